"""What every model is: states, inputs and the terms of its slots, checked and frozen.

The record holds no mathematics: ``symbolic`` turns it into CasADi functions,
``structure`` reads positions and storages from it, the catalogue finds effects that
could be added to it, and ``model`` has the classes that a user writes. Every change
makes a new record.
"""

from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from itertools import chain
from types import MappingProxyType
from typing import Any, ClassVar, Self, TypeVar, cast

import numpy as np

from phsi_opt.arguments import is_of, require_known, typed
from phsi_opt.data.checks import check_unique, checked_names
from phsi_opt.errors import ModelError, did_you_mean, shown
from phsi_opt.model.directions import direction_parts, normal_direction
from phsi_opt.model.effect import Effect
from phsi_opt.model.expressions import RESERVED_IN_FORMULAS, delays_in
from phsi_opt.model.kinds import checked_kinds
from phsi_opt.model.parameters import Parameter, with_value
from phsi_opt.model.slots import (
    BY_EQUATION,
    SLOTS,
    Entry,
    PlacedTerm,
    Variables,
)
from phsi_opt.model.terms import Dictionary, Term, check_number_of_terms

T = TypeVar("T")


@lru_cache(maxsize=64)  # those last asked for; a model keeps its own while it lives
def built_of(formulas: Hashable) -> dict[Hashable, object]:
    """What was built of the same formulas, by name; empty at first.

    Models are records that come and go: a fit makes dozens with other values, a study
    hundreds. Building CasADi functions takes longer than evaluating them, and what a
    function computes follows from its formulas alone, so it does not matter who built
    it. Nothing here is written to a file.
    """
    return {}


@dataclass(frozen=True, kw_only=True, repr=False)
class BaseModel:
    """States, inputs, and the terms of the slots H, R, F and sensor; see ``Model``.

    ``kind`` says of some states what they are, see ``kinds``.

    Raises:
        ModelError: names that are no names or stand twice, terms that are not of their
            slot, or an equation of a state that the model does not have.
    """

    states: Sequence[str]  # a tuple once checked
    inputs: Sequence[str]
    R: Mapping[str, Dictionary]
    F: Mapping[str, Dictionary]
    sensor: Mapping[str, Dictionary]
    S: Any  # a tuple of rows once checked
    H: Dictionary
    memory: Sequence[str]
    kind: Any  # a mapping from states once checked
    has_energy: ClassVar[bool] = True  # whether efforts are dH/dx; else the states

    # ---- what is allowed -------------------------------------------------------------

    def __post_init__(self) -> None:
        for what in ("states", "inputs", "memory"):
            names = getattr(self, what)
            listed = checked_names(names, what, RESERVED_IN_FORMULAS, ModelError)
            self._set(what, listed)
        check_unique((*self.states, *self.inputs), "name", ModelError)
        check_unique(self.memory, "memory", ModelError)
        self._set("S", checked_structure(self.S, len(self.states)))
        self._read_texts()
        for name in self.memory:
            self.index(name, "memory")
        self._set("kind", checked_kinds(self.kind, self.states, self.memory))
        of_dictionaries = [one for one in self.placed() if not one.term.is_formula]
        check_number_of_terms(len(of_dictionaries), "a model")
        self.variables.check_parameters(self.entries)
        shared = self.names_in_formulas
        for placed in self.placed():
            self.variables.check_term(placed, shared)

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)  # the record is frozen for all others

    def __getstate__(self) -> dict[str, Any]:  # without what was built
        return {part.name: getattr(self, part.name) for part in fields(self)}

    def _read_texts(self) -> None:
        """Turn texts into formulas; names that nothing defines become parameters.

        Equations are put in the order of the states, and directions behind them.
        """
        given: dict[str, dict[str, Any]] = {"R": {}, "H": {"": self.H}}  # R first:
        for slot in BY_EQUATION:  # what is a loss is not negative elsewhere either
            terms = {}
            for name, one in getattr(self, slot).items():
                terms[self._place(slot, name)] = one
            own = {name: terms.pop(name) for name in self.states if name in terms}
            given[slot] = own | terms
        known: dict[str, Parameter] = {}
        for terms in chain.from_iterable(map(dict.values, given.values())):
            for term in terms if isinstance(terms, Dictionary) else ():
                known |= term.inner if term.is_formula else {}
        for slot, equations in given.items():
            for equation, terms in equations.items():
                if isinstance(terms, str):
                    formula = self.variables.formula(terms, slot, equation, known)
                    equations[equation] = formula
        self._set("H", given.pop("H")[""])
        for slot, equations in given.items():
            self._set(slot, MappingProxyType(equations))

    # ---- what it consists of ---------------------------------------------------------

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def n_inputs(self) -> int:
        """Number of inputs of its functions, two more for each that is delayed."""
        return len(self.inputs) + 2 * len(self.delays)

    @cached_property
    def delays(self) -> tuple[tuple[str, str], ...]:
        """Input and parameter of each delayed input ``delayed(u, tau)``.

        To its functions u(t - tau) is ``value + tau slope``: the values are inputs
        behind the measured ones, and the slopes behind these.
        """
        found = chain.from_iterable(delays_in(term.body) for *_, term in self.placed())
        return tuple(dict.fromkeys(found))

    @property
    def variables(self) -> Variables:
        """The names that formulas may use beside parameters."""
        return Variables(self.states, self.inputs)

    @property
    def efforts(self) -> tuple[str, ...]:
        """Names of the efforts dH/dx_i in formulas of R and F.

        The effort of a momentum is a velocity, that of a storage a level.
        """
        return self.variables.efforts

    def index(self, state: str, what: str = "state") -> int:
        """Position of a state among the states.

        Raises:
            ModelError: there is no such state; ``what`` says what was looked for.
        """
        said = f"{what} {state!r} is not a state of the model"
        require_known(state, self.states, said)
        return self.states.index(state)

    def _place(self, slot: str, equation: Any) -> str:
        """An equation of a slot, or for R and F a direction as it is kept.

        Raises:
            ModelError: it is no state, or no sum of states.
        """
        is_text = isinstance(equation, str)
        if is_text and slot != "sensor" and not equation.isidentifier():
            return normal_direction(equation, self.states)
        row = self.index(equation, f"equation of {slot}")
        return self.states[row]

    @typed
    def rows(self, equation: str) -> tuple[int, ...]:
        """Positions of the states in whose equations a term acts."""
        if equation.isidentifier() or not equation:
            return (self.index(equation, "equation"),)
        parts = direction_parts(equation, tuple(self.states))
        return tuple(self.states.index(part.state) for part in parts)

    def terms_at(self, slot: str, equation: str) -> Dictionary:
        """The terms in a slot of an equation (of the whole model, for H)."""
        if slot == "H":
            return self.H
        terms: Dictionary = getattr(self, slot).get(equation, Dictionary())
        return terms

    def placed(self) -> list[PlacedTerm]:
        """All terms with slot and equation ('' for H)."""
        rows = self.placed_at("H", "")
        for slot in BY_EQUATION:
            for equation in getattr(self, slot):
                rows += self.placed_at(slot, equation)
        return rows

    def placed_at(self, slot: str, equation: str) -> list[PlacedTerm]:
        """The terms in a slot of an equation, with both."""
        return [
            PlacedTerm(slot, equation, one) for one in self.terms_at(slot, equation)
        ]

    @cached_property
    def names_in_formulas(self) -> tuple[str, ...]:
        """Names of the parameters in formulas, which a user gave."""
        names: dict[str, Parameter] = {}
        for _, _, term in self.placed():
            names |= term.inner if term.is_formula else {}
        return tuple(names)

    # ---- its parameters --------------------------------------------------------------

    @cached_property
    def entries(self) -> Mapping[str, Entry]:
        """Every parameter by name, in the order of the model.

        A formula's parameter may stand in several terms.

        Raises:
            ModelError: one name for two different parameters, or a term that stands
                twice.
        """
        table: dict[str, Entry] = {}
        for entry in chain.from_iterable(map(PlacedTerm.entries, self.placed())):
            known = table.setdefault(entry.name, entry)
            if known is entry:
                continue
            if known.parameter != entry.parameter:
                raise ModelError(
                    f"parameter {entry.name!r} is defined twice and differently "
                    f"({known.slot} and {entry.slot}): "
                    f"{known.parameter} and {entry.parameter}. "
                    "Use one Parameter for both, or two names."
                )
            if entry.prunable:
                raise ModelError(f"the term of {entry.name!r} is in the model already.")
        return MappingProxyType(table)

    @cached_property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters that are not fixed, in the order of theta."""
        entries = self.entries.values()
        return tuple(one.name for one in entries if not one.parameter.fixed)

    @property
    def values(self) -> dict[str, float]:
        """Present value (or start) of every parameter."""
        return {name: entry.parameter.start for name, entry in self.entries.items()}

    @property
    def theta(self) -> np.ndarray:
        """Present values of the free parameters, (n_free,), in the order of `free`."""
        values = self.values
        return np.array([values[name] for name in self.free])

    # ---- what is built of it ---------------------------------------------------------

    def built(self, key: Hashable, make: Callable[[], T]) -> T:
        """What ``make`` builds, once for all models with the same formulas.

        It must not depend on the values of the free parameters.

        Args:
            key: under which it is kept.
            make: builds it.
        """
        if key not in self._built:
            self._built[key] = make()
        return cast("T", self._built[key])

    @cached_property
    def _built(self) -> dict[Hashable, object]:
        """By the formulas and the numbers in them, on which alone it depends."""
        # Values of unknown parameters are arguments, and bounds, units and guesses are
        # for others.
        terms: list[Hashable] = []
        for *at, term in self.placed():
            terms.append((*at, term.body, term.name, term.is_formula, *term.inner))
        for name, entry in self.entries.items():
            if entry.parameter.fixed:
                terms.append((name, entry.parameter.start.hex()))
        structure = (type(self), self.states, self.inputs, self.memory, self.S)
        return built_of((*structure, self.free, *terms))

    # ---- changes: each makes a new model ---------------------------------------------

    def add(self, effect: Effect) -> Self:
        """A new model with the effect's terms in its slot; see `Model.add`."""
        slot = effect.slot
        equation = effect.equation
        if slot == "H" and not self.has_energy:
            raise ModelError(
                f"effect {effect.name!r} changes an energy, "
                f"but a {type(self).__name__} model has none."
            )
        states = (*self.states, *effect.memory)
        S = np.zeros((len(states), len(states)))
        S[: self.n_states, : self.n_states] = self.S
        changed: dict[str, Any] = {"F": {**self.F, **effect.memory}}
        if slot == "H":
            changed["H"] = self.H + effect.term
        else:
            if equation.isidentifier() or slot == "sensor":
                said = (
                    f"equation of effect {effect.name!r}: {equation!r} is not a state"
                )
                require_known(equation, states, f"{said} of the model")
            else:
                equation = normal_direction(equation, states)
            terms = dict(changed.get(slot, getattr(self, slot)))
            terms[equation] = terms.get(equation, Dictionary()) + effect.term
            changed[slot] = terms
        memory = (*self.memory, *effect.memory)
        return replace(self, states=states, S=S, memory=memory, **changed)

    @typed
    def without(self, names: set[str]) -> Self:
        """A new model without the terms whose coefficients are named."""

        def kept(place: str, term: Term) -> Term | None:
            is_kept = term.is_formula or term.parameter_name(place) not in names
            return term if is_kept else None

        return self._with_terms(kept)

    @typed
    def with_values(self, values: Mapping[str, float]) -> Self:
        """A new model with the named parameters set.

        Raises:
            ModelError: there is no such parameter.
        """
        for name in sorted(values.keys() - self.entries.keys()):
            hint = did_you_mean(name, self.entries)
            raise ModelError(f"parameter {name!r} is not in the model.{hint}")
        if all(self.entries[name].parameter.value == v for name, v in values.items()):
            return self
        changed = self.with_parameters(
            lambda name, parameter: with_value(parameter, values[name]), values
        )
        if not any(self.entries[name].parameter.fixed for name in values):
            # Parameters that are not known are arguments of what was built.
            vars(changed)["_built"] = self._built
        return changed

    def with_fixed(self, values: Mapping[str, float]) -> Self:
        """A new model with the named parameters known: fixed at these values.

        Raises:
            ModelError: there is no such parameter.
        """
        valued = self.with_values(values)
        return valued._with_settings(values, fixed=True, per_trajectory=False)

    @typed
    def with_free(self, names: Iterable[str]) -> Self:
        """A new model with the named parameters unknown, from their present values."""
        return self._with_settings(set(names), fixed=False)

    @typed
    def with_upper(self, bounds: Mapping[str, float]) -> Self:
        """A new model with the named parameters no higher than the given bounds.

        An upper bound that is lower already stays.
        """

        def bounded(name: str, one: Parameter) -> Parameter:
            upper = min(bounds[name], one.upper)
            within = None if one.value is None else min(one.value, upper)
            return replace(one, upper=upper, value=within)

        return self.with_parameters(bounded, bounds)

    def frozen(self) -> Self:
        """A new model with every parameter fixed at its present value."""
        return self.with_fixed(self.values)

    def dynamics(self) -> Self:
        """A new model of the motion alone, the same for all trajectories.

        Its sensors show the state itself, and every parameter is shared by all runs.
        """
        entries = self.entries.values()
        if not self.sensor and not any(e.parameter.per_trajectory for e in entries):
            return self
        motion = replace(self, sensor={})
        return motion._with_settings(motion.entries, per_trajectory=False)

    def _with_settings(self, names: Collection[str], **settings: Any) -> Self:
        """A new model with the same settings for the named parameters."""
        return self.with_parameters(lambda _, one: replace(one, **settings), names)

    def with_parameters(
        self, change: Callable[[str, Parameter], Parameter], names: Collection[str]
    ) -> Self:
        """A new model with each of the named parameters (by its name) changed."""

        def chosen(name: str, parameter: Parameter) -> Parameter:
            return change(name, parameter) if name in names else parameter

        return self._with_terms(lambda place, one: one.with_parameters(place, chosen))

    def _with_terms(self, change: Callable[[str, Term], Term | None]) -> Self:
        """A new model with each term changed, by the name of its place; None: gone."""
        slots: dict[str, Any] = {slot: {} for slot in SLOTS}
        for placed in self.placed():
            slot, equation, term = placed
            changed = change(placed.place, term)
            if changed is not None:
                slots[slot].setdefault(equation, []).append(changed)
        for slot, equations in slots.items():
            for equation, terms in equations.items():
                slots[slot][equation] = Dictionary(tuple(terms))
        slots["H"] = slots["H"].get("", Dictionary())
        return replace(self, **slots)


def checked_structure(S: Any, n: int) -> tuple[tuple[float, ...], ...]:
    """The structure matrix S, (n, n), as rows; zero where none is given.

    Raises:
        ModelError: S is no n x n matrix of numbers, or is not skew-symmetric.
    """
    try:
        if S is not None and not is_of(S, Iterable[Iterable[float]]):
            raise TypeError
        matrix = np.zeros((n, n)) if S is None else np.array(S, dtype=float)
    except (TypeError, ValueError):
        raise ModelError(
            f"S={shown(S)} is not a matrix of numbers; expected {n} x {n}."
        ) from None
    if matrix.shape != (n, n):
        raise ModelError(
            f"S has shape {matrix.shape}; expected ({n}, {n}), "
            "one row and column per state."
        )
    wrong = ~np.isfinite(matrix) | (matrix != -matrix.T)
    if np.any(wrong):
        i, j = np.argwhere(wrong)[0]
        raise ModelError(
            f"S is not skew-symmetric: S[{i}, {j}]={matrix[i, j]:g} "
            f"but S[{j}, {i}]={matrix[j, i]:g}; "
            "expected S[j, i] = -S[i, j]. Put losses into R."
        )
    return tuple(map(tuple, matrix.tolist()))

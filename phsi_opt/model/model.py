"""Models: dx/dt = (S - R(x)) grad H(x) + F(x, t, u), and dx/dt = F(x, t, u) without
structure.

A model is a frozen record of states, inputs and the dictionaries of its slots; every
change makes a new model. This file also turns a model into CasADi functions. It knows
nothing of data, losses or solvers.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, Protocol

import casadi as ca
import numpy as np

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.expressions import CASADI, CONSTANTS, FUNCTIONS, evaluate, names_of
from phsi_opt.model.parameters import Parameter, with_value
from phsi_opt.model.slots import BY_EQUATION, SLOTS, Entry, place_of
from phsi_opt.model.terms import Dictionary, Term, with_parameters


class Addition(Protocol):
    """What `Model.add` needs of an effect."""

    @property
    def name(self) -> str: ...
    @property
    def slot(self) -> str: ...
    @property
    def equation(self) -> str: ...
    @property
    def term(self) -> Dictionary: ...
    @property
    def memory(self) -> Mapping[str, Dictionary]: ...


@dataclass(frozen=True, kw_only=True)
class Model:
    """What every model has: states, inputs, loss R and force F per equation. See
    `PseudoHamiltonian`, `FirstOrder`.

    ``sensor`` holds, per state, what its sensor adds to it: measured = state + sensor
    terms, such as an offset ``formula("b", b=Parameter(0.0))`` or a gain ``formula("(g
    - 1)*q", g=Parameter(1.0))``. ``memory`` names the states that are the memory of an
    effect (a lag, a hysteresis): their equations stand in F and the measurements need
    not know them.
    """

    states: Sequence[str]  # a tuple once checked
    inputs: Sequence[str] = ()
    R: Mapping[str, Dictionary] = field(default_factory=dict)
    F: Mapping[str, Dictionary] = field(default_factory=dict)
    sensor: Mapping[str, Dictionary] = field(default_factory=dict)
    S: Any = None
    H: Dictionary = field(default_factory=Dictionary)
    memory: Sequence[str] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "states", _names(self.states, "states"))
        object.__setattr__(self, "inputs", _names(self.inputs, "inputs", empty=True))
        if clash := set(self.states) & set(self.inputs):
            raise ModelError(
                f"{sorted(clash)} are both states and inputs; rename one of them."
            )
        object.__setattr__(self, "S", _structure(self.S, len(self.states)))
        object.__setattr__(self, "H", _dictionary(self.H, "H"))
        for slot in BY_EQUATION:
            object.__setattr__(self, slot, self._equations(getattr(self, slot), slot))
        object.__setattr__(self, "memory", _names(self.memory, "memory", empty=True))
        for name in self.memory:
            self.index(name, "memory")
        self._check_names()

    def __getstate__(self) -> dict[str, Any]:  # a mappingproxy cannot be pickled
        kept = {f.name: getattr(self, f.name) for f in fields(self)}
        return {**kept, **{slot: dict(getattr(self, slot)) for slot in BY_EQUATION}}

    def __setstate__(self, parts: dict[str, Any]) -> None:
        for name, value in parts.items():
            object.__setattr__(
                self, name, MappingProxyType(value) if name in BY_EQUATION else value
            )

    def _equations(
        self, dictionaries: Mapping[str, Dictionary], slot: str
    ) -> Mapping[str, Dictionary]:
        if not isinstance(dictionaries, Mapping):
            raise ModelError(
                f"{slot}={dictionaries!r} must map a state to its terms, such as {{'p': formula('u')}}."
            )
        for name in dictionaries:
            self.index(name, f"equation of {slot}")
        ordered = {
            name: _dictionary(dictionaries[name], f"{slot}[{name!r}]")
            for name in self.states
            if name in dictionaries
        }
        return MappingProxyType(ordered)

    def _check_names(self) -> None:
        variables = set(self.states) | set(self.inputs) | {"t"}
        if clash := set(self.entries) & (
            variables | set(self.efforts) | set(self.slopes)
        ):
            raise ModelError(
                f"parameter name {sorted(clash)[0]!r} is also a state, an input or an effort; rename it."
            )
        for slot, _, term in self.placed():
            allowed = set(self.states) | set(term.inner)
            allowed |= set() if slot == "H" else {"t", *self.inputs, *self.efforts}
            allowed |= set(self.slopes) if slot == "F" else set()
            for name in sorted(names_of(term.body) - allowed):
                raise ModelError(self._unknown_name(name, slot, term, allowed))

    def _unknown_name(self, name: str, slot: str, term: Term, allowed: set[str]) -> str:
        if slot == "H" and name in {"t", *self.inputs, *self.efforts}:
            return f"{term.body!r} in H uses {name!r}, but an energy depends on the states alone; put the term into F."
        hint = (
            did_you_mean(name, allowed)
            or f" If it is a parameter, give it: formula(..., {name}=Parameter(1.0))."
        )
        return f"name {name!r} in {term.body!r} ({slot}) is unknown; known are {', '.join(sorted(allowed))}.{hint}"

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def efforts(self) -> tuple[str, ...]:
        """Names of the efforts dH/dx_i in formulas of R and F (velocities, for
        momenta).
        """
        return tuple(f"dH_d{name}" for name in self.states)

    @property
    def slopes(self) -> tuple[str, ...]:
        """Names, in formulas of F, of the slope of the equation's other force terms in
        each input.
        """
        return tuple(f"dF_d{name}" for name in self.inputs)

    def index(self, state: str, what: str = "state") -> int:
        """Position of a state; raises `ModelError` for an unknown name."""
        if state not in self.states:
            raise ModelError(
                f"{what} {state!r} is not a state of the model; its states are {', '.join(self.states)}."
                f"{did_you_mean(str(state), self.states)}"
            )
        return self.states.index(state)

    def placed(self) -> list[tuple[str, str, Term]]:
        """All terms with slot and equation ('' for H)."""
        rows = [("H", "", term) for term in self.H]
        for slot in BY_EQUATION:
            dictionaries = getattr(self, slot)
            rows += [
                (slot, equation, term)
                for equation, terms in dictionaries.items()
                for term in terms
            ]
        return rows

    @cached_property
    def entries(self) -> Mapping[str, Entry]:
        """Every parameter by name, in the order of the model. A formula's parameter may
        stand in several terms.
        """
        found: dict[str, Entry] = {}
        for slot, equation, term in self.placed():
            place = place_of(slot, equation)
            rows = (
                []
                if term.is_formula
                else [(term.coefficient_name(place), term.coefficient, True)]
            )
            rows += [
                (term.inner_name(name, place), parameter, False)
                for name, parameter in term.inner.items()
            ]
            for name, parameter, prunable in rows:
                assert parameter is not None
                _register(found, Entry(name, parameter, slot, equation, prunable))
        return MappingProxyType(found)

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters that are not fixed: the order of theta."""
        return tuple(
            name for name, entry in self.entries.items() if not entry.parameter.fixed
        )

    @property
    def values(self) -> dict[str, float]:
        """Present value (or start) of every parameter."""
        return {name: entry.parameter.start for name, entry in self.entries.items()}

    @property
    def theta(self) -> np.ndarray:
        """Present values of the free parameters, (n_free,), in the order of `free`."""
        values = self.values
        return np.array([values[name] for name in self.free])

    def add(self, effect: Addition) -> "Model":
        """A new model with the effect's terms added in its slot, and its memory as
        further states at the end.
        """
        if effect.memory:
            return self._remembering(effect.memory).add(replace(effect, memory={}))  # type: ignore[type-var]
        if effect.slot == "H":
            return replace(self, H=self.H + effect.term)
        if effect.slot not in BY_EQUATION:
            raise ModelError(
                f"effect {effect.name!r} acts in slot {effect.slot!r}; expected one of {', '.join(SLOTS)}."
            )
        self.index(effect.equation, f"equation of effect {effect.name!r}:")
        old = getattr(self, effect.slot)
        new = old.get(effect.equation, Dictionary()) + effect.term
        changed: dict[str, Any] = {effect.slot: {**old, effect.equation: new}}
        return replace(self, **changed)

    def _remembering(self, memory: Mapping[str, Dictionary]) -> "Model":
        n, more = self.n_states, len(memory)
        S = np.zeros((n + more, n + more))
        S[:n, :n] = self.S
        return replace(
            self,
            states=(*self.states, *memory),
            S=S,
            F={**self.F, **memory},
            memory=(*self.memory, *memory),
        )

    def without(self, names: set[str]) -> "Model":
        """A new model without the terms whose coefficients are named."""

        def kept(slot: str, equation: str, terms: Dictionary) -> Dictionary:
            place = place_of(slot, equation)
            return Dictionary(
                tuple(
                    t
                    for t in terms
                    if t.is_formula or t.coefficient_name(place) not in names
                )
            )

        slots: dict[str, Any] = {
            slot: {
                name: d
                for name, terms in getattr(self, slot).items()
                if len(d := kept(slot, name, terms))
            }
            for slot in BY_EQUATION
        }
        return replace(self, H=kept("H", "", self.H), **slots)

    def with_values(self, values: Mapping[str, float]) -> "Model":
        """A new model with the named parameters set."""
        for name in values:
            if name not in self.entries:
                raise ModelError(
                    f"parameter {name!r} is not in the model.{did_you_mean(name, self.entries)}"
                )

        return self._changed(
            lambda name, p: with_value(p, values[name]) if name in values else p
        )

    def with_fixed(self, values: Mapping[str, float]) -> "Model":
        """A new model with the named parameters known: fixed at these values."""

        def hold(name: str, parameter: Parameter) -> Parameter:
            return (
                replace(parameter, fixed=True, per_trajectory=False)
                if name in values
                else parameter
            )

        return self.with_values(values)._changed(hold)

    def with_free(self, names: Iterable[str]) -> "Model":
        """A new model with the named parameters unknown, from their present values on."""
        chosen = set(names)
        return self._changed(
            lambda name, p: replace(p, fixed=False) if name in chosen else p
        )

    def with_upper(self, bounds: Mapping[str, float]) -> "Model":
        """A new model in which the named parameters, and their upper bounds, are no
        higher than the given ones.
        """

        def bounded(name: str, parameter: Parameter) -> Parameter:
            if name not in bounds or bounds[name] >= parameter.upper:
                return parameter
            value = (
                None if parameter.value is None else min(parameter.value, bounds[name])
            )
            return replace(parameter, upper=bounds[name], value=value)

        return self._changed(bounded)

    def _changed(self, change: Callable[[str, Parameter], Parameter]) -> "Model":
        """A new model with each parameter (by its name) changed."""

        def changed(slot: str, equation: str, terms: Dictionary) -> Dictionary:
            return Dictionary(
                tuple(
                    with_parameters(term, place_of(slot, equation), change)
                    for term in terms
                )
            )

        slots: dict[str, Any] = {
            s: {
                name: changed(s, name, terms)
                for name, terms in getattr(self, s).items()
            }
            for s in BY_EQUATION
        }
        return replace(self, H=changed("H", "", self.H), **slots)

    def frozen(self) -> "Model":
        """A new model with every parameter fixed at its present value."""
        return self.with_fixed(self.values)

    def dynamics(self) -> "Model":
        """A new model without sensors (they show the state itself) and with every
        parameter shared by all runs.
        """
        return replace(self, sensor={})._changed(
            lambda name, p: replace(p, per_trajectory=False)
        )

    def expressions(
        self, x: Any, u: Any, t: Any, values: Mapping[str, Any], backend: int = CASADI
    ) -> "Expressions":
        """H, the diagonal of R and F as expressions of the states x, inputs u, time t
        and parameter values.
        """
        known = {
            **dict(zip(self.states, x, strict=True)),
            **dict(zip(self.inputs, u, strict=True)),
            "t": t,
        }
        energy = self._sum(self.H, "H", known, values, backend)
        efforts = self._efforts(energy, x, backend)
        known.update(zip(self.efforts, efforts, strict=True))
        loss, sensor = (
            [
                self._sum(
                    slot.get(n, Dictionary()), place_of(kind, n), known, values, backend
                )
                for n in self.states
            ]
            for kind, slot in (("R", self.R), ("sensor", self.sensor))
        )
        force = [self._force(name, u, known, values, backend) for name in self.states]
        return Expressions(energy, efforts, loss, force, sensor)

    def _force(
        self,
        equation: str,
        u: Sequence[Any],
        known: Mapping[str, Any],
        values: Mapping[str, Any],
        backend: int,
    ) -> Any:
        """F of one equation; terms that name a slope in an input see the slope of the
        other terms.
        """
        terms, place = self.F.get(equation, Dictionary()), place_of("F", equation)
        later = tuple(term for term in terms if names_of(term.body) & set(self.slopes))
        force = self._sum(
            Dictionary(tuple(t for t in terms if t not in later)),
            place,
            known,
            values,
            backend,
        )
        if not later:
            return force
        slopes = {
            name: _slope(force, u[i], backend) for i, name in enumerate(self.slopes)
        }
        return force + self._sum(
            Dictionary(later), place, {**known, **slopes}, values, backend
        )

    def _sum(
        self,
        terms: Dictionary,
        place: str,
        known: Mapping[str, Any],
        values: Mapping[str, Any],
        backend: int,
    ) -> Any:
        total = 0
        for term in terms:
            inner = {name: values[term.inner_name(name, place)] for name in term.inner}
            body = evaluate(term.body, {**known, **inner}, backend)
            total = total + (
                body if term.is_formula else values[term.coefficient_name(place)] * body
            )
        return total

    def _efforts(self, energy: Any, x: Sequence[Any], backend: int) -> list[Any]:
        if backend == CASADI:
            gradient = (
                ca.gradient(energy, ca.vertcat(*x))
                if isinstance(energy, ca.SX)
                else ca.SX.zeros(len(x))
            )
            return [gradient[i] for i in range(len(x))]
        return [energy.diff(name) if energy != 0 else energy for name in x]

    def rhs(self) -> ca.Function:
        """CasADi function (x, u, t, theta) -> dx/dt, theta in the order of `free`."""
        return self._rhs

    @cached_property
    def _rhs(self) -> ca.Function:
        x, u, t, theta, values = self._symbols()
        e = self.expressions(
            [x[i] for i in range(self.n_states)],
            [u[i] for i in range(self.n_inputs)],
            t,
            values,
        )
        return ca.Function(
            "rhs",
            [x, u, t, theta],
            [ca.densify(self.derivative(e))],
            ["x", "u", "t", "theta"],
            ["dx"],
        )

    def output(self) -> ca.Function:
        """CasADi function (x, u, t, theta) -> what the sensors show of the states x."""
        return self._output

    @cached_property
    def _output(self) -> ca.Function:
        x, u, t, theta, values = self._symbols()
        shown = x
        if self.sensor:
            e = self.expressions(
                [x[i] for i in range(self.n_states)],
                [u[i] for i in range(self.n_inputs)],
                t,
                values,
            )
            shown = x + ca.vertcat(*(ca.SX(added) for added in e.sensor))
        return ca.Function(
            "output",
            [x, u, t, theta],
            [ca.densify(shown)],
            ["x", "u", "t", "theta"],
            ["y"],
        )

    def derivative(self, e: "Expressions") -> Any:
        """(S - R) grad H + F as a column of expressions."""
        rows = []
        for i in range(self.n_states):
            exchange = sum(
                (s * e.efforts[j] for j, s in enumerate(self.S[i]) if s != 0.0), start=0
            )
            rows.append(exchange - e.loss[i] * e.efforts[i] + e.force[i])
        return ca.vertcat(*(ca.SX(row) for row in rows))

    def function(self, *expressions: str) -> ca.Function:
        """CasADi function (x, u, t, theta) -> the given formulas (of states, inputs, t,
        efforts), as one column.
        """
        x, u, t, theta, values = self._symbols()
        xs, us = (
            [x[i] for i in range(self.n_states)],
            [u[i] for i in range(self.n_inputs)],
        )
        e = self.expressions(xs, us, t, values)
        known = {
            **dict(zip(self.states, xs, strict=True)),
            **dict(zip(self.inputs, us, strict=True)),
            "t": t,
        }
        known.update(zip(self.efforts, e.efforts, strict=True))
        known.update(values)
        column = ca.vertcat(*(ca.SX(evaluate(text, known)) for text in expressions))
        return ca.Function("formulas", [x, u, t, theta], [ca.densify(column)])

    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, dict[str, Any]]:
        x, u, t = (
            ca.SX.sym("x", self.n_states),
            ca.SX.sym("u", self.n_inputs),
            ca.SX.sym("t"),
        )
        free = self.free
        theta = ca.SX.sym("theta", len(free))
        values: dict[str, Any] = dict(self.values)
        values.update({name: theta[i] for i, name in enumerate(free)})
        return x, u, t, theta, values


@dataclass(frozen=True)
class Expressions:
    """The parts of a model as expressions; R is diagonal, so ``loss`` holds its
    diagonal.
    """

    energy: Any
    efforts: list[Any]
    loss: list[Any]
    force: list[Any]
    sensor: list[Any]


@dataclass(frozen=True, kw_only=True)
class PseudoHamiltonian(Model):
    """dx/dt = (S - R(x)) grad H(x) + F(x, t, u) (thesis Eq. 2.42), with a constant
    skew-symmetric S and a diagonal R.

    Args:
        states: names of the states; S: (n_states, n_states) matrix, see `canonical`.
        H: dictionary of the states alone.
        R: per equation, the terms of the diagonal entry R_ii(x) >= 0; the loss is R_ii
            dH/dx_i.
        F: per equation, terms in the states, inputs, efforts (``dH_dp``) and the time
            ``t``.
        inputs: names of the measured inputs.
        sensor: per measured state, what its sensor adds to it, such as an offset; terms
            as in F.

    Raises `ModelError` for unknown names, a matrix that is not skew-symmetric, or a
    term that occurs twice.
    """

    def __post_init__(self) -> None:
        if self.S is None:
            raise ModelError(
                "S is missing; give canonical(n) for n positions and n momenta, or a matrix."
            )
        super().__post_init__()
        if not self.H.terms:
            raise ModelError(
                "H has no term, so no energy flows; give it a formula or dictionary, or use FirstOrder."
            )


@dataclass(frozen=True, kw_only=True, init=False)
class FirstOrder(Model):
    """dx_i/dt = F_i(x, t, u) - R_ii(x) x_i: no energy, no structure (the thesis' BSI).
    Its efforts are the states.
    """

    def __init__(
        self,
        states: Sequence[str],
        F: Mapping[str, Dictionary],
        inputs: Sequence[str] = (),
        R: Mapping[str, Dictionary] | None = None,
        sensor: Mapping[str, Dictionary] | None = None,
        *,
        memory: Sequence[str] = (),
        S: Any = None,
        H: Dictionary | None = None,
    ) -> None:
        if H or np.any(S):  # `dataclasses.replace` passes them on, empty
            raise ModelError(
                "a FirstOrder model has no S and no H; use PseudoHamiltonian, or put the terms into F."
            )
        parts = {
            "states": states,
            "F": F,
            "inputs": inputs,
            "R": R or {},
            "sensor": sensor or {},
            "S": None,
            "H": Dictionary(),
            "memory": memory,
        }
        for name, value in parts.items():
            object.__setattr__(self, name, value)
        self.__post_init__()

    def add(self, effect: Addition) -> Model:
        """A new model with the effect's terms added; effects of the energy have no
        place here.
        """
        if effect.slot == "H":
            raise ModelError(
                f"effect {effect.name!r} changes an energy, but a FirstOrder model has none."
            )
        return super().add(effect)

    def _efforts(self, energy: Any, x: Sequence[Any], backend: int) -> list[Any]:
        return list(x)


def _slope(expression: Any, variable: Any, backend: int) -> Any:
    if backend == CASADI:
        return (
            ca.jacobian(expression, variable) if isinstance(expression, ca.SX) else 0.0
        )
    return expression.diff(variable) if hasattr(expression, "diff") else 0


def _names(names: Sequence[str], what: str, empty: bool = False) -> tuple[str, ...]:
    if isinstance(names, str):
        raise ModelError(
            f"{what}={names!r} must be a list of names, such as [{names!r}]."
        )
    listed = tuple(names)
    for name in listed:
        if (
            not isinstance(name, str)
            or not name.isidentifier()
            or name == "t"
            or name in (*FUNCTIONS, *CONSTANTS)
        ):
            raise ModelError(
                f"{name!r} in {what} cannot be a name here; use letters, digits and _, and not t or a function."
            )
    if len(set(listed)) != len(listed) or (not listed and not empty):
        raise ModelError(
            f"{what}={list(listed)!r} must name at least one, and each only once."
        )
    return listed


def _structure(S: Any, n: int) -> tuple[tuple[float, ...], ...]:
    try:
        matrix = np.zeros((n, n)) if S is None else np.array(S, dtype=float)
    except (TypeError, ValueError):
        raise ModelError(
            f"S={S!r} is not a matrix of numbers; expected {n} x {n}."
        ) from None
    if matrix.shape != (n, n):
        raise ModelError(
            f"S has shape {matrix.shape}; expected ({n}, {n}), one row and column per state."
        )
    if not np.all(np.isfinite(matrix)) or np.any(matrix != -matrix.T):
        i, j = np.argwhere(~np.isfinite(matrix) | (matrix != -matrix.T))[0]
        raise ModelError(
            f"S is not skew-symmetric: S[{i}, {j}]={matrix[i, j]:g} but S[{j}, {i}]={matrix[j, i]:g}; "
            "expected S[j, i] = -S[i, j]. Put losses into R."
        )
    return tuple(tuple(float(v) for v in row) for row in matrix)


def _dictionary(terms: Any, where: str) -> Dictionary:
    if not isinstance(terms, Dictionary):
        raise ModelError(
            f"{where}={terms!r} is not a dictionary of terms; write formula('...') or polynomials([...], n)."
        )
    return terms


def _register(found: dict[str, Entry], entry: Entry) -> None:
    known = found.get(entry.name)
    if known is None:
        found[entry.name] = entry
    elif known.parameter != entry.parameter:
        raise ModelError(
            f"parameter {entry.name!r} is defined twice and differently ({known.slot} and {entry.slot}): "
            f"{known.parameter} and {entry.parameter}. Use one Parameter for both, or two names."
        )
    elif entry.prunable:
        raise ModelError(f"the term of {entry.name!r} is in the model already.")

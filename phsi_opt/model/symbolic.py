"""A model as expressions and CasADi functions of its states, inputs, time and theta.

The sums of a model's slots are evaluated here, in CasADi for the solver and in SymPy
for printing; ``Model`` keeps the functions. This file knows nothing of data, losses or
solvers.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from phsi_opt.model.base import BaseModel
from phsi_opt.model.directions import direction_parts, summed
from phsi_opt.model.effect import Effect, is_scanned
from phsi_opt.model.expressions import CASADI, Backend, names_of
from phsi_opt.model.poisson import structure_words
from phsi_opt.model.slots import PlacedTerm, place_of
from phsi_opt.model.terms import Term
from phsi_opt.presentation.summary import Part, Summary, printed_table


@dataclass(frozen=True)
class Expressions:
    """The parts of a model as expressions, one per state but for the energy."""

    model: BaseModel  # the model
    x: Sequence[Any]  # the states
    u: Sequence[Any]  # the inputs
    t: Any  # the time
    values: Mapping[str, Any]  # the parameters, by name
    backend: Backend = CASADI  # the library whose symbols these are

    @cached_property
    def energy(self) -> Any:
        return self._total(self.model.placed_at("H", ""), self._variables)

    @cached_property
    def efforts(self) -> list[Any]:
        """dH/dx; in a model without energy the states themselves."""
        if not self.model.has_energy:
            return list(self.x)
        if self.backend is not CASADI:
            return [self._slope(self.energy, name) for name in self.x]
        energy = ca.SX(self.energy)  # a number, where no term has a state
        return ca.vertsplit(ca.gradient(energy, ca.vertcat(*self.x)))

    @cached_property
    def losses(self) -> list[Any]:
        """What R takes from each rate, r b b' grad H along every direction b."""
        found = []
        for state, effort in zip(self.model.states, self.efforts, strict=True):
            found.append(self.total("R", state) * effort)
        efforts = dict(zip(self.model.states, self.efforts, strict=True))
        for loss, factors in self._along_directions("R"):
            along = sum(factor * efforts[state] for state, factor in factors.items())
            for state, factor in factors.items():
                found[self.model.states.index(state)] += factor * loss * along
        return found

    @cached_property
    def sensor(self) -> list[Any]:
        """What each sensor adds to its state."""
        return [self.total("sensor", state) for state in self.model.states]

    @cached_property
    def force(self) -> list[Any]:
        """F; terms that name a slope in an input see that of the equation's others."""
        forces = []
        slope_names = self.model.variables.slopes
        names = set(slope_names)
        for equation in self.model.states:
            placed = self.model.placed_at("F", equation)
            on_slopes = [one for one in placed if names_of(one.term.body) & names]
            direct = [one for one in placed if one not in on_slopes]
            force = self._total(direct, self.known)
            if on_slopes:
                slopes = [self._slope(force, u) for u in self.u]
                named = dict(zip(slope_names, slopes, strict=True))
                force = force + self._total(on_slopes, {**self.known, **named})
            forces.append(force)
        for force, factors in self._along_directions("F"):
            for state, factor in factors.items():
                forces[self.model.states.index(state)] += factor * force
        return forces

    @cached_property
    def rates(self) -> list[Any]:
        """dx/dt = (S - R) grad H + F."""
        rows = []
        for i, couplings in enumerate(self.model.S):
            exchange = 0
            for coupling, effort in zip(couplings, self.efforts, strict=True):
                if coupling != 0.0:
                    exchange = exchange + self.backend.number(coupling) * effort
            rows.append(exchange - self.losses[i] + self.force[i])
        return rows

    def total(self, slot: str, equation: str) -> Any:
        """The sum of the terms at a place."""
        return self._total(self.model.placed_at(slot, equation), self.known)

    @property
    def shown(self) -> ca.SX:
        """What the sensors show of the states, as a column, (n_states, 1)."""
        x = ca.vertcat(*self.x)
        return x + ca.vertcat(*map(ca.SX, self.sensor)) if self.model.sensor else x

    @cached_property
    def _variables(self) -> dict[str, Any]:
        states = zip(self.model.states, self.x, strict=True)
        inputs = zip(self.model.inputs, self.u, strict=True)
        return {**dict(states), **dict(inputs), "t": self.t}

    @cached_property
    def known(self) -> dict[str, Any]:
        """States, inputs, the time and the efforts, by name."""
        efforts = zip(self.model.efforts, self.efforts, strict=True)
        return {**self._variables, **dict(efforts)}

    def _total(self, terms: Iterable[PlacedTerm], known: Mapping[str, Any]) -> Any:
        names = {**self.values, **known}
        return sum(placed.value(names, self.backend) for placed in terms)

    def _along_directions(self, slot: str) -> Iterator[tuple[Any, dict[str, Any]]]:
        """Value of each term along a direction of several states, and the factors."""
        names = {**self.values, **self.known}
        for equation in getattr(self.model, slot):
            for placed in self.model.placed_at(slot, equation):
                if equation not in self.model.states:
                    factors = placed.factors(self.model.states, names, self.backend)
                    yield placed.value(names, self.backend), factors

    def _slope(self, expression: Any, variable: Any) -> Any:
        if self.backend is CASADI:
            is_symbolic = isinstance(expression, ca.SX)
            return ca.jacobian(expression, variable) if is_symbolic else 0.0
        return expression.diff(variable) if hasattr(expression, "diff") else 0


# ---- CasADi functions ----------------------------------------------------------------


def function_of(
    model: BaseModel, name: str, value: Callable[[Expressions], ca.SX]
) -> ca.Function:
    """CasADi function (x, u, t, theta) -> a value made of the model's expressions.

    Free parameters become theta, the fixed ones stay numbers.
    """
    x = ca.SX.sym("x", model.n_states)
    u = ca.SX.sym("u", model.n_inputs)
    t = ca.SX.sym("t")
    theta = ca.SX.sym("theta", len(model.free))
    values: dict[str, Any] = dict(model.values)
    values |= zip(model.free, ca.vertsplit(theta), strict=True)
    n = len(model.inputs)
    slopes = u[n + len(model.delays) :]
    for k, (name, delay) in enumerate(model.delays):
        values[f"delayed({name}, {delay})"] = u[n + k] + values[delay] * slopes[k]
    parts = Expressions(model, ca.vertsplit(x), ca.vertsplit(u[:n]), t, values)
    result = ca.densify(value(parts))
    names = ["x", "u", "t", "theta"]
    return ca.Function(name, [x, u, t, theta], [result], names, ["value"])


def argument_symbols(function: ca.Function) -> list[ca.SX]:
    """A column of symbols for every argument of a function, named as there."""
    return [ca.SX.sym(name, function.size1_in(name)) for name in function.name_in()]


def with_slopes(function: ca.Function, *names: str) -> ca.Function:
    """The function, and its slopes in each argument named, row by row.

    That is (n_out * n_argument,) each.
    """
    arguments = argument_symbols(function)
    results = [function(*arguments)]
    for name in names:
        slopes = ca.jacobian(results[0], arguments[function.index_in(name)])
        results.append(ca.vec(ca.densify(slopes.T)))
    return ca.Function("slopes", arguments, results)


def terms_function(model: BaseModel) -> ca.Function:
    """CasADi function (x, u, t, theta) -> one number per term, as `placed` has them.

    The term's value, and in H those of its slopes in the states, added up: a number
    that is finite only where all of them are.
    """

    def values(parts: Expressions) -> ca.SX:
        names = {**parts.values, **parts.known}
        names |= dict.fromkeys(model.variables.slopes, ca.SX(0))
        found = [ca.SX(placed.value(names)) for placed in model.placed()]
        energies = ca.vertcat(*found[: len(model.H)])
        others = ca.vertcat(*found[len(model.H) :])
        slopes = ca.jacobian(energies, ca.vertcat(*parts.x))
        return ca.vertcat(energies + ca.sum2(slopes), others)

    return function_of(model, "terms", values)


# ---- what a model can do already -----------------------------------------------------


def is_redundant(model: BaseModel, effect: Effect) -> bool:
    """Whether the model can do already what the effect does."""
    return stands_in(model, effect) or is_spanned(model, effect)


def is_spanned(model: BaseModel, effect: Effect) -> bool:
    """Whether the model's free parameters can do what the effect does."""
    if not model.free or is_scanned(effect):
        return False
    # Whether its slopes are a sum of the slopes of the model's parameters.
    larger = model.add(effect)
    is_new = ~np.isin(larger.free, list(model.entries))
    slopes = _slopes_in_random_states(model, larger)
    own = slopes[:, ~is_new]
    added = slopes[:, is_new]
    weights = np.linalg.lstsq(own, added, rcond=None)[0]
    left = added - own @ weights
    # Above the rounding of the least squares, far below any effect of its own.
    return bool(np.linalg.norm(left) < 1e-8 * np.linalg.norm(added))


def stands_in(model: BaseModel, effect: Effect) -> bool:
    """Whether a term, a coefficient or a memory of the effect is in the model."""
    bodies = {term.body for term in model.terms_at(effect.slot, effect.equation)}
    for term in effect.term:
        if term.body in bodies or term.name in model.entries:
            return True
    return not set(effect.memory).isdisjoint((*model.states, *model.inputs))


def _slopes_in_random_states(model: BaseModel, larger: BaseModel) -> np.ndarray:
    """Slopes of dx/dt and of what is shown in theta, (n_values, n_free)."""
    random = np.random.default_rng(0)
    # The model's parameters must explain the effect at one point of theta. The effect's
    # coefficient is zero there, so that no parameter acts through it.
    known = model.values
    values = []
    for name in larger.free:
        value = known.get(name) or random.uniform(0.5, 1.5)  # away from zero
        is_added = name not in model.entries and larger.entries[name].prunable
        values.append(0.0 if is_added else value)
    theta = np.array(values)
    # With fewer rows than parameters anything would be explained.
    n = 4 * len(theta) + 20
    x = random.normal(size=(larger.n_states, n))
    u = random.normal(size=(larger.n_inputs, n))
    t = random.uniform(0, 3, (1, n))

    def values_of(parts: Expressions) -> ca.SX:
        return ca.vertcat(*map(ca.SX, parts.rates), parts.shown)

    function = with_slopes(function_of(larger, "values", values_of), "theta")
    slopes = function.map("slopes", "serial", n, [3], [])(x, u, t, theta)[1]
    return np.nan_to_num(np.array(slopes).T.reshape(-1, len(theta)))


# ---- how a model prints --------------------------------------------------------------


def model_summary(model: BaseModel) -> Summary:
    """What a model says of itself: its equations, and its parameters in a table."""
    title = f"{type(model).__name__}: states {', '.join(model.states)}"
    if model.inputs:
        title += f"; inputs {', '.join(model.inputs)}"
    rows = [*structure_rows(model), *dictionary_rows(model, _term)]
    rows += filter(None, [structure_words(model)])
    parts = [Part(code="\n".join(rows))]
    listed = []
    for name, entry in model.entries.items():
        parameter = entry.parameter
        known = "yes" if parameter.fixed else "no"
        bounds = (parameter.lower, parameter.upper)
        listed.append((name, parameter.start, known, *bounds, parameter.unit))
    if listed:
        columns = ["name", "value", "known", "lower", "upper", "unit"]
        table = printed_table(listed, columns=columns)
        parts.append(Part("parameters", table=table))
    return Summary(title, tuple(parts))


class Bell(NamedTuple):
    """What the name of a bell's coefficient says, such as r_q_on_p_bell_3."""

    kind: str  # "f", or "r" of a loss
    z: str  # what the function depends on
    x: str  # where it acts
    function: str  # its name without the number

    @classmethod
    def of(cls, name: str) -> "Bell | None":
        """Of a name; None: it is none (`model.functions`)."""
        function, is_bell, _ = name.partition("_bell_")
        kind, _, rest = function.partition("_")
        z, _, x = rest.partition("_on_")
        return (
            cls(kind, z, x, function) if is_bell and x and kind in ("f", "r") else None
        )


def dictionary_rows(
    model: BaseModel, written: Callable[[Term, str, int], str]
) -> list[str]:
    """Every dictionary of the model that has terms: F_p = c1*q + c2*q**3."""
    sums: dict[str, list[str]] = {}
    bells: dict[str, list[str]] = {}
    for placed in model.placed():
        terms = sums.setdefault(placed.place, [])
        bell = Bell.of(placed.term.name)
        if bell is None:
            terms.append(written(placed.term, placed.place, len(terms) + 1))
            continue
        function = f"{bell.kind}_{bell.x}({bell.z})"
        if function not in bells:
            effort = placed.term.body[1:].partition("*(")[0]
            terms.append(f"-{function}*{effort}" if bell.kind == "r" else function)
        bells.setdefault(function, []).append(placed.term.name)
    rows = []
    for place, terms in sums.items():
        rows.append(f"{place} = {' + '.join(terms).replace('+ -', '- ')}")
    for function, names in bells.items():
        told = f"a sum of bells, by the parameters {names[0]} to {names[-1]}"
        rows.append(f"{function} = {told}")
    return rows


def _term(term: Term, place: str, number: int) -> str:
    """A term; a coefficient without a name of its own has the term's number."""
    if term.is_formula:
        return term.body
    coefficient = term.name or f"c{number}"
    return term.product(coefficient, term.body)


def structure_rows(model: BaseModel) -> list[str]:
    """An equation per state in the names of the slots: dp/dt = - dH_dq - R_p*dH_dp."""
    names = model.efforts if model.H.terms else model.states
    efforts = dict(zip(model.states, names, strict=True))
    rows = []
    for i, state in enumerate(model.states):
        parts = []
        for entry, other in zip(model.S[i], model.states, strict=True):
            if entry:
                sign = "+" if entry > 0 else "-"
                factor = "" if abs(entry) == 1 else f"{abs(entry):g}*"
                parts.append(f"{sign} {factor}dH_d{other}")
        for slot, usual in (("R", -1), ("F", 1)):
            for equation in getattr(model, slot):
                directed = direction_parts(equation, tuple(model.states))
                for part in directed:
                    if part.state == state:
                        text = part.times(place_of(slot, equation))
                        if slot == "R":
                            text += f"*{summed(directed, efforts)}"
                        sign = "+" if part.sign == usual else "-"
                        parts.append(f"{sign} {text}")
        right_hand_side = " ".join(parts).removeprefix("+ ") or "0"
        rows.append(f"d{state}/dt = {right_hand_side}")
    return rows

"""A model as expressions and CasADi functions of its states, inputs, time and theta.

The sums of a model's slots are evaluated here, in CasADi for the solver and in SymPy
for printing; ``Model`` keeps the functions. This file knows nothing of data, losses or
solvers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from phsi_opt.model.backends import CASADI, Backend
from phsi_opt.model.base import BaseModel
from phsi_opt.model.expressions import evaluate, names_of
from phsi_opt.model.slots import place_of
from phsi_opt.model.terms import Dictionary, Term


@dataclass(frozen=True)
class Expressions:
    """The parts of a model as expressions, one per state but for the energy.

    R is diagonal, so ``loss`` holds its diagonal.
    """

    energy: Any
    efforts: list[Any]
    loss: list[Any]
    force: list[Any]
    sensor: list[Any]


@dataclass(frozen=True)
class Symbols:
    """What a model is evaluated in: symbols for all that its terms name.

    Args:
        x: the states.
        u: the inputs.
        t: the time.
        values: the parameters, by name.
        backend: the library whose symbols these are.
    """

    x: Sequence[Any]
    u: Sequence[Any]
    t: Any
    values: Mapping[str, Any]
    backend: Backend = CASADI


def expressions_at(model: BaseModel, symbols: Symbols) -> Expressions:
    """Energy, efforts, loss, force and sensor terms of the model in these symbols."""
    in_states = _Sums(symbols, _variables(model, symbols))
    energy = in_states.total(model.H, "H")
    efforts = _efforts(model, energy, symbols)
    by_name = dict(zip(model.efforts, efforts, strict=True))
    sums = in_states.knowing(by_name)
    return Expressions(
        energy=energy,
        efforts=efforts,
        loss=_by_state(model, "R", sums),
        sensor=_by_state(model, "sensor", sums),
        force=[_force(model, name, sums) for name in model.states],
    )


def _variables(model: BaseModel, symbols: Symbols) -> dict[str, Any]:
    states = dict(zip(model.states, symbols.x, strict=True))
    inputs = dict(zip(model.inputs, symbols.u, strict=True))
    return {**states, **inputs, "t": symbols.t}


@dataclass(frozen=True)
class _Sums:
    """Sums of terms in the variables that are known by name."""

    symbols: Symbols
    known: Mapping[str, Any]

    def knowing(self, more: Mapping[str, Any]) -> "_Sums":
        return _Sums(self.symbols, {**self.known, **more})

    def total(self, terms: Dictionary, place: str) -> Any:
        total = 0
        for term in terms:
            total = total + self.value(term, place)
        return total

    def value(self, term: Term, place: str) -> Any:
        values = self.symbols.values
        inner = {name: values[term.inner_name(name, place)] for name in term.inner}
        body = evaluate(term.body, {**self.known, **inner}, self.symbols.backend)
        if term.is_formula:
            return body
        return values[term.coefficient_name(place)] * body


def _by_state(model: BaseModel, slot: str, sums: _Sums) -> list[Any]:
    totals = []
    for name in model.states:
        totals.append(sums.total(model.terms_at(slot, name), place_of(slot, name)))
    return totals


def _force(model: BaseModel, equation: str, sums: _Sums) -> Any:
    """F of one equation; terms that name a slope in an input see that of the others."""
    place = place_of("F", equation)
    direct: list[Term] = []
    on_slopes: list[Term] = []
    for term in model.terms_at("F", equation):
        uses_slopes = names_of(term.body) & set(model.slopes)
        (on_slopes if uses_slopes else direct).append(term)
    force = sums.total(Dictionary(tuple(direct)), place)
    if not on_slopes:
        return force
    slopes = {}
    for name, u in zip(model.slopes, sums.symbols.u, strict=True):
        slopes[name] = _slope(force, u, sums.symbols.backend)
    return force + sums.knowing(slopes).total(Dictionary(tuple(on_slopes)), place)


def _slope(expression: Any, variable: Any, backend: Backend) -> Any:
    if backend is CASADI:
        is_symbolic = isinstance(expression, ca.SX)
        return ca.jacobian(expression, variable) if is_symbolic else 0.0
    return expression.diff(variable) if hasattr(expression, "diff") else 0


def _efforts(model: BaseModel, energy: Any, symbols: Symbols) -> list[Any]:
    """dH/dx; in a model without energy the states themselves."""
    x = symbols.x
    if not model.has_energy:
        return list(x)
    if symbols.backend is not CASADI:
        return [energy.diff(name) if energy != 0 else energy for name in x]
    if not isinstance(energy, ca.SX):  # a number: no terms, or none with a state
        return _rows(ca.SX.zeros(len(x)))
    return _rows(ca.gradient(energy, ca.vertcat(*x)))


def derivative(model: BaseModel, parts: Expressions) -> ca.SX:
    """dx/dt = (S - R) grad H + F as a column, (n_states, 1)."""
    rows = []
    for i, couplings in enumerate(model.S):
        exchange = 0
        for coupling, effort in zip(couplings, parts.efforts, strict=True):
            if coupling != 0.0:
                exchange = exchange + coupling * effort
        rows.append(exchange - parts.loss[i] * parts.efforts[i] + parts.force[i])
    return ca.vertcat(*map(ca.SX, rows))


# ---- CasADi functions ----------------------------------------------------------------


class Arguments:
    """Symbols for the arguments x, u, t and theta of a model's CasADi functions."""

    names = ("x", "u", "t", "theta")

    def __init__(self, model: BaseModel) -> None:
        """Free parameters become theta, the fixed ones stay numbers."""
        free = model.free
        self.x = ca.SX.sym("x", model.n_states)
        self.u = ca.SX.sym("u", model.n_inputs)
        self.t = ca.SX.sym("t")
        self.theta = ca.SX.sym("theta", len(free))
        values: dict[str, Any] = dict(model.values)
        for i, name in enumerate(free):
            values[name] = self.theta[i]
        self.symbols = Symbols(_rows(self.x), _rows(self.u), self.t, values)

    def function(self, name: str, value: ca.SX, value_name: str) -> ca.Function:
        """The CasADi function (x, u, t, theta) -> value."""
        return ca.Function(
            name,
            [self.x, self.u, self.t, self.theta],
            [ca.densify(value)],
            list(self.names),
            [value_name],
        )


def _rows(column: ca.SX) -> list[ca.SX]:
    return [column[i] for i in range(column.numel())]


def rhs_function(model: BaseModel) -> ca.Function:
    """CasADi function (x, u, t, theta) -> dx/dt."""
    arguments = Arguments(model)
    parts = expressions_at(model, arguments.symbols)
    return arguments.function("rhs", derivative(model, parts), "dx")


def energy_function(model: BaseModel) -> ca.Function:
    """CasADi function (x, u, t, theta) -> H; zero in a model without energy."""
    arguments = Arguments(model)
    parts = expressions_at(model, arguments.symbols)
    return arguments.function("energy", ca.SX(parts.energy), "H")


def output_function(model: BaseModel) -> ca.Function:
    """CasADi function (x, u, t, theta) -> what the sensors show of the states x."""
    arguments = Arguments(model)
    shown = arguments.x
    if model.sensor:
        parts = expressions_at(model, arguments.symbols)
        shown = shown + ca.vertcat(*map(ca.SX, parts.sensor))
    return arguments.function("output", shown, "y")


def terms_function(model: BaseModel) -> ca.Function:
    """CasADi function (x, u, t, theta) -> one number per term, as `placed` has them.

    The term's value, and in H those of its slopes in the states, added up: a number
    that is finite only where all of them are.
    """
    arguments = Arguments(model)
    symbols = arguments.symbols
    parts = expressions_at(model, symbols)
    known = dict(zip(model.efforts, parts.efforts, strict=True))
    known |= dict.fromkeys(model.slopes, ca.SX(0))
    sums = _Sums(symbols, _variables(model, symbols)).knowing(known)
    values = []
    for slot, equation, term in model.placed():
        value = ca.SX(sums.value(term, place_of(slot, equation)))
        if slot == "H":
            value = value + ca.sum1(ca.gradient(value, arguments.x))
        values.append(value)
    return arguments.function("terms", ca.vertcat(*values), "values")


def formulas_function(model: BaseModel, formulas: Sequence[str]) -> ca.Function:
    """CasADi function (x, u, t, theta) -> values of the formulas, as one column."""
    arguments = Arguments(model)
    symbols = arguments.symbols
    parts = expressions_at(model, symbols)
    efforts = dict(zip(model.efforts, parts.efforts, strict=True))
    known = {**_variables(model, symbols), **efforts, **symbols.values}
    values = [ca.SX(evaluate(text, known)) for text in formulas]
    return arguments.function("formulas", ca.vertcat(*values), "values")

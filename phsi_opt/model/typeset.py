"""The equations of a model as MathML, in the names of their states and parameters.

SymPy writes them. The velocity of a position q has a dot, and a delay is written as
u(t - 5.3 ms), that of a sensor too, which states approximate.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from html import escape
from typing import Any

from phsi_opt.model.base import BaseModel
from phsi_opt.model.laws import parameter_symbols
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.structure import position_of_momentum
from phsi_opt.model.symbolic import Bell, Expressions
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.presentation.numbers import decimal

RATE = "<mfrac><mrow><mi>d</mi>{}</mrow><mrow><mi>d</mi><mi>t</mi></mrow></mfrac>"
TIMES, THIN_SPACE = "<mo>&InvisibleTimes;</mo>", '<mspace width="0.17em"/>'
SEVERAL_WORDS = re.compile(r"<mi>([^<]+ [^<]+)</mi>")  # upright, as text is
BY_NUMBER = re.compile(r"<mi>N(\d+)N</mi>")  # of a name in what SymPy writes


class _WithVelocities(Expressions):
    """Efforts that are velocities of positions have these as names."""

    @cached_property
    def efforts(self) -> list[Any]:
        efforts = list(super().efforts)
        for momentum, position in position_of_momentum(self.model).items():
            if self.model.has_energy:
                row = self.model.states.index(momentum)
                efforts[row] = self.values[_dotted(position)]
        return efforts


def typeset_equations(
    model: BaseModel, values: Mapping[str, float], unit_of_time: str
) -> tuple[str, ...]:
    """Energy, rates and sensors as elements of MathML; none of a model that is large.

    Args:
        model: the model.
        values: its parameters; a coefficient that has no name of its own is written as
            a number.
        unit_of_time: of the measurements.
    """
    model, functions = _with_named_functions(model)
    if len(model.placed()) > 60:  # nobody reads so many terms
        return ()
    import sympy as sp

    from phsi_opt.model.sympy_backend import SYMPY, without_steps

    written: list[str] = []  # MathML of the names that SymPy knows by their numbers

    def named(text: str) -> Any:
        written.append(text)
        return sp.Symbol(f"N{len(written):04}N", real=True)  # factors are in this order

    known = {}
    symbol_of = parameter_symbols(model)
    for name, value in values.items():
        known[name] = sp.Float(f"{value:.3g}")
        if "[" not in name:
            known[name] = named(_name(symbol_of.get(name, name)))
    pairs = position_of_momentum(model)
    for name, bell in functions.items():
        letter = f"<msub><mi>{bell.kind}</mi>{_name(bell.x)}</msub>"
        momentum = bell.z.removeprefix("dH_d")
        variable = _name(bell.z)
        if momentum in pairs and bell.z not in model.states:
            variable = _velocity(pairs[momentum])
        at = f"<mo>(</mo>{variable}<mo>)</mo>"
        known[name] = named(f"<mrow>{letter}{at}</mrow>")
    for name in model.states:
        known[_dotted(name)] = named(_velocity(name))
    x = list(map(named, map(_name, model.states)))
    u = list(map(named, map(_name, model.inputs)))
    symbols = dict(zip((*model.states, *model.inputs), (*x, *u), strict=True))
    delayed = set()
    for name, delay in model.delays:
        late = named(_late(name, values[delay], unit_of_time))
        known[f"delayed({name}, {delay})"] = late
        delayed.add(late)
    instead: dict[Any, Any] = {}
    for state in model.memory:
        if f"{state}_bend" not in model.memory:
            continue  # it is no delay of a sensor
        signal = state.removesuffix("_delayed")
        late = named(_late(signal, values[f"sensor_delay_{signal}"], unit_of_time))
        delayed.add(late)
        now = symbols[signal]
        instead[symbols[state]] = (now + late) / 2
        for one in ("rate", "bend"):
            instead[symbols[f"{state}_{one}"]] = 0
    arguments = (model, x, u, sp.Symbol("t", real=True), known, SYMPY)
    plain, parts = Expressions(*arguments), _WithVelocities(*arguments)
    rows = {"<mi>H</mi>": plain.energy} if model.has_energy else {}
    for k, state in enumerate(model.states):
        if symbols[state] not in instead:
            rate = (plain if state in pairs.values() else parts).rates[k]
            rows[RATE.format(_name(state))] = rate
    for k, state in enumerate(model.states):
        if state in model.sensor:
            shown = f"<msub>{_name(state)}<mtext>measured</mtext></msub>"
            rows[shown] = x[k] + plain.sensor[k]
    lines = []
    for left, right in rows.items():
        found = without_steps(sp.sympify(right)).subs(instead)
        if found.free_symbols & delayed:
            found = sp.expand(found)
        found = found.replace(lambda one: one.is_Float, _exact)
        text = _mathml(found).replace(TIMES, THIN_SPACE)
        text = text.replace("<mo>-</mo>", "<mo>\N{MINUS SIGN}</mo>")
        text = BY_NUMBER.sub(lambda one: written[int(one[1]) - 1], text)
        lines.append(f'<math display="block">{left}<mo>=</mo>{text}</math>')
    return tuple(lines)


def _with_named_functions(
    model: BaseModel,
) -> tuple[BaseModel, dict[str, Bell]]:
    """With one name in place of the bells of each unknown function."""
    named: dict[str, Bell] = {}
    forces = {}
    for equation, dictionary in model.F.items():
        terms = {}  # a function once
        for term in dictionary:
            one = term
            if bell := Bell.of(term.name):
                name = f"{bell.function}_bells"  # a formula may have the plain one
                named[name] = bell
                body = name
                if bell.kind == "r":
                    body = f"-{term.body[1:].partition('*(')[0]}*{name}"
                one = Term(body, None, {name: Parameter(1.0)})
            terms[one.body] = one
        forces[equation] = Dictionary(tuple(terms.values()))
    return (replace(model, F=forces) if named else model), named


def _mathml(expression: Any) -> str:
    """With a - b in place of -b + a, and roots other than square ones as powers."""
    from sympy.printing.mathml import MathMLPresentationPrinter

    class AsPeopleWrite(MathMLPresentationPrinter):
        def _as_ordered_terms(self, expr: Any, order: Any = None) -> list[Any]:
            terms = list(super()._as_ordered_terms(expr, order))
            is_first = len(terms) == 2 and terms[0].could_extract_minus_sign()
            return terms[::-1] if is_first else terms

        def _print_Pow(self, expr: Any) -> Any:  # noqa: N802 (by its class)
            self._settings["root_notation"] = getattr(expr.exp, "q", 0) == 2
            return super()._print_Pow(expr)

    text: str = AsPeopleWrite({"fold_frac_powers": True}).doprint(expression)
    return text


def _exact(value: Any) -> Any:
    """A number of halves and quarters as such: 2 for 2.0, 1/4 for 0.25."""
    import sympy as sp

    quarters = 4 * float(value)
    return sp.Rational(int(quarters), 4) if quarters == int(quarters) else value


def _dotted(state: str) -> str:
    return f"d{state}/dt"


def _velocity(state: str) -> str:
    """With a dot above a letter; of a word as a rate."""
    written = _name(state)
    if len(state.partition("_")[0]) > 1:
        return f"<mrow><mo>(</mo>{RATE.format(written)}<mo>)</mo></mrow>"
    return f'<mover accent="true">{written}<mo>\N{DOT ABOVE}</mo></mover>'


def _late(signal: str, delay: float, unit: str) -> str:
    """Such as u(t - 5.3 ms)."""
    if unit == "s" and abs(delay) < 0.1:
        delay, unit = 1000 * delay, "ms"
    minus = f"<mi>t</mi><mo>\N{MINUS SIGN}</mo><mn>{decimal(delay, 3)}</mn>"
    told_unit = f"<mtext>\N{NO-BREAK SPACE}{escape(unit)}</mtext>"
    return f"<mrow>{_name(signal)}<mo>(</mo>{minus}{told_unit}<mo>)</mo></mrow>"


def _name(name: str) -> str:
    """A name with its further words as an index, and Greek letters: omega_t, v0."""
    import sympy as sp

    base, _, index = name.rpartition(".")[2].strip("_").partition("_")
    text = _mathml(sp.Symbol(f"{base}_{index.replace('_', ' ')}" if index else base))
    return SEVERAL_WORDS.sub(r"<mtext>\1</mtext>", text)

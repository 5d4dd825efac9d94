"""The equations of a model in SymPy, in names that C, MATLAB and Modelica allow.

Every effort dH/dx has a symbol, so that its expression is written once and the printed
equations show the structure (S - R) grad H + F.
"""

import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, replace

import sympy as sp

from phsi_opt.errors import ModelError
from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import Expressions
from phsi_opt.model.sympy_backend import SYMPY, formula_text, without_steps

# Words of the three languages, and names that the templates use. Those of functions of
# formulas, t and pi are no names in a model.
RESERVED = """
algorithm and annotation asm auto block bool boolean break case catch char class
classdef complex connect connector const constant constrainedby continue cosh default
delay der discrete do double each else elseif elsewhen encapsulated end enum enumeration
equation error expandable extends extern external fabs false final float flow fmax fmin
for function global goto if import impure in inf initial inline inner input int long
loop model nan not operator or otherwise outer output package par parameter parfor
partial persistent pow protected public pure rate record redeclare register replaceable
restrict return short shown signed sizeof slope static state step stream struct switch
then time true try type typedef union unsigned void volatile when while within
"""


def allowed_names(names: Iterable[str], reserved: Iterable[str] = ()) -> dict[str, str]:
    """An `allowed_name` for each of several names.

    A word of one of the languages, or a name that is taken, gets a number.
    """
    taken = {*RESERVED.split(), *reserved}
    found = {}
    for name in names:
        choice = plain = allowed_name(name)
        number = 2
        while choice in taken:
            choice = f"{plain}_{number}"
            number += 1
        taken.add(choice)
        found[name] = choice
    return found


def allowed_name(name: str) -> str:
    """A name of ASCII letters, digits and underscores; a Greek letter is spelt."""
    spelt = "".join(map(_spelt, unicodedata.normalize("NFKC", name)))
    # MATLAB cuts names at 63 characters, and none begins with an underscore.
    plain = re.sub(r"\W+", "_", spelt, flags=re.ASCII).strip("_")[:55]
    return plain if plain[:1].isalpha() else f"x{plain}"


def _spelt(letter: str) -> str:
    """A Greek letter as its name; every other one as it is."""
    words = unicodedata.name(letter, "").split()
    if words[:1] != ["GREEK"]:
        return letter
    return words[-1].capitalize() if "CAPITAL" in words else words[-1].lower()


@dataclass(frozen=True, eq=False)
class Equations:
    """A model's equations as assignments, one after the other.

    Attributes:
        states: allowed names by those in the model.
        inputs: the same, with those that are delayed behind the measured ones.
        parameters: the same, in the order of the model.
        efforts: the efforts dH/dx that need a name, with their expressions.
        rates: dx/dt, one per state.
        shown: what each sensor shows, by the state.
    """

    states: dict[str, str]
    inputs: dict[str, str]
    parameters: dict[str, str]
    efforts: dict[str, sp.Expr]
    rates: tuple[sp.Expr, ...]
    shown: dict[str, sp.Expr]

    @classmethod
    def of(cls, model: Model) -> "Equations":
        """Of a model, in allowed names.

        Raises:
            ModelError: a slope of its energy has no form in these languages.
        """
        late = {}
        for name, delay in model.delays:
            late[f"delayed({name}, {delay})"] = f"{name}(t - {delay})"
        inputs = (*model.inputs, *late.values())
        every = (*model.states, *inputs, *model.efforts, *model.entries)
        plain = allowed_names(every)
        symbols = {name: sp.Symbol(plain[name], real=True) for name in every}
        x = [symbols[name] for name in model.states]
        u = [symbols[name] for name in model.inputs]
        values = {name: symbols[name] for name in model.entries}
        values |= {written: symbols[name] for written, name in late.items()}
        t = sp.Symbol("t", real=True)
        parts = Expressions(model, x, u, t, values, SYMPY)
        slopes = [_plain(effort, "the energy") for effort in parts.efforts]
        efforts = {}
        named = list(slopes)
        for k, name in enumerate(model.efforts):
            if slopes[k].free_symbols and not slopes[k].is_Symbol:
                efforts[plain[name]] = slopes[k]
                named[k] = symbols[name]
        by_effort = replace(parts)
        vars(by_effort)["efforts"] = named
        rates = []
        for state, rate in zip(model.states, by_effort.rates, strict=True):
            rates.append(_plain(rate, f"d{state}/dt"))
        shown = {}
        for state in model.sensor:
            value = symbols[state] + by_effort.total("sensor", state)
            shown[state] = _plain(value, f"the sensor of {state}")
        return cls(
            states={name: plain[name] for name in model.states},
            inputs={name: plain[name] for name in inputs},
            parameters={name: plain[name] for name in model.entries},
            efforts=efforts,
            rates=tuple(rates),
            shown=shown,
        )

    def used(self, *results: sp.Expr) -> set[str]:
        """Names of all that results need, efforts and what these need among them."""
        names = {one.name for result in results for one in result.free_symbols}
        for name in names & self.efforts.keys():
            names |= self.used(self.efforts[name])
        return names

    def c_text(self, expression: sp.Expr) -> str:
        """An expression in C99; parameters are members of ``par``."""
        members = {}
        for name in self.parameters.values():
            members[sp.Symbol(name, real=True)] = sp.Symbol(f"par->{name}")
        inside = expression.xreplace(members)
        # C99 has no constants such as M_LN2.
        return str(sp.ccode(inside, standard="C99", math_macros={}))


def text_of(expression: sp.Expr) -> str:
    """An expression in MATLAB and Modelica, which write scalars alike."""
    return formula_text(expression).replace("**", "^")


def _by_base(product: sp.Mul) -> sp.Expr:
    """With one power of each base: |q|^n / |q| would be 0/0 at q = 0."""
    powers = product.as_powers_dict()
    if len(powers) == len(product.args):
        return product
    return sp.Mul(*(base**exponent for base, exponent in powers.items()))


def _plain(expression: sp.Expr, where: str) -> sp.Expr:
    """The expression by functions that all three languages have.

    Raises:
        ModelError: it has another one.
    """
    changed = without_steps(sp.sympify(expression))
    changed = changed.replace(sp.Heaviside, lambda x, *_: (1 + sp.sign(x)) / 2)
    changed = changed.replace(sp.DiracDelta, lambda *_: sp.Integer(0))
    changed = changed.replace(lambda part: part.is_Mul, _by_base)
    numbers = {}
    for one in changed.atoms(sp.NumberSymbol, sp.Float, sp.Integer):
        value = float(one)
        is_int = value.is_integer() and abs(value) < 2**31
        numbers[one] = sp.Integer(value) if is_int else sp.Float(value)
    changed = changed.xreplace(numbers)
    known = {sp.sin, sp.cos, sp.tan, sp.atan, sp.exp, sp.log, sp.sinh, sp.cosh, sp.tanh}
    known |= {sp.Abs, sp.sign, sp.Min, sp.Max}
    others = [one for one in changed.atoms(sp.Function) if one.func not in known]
    is_number = not changed.has(sp.I, sp.nan, sp.oo, sp.zoo, sp.Derivative, sp.Subs)
    if others or not is_number:
        found = others[0] if others else changed
        raise ModelError(
            f"{where} cannot be exported: {str(found)[:60]!r} has no form in C, "
            "MATLAB or Modelica. Write the term with another function."
        )
    return changed

"""Unknown functions of one quantity, as effects that a model can have.

What an equation lacks may be a function f of a position, a speed, a level or an input,
or a loss r times the effort, that no law of the catalogue describes::

    dx_i/dt = ... + f(z)        dx_i/dt = ... - r(z) dH/dx_i

A function is a sum of bells along a range of z, less the constant and the straight line
in z that the model has already: a term of a few numbers, which is fitted, kept in files
and judged by its evidence as any law is. Beside it stand short formulas with an inner
number. All are known by their names:

    unknown loss r(q) of 12 bells from -0.8 to 1.1
    unknown force f(q) like c*tanh(q/width)/tanh(1.1/width)
    unknown torque f(q) that repeats
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.model.base import BaseModel
from phsi_opt.model.directions import direction_parts, summed
from phsi_opt.model.effect import Effect
from phsi_opt.model.expressions import NUMPY, evaluate, names_of
from phsi_opt.model.parameters import Parameter, Scan, Share, Tried
from phsi_opt.model.redundancy import is_redundant
from phsi_opt.model.structure import (
    WORDS,
    effort_of,
    forced_rows,
    position_of_momentum,
    role_of,
)
from phsi_opt.model.terms import Dictionary, Term

N_BELLS = (6, 12)  # of a function that is wide, and of one with details
N_SAMPLES = 60  # along a function, where it is told
# Their coefficient is the value where they are largest, as far as the record goes.
SHAPES = (
    "sinh({z}/width)/sinh({top}/width)",
    "tanh({z}/width)/tanh({top}/width)",
    "exp(-({z}/width)**2)",
    "max({z} - limit, 0)",
    "max(limit - {z}, 0)",
    "abs({z})",
    "{z}",
    "{z}**5",
)
# Of the numbers inside of a formula: shares of the largest value to begin with.
INNER = {"width": (0.1, 0.2, 0.35, 0.6, 1.0), "limit": (-0.7, -0.4, 0.0, 0.4, 0.7, 0.9)}
NUMERAL = r"-?\d{1,20}(?:\.\d{1,20})?(?:e[-+]\d{1,2})?"
NAME = re.compile(
    r"unknown [a-z ]{1,40} (?P<kind>[fr])\((?P<z>\w+(?: - \w+)?)\) "
    r"(?:like c\*(?P<formula>.{1,500})|(?P<wave>that repeats)"
    rf"|of (?P<n>\d{{1,2}}) bells from (?P<low>{NUMERAL}) to (?P<high>{NUMERAL}))"
)
# Corners are rounded as that of dry friction is, within a width that a fit makes as
# small as the record asks for.
ROUNDED = {
    "max({z} - limit, 0)": "({z} - limit + sqrt(({z} - limit)**2 + corner**2))/2",
    "max(limit - {z}, 0)": "(limit - {z} + sqrt((limit - {z})**2 + corner**2))/2",
}
CORNER_SHARE = 0.05  # of the typical size of a quantity, within which it is rounded
Range = tuple[float, float]


def function_named(model: BaseModel, name: str, equation: str) -> Effect | None:
    """The unknown function of a name, such as a diagnosis tells; None: it is none.

    Raises:
        ModelError: its formula cannot be read, or it has no range.
    """
    found = NAME.fullmatch(name)
    if found is None:
        return None
    place = _Place(model, equation, found["z"], found["kind"])
    if found["formula"]:
        return place.formula(name, found["formula"])
    if found["wave"]:
        return place.wave(name)
    low, high = float(found["low"]), float(found["high"])
    if not low < high or int(found["n"]) < 4:
        raise ModelError(
            f"effect {name!r} has {found['n']} bells from {low:g} to {high:g}; "
            "expected four or more, along a range that increases."
        )
    return place.bells(name, int(found["n"]), (low, high))


def unknown_functions(
    model: BaseModel, range_of: Callable[[str], Range]
) -> Iterator[Effect]:
    """The functions that the equations of a model may lack, as bells.

    Args:
        model: the model.
        range_of: the least and the largest value of a quantity.
    """
    for place in _places(model):
        low, high = range_of(place.z)
        if not low < high:
            continue
        for n in N_BELLS:
            name = f"{place.called} of {n} bells from {low:.10g} to {high:.10g}"
            yield place.bells(name, n, (low, high))


def formulas_like(model: BaseModel, bells: Effect) -> Iterator[Effect]:
    """Short formulas that an unknown function may be."""
    found = NAME.fullmatch(bells.name)
    assert found is not None
    place = _Place(model, bells.equation, found["z"], found["kind"])
    if place.kind == "f" and place.z in model.states and place.z != place.equation:
        yield place.wave(f"{place.called} that repeats")
    known = model.variables.of_slot("F").union(model.names_in_formulas)
    if not known.isdisjoint((*INNER, "corner")):
        return  # the formulas need these names
    top = f"{max(abs(float(found['low'])), abs(float(found['high']))):g}"
    for shape in SHAPES:
        formula = shape.format(z=place.variable, top=top)
        effect = place.formula(f"{place.called} like c*{formula}", formula)
        if not is_redundant(model, effect):
            yield effect


def is_function(effect: Effect) -> bool:
    """Whether an effect is an unknown function, and no formula."""
    found = NAME.fullmatch(effect.name)
    return found is not None and found["n"] is not None


def along_function(effect: Effect) -> tuple[np.ndarray, np.ndarray]:
    """Values (n,) of what an unknown function depends on, and of its terms there.

    Returns:
        (n,), and (n, n_terms) with coefficients of one.
    """
    found = NAME.fullmatch(effect.name)
    assert found is not None
    z = np.linspace(float(found["low"]), float(found["high"]), N_SAMPLES)
    # The effort, by which a loss is multiplied, is minus one; of a difference the
    # second is zero.
    first, *second = found["z"].split(" - ")
    names = dict.fromkeys(effect.names, -1.0) | dict.fromkeys(second, 0.0) | {first: z}
    return z, np.stack([evaluate(one.body, names, NUMPY) for one in effect.term], 1)


@dataclass(frozen=True)
class _Place:
    """Where an unknown function may act, and of what."""

    model: BaseModel
    equation: str
    z: str  # what it depends on
    kind: str  # "f", or "r" of a loss

    @property
    def called(self) -> str:
        lacking = "loss"
        if self.kind == "f":
            (first, *_) = self.model.rows(self.equation)
            lacking = WORDS[role_of(self.model, self.model.states[first])][0]
        return f"unknown {lacking} {self.kind}({self.z})"

    @property
    def coefficient(self) -> str:
        words = f"{self.kind} {self.z} on {self.equation}"
        return words.replace(" - ", "_").replace(" ", "_")

    @property
    def variable(self) -> str:
        """What it depends on, as a factor in a formula."""
        return self.z if self.z.isidentifier() else f"({self.z})"

    def body(self, shape: str) -> str:
        if self.kind == "f":
            return shape
        parts = direction_parts(self.equation, tuple(self.model.states))
        efforts = {part.state: effort_of(self.model, part.state) for part in parts}
        return f"-({shape})*{summed(parts, efforts)}"

    def effect(self, name: str, *terms: Term) -> Effect:
        return Effect(name, "F", self.equation, Dictionary(terms), {}, self.called)

    def formula(self, name: str, formula: str) -> Effect:
        """A formula times a coefficient; its other names are parameters."""
        rounded = formula
        for told, body in ROUNDED.items():
            if formula == told.format(z=self.variable):
                rounded = body.format(z=self.variable)
        known = self.model.variables.of_slot("F").union(self.model.names_in_formulas)
        inner = {}
        for key in sorted(names_of(formula).difference(known - INNER.keys())):
            shares = INNER.get(key)
            inner[key] = Parameter(guess=Tried(self.z, shares) if shares else None)
        if rounded != formula:
            width = Share(self.z, CORNER_SHARE, (0.5,) * 6)
            inner["corner"] = Parameter(lower=0.0, fixed=True, guess=width)
        body = self.body(rounded)
        return self.effect(name, Term(body, Parameter(), inner, self.coefficient))

    def wave(self, name: str) -> Effect:
        """What repeats along a position, such as the cogging of a motor."""
        omega = f"omega_{self.z}"
        inner = {omega: Parameter(lower=0.0, guess=Scan(self.z))}
        shapes = (f"sin({omega}*{self.z})", f"cos({omega}*{self.z})")
        return self.effect(name, *(Term(one, Parameter(), inner) for one in shapes))

    def bells(self, name: str, n: int, along: Range) -> Effect:
        """A sum of n bells, each less the line that the model has."""
        from scipy.linalg import qr  # what listing effects does not need

        centres = np.linspace(*along, n)
        step = float(centres[1] - centres[0])
        z = np.linspace(*along, N_SAMPLES)
        values = np.exp(-(((z[:, None] - centres) / step) ** 2))
        has_line = []
        for shape in ("1", self.z):
            term = Term(self.body(shape), Parameter(), name="shape_in_question")
            has_line.append(is_redundant(self.model, self.effect("in question", term)))
        line = np.stack([np.ones(N_SAMPLES), z], axis=1)[:, has_line]
        straight = np.zeros((n, 2))
        straight[:, has_line] = np.linalg.lstsq(line, values, rcond=None)[0].T
        # Each line that is taken away leaves one bell less that is independent.
        left = values - line @ straight[:, has_line].T
        _, order = qr(left, mode="r", pivoting=True)
        kept = np.sort(order[: n - sum(has_line)])
        terms = []
        for number, k in enumerate(kept.tolist()):
            shape = f"exp(-(({self.z}{_less(centres[k])})/{step:.10g})**2)"
            constant, slope = straight[k].tolist()
            shape += _less(constant) + (
                f"{_less(slope)}*{self.variable}" if slope else ""
            )
            body = self.body(shape)
            terms.append(Term(body, Parameter(), name=f"{self.coefficient}_{number}"))
        return self.effect(name, *terms)


def _less(number: float) -> str:
    """As text of a difference: " - 0.3", or " + 0.3"; "" of zero."""
    if not number:
        return ""
    return f" {'-' if number > 0 else '+'} {abs(number):.10g}"


def _places(model: BaseModel) -> Iterator[_Place]:
    known = [one for one in model.states if one not in model.memory]
    for row in forced_rows(model):
        x = model.states[row]
        for z in (*known, *model.inputs):
            # Of its own state a function is one of its effort.
            yield _Place(model, x, effort_of(model, x) if z == x else z, "f")
            if z != x:
                yield _Place(model, x, z, "r")
    pairs = position_of_momentum(model)
    for p1, p2 in combinations(pairs, 2) if model.has_energy else ():
        yield _Place(model, f"{p1} - {p2}", f"{pairs[p1]} - {pairs[p2]}", "f")

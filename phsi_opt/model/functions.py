"""Unknown functions of one quantity, as effects that a model can have.

What an equation lacks may be a function f of a position, a speed, a level or an input,
or a loss r times the effort, that no law of the catalogue describes::

    dx_i/dt = ... + f(z)        dx_i/dt = ... - r(z) dH/dx_i

A function is a sum of bells along a range of z, less the constant and the straight line
in z that the model has already: a term of a few numbers, which is fitted, kept in files
and judged by its evidence as any law is. Beside it stand short formulas with an inner
number. All are known by their names:

    unknown loss r(q) of 12 bells from -0.8 to 1.1, less a constant
    unknown force f(q) like c*tanh(q/width)/tanh(1.1/width)
    unknown force f(q) that repeats
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from phsi_opt.arguments import require_known
from phsi_opt.errors import ModelError
from phsi_opt.model.base import BaseModel
from phsi_opt.model.directions import direction_parts, normal_direction, summed
from phsi_opt.model.effect import Effect
from phsi_opt.model.expressions import names_of
from phsi_opt.model.parameters import Parameter, Scan, Share, Tried
from phsi_opt.model.slots import place_of
from phsi_opt.model.structure import (
    effort_of,
    forced_rows,
    kind_of,
    position_of_momentum,
    role_of,
)
from phsi_opt.model.symbolic import is_spanned, stands_in
from phsi_opt.model.terms import Dictionary, Term

# Of sinh and tanh the coefficient is the value at the largest that the record has.
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
# What bells leave out: 1 for a constant that the model has, 2 for a line through zero.
LESS = ("", ", less a constant", ", less a slope", ", less a line")
NUMERAL = r"-?\d{1,20}(?:\.\d{1,20})?(?:e[-+]\d{1,3})?"
NAME = re.compile(
    r"unknown [a-z ]{1,40} (?P<kind>[fr])\((?P<z>\w+(?: - \w+)?)\) "
    r"(?:like c\*(?P<formula>.{1,500})|(?P<wave>that repeats)"
    rf"|of (?P<n>\d{{1,2}}) bells from (?P<low>{NUMERAL}) to (?P<high>{NUMERAL})"
    r"(?P<less>(?:, less a (?:constant|slope|line))?))"
)
# Corners are rounded as that of dry friction is, within a width that a fit makes as
# small as the record asks for.
ROUNDED = {
    "max({z} - limit, 0)": "({z} - limit + sqrt(({z} - limit)**2 + corner**2))/2",
    "max(limit - {z}, 0)": "(limit - {z} + sqrt((limit - {z})**2 + corner**2))/2",
}


def function_named(model: BaseModel, name: str, equation: str) -> Effect | None:
    """The unknown function of a name, such as a diagnosis tells; None: it is none.

    Raises:
        ModelError: its formula cannot be read, it is a function of nothing that the
            model has, or has no range.
    """
    found = NAME.fullmatch(name)
    if found is None:
        return None
    known = (*model.states, *model.inputs, *model.variables.efforts)
    for one in found["z"].split(" - "):
        require_known(one, known, f"effect {name!r}: {one!r} is unknown")
    equation = normal_direction(equation, model.states)
    place = _Place(model, equation, found["kind"], found["z"])
    if not name.startswith(f"{place.called} "):
        raise ModelError(f"effect {name!r} is called {place.called!r} in this model.")
    if found["formula"]:
        return place.formula(name, found["formula"])
    return place.wave(name) if found["wave"] else place.bells(name, _Bells.of(found))


def unknown_functions(
    model: BaseModel, range_of: Callable[[str], tuple[float, float]]
) -> Iterator[Effect]:
    """The functions that the equations of a model may lack, as bells.

    Args:
        model: the model.
        range_of: the least and the largest value of a quantity.
    """
    for place in _places(model):
        known = (place.coefficient, f"{place.coefficient}_bell_0")
        if not model.entries.keys().isdisjoint(known):
            continue  # the model has that function, in one way or the other
        low, high = range_of(place.z)
        if _is_range(low, high):
            less = LESS[place.is_known("1") + 2 * place.is_known(place.z)]
            for n in (6, 12):  # for a function that is wide, and for one with details
                of = f"of {n} bells from {low:.10g} to {high:.10g}{less}"
                yield place.named(f"{place.called} {of}")


def formulas_like(model: BaseModel, bells: Effect) -> Iterator[Effect]:
    """Short formulas that an unknown function may be."""
    found = NAME.fullmatch(bells.name)
    assert found is not None
    place = _Place(model, bells.equation, found["kind"], found["z"])
    if place.kind == "f" and place.z in model.states and place.z != place.equation:
        wave = place.named(f"{place.called} that repeats")
        if not stands_in(model, wave):
            yield wave
    low, high = float(found["low"]), float(found["high"])
    names = model.variables.of_slot("F").union(model.names_in_formulas)
    is_far = low > high - low or high < low - high  # from zero
    if is_far or not names.isdisjoint((*INNER, "corner")):
        return
    top = f"{max(abs(low), abs(high)):g}"
    # Of laws of the catalogue: a line of its own effort, or of a position, and dry
    # friction.
    laws = []
    if place.kind == "f" and place.z not in model.inputs:
        laws.append("{z}")
    if place.kind == "f" and place.variable == effort_of(model, place.equation):
        laws += [shape for shape in SHAPES if shape.startswith("tanh")]
    for shape in SHAPES:
        if shape in laws:
            continue
        formula = shape.format(z=place.variable, top=top)
        effect = place.named(f"{place.called} like c*{formula}")
        if not is_spanned(model, effect):
            yield effect


def is_unknown(effect: Effect) -> bool:
    """Whether an effect is an unknown function, or a formula that it may be."""
    return NAME.fullmatch(effect.name) is not None


def is_function(effect: Effect) -> bool:
    """Whether an effect is an unknown function, and no formula."""
    found = NAME.fullmatch(effect.name)
    return found is not None and found["n"] is not None


def along_function(effect: Effect) -> tuple[np.ndarray, np.ndarray]:
    """Values (n,) of what an unknown function depends on, and of its bells there.

    Returns:
        (n,), and (n, n_terms) with coefficients of one.
    """
    found = NAME.fullmatch(effect.name)
    assert found is not None
    bells = _Bells.of(found)
    return bells.z, bells.left[:, bells.kept]


class _Bells(NamedTuple):
    """Bells along a range, each less the line that the model has."""

    step: float  # from one centre to the next
    centres: np.ndarray  # (n,)
    straight: np.ndarray  # (n, 2) constant and slope of each line
    z: np.ndarray  # (n_samples,) along the range
    left: np.ndarray  # (n_samples, n) the bells less their lines
    kept: list[int]  # places of those that are independent

    @classmethod
    def of(cls, found: re.Match[str]) -> "_Bells":
        """Of a name.

        Raises:
            ModelError: too few or too many, or no range.
        """
        from scipy.linalg import qr  # what listing effects does not need

        n, low, high = int(found["n"]), float(found["low"]), float(found["high"])
        if not (4 <= n <= 30 and _is_range(low, high) and np.isfinite(high - low)):
            raise ModelError(
                f"effect {found[0]!r} has {n} bells from {low:g} to {high:g}; expected "
                "4 to 30, along a range that increases."
            )
        less = LESS.index(found["less"])
        own = np.flatnonzero([less % 2, less // 2])  # a constant, and a slope
        step = (high - low) / (n - 1)
        z = np.linspace(low, high, 60)
        centres = np.linspace(low, high, n)
        values = np.exp(-(((z[:, None] - centres) / step) ** 2))
        line = np.stack([np.ones(len(z)), z], axis=1)[:, own]
        straight = np.zeros((n, 2))
        straight[:, own] = np.linalg.lstsq(line, values, rcond=None)[0].T
        left = values - line @ straight[:, own].T
        # Each line that is taken away leaves one bell less that is independent.
        _, order = qr(left, mode="r", pivoting=True)
        kept = sorted(order[: n - len(own)].tolist())
        return cls(step, centres, straight, z, left, kept)

    def shape(self, k: int, z: str, variable: str) -> str:
        """A bell of a quantity, less its line, as a formula."""
        constant, slope = self.straight[k].tolist()
        bell = f"exp(-(({z}{_less(self.centres[k])})/{self.step:.10g})**2)"
        line = f"{_less(slope)}*{variable}" if slope else ""
        return f"{bell}{_less(constant)}{line}"


def _is_range(low: float, high: float) -> bool:
    """Whether a quantity changes by more than a millionth of its size."""
    return high - low > 1e-6 * max(abs(low), abs(high))


@dataclass(frozen=True)
class _Place:
    """Where an unknown function may act, and of what."""

    model: BaseModel
    equation: str
    kind: str  # "f", or "r" of a loss
    z: str  # what it depends on

    @property
    def called(self) -> str:
        lacking = "loss"
        if self.kind == "f":
            (first, *_) = self.model.rows(self.equation)
            lacking = role_of(self.model, self.model.states[first]).value[0]
        return f"unknown {lacking} {self.kind}({self.z})"

    @property
    def words(self) -> str:
        """What it depends on, as a part of a name."""
        return self.z.replace(" - ", "_")

    @property
    def coefficient(self) -> str:
        at = place_of("F", self.equation).removeprefix("F_")
        return f"{self.kind}_{self.words}_on_{at}"

    @property
    def variable(self) -> str:
        """What it depends on, as a factor in a formula."""
        return self.z if self.z.isidentifier() else f"({self.z})"

    def body(self, shape: str) -> str:
        if self.kind == "f":
            return shape
        parts = direction_parts(self.equation, tuple(self.model.states))
        efforts = {part.state: effort_of(self.model, part.state) for part in parts}
        return f"-{summed(parts, efforts)}*({shape})"

    def is_known(self, shape: str) -> bool:
        """Whether the model's parameters can do that already."""
        term = Term(self.body(shape), Parameter(), name="shape_in_question")
        return is_spanned(self.model, self.effect("in question", term))

    def effect(self, name: str, *terms: Term) -> Effect:
        return Effect(name, "F", self.equation, Dictionary(terms), {}, self.called)

    def named(self, name: str) -> Effect:
        effect = function_named(self.model, name, self.equation)
        assert effect is not None
        return effect

    def formula(self, name: str, formula: str) -> Effect:
        """A formula times a coefficient; its other names are parameters."""
        rounded = formula
        for told, body in ROUNDED.items():
            if formula == told.format(z=self.variable):
                rounded = body.format(z=self.variable)
        known = self.model.variables.of_slot("F").union(self.model.names_in_formulas)
        inner = {}
        for key in sorted(names_of(formula).difference(known)):
            if key in INNER:
                least = 0.0 if key == "width" else -np.inf
                tried = Tried(self.z, INNER[key])
                inner[key] = Parameter(lower=least, guess=tried)
            elif not key.startswith(("dH_d", "dF_d")):
                inner[key] = Parameter(1.0)
        if rounded != formula:
            width = Share(self.z, 0.05, (0.5,) * 6)
            inner["corner"] = Parameter(lower=0.0, fixed=True, guess=width)
        body = self.body(rounded)
        return self.effect(name, Term(body, Parameter(), inner, self.coefficient))

    def wave(self, name: str) -> Effect:
        """What repeats along a position, such as the cogging of a motor."""
        omega = f"omega_{self.words}"
        inner = {omega: Parameter(lower=0.0, guess=Scan(self.z))}
        terms = []
        for part in ("sin", "cos"):
            body = self.body(f"{part}({omega}*{self.variable})")
            terms.append(Term(body, Parameter(), inner))
        return self.effect(name, *terms)

    def bells(self, name: str, bells: _Bells) -> Effect:
        """The sum of some bells."""
        terms = []
        for number, k in enumerate(bells.kept):
            body = self.body(bells.shape(k, self.z, self.variable))
            called = f"{self.coefficient}_bell_{number}"
            terms.append(Term(body, Parameter(), name=called))
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
            of = effort_of(model, x) if z == x else z
            yield _Place(model, x, "f", of)
            if z != x:
                yield _Place(model, x, "r", z)
    pairs = position_of_momentum(model)
    for p1, p2 in combinations(pairs, 2) if model.has_energy else ():
        if kind_of(model, p1) == kind_of(model, p2):
            yield _Place(model, f"{p1} - {p2}", "f", f"{pairs[p1]} - {pairs[p2]}")

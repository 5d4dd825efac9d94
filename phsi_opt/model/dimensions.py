"""What formulas say about units, and the units that follow: sums are of like things.

A unit is a product of powers, so that its logarithm is linear: each part of a formula
has a *form*, the sum of its names' dimensions with their powers. Terms of a sum have
like forms, and what stands in an exponential has none. `Likenesses` collects this while
formulas are evaluated in `Quantity`, as they are in CasADi's symbols; the powers of
each unit then solve linear equations.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from phsi_opt.model.backends import CONSTANTS, FUNCTIONS, Backend
from phsi_opt.model.expressions import evaluate
from phsi_opt.presentation.units import RADIAN, Powers, product

# Power of each quantity in a dimension, by the quantity's name.
Form = Mapping[str, float]

# A number beyond this one, or one that is no multiple of a quarter, may be a constant
# of physics with a unit of its own, such as 9.81.
LARGEST_PURE_NUMBER = 8
# Rounding errors of powers, which are halves and quarters of whole numbers.
POWER_ROUNDING = 1e-8


@dataclass(frozen=True)
class Likeness:
    """A form that has no dimension.

    Args:
        form: the powers of the quantities in it.
        is_angle: whether it may have the dimension of the radian.
        is_number: whether a number stands beside it in a sum, as in 1 - q; the number
            may then have a unit of its own.
    """

    form: Form
    is_angle: bool = False
    is_number: bool = False


@dataclass
class Likenesses:
    """All that formulas say; `said` grows with each formula that is evaluated."""

    said: list[Likeness] = field(default_factory=list)
    n_numbers: int = 0

    def alike(self, first: Form, second: Form) -> None:
        """Says that two forms have one dimension."""
        self.said.append(Likeness(product(first, second, -1.0)))

    def form_of(self, text: str, names: Mapping[str, Form]) -> Form:
        """The dimension of a formula.

        Args:
            text: the formula.
            names: the forms of the names in it.
        """
        quantities = {name: Quantity(self, form) for name, form in names.items()}
        functions = {name: self._function(name) for name in FUNCTIONS}
        constants = dict.fromkeys(CONSTANTS, Quantity(self, {}))
        backend = Backend(functions, self._number, constants)
        value: Quantity = evaluate(text, quantities, backend)
        return value.form

    def unknown(self) -> Form:
        """A dimension of which nothing is known."""
        self.n_numbers += 1
        return {f"number {self.n_numbers}": 1.0}

    def _number(self, number: float) -> "Quantity":
        is_simple = float(4 * number).is_integer() and 0 < number <= LARGEST_PURE_NUMBER
        return Quantity(self, {} if is_simple else self.unknown(), number)

    def _function(self, name: str) -> Callable[..., "Quantity"]:
        def called(first: "Quantity", *others: "Quantity") -> "Quantity":
            if name in ("abs", "min", "max"):
                for other in others:
                    self.alike(first.form, other.form)
                return replace(first, value=None)
            if name == "sqrt":
                return Quantity(self, product({}, first.form, 0.5))
            if name != "sign":
                is_angle = name in ("sin", "cos", "tan")
                self.said.append(Likeness(first.form, is_angle))
            return Quantity(self, {})

        return called


@dataclass(frozen=True)
class Quantity:
    """A part of a formula by its dimension; what is added to it must be alike.

    ``value`` is that of a number, also of a quotient of two, such as -1/4.
    """

    said: Likenesses
    form: Form
    value: float | None = None

    def __add__(self, other: "Quantity") -> "Quantity":
        is_number = self.value is not None or other.value is not None
        difference = product(self.form, other.form, -1.0)
        self.said.said.append(Likeness(difference, is_number=is_number))
        return replace(self if self.value is None else other, value=None)

    __sub__ = __add__

    def __neg__(self) -> "Quantity":
        return replace(self, value=None if self.value is None else -self.value)

    def __mul__(self, other: "Quantity") -> "Quantity":
        return Quantity(self.said, product(self.form, other.form))

    def __truediv__(self, other: "Quantity") -> "Quantity":
        value = None
        if self.value is not None and other.value:
            value = self.value / other.value
        return Quantity(self.said, product(self.form, other.form, -1.0), value)

    def __pow__(self, other: "Quantity") -> "Quantity":
        if other.value is not None:
            return Quantity(self.said, product({}, self.form, other.value))
        self.said.alike(other.form, {})
        return Quantity(self.said, self.said.unknown() if self.form else {})


def solved_dimensions(
    said: Sequence[Likeness], known: Mapping[str, Powers]
) -> dict[str, Powers] | None:
    """The powers of the units in each quantity that the likenesses determine.

    Radians come and go in physics (a torque is N m, an arc is a length): where they
    contradict each other or are left open, there are none.

    Args:
        said: what is known of the quantities' forms.
        known: the powers of the units in some of them, by name.

    Returns:
        The powers by name; None where the likenesses contradict each other.
    """
    names = dict.fromkeys(name for likeness in said for name in likeness.form)
    unknown = [name for name in names if name not in known]
    rows = _rows(said, unknown)
    known_rows = _rows(said, list(known))
    without_angles = np.array([not likeness.is_angle for likeness in said], dtype=bool)
    _, determined = _least_squares(rows, np.zeros(len(said)))
    found: dict[str, Any] = {
        name: {}
        for name, is_determined in zip(unknown, determined, strict=True)
        if is_determined
    }
    for unit in sorted({unit for powers in known.values() for unit in powers}):
        kept = without_angles if unit == RADIAN else np.full(len(said), fill_value=True)
        given = np.array([powers.get(unit, 0.0) for powers in known.values()])
        right = -(known_rows @ given)[kept]
        powers, determined = _least_squares(rows[kept], right)
        if np.any(np.abs(rows[kept] @ powers - right) > POWER_ROUNDING):
            if unit == RADIAN:
                continue
            return None
        for name, power, is_told in zip(unknown, powers, determined, strict=True):
            power = round(float(power), 6)
            if name in found and is_told and power:
                found[name][unit] = power
    return found


def _rows(said: Sequence[Likeness], names: Sequence[str]) -> np.ndarray:
    """The power of each name in each likeness, (n_likenesses, n_names)."""
    rows = np.zeros((len(said), len(names)))
    for row, likeness in zip(rows, said, strict=True):
        row[:] = [likeness.form.get(name, 0.0) for name in names]
    return rows


def _least_squares(
    rows: np.ndarray, right: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The least squares solution, and whether the rows determine each unknown."""
    inverse = np.linalg.pinv(rows, rcond=POWER_ROUNDING)
    resolution = np.diag(inverse @ rows)
    return inverse @ right, np.abs(resolution - 1.0) < POWER_ROUNDING

"""Dimensions from likenesses: a linear system for the powers of each unit."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from phsi_opt.model.formula_dimensions import Likeness
from phsi_opt.presentation.units import RADIAN, Powers

# Rounding errors of powers, which are halves and quarters of whole numbers.
POWER_ROUNDING = 1e-8


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
    system = _System.of(said, known)
    determined = system.determined(system.rows)
    powers: dict[str, dict[str, float]] = {}
    for name, is_determined in zip(system.unknown, determined, strict=True):
        if is_determined:
            powers[name] = {}
    units = {unit for one in known.values() for unit in one}
    for unit in sorted(units):
        solution = system.powers_of(unit)
        if solution is None and unit != RADIAN:
            return None
        for name in powers:
            power = (solution or {}).get(name, 0.0)
            if power:
                powers[name][unit] = power
    return dict(powers)


@dataclass(frozen=True)
class _System:
    """The likenesses as rows of numbers, known quantities apart."""

    said: Sequence[Likeness]
    known: Mapping[str, Powers]
    unknown: tuple[str, ...]
    rows: np.ndarray  # (n_likenesses, n_unknown)

    @classmethod
    def of(cls, said: Sequence[Likeness], known: Mapping[str, Powers]) -> "_System":
        names = dict.fromkeys(name for likeness in said for name in likeness.form)
        unknown = tuple(name for name in names if name not in known)
        rows = np.zeros((len(said), len(unknown)))
        for number, likeness in enumerate(said):
            for column, name in enumerate(unknown):
                rows[number, column] = likeness.form.get(name, 0.0)
        return cls(said, known, unknown, rows)

    def determined(self, rows: np.ndarray) -> np.ndarray:
        """Whether the rows determine each unknown, (n_unknown,)."""
        resolution = np.linalg.pinv(rows, rcond=POWER_ROUNDING) @ rows
        return np.abs(np.diag(resolution) - 1.0) < POWER_ROUNDING

    def powers_of(self, unit: str) -> dict[str, float] | None:
        """Power of the unit in each quantity it is told of; None: contradiction."""
        kept = np.ones(len(self.said), dtype=bool)
        if unit == RADIAN:
            kept = np.array([not likeness.is_angle for likeness in self.said])
        rows = self.rows[kept]
        right = self._right(unit)[kept]
        powers = np.linalg.pinv(rows, rcond=POWER_ROUNDING) @ right
        if np.any(np.abs(rows @ powers - right) > POWER_ROUNDING):
            return None
        found = {}
        determined = self.determined(rows)
        for column, name in enumerate(self.unknown):
            power = round(float(powers[column]), 6)
            if determined[column] and power:
                found[name] = power
        return found

    def _right(self, unit: str) -> np.ndarray:
        right = np.zeros(len(self.said))
        for number, likeness in enumerate(self.said):
            for name, exponent in likeness.form.items():
                right[number] -= exponent * self.known.get(name, {}).get(unit, 0.0)
        return right

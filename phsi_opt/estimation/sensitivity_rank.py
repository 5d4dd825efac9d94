"""Which parameters a motion tells: the rank of its sensitivities at random points.

What sensors show is y(t; x0, theta). A parameter is locally identifiable where no
direction of (x0, theta) along which y does not change contains it (Sedoglavic, Journal
of Symbolic Computation 33, 2002; Stigter and Molenaar, Automatica 58, 2015). The
coefficients of the Taylor series of dy/d(x0, theta) are eliminated row by row, until
the columns are independent or two orders in a row add nothing: then no further one
does. Parameters, states and inputs are random numbers, so the answer holds but for
special values. A model with corners is looked at from several points, since each tells
of one branch; all have the same parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal, DecimalException

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Parameter
from phsi_opt.simulation.taylor_series import NO_CHANGE, Motion


class ImpreciseError(ArithmeticError):
    """A number is too small to be told from rounding, and too large to be none."""


def _largest(row: np.ndarray) -> Decimal:
    return max(map(abs, row.tolist()), default=NO_CHANGE)


class Echelon:
    """Independent rows, each without the columns that lead those before.

    Attributes:
        rows: with the column that leads each, where it has a one.
    """

    def __init__(self, digits: int) -> None:
        self.rows: list[tuple[int, np.ndarray]] = []
        self._zero = Decimal(10) ** (-digits * 7 // 10)
        self._told = Decimal(10) ** (-digits * 4 // 10)

    def add(self, row: np.ndarray) -> bool:
        """Whether a row of decimals (n,) is independent of those before and kept.

        Raises:
            ImpreciseError: the digits do not suffice to decide it.
        """
        size = _largest(row)
        for lead, known in self.rows:
            row = row - row[lead] * known if row[lead] else row
        left = _largest(row)
        if left <= size * self._zero:
            return False
        if left < size * self._told:
            raise ImpreciseError
        lead = int(np.argmax(np.abs(row)))
        self.rows.append((lead, row / row[lead]))
        return True

    def widen(self, n_columns: int) -> None:
        """Further columns, in which the rows are zero."""
        gap = np.full(n_columns, NO_CHANGE)
        for number, (lead, row) in enumerate(self.rows):
            self.rows[number] = (lead, np.append(row, gap))

    def null_space(self, width: int) -> list[np.ndarray]:
        """Directions (width,) on which all rows vanish, one per column without lead."""
        free = np.ones(width, dtype=bool)
        free[[lead for lead, _ in self.rows]] = False
        found = []
        for column in np.flatnonzero(free):
            direction = np.full(width, NO_CHANGE)
            direction[column] = Decimal(1)
            for lead, row in reversed(self.rows):
                direction[lead] = -(row @ direction)
            size = np.abs(direction)
            direction[size <= self._told * max(size)] = NO_CHANGE  # it is rounding
            found.append(direction)
        return found


@dataclass(frozen=True, eq=False)
class Silent:
    """Directions along which nothing that is measured changes."""

    # (n_directions, n_free) relative changes of the parameters; each direction has one
    # of them to itself.
    parameters: np.ndarray
    states: tuple[int, ...]  # places of the states whose start is in any direction


@dataclass(frozen=True, eq=False)
class RandomPoints:
    """Motions of a model from random starts, all with the same random parameters.

    Raises:
        ModelError: there is no point at which the model has a value.
    """

    model: Model
    n_runs: int = 1  # records, each with a start of its own
    digits: int = 100  # of the numbers
    _motions: list[Motion] = field(default_factory=list)
    _random: np.random.Generator = field(
        default_factory=lambda: np.random.default_rng(0)
    )
    _theta: list[Decimal] = field(default_factory=list)

    @property
    def theta(self) -> np.ndarray:
        """The parameters, (n_free,)."""
        return np.array(self._theta, dtype=float)

    @property
    def most_points(self) -> int:
        """Points that are looked at where fewer leave something open."""
        return max(self.n_runs, 8 if self._motion(0).has_corners else 1)

    def _motion(self, number: int) -> Motion:
        while len(self._motions) <= number:
            self._motions.append(self._drawn())
        return self._motions[number]

    def _drawn(self) -> Motion:
        """From a point at which the model has a value."""
        parameters = [self.model.entries[name].parameter for name in self.model.free]
        for trial in range(40):
            if not self._motions:
                drawn = [self._value(one) for one in parameters]
                self._theta[:] = map(Decimal, drawn)
            x = self._random.uniform(0.3, 3, self.model.n_states)
            x *= self._random.choice(self._sizes, self.model.n_states)
            if trial < 20:  # roots and logarithms need those that are positive
                x *= self._random.choice([1.0, -1.0], self.model.n_states)
            start = list(map(Decimal, x.tolist()))
            motion = Motion(self.model, start, self._theta, self._number)
            try:
                motion.order(2)
            except DecimalException:
                continue
            return motion
        raise ModelError(
            "the model has no value at forty random points; look for a root or "
            "logarithm of a negative number, or a division by zero."
        )

    @property
    def _sizes(self) -> list[float]:
        """Sizes of states and inputs: corners lie beside numbers of the model."""
        if not self._motions:
            return [1.0]
        return [1.0, *filter(None, map(abs, self.model.values.values()))]

    def _number(self) -> Decimal:
        size = self._random.choice(self._sizes)
        return Decimal(float(size * self._random.uniform(-1.5, 1.5)))

    def _value(self, parameter: Parameter) -> Decimal:
        """A random value beside the given one, within the bounds."""
        lower, upper = parameter.lower, parameter.upper
        share = self._random.uniform(0.5, 1.5)
        value = (parameter.value or 1.0) * share
        if lower < value < upper:
            return Decimal(value)
        if np.isfinite(lower) and np.isfinite(upper):
            return Decimal(lower + (upper - lower) * share / 2)
        if np.isfinite(lower):
            return Decimal(lower + max(abs(lower), 1.0) * share)
        return Decimal(upper - max(abs(upper), 1.0) * share)

    def silent(self, measured: Sequence[int], knows_start: bool = False) -> Silent:
        """The directions that sensors of the states ``measured`` leave open.

        ``knows_start``: whether the states at the start are known.
        """
        n, n_free = self.model.n_states, len(self.model.free)
        entries = [self.model.entries[name].parameter for name in self.model.free]
        is_local = np.array([False] * n + [one.per_trajectory for one in entries])
        has_prior = np.array([False] * n + [one.prior is not None for one in entries])
        places = np.arange(n + n_free)
        shared = places[(places >= n) & ~is_local]
        own = places[is_local | ((places < n) & (not knows_start))]
        units = np.diag(np.full(n + n_free, Decimal(1)))
        echelon = Echelon(self.digits)
        width = len(shared)
        for number in range(self.most_points):
            gap = np.full((n + n_free, width - len(shared)), NO_CHANGE)
            echelon.widen(len(own))
            width += len(own)

            def columns(rows: np.ndarray, gap: np.ndarray = gap) -> list[np.ndarray]:
                gaps = gap[: len(rows)]
                return list(np.hstack([rows[:, shared], gaps, rows[:, own]]))

            for unit in columns(units[has_prior]):
                echelon.add(unit)  # a prior tells the parameter itself
            idle, k = 0, 0
            while idle < 2 and len(echelon.rows) < width:
                rows = self._relative(number, k)[list(measured)]
                added = list(map(echelon.add, columns(rows)))
                idle = 0 if any(added) else idle + 1
                k += 1
            if len(echelon.rows) == width:
                break
        directions = np.array(echelon.null_space(width)).reshape(-1, width)
        # Columns of each run stand behind the shared ones, the first run's first.
        whole = np.full((len(directions), n + n_free), NO_CHANGE)
        first = np.append(shared, own)
        whole[:, first] = directions[:, : len(first)]
        parameters = Echelon(self.digits)
        for direction in whole[:, n:]:
            parameters.add(direction)
        states: list[int] = []
        if len(directions) and not knows_start:
            of_runs = directions[:, len(shared) :].reshape(
                len(directions), -1, len(own)
            )
            is_open = np.all(np.any(of_runs[:, :, :n] != NO_CHANGE, axis=0), axis=0)
            states = np.flatnonzero(is_open).tolist()
        return Silent(_separated(parameters, n_free), tuple(states))

    def _relative(self, number: int, k: int) -> np.ndarray:
        """Slopes of order k by the share of a start or parameter that changes."""
        motion = self._motion(number)
        return np.array(motion.order(k), dtype=object) * np.array(motion.sizes)


def _separated(echelon: Echelon, n_free: int) -> np.ndarray:
    """The rows, each with a column to itself, (n_rows, n_free)."""
    found = np.full((len(echelon.rows), n_free), NO_CHANGE)
    for number, (lead, row) in enumerate(echelon.rows):
        found[:number] -= np.outer(found[:number, lead], row)
        found[number] = row
    separated = found.astype(float)
    separated[np.abs(separated) < 1e-15] = 0.0  # beside ones; all else is rounding
    return separated

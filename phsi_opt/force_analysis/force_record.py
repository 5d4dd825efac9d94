"""The missing forces of a record, beside everything that they may depend on.

All stands at the middle of every interval, where the estimate has the force.
"""

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from phsi_opt.estimation.missing_force import ForceEstimate
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.cross_validation import (
    Sought,
    fold_numbers,
    left_out_error,
)
from phsi_opt.model.model import Model
from phsi_opt.model.parameter_units import state_units
from phsi_opt.optimization.column_function import in_numbers
from phsi_opt.statistics import TINY


@dataclass(frozen=True, eq=False)
class Points:
    """States (n, n_states), inputs, times, and parameters (n_free, n) of functions."""

    x: np.ndarray
    u: np.ndarray
    t: np.ndarray
    theta: np.ndarray

    @classmethod
    def middles(cls, record: Record) -> "Points":
        """The middle of every interval, where an estimate has the missing force."""
        grid = record.estimate.grid.driven(record.model, record.theta)
        x = record.estimate.x
        middle = (x[grid.begin] + x[grid.begin + 1]) / 2
        u = (grid.u0 + grid.u1) / 2
        t = grid.t[grid.begin] + grid.h / 2
        return cls(middle, u, t, record.theta[:, grid.runs])

    def values(self, function: ca.Function) -> np.ndarray:
        """Of a function of states, inputs, time and parameters, (n, n_out)."""
        arguments = (self.x.T, self.u.T, self.t[None, :], self.theta)
        return np.vstack(in_numbers(function, *arguments)).T

    def slopes(self, model: Model) -> np.ndarray:
        """Of dx/dt in the free parameters, (n, n_states, n_free)."""
        columns = self.values(model.rhs_slopes("theta"))[:, model.n_states :]
        return columns.reshape(len(self.t), model.n_states, -1)


@dataclass(frozen=True, eq=False)
class ForceRecord:
    """The missing forces along a fit, and what they may depend on, by interval."""

    along: Record
    model: Model  # with the values beside which the forces were estimated
    points: Points

    @classmethod
    def of(cls, record: Record) -> "ForceRecord":
        model = record.model.with_values(record.estimate.rounded)
        return cls(record, model, Points.middles(record))

    @property
    def estimate(self) -> ForceEstimate:
        return self.along.estimate

    def origin_of(self, trajectory: str) -> dt.datetime | None:
        """The moment at which the time of a trajectory is 0, where it is a date."""
        number = self.along.runs.index(trajectory)
        return self.along.data.trajectories[number].origin

    @cached_property
    def units(self) -> dict[str, str]:
        """Of states and inputs by name, and of ``t``."""
        units = self.along.data.units
        return {**units, **state_units(self.model, units)}

    @property
    def labels(self) -> Mapping[str, str]:
        return self.along.data.labels

    @property
    def equations(self) -> tuple[str, ...]:
        """States in whose equations a force was estimated."""
        return tuple(self.model.states[row] for row in self.estimate.rows)

    @property
    def t(self) -> np.ndarray:
        """Time, (n_intervals,)."""
        return self.points.t

    @cached_property
    def run(self) -> np.ndarray:
        """Number of the trajectory, (n_intervals,)."""
        return self.estimate.grid.runs

    @cached_property
    def efforts(self) -> np.ndarray:
        """dH/dx, (n_intervals, n_states)."""
        return self.points.values(self.model.function(*self.model.efforts))

    @cached_property
    def rates(self) -> np.ndarray:
        """dx/dt of the model, (n_intervals, n_states)."""
        return self.points.values(self.model.rhs())

    @cached_property
    def slopes(self) -> np.ndarray:
        """Slopes of dx/dt in the parameters that do not stand at a bound, of rms one.

        (n_intervals, n_states, n_moving).
        """
        slopes = np.nan_to_num(self.points.slopes(self.model))
        size = np.sqrt(np.mean(slopes**2, axis=0))
        rate = np.sqrt(np.mean(np.nan_to_num(self.rates) ** 2, axis=0))
        strength = np.max(size / np.maximum(rate, TINY)[:, None], axis=0, initial=0.0)
        model = self.model
        to_bounds = []
        for name in model.free:
            bounds = model.entries[name].parameter
            value = model.values[name]
            to_bounds.append(min(abs(value - bounds.lower), abs(bounds.upper - value)))
        # As a change of the rates beside these; else it stands at a bound.
        is_moving = np.array(to_bounds) * np.maximum(strength, TINY) > 1e-6
        scaled = slopes / np.where(size > 0, size, 1.0)
        return scaled[:, :, is_moving]

    @cached_property
    def folds(self) -> np.ndarray:
        """Which fold leaves each interval out, (n_intervals,)."""
        return fold_numbers(self.run)

    @cached_property
    def folds_of_inputs(self) -> np.ndarray:
        """The same where functions of the inputs are judged, (n_intervals,)."""
        return fold_numbers(self.run, self.points.u[:, : len(self.model.inputs)])

    def variable(self, name: str) -> np.ndarray:
        """Values of a state, an effort, an input or the time ``t``, (n_intervals,)."""
        model = self.model
        known = {"t": self.t}
        known |= zip(model.efforts, self.efforts.T, strict=True)
        known |= zip(model.states, self.points.x.T, strict=True)
        known |= zip(model.inputs, self.points.u.T, strict=False)
        return known[name]


@dataclass(frozen=True, eq=False)
class Force:
    """The missing force (n_intervals,) of one equation."""

    record: ForceRecord
    equation: str

    @property
    def number(self) -> int:
        return self.record.equations.index(self.equation)

    @property
    def row(self) -> int:
        return self.record.model.states.index(self.equation)

    @property
    def w(self) -> np.ndarray:
        """The force, (n_intervals,)."""
        return self.record.estimate.w[:, self.number]

    @property
    def deviation(self) -> np.ndarray:
        """Its standard deviation, (n_intervals,)."""
        return self.record.estimate.posterior.deviation[:, self.number]

    @property
    def effort(self) -> np.ndarray:
        """The effort of the equation (the velocity for a momentum), (n_intervals,)."""
        return self.record.efforts[:, self.row]

    def shown(self, forces: np.ndarray) -> np.ndarray:
        """What the estimate would show of forces (n_intervals, k) on the equation.

        They are less what noise and prior hide, w_shown = w - C P^-1 w, with the
        covariance P of the force before and C after the measurements.
        """
        return self.record.estimate.posterior.shown(self.number, forces)

    @cached_property
    def by_parameters(self) -> np.ndarray:
        """Slopes in the parameters that act in the equation, as they would be shown.

        (n_intervals, n_acting).
        """
        slopes = self.record.slopes[:, self.row]
        return self.shown(slopes[:, np.any(slopes != 0, axis=0)])

    @property
    def squares(self) -> float:
        return float(self.w @ self.w)

    def left_out_error(
        self,
        bases: Sequence[np.ndarray],
        sought: Sought | None = None,
        with_inputs: bool = False,
    ) -> float:
        """That of functions (n_intervals, k) of the force, of inputs too or not."""
        record = self.record
        folds = record.folds_of_inputs if with_inputs else record.folds
        return left_out_error(self.w, folds, bases, sought)

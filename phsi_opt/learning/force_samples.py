"""The missing force of one equation along a record, as samples to learn from."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from phsi_opt.errors import DataError, ModelError
from phsi_opt.estimation.record import Record
from phsi_opt.model.model import Model
from phsi_opt.statistics import TINY
from phsi_opt.transcription.parameter_vector import Theta

MIN_INTERVALS = 50  # so that every stretch of time that is left out holds a few
# Singular value, as a share of the largest, below which a direction is one that others
# explain.
RANK_TOLERANCE = 1e-8


@dataclass(frozen=True, eq=False)
class Points:
    """Points at which a model is evaluated.

    Attributes:
        x: (n, n_states).
        u: (n, n_inputs).
        t: (n,).
        theta: (n_free, n), the parameters at each point.
    """

    x: np.ndarray
    u: np.ndarray
    t: np.ndarray
    theta: np.ndarray

    def values(self, function: ca.Function) -> np.ndarray:
        """A CasADi function (x, u, t, theta) at every point, (n, n_values)."""
        times = np.reshape(self.t, (1, -1))
        columns = function.map(len(self.t))(self.x.T, self.u.T, times, self.theta)
        return np.array(columns).T


@dataclass(frozen=True, eq=False)
class ForceSamples:
    """The missing force of one equation, in the middle of every interval of a record.

    Attributes:
        v: (n, n_variables), the variables it may depend on.
        w: (n,), the force.
        std: (n,), its standard deviation.
        physics: (n, n_columns), orthonormal basis of the forces over ``std`` that the
            free parameters can produce.
    """

    v: np.ndarray
    w: np.ndarray
    std: np.ndarray
    physics: np.ndarray

    @classmethod
    def of(cls, record: Record, equation: str, on: Sequence[str]) -> "ForceSamples":
        """The samples of a record.

        Args:
            record: a fit along measurements.
            equation: the state whose equation lacks the force.
            on: names of the variables.

        Raises:
            ModelError: the equation is unknown, or one of kinematics.
            DataError: there are too few intervals.
        """
        estimate = record.estimate
        model = record.model.with_values(estimate.rounded)
        row = model.index(equation, "equation of a learned force")
        if row not in estimate.rows:
            raise ModelError(
                f"d{equation}/dt is kinematics and lacks no force; "
                "learn it in the equation of a momentum."
            )
        n_intervals = estimate.grid.n_intervals
        if n_intervals < MIN_INTERVALS:
            raise DataError(
                f"{n_intervals} intervals are too few to learn a force; "
                f"at least {MIN_INTERVALS} are needed."
            )
        points = _midpoints(record)
        column = estimate.rows.index(row)
        std = np.maximum(estimate.posterior.deviation[:, column], TINY)
        columns = _force_by_parameters(record, model, row, points)
        scaled = columns / std[:, None]
        basis, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
        largest = np.max(sizes, initial=0.0)
        physics = basis[:, sizes > RANK_TOLERANCE * largest]
        v = points.values(model.function(*on))
        return cls(v, estimate.w[:, column], std, physics)

    @property
    def beyond_physics(self) -> np.ndarray:
        """The force less what the physics explains of it, (n,).

        By least squares, weighted with the standard deviation.
        """
        scaled = self.w / self.std
        explained = self.physics @ (self.physics.T @ scaled)
        return np.asarray(scaled - explained) * self.std


def _midpoints(record: Record) -> Points:
    """The middle of every interval of the estimate."""
    estimate = record.estimate
    grid = estimate.grid
    x = (estimate.x[grid.begin] + estimate.x[grid.begin + 1]) / 2
    u = (grid.u0 + grid.u1) / 2
    t = grid.t[grid.begin] + grid.h / 2
    trajectory = grid.trajectory[grid.begin]
    return Points(x, u, t, record.theta[:, trajectory])


def _force_by_parameters(
    record: Record, model: Model, row: int, points: Points
) -> np.ndarray:
    """Slopes of one rate in the parameters, (n, n_theta)."""
    grid = record.estimate.grid
    sizes = (model.n_states, model.n_inputs, 1, len(model.free))
    symbols = [ca.SX.sym("s", size) for size in sizes]
    rate = model.rhs()(*symbols)[row]
    slope = ca.densify(ca.jacobian(rate, symbols[-1]).T)
    slopes = points.values(ca.Function("slope", symbols, [slope]))
    unknown = Theta.of(model, record.trajectories)
    columns = np.zeros((len(points.t), len(unknown)))
    places = unknown.table[:, grid.trajectory[grid.begin]].T
    np.put_along_axis(columns, places, slopes, axis=1)
    return columns

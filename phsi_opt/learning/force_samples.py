"""The missing force of one equation along a record, as samples to learn from.

And what a force along the record does to the residuals of the measurements.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phsi_opt.errors import DataError, ModelError
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.cross_validation import N_FOLDS
from phsi_opt.force_analysis.force_record import Points
from phsi_opt.screening.linearized_record import LinearizedRecord
from phsi_opt.statistics import TINY
from phsi_opt.transcription.parameter_vector import Theta

# Singular value, as a share of the largest, below which a direction is one that others
# explain.
RANK_TOLERANCE = 1e-8


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
        """The samples of what a record lacks in an equation, on variables.

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
        if n_intervals < 50:  # every stretch of time left out holds a few
            raise DataError(
                f"{n_intervals} intervals are too few to learn a force; "
                "at least 50 are needed."
            )
        points = Points.middles(record)
        column = estimate.rows.index(row)
        std = np.maximum(estimate.posterior.deviation[:, column], TINY)
        grid = estimate.grid
        unknown = Theta.of(model, record.trajectories)
        places = unknown.table[:, grid.runs].T
        columns = np.zeros((n_intervals, len(unknown)))
        np.put_along_axis(columns, places, points.slopes(model)[:, row], axis=1)
        basis, sizes, _ = np.linalg.svd(columns / std[:, None], full_matrices=False)
        physics = basis[:, sizes > RANK_TOLERANCE * np.max(sizes, initial=0.0)]
        v = points.values(model.function(*on))
        return cls(v, estimate.w[:, column], std, physics)

    def without_physics(self, force: np.ndarray) -> np.ndarray:
        """A force (n,) over ``std``, less what the physics explains of it, (n,)."""
        scaled = force / self.std
        return scaled - self.physics @ (self.physics.T @ scaled)


@dataclass(frozen=True, eq=False)
class Response:
    """The linearised response of the residuals to a force in one equation.

    Attributes:
        linearized: the likelihood of the record, at the states of its missing force.
        row: of the equation.
        residual: (n_values,), what the fit leaves, in units of the noise.
    """

    linearized: LinearizedRecord
    row: int
    residual: np.ndarray

    @classmethod
    def of(cls, record: Record, row: int) -> "Response":
        """The response of a record."""
        linearized = LinearizedRecord.of(record)
        return cls(linearized, row, linearized.residual)

    def folds(self) -> tuple[np.ndarray, np.ndarray]:
        """Groups of stretches of time, (n_intervals,) and (n_values,)."""
        grid = self.linearized.grid
        # With two, a fold sees the beginning and the end of what decays.
        n_stretches = 2 * N_FOLDS
        of_node = np.arange(grid.n_nodes) * n_stretches // grid.n_nodes % N_FOLDS
        return of_node[grid.begin], of_node[np.nonzero(grid.measured)[0]]

    def traces(self, forces: np.ndarray) -> np.ndarray:
        """What forces (n_intervals, n_forces) change of the explained values.

        In units of the noise, (n_values, n_forces).
        """
        grid = self.linearized.grid
        n_states = self.linearized.model.n_states
        n_forces = forces.shape[1]
        of_defects = np.zeros((grid.n_intervals, n_states, n_forces))
        of_defects[:, self.row] = -forces
        of_outputs = np.zeros((grid.n_nodes * n_states, n_forces))
        return self.linearized.traces(of_defects.reshape(-1, n_forces), of_outputs)

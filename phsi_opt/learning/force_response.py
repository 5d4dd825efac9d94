"""What a force along a record does to the residuals of the measurements."""

from dataclasses import dataclass

import numpy as np

from phsi_opt.estimation.record import Record
from phsi_opt.screening.linearized_record import LinearizedRecord

N_FOLDS = 5  # groups of stretches of time that are left out in turn
# Stretches in a fold: with two, a fold sees the beginning and the end of what decays.
STRETCHES_PER_FOLD = 2


@dataclass(frozen=True, eq=False)
class Response:
    """The linearised response of the residuals to a force in one equation.

    Attributes:
        linearized: the likelihood of the record.
        row: of the equation.
        residual: (n_values,), what the fit leaves, in units of the noise.
        fold: (n_intervals,), the group of stretches of time of an interval.
        value_fold: (n_values,), the same of a measured value.
    """

    linearized: LinearizedRecord
    row: int
    residual: np.ndarray
    fold: np.ndarray
    value_fold: np.ndarray

    @classmethod
    def of(cls, record: Record, row: int) -> "Response":
        """The response of a record, linearised at the states of its missing force."""
        linearized = LinearizedRecord.of(record)
        grid = linearized.grid
        n_stretches = STRETCHES_PER_FOLD * N_FOLDS
        stretch = np.arange(grid.n_nodes) * n_stretches // grid.n_nodes
        of_node = stretch % N_FOLDS
        of_value = of_node[np.nonzero(grid.measured)[0]]
        residual = linearized.residual
        return cls(linearized, row, residual, of_node[grid.begin], of_value)

    def traces(self, forces: np.ndarray) -> np.ndarray:
        """What forces change of the explained values, in units of the noise.

        Args:
            forces: (n_intervals, n_forces).

        Returns:
            (n_values, n_forces).
        """
        linearized = self.linearized
        grid = linearized.grid
        n_states = linearized.model.n_states
        n_forces = forces.shape[1]
        of_defects = np.zeros((grid.n_intervals, n_states, n_forces))
        of_defects[:, self.row] = -forces
        of_outputs = np.zeros((grid.n_nodes * n_states, n_forces))
        return linearized.traces(of_defects.reshape(-1, n_forces), of_outputs)

"""The prior of a missing force: how large it is, and over what time it changes.

A first-order process, smooth enough to tell a force from noise and rough enough for a
friction that jumps. How large the force is, is not chosen here but by marginal
likelihood (`phsi_opt.estimation.missing_force`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import diags

from phsi_opt.statistics import TINY
from phsi_opt.transcription.grid import Grid


@dataclass(frozen=True, eq=False)
class ForcePrior:
    """Ornstein-Uhlenbeck prior of the missing force, one process per forced equation.

    Between the middles of two intervals, a time dt apart, the force keeps the share
    exp(-dt/time) of its value; the rest is new and independent.

    Attributes:
        rows: equations that the force acts in.
        size: (n_forced,) standard deviation of the force in each of them.
        time: correlation time, in the unit of the record's times.
    """

    rows: tuple[int, ...]
    size: np.ndarray
    time: float

    def whitener(self, grid: Grid, k: int) -> Any:
        """Sparse matrix from the force in row k to independent standard normals."""
        return self.unit_whitener(grid) / self.size[k]

    def unit_whitener(self, grid: Grid) -> Any:
        """The whitener of a force of size one, (n_intervals, n_intervals), sparse."""
        middle = grid.t[grid.begin] + grid.h / 2
        is_first = np.diff(grid.trajectory[grid.begin], prepend=-1) != 0
        kept = np.exp(-np.diff(middle, prepend=middle[0]) / self.time)
        kept[is_first] = 0.0
        log_kept = np.log(np.maximum(kept, TINY))
        innovation = np.sqrt(-np.expm1(2 * log_kept))
        below_diagonal = -kept[1:] / innovation[1:]
        return diags([1 / innovation, below_diagonal], [0, -1], format="csc")

"""Linear algebra along the time.

Unknowns that touch only their neighbours in time make a banded matrix.
The optimality system of every likelihood here is such a matrix, bordered by the few
columns of the parameters. Its factors cost time and memory in proportion to the number
of samples. The border is dealt with elsewhere (`transcription.elimination`).
"""

from typing import Any

import numpy as np
from scipy.linalg.lapack import dgbtrf, dgbtrs

from phsi_opt.errors import SolveError


class Banded:
    """LU factors (LAPACK, partial pivoting) of a matrix that is banded once sorted.

    Args:
        matrix: square, SciPy sparse, (n, n).
        order: (n,), the unknowns in the order in which they make a band.

    Attributes:
        kl: number of diagonals below the main one.
        ku: number of diagonals above it.

    Raises:
        SolveError: the matrix is singular.
    """

    def __init__(self, matrix: Any, order: np.ndarray) -> None:
        self.order = order
        self.n = len(order)
        rank = np.empty(self.n, dtype=np.int64)
        rank[order] = np.arange(self.n)
        entries = matrix.tocoo()
        rows = rank[entries.row]
        columns = rank[entries.col]
        self.kl = int(np.max(rows - columns, initial=0))
        self.ku = int(np.max(columns - rows, initial=0))
        # LAPACK's band storage, with kl more rows for what pivoting fills in.
        band = np.zeros((2 * self.kl + self.ku + 1, self.n), order="F")
        self._diagonal = self.kl + self.ku
        np.add.at(band, (self._diagonal + rows - columns, columns), entries.data)
        self.factors, self.pivots, info = dgbtrf(
            band, self.kl, self.ku, overwrite_ab=True
        )
        if info > 0:
            raise SolveError(
                "the optimality system is singular: a state may neither be measured "
                "nor act on one that is; measure it, or take it out of the model."
            )

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solution for one right-hand side (n,) or several (n, k)."""
        columns = right.reshape(self.n, -1)
        found, _ = dgbtrs(
            self.factors,
            self.kl,
            self.ku,
            columns[self.order],
            self.pivots,
            overwrite_b=True,
        )
        result = np.empty_like(found)
        result[self.order] = found
        return result.reshape(right.shape)

    @property
    def log_abs_det(self) -> float:
        """Logarithm of the absolute value of the determinant."""
        diagonal = self.factors[self._diagonal]
        return float(np.sum(np.log(np.abs(diagonal))))

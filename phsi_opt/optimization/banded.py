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

# Right-hand sides from which LAPACK solves with the transposed factors in less time: a
# quarter to a third less for eight and more. Of a symmetric matrix both are the same.
TRANSPOSED_FROM = 3


class BandLayout:
    """Where the entries of matrices of one pattern stand in LAPACK's band storage.

    Args:
        rows: (n_entries,) row of every entry; entries at one place are added.
        columns: (n_entries,) its column.
        order: (n,), the unknowns in the order in which they make a band.
        is_symmetric: whether the matrices are.

    Attributes:
        rank: (n,) place of every unknown in that order.
        kl: number of diagonals below the main one.
        ku: number of diagonals above it.
    """

    def __init__(
        self,
        rows: np.ndarray,
        columns: np.ndarray,
        order: np.ndarray,
        is_symmetric: bool = False,
    ) -> None:
        self.order = order
        self.is_symmetric = is_symmetric
        self.n = len(order)
        self.rank = np.empty(self.n, dtype=np.int64)
        self.rank[order] = np.arange(self.n)
        sorted_rows = self.rank[rows]
        sorted_columns = self.rank[columns]
        offsets = sorted_rows - sorted_columns
        self.kl = int(np.max(offsets, initial=0))
        self.ku = int(np.max(-offsets, initial=0))
        # LAPACK's band storage, with kl more rows for what pivoting fills in.
        self._height = 2 * self.kl + self.ku + 1
        self._places = sorted_columns * self._height + self.diagonal + offsets

    @property
    def diagonal(self) -> int:
        """Row of the band storage that holds the main diagonal."""
        return self.kl + self.ku

    def filled(self, entries: np.ndarray) -> np.ndarray:
        """The band of a matrix with these entries, (height, n)."""
        size = self.n * self._height
        band = np.bincount(self._places, weights=entries, minlength=size)
        return band.reshape(self.n, self._height).T


class Banded:
    """LU factors (LAPACK, partial pivoting) of a matrix that is banded once sorted.

    Args:
        matrix: square, SciPy sparse, (n, n).
        order: (n,), the unknowns in the order in which they make a band.
        is_symmetric: whether the matrix is.

    Raises:
        SolveError: the matrix is singular.
    """

    def __init__(
        self, matrix: Any, order: np.ndarray, is_symmetric: bool = False
    ) -> None:
        entries = matrix.tocoo()
        layout = BandLayout(entries.row, entries.col, order, is_symmetric)
        self._factor(layout, entries.data)

    @classmethod
    def of(cls, layout: BandLayout, entries: np.ndarray) -> "Banded":
        """Of the matrix with these entries (n_entries,) in a layout made before.

        Raises:
            SolveError: the matrix is singular.
        """
        banded = cls.__new__(cls)
        banded._factor(layout, entries)
        return banded

    def _factor(self, layout: BandLayout, entries: np.ndarray) -> None:
        self.order = layout.order
        self._rank = layout.rank
        self.n = layout.n
        self.kl = layout.kl
        self.ku = layout.ku
        self._is_symmetric = layout.is_symmetric
        self._diagonal = layout.diagonal
        band = layout.filled(entries)
        self.factors, self.pivots, info = dgbtrf(
            band, self.kl, self.ku, overwrite_ab=True
        )
        if info > 0:
            raise SolveError(
                "the optimality system is singular: a state may neither be measured "
                "nor act on one that is; measure it, or take it out of the model."
            )

    def solve(self, right: np.ndarray, is_transposed: bool = False) -> np.ndarray:
        """Solution for one right-hand side (n,) or several (n, k).

        Column after column in memory, as LAPACK has them; nothing is copied where the
        right-hand sides are so too.

        Args:
            right: one or several.
            is_transposed: whether the matrix is taken transposed.
        """
        columns = np.take(right.reshape(self.n, -1).T, self.order, axis=1)
        if self._is_symmetric:
            is_transposed = len(columns) >= TRANSPOSED_FROM
        found, _ = dgbtrs(
            self.factors,
            self.kl,
            self.ku,
            columns.T,
            self.pivots,
            trans=int(is_transposed),
            overwrite_b=True,
        )
        result = np.take(found.T, self._rank, axis=1)
        return result[0] if right.ndim == 1 else result.T

    @property
    def log_abs_det(self) -> float:
        """Logarithm of the absolute value of the determinant."""
        diagonal = self.factors[self._diagonal]
        return float(np.sum(np.log(np.abs(diagonal))))

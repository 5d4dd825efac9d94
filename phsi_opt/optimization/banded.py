"""Linear algebra along the time.

Unknowns that touch only their neighbours in time make a banded matrix.
The optimality system of every likelihood here is such a matrix, bordered by the few
columns of the parameters. Its factors cost time and memory in proportion to the number
of samples. The border is dealt with elsewhere (`transcription.elimination`).
"""

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
        height: of the band's storage, (height, n).
        places: (n_entries,) of the entries in it, column after column.
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
        self.height = 2 * self.kl + self.ku + 1
        self.places = sorted_columns * self.height + self.kl + self.ku + offsets


class Banded:
    """LU factors (LAPACK, partial pivoting) of a matrix that is banded once sorted.

    Args:
        layout: of its pattern.
        entries: (n_entries,) in the order of the layout.

    Attributes:
        layout: likewise.
        n: number of unknowns.

    Raises:
        SolveError: the matrix is singular.
    """

    def __init__(self, layout: BandLayout, entries: np.ndarray) -> None:
        self.layout = layout
        self.n = layout.n
        size = layout.n * layout.height
        band = np.bincount(layout.places, weights=entries, minlength=size)
        self._factors, self._pivots, info = dgbtrf(
            band.reshape(layout.n, layout.height).T,
            layout.kl,
            layout.ku,
            overwrite_ab=True,
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
        layout = self.layout
        columns = np.take(right.reshape(self.n, -1).T, layout.order, axis=1)
        if layout.is_symmetric:
            is_transposed = len(columns) >= TRANSPOSED_FROM
        found, _ = dgbtrs(
            self._factors,
            layout.kl,
            layout.ku,
            columns.T,
            self._pivots,
            trans=int(is_transposed),
            overwrite_b=True,
        )
        result = np.take(found.T, layout.rank, axis=1)
        return result[0] if right.ndim == 1 else result.T

    @property
    def log_abs_det(self) -> float:
        """Logarithm of the absolute value of the determinant."""
        diagonal = self._factors[self.layout.kl + self.layout.ku]
        return float(np.sum(np.log(np.abs(diagonal))))

"""Where the entries of a sparse matrix stand, while their values come and go."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.sparse import csc_matrix


@dataclass(frozen=True, eq=False)
class Pattern:
    """Rows and columns of a matrix's entries; those at one place are added.

    Attributes:
        rows: (n_entries,).
        columns: (n_entries,).
        shape: of the matrix.
    """

    rows: np.ndarray
    columns: np.ndarray
    shape: tuple[int, int]

    def filled(self, entries: np.ndarray) -> csc_matrix:
        """The matrix with these entries, (n_entries,)."""
        return csc_matrix((entries, (self.rows, self.columns)), shape=self.shape)

    def symmetric(self, upper: np.ndarray) -> csc_matrix:
        """The symmetric matrix whose upper triangle has these entries."""
        above = self.rows != self.columns
        entries = np.concatenate([upper, upper[above]])
        rows = np.concatenate([self.rows, self.columns[above]])
        columns = np.concatenate([self.columns, self.rows[above]])
        return csc_matrix((entries, (rows, columns)), shape=self.shape)


def entry_places(matrix: ca.SX) -> np.ndarray:
    """Row and column of each entry that is not always zero, (n_entries, 2)."""
    rows, columns = matrix.sparsity().get_triplet()
    return np.array([rows, columns], dtype=int).T


def entries_of(matrix: ca.SX) -> ca.SX:
    """The entries at `entry_places`, as a column."""
    entries = [matrix[row, column] for row, column in entry_places(matrix).tolist()]
    return ca.vertcat(ca.SX(0, 1), *entries)

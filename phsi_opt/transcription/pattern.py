"""Where the entries of a sparse matrix stand, while their values come and go."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.sparse import coo_matrix


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

    def part(self, columns: slice) -> "PatternPart":
        """The same of a range of columns."""
        own = (self.columns >= columns.start) & (self.columns < columns.stop)
        places = np.flatnonzero(own)
        return PatternPart(
            places=places,
            rows=self.rows[places],
            columns=self.columns[places] - columns.start,
            shape=(self.shape[0], columns.stop - columns.start),
        )


@dataclass(frozen=True, eq=False)
class PatternPart:
    """Some columns of a pattern.

    Attributes:
        places: (n_part,) of its entries among those of the whole pattern.
        rows: (n_part,).
        columns: (n_part,) among those of the part.
        shape: of the part.
    """

    places: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    shape: tuple[int, int]

    def sparse(self, entries: np.ndarray) -> coo_matrix:
        """With the entries of the whole pattern, (n_entries,)."""
        own = (entries[self.places], (self.rows, self.columns))
        return coo_matrix(own, shape=self.shape)

    def dense(self, entries: np.ndarray) -> np.ndarray:
        """The same as an array."""
        n_rows, n_columns = self.shape
        places = self.rows * n_columns + self.columns
        filled = np.bincount(places, entries[self.places], n_rows * n_columns)
        return filled.reshape(self.shape)


def entry_places(matrix: ca.SX) -> np.ndarray:
    """Row and column of each entry that is not always zero, (n_entries, 2)."""
    rows, columns = matrix.sparsity().get_triplet()
    return np.array([rows, columns], dtype=int).T


def entries_of(matrix: ca.SX) -> ca.SX:
    """The entries at `entry_places`, as a column."""
    entries = [matrix[row, column] for row, column in entry_places(matrix).tolist()]
    return ca.vertcat(ca.SX(0, 1), *entries)

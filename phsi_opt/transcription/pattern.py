"""The entries of a sparse matrix of symbols that are not always zero."""

import casadi as ca
import numpy as np


def entry_places(matrix: ca.SX) -> np.ndarray:
    """Row and column of each entry that is not always zero, (n_entries, 2)."""
    rows, columns = matrix.sparsity().get_triplet()
    return np.array([rows, columns], dtype=int).T


def entries_of(matrix: ca.SX) -> ca.SX:
    """The entries at `entry_places`, as a column."""
    entries = [matrix[row, column] for row, column in entry_places(matrix).tolist()]
    return ca.vertcat(ca.SX(0, 1), *entries)

"""TODO."""

import numpy as np
from scipy.sparse import csc_matrix

LINEARIZATION_SCHEME = "srk4"
BACK = 4  # steps of Newton's method to states that obey the model, at most
OBEYED, NEARLY = (
    1e-4,
    1e-2,
)  # defects, as shares of those at the missing force's states: none; few enough
KEPT = 20_000  # rows of every trace scanned that are kept, for the pairs


def column_scale(B: csc_matrix, D: csc_matrix) -> np.ndarray:
    """Per column of B above D: one over its norm."""
    norms = np.sqrt(np.asarray(B.power(2).sum(axis=0) + D.power(2).sum(axis=0)).ravel())
    return 1 / np.where(norms > 0, norms, 1.0)

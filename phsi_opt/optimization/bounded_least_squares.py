"""Linear least squares within bounds."""

import numpy as np
from scipy.optimize import lsq_linear


def bounded_least_squares(
    A: np.ndarray, b: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """The x within bounds that minimises ``|A x - b|^2``, (n,).

    By an active set (Stark and Parker, Comput. Stat. 10, 1995), which always ends:
    where the columns of A differ by many orders of magnitude, the line search of
    SciPy's other method goes on for ever.

    Args:
        A: matrix, (m, n).
        b: right-hand side, (m,).
        lower: least values, (n,), each below that of ``upper``.
        upper: largest values, (n,).
    """
    found: np.ndarray = lsq_linear(A, b, (lower, upper), method="bvls").x
    return found

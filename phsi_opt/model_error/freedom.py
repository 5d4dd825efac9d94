"""How well a variance is itself known: its degrees of freedom.

The sizes of disturbances are estimated, and so is every variance that follows from
them. Satterthwaite's rule gives the chi-square distribution that scatters alike
(Biometrics Bulletin 2, 1946; for sizes found by restricted likelihood, Kenward and
Roger, Biometrics 53, 1997)::

    freedom = 2 variance^2 / Var(variance)
"""

from collections.abc import Callable

import numpy as np

LOG_STEP = 0.1  # of logarithms of sizes and times, for slopes and curvatures
# Curvature of minus the log evidence in a logarithm, at least: a size that the record
# tells no better is known to a factor of four.
LEAST_CURVATURE = 0.5
FEWEST = 3.0  # degrees of freedom; with fewer a variance means nothing
MOST = 1e9  # degrees of freedom of a variance that is as good as known


def degrees_of_freedom(
    negative_evidence: Callable[[np.ndarray], float],
    log_variances: Callable[[np.ndarray], np.ndarray],
    is_free: np.ndarray,
) -> np.ndarray:
    """Degrees of freedom of variances that follow from estimated logarithms.

    Args:
        negative_evidence: minus the log evidence, least at zero.
        log_variances: logarithms of the variances, (n,).
        is_free: (n_coordinates,) whether a coordinate of the vectors that both take was
            estimated, and is not given by a bound.

    Returns:
        (n,), from `FEWEST` to `MOST`.
    """
    if not is_free.any():
        at_zero = log_variances(np.zeros(len(is_free)))
        return np.full(len(at_zero), MOST)
    units = LOG_STEP * np.eye(len(is_free))[is_free]
    curvature = _curvature(negative_evidence, units)
    values, vectors = np.linalg.eigh(curvature)
    spread = 1 / np.maximum(values, LEAST_CURVATURE)
    covariance = (vectors * spread) @ vectors.T
    slopes = _slopes(log_variances, units)
    variance = np.einsum("in,ij,jn->n", slopes, covariance, slopes)
    return np.maximum(2 / np.maximum(variance, 2 / MOST), FEWEST)


def _slopes(
    function: Callable[[np.ndarray], np.ndarray], units: np.ndarray
) -> np.ndarray:
    """Of several functions along every unit, (n_units, n_functions)."""
    slopes = []
    for unit in units:
        slopes.append((function(unit) - function(-unit)) / (2 * LOG_STEP))
    return np.array(slopes)


def _curvature(
    function: Callable[[np.ndarray], float], units: np.ndarray
) -> np.ndarray:
    """Second derivatives at zero, (n_units, n_units)."""
    n = len(units)
    middle = function(np.zeros(units.shape[1]))
    above = np.array([function(unit) for unit in units])
    below = np.array([function(-unit) for unit in units])
    curvature = np.diag((above - 2 * middle + below) / LOG_STEP**2)
    for i in range(n):
        for j in range(i):
            both = function(units[i] + units[j])
            mixed = (both - above[i] - above[j] + middle) / LOG_STEP**2
            curvature[i, j] = mixed
            curvature[j, i] = mixed
    return curvature

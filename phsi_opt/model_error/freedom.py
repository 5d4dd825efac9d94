"""A covariance, and how well it is itself known: its degrees of freedom.

The sizes of disturbances are estimated, and so is every variance that follows from
them. Satterthwaite's rule gives the chi-square distribution that scatters alike
(Biometrics Bulletin 2, 1946; for sizes found by restricted likelihood, Kenward and
Roger, Biometrics 53, 1997)::

    freedom = 2 variance^2 / Var(variance)

How surely the sizes are known is told by the average information (Gilmour, Thompson and
Cullis, Biometrics 51, 1995), which the search for them has anyway.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

LOG_STEP = 0.1  # of logarithms of sizes and times, for slopes
FEWEST = 3.0  # degrees of freedom; with fewer a variance means nothing
MOST = 1e9  # degrees of freedom of a variance that is as good as known


@dataclass(frozen=True, eq=False)
class Spread:
    """A covariance of the scaled parameters, and how well it is known.

    Attributes:
        covariance: (n_theta, n_theta).
        freedom: (n_theta,) degrees of freedom of the variances.
    """

    covariance: np.ndarray
    freedom: np.ndarray


def degrees_of_freedom(
    information: np.ndarray,
    log_variances: Callable[[np.ndarray], np.ndarray],
    is_free: np.ndarray,
) -> np.ndarray:
    """Degrees of freedom of variances that follow from estimated logarithms.

    Args:
        information: of estimated logarithms, (n_coordinates, n_coordinates).
        log_variances: logarithms of the variances, (n,), of a vector (n_coordinates,)
            that is zero at the estimate.
        is_free: (n_coordinates,) whether a coordinate was estimated, and is not given
            by a bound.

    Returns:
        (n,), from `FEWEST` to `MOST`.
    """
    if not is_free.any():
        at_zero = log_variances(np.zeros(len(is_free)))
        return np.full(len(at_zero), MOST)
    units = LOG_STEP * np.eye(len(is_free))[is_free]
    values, vectors = np.linalg.eigh(information[np.ix_(is_free, is_free)])
    # A size that the record tells no better is known to a factor of four.
    spread = 1 / np.maximum(values, 0.5)
    covariance = (vectors * spread) @ vectors.T
    changes = [log_variances(unit) - log_variances(-unit) for unit in units]
    slopes = np.array(changes) / (2 * LOG_STEP)
    variance = np.einsum("in,ij,jn->n", slopes, covariance, slopes)
    return np.maximum(2 / np.maximum(variance, 2 / MOST), FEWEST)

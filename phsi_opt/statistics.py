"""What residuals that are correlated in time can tell: independent values among them."""

from collections.abc import Sequence

import numpy as np
from scipy.signal import fftconvolve

# Keeps quotients and logarithms of what may be zero finite; far below every number that a
# measurement or a model can mean, far above the least that float64 can hold.
TINY = 1e-300


def spread_together(series: Sequence[np.ndarray]) -> float:
    """How much more the sum of values in the order of time varies than if they were
    independent.

    One plus twice their correlations, over lags up to the first pair of neighbouring
    lags whose sum is not positive (Geyer's initial positive sequence); (1 + rho)/(1 -
    rho) where each value keeps a share rho of the last one. ``series`` holds one array
    per trajectory.
    """
    covariance = np.zeros(max((len(s) for s in series), default=0) + 2)
    for s in series:
        covariance[: len(s)] += fftconvolve(s, s[::-1])[len(s) - 1 :]
    if covariance[0] <= 0:
        return 1.0
    pairs = (
        covariance[: len(covariance) // 2 * 2].reshape(-1, 2).sum(axis=1)
        / covariance[0]
    )
    ends = np.flatnonzero(pairs <= 0)
    return max(float(2 * pairs[: ends[0] if len(ends) else None].sum() - 1), 1.0)


def independent_share(
    changes: Sequence[np.ndarray], residuals: Sequence[np.ndarray]
) -> float:
    """Independent values among the residuals, for one ``change`` of what the model
    shows: naive over actual variance.

    Both (n_samples, n_channels) per trajectory, in units of the residuals' own size.
    What a coefficient can explain by chance depends on its trace times the residual: a
    slow error of the model does not imitate a fast trace.
    """
    scores = [
        np.sum(change * r, axis=1) for change, r in zip(changes, residuals, strict=True)
    ]
    naive = sum(float(np.sum(change**2)) for change in changes)
    actual = sum(float(s @ s) for s in scores) * spread_together(scores)
    return float(min(naive / actual, 1.0)) if actual > 0 else 1.0

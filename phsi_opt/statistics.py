"""P-values, and what residuals that are correlated in time can tell.

Tails and limits of distributions come from `scipy.special`: they are the numbers of
`scipy.stats`, whose import takes longer than all else that the package waits for.

Residuals of a model that is not perfect vary slowly: neighbours say nearly the same.
Tests and criteria that count samples have to count independent values instead. The two
measures of that number stand here because several rooms need them; they know arrays
only, no model and no measurements. So do the peaks of a sequence, and ``TINY``, which
guards divisions everywhere.
"""

from collections.abc import Sequence

import numpy as np
import scipy

# Keeps quotients and logarithms of what may be zero finite; far below every number that
# a measurement or a model can mean, far above the least that float64 can hold.
TINY = 1e-300


def rms(values: np.ndarray) -> float:
    """Root mean square of values (n,)."""
    return float(np.sqrt(np.mean(values**2)))


def local_maxima(values: np.ndarray, last_of_plateau: bool = False) -> np.ndarray:
    """Which values are at least as large as both neighbours, (n,) of bool.

    The first and the last value have one neighbour only.

    Args:
        values: (n,).
        last_of_plateau: of neighbours that are equal, only the last one counts; else
            all of them do.
    """
    padded = np.concatenate([[-np.inf], values, [-np.inf]])
    from_before = values >= padded[:-2]
    to_next = values > padded[2:] if last_of_plateau else values >= padded[2:]
    return np.asarray(from_before & to_next)


def stretches(run: np.ndarray, n_parts: np.ndarray | int) -> np.ndarray:
    """Number of the stretch of each sample when all runs are cut evenly, (n,).

    Args:
        run: (n,) number of the run of each sample, not decreasing.
        n_parts: stretches of each run, one number or (n_runs,).
    """
    count = np.bincount(run)
    parts = np.broadcast_to(n_parts, count.shape)
    first = np.cumsum(count) - count
    before = np.cumsum(parts) - parts
    place = np.arange(len(run)) - first[run]
    return np.asarray(before[run] + place * parts[run] // count[run])


def autocorrelation_time(series: Sequence[np.ndarray]) -> float:
    """Integrated autocorrelation time of several series, in samples; at least 1.

    It says how much more the sum of a series varies than the sum of as many independent
    values of the same size::

        tau = 1 + 2 (rho_1 + rho_2 + ...)

    with the correlations rho_k at lag k, up to the first pair of neighbouring lags
    whose sum is not positive (the initial positive sequence of Geyer, 1992). Where each
    value keeps a share rho of the last one, tau = (1 + rho) / (1 - rho).

    Args:
        series: One array (n_samples,) per trajectory, in the order of time, with a mean
            of zero.

    Returns:
        tau; 1 where the series are empty or zero, or where neighbours alternate.
    """
    # Sums of products at each lag, over all series; zero at two lags more.
    covariances = np.zeros(max(map(len, series), default=0) + 2)
    for values in series:
        covariances[: len(values)] += self_convolved(values)[len(values) - 1 :]
    variance = covariances[0]
    if variance <= 0:
        return 1.0
    n_even = len(covariances) // 2 * 2
    neighbours = covariances[:n_even].reshape(-1, 2)
    pairs = neighbours.sum(axis=1) / variance
    not_positive = np.flatnonzero(pairs <= 0)
    n_pairs = not_positive[0] if len(not_positive) else len(pairs)
    # the first pair is 1 + rho_1: twice the sum of the pairs counts lag 0 twice
    tau = 2 * pairs[:n_pairs].sum() - 1
    return max(float(tau), 1.0)


def autocorrelation(series: Sequence[np.ndarray], n_lags: int) -> np.ndarray:
    """Autocorrelation of several series with a mean of zero, (n_lags + 1,).

    ``r_k = sum_i e_i e_(i+k) / sum_i e_i^2`` over all series (n_samples,), where both
    values are known; as many lags at most as the longest series has, and NaN where all
    values are zero.
    """
    n_lags = min(n_lags, max(map(len, series), default=1) - 1)
    products = np.zeros(n_lags + 1)
    for values in series:
        known = np.nan_to_num(values)
        for lag in range(min(n_lags + 1, len(known))):
            products[lag] += known[lag:] @ known[: len(known) - lag]
    return products / products[0] if products[0] > 0 else np.full(n_lags + 1, np.nan)


def self_convolved(values: np.ndarray) -> np.ndarray:
    """Sums of products of a series (n,) with itself shifted, (2 n - 1,)."""
    n_shifts = max(2 * len(values) - 1, 0)
    if not n_shifts:
        return np.zeros(0)
    n_fft = scipy.fft.next_fast_len(n_shifts, real=True)
    spectrum = scipy.fft.rfft(values, n_fft)
    reversed_spectrum = scipy.fft.rfft(values[::-1], n_fft)
    products = scipy.fft.irfft(spectrum * reversed_spectrum, n_fft)
    return np.asarray(products[:n_shifts])


def chi_square_tail(value: float, freedom: float) -> float:
    """Probability that a chi-square variable of this freedom exceeds the value."""
    return float(scipy.special.chdtrc(freedom, max(value, 0.0)))


def chi_square_limit(level: float, freedom: float) -> float:
    """What a chi-square variable exceeds with the probability ``level``."""
    return float(scipy.special.chdtri(freedom, level))


def ljung_box(series: Sequence[np.ndarray]) -> float:
    """p-value of the hypothesis that residuals are white, by Ljung and Box's test.

    Q = sum over lags k of n (n + 2) r_k^2 / (n - k), with the autocorrelation r_k, is
    chi-square distributed with as many degrees of freedom as there are lags. At most
    ten lags of each series are used, a fifth of its length at most (Ljung and Box,
    Biometrika 65, 1978).

    Args:
        series: residuals in the order of time, one array (n_samples,) per trajectory.

    Returns:
        The p-value; NaN where all series are too short.
    """
    statistic = 0.0
    n_lags = 0
    for residual in series:
        n = len(residual)
        lags = min(10, n // 5)
        n_lags += lags
        power = float(np.sum(residual**2))
        if power <= 0:
            continue
        for lag in range(1, lags + 1):
            correlation = np.sum(residual[lag:] * residual[:-lag]) / power
            statistic += n * (n + 2) * correlation**2 / (n - lag)
    return chi_square_tail(statistic, n_lags) if n_lags else np.nan

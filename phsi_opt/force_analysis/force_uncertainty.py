"""How well an estimate knows its missing force: deviations, certainty, random errors.

All come from the problem linearised at the estimate (`linearized_force`), whose
covariance is that of the force given the measurements.
"""

import numpy as np
from scipy.sparse.linalg import spsolve

from phsi_opt.estimation.missing_force import ForceEstimate, force_deviation
from phsi_opt.statistics import TINY

# Numbers that are held at once while the linearised problem is solved: 240 MB.
MOST_SOLVED = 3e7
# Intervals at which the standard deviation is solved for, at least and at most; it
# changes slowly and is interpolated between them.
FEWEST_DEVIATIONS = 16
MOST_DEVIATIONS = 400


def deviation_of(estimate: ForceEstimate) -> np.ndarray:
    """Standard deviation of the force, (n_intervals, n_forced).

    It is solved for at as many intervals as fit in memory, and interpolated between.
    """
    that_fit = MOST_SOLVED / estimate.linear.n_total
    n_solved = int(np.clip(that_fit, FEWEST_DEVIATIONS, MOST_DEVIATIONS))
    return force_deviation(estimate, n_solved)


def times_noise(estimate: ForceEstimate) -> np.ndarray:
    """Size of the force over its typical (median) standard deviation, (n_forced,).

    Both are those of the last sizes of force and noise: while the force's size still
    falls towards zero, the stored force is that of a larger size, and would seem
    certain.
    """
    linear = estimate.linear
    typical = np.median(deviation_of(estimate), axis=0)
    w = spsolve(linear.L, linear.innovations).reshape(estimate.w.shape)
    rms = np.sqrt(np.mean(w**2, axis=0))
    return np.asarray(rms / np.maximum(typical, TINY))


def error_draws(
    estimate: ForceEstimate, n_draws: int = 24, seed: int = 0
) -> np.ndarray:
    """Random errors of the estimated force, with their correlation in time.

    They are solutions of the linearised problem for random noise and random innovations
    of the prior, whose covariance is that of the force given the measurements.

    Returns:
        (n_intervals, n_forced, n_draws).
    """
    linear = estimate.linear
    rng = np.random.default_rng(seed)
    n_values = linear.seen_of.shape[0]
    n_innovations = linear.L.shape[0]
    noise = rng.normal(size=(n_values, n_draws))
    innovations = rng.normal(size=(n_innovations, n_draws))
    right = np.zeros((linear.n_total, n_draws))
    right[: linear.n_x] = linear.seen_of.T @ noise
    right[linear.force_part] = linear.L.T @ innovations
    errors = linear.factor.solve(right)[linear.force_part]
    return np.asarray(errors).reshape(*estimate.w.shape, n_draws)

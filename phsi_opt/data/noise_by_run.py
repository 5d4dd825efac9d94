"""Noise that differs between trajectories, from the data alone.

What neighbouring samples scatter (`phsi_opt.data.noise`) is known to about 2 over the
root of the number of samples, as a share of itself. Trajectories whose scatter differs
by more than that have noises of their own.
"""

import numpy as np

from phsi_opt.criteria import DIFFERENT_RUNS_LEVEL
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.noise import MEDIAN_OF_NORMAL, initial_noise, scatter_residuals
from phsi_opt.data.resolution import quantisation_noise
from phsi_opt.statistics import chi_square_tail

# Standard deviation of the logarithm of a scatter, times the root of the number of
# samples: that of a median of absolute values of normal residuals is 1.17, and these
# residuals, whose stencils overlap, are worth about a third as many independent ones.
MEDIAN_SPREAD = 2.0
# Samples of a trajectory from which its scatter is asked for.
FEWEST_SAMPLES = 30


def scatter_by_run(data: Measurements) -> np.ndarray:
    """Noise that neighbouring samples show, (n_trajectories, n_states).

    One for all trajectories of a state unless they differ by more than chance.

    Raises:
        DataError: no measured value ever changes.
    """
    together = initial_noise(data)
    scatter = np.tile(together, (data.n_trajectories, 1))
    if data.n_trajectories == 1:
        return scatter
    n_samples = np.array([run.n_samples for run in data.trajectories])
    if n_samples.min() < FEWEST_SAMPLES:
        return scatter
    quantised = quantisation_noise(data)
    for state in range(data.n_states):
        of_state = _of_runs(data, state)
        of_state = np.maximum(of_state, quantised[state])
        is_known = np.all(np.isfinite(of_state)) and np.all(of_state > 0)
        if is_known and _differ(np.log(of_state), MEDIAN_SPREAD**2 / n_samples):
            scatter[:, state] = np.maximum(of_state, together[state] / 100)
    return scatter


def _of_runs(data: Measurements, state: int) -> np.ndarray:
    """What neighbouring samples of each trajectory scatter, (n_trajectories,)."""
    run, residuals = scatter_residuals(data, state)
    lengths = np.bincount(run.astype(int), minlength=data.n_trajectories)
    sizes = np.abs(residuals)
    sizes = sizes[np.lexsort((sizes, run))]
    scatter = np.full(len(lengths), np.nan)
    has_some = lengths > 0
    first = (np.cumsum(lengths) - lengths)[has_some]
    n = lengths[has_some]
    medians = (sizes[first + (n - 1) // 2] + sizes[first + n // 2]) / 2
    scatter[has_some] = medians / MEDIAN_OF_NORMAL
    return scatter


def _differ(values: np.ndarray, variances: np.ndarray) -> bool:
    """Whether values (n,) of known variances scatter more than they should."""
    weights = 1 / variances
    mean = np.sum(weights * values) / np.sum(weights)
    statistic = np.sum(weights * (values - mean) ** 2)
    return chi_square_tail(statistic, len(values) - 1) < DIFFERENT_RUNS_LEVEL

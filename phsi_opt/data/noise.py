"""A first guess of the measurement noise, from the data alone.

Each sample is predicted by the cubic through its four neighbours; what is left is noise
(and curvature that the sampling does not resolve, which is why this is only a first
guess: `missing_force` estimates the noise with a model). What quantisation alone makes
counts as noise at least, unless the noise is declared.

What neighbouring samples scatter is known to about 2 over the root of the number of
samples, as a share of itself. Trajectories whose scatter differs by more than that have
noises of their own.
"""

from itertools import compress
from operator import attrgetter

import numpy as np

from phsi_opt.criteria import RESOLVED_STEPS, SURE_LEVEL
from phsi_opt.data.channel_noise import DEVIATION_PER_STEP, robust_deviation
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError
from phsi_opt.presentation.units import scale_of, spaced
from phsi_opt.statistics import chi_square_tail

# least noise that is assumed, as a share of the spread of a channel: weights stay
# within double precision
LEAST_NOISE_SHARE = 1e-5
LEAST_SIZE = 1e-12  # taken for the size of a channel that is zero throughout, its unit


def difference_noise(data: Measurements) -> np.ndarray:
    """Standard deviation of the noise per state, from differences of neighbours.

    The residual of a sample against the cubic through its four neighbours, divided by
    the standard deviation that noise of unit size would give it::

        r_i = (y_i - sum_j w_j y_(i+j)) / sqrt(1 + sum_j w_j^2),    j = -2, -1, 1, 2
        sigma = median |r_i| / 0.6745

    At least what quantisation makes of the values: most differences of a slow signal
    are then zero. (n_states,), NaN with fewer than 5 samples in every trajectory.
    """
    return _of_states(data, "noise")


def initial_noise(data: Measurements, given: np.ndarray | None = None) -> np.ndarray:
    """Noise per state, (n_states,), from differences of the data, or as given.

    A tenth of the spread, from which the estimation comes down, where NaN is given, and
    where no trajectory has enough samples for differences. At least `least_noise`; 1
    where nothing was measured.
    """
    y = data.stacked("x")
    highest = np.fmax.reduce(y)  # NaN is not measured
    if not (highest > np.fmin.reduce(y)).any():
        told = []
        for name in data.measured:
            scale = scale_of(data.units.get(name, ""))
            value = scale.shown(highest[data.states.index(name)])
            told.append(f"{name} is always {value:g}{spaced(scale.unit)}")
        raise DataError(
            f"{', '.join(told)}: nothing moves, so nothing can be identified. "
            "Check the columns, or measure while the system moves."
        )
    spread = channel_spread(data)
    noise = difference_noise(data) if given is None else given
    unknown = 0.1 * np.where(spread > 0, spread, _size(y))
    noise = np.where(np.isfinite(noise), noise, unknown)
    noise = np.maximum(noise, least_noise(y))
    quantised = quantisation_noise(data)
    if given is not None:
        quantised[np.isfinite(given)] = 0.0
    noise = np.maximum(noise, quantised)
    return np.where(np.isfinite(highest), noise, 1.0)


def least_noise(y: np.ndarray) -> np.ndarray:
    """Least noise that is assumed, (n_states,): without any, weights were infinite."""
    spread = _spread(y)
    size = _size(y)
    moves = spread > 1e-12 * size  # else it is nothing but rounding
    return LEAST_NOISE_SHARE * np.where(moves, spread, size)


def channel_spread(data: Measurements) -> np.ndarray:
    """Standard deviation of the measured values per state, (n_states,).

    1 where nothing was measured.
    """
    return _spread(data.stacked("x"))


def _spread(y: np.ndarray) -> np.ndarray:
    spread = np.ones(y.shape[1])
    is_measured = np.isfinite(y)
    for k in np.flatnonzero(is_measured.any(axis=0)):
        spread[k] = np.std(y[is_measured[:, k], k])
    return spread


def _size(y: np.ndarray) -> np.ndarray:
    """Largest absolute value per channel, (n_states,), not zero in its unit."""
    return np.fmax(np.fmax.reduce(np.abs(y), axis=0), LEAST_SIZE)


def scatter_by_run(data: Measurements) -> np.ndarray:
    """Noise that neighbouring samples show, (n_trajectories, n_states).

    One for all trajectories of a state unless they differ by more than chance.
    """
    together = initial_noise(data)
    scatter = np.tile(together, (data.n_trajectories, 1))
    if data.n_trajectories == 1:
        return scatter
    n_samples = np.array([run.n_samples for run in data.trajectories])
    if n_samples.min() < 30:  # few samples tell no scatter
        return scatter
    # The logarithm of a median of absolute values of normal residuals has a standard
    # deviation of 1.17 over the root of their number; and these residuals, whose
    # stencils overlap, are worth about a third as many independent ones.
    variances = 2.0**2 / n_samples
    quantised = quantisation_noise(data)
    for state in range(data.n_states):
        of_state = _of_runs(data, state)
        of_state = np.maximum(of_state, quantised[state])
        is_known = np.all(np.isfinite(of_state)) and np.all(of_state > 0)
        if is_known and _differ(np.log(of_state), variances):
            scatter[:, state] = np.maximum(of_state, together[state] / 100)
    return scatter


def _of_runs(data: Measurements, state: int) -> np.ndarray:
    """What neighbouring samples of each trajectory scatter, (n_trajectories,)."""
    run, residuals = data.computed_look.channels[state].scatter
    ends = np.searchsorted(run, np.arange(1, data.n_trajectories))
    return np.array(list(map(robust_deviation, np.split(residuals, ends))))


def _differ(values: np.ndarray, variances: np.ndarray) -> bool:
    """Whether values (n,) of known variances scatter more than they should."""
    weights = 1 / variances
    mean = np.sum(weights * values) / np.sum(weights)
    statistic = np.sum(weights * (values - mean) ** 2)
    return chi_square_tail(statistic, len(values) - 1) < SURE_LEVEL


# ---- quantised sensors ---------------------------------------------------------------


def quantisation_noise(data: Measurements) -> np.ndarray:
    """Standard deviation of quantisation alone, (n_states,); 0 where there is none."""
    return DEVIATION_PER_STEP * _of_states(data, "resolution")


def _of_states(data: Measurements, what: str) -> np.ndarray:
    return np.array(list(map(attrgetter(what), data.computed_look.state_looks)))


def unresolved_channels(data: Measurements) -> tuple[str, ...]:
    """Names of the states that move by less than a step (`RESOLVED_STEPS`).

    The errors of their values follow the motion and are no noise.
    """
    steps = _of_states(data, "resolution")
    is_coarse = (steps > 0) & (channel_spread(data) < RESOLVED_STEPS * steps)
    return tuple(compress(data.states, is_coarse))

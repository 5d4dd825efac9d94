"""A first guess of the measurement noise, from the data alone.

Each sample is predicted by the cubic through its four neighbours; what is left is noise
(and curvature that the sampling does not resolve, which is why this is only a first
guess: `missing_force` estimates the noise with a model). What quantisation alone makes
counts as noise at least, unless the noise is declared.

What neighbouring samples scatter is known to about 2 over the root of the number of
samples, as a share of itself. Trajectories whose scatter differs by more than that have
noises of their own.

The resolution of a sensor is the step in which its values are quantised. They stand on
a lattice, offset + k * step, and come back to the same ones. A value has then an error
of up to half a step, of the size ``step / sqrt(12)`` (Widrow, IRE Transactions on
Circuit Theory 3, 1956). Differences of neighbours do not show it where the signal is
slow: most of them are zero. The step is the largest one of which all gaps between
values are multiples (Euclid's algorithm), within the rounding of stored numbers. Values
that were printed with few digits lie on the lattice of the digits; where they leave
most of it empty, a coarser one is sought within half a digit.
"""

from collections.abc import Sequence

import numpy as np

from phsi_opt.criteria import RESOLVED_STEPS, SURE_LEVEL
from phsi_opt.data.measurements import Measurements, worked_out_once
from phsi_opt.errors import DataError
from phsi_opt.statistics import chi_square_tail

NEIGHBOURS = (-2, -1, 1, 2)  # samples through which the cubic goes, from the middle

# least noise that is assumed, as a share of the spread of a channel: weights stay
# within double precision
LEAST_NOISE_SHARE = 1e-5
LEAST_SIZE = 1e-12  # taken for the size of a channel that is zero throughout, its unit
# Errors of a stored number, as a share of the largest one of the channel: of single
# precision, of double precision after a change of unit. The larger one first: single
# precision is a fine lattice itself.
STORED_ERRORS = (
    0.6 * float(np.finfo(np.float32).eps),
    8 * float(np.finfo(np.float64).eps),
)
# Errors between two values below which they are the same value; a finer lattice has a
# point near every value.
SAME_VALUE = 4.0
DEVIATION_PER_STEP = 1 / np.sqrt(12)  # of an error that is uniform over one step


@worked_out_once
def difference_noise(data: Measurements) -> np.ndarray:
    """Standard deviation of the noise per state, from differences of neighbours.

    The residual of a sample against the cubic through its four neighbours, divided by
    the standard deviation that noise of unit size would give it::

        r_i = (y_i - sum_j w_j y_(i+j)) / sqrt(1 + sum_j w_j^2),    j = -2, -1, 1, 2
        sigma = median |r_i| / 0.6745

    At least what quantisation makes of the values: most differences of a slow signal
    are then zero.

    Returns:
        (n_states,) in the states' units; NaN where every trajectory has fewer than 5
        samples of a state.
    """
    noise = np.full(data.n_states, np.nan)
    for k in range(data.n_states):
        _, residuals = scatter_residuals(data, k)
        if len(residuals):
            noise[k] = robust_deviation(residuals)
    return np.maximum(noise, quantisation_noise(data))


@worked_out_once
def scatter_residuals(data: Measurements, state: int) -> np.ndarray:
    """Residuals of samples against the cubic through their neighbours, as `r_i` above.

    Of all trajectories at once: there may be thousands of short ones.

    Returns:
        (2, n_residuals): the number of the trajectory of each, and the residuals;
        n_measured - 4 per trajectory, none where it has too few.
    """
    values = data.stacked("x")[:, state]
    is_measured = np.isfinite(values)
    t = data.stacked("t")[is_measured]
    y = values[is_measured]
    lengths = [run.n_samples for run in data.trajectories]
    run = np.repeat(np.arange(len(lengths)), lengths)[is_measured]
    reach = max(NEIGHBOURS)
    middle = np.arange(reach, len(t) - reach)
    middle = middle[run[middle - reach] == run[middle + reach]]
    return np.vstack([run[middle], _cubic_residuals(t, y, middle)])


def robust_deviation(residuals: np.ndarray) -> float:
    """Standard deviation of normal residuals (n,), through their median.

    The median size of a standard normal number is 0.6745. It is not moved by the few
    samples at a jump of the force.
    """
    return float(np.median(np.abs(residuals)) / 0.6745)


def _cubic_residuals(t: np.ndarray, y: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Residuals of samples ``middle`` (n_middle,), which have neighbours on both sides.

    Times and values are (n_samples,), without gaps.
    """
    at = {offset: t[middle + offset] for offset in (0, *NEIGHBOURS)}
    predicted = np.zeros(len(middle))
    variance = np.zeros(len(middle))  # of the prediction, for noise of unit size
    for offset in NEIGHBOURS:
        weight = np.ones(len(middle))  # in the cubic's value in the middle
        for other in NEIGHBOURS:
            if other != offset:
                weight *= (at[0] - at[other]) / (at[offset] - at[other])
        predicted += weight * y[middle + offset]
        variance += weight**2
    return (y[middle] - predicted) / np.sqrt(1 + variance)


def initial_noise(data: Measurements, given: np.ndarray | None = None) -> np.ndarray:
    """Noise per state to start from: the given one, else from differences of the data.

    Args:
        data: The measurements.
        given: Standard deviations (n_states,), NaN where unknown.

    Returns:
        (n_states,), at least `least_noise`, and at least `quantisation_noise` where
        it was not given; 1 where nothing was measured.

    Raises:
        DataError: no measured value ever changes.
    """
    y = data.stacked("x")
    is_measured = np.isfinite(y).any(axis=0)
    highest = np.fmax.reduce(y[:, is_measured], axis=0)  # NaN is not measured
    lowest = np.fmin.reduce(y[:, is_measured], axis=0)
    if not (highest > lowest).any():
        raise DataError(
            f"every measured value of {', '.join(data.measured)} is the same "
            f"({highest.max():g}): nothing moves, so nothing can be identified. "
            "Check the columns, or measure while the system moves."
        )
    spread = channel_spread(data)
    noise = difference_noise(data) if given is None else given
    # Where no trajectory has enough samples, the estimation starts with a tenth.
    unknown = 0.1 * np.where(spread > 0, spread, _size(y))
    noise = np.where(np.isfinite(noise), noise, unknown)
    noise = np.maximum(noise, least_noise(y))
    is_given = np.zeros(data.n_states, bool) if given is None else np.isfinite(given)
    noise = np.where(is_given, noise, np.maximum(noise, quantisation_noise(data)))
    return np.where(is_measured, noise, 1.0)


def least_noise(y: np.ndarray) -> np.ndarray:
    """Least noise that is assumed per channel: without any, weights would be infinite.

    Args:
        y: Measured values (n_samples, n_states), NaN where not measured.

    Returns:
        (n_states,): `LEAST_NOISE_SHARE` of the spread, or of the size where a channel
        does not move.
    """
    spread = _spread(y)
    size = _size(y)
    moves = spread > 1e-12 * size  # else it is nothing but rounding
    return LEAST_NOISE_SHARE * np.where(moves, spread, size)


@worked_out_once
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
    run, residuals = scatter_residuals(data, state)
    scatter = np.full(data.n_trajectories, np.nan)
    ends = np.searchsorted(run, np.arange(1, data.n_trajectories))
    for k, own in enumerate(np.split(residuals, ends)):
        if len(own):
            scatter[k] = robust_deviation(own)
    return scatter


def _differ(values: np.ndarray, variances: np.ndarray) -> bool:
    """Whether values (n,) of known variances scatter more than they should."""
    weights = 1 / variances
    mean = np.sum(weights * values) / np.sum(weights)
    statistic = np.sum(weights * (values - mean) ** 2)
    return chi_square_tail(statistic, len(values) - 1) < SURE_LEVEL


# ---- quantised sensors ---------------------------------------------------------------


@worked_out_once
def quantisation_noise(data: Measurements) -> np.ndarray:
    """Standard deviation that quantisation alone gives the values of each state.

    Returns:
        (n_states,) in the states' units; zero where nothing is quantised.
    """
    steps = np.zeros(data.n_states)
    for k in range(data.n_states):
        steps[k] = resolution([run.x[:, k] for run in data.trajectories])
    return DEVIATION_PER_STEP * steps


def unresolved_channels(data: Measurements) -> tuple[str, ...]:
    """Names of the states that move by less than a step (`RESOLVED_STEPS`).

    The errors of their values follow the motion and are no noise.
    """
    names = []
    steps = quantisation_noise(data) / DEVIATION_PER_STEP
    for name, step, values in zip(data.states, steps, data.stacked("x").T, strict=True):
        if step > 0 and np.nanstd(values) < RESOLVED_STEPS * step:
            names.append(name)
    return tuple(names)


def resolution(runs: Sequence[np.ndarray]) -> float:
    """The step in which the values of a channel are quantised; zero if they are not.

    Where the steps are uneven (a nonlinear scale behind the converter), their median.

    Args:
        runs: values of the channel, one (n_samples,) per trajectory, NaN where not
            measured.
    """
    runs = [values[np.isfinite(values)] for values in runs]
    values = np.concatenate(runs)
    if len(values) < 20:  # among a few, repeats are chance
        return 0.0
    # Of measured channels that are quantised, 5 to 75 % of the values repeat another
    # one of their trajectory; of continuous ones none do.
    if _n_repeated(runs) < 0.03 * len(values):
        return 0.0
    values = np.unique(values)
    step = _even_step(values)
    if step == 0:  # trajectories with different offsets; one that rests is left out
        different = list(map(np.unique, runs))
        steps = [_even_step(own) for own in different if len(own) > 1]
        if len(steps) >= 2 and min(steps) > 0:
            step = float(np.median(steps))
    if step > 0:
        return step
    if len(values) > 1 and _stays_and_comes_back(runs):
        return float(np.median(np.diff(values)))
    return 0.0


def _n_repeated(runs: Sequence[np.ndarray]) -> int:
    """Number of values that stand in their trajectory before."""
    return sum(len(values) - len(np.unique(values)) for values in runs)


def _even_step(values: np.ndarray) -> float:
    """The step of a channel's different values, sorted; zero if they have none."""
    if len(values) < 2:
        return 0.0
    size = float(np.max(np.abs(values)))
    for error in STORED_ERRORS:
        step = lattice_step(values, error * size)
        if step > 0:
            # Of digits printed, unless the values are as dense as these.
            is_sparse = len(values) > 2 and np.diff(values).min() >= 2.5 * step
            return max(lattice_step(values, step / 2), step) if is_sparse else step
    return 0.0


def lattice_step(values: np.ndarray, error: float) -> float:
    """The largest step of a lattice near which all values lie; zero if there is none.

    Args:
        values: (n_values,) sorted, all different.
        error: of a value, at most.
    """
    is_new = np.diff(values) > SAME_VALUE * error
    values = values[np.r_[True, is_new]]
    if len(values) < 2:
        return 0.0
    gaps = np.diff(values)
    step = float(gaps.min())
    while step > SAME_VALUE * error:  # a remainder is at most half of the step
        fitted, distance = _fitted_lattice(values, step, error)
        if distance <= 1.3 * error:  # of a value from what was fitted to all
            # Two values always lie near to one; would more do so by chance, anywhere,
            # in more than one of 10 000 cases?
            chance = (len(values) - 2) * np.log(2 * (error / fitted))
            return fitted if len(values) == 2 or chance < np.log(1e-4) else 0.0
        remainders = np.abs(gaps - np.round(gaps / step) * step)
        is_left = remainders > SAME_VALUE * error
        if not is_left.any():
            break
        step = float(remainders[is_left].min())
    return 0.0


def _fitted_lattice(
    values: np.ndarray, step: float, error: float
) -> tuple[float, float]:
    """The step by least squares, and the largest distance of a value from its lattice.

    Gaps of one step are averaged first, so that long gaps are counted right.

    Args:
        values: (n_values,) sorted.
        step: Good enough to count with.
        error: Of a value, at most.
    """

    def counted(step: float) -> np.ndarray:  # steps from the first value to each
        return np.concatenate([[0.0], np.cumsum(np.round(gaps / step))])

    gaps = np.diff(values)
    single = gaps[gaps <= step + SAME_VALUE * error]
    if len(single):
        step = float(np.mean(single))
    k = counted(step)
    k = k - k.mean()
    fitted = float(k @ (values - values.mean()) / (k @ k))
    away = values - fitted * counted(fitted)
    return fitted, float(np.max(np.abs(away - away.mean())))


def _stays_and_comes_back(runs: Sequence[np.ndarray]) -> bool:
    """Whether the channel stays at values, and comes back to them after others."""
    n_samples = sum(map(len, runs))
    n_equal = sum(int(np.sum(np.diff(values) == 0)) for values in runs)
    # A continuous channel that was sampled and held has one stretch per value; a
    # periodic motion without noise has few equal neighbours.
    comes_back = n_samples - n_equal >= 2 * (n_samples - _n_repeated(runs))
    return comes_back and n_equal >= n_samples / 4

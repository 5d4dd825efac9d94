"""What the samples of one channel tell: their scatter, and the sensor's resolution.

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
from itertools import permutations

import numpy as np

# Errors of a stored number, as a share of the largest one of the channel: of single
# precision, of double precision after a change of unit. The larger one first: single
# precision is a fine lattice itself.
STORED_ERRORS = (
    0.6 * float(np.finfo(np.float32).eps),
    8 * float(np.finfo(np.float64).eps),
)
DEVIATION_PER_STEP = 1 / np.sqrt(12)  # of an error that is uniform over one step


def scatter_of(t: np.ndarray, values: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Residuals of samples against the cubic through their four neighbours.

    Of all trajectories at once: there may be thousands of short ones. (2, n_residuals):
    the number of the trajectory of each, and the residuals.
    """
    is_measured = np.isfinite(values)
    t, values, run = t[is_measured], values[is_measured], run[is_measured]
    middle = np.arange(2, len(t) - 2)
    middle = middle[run[middle - 2] == run[middle + 2]]
    near = middle + np.arange(-2, 3)[:, None]
    # The residual is a multiple of the fourth divided difference; noise of unit size
    # gives it the size of its weights.
    at = t[near]
    products = np.ones(near.shape)
    for one, other in permutations(range(5), 2):
        products[one] *= at[one] - at[other]
    weights = 1 / products
    difference = np.sum(weights * values[near], axis=0)
    return np.vstack([run[middle], difference / np.linalg.norm(weights, axis=0)])


def robust_deviation(residuals: np.ndarray) -> float:
    """Standard deviation of normal residuals (n,), through their median.

    The median size of a standard normal number is 0.6745. It is not moved by the few
    samples at a jump of the force. NaN of none.
    """
    if not len(residuals):
        return np.nan
    return float(np.median(np.abs(residuals)) / 0.6745)


def resolution(runs: Sequence[np.ndarray]) -> float:
    """The step in which the values of a channel are quantised; zero if they are not.

    Where the steps are uneven (a nonlinear scale behind the converter), their median.
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
    if step == 0 and len(values) > 1 and _stays_and_comes_back(runs):
        step = float(np.median(np.diff(values)))
    return step


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
    # Less is between two readings of one value; a finer lattice has a point near each.
    least = 4.0 * error
    is_new = np.diff(values, prepend=-np.inf) > least
    values = values[is_new]
    if len(values) < 2:
        return 0.0
    gaps = np.diff(values)
    step = float(gaps.min())
    while step > least:  # a remainder is at most half of the step
        fitted, distance = _fitted_lattice(values, step, least)
        if distance <= 1.3 * error:  # of a value from what was fitted to all
            # Two values always lie near to one; would more do so by chance, anywhere,
            # in more than one of 10 000 cases?
            chance = (len(values) - 2) * np.log(2 * (error / fitted))
            return fitted if len(values) == 2 or chance < np.log(1e-4) else 0.0
        remainders = np.abs(gaps - np.round(gaps / step) * step)
        is_left = remainders > least
        if not is_left.any():
            break
        step = float(remainders[is_left].min())
    return 0.0


def _fitted_lattice(
    values: np.ndarray, step: float, least: float
) -> tuple[float, float]:
    """The step by least squares, and the largest distance from its lattice."""

    def counted(step: float) -> np.ndarray:  # steps from the first value to each
        return np.append(0.0, np.cumsum(np.round(gaps / step)))

    gaps = np.diff(values)
    single = gaps[gaps <= step + least]
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

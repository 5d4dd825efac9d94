"""Sizes of states and parameters, found from the data.

A solver sees every unknown divided by its size, so that its tolerance means the same
for a position in micrometres and a stiffness in N/m. Sizes follow the units of the data
and need no solve.

Here too are the first states of a search, without an optimisation. What is measured is
interpolated, and moves at rates that differences show; where the model says that a
state which nobody measured makes such a rate (a momentum that of its position), the
state follows from it. These are rough states: their noise is that of differences.
"""

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from phsi_opt.data.noise import LEAST_SIZE
from phsi_opt.model.model import Model
from phsi_opt.statistics import TINY
from phsi_opt.transcription.defects import at_nodes, parameter_slopes, with_matrices
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import STARTING_SCHEME
from phsi_opt.transcription.parameter_vector import Point, Theta
from phsi_opt.transcription.sensors import output_slopes, outputs

# By how much the size of a parameter may differ from its own value. Far from its start,
# in units of its effect, it would meet the solver as a huge number; a frequency inside
# a term whose wave starts with no amplitude shows no effect, and would go anywhere.
MOST_RATIO = 1e3


def first_point(model: Model, grid: Grid, theta: np.ndarray | None = None) -> Point:
    """Measured states interpolated, others zero, with the size of every unknown.

    At parameters theta, (n_free,); None: the model's present values.
    """
    grid = invert_sensors(model, grid)
    theta = model.theta if theta is None else theta
    x = interpolated(grid)
    x_scale = _with_unmeasured_scale(model, grid, theta, x, _measured_scale(grid))
    return Point(theta, x, theta_scale(model, grid, theta, x, x_scale), x_scale)


def point_at(
    model: Model,
    grid: Grid,
    unknown: Theta,
    theta: np.ndarray,
    x: np.ndarray,
    held: Collection[str] = (),
) -> Point:
    """The point of given parameters and states, with the size of each.

    Of theta (n_theta,) and states x (n_nodes, n_states). A solve left the parameters
    ``held`` at their bounds.
    """
    from_data = _measured_scale(invert_sensors(model, grid))
    spread = np.std(x, axis=0)
    from_states = np.where(spread > 0, spread, np.nan)
    x_scale = np.where(grid.measured_states, from_data, from_states)
    means = unknown.means(theta)
    x_scale = _with_unmeasured_scale(model, grid, means, x, x_scale)
    sizes = theta_scale(model, grid, means, x, x_scale, held)
    return Point(theta, x, unknown.spread(sizes), x_scale)


def invert_sensors(model: Model, grid: Grid) -> Grid:
    """The grid with the states behind what the sensors show as what was measured.

    For the parameters' present values, by Newton's method for every channel alone. A
    sensor that does not change with its state says nothing about it: the reading
    itself stays.
    """
    if not model.sensor:
        return grid
    theta = model.theta
    x = grid.y.copy()
    with np.errstate(all="ignore"):
        for _ in range(10):
            finite = np.nan_to_num(x)
            shown = outputs(model, grid, finite, theta)
            slopes = output_slopes(model, grid, finite, theta).in_states
            own_slope = np.einsum("aii->ai", slopes)
            is_steep = np.abs(own_slope) > 1e-6
            step = (grid.y - shown) / np.where(is_steep, own_slope, np.nan)
            x = x + np.where(np.isfinite(step), step, 0.0)
    return replace(grid, y=x)


def theta_scale(
    model: Model,
    grid: Grid,
    theta: np.ndarray,
    x: np.ndarray,
    x_scale: np.ndarray,
    held: Collection[str] = (),
) -> np.ndarray:
    """Size of each parameter, (n_free,): the change that shows in the equations.

    It moves some equation by the size of its own rate, or what a sensor shows by the
    size ``x_scale`` (n_states,) of the state. So it follows the units. Of a parameter
    that a solve left at a bound (``held``) the value says nothing of the size.
    """
    if not len(theta):
        return np.ones(0)
    # The largest effect of each parameter on an equation, in units of its rate.
    rate = _rate_size(grid, x)
    rate = np.where(rate > 0, rate, x_scale)
    known = parameter_slopes(model, grid, STARTING_SCHEME, theta, x)
    slopes = known.slopes.reshape(grid.n_intervals, -1, len(theta))
    n_finite = np.maximum(np.isfinite(slopes).sum(axis=0), 1)
    mean_square = np.nansum(slopes**2, axis=0) / n_finite
    per_equation = np.sqrt(mean_square) / rate[:, None]
    strength = np.nan_to_num(per_equation.max(axis=0))
    if model.sensor:
        slopes = output_slopes(model, *some_nodes(grid, x), theta).in_parameters
        squares = np.square(slopes)
        in_sensors = np.sqrt(np.mean(squares, axis=0)).T @ (1 / x_scale)
        strength = np.maximum(strength, in_sensors)
    own_size = np.where(np.abs(theta) > 0, np.abs(theta), 1.0)
    scale = np.where(strength > 0, 1 / np.maximum(strength, TINY), own_size)
    most = np.full(len(theta), np.inf)
    for place, name in enumerate(model.free):
        says_size = theta[place] != 0 and name not in held
        if says_size and not model.entries[name].prunable:
            most[place] = MOST_RATIO * abs(theta[place])
    return np.clip(scale, 1 / MOST_RATIO * np.abs(theta), most)


def interpolated(grid: Grid) -> np.ndarray:
    """States with their gaps filled along each trajectory, (n_nodes, n_states).

    Zero where a state was never measured.
    """
    x = np.nan_to_num(grid.y)
    is_measured = grid.measured
    with_gaps = np.flatnonzero(~is_measured.all(axis=0))
    for begin, end in grid.spans:
        for k in with_gaps:
            known = begin + np.flatnonzero(is_measured[begin:end, k])
            if len(known):
                x[begin:end, k] = np.interp(
                    grid.t[begin:end], grid.t[known], grid.y[known, k]
                )
    return x


def _measured_scale(grid: Grid) -> np.ndarray:
    """Spread of each state, or size where constant, (n_states,); NaN: unmeasured."""
    scale = np.full(grid.y.shape[1], np.nan)
    for k in np.flatnonzero(grid.measured_states):
        deviation = np.nanstd(grid.y[:, k])
        mean = float(np.nanmean(grid.y[:, k]))
        scale[k] = deviation if deviation > 0 else max(abs(mean), LEAST_SIZE)
    return scale


def _with_unmeasured_scale(
    model: Model, grid: Grid, theta: np.ndarray, x: np.ndarray, scale: np.ndarray
) -> np.ndarray:
    """Sizes with those of the states that nobody measured, where one is NaN."""
    # A state is as large as the measured rates that it drives through the model say;
    # one where it drives none.
    if np.all(np.isfinite(scale)):
        return scale
    known = np.flatnonzero(np.isfinite(scale))
    rate = _rate_size(grid, x)
    # Away from the origin, where a higher-order term has no slope.
    shifted = x + np.where(np.all(x == 0, axis=0), 1.0, 0.0)
    found = rates_and_slopes(model, *some_nodes(grid, shifted), theta)[1]
    with np.errstate(over="ignore"):
        squares = np.square(found)
    # Where a slope has no number (a corner as sharp as a step) it says nothing.
    is_number = np.isfinite(squares)
    n_numbers = np.maximum(np.sum(is_number, axis=0), 1)
    slopes = np.sqrt(np.sum(np.where(is_number, squares, 0.0), axis=0) / n_numbers)
    result = scale.copy()
    for k in np.flatnonzero(~np.isfinite(scale)):
        driven = known[slopes[known, k] > 0]
        sizes = rate[driven] / slopes[driven, k]
        result[k] = np.min(sizes) if len(sizes) else 1.0
    return result


def _rate_size(grid: Grid, x: np.ndarray) -> np.ndarray:
    """Root mean square of each state's rate, (n_states,)."""
    # Over 200 stretches of a record, where the noise of a sample no longer dominates.
    stride = max(1, grid.n_nodes // 200)
    is_inside = grid.trajectory[:-stride] == grid.trajectory[stride:]
    if is_inside.any():
        duration = (grid.t[stride:] - grid.t[:-stride])[is_inside]
        change = (x[stride:] - x[:-stride])[is_inside]
        rates = change / duration[:, None]
    else:
        rates = grid.rates(x)
    return np.sqrt(np.mean(np.square(rates), axis=0))


def some_nodes(grid: Grid, x: np.ndarray) -> tuple[Grid, np.ndarray]:
    """Evenly spread nodes of a grid, enough for a mean slope, and the states there."""
    nodes = np.linspace(0, grid.n_nodes - 1, 25).astype(int)
    return grid.intervals(nodes[:0]).at_nodes(nodes), x[nodes]


# ---- states by kinematics ----------------------------------------------------------


def kinematic_states(model: Model, grid: Grid) -> tuple[np.ndarray, bool]:
    """States at the nodes for the model's present parameters.

    Those that make the rates of measured states follow from these; in turn those that
    make the rates of them, and so on. Gaps are interpolated; a trajectory of a channel
    is never extrapolated beyond its last value. A memory stays at zero.

    Returns:
        (n_nodes, n_states) rough states, zero where nothing tells them, and whether
        every state is measured or follows, but for a memory.
    """
    grid = invert_sensors(model, grid)
    x = interpolated(grid)
    known = np.flatnonzero(grid.measured_states)
    no_memory = [k for k, name in enumerate(model.states) if name not in model.memory]
    unknown = np.setdiff1d(no_memory, known)
    while len(unknown) and len(known):
        _, slopes = rates_and_slopes(model, grid, x, model.theta)
        mean_square = np.mean(slopes[:, known][:, :, unknown] ** 2, axis=(0, 1))
        # Those that make a rate of a known one.
        found = unknown[np.isfinite(mean_square) & (mean_square > TINY)]
        if not len(found) or not _follow(model, grid, x, known, found):
            break
        known = np.union1d(known, found)
        unknown = np.setdiff1d(unknown, found)
    return x, not len(unknown)


def _follow(
    model: Model, grid: Grid, x: np.ndarray, known: np.ndarray, unknown: np.ndarray
) -> bool:
    """Set the unknown states to what makes the rates of the known ones; if it can."""
    rates = np.zeros((grid.n_nodes, len(known)))
    for begin, end in grid.spans:
        if end - begin > 1:
            run = slice(begin, end)
            rates[run] = np.gradient(x[run][:, known], grid.t[run], axis=0)
    weights = 1 / np.maximum(np.std(rates, axis=0), TINY)
    found = x.copy()
    for _ in range(3):  # Newton's steps; one is exact where the rates are linear
        values, slopes = rates_and_slopes(model, grid, found, model.theta)
        missing = (rates - values[:, known]) * weights
        of_unknown = slopes[:, known][:, :, unknown] * weights[:, None]
        step = _least_squares_steps(of_unknown, missing)
        if step is None:
            return False
        found[:, unknown] += step
        if np.max(np.abs(step)) < 1e-4 * np.max(np.abs(found[:, unknown])):
            break  # they are a start
    x[:, unknown] = found[:, unknown]
    return True


def rates_and_slopes(
    model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rates (n_nodes, n_states), and slopes (n_nodes, n_states, n_states) in states."""
    grid = grid.driven(model, theta)
    rates, slopes = with_matrices(at_nodes(model.rhs_slopes("x"), grid, x, theta))
    return rates, slopes


def _least_squares_steps(slopes: np.ndarray, missing: np.ndarray) -> np.ndarray | None:
    """Steps (n_nodes, n_unknown) that bring the rates nearest to what is missing."""
    # By slopes (n_nodes, n_known, n_unknown), of what is missing (n_nodes, n_known).
    # None where the slopes leave a direction open, or are not finite.
    gram = np.einsum("aki,akj->aij", slopes, slopes)
    mean = np.mean(gram, axis=0)
    if not np.all(np.isfinite(mean)):
        return None
    # Share of the largest curvature of the rates' squares below which they leave a
    # direction of the states open.
    least = 1e-6
    size = np.sqrt(np.maximum(np.diag(mean), TINY))
    curvatures = np.linalg.eigvalsh(mean / np.outer(size, size))
    if np.diag(mean).min() <= TINY or curvatures[0] < least:
        return None
    ridge = least * np.diag(size**2)
    right = np.einsum("aki,ak->ai", slopes, missing)
    step = np.linalg.solve(gram + ridge, right[:, :, None])[:, :, 0]
    return step if np.all(np.isfinite(step)) else None

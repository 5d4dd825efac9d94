"""TODO."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.statistics import TINY
from phsi_opt.transcription.defects import defect_jacobian
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import STARTING_SCHEME
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.point import Point
from phsi_opt.transcription.sensors import output_slopes, outputs

SHALLOW = 1e-6  # slope of a sensor below which it says nothing about its state


def first_point(model: Model, grid: Grid, theta: np.ndarray | None = None) -> Point:
    """Measured states interpolated, others zero, with the size of every state taken
    from the data.
    """
    grid = invert_sensors(model, grid)
    x, scale, measured = (
        np.nan_to_num(grid.y),
        np.full(model.n_states, np.nan),
        grid.measured,
    )
    runs = list(pairwise([*grid.first.tolist(), grid.n_nodes]))
    for k in range(model.n_states):
        for begin, end in runs if not measured[:, k].all() else []:
            node, seen = (
                np.arange(begin, end),
                begin + np.flatnonzero(measured[begin:end, k]),
            )
            if len(seen):
                x[node, k] = np.interp(grid.t[node], grid.t[seen], grid.y[seen, k])
        if measured[:, k].any():
            spread = np.nanstd(grid.y[:, k])
            scale[k] = (
                spread
                if spread > 0
                else max(abs(float(np.nanmean(grid.y[:, k]))), 1e-12)
            )
    theta = model.theta if theta is None else theta
    scale = _unmeasured_scale(model, grid, theta, x, scale)
    return Point(theta, x, theta_scale(model, grid, theta, x, scale), scale)


def point_at(
    model: Model, grid: Grid, unknown: Theta, theta: np.ndarray, x: np.ndarray
) -> Point:
    """The point of theta (in the order of ``unknown``) and the states x at the nodes,
    with the size of each.
    """
    measured = first_point(model, grid).x_scale
    x_scale = np.where(
        grid.measured.any(axis=0), measured, np.maximum(np.std(x, axis=0), 1e-12)
    )
    sizes = theta_scale(model, grid, unknown.means(theta), x, x_scale)
    return Point(theta, x, unknown.spread(sizes), x_scale)


def invert_sensors(model: Model, grid: Grid) -> Grid:
    """The grid with the states that the sensors, with the parameters' present values,
    show as what was measured.
    """
    if not model.sensor:
        return grid
    theta, x = model.theta, grid.y.copy()
    with np.errstate(all="ignore"):
        for _ in range(10):  # Newton's method for every channel alone
            missed = (
                grid.y - np.array(outputs(model, grid, np.nan_to_num(x).T, theta)).T
            )
            slope = np.einsum(
                "aii->ai", output_slopes(model, grid, np.nan_to_num(x), theta).in_states
            )
            step = missed / np.where(np.abs(slope) > SHALLOW, slope, np.nan)
            x = x + np.where(np.isfinite(step), step, 0.0)
    return replace(grid, y=x)


def _unmeasured_scale(
    model: Model, grid: Grid, theta: np.ndarray, x: np.ndarray, scale: np.ndarray
) -> np.ndarray:
    """Size of a state that nobody measured: what the measured rates say through the
    model, else one.
    """
    if np.all(np.isfinite(scale)):
        return scale
    known = np.isfinite(scale)
    rate = np.sqrt(np.mean(np.square(_smooth_rates(grid, x)), axis=0))
    slopes = np.abs(_state_slopes(model, grid, theta, x))
    result = scale.copy()
    for k in np.flatnonzero(~known):
        ratios = [
            rate[i] / slopes[i, k] for i in np.flatnonzero(known) if slopes[i, k] > 0
        ]
        result[k] = min(ratios) if ratios else 1.0
    return result


def _smooth_rates(grid: Grid, x: np.ndarray) -> np.ndarray:
    """Rates over longer stretches, where the noise of a sample no longer dominates."""
    stride = max(1, grid.n_nodes // 200)
    same = grid.trajectory[:-stride] == grid.trajectory[stride:]
    span = (grid.t[stride:] - grid.t[:-stride])[same]
    return (
        (x[stride:] - x[:-stride])[same] / span[:, None]
        if same.any()
        else grid.rates(x)
    )


def _state_slopes(
    model: Model, grid: Grid, theta: np.ndarray, x: np.ndarray
) -> np.ndarray:
    rhs = model.rhs()
    jacobian = rhs.jacobian()
    rows = np.linspace(0, grid.n_nodes - 1, 25).astype(int)
    # Away from the origin, where a higher-order term has no slope.
    shifted = x + np.where(np.all(x == 0, axis=0), 1.0, 0.0)
    slopes = [
        np.array(jacobian(shifted[i], grid.u[i], grid.t[i], theta, 0)[0]) for i in rows
    ]
    return np.sqrt(np.mean(np.nan_to_num(np.square(slopes)), axis=0))


def theta_scale(
    model: Model, grid: Grid, theta: np.ndarray, x: np.ndarray, x_scale: np.ndarray
) -> np.ndarray:
    """Size of each parameter: the change that moves some equation by the size of its
    own rate. Follows the units.
    """
    if not len(theta):
        return np.ones(0)
    rate = np.sqrt(np.mean(np.square(_smooth_rates(grid, x)), axis=0))
    rate = np.where(rate > 0, rate, x_scale)
    jacobian = np.array(defect_jacobian(model, grid, STARTING_SCHEME)(x.T, theta))
    slopes = jacobian.reshape(grid.n_intervals, -1, len(theta))
    n_finite = np.maximum(np.isfinite(slopes).sum(axis=0), 1)
    per_equation = np.sqrt(np.nansum(slopes**2, axis=0) / n_finite) / rate[:, None]
    strength = np.nan_to_num(per_equation.max(axis=0))
    if (
        model.sensor
    ):  # a sensor's parameter moves what is shown, by the size of the state
        strength = np.maximum(
            strength, _sensor_strength(model, grid, theta, x) @ (1 / x_scale)
        )
    fallback = np.where(np.abs(theta) > 0, np.abs(theta), 1.0)
    scale = np.where(strength > 0, 1 / np.maximum(strength, TINY), fallback)
    # A parameter far from its start in units of its effect would meet the solver as a
    # huge number.
    return np.maximum(scale, 1e-3 * np.abs(theta))


def _sensor_strength(
    model: Model, grid: Grid, theta: np.ndarray, x: np.ndarray
) -> np.ndarray:
    """Root mean square over the nodes of the slope of what is shown in each parameter,
    (n_free, n_states).
    """
    slopes, rows = (
        model.output().jacobian(),
        np.linspace(0, grid.n_nodes - 1, 50).astype(int),
    )
    found = [np.array(slopes(x[i], grid.u[i], grid.t[i], theta, 0)[3]) for i in rows]
    return np.sqrt(np.mean(np.square(found), axis=0)).T


def with_states(grid: Grid, x: np.ndarray) -> Grid:
    """The grid as if x had been measured at every node."""
    return replace(grid, y=x)

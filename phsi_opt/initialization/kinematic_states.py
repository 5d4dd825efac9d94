"""States from the measurements and the model's own kinematics, without an optimisation.

What is measured moves at rates that differences show; where the model says that a state
which nobody measured makes such a rate (a momentum that of its position), the state
follows from it. These are rough states to start from: their noise is that of
differences.
"""

from itertools import pairwise

import casadi as ca
import numpy as np

from phsi_opt.initialization.scaling import interpolated, invert_sensors
from phsi_opt.model.model import Model
from phsi_opt.statistics import TINY
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.interval_map import argument_symbols, at_nodes

KINEMATIC_STEPS = 3  # of Newton's method; one is exact where the rates are linear
# Share of the largest curvature of the rates' squares below which they leave a
# direction of the states open.
LEAST_CURVATURE = 1e-6
SETTLED_STATES = 1e-4  # share of them that the last step moves: they are a start


def kinematic_states(model: Model, grid: Grid) -> np.ndarray | None:
    """States at the nodes, (n_nodes, n_states), for the model's present parameters.

    Gaps are interpolated; a trajectory of a channel is never extrapolated beyond its
    last value.

    Args:
        model: the model; its memory does not follow from rates.
        grid: one interval between neighbouring samples.

    Returns:
        None where some state follows from no rate of a measured one.
    """
    grid = invert_sensors(model, grid)
    x = interpolated(grid)
    known = np.flatnonzero(grid.measured.any(axis=0))
    unknown = np.setdiff1d(np.arange(model.n_states), known)
    if not len(unknown):
        return x
    if model.memory or not len(known):
        return None
    rates = _rates(grid, x[:, known])
    weights = 1 / np.maximum(np.std(rates, axis=0), TINY)
    together = model.built("rates and slopes", lambda: _with_slopes(model.rhs()))
    for _ in range(KINEMATIC_STEPS):
        values, entries = at_nodes(together, grid, x.T, model.theta)
        shape = (grid.n_nodes, model.n_states, model.n_states)
        slopes = entries.T.reshape(shape)[:, known][:, :, unknown]
        missing = (rates - values.T[:, known]) * weights
        step = _least_squares_steps(slopes * weights[:, None], missing)
        if step is None:
            return None
        x[:, unknown] += step
        if np.max(np.abs(step)) < SETTLED_STATES * np.max(np.abs(x[:, unknown])):
            break
    return x


def _rates(grid: Grid, x: np.ndarray) -> np.ndarray:
    """Differences over time along every trajectory, in the shape of x (n_nodes, k)."""
    rates = np.zeros(x.shape)
    for begin, end in pairwise([*grid.first.tolist(), grid.n_nodes]):
        if end - begin > 1:
            rates[begin:end] = np.gradient(x[begin:end], grid.t[begin:end], axis=0)
    return rates


def _least_squares_steps(slopes: np.ndarray, missing: np.ndarray) -> np.ndarray | None:
    """Steps (n_nodes, n_unknown) that bring the rates nearest to what is missing.

    Args:
        slopes: (n_nodes, n_known, n_unknown).
        missing: (n_nodes, n_known).

    Returns:
        None where the slopes leave a direction open, or are not finite.
    """
    gram = np.einsum("aki,akj->aij", slopes, slopes)
    mean = np.mean(gram, axis=0)
    if not np.all(np.isfinite(mean)):
        return None
    size = np.sqrt(np.maximum(np.diag(mean), TINY))
    curvatures = np.linalg.eigvalsh(mean / np.outer(size, size))
    if np.diag(mean).min() <= TINY or curvatures[0] < LEAST_CURVATURE:
        return None
    ridge = LEAST_CURVATURE * np.diag(size**2)
    right = np.einsum("aki,ak->ai", slopes, missing)
    step = _solved(gram + ridge, right)
    return step if np.all(np.isfinite(step)) else None


def _solved(matrices: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solutions (n, k) of a small system each; of one unknown without LAPACK."""
    if right.shape[1] == 1:
        return right / matrices[:, :, 0]
    return np.asarray(np.linalg.solve(matrices, right[:, :, None])[:, :, 0])


def _with_slopes(rhs: ca.Function) -> ca.Function:
    """(x, u, t, theta) -> rates, and their slopes in the states row by row."""
    arguments = argument_symbols(rhs)
    rates = rhs(*arguments)
    slopes = ca.densify(ca.jacobian(rates, arguments[0]).T)
    return ca.Function("rates", arguments, [rates, ca.vec(slopes)])

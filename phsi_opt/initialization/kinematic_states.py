"""States from the measurements and the model's own kinematics, without an optimisation.

What is measured moves at rates that differences show; where the model says that a state
which nobody measured makes such a rate (a momentum that of its position), the state
follows from it. These are rough states to start from: their noise is that of
differences.
"""

import numpy as np

from phsi_opt.initialization.scaling import interpolated, invert_sensors
from phsi_opt.model.model import Model
from phsi_opt.statistics import TINY
from phsi_opt.transcription.defects import at_nodes
from phsi_opt.transcription.grid import Grid

# Share of the largest curvature of the rates' squares below which they leave a
# direction of the states open.
LEAST_CURVATURE = 1e-6


def kinematic_states(model: Model, grid: Grid) -> tuple[np.ndarray, bool]:
    """States at the nodes for the model's present parameters.

    Those that make the rates of measured states follow from these; in turn those that
    make the rates of them, and so on. Gaps are interpolated; a trajectory of a channel
    is never extrapolated beyond its last value. A memory stays at zero.

    Args:
        model: the model.
        grid: one interval between neighbouring samples.

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
        _, slopes = _rates_and_slopes(model, grid, x)
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
    rates = _rates(grid, x[:, known])
    weights = 1 / np.maximum(np.std(rates, axis=0), TINY)
    found = x.copy()
    for _ in range(3):  # Newton's steps; one is exact where the rates are linear
        values, slopes = _rates_and_slopes(model, grid, found)
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


def _rates_and_slopes(
    model: Model, grid: Grid, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rates (n_nodes, n_states), and slopes (n_nodes, n_states, n_states) in states."""
    values, entries = at_nodes(model.rhs_slopes("x"), grid, x.T, model.theta)
    n = model.n_states
    return values.T, entries.T.reshape(grid.n_nodes, n, n)


def _rates(grid: Grid, x: np.ndarray) -> np.ndarray:
    """Differences over time along every trajectory, in the shape of x (n_nodes, k)."""
    rates = np.zeros(x.shape)
    for begin, end in grid.spans:
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
    step = np.linalg.solve(gram + ridge, right[:, :, None])[:, :, 0]
    return step if np.all(np.isfinite(step)) else None

"""TODO."""

from itertools import pairwise

import numpy as np

from phsi_opt.estimation.problem import State
from phsi_opt.statistics import TINY
from phsi_opt.transcription.defects import local_errors
from phsi_opt.transcription.elimination import regularized_inverse
from phsi_opt.transcription.grid import steps_per_gap

MOST_STEPS = 64  # intervals between two samples
VISIBLE = (
    0.1  # integration error that is refined: share of a standard error, or of the noise
)


def finer_steps(state: State) -> list[np.ndarray] | None:
    """More steps where the integration error moves the estimates, or residuals, by more
    than `VISIBLE`; else None.

    The error of each step, against a finer integration, offsets the constraints; the
    linearised likelihood says what that does to the estimates. The number of steps
    grows with the fourth root of an interval's error (order four).
    """
    grid, unknown = state.grid, state.unknown
    error = local_errors(
        state.model, grid, state.nodes, np.asarray(unknown.by_trajectory(state.theta))
    )
    lost = ~np.isfinite(error).all(axis=1)
    scaled = np.where(lost[:, None], 0.0, error / state.point.x_scale)
    held = [
        i
        for i, name in enumerate(unknown.names)
        if name in state.solution.outcome.at_bounds
    ]
    covariance = regularized_inverse(state.reduced.information, held)
    shift = state.reduced.respond(scaled.ravel(), covariance)
    # In standard errors of the direction in which it is largest: many small shifts of
    # one sign add up.
    moved = np.sqrt(
        max(float(shift.theta @ state.reduced.information @ shift.theta), 0.0)
    )
    shown = (shift.x.reshape(grid.y.shape) * state.point.x_scale / state.sigma)[
        grid.measured
    ]
    visible = max(moved, float(np.sqrt(np.mean(shown**2))))
    if visible < VISIBLE and not lost.any():
        return None
    size = np.linalg.norm(scaled, axis=1)
    typical = np.sum(size**2) / max(np.sum(size), TINY)
    wanted = np.ceil((1.2 * visible / VISIBLE * size / max(typical, TINY)) ** 0.25)
    wanted = np.where(lost, 4, np.clip(wanted, 1, 16)).astype(int)
    old = steps_per_gap(grid)
    gap = np.repeat(np.arange(sum(map(len, old))), np.concatenate(old))
    factor = np.ones(sum(map(len, old)), dtype=int)
    np.maximum.at(factor, gap, wanted)
    edges = np.cumsum([0, *map(len, old)]).tolist()
    new = [
        np.minimum(n * factor[a:b], MOST_STEPS)
        for n, (a, b) in zip(old, pairwise(edges), strict=True)
    ]
    return (
        None
        if all(np.array_equal(n, m) for n, m in zip(old, new, strict=True))
        else new
    )

"""Defects: what is left of the model's equations over every interval of a grid.

The defect of an interval is (x1 - x0)/h - Psi(g; x0, x1), where g is the right-hand
side of the model and Psi the mean derivative of a scheme (`integrators`). Every loss is
made from them. Their second derivatives, and the first ones interval by interval, are
in `defect_derivatives`.
"""

from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import integrator
from phsi_opt.transcription.interval_map import (
    in_intervals,
    interval_arguments,
    known_arguments,
    map_intervals,
)

FINE_STEPS = 8  # of RK4 along the interval by which one step of a scheme is checked


def interval_symbols(model: Model) -> list[ca.SX]:
    """Of one interval: start, length, inputs at both ends, parameters."""
    sizes = {"t0": 1, "h": 1, "u0": model.n_inputs, "u1": model.n_inputs}
    symbols = [ca.SX.sym(name, size) for name, size in sizes.items()]
    return [*symbols, ca.SX.sym("theta", len(model.free))]


def rates_within(rhs: ca.Function, interval: list[ca.SX], x: Any, share: Any) -> Any:
    """Right-hand side at a state, where a share of the interval lies behind."""
    t0, h, u0, u1, theta = interval
    return rhs(x, u0 + share * (u1 - u0), t0 + share * h, theta)


def defect(model: Model, scheme: str, n_moving: int | None = None) -> ca.Function:
    """CasADi function of one interval, (x0, x1, t0, h, u0, u1, theta) -> defect d.

    ::

        d = (x1 - x0)/h - Psi(g; x0, x1)

    Args:
        model: the model whose right-hand side is g.
        scheme: name of the integrator.
        n_moving: only the first so many states move along the interval; the others
            keep what x0 and x1 say. None: all move.

    Raises:
        ModelError: there is no integrator of that name.
    """
    key = ("defect", scheme, n_moving)
    return model.built(key, lambda: _defect(model, scheme, n_moving))


def _defect(model: Model, scheme: str, n_moving: int | None) -> ca.Function:
    n_states = model.n_states
    rhs = model.rhs()
    psi = integrator(scheme).psi
    x0 = ca.SX.sym("x0", n_states)
    x1 = ca.SX.sym("x1", n_states)
    interval = interval_symbols(model)

    def g(x: Any, share: float) -> Any:
        rates = rates_within(rhs, interval, x, share)
        if n_moving is None:
            return rates
        return ca.vertcat(rates[:n_moving], ca.SX.zeros(n_states - n_moving))

    h = interval[1]
    value = (x1 - x0) / h - psi(g, x0, x1, h)
    names = ["x0", "x1", "t0", "h", "u0", "u1", "theta"]
    arguments = [x0, x1, *interval]
    return ca.Function("defect", arguments, [ca.densify(value)], names, ["d"])


def defects(
    model: Model,
    grid: Grid,
    scheme: str,
    x: Any,
    theta: Any,
) -> Any:
    """Defects of all intervals, (n_states, n_intervals).

    Args:
        model: the model.
        grid: nodes and intervals.
        scheme: name of the integrator.
        x: (n_states, n_nodes) states, symbols or numbers.
        theta: (n_free,) parameters, or (n_free, n_trajectories) where trajectories
            have parameters of their own.
    """
    function = defect(model, scheme)
    return map_intervals(function, grid, interval_arguments(grid, x), theta)


def local_errors(
    model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """What one step of the scheme misses of the exact solution.

    For states that obey the scheme. The exact end of an interval is found by
    `FINE_STEPS` steps of RK4 from its beginning.

    Args:
        model: the model.
        grid: nodes and intervals.
        x: (n_nodes, n_states) states at the nodes.
        theta: (n_free,) parameters, or (n_free, n_trajectories).

    Returns:
        (n_intervals, n_states) exact end minus state at the end; NaN where the exact
        solution leaves the range of numbers.
    """
    return _ends(model, grid, x, theta) - x[grid.begin + 1]


def between_samples(
    model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """States at all nodes, those between samples as the model goes on from a sample.

    So the model is violated at the ends of gaps alone: a straight line would cut the
    corners of dry friction, and a search that begins there does not come back.

    Args:
        model: the model.
        grid: nodes and intervals, those of every gap between samples.
        x: (n_samples, n_states) states at the samples of all trajectories.
        theta: (n_free,) parameters, or (n_free, n_trajectories).

    Returns:
        (n_nodes, n_states); a state that the model would carry further than it ever
        moves stays.
    """
    if grid.sample.all():
        return x
    place = np.arange(grid.n_nodes)
    behind = place - np.maximum.accumulate(np.where(grid.sample, place, 0))
    reach = np.ptp(x, axis=0)
    nodes = np.empty((grid.n_nodes, x.shape[1]))
    nodes[grid.sample] = x
    for n_behind in range(1, int(behind.max()) + 1):
        own = grid.intervals(np.flatnonzero(behind[grid.begin + 1] == n_behind))
        begins = nodes[own.begin]
        ends = _ends(model, own, nodes, theta)
        is_near = np.abs(ends - begins) <= reach
        nodes[own.begin + 1] = np.where(is_near, ends, begins)
    return nodes


def _ends(model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """The exact ends of intervals that begin at states x, (n_intervals, n_states)."""
    exact = model.built("exact", lambda: _fine_integration(model))
    begins = x[grid.begin].T
    (ends,) = in_intervals(exact, grid, [begins, *known_arguments(grid)], theta)
    return ends.T


def _fine_integration(model: Model) -> ca.Function:
    """CasADi function (x0, t0, h, u0, u1, theta) -> x at the end of the interval."""
    rhs = model.rhs()
    psi = integrator("rk4").psi
    x0 = ca.SX.sym("x0", model.n_states)
    n_done = ca.SX.sym("n_done")
    interval = interval_symbols(model)
    h_fine = interval[1] / FINE_STEPS

    def g(at: Any, c: float) -> Any:
        return rates_within(rhs, interval, at, (n_done + c) / FINE_STEPS)

    behind = x0 + h_fine * psi(g, x0, x0, h_fine)
    step = ca.Function("step", [x0, n_done, *interval], [behind])
    x = x0
    for k in range(FINE_STEPS):
        x = step(x, k, *interval)
    return ca.Function("exact", [x0, *interval], [x])

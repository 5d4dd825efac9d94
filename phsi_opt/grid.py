"""Measurements laid out for a program: nodes where the states live, and the intervals between them.

All trajectories stand one after the other; an interval joins two nodes of one trajectory. Between samples there may be
further nodes, so that the integration error stays small where the sampling is coarse. Here, and only here, the user's
rows (n_samples, n_states) become CasADi's columns.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from scipy.sparse import bsr_matrix

from phsi_opt.integrators import integrator
from phsi_opt.measurements import Measurements, Trajectory
from phsi_opt.model import Model
from phsi_opt.theta import Theta

FINE = 8  # steps of the integration that checks one step of a scheme


@dataclass(frozen=True, eq=False)
class Grid:
    """Nodes and intervals. Arrays are (n_nodes, ...) or (n_intervals, ...); y is NaN where nothing was measured."""

    t: np.ndarray
    y: np.ndarray
    trajectory: np.ndarray  # number of the trajectory of each node
    sample: np.ndarray  # whether the node is a sample
    begin: np.ndarray  # first node of each interval
    h: np.ndarray
    u0: np.ndarray  # input at the two ends of the interval, equal for zero-order hold
    u1: np.ndarray
    u: np.ndarray  # input at each node

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.t)

    @property
    def n_intervals(self) -> int:
        """Number of intervals."""
        return len(self.h)

    @property
    def measured(self) -> np.ndarray:
        """Where a state was measured, (n_nodes, n_states)."""
        return np.isfinite(self.y)

    @property
    def first(self) -> np.ndarray:
        """First node of each trajectory."""
        return np.flatnonzero(np.diff(self.trajectory, prepend=-1))

    def split(self, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """Values at the nodes, per trajectory."""
        return tuple(values[a:b] for a, b in pairwise([*self.first.tolist(), self.n_nodes]))

    def intervals(self, keep: np.ndarray) -> "Grid":
        """The same nodes with only the intervals ``keep``."""
        return replace(self, begin=self.begin[keep], h=self.h[keep], u0=self.u0[keep], u1=self.u1[keep])

    def apart(self) -> "Grid":
        """The same intervals, each with two nodes of its own, one after the other."""
        node = np.column_stack([self.begin, self.begin + 1]).ravel()
        moved = {name: getattr(self, name)[node] for name in ("t", "y", "trajectory", "sample", "u")}
        return replace(self, **moved, begin=2 * np.arange(self.n_intervals))

    def rates(self, x: np.ndarray) -> np.ndarray:
        """(x1 - x0)/h per interval."""
        return (x[self.begin + 1] - x[self.begin]) / self.h[:, None]

    def interval_label(self, n_rows: int) -> Any:
        """Labels of defects: 'trajectory=2, interval=17, equation=0'."""
        offset = self.begin - self.first[self.trajectory[self.begin]]
        return lambda i: (
            f"trajectory={self.trajectory[self.begin[i // n_rows]]}, interval={offset[i // n_rows]}, row={i % n_rows}"
        )


def grid_of(data: Measurements, steps: int | Sequence[np.ndarray] = 1) -> Grid:
    """Lay out the measurements with ``steps`` intervals between neighbouring samples.

    ``steps`` is a number, or per trajectory an array (n_samples - 1,) with the number for each gap between samples.
    """
    runs = data.trajectories
    counts = [np.full(r.n_samples - 1, steps) for r in runs] if isinstance(steps, int) else list(steps)
    parts = [_refined(run, data.hold, n) for run, n in zip(runs, counts, strict=True)]
    sizes = [len(part["t"]) for part in parts]
    offsets = np.cumsum([0, *sizes[:-1]])
    joined = {key: np.concatenate([part[key] for part in parts]) for key in ("t", "y", "sample", "h", "u0", "u1", "u")}
    begin = np.concatenate([offset + np.arange(size - 1) for offset, size in zip(offsets, sizes, strict=True)])
    return Grid(trajectory=np.repeat(np.arange(len(parts)), sizes), begin=begin, **joined)


def steps_of(grid: Grid) -> list[np.ndarray]:
    """Number of intervals in every gap between samples, per trajectory."""
    samples = np.flatnonzero(grid.sample)
    gaps = np.diff(samples)
    inside = np.diff(grid.trajectory[samples]) == 0
    runs = grid.trajectory[samples][:-1]
    return [gaps[inside & (runs == i)] for i in range(grid.trajectory[-1] + 1)]


def between(x: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Values (n_samples, ...) at the samples, interpolated to the nodes of a grid with ``steps`` intervals per gap."""
    left, fraction = _places(steps)
    weight = fraction.reshape(-1, *[1] * (x.ndim - 1))
    return (1 - weight) * x[left] + weight * x[np.minimum(left + 1, len(x) - 1)]


def _places(steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each node: the sample to its left (the last node: itself), and the fraction of the gap behind it."""
    left = np.repeat(np.arange(len(steps)), steps)
    first = np.cumsum(steps) - steps
    fraction = (np.arange(len(left)) - first[left]) / steps[left]
    return np.r_[left, len(steps)], np.r_[fraction, 0.0]


def _refined(trajectory: Trajectory, hold: str, steps: np.ndarray) -> dict[str, np.ndarray]:
    left, fraction = _places(steps)
    t = between(trajectory.t, steps)
    sample = fraction == 0
    y = np.full((len(t), trajectory.x.shape[1]), np.nan)
    y[sample] = trajectory.x
    if hold == "zero":
        at_node = trajectory.u[left]
        u0 = u1 = at_node[:-1]
    else:
        at_node = between(trajectory.u, steps)
        u0, u1 = at_node[:-1], at_node[1:]
    return {"t": t, "y": y, "sample": sample, "h": np.diff(t), "u0": u0, "u1": u1, "u": at_node}


def defect(model: Model, scheme: str, n_moving: int | None = None) -> ca.Function:
    """CasADi function (x0, x1, t0, h, u0, u1, theta) -> (x1 - x0)/h - Psi, the defect of one interval.

    ``n_moving``: only the first so many states move along the interval; the others keep what x0 and x1 say.
    """
    n, m, rhs, psi = model.n_states, model.n_inputs, model.rhs(), integrator(scheme).psi
    x0, x1, theta = ca.SX.sym("x0", n), ca.SX.sym("x1", n), ca.SX.sym("theta", len(model.free))
    t0, h, u0, u1 = ca.SX.sym("t0"), ca.SX.sym("h"), ca.SX.sym("u0", m), ca.SX.sym("u1", m)

    def g(x: Any, c: float) -> Any:
        rates = rhs(x, u0 + c * (u1 - u0), t0 + c * h, theta)
        return rates if n_moving is None else ca.vertcat(rates[:n_moving], ca.SX.zeros(n - n_moving))

    value = (x1 - x0) / h - psi(g, x0, x1, h)
    names = ["x0", "x1", "t0", "h", "u0", "u1", "theta"]
    return ca.Function("defect", [x0, x1, t0, h, u0, u1, theta], [ca.densify(value)], names, ["d"])


def defects(model: Model, grid: Grid, scheme: str, x: Any, theta: Any, n_moving: int | None = None) -> Any:
    """Defects of all intervals, (n_states, n_intervals); x is (n_states, n_nodes), symbolic or numbers.

    theta is (n_free,), or (n_free, n_trajectories) where trajectories have parameters of their own.
    """
    return _along(defect(model, scheme, n_moving), grid, _columns(grid, x), theta)


def defect_function(
    model: Model, grid: Grid, scheme: str, n_columns: int = 1, n_moving: int | None = None
) -> ca.Function:
    """Function (x, theta) -> `defects`, for many evaluations; theta has ``n_columns`` (see `defect_jacobian`)."""
    x, theta = ca.MX.sym("x", model.n_states, grid.n_nodes), ca.MX.sym("theta", len(model.free), n_columns)
    return ca.Function("defects", [x, theta], [defects(model, grid, scheme, x, theta, n_moving)])


def outputs(model: Model, grid: Grid, x: Any, theta: Any) -> Any:
    """What the sensors show at the nodes, (n_states, n_nodes)."""
    columns = [x, grid.u.T, grid.t[None, :]]
    return _along(model.output(), replace(grid, begin=np.arange(grid.n_nodes)), columns, theta)


def defect_jacobian(
    model: Model, grid: Grid, scheme: str, only: list[int] | None = None, n_columns: int = 1,
    n_moving: int | None = None,
) -> ca.Function:  # fmt: skip
    """Function (x, theta) -> dd/dtheta: a row per (interval, equation), a column per parameter (or of ``only``).

    theta has ``n_columns``: one, or as many as trajectories that have parameters of their own.
    """
    one = defect(model, scheme, n_moving)
    arguments = [ca.SX.sym(one.name_in(i), one.size1_in(i)) for i in range(one.n_in())]
    chosen = list(range(len(model.free))) if only is None else only
    jacobian = ca.densify(ca.jacobian(one(*arguments), arguments[-1])[:, chosen])
    per_interval = ca.Function("row", arguments, [ca.vec(jacobian.T)])
    x, theta = ca.MX.sym("x", model.n_states, grid.n_nodes), ca.MX.sym("theta", len(model.free), n_columns)
    rows = _along(per_interval, grid, _columns(grid, x), theta)
    return ca.Function("jacobian", [x, theta], [ca.reshape(rows, len(chosen), model.n_states * grid.n_intervals).T])


def defect_slopes(model: Model, grid: Grid, scheme: str, x: np.ndarray, theta: np.ndarray) -> tuple[np.ndarray, ...]:
    """dd/dx0 and dd/dx1 of every interval, each (n_intervals, n_states, n_states)."""
    one, n = defect(model, scheme), model.n_states
    arguments = [ca.SX.sym(one.name_in(i), one.size1_in(i)) for i in range(one.n_in())]
    value = one(*arguments)
    slopes = [ca.vec(ca.densify(ca.jacobian(value, end).T)) for end in arguments[:2]]
    mapped = _mapped(ca.Function("slopes", arguments, slopes), grid)(*_columns(grid, ca.DM(x.T)), theta)
    return tuple(np.array(columns).T.reshape(grid.n_intervals, n, n) for columns in mapped)


def defect_curvature(model: Model, scheme: str) -> tuple[ca.Function, np.ndarray]:
    """CasADi function (x0, x1, t0, h, u0, u1, multiplier, theta) -> second derivatives of multiplier' defect.

    They are those of the upper triangle in (x0, x1, theta) that are not always zero, as a column; the array (n, 2) says
    which row and column each of them is.
    """
    one = defect(model, scheme)
    *ends, theta = (ca.SX.sym(one.name_in(i), one.size1_in(i)) for i in range(one.n_in()))
    multiplier = ca.SX.sym("multiplier", model.n_states)
    value = ca.dot(multiplier, one(*ends, theta))
    hessian = ca.triu(ca.hessian(value, ca.vertcat(ends[0], ends[1], theta))[0])
    rows, columns = hessian.sparsity().get_triplet()
    entries = ca.vertcat(ca.SX(0, 1), *(hessian[i, j] for i, j in zip(rows, columns, strict=True)))
    return ca.Function("curvature", [*ends, multiplier, theta], [entries]), np.array([rows, columns], dtype=int).T


def defect_steps(model: Model, scheme: str, with_theta: bool) -> tuple[ca.Function, np.ndarray]:
    """CasADi function (x0, x1, t0, h, u0, u1, theta) -> first derivatives of the defect, and where they stand.

    They are those in (x0, x1, theta), or in (x0, x1) alone, that are not always zero, as a column; the array (n, 2)
    holds the row and column of each.
    """
    one = defect(model, scheme)
    arguments = [ca.SX.sym(one.name_in(i), one.size1_in(i)) for i in range(one.n_in())]
    along = ca.vertcat(arguments[0], arguments[1], *(arguments[-1:] if with_theta else []))
    slopes = ca.jacobian(one(*arguments), along)
    rows, columns = slopes.sparsity().get_triplet()
    entries = ca.vertcat(ca.SX(0, 1), *(slopes[i, j] for i, j in zip(rows, columns, strict=True)))
    return ca.Function("steps", arguments, [entries]), np.array([rows, columns], dtype=int).T


def steps_along(model: Model, grid: Grid, scheme: str, x: Any, theta: Any, with_theta: bool) -> tuple[Any, np.ndarray]:
    """`defect_steps` in every interval, (n, n_intervals)."""
    one, places = defect_steps(model, scheme, with_theta)
    return _along(one, grid, _columns(grid, x), theta), places


def curvatures(model: Model, grid: Grid, scheme: str, x: Any, theta: Any, multiplier: Any) -> tuple[Any, np.ndarray]:
    """`defect_curvature` in every interval, (n, n_intervals), for multipliers (n_states, n_intervals)."""
    one, places = defect_curvature(model, scheme)
    return _along(one, grid, [*_columns(grid, x), multiplier], theta), places


def output_slopes(model: Model, grid: Grid, x: np.ndarray, theta: Any) -> tuple[np.ndarray, np.ndarray]:
    """Slopes of `outputs` at every node: in the states, (n_nodes, n_states, n_states), and in the parameters."""
    one, n = model.output(), model.n_states
    arguments = [ca.SX.sym(one.name_in(i), one.size1_in(i)) for i in range(one.n_in())]
    shown = one(*arguments)
    slopes = [ca.vec(ca.densify(ca.jacobian(shown, arguments[i]).T)) for i in (0, 3)]
    nodes = replace(grid, begin=np.arange(grid.n_nodes))
    columns = [ca.DM(x.T), grid.u.T, grid.t[None, :]]
    made = _along(ca.Function("slopes", arguments, slopes), nodes, columns, theta)
    by_x, by_theta = (np.array(part).T.reshape(grid.n_nodes, n, -1) for part in made)
    return by_x, by_theta


def output_slopes_of(unknown: Theta, grid: Grid, x: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Slope of `outputs` at every node in each entry of theta, (n_nodes, n_states, n_theta)."""
    model = unknown.model
    slopes = np.zeros((grid.n_nodes, model.n_states, len(unknown)))
    if model.sensor:
        own = output_slopes(model, grid, x, unknown.by_trajectory(theta))[1]
        places = unknown.table[:, grid.trajectory].T[:, None, :]
        np.put_along_axis(slopes, np.broadcast_to(places, own.shape), own, axis=2)
    return slopes


def output_slope(model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray) -> Any:
    """Slope of `outputs` in the states: sparse, (n_nodes * n_states) square, a block per node."""
    blocks = output_slopes(model, grid, x, theta)[0]
    return bsr_matrix((blocks, np.arange(grid.n_nodes), np.arange(grid.n_nodes + 1))).tocsc()


def local_errors(model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """What one step of the scheme misses of the exact solution, (n_intervals, n_states), for states on the scheme.

    The exact end of an interval is found by `FINE` steps of RK4 from its beginning. NaN where they leave the range.
    """
    rhs, psi, n, m = model.rhs(), integrator("rk4").psi, model.n_states, model.n_inputs
    x0, all_of = ca.SX.sym("x0", n), ca.SX.sym("theta", len(model.free))
    t0, h, u0, u1 = ca.SX.sym("t0"), ca.SX.sym("h"), ca.SX.sym("u0", m), ca.SX.sym("u1", m)
    at = x0
    for k in range(FINE):

        def g(x: Any, c: float, done: int = k) -> Any:
            share = (done + c) / FINE
            return rhs(x, u0 + share * (u1 - u0), t0 + share * h, all_of)

        at = at + h / FINE * psi(g, at, at, h / FINE)
    exact = ca.Function("exact", [x0, t0, h, u0, u1, all_of], [at])
    columns = _columns(grid, ca.DM(x.T))
    ends = _along(exact, grid, [columns[0], *columns[2:]], theta)
    return np.array(ends).T - x[grid.begin + 1]


def _along(one: ca.Function, grid: Grid, columns: list[Any], theta: Any) -> Any:
    """The function in every interval (or node) with the parameters of its trajectory."""
    shape = theta.shape if hasattr(theta, "shape") else np.shape(theta)
    if len(shape) < 2 or shape[1] == 1:
        return _mapped(one, grid)(*columns, theta)
    each = theta[:, grid.trajectory[grid.begin].tolist()]
    return one.map(len(grid.begin), "serial")(*columns, each)


def _mapped(per_interval: ca.Function, grid: Grid) -> ca.Function:
    # theta (the last argument) is one and the same for all intervals.
    return per_interval.map("mapped", "serial", len(grid.begin), [per_interval.n_in() - 1], [])


def _columns(grid: Grid, x: Any) -> list[Any]:
    begin = grid.begin.tolist()
    ends = [i + 1 for i in begin]
    return [x[:, begin], x[:, ends], grid.t[grid.begin][None, :], grid.h[None, :], grid.u0.T, grid.u1.T]

"""Measurements laid out for a program: nodes where the states live, and the intervals between them.

All trajectories stand one after the other; an interval joins two nodes of one trajectory. Between samples there may be
further nodes, so that the integration error stays small where the sampling is coarse. Here, and only here, the user's
rows (n_samples, n_states) become CasADi's columns.
"""

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.integrators import integrator
from phsi_opt.measurements import Measurements, Trajectory
from phsi_opt.model import Model


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

    def intervals(self, keep: np.ndarray) -> "Grid":
        """The same nodes with only the intervals ``keep``."""
        return replace(self, begin=self.begin[keep], h=self.h[keep], u0=self.u0[keep], u1=self.u1[keep])

    def rates(self, x: np.ndarray) -> np.ndarray:
        """(x1 - x0)/h per interval."""
        return (x[self.begin + 1] - x[self.begin]) / self.h[:, None]

    def interval_label(self, n_rows: int) -> Any:
        """Labels of defects: 'trajectory=2, interval=17, equation=0'."""
        offset = self.begin - self.first[self.trajectory[self.begin]]
        return lambda i: (
            f"trajectory={self.trajectory[self.begin[i // n_rows]]}, interval={offset[i // n_rows]}, row={i % n_rows}"
        )


def grid_of(data: Measurements, steps: int = 1) -> Grid:
    """Lay out the measurements with ``steps`` intervals between neighbouring samples."""
    parts = [_refined(trajectory, data.hold, steps) for trajectory in data.trajectories]
    sizes = [len(part["t"]) for part in parts]
    offsets = np.cumsum([0, *sizes[:-1]])
    joined = {key: np.concatenate([part[key] for part in parts]) for key in ("t", "y", "sample", "h", "u0", "u1", "u")}
    begin = np.concatenate([offset + np.arange(size - 1) for offset, size in zip(offsets, sizes, strict=True)])
    return Grid(trajectory=np.repeat(np.arange(len(parts)), sizes), begin=begin, **joined)


def _refined(trajectory: Trajectory, hold: str, steps: int) -> dict[str, np.ndarray]:
    n = trajectory.n_samples
    position = np.arange((n - 1) * steps + 1) / steps
    left, fraction = np.minimum(position.astype(int), n - 2), None
    fraction = (position - left)[:, None]
    t = trajectory.t[left] + fraction[:, 0] * (trajectory.t[left + 1] - trajectory.t[left])
    sample = np.arange(len(t)) % steps == 0
    y = np.full((len(t), trajectory.x.shape[1]), np.nan)
    y[sample] = trajectory.x
    u = trajectory.u
    if hold == "zero":
        at_node = u[np.minimum(position.astype(int), n - 1)]
        u0 = u1 = at_node[:-1]
    else:
        at_node = (1 - fraction) * u[left] + fraction * u[left + 1]
        u0, u1 = at_node[:-1], at_node[1:]
    return {"t": t, "y": y, "sample": sample, "h": np.diff(t), "u0": u0, "u1": u1, "u": at_node}


def defect(model: Model, scheme: str) -> ca.Function:
    """CasADi function (x0, x1, t0, h, u0, u1, theta) -> (x1 - x0)/h - Psi, the defect of one interval."""
    n, m, rhs, psi = model.n_states, model.n_inputs, model.rhs(), integrator(scheme).psi
    x0, x1, theta = ca.SX.sym("x0", n), ca.SX.sym("x1", n), ca.SX.sym("theta", len(model.free))
    t0, h, u0, u1 = ca.SX.sym("t0"), ca.SX.sym("h"), ca.SX.sym("u0", m), ca.SX.sym("u1", m)

    def g(x: Any, c: float) -> Any:
        return rhs(x, u0 + c * (u1 - u0), t0 + c * h, theta)

    value = (x1 - x0) / h - psi(g, x0, x1, h)
    names = ["x0", "x1", "t0", "h", "u0", "u1", "theta"]
    return ca.Function("defect", [x0, x1, t0, h, u0, u1, theta], [ca.densify(value)], names, ["d"])


def defects(model: Model, grid: Grid, scheme: str, x: Any, theta: Any) -> Any:
    """Defects of all intervals, (n_states, n_intervals); x is (n_states, n_nodes), symbolic or numbers."""
    return _mapped(defect(model, scheme), grid)(*_columns(grid, x), theta)


def defect_jacobian(model: Model, grid: Grid, scheme: str, only: list[int] | None = None) -> ca.Function:
    """Function (x, theta) -> dd/dtheta: a row per (interval, equation), a column per parameter (or of ``only``)."""
    one = defect(model, scheme)
    arguments = [ca.SX.sym(one.name_in(i), one.size1_in(i)) for i in range(one.n_in())]
    chosen = list(range(len(model.free))) if only is None else only
    jacobian = ca.densify(ca.jacobian(one(*arguments), arguments[-1])[:, chosen])
    per_interval = ca.Function("row", arguments, [ca.vec(jacobian.T)])
    x, theta = ca.MX.sym("x", model.n_states, grid.n_nodes), ca.MX.sym("theta", len(model.free))
    rows = _mapped(per_interval, grid)(*_columns(grid, x), theta)
    return ca.Function("jacobian", [x, theta], [ca.reshape(rows, len(chosen), model.n_states * grid.n_intervals).T])


def defect_slopes(model: Model, grid: Grid, scheme: str, x: np.ndarray, theta: np.ndarray) -> tuple[np.ndarray, ...]:
    """dd/dx0 and dd/dx1 of every interval, each (n_intervals, n_states, n_states)."""
    one, n = defect(model, scheme), model.n_states
    arguments = [ca.SX.sym(one.name_in(i), one.size1_in(i)) for i in range(one.n_in())]
    value = one(*arguments)
    slopes = [ca.vec(ca.densify(ca.jacobian(value, end).T)) for end in arguments[:2]]
    mapped = _mapped(ca.Function("slopes", arguments, slopes), grid)(*_columns(grid, ca.DM(x.T)), theta)
    return tuple(np.array(columns).T.reshape(grid.n_intervals, n, n) for columns in mapped)


def _mapped(per_interval: ca.Function, grid: Grid) -> ca.Function:
    # theta (the last argument) is one and the same for all intervals.
    return per_interval.map("mapped", "serial", grid.n_intervals, [per_interval.n_in() - 1], [])


def _columns(grid: Grid, x: Any) -> list[Any]:
    begin = grid.begin.tolist()
    ends = [i + 1 for i in begin]
    return [x[:, begin], x[:, ends], grid.t[grid.begin][None, :], grid.h[None, :], grid.u0.T, grid.u1.T]

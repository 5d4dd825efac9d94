"""Measurements laid out for a program: nodes where the states live, and the intervals
between them.

All trajectories stand one after the other; an interval joins two nodes of one
trajectory. Between samples there may be further nodes, so that the integration error
stays small where the sampling is coarse. Here, and only here, the user's rows
(n_samples, n_states) become CasADi's columns.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.data.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Grid:
    """Nodes and intervals. Arrays are (n_nodes, ...) or (n_intervals, ...); y is NaN
    where nothing was measured.
    """

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
        return tuple(
            values[a:b] for a, b in pairwise([*self.first.tolist(), self.n_nodes])
        )

    def intervals(self, keep: np.ndarray) -> "Grid":
        """The same nodes with only the intervals ``keep``."""
        return replace(
            self,
            begin=self.begin[keep],
            h=self.h[keep],
            u0=self.u0[keep],
            u1=self.u1[keep],
        )

    def apart(self) -> "Grid":
        """The same intervals, each with two nodes of its own, one after the other."""
        node = np.column_stack([self.begin, self.begin + 1]).ravel()
        moved = {
            name: getattr(self, name)[node]
            for name in ("t", "y", "trajectory", "sample", "u")
        }
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

    ``steps`` is a number, or per trajectory an array (n_samples - 1,) with the number
    for each gap between samples.
    """
    runs = data.trajectories
    counts = (
        [np.full(r.n_samples - 1, steps) for r in runs]
        if isinstance(steps, int)
        else list(steps)
    )
    parts = [_refined(run, data.hold, n) for run, n in zip(runs, counts, strict=True)]
    sizes = [len(part["t"]) for part in parts]
    offsets = np.cumsum([0, *sizes[:-1]])
    joined = {
        key: np.concatenate([part[key] for part in parts])
        for key in ("t", "y", "sample", "h", "u0", "u1", "u")
    }
    begin = np.concatenate(
        [
            offset + np.arange(size - 1)
            for offset, size in zip(offsets, sizes, strict=True)
        ]
    )
    return Grid(
        trajectory=np.repeat(np.arange(len(parts)), sizes), begin=begin, **joined
    )


def steps_per_gap(grid: Grid) -> list[np.ndarray]:
    """Number of intervals in every gap between samples, per trajectory."""
    samples = np.flatnonzero(grid.sample)
    gaps = np.diff(samples)
    inside = np.diff(grid.trajectory[samples]) == 0
    runs = grid.trajectory[samples][:-1]
    return [gaps[inside & (runs == i)] for i in range(grid.trajectory[-1] + 1)]


def interpolate_at_nodes(x: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Values (n_samples, ...) at the samples, interpolated to the nodes of a grid with
    ``steps`` intervals per gap.
    """
    left, fraction = _places(steps)
    weight = fraction.reshape(-1, *[1] * (x.ndim - 1))
    return (1 - weight) * x[left] + weight * x[np.minimum(left + 1, len(x) - 1)]


def _places(steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each node: the sample to its left (the last node: itself), and the fraction of
    the gap behind it.
    """
    left = np.repeat(np.arange(len(steps)), steps)
    first = np.cumsum(steps) - steps
    fraction = (np.arange(len(left)) - first[left]) / steps[left]
    return np.r_[left, len(steps)], np.r_[fraction, 0.0]


def _refined(
    trajectory: Trajectory, hold: str, steps: np.ndarray
) -> dict[str, np.ndarray]:
    left, fraction = _places(steps)
    t = interpolate_at_nodes(trajectory.t, steps)
    sample = fraction == 0
    y = np.full((len(t), trajectory.x.shape[1]), np.nan)
    y[sample] = trajectory.x
    if hold == "zero":
        at_node = trajectory.u[left]
        u0 = u1 = at_node[:-1]
    else:
        at_node = interpolate_at_nodes(trajectory.u, steps)
        u0, u1 = at_node[:-1], at_node[1:]
    return {
        "t": t,
        "y": y,
        "sample": sample,
        "h": np.diff(t),
        "u0": u0,
        "u1": u1,
        "u": at_node,
    }

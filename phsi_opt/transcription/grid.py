"""Measurements laid out for a program: nodes, and the intervals between them.

The states of a program live at the nodes; every sample is one.

All trajectories stand one after the other; an interval joins two nodes of one
trajectory. Between samples there may be further nodes, so that the integration error
stays small where the sampling is coarse. Arrays are still rows (n_nodes, n_states);
`defects` turns them into CasADi's columns.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from phsi_opt.data.checks import hold_of_each
from phsi_opt.data.copies import copies_in, counted_once, sentence_about
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.smooth_inputs import SmoothInputs
from phsi_opt.data.trajectory import Trajectory
from phsi_opt.errors import DataError, ModelError
from phsi_opt.model.model import Model


@dataclass(frozen=True, eq=False)
class Grid:
    """Nodes and intervals of all trajectories, one after the other.

    Attributes:
        t: (n_nodes,) times.
        y: (n_nodes, n_states) measurements; NaN where nothing was measured.
        trajectory: (n_nodes,) number of the trajectory of each node.
        sample: (n_nodes,) whether the node is a sample.
        begin: (n_intervals,) first node of each interval; the next node is its end.
        h: (n_intervals,) length in time of each interval.
        u0: (n_intervals, n_inputs) input at the beginning of the interval; of a smooth
            input the straight line that acts like it.
        u1: (n_intervals, n_inputs) input at its end, equal to u0 for a held input.
        u: (n_nodes, n_inputs) input at each node.
    """

    t: np.ndarray
    y: np.ndarray
    trajectory: np.ndarray
    sample: np.ndarray
    begin: np.ndarray
    h: np.ndarray
    u0: np.ndarray
    u1: np.ndarray
    u: np.ndarray

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.t)

    @property
    def n_intervals(self) -> int:
        """Number of intervals."""
        return len(self.h)

    @cached_property
    def measured(self) -> np.ndarray:
        """Where a state was measured, (n_nodes, n_states), read-only."""
        measured = np.isfinite(self.y)
        measured.flags.writeable = False
        return measured

    @cached_property
    def measured_states(self) -> np.ndarray:
        """Whether a state was measured at all, (n_states,)."""
        return np.asarray(self.measured.any(axis=0))

    @cached_property
    def channel(self) -> np.ndarray:
        """State of every measured value in the order of the nodes, (n_values,)."""
        return np.nonzero(self.measured)[1]

    def rms_by_channel(self, values: np.ndarray) -> np.ndarray:
        """Root mean square per state, (n_states,); zero where nothing is measured.

        Args:
            values: (n_values,) one per measured value, in the order of the nodes.
        """
        n_states = self.y.shape[1]
        squares = np.bincount(self.channel, values**2, minlength=n_states)
        counts = np.bincount(self.channel, minlength=n_states)
        rms: np.ndarray = np.sqrt(squares / np.maximum(counts, 1))
        return rms

    @cached_property
    def first(self) -> np.ndarray:
        """First node of each trajectory."""
        return np.flatnonzero(np.diff(self.trajectory, prepend=-1))

    @property
    def n_trajectories(self) -> int:
        """Number of trajectories."""
        return int(self.trajectory[-1]) + 1

    @property
    def spans(self) -> list[tuple[int, int]]:
        """First node of each trajectory, and the node behind its last."""
        return list(pairwise([*self.first.tolist(), self.n_nodes]))

    @cached_property
    def runs(self) -> np.ndarray:
        """Number of the trajectory of each interval, (n_intervals,)."""
        return self.trajectory[self.begin]

    def split(self, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """Values (n_nodes, ...) at the nodes, per trajectory."""
        return tuple(values[begin:end] for begin, end in self.spans)

    def intervals(self, keep: np.ndarray) -> "Grid":
        """The same nodes with only the intervals ``keep``, given by their numbers."""
        return replace(
            self,
            begin=self.begin[keep],
            h=self.h[keep],
            u0=self.u0[keep],
            u1=self.u1[keep],
        )

    def at_nodes(self, nodes: np.ndarray, **intervals: np.ndarray) -> "Grid":
        """Some of the nodes (n,), given by their numbers, with other intervals."""
        return replace(
            self,
            t=self.t[nodes],
            y=self.y[nodes],
            trajectory=self.trajectory[nodes],
            sample=self.sample[nodes],
            u=self.u[nodes],
            **intervals,
        )

    def apart(self) -> "Grid":
        """The same intervals, each with two nodes of its own, one after the other."""
        nodes = np.column_stack([self.begin, self.begin + 1]).ravel()
        return self.at_nodes(nodes, begin=2 * np.arange(self.n_intervals))

    def rates(self, x: np.ndarray) -> np.ndarray:
        """(x1 - x0)/h per interval, of values (n_nodes, n_states)."""
        return (x[self.begin + 1] - x[self.begin]) / self.h[:, None]

    def interval_label(self, n_rows: int, place: int) -> str:
        """Where a value is that stands in ``n_rows`` rows per interval.

        Such as 'trajectory 3, t = 1.7 to 1.8, row 1': trajectories and rows are counted
        from one.
        """
        interval, row = divmod(place, n_rows)
        begin = self.begin[interval]
        return (
            f"trajectory {self.trajectory[begin] + 1}, "
            f"t = {self.t[begin]:g} to {self.t[begin + 1]:g}, row {row + 1}"
        )

    def node_label(self, n_rows: int, place: int) -> str:
        """Where a value is that stands in ``n_rows`` rows per node.

        Such as 'trajectory 3, t = 0.5, state 1'.
        """
        node, row = divmod(place, n_rows)
        run = self.trajectory[node] + 1
        return f"trajectory {run}, t = {self.t[node]:g}, state {row + 1}"


def grid_of(data: Measurements, steps: int | Sequence[np.ndarray] = 1) -> Grid:
    """Lay out the measurements with ``steps`` intervals between neighbouring samples.

    Args:
        data: the measurements.
        steps: a number, or per trajectory an array (n_samples - 1,) with the number for
            each gap between samples.
    """
    runs = data.trajectories
    lengths = np.array([run.n_samples for run in runs])
    last_sample = np.cumsum(lengths) - 1
    # Nodes at each sample and in the gap behind it.
    n_nodes = np.ones(int(lengths.sum()), dtype=int)
    has_gap = np.ones(len(n_nodes), dtype=bool)
    has_gap[last_sample] = False
    n_nodes[has_gap] = steps if isinstance(steps, int) else np.concatenate(steps)
    places = _NodePlaces.of(n_nodes, last_sample)
    t = places.interpolated(data.stacked("t"))
    is_sample = places.fraction == 0
    x = data.stacked("x")
    y = np.full((len(t), x.shape[1]), np.nan)
    y[is_sample] = x
    trajectory = np.repeat(np.arange(len(runs)), lengths)[places.left]
    begin = np.flatnonzero(np.diff(trajectory) == 0)
    hold = hold_of_each(data.hold, data.inputs)
    is_held = hold == "zero"
    u = data.stacked("u")
    u = np.where(is_held, u[places.left], places.interpolated(u))
    u0 = u[begin]
    u1 = np.where(is_held, u0, u[begin + 1])
    is_smooth = hold == "cubic"
    if is_smooth.any():
        smooth = _smooth(runs, t, trajectory, begin)
        u = np.where(is_smooth, smooth[0], u)
        u0 = np.where(is_smooth, smooth[1], u0)
        u1 = np.where(is_smooth, smooth[2], u1)
    return Grid(
        t=t,
        y=y,
        trajectory=trajectory,
        sample=is_sample,
        begin=begin,
        h=t[begin + 1] - t[begin],
        u0=u0,
        u1=u1,
        u=u,
    )


def _smooth(
    runs: Sequence[Trajectory], t: np.ndarray, trajectory: np.ndarray, begin: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inputs that are smooth, at the nodes, and their lines at the ends of intervals.

    Args:
        runs: all trajectories.
        t: (n_nodes,) times.
        trajectory: (n_nodes,) number of the trajectory of each node.
        begin: (n_intervals,) first node of each interval.
    """
    at_nodes, first, last = [], [], []
    for k, run in enumerate(runs):
        smooth = SmoothInputs(run.t, run.u)
        own = begin[trajectory[begin] == k]
        ends = smooth.lines(t[own], t[own + 1])
        at_nodes.append(smooth(t[trajectory == k]))
        first.append(ends[0])
        last.append(ends[1])
    return np.concatenate(at_nodes), np.concatenate(first), np.concatenate(last)


def steps_per_gap(grid: Grid) -> list[np.ndarray]:
    """Number of intervals in every gap, (n_samples - 1,) per trajectory."""
    samples = np.flatnonzero(grid.sample)
    trajectory = grid.trajectory[samples]
    is_inside = np.diff(trajectory) == 0
    n_intervals = np.diff(samples)[is_inside]
    ends = np.searchsorted(
        trajectory[:-1][is_inside], np.arange(trajectory[-1]), "right"
    )
    return np.split(n_intervals, ends)


@dataclass(frozen=True, eq=False)
class _NodePlaces:
    """Where nodes stand among the samples of trajectories, one after the other.

    Attributes:
        left: (n_nodes,) sample to the left of each node, or at it.
        right: (n_nodes,) the next sample; that of a trajectory's last is itself.
        fraction: (n_nodes,) share of the gap that lies between left and node.
    """

    left: np.ndarray
    right: np.ndarray
    fraction: np.ndarray

    @classmethod
    def of(cls, n_nodes: np.ndarray, last_sample: np.ndarray) -> "_NodePlaces":
        """Places of the nodes.

        Args:
            n_nodes: (n_samples,) nodes at each sample and in the gap behind it.
            last_sample: (n_trajectories,) number of each trajectory's last sample.
        """
        left = np.repeat(np.arange(len(n_nodes)), n_nodes)
        first = np.cumsum(n_nodes) - n_nodes
        fraction = (np.arange(len(left)) - first[left]) / n_nodes[left]
        next_sample = np.arange(1, len(n_nodes) + 1)
        next_sample[last_sample] = last_sample
        return cls(left, next_sample[left], fraction)

    def interpolated(self, values: np.ndarray) -> np.ndarray:
        """Values (n_samples, ...) at the nodes, linearly."""
        fraction = self.fraction.reshape(-1, *[1] * (values.ndim - 1))
        return (1 - fraction) * values[self.left] + fraction * values[self.right]


@dataclass(frozen=True, eq=False)
class AlignedData:
    """Measurements with states and inputs in a model's order, and their layout.

    Made once and handed on: alignments for larger models are kept, so that none is made
    twice however often it is asked for.

    Attributes:
        data: the measurements.
        grid: the same laid out with one interval between neighbouring samples.
        notes: what a user should know of them: runs that are copies of others.
    """

    data: Measurements
    grid: Grid
    notes: tuple[str, ...] = ()
    _larger: dict[tuple[str, ...], "AlignedData"] = field(
        default_factory=dict, repr=False
    )

    @classmethod
    def of(cls, model: Model, data: Measurements) -> "AlignedData":
        """Align and lay out measurements that hold what the model needs.

        Raises:
            DataError: a state or input of the model is not in the measurements, or one
                of theirs is not in the model; or these are no measurements.
            ModelError: the model is none.
        """
        if not isinstance(model, Model):
            raise ModelError(
                f"model={model!r} is no model; expected a PseudoHamiltonian or a "
                "FirstOrder."
            )
        if not isinstance(data, Measurements):
            raise DataError(
                f"data={data!r} are no Measurements; make them with "
                "Measurements.from_arrays or from_csv."
            )
        ordered = aligned(model, data)
        copies = copies_in(ordered)
        once = counted_once(ordered, copies)
        notes = (sentence_about(copies),) if copies else ()
        return cls(once, grid_of(once), notes)

    def for_model(self, model: Model) -> "AlignedData":
        """The same for a model that has states more; itself where it has none."""
        if (model.states, model.inputs) == (self.data.states, self.data.inputs):
            return self
        states = tuple(model.states)
        if states not in self._larger:
            data = aligned(model, self.data)
            self._larger[states] = AlignedData(data, grid_of(data), self.notes)
        return self._larger[states]

    def grid_with(self, steps: Sequence[np.ndarray]) -> Grid:
        """The layout with further nodes between samples.

        Args:
            steps: intervals in every gap between samples, one (n_samples - 1,) per
                trajectory.
        """
        if all(np.all(n == 1) for n in steps):
            return self.grid
        return grid_of(self.data, steps)


def aligned_once(model: Model, data: Measurements) -> Measurements:
    """`aligned`, without runs that are exact copies of others.

    Raises:
        DataError: as `aligned`.
    """
    ordered = aligned(model, data)
    return counted_once(ordered, copies_in(ordered))


def aligned(model: Model, data: Measurements) -> Measurements:
    """The measurements with their states and inputs in the model's order.

    States that are the memory of an effect need not be in the measurements: nobody
    measures them. They are added as columns of NaN. Measurements that are in the
    model's order already are returned as they are.

    Raises:
        DataError: a state or an input of the model is not in the measurements, or the
            measurements have a state that the model has not.
    """
    data = _with_memory_columns(data, model.memory)
    _check_names(model, data)
    if data.states == model.states and data.inputs == model.inputs:
        return data
    state_columns = [data.states.index(name) for name in model.states]
    input_columns = [data.inputs.index(name) for name in model.inputs]
    trajectories = tuple(
        replace(run, x=run.x[:, state_columns], u=run.u[:, input_columns])
        for run in data.trajectories
    )
    kept = {"t", *model.states, *model.inputs}
    units = {name: unit for name, unit in data.units.items() if name in kept}
    hold = data.hold
    if not isinstance(hold, str):
        hold = {name: hold[name] for name in model.inputs}
    return replace(
        data,
        trajectories=trajectories,
        states=tuple(model.states),
        inputs=tuple(model.inputs),
        units=units,
        hold=hold,
    )


def _with_memory_columns(data: Measurements, memory: Sequence[str]) -> Measurements:
    """The measurements with the memory's states that they lack, as never measured."""
    lacking = [name for name in memory if name not in data.states]
    if not lacking:
        return data
    trajectories = []
    for run in data.trajectories:
        not_measured = np.full((run.n_samples, len(lacking)), np.nan)
        x = np.column_stack([run.x, not_measured])
        trajectories.append(replace(run, x=x))
    return replace(
        data, trajectories=tuple(trajectories), states=(*data.states, *lacking)
    )


def _check_names(model: Model, data: Measurements) -> None:
    for name in model.states:
        if name not in data.states:
            raise DataError(
                f"state {name!r} of the model is not in the measurements "
                f"({', '.join(data.states)}); declare it as not measured: "
                f"states={{..., {name!r}: None}}."
            )
    for name in model.inputs:
        if name not in data.inputs:
            raise DataError(
                f"input {name!r} of the model is not in the measurements "
                f"({', '.join(data.inputs)})."
            )
    extra = sorted(set(data.states) - set(model.states))
    if extra:
        raise DataError(
            f"state {extra[0]!r} of the measurements is not in the model; "
            "leave its column out."
        )

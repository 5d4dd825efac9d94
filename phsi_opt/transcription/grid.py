"""Measurements in the model's order, laid out for a program: nodes and intervals.

The states of a program live at the nodes; every sample is one. All trajectories stand
one after the other; an interval joins two nodes of one trajectory. None leads over a
gap in which an input is unknown: the states begin anew there. Between samples there may
be further nodes, so that the integration error stays small where the sampling is
coarse. Arrays are still rows (n_nodes, n_states); `defects` turns them into CasADi's
columns.

From here on a column is addressed by its number, which means the same in the model and
in the data. Units and noise stay with their names; values are never changed. A run that
is a copy of another is left out: in all that follows it counts once.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np

from phsi_opt.arguments import typed
from phsi_opt.data.checks import Hold, hold_of_each
from phsi_opt.data.copies import copies_in, counted_once, sentence_about
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.noticed import breaks_of
from phsi_opt.data.trajectory import InputCurve, is_stepped
from phsi_opt.errors import DataError, some_of
from phsi_opt.model.expressions import angles_in
from phsi_opt.model.model import Model
from phsi_opt.model.structure import position_of_momentum
from phsi_opt.model.unit_checks import UnitCheck


@dataclass(frozen=True, eq=False)
class Grid:
    """Nodes and intervals of all trajectories, one after the other."""

    t: np.ndarray  # (n_nodes,) times
    y: np.ndarray  # (n_nodes, n_states) measurements; NaN where nothing was measured
    trajectory: np.ndarray  # (n_nodes,) number of the trajectory of each node
    sample: np.ndarray  # (n_nodes,) whether the node is a sample
    # (n_intervals,) first node of each interval; the next node is its end.
    begin: np.ndarray
    h: np.ndarray  # (n_intervals,) length in time of each interval
    # (n_intervals, n_inputs) input at the beginning of the interval; of a smooth input
    # the straight line that acts like it.
    u0: np.ndarray
    # (n_intervals, n_inputs) input at its end, equal to u0 for a held input.
    u1: np.ndarray
    u: np.ndarray  # (n_nodes, n_inputs) input at each node
    # (n_nodes,) number of the stretch of measurements of each node, and the inputs of
    # each of these, by which they are delayed.
    stretch: np.ndarray
    past: Sequence[Sequence[InputCurve]]

    @property
    def n_nodes(self) -> int:
        return len(self.t)

    @property
    def n_intervals(self) -> int:
        return len(self.h)

    @property
    def n_trajectories(self) -> int:
        return int(self.trajectory[-1]) + 1

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

    @cached_property
    def node(self) -> np.ndarray:
        """Node of every measured value, (n_values,)."""
        return np.nonzero(self.measured)[0]

    @cached_property
    def run_of_value(self) -> np.ndarray:
        """Number of the trajectory of every measured value, (n_values,)."""
        return self.trajectory[self.node]

    def rms_by_channel(self, values: np.ndarray) -> np.ndarray:
        """Root mean square per state, (n_states,); zero where nothing is measured.

        ``values`` (n_values,) are one per measured value, in the order of the nodes.
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
    def spans(self) -> list[tuple[int, int]]:
        """First node of each trajectory, and the node behind its last."""
        return list(pairwise([*self.first.tolist(), self.n_nodes]))

    @cached_property
    def starts(self) -> np.ndarray:
        """Nodes at which a trajectory begins, or states begin anew after a gap."""
        return np.setdiff1d(np.arange(self.n_nodes), self.begin + 1)

    @cached_property
    def piece(self) -> np.ndarray:
        """Number of the start from which each node follows, (n_nodes,)."""
        nodes = np.arange(self.n_nodes)
        return np.searchsorted(self.starts, nodes, side="right") - 1

    @cached_property
    def runs(self) -> np.ndarray:
        """Number of the trajectory of each interval, (n_intervals,)."""
        return self.trajectory[self.begin]

    def split(self, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """Values (n_nodes, ...) at the nodes, per trajectory."""
        return tuple(values[begin:end] for begin, end in self.spans)

    def intervals(self, keep: np.ndarray) -> "Grid":
        """The same nodes with only the intervals ``keep``, given by their numbers."""
        names = ("begin", "h", "u0", "u1")
        parts: dict[str, Any] = {name: getattr(self, name)[keep] for name in names}
        return replace(self, **parts)

    def at_nodes(self, nodes: np.ndarray, **intervals: Any) -> "Grid":
        """Some of the nodes (n,), given by their numbers, with other intervals."""
        names = ("t", "y", "trajectory", "sample", "u", "stretch")
        parts = {name: getattr(self, name)[nodes] for name in names}
        return replace(self, **parts, **intervals)

    def apart(self) -> "Grid":
        """The same intervals, each with two nodes of its own, one after the other."""
        nodes = np.column_stack([self.begin, self.begin + 1]).ravel()
        return self.at_nodes(nodes, begin=2 * np.arange(self.n_intervals))

    def driven(self, model: Model, theta: np.ndarray) -> "Grid":
        """With the delayed inputs of a model behind its measured ones.

        Values and slopes in the delay, as `BaseModel.delays` has them, at parameters
        (n_free,) or (n_free, n_trajectories).
        """
        if not model.delays:
            return self
        known = np.broadcast_to(theta.T, (self.n_trajectories, len(model.free)))
        n = self.n_intervals
        run = np.r_[self.runs, self.runs, self.trajectory]
        late = np.zeros((2, len(model.delays), len(run)))
        for k, (name, delay) in enumerate(model.delays):
            tau = np.full(self.n_trajectories, model.values[delay])
            if delay in model.free:
                tau = known[:, model.free.index(delay)]
            for number in np.unique(self.stretch).tolist():
                past = self.past[number][model.inputs.index(name)]
                own = np.flatnonzero(self.stretch[self.begin] == number)
                nodes = np.flatnonzero(self.stretch == number)
                begin = self.t[self.begin[own]] - tau[self.runs[own]]
                at = self.t[nodes] - tau[self.trajectory[nodes]]
                first, last, *moved = past.lines(begin, begin + self.h[own])
                places = np.r_[own, n + own, 2 * n + nodes]
                late[0, k, places] = np.r_[first, last, past.after(at)]
                late[1, k, places] = -np.r_[*moved, past.around(at, 1)]
            late[0, k] -= tau[run] * late[1, k]
        behind = np.split(late.reshape(-1, len(run)).T, [n, 2 * n])
        measured = (one[:, : len(model.inputs)] for one in (self.u0, self.u1, self.u))
        u0, u1, u = map(np.hstack, zip(measured, behind, strict=True))
        return replace(self, u0=u0, u1=u1, u=u)

    def rates(self, x: np.ndarray) -> np.ndarray:
        """(x1 - x0)/h per interval, of values (n_nodes, n_states)."""
        return (x[self.begin + 1] - x[self.begin]) / self.h[:, None]

    def interval_label(self, n_rows: int, place: int) -> str:
        """Where a value is that stands in ``n_rows`` rows per interval.

        Such as 'trajectory 3, t = 1.7 to 1.8, row 1': trajectories and rows are counted
        from one.
        """
        interval, row = divmod(place, n_rows)
        node = int(self.begin[interval])
        return f"{self._node_label(node)} to {self.t[node + 1]:g}, row {row + 1}"

    def node_label(self, n_rows: int, place: int) -> str:
        """The same of a value in ``n_rows`` rows per node.

        Such as 'trajectory 3, t = 0.5, state 1'.
        """
        node, row = divmod(place, n_rows)
        return f"{self._node_label(node)}, state {row + 1}"

    def _node_label(self, node: int) -> str:
        return f"trajectory {self.trajectory[node] + 1}, t = {self.t[node]:g}"


def grid_of(data: Measurements, steps: int | Sequence[np.ndarray] = 1) -> Grid:
    """Lay out the measurements with ``steps`` intervals between neighbouring samples.

    Args:
        data: the measurements.
        steps: a number, or per trajectory an array (n_samples - 1,) with the number for
            each gap between samples.
    """
    lengths = np.array([run.n_samples for run in data.trajectories])
    # Nodes at each sample and in the gap behind it.
    n_nodes = np.ones(int(lengths.sum()), dtype=int)
    has_gap = np.ones(len(n_nodes), dtype=bool)
    has_gap[np.cumsum(lengths) - 1] = False
    n_nodes[has_gap] = steps if isinstance(steps, int) else np.concatenate(steps)
    is_break = np.zeros(len(n_nodes), dtype=bool)
    first = np.cumsum(lengths) - lengths
    for begin, run in zip(first, data.trajectories, strict=True):
        is_break[begin + breaks_of(run)] = True
    n_nodes[is_break] = 1
    # The sample before each node, and the share of the gap that lies between them.
    left = np.repeat(np.arange(len(n_nodes)), n_nodes)
    right = np.minimum(left + 1, len(n_nodes) - 1)
    place = np.arange(len(left)) - (np.cumsum(n_nodes) - n_nodes)[left]
    share = place / n_nodes[left]
    times = data.stacked("t")
    t = (1 - share) * times[left] + share * times[right]
    x = data.stacked("x")
    y = np.full((len(t), x.shape[1]), np.nan)
    y[place == 0] = x
    trajectory = np.repeat(np.arange(len(lengths)), lengths)[left]
    begin = np.flatnonzero((np.diff(trajectory) == 0) & ~is_break[left[:-1]])
    hold = hold_of_each(data.hold, data.inputs)
    is_held = hold == "zero"
    sampled = data.stacked("u")
    between = (1 - share)[:, None] * sampled[left] + share[:, None] * sampled[right]
    u = np.where(is_held, sampled[left], between)
    u0 = u[begin]
    u1 = np.where(is_held, u0, u[begin + 1])
    # A delayed or smooth input has no past beyond a gap.
    is_new = np.append(False, (np.diff(trajectory) != 0) | is_break[left[:-1]])
    stretch = np.cumsum(is_new)
    past = []
    for number in range(stretch[-1] + 1):
        nodes = stretch == number
        own = nodes[begin]
        samples = left[nodes & (place == 0)]
        known = np.column_stack([times, sampled])[samples]
        if samples[0] in first:
            run = data.trajectories[trajectory[np.argmax(nodes)]]
            known = np.vstack([run.past, known])
        at, *inputs = known.T
        curves = tuple(map(partial(InputCurve, at), inputs, hold))
        for k in np.flatnonzero(hold == "cubic"):
            u[nodes, k] = curves[k].after(t[nodes])
            ends = curves[k].lines(t[begin[own]], t[begin[own] + 1])
            u0[own, k], u1[own, k] = ends[:2]
        past.append(curves)
    h = t[begin + 1] - t[begin]
    of_inputs = (u0, u1, u, stretch, tuple(past))
    return Grid(t, y, trajectory, place == 0, begin, h, *of_inputs)


def steps_per_gap(grid: Grid) -> list[np.ndarray]:
    """Number of intervals in every gap, (n_samples - 1,) per trajectory."""
    return [np.diff(np.flatnonzero(is_sample)) for is_sample in grid.split(grid.sample)]


# ---- the model's order


@dataclass(frozen=True, eq=False)
class AlignedData:
    """Measurements with states and inputs in a model's order, and their layout.

    Made once and handed on: alignments for larger models are kept. The grid has one
    interval between neighbouring samples; notes say which runs are copies of others,
    which inputs jump but are interpolated, which the model does not have, and which
    channels may be angles in degrees.
    """

    data: Measurements
    grid: Grid
    notes: tuple[str, ...] = ()
    _larger: dict[tuple[str, ...], "AlignedData"] = field(
        default_factory=dict, repr=False
    )

    @classmethod
    @typed
    def of(cls, model: Model, data: Measurements) -> "AlignedData":
        """Align and lay out measurements that hold what the model needs.

        Raises:
            DataError: a state or input of the model is not in the measurements, or one
                of theirs is not in the model; or these are no measurements.
        """
        ordered = aligned(model, data)
        copies = copies_in(ordered)
        once = counted_once(ordered, copies)
        notes = [sentence_about(copies)] if copies else []
        notes += [*_notes_on_inputs(model, data), *_notes_on_angles(model, once)]
        return cls(once, grid_of(once), tuple(notes))

    def for_model(self, model: Model) -> "AlignedData":
        """The same for a model that has states more; itself where it has none."""
        if (model.states, model.inputs) == (self.data.states, self.data.inputs):
            return self
        states = tuple(model.states)
        if states not in self._larger:
            data = aligned(model, self.data)
            self._larger[states] = AlignedData(data, grid_of(data), self.notes)
        return self._larger[states]

    def held_as(self, hold: Hold, notes: tuple[str, ...]) -> "AlignedData":
        """The same samples with inputs that do otherwise between them."""
        data = replace(self.data, hold=hold)
        return AlignedData(data, grid_of(data), notes)

    def grid_with(self, steps: Sequence[np.ndarray]) -> Grid:
        """The layout with other numbers of intervals in every gap between samples.

        ``steps`` has one array (n_samples - 1,) per trajectory.
        """
        if all(np.all(n == 1) for n in steps):
            return self.grid
        return grid_of(self.data, steps)


class WithMeasurements:
    """What has aligned measurements, and is asked for their parts."""

    aligned: AlignedData

    @property
    def data(self) -> Measurements:
        """The measurements, states and inputs in the model's order."""
        return self.aligned.data

    @property
    def grid(self) -> Grid:
        """The measurements laid out, one interval between neighbouring samples."""
        return self.aligned.grid

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the trajectories."""
        return tuple(run.name for run in self.data.trajectories)


def _notes_on_inputs(model: Model, data: Measurements) -> Iterator[str]:
    """A sentence on every input that is not used, or that jumps and is not held."""
    for k, hold in enumerate(hold_of_each(data.hold, data.inputs)):
        name = data.inputs[k]
        if name not in model.inputs:
            yield (
                f"input {name} was measured, but is no input of the model; to consider "
                "effects that depend on it, add it to these (no formula needs it)"
            )
        elif hold == "linear" and is_stepped([run.u[:, k] for run in data]):
            yield (
                f"input {name} is constant between jumps, but it is interpolated "
                "between samples, so that it acts half a sample too early; if it keeps "
                f'each value until the next sample, give hold={{"{name}": "zero"}} '
                f'(in a study file: {name} = {{ ..., hold = "zero" }})'
            )


def _notes_on_angles(model: Model, data: Measurements) -> Iterator[str]:
    """A sentence on every channel without a unit that may be an angle in degrees."""
    angles: dict[str, str] = {}
    for placed in model.placed():
        angles |= angles_in(placed.term.body)
    for one in data.look.channels:
        low, high = np.fmin.reduce(one.values), np.fmax.reduce(one.values)
        # More than a turn in radians: a motor turns so far, and has a unit.
        if one.name in angles and not one.unit and high - low > 2 * np.pi:
            yield (
                f"{one.name} runs from {low:.3g} to {high:.3g} in {angles[one.name]}, "
                "which takes radians: probably these are degrees. Give the unit of "
                f'{one.name}, "deg" or "rad"; study files and data.in_si() convert it'
            )


def checked_data(model: Model, data: Measurements) -> AlignedData:
    """`AlignedData.of`, where the units of data and parameters fit together.

    Raises:
        DataError: as there.
        ModelError: as there, or units contradict each other in a formula.
    """
    found = AlignedData.of(model, data)
    UnitCheck(model, data.units).refuse()
    return found


def aligned_once(model: Model, data: Measurements) -> Measurements:
    """`aligned`, without runs that are copies of others."""
    ordered = aligned(model, data)
    return counted_once(ordered, copies_in(ordered))


def aligned(model: Model, data: Measurements) -> Measurements:
    """The measurements with their states and inputs in the model's order.

    States that are the memory of an effect, and momenta of measured positions, need not
    be in the measurements: nobody measures them. They are added as columns of NaN.
    Measurements that are in the model's order already are returned as they are.

    Raises:
        DataError: a state or an input of the model is not in the measurements, or the
            measurements have a state that the model has not.
    """
    lacking = [name for name in model.memory if name not in data.states]
    if not set(model.states) <= {*data.states, *lacking}:
        for momentum, position in position_of_momentum(model).items():
            if position in data.states and momentum not in data.states:
                lacking.append(momentum)
    known = (*data.states, *lacking)
    _check_names(model, known, data.inputs)
    if known == model.states and data.inputs == model.inputs and not lacking:
        return data
    state_columns = list(map(known.index, model.states))
    input_columns = list(map(data.inputs.index, model.inputs))
    trajectories = []
    for run in data.trajectories:
        not_measured = np.full((run.n_samples, len(lacking)), np.nan)
        x = np.column_stack([run.x, not_measured])[:, state_columns]
        past = run.past[:, [0, *(1 + k for k in input_columns)]]
        own = replace(run, x=x, u=run.u[:, input_columns], past=past)
        trajectories.append(own)
    kept = {"t", *model.states, *model.inputs}
    hold = data.hold
    if not isinstance(hold, str):
        hold = {name: hold[name] for name in model.inputs}
    return replace(
        data,
        trajectories=tuple(trajectories),
        states=tuple(model.states),
        inputs=tuple(model.inputs),
        units={name: unit for name, unit in data.units.items() if name in kept},
        labels={name: one for name, one in data.labels.items() if name in kept},
        hold=hold,
    )


def _check_names(model: Model, states: Sequence[str], inputs: Sequence[str]) -> None:
    for name in model.states:
        if name not in states:
            raise DataError(
                f"state {name!r} of the model is not in the measurements "
                f"({', '.join(states)}); declare it as not measured: "
                f"states={{..., {name!r}: None}}."
            )
    for name in model.inputs:
        if name not in inputs:
            raise DataError(
                f"input {name!r} of the model is not in the measurements "
                f"({some_of(inputs) or 'none'}); read its column: "
                f"inputs={{{name!r}: column}}."
            )
    extra = sorted(set(states) - set(model.states))
    if extra:
        raise DataError(
            f"state {extra[0]!r} of the measurements is not in the model; "
            "leave its column out."
        )

"""Measurements: what was recorded, checked once, and never changed afterwards.

Every later step relies on what is checked here: times increase, inputs are known at
every sample, states are finite or NaN (not measured), names can be used in formulas.
Values are reported when they are wrong, never repaired, interpolated, scaled or
filtered. Reading files and data frames is here too, because a message about a bad value
has to name the line and the column it came from.
"""

import hashlib
import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Real
from typing import Any, Self

import numpy as np
import pandas as pd

from phsi_opt.data.checks import (
    HOLDS,
    as_columns,
    as_tuple,
    check_same_length,
    check_unique,
    checked_names,
    checked_noise,
    checked_units,
    counted,
    numbered,
)
from phsi_opt.data.pairs import check_pair_times, pair_arrays, pair_inputs, same_rows
from phsi_opt.data.tables import (
    ColumnMap,
    Layout,
    Source,
    Table,
    column_map,
    csv_tables,
    sources,
    trajectories,
)
from phsi_opt.data.trajectory import Trajectory, check_channels
from phsi_opt.errors import DataError, did_you_mean


@dataclass(frozen=True, eq=False, repr=False)
class Measurements:
    """Several trajectories of the same channels, with names, units and noise levels.

    `units` holds every state, input and "t" ("" when unknown). `hold` says what inputs
    do between samples: "linear" interpolation, or "zero" (the sample's value is kept
    until the next sample). `noise` holds standard deviations of the measurement noise
    by state, in the state's unit; None, or a state left out: unknown. Raises
    `DataError`.
    """

    trajectories: tuple[Trajectory, ...]
    states: tuple[str, ...]
    inputs: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    hold: str = "linear"
    noise: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        trajectories = _checked_trajectories(self.trajectories)
        states, inputs = (
            checked_names(self.states, "states"),
            checked_names(self.inputs, "inputs"),
        )
        check_unique(states + inputs, "name")
        if self.hold not in HOLDS:
            hint = did_you_mean(self.hold, HOLDS)
            raise DataError(
                f"hold={self.hold!r} is unknown; expected 'linear' or 'zero'.{hint}"
            )
        checked = {
            "trajectories": trajectories,
            "states": states,
            "inputs": inputs,
            "units": checked_units(self.units, ("t", *states, *inputs)),
            "noise": checked_noise(self.noise, states),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        for trajectory in trajectories:
            check_channels(trajectory, states, inputs)

    @classmethod
    def from_csv(
        cls,
        source: Source | Iterable[Source],
        *,
        time: str,
        states: ColumnMap,
        inputs: ColumnMap | None = None,
        hold: str = "linear",
        trajectory: str | None = None,
        units: Mapping[str, str] | None = None,
        noise: Mapping[str, float] | None = None,
    ) -> Self:
        """Read text tables with a header line: UTF-8, decimal points, separated by
        comma, semicolon or tab.

        `source` is a path, an open text file, or several of them: then each file is a
        trajectory of its own. `time` and `trajectory` name columns; each value in the
        column `trajectory` is one trajectory, whose lines need not be contiguous but
        keep their order. `states` and `inputs` map names to columns (or list columns
        whose names they share); a state mapped to None was not measured. Empty cells,
        nan and NA are missing samples. Raises `DataError` with file, column and line
        number (the header is line 1 when it is the file's first).
        """
        layout = Layout(
            time, column_map(states, "states"), column_map(inputs, "inputs"), trajectory
        )
        runs = trajectories(csv_tables(sources(source), layout), layout)
        return cls(
            runs,
            tuple(layout.states),
            tuple(layout.inputs),
            {} if units is None else units,
            hold,
            noise,
        )

    @classmethod
    def from_dataframe(
        cls,
        frame: pd.DataFrame,
        *,
        time: str,
        states: ColumnMap,
        inputs: ColumnMap | None = None,
        hold: str = "linear",
        trajectory: str | None = None,
        units: Mapping[str, str] | None = None,
        noise: Mapping[str, float] | None = None,
    ) -> Self:
        """As `from_csv`, from a data frame, which is not changed; messages name the row
        by its label in the index.
        """
        if not isinstance(frame, pd.DataFrame):
            raise DataError(
                f"frame is a {type(frame).__name__}; expected a pandas.DataFrame (files: from_csv)."
            )
        layout = Layout(
            time, column_map(states, "states"), column_map(inputs, "inputs"), trajectory
        )
        runs = trajectories([Table("data frame", "row", frame, "run 1")], layout)
        return cls(
            runs,
            tuple(layout.states),
            tuple(layout.inputs),
            {} if units is None else units,
            hold,
            noise,
        )

    @classmethod
    def from_arrays(
        cls,
        t: Any,
        x: Any,
        u: Any = None,
        *,
        states: Sequence[str],
        inputs: Sequence[str] | None = None,
        names: Sequence[str] | None = None,
        hold: str = "linear",
        units: Mapping[str, str] | None = None,
        noise: Mapping[str, float] | None = None,
    ) -> Self:
        """One trajectory from t (n_samples,), x (n_samples, n_states), u (n_samples,
        n_inputs), or lists of those.

        A single state or input may be (n_samples,). Inputs are called u1, u2, ... and
        trajectories "run 1", "run 2", ... unless `inputs` and `names` say otherwise.
        """
        several = isinstance(t, list | tuple) and len(t) > 0 and np.ndim(t[0]) > 0
        ts, xs, us = (t, x, u) if several else ([t], [x], None if u is None else [u])
        us = [np.empty((np.size(t_run), 0)) for t_run in ts] if us is None else us
        names = numbered("run ", len(ts)) if names is None else names
        check_same_length(
            {"t": ts, "x": xs, "u": us, "names": names}, "one entry per trajectory"
        )
        rows = zip(names, ts, xs, us, strict=True)
        runs = tuple(
            Trajectory(name, t_run, as_columns(x_run), as_columns(u_run))
            for name, t_run, x_run, u_run in rows
        )
        inputs = numbered("u", runs[0].u.shape[1]) if inputs is None else inputs
        return cls(
            runs,
            as_tuple(states),
            as_tuple(inputs),
            {} if units is None else units,
            hold,
            noise,
        )

    @classmethod
    def from_pairs(
        cls,
        x_start: Any,
        x_end: Any,
        t_start: Any,
        t_end: Any,
        *,
        states: Sequence[str] | None = None,
        u_start: Any = None,
        u_end: Any = None,
        inputs: Sequence[str] | None = None,
        hold: str = "linear",
        units: Mapping[str, str] | None = None,
        noise: Mapping[str, float] | None = None,
    ) -> Self:
        """From integration steps: x_start, x_end (n_pairs, n_states), t_start, t_end
        (n_pairs,), u (n_pairs, n_inputs).

        A pair which starts exactly where the pair before it ended (same time, same
        state, same input) continues its trajectory; any other pair starts a new one.
        With hold="zero" the input at the end of a pair acts on nothing: it is not
        compared, and `u_end` may be left out. States are called x1, x2, ... unless
        `states` says otherwise.
        """
        x0, x1 = pair_arrays(x_start, x_end, 2, "x")
        t0, t1 = pair_arrays(t_start, t_end, 1, "t")
        u0, u1 = pair_inputs(u_start, u_end, len(t0), hold)
        check_same_length(
            {"x_start": x0, "t_start": t0, "u_start": u0}, "one row per pair"
        )
        check_pair_times(t0, t1)
        follows = (t0[1:] == t1[:-1]) & same_rows(x0[1:], x1[:-1])
        if hold != "zero":
            follows &= same_rows(u0[1:], u1[:-1])
        runs = np.split(np.arange(len(t0)), np.flatnonzero(~follows) + 1)
        t, x, u = (
            [np.concatenate([a[rows], b[rows[-1:]]]) for rows in runs]
            for a, b in ((t0, t1), (x0, x1), (u0, u1))
        )
        states = numbered("x", x0.shape[1]) if states is None else states
        return cls.from_arrays(
            t, x, u, states=states, inputs=inputs, hold=hold, units=units, noise=noise
        )

    @property
    def n_states(self) -> int:
        return len(self.states)

    @property
    def n_inputs(self) -> int:
        return len(self.inputs)

    @property
    def n_trajectories(self) -> int:
        return len(self.trajectories)

    @property
    def n_samples(self) -> int:
        """Samples of all trajectories together."""
        return sum(trajectory.n_samples for trajectory in self.trajectories)

    @property
    def measured(self) -> tuple[str, ...]:
        """The states with at least one finite value."""
        seen = np.any(
            [np.isfinite(trajectory.x).any(axis=0) for trajectory in self.trajectories],
            axis=0,
        )
        return tuple(
            name for name, is_seen in zip(self.states, seen, strict=True) if is_seen
        )

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the trajectories' names, times, states and inputs, as hex digits.

        A fit keeps it to recognise the measurements that it came from.
        """
        digest = hashlib.sha256()
        for run in self.trajectories:
            digest.update(run.name.encode())
            for array in (run.t, run.x, run.u):
                digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def __len__(self) -> int:
        return self.n_trajectories

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self.trajectories)

    def __getitem__(self, key: int | slice | str) -> Self:
        """The measurements of one trajectory (by position or name) or of several (by
        slice).
        """
        if isinstance(key, slice):
            return replace(self, trajectories=self.trajectories[key])
        number = self.trajectory_number(key)
        return replace(self, trajectories=(self.trajectories[number],))

    def trajectory_number(self, trajectory: str | int) -> int:
        """The number of a trajectory, counted from 0, by its name or its number.

        Negative numbers count from the end, as in a list.

        Args:
            trajectory: The trajectory's name, or its number.

        Returns:
            A number from 0 to ``n_trajectories - 1``.

        Raises:
            DataError: There is no such trajectory.
        """
        names = [run.name for run in self.trajectories]
        if isinstance(trajectory, str):
            if trajectory in names:
                return names.index(trajectory)
            hint = did_you_mean(trajectory, names)
            raise DataError(
                f"there is no trajectory {trajectory!r}; expected one of {names}.{hint}"
            )
        if not hasattr(trajectory, "__index__"):
            raise DataError(
                f"trajectory {trajectory!r} is unknown; expected a name of {names} "
                "or a number, counted from 0."
            )
        number = operator.index(trajectory)
        if not -len(names) <= number < len(names):
            raise DataError(
                f"there is no trajectory {number}; there are {len(names)}, "
                f"counted from 0: {names}."
            )
        return number % len(names)

    def split(self, fraction: float = 0.7) -> tuple[Self, Self]:
        """(train, test): the first `fraction` (0 < fraction < 1) of the trajectories,
        and the others.

        A single trajectory is cut in time instead: its first round(fraction *
        n_samples) samples, and the samples after them. Nothing is drawn at random: the
        order of the file decides. Each part has at least one trajectory, or two
        samples, and no sample is in both.
        """
        if not isinstance(fraction, Real) or not 0 < float(fraction) < 1:
            raise DataError(
                f"fraction={fraction!r} is not between 0 and 1; give the training data's share, e.g. 0.7."
            )
        if self.n_trajectories > 1:
            cut = _share(float(fraction), self.n_trajectories, 1)
            return self[:cut], self[cut:]
        run = self.trajectories[0]
        if run.n_samples < 4:
            raise DataError(
                f"trajectory {run.name!r} has {run.n_samples} samples; a split in time needs at least 4."
            )
        cut = _share(float(fraction), run.n_samples, 2)
        parts = [
            Trajectory(run.name, run.t[rows], run.x[rows], run.u[rows])
            for rows in (slice(cut), slice(cut, None))
        ]
        return replace(self, trajectories=(parts[0],)), replace(
            self, trajectories=(parts[1],)
        )

    def with_noise(self, noise: Mapping[str, float] | None) -> Self:
        """The same measurements with other standard deviations of the noise."""
        return replace(self, noise=noise)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per sample, with the columns trajectory, t, the states and the
        inputs.
        """
        names = np.repeat(
            [trajectory.name for trajectory in self],
            [trajectory.n_samples for trajectory in self],
        )
        values = np.concatenate(
            [np.column_stack([run.t, run.x, run.u]) for run in self]
        )
        frame = pd.DataFrame(values, columns=["t", *self.states, *self.inputs])
        frame.insert(0, "trajectory", names.tolist())
        return frame

    def __repr__(self) -> str:
        first, last = min(run.t[0] for run in self), max(run.t[-1] for run in self)
        counts = f"{counted(self.n_trajectories, 'trajectory', 'trajectories')}, {self.n_samples} samples"
        lines = [
            f"Measurements: {counts}, t = {first:g} to {last:g}{_unit(self.units['t'])}"
        ]
        for word, names, label in (
            ("state", self.states, "x"),
            ("input", self.inputs, "u"),
        ):
            values = np.concatenate([getattr(run, label) for run in self])
            for name, column in zip(names, values.T, strict=True):
                noise = (
                    f", noise {self.noise[name]:g}"
                    if self.noise and name in self.noise
                    else ""
                )
                lines.append(
                    f"  {word} {name}{_unit(self.units[name])}: {_summary(column)}{noise}"
                )
        return "\n".join(lines)

    def __reduce__(self) -> tuple[Any, ...]:  # a mappingproxy cannot be pickled
        noise = None if self.noise is None else dict(self.noise)
        return type(self), (
            self.trajectories,
            self.states,
            self.inputs,
            dict(self.units),
            self.hold,
            noise,
        )


def _checked_trajectories(trajectories: Any) -> tuple[Trajectory, ...]:
    runs = as_tuple(trajectories)
    if not isinstance(runs, tuple) or not runs:
        raise DataError(
            f"trajectories={trajectories!r}; expected a list or tuple of at least one Trajectory."
        )
    for i, run in enumerate(runs):
        if not isinstance(run, Trajectory):
            raise DataError(
                f"trajectories[{i}] is a {type(run).__name__}; expected a Trajectory (see from_arrays)."
            )
    check_unique([run.name for run in runs], "trajectory name")
    return runs


def _share(fraction: float, n: int, at_least: int) -> int:
    return min(max(round(fraction * n), at_least), n - at_least)


def _unit(unit: str) -> str:
    return f" [{unit}]" if unit else ""


def _summary(values: np.ndarray) -> str:
    seen = values[np.isfinite(values)]
    if not seen.size:
        return "not measured"
    return f"{seen.size} of {values.size} samples measured, {seen.min():g} to {seen.max():g}"

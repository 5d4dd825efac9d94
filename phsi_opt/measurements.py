"""Measurements: what was recorded, checked once, and never changed afterwards.

Every later step relies on what is checked here: times increase, inputs are known at every sample, states are finite
or NaN (not measured), names can be used in formulas. Values are reported when they are wrong, never repaired,
interpolated, scaled or filtered. Reading files and data frames is here too, because a message about a bad value has to
name the line and the column it came from.
"""

from __future__ import annotations

import csv
import functools
import io
import keyword
import operator
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from numbers import Real
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self, TextIO

import numpy as np
import pandas as pd

from phsi_opt.errors import DataError, did_you_mean

HOLDS = ("linear", "zero")
RESERVED_NAMES = ("t", "trajectory")  # the time in formulas; the first column of to_dataframe
RESERVED_PREFIX = "dH_d"  # formulas write dH_dp for the velocity dH/dp
LARGEST = 1e100  # squares of larger values leave the range of float64 in sums of squares
MISSING_CELLS = frozenset({"", "nan", "na", "n/a"})

ColumnMap = Mapping[str, Any] | Sequence[str]  # name -> column, or names which are columns
Source = str | os.PathLike[str] | TextIO


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """One experiment. The arrays are read-only float64 copies; times increase strictly.

    The values of x and u are checked by `Measurements`, which knows the channels' names.
    """

    name: str
    t: np.ndarray  # (n_samples,)
    x: np.ndarray  # (n_samples, n_states), NaN where not measured
    u: np.ndarray  # (n_samples, n_inputs)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise DataError(f"trajectory name {self.name!r} is not a text; give each trajectory a non-empty name.")
        for label, n_axes in (("t", 1), ("x", 2), ("u", 2)):
            array = _read_only_floats(getattr(self, label), n_axes, f"trajectory {self.name!r}: {label}")
            object.__setattr__(self, label, array)
        _check_lengths(self)
        _check_times(self)

    @property
    def n_samples(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"Trajectory({self.name!r}, {self.n_samples} samples, t = {self.t[0]:g} to {self.t[-1]:g})"

    def __reduce__(self) -> tuple[Any, ...]:  # unpickled arrays would be writeable
        return type(self), (self.name, self.t, self.x, self.u)


@dataclass(frozen=True, eq=False, repr=False)
class Measurements:
    """Several trajectories of the same channels, with names, units and noise levels.

    `units` holds every state, input and "t" ("" when unknown). `hold` says what inputs do between samples: "linear"
    interpolation, or "zero" (the sample's value is kept until the next sample). `noise` holds standard deviations of
    the measurement noise by state, in the state's unit; None, or a state left out: unknown. Raises `DataError`.
    """

    trajectories: tuple[Trajectory, ...]
    states: tuple[str, ...]
    inputs: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    hold: str = "linear"
    noise: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        trajectories = _checked_trajectories(self.trajectories)
        states, inputs = _checked_names(self.states, "states"), _checked_names(self.inputs, "inputs")
        _check_unique(states + inputs, "name")
        if self.hold not in HOLDS:
            hint = did_you_mean(self.hold, HOLDS)
            raise DataError(f"hold={self.hold!r} is unknown; expected 'linear' or 'zero'.{hint}")
        checked = {
            "trajectories": trajectories,
            "states": states,
            "inputs": inputs,
            "units": _checked_units(self.units, ("t", *states, *inputs)),
            "noise": _checked_noise(self.noise, states),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        for trajectory in trajectories:
            _check_channels(trajectory, states, inputs)

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
        """Read text tables with a header line: UTF-8, decimal points, separated by comma, semicolon or tab.

        `source` is a path, an open text file, or several of them: then each file is a trajectory of its own.
        `time` and `trajectory` name columns; each value in the column `trajectory` is one trajectory, whose lines need
        not be contiguous but keep their order. `states` and `inputs` map names to columns (or list columns whose
        names they share); a state mapped to None was not measured. Empty cells, nan and NA are missing samples.
        Raises `DataError` with file, column and line number (the header is line 1 when it is the file's first).
        """
        layout = _Layout(time, _column_map(states, "states"), _column_map(inputs, "inputs"), trajectory)
        runs = _trajectories(_csv_tables(_sources(source), layout), layout)
        return cls(runs, tuple(layout.states), tuple(layout.inputs), {} if units is None else units, hold, noise)

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
        """As `from_csv`, from a data frame, which is not changed; messages name the row by its label in the index."""
        if not isinstance(frame, pd.DataFrame):
            raise DataError(f"frame is a {type(frame).__name__}; expected a pandas.DataFrame (files: from_csv).")
        layout = _Layout(time, _column_map(states, "states"), _column_map(inputs, "inputs"), trajectory)
        runs = _trajectories([_Table("data frame", "row", frame, "run 1")], layout)
        return cls(runs, tuple(layout.states), tuple(layout.inputs), {} if units is None else units, hold, noise)

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
        """One trajectory from t (n_samples,), x (n_samples, n_states), u (n_samples, n_inputs), or lists of those.

        A single state or input may be (n_samples,). Inputs are called u1, u2, ... and trajectories "run 1", "run 2",
        ... unless `inputs` and `names` say otherwise.
        """
        several = isinstance(t, list | tuple) and len(t) > 0 and np.ndim(t[0]) > 0
        ts, xs, us = (t, x, u) if several else ([t], [x], None if u is None else [u])
        us = [np.empty((np.size(t_run), 0)) for t_run in ts] if us is None else us
        names = _numbered("run ", len(ts)) if names is None else names
        _check_same_length({"t": ts, "x": xs, "u": us, "names": names}, "one entry per trajectory")
        rows = zip(names, ts, xs, us, strict=True)
        runs = tuple(
            Trajectory(name, t_run, _as_columns(x_run), _as_columns(u_run)) for name, t_run, x_run, u_run in rows
        )
        inputs = _numbered("u", runs[0].u.shape[1]) if inputs is None else inputs
        return cls(runs, _as_tuple(states), _as_tuple(inputs), {} if units is None else units, hold, noise)

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
        """From integration steps: x_start, x_end (n_pairs, n_states), t_start, t_end (n_pairs,), u (n_pairs, n_inputs).

        A pair which starts exactly where the pair before it ended (same time, same state, same input) continues its
        trajectory; any other pair starts a new one. With hold="zero" the input at the end of a pair acts on nothing: it
        is not compared, and `u_end` may be left out. States are called x1, x2, ... unless `states` says otherwise.
        """
        x0, x1 = _pair_arrays(x_start, x_end, 2, "x")
        t0, t1 = _pair_arrays(t_start, t_end, 1, "t")
        u0, u1 = _pair_inputs(u_start, u_end, len(t0), hold)
        _check_same_length({"x_start": x0, "t_start": t0, "u_start": u0}, "one row per pair")
        _check_pair_times(t0, t1)
        follows = (t0[1:] == t1[:-1]) & _same_rows(x0[1:], x1[:-1])
        if hold != "zero":
            follows &= _same_rows(u0[1:], u1[:-1])
        runs = np.split(np.arange(len(t0)), np.flatnonzero(~follows) + 1)
        t, x, u = (
            [np.concatenate([a[rows], b[rows[-1:]]]) for rows in runs] for a, b in ((t0, t1), (x0, x1), (u0, u1))
        )
        states = _numbered("x", x0.shape[1]) if states is None else states
        return cls.from_arrays(t, x, u, states=states, inputs=inputs, hold=hold, units=units, noise=noise)

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
        seen = np.any([np.isfinite(trajectory.x).any(axis=0) for trajectory in self.trajectories], axis=0)
        return tuple(name for name, is_seen in zip(self.states, seen, strict=True) if is_seen)

    def __len__(self) -> int:
        return self.n_trajectories

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self.trajectories)

    def __getitem__(self, key: int | slice | str) -> Self:
        """The measurements of one trajectory (by position or name) or of several (by slice)."""
        if isinstance(key, slice):
            return replace(self, trajectories=self.trajectories[key])
        return replace(self, trajectories=(self.trajectories[self._position(key)],))

    def _position(self, key: int | str) -> int:
        names = [trajectory.name for trajectory in self.trajectories]
        if isinstance(key, str):
            if key not in names:
                raise DataError(f"there is no trajectory {key!r}; expected one of {names}.{did_you_mean(key, names)}")
            return names.index(key)
        if not hasattr(key, "__index__"):
            raise DataError(f"trajectory {key!r} is unknown; expected a position, a slice or a name.")
        position = operator.index(key)
        if not -len(names) <= position < len(names):
            raise DataError(f"there is no trajectory {position}; there are {len(names)}, counted from 0.")
        return position

    def split(self, fraction: float = 0.7) -> tuple[Self, Self]:
        """(train, test): the first `fraction` (0 < fraction < 1) of the trajectories, and the others.

        A single trajectory is cut in time instead: its first round(fraction * n_samples) samples, and the samples after
        them. Nothing is drawn at random: the order of the file decides. Each part has at least one trajectory, or two
        samples, and no sample is in both.
        """
        if not isinstance(fraction, Real) or not 0 < float(fraction) < 1:
            raise DataError(f"fraction={fraction!r} is not between 0 and 1; give the training data's share, e.g. 0.7.")
        if self.n_trajectories > 1:
            cut = _share(float(fraction), self.n_trajectories, 1)
            return self[:cut], self[cut:]
        run = self.trajectories[0]
        if run.n_samples < 4:
            raise DataError(f"trajectory {run.name!r} has {run.n_samples} samples; a split in time needs at least 4.")
        cut = _share(float(fraction), run.n_samples, 2)
        parts = [Trajectory(run.name, run.t[rows], run.x[rows], run.u[rows]) for rows in (slice(cut), slice(cut, None))]
        return replace(self, trajectories=(parts[0],)), replace(self, trajectories=(parts[1],))

    def with_noise(self, noise: Mapping[str, float] | None) -> Self:
        """The same measurements with other standard deviations of the noise."""
        return replace(self, noise=noise)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per sample, with the columns trajectory, t, the states and the inputs."""
        names = np.repeat([trajectory.name for trajectory in self], [trajectory.n_samples for trajectory in self])
        values = np.concatenate([np.column_stack([run.t, run.x, run.u]) for run in self])
        frame = pd.DataFrame(values, columns=["t", *self.states, *self.inputs])
        frame.insert(0, "trajectory", names.tolist())
        return frame

    def __repr__(self) -> str:
        first, last = min(run.t[0] for run in self), max(run.t[-1] for run in self)
        counts = f"{_count(self.n_trajectories, 'trajectory', 'trajectories')}, {self.n_samples} samples"
        lines = [f"Measurements: {counts}, t = {first:g} to {last:g}{_unit(self.units['t'])}"]
        for word, names, label in (("state", self.states, "x"), ("input", self.inputs, "u")):
            values = np.concatenate([getattr(run, label) for run in self])
            for name, column in zip(names, values.T, strict=True):
                noise = f", noise {self.noise[name]:g}" if self.noise and name in self.noise else ""
                lines.append(f"  {word} {name}{_unit(self.units[name])}: {_summary(column)}{noise}")
        return "\n".join(lines)

    def __reduce__(self) -> tuple[Any, ...]:  # a mappingproxy cannot be pickled
        noise = None if self.noise is None else dict(self.noise)
        return type(self), (self.trajectories, self.states, self.inputs, dict(self.units), self.hold, noise)


# ---- checks of arrays and records ------------------------------------------------------------------------------------


def _read_only_floats(values: Any, n_axes: int, where: str) -> np.ndarray:
    """A read-only float64 copy; masked entries become NaN, which says that they were not measured."""
    try:
        array = np.ma.asanyarray(values)
    except ValueError as error:
        raise DataError(f"{where} is not a regular array ({error}); every row must have the same length.") from error
    if array.dtype.kind not in "biuf":
        raise DataError(f"{where} has the type {array.dtype}; expected real numbers, NaN where nothing was measured.")
    if array.ndim != n_axes:
        expected = "(n_samples,)" if n_axes == 1 else "(n_samples, n_channels)"
        raise DataError(f"{where} has the shape {array.shape}; expected {expected}. Reshape the array.")
    floats: np.ndarray = np.array(array.astype(np.float64).filled(np.nan))
    floats.flags.writeable = False
    return floats


def _check_lengths(run: Trajectory) -> None:
    for label, array in (("x", run.x), ("u", run.u)):
        if len(array) != len(run.t):
            raise DataError(
                f"trajectory {run.name!r}: {label} has {len(array)} rows and t has {len(run.t)}; "
                "expected one row per time. Check that the arrays belong together and are not transposed."
            )
    if len(run.t) < 2:
        found = _count(len(run.t), "sample", "samples")
        raise DataError(f"trajectory {run.name!r} has {found}; expected at least 2. Leave the trajectory out.")


def _check_times(run: Trajectory) -> None:
    _check_values(run.t, lambda i: f"trajectory {run.name!r}: t[{i}]", may_be_missing=False)
    late = np.flatnonzero(np.diff(run.t) <= 0)
    if late.size:
        k = int(late[0])
        raise DataError(
            f"trajectory {run.name!r}: t[{k + 1}]={float(run.t[k + 1])} is not after t[{k}]={float(run.t[k])}; "
            "times must increase strictly. Sort the samples or drop the duplicate."
        )


def _check_values(values: np.ndarray, where: Callable[[int], str], may_be_missing: bool) -> None:
    """Refuse infinite and huge values, and NaN unless a sample may be missing; `where` names the i-th value."""
    bad = np.abs(values) > LARGEST
    if not may_be_missing:
        bad |= np.isnan(values)
    if not bad.any():
        return
    i = int(np.argmax(bad))
    if np.isnan(values[i]):
        problem = "is nan; times and inputs must be known at every sample. Drop the sample or fill the gap."
    elif np.isinf(values[i]):
        problem = f"is {values[i]}; expected a finite value. Correct it; a state that was not measured is NaN."
    else:
        problem = f"is {values[i]}; expected at most {LARGEST:g} in size. Correct it or choose a larger unit."
    raise DataError(f"{where(i)} {problem}")


def _check_channels(run: Trajectory, states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
    for word, names, values in (("state", states, run.x), ("input", inputs, run.u)):
        if values.shape[1] != len(names):
            raise DataError(
                f"trajectory {run.name!r} has {_count(values.shape[1], f'{word} column', f'{word} columns')}; "
                f"expected {len(names)}, one for each of {list(names)}. Name every column of the array."
            )
        for name, column in zip(names, values.T, strict=True):
            where = functools.partial(_sample, run, f"{word} {name!r}")
            _check_values(column, where, may_be_missing=word == "state")
    if not np.isfinite(run.x).any():
        raise DataError(
            f"trajectory {run.name!r} has no measured value in any of the states {list(states)}; "
            "expected at least one measured state. Map a state to its column or leave the trajectory out."
        )


def _sample(run: Trajectory, channel: str, i: int) -> str:
    return f"trajectory {run.name!r}: {channel} at sample {i} (t={run.t[i]})"


def _checked_trajectories(trajectories: Any) -> tuple[Trajectory, ...]:
    runs = _as_tuple(trajectories)
    if not isinstance(runs, tuple) or not runs:
        raise DataError(f"trajectories={trajectories!r}; expected a list or tuple of at least one Trajectory.")
    for i, run in enumerate(runs):
        if not isinstance(run, Trajectory):
            raise DataError(f"trajectories[{i}] is a {type(run).__name__}; expected a Trajectory (see from_arrays).")
    _check_unique([run.name for run in runs], "trajectory name")
    return runs


def _checked_names(names: Any, what: str) -> tuple[str, ...]:
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise DataError(f"{what}={names!r} is not a list of names; expected e.g. {what}=['a', 'b'].")
    if what == "states" and not names:
        raise DataError("states=[] names no state; expected at least one.")
    for name in names:
        if not isinstance(name, str) or not name.isidentifier() or keyword.iskeyword(name):
            raise DataError(f"{what}: {name!r} cannot be used in a formula; expected letters, digits, _ as in 'q_1'.")
        if name in RESERVED_NAMES or name.startswith(RESERVED_PREFIX):
            raise DataError(
                f"{what}: the name {name!r} is reserved (the time 't', the column 'trajectory', the derivatives "
                f"'{RESERVED_PREFIX}...'); choose another name and map it to the column."
            )
    return tuple(names)


def _check_unique(names: Sequence[str], what: str) -> None:
    twice = [(name, n_uses) for name, n_uses in Counter(names).items() if n_uses > 1]
    if twice:
        name, n_uses = twice[0]
        raise DataError(f"the {what} {name!r} is used {n_uses} times; each must be used once. Rename one.")


def _checked_units(units: Any, names: tuple[str, ...]) -> Mapping[str, str]:
    _check_keys(units, names, "units")
    for name, unit in units.items():
        if not isinstance(unit, str):
            raise DataError(f"units: {name!r} has the unit {unit!r}; expected text such as 'm', or '' when unknown.")
    return MappingProxyType({name: units.get(name, "") for name in names})


def _checked_noise(noise: Any, states: tuple[str, ...]) -> Mapping[str, float] | None:
    if noise is None:
        return None
    _check_keys(noise, states, "noise")
    for name, sigma in noise.items():
        if not isinstance(sigma, Real) or not 0 < float(sigma) < np.inf:
            raise DataError(
                f"noise: {name!r} has the standard deviation {sigma!r}; expected a positive number in the "
                "state's unit. Leave it out when it is unknown."
            )
    return MappingProxyType({name: float(sigma) for name, sigma in noise.items()})


def _check_keys(mapping: Any, names: tuple[str, ...], what: str) -> None:
    if not isinstance(mapping, Mapping):
        raise DataError(f"{what}={mapping!r} is not a mapping; expected e.g. {{{names[-1]!r}: ...}}.")
    for name in mapping:
        if name not in names:
            hint = did_you_mean(name, names)
            raise DataError(f"{what} names the unknown {name!r}; expected names of {list(names)}.{hint}")


# ---- pairs -----------------------------------------------------------------------------------------------------------


def _pair_arrays(start: Any, end: Any, n_axes: int, label: str) -> tuple[np.ndarray, np.ndarray]:
    names = f"{label}_start", f"{label}_end"
    columns = _as_columns if n_axes == 2 else np.ma.asanyarray
    a, b = (_read_only_floats(columns(v), n_axes, name) for v, name in zip((start, end), names, strict=True))
    if a.shape != b.shape:
        raise DataError(f"{names[0]} has the shape {a.shape} and {names[1]} {b.shape}; expected the same shape.")
    return a, b


def _pair_inputs(start: Any, end: Any, n_pairs: int, hold: str) -> tuple[np.ndarray, np.ndarray]:
    if start is None and end is None:
        return np.empty((n_pairs, 0)), np.empty((n_pairs, 0))
    if start is None or (end is None and hold != "zero"):
        raise DataError("only one of u_start and u_end is given; expected both. If u keeps its value: hold='zero'.")
    return _pair_arrays(start, start if end is None else end, 2, "u")


def _check_pair_times(t0: np.ndarray, t1: np.ndarray) -> None:
    if not len(t0):
        raise DataError("there are no pairs; expected at least one row in x_start and t_start.")
    for label, t in (("t_start", t0), ("t_end", t1)):
        _check_values(t, (label + "[{}]").format, may_be_missing=False)
    late = np.flatnonzero(t1 <= t0)
    if late.size:
        k = int(late[0])
        raise DataError(
            f"pair {k}: t_end[{k}]={float(t1[k])} is not after t_start[{k}]={float(t0[k])}; "
            "each pair must go forward in time. Exchange the two ends or drop the pair."
        )


def _same_rows(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    same: np.ndarray = ((a == b) | (np.isnan(a) & np.isnan(b))).all(axis=1)
    return same


# ---- tables: files and data frames -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Layout:
    """Which column plays which part."""

    time: str
    states: Mapping[str, Any]  # state -> column, or None: not measured
    inputs: Mapping[str, Any]
    trajectory: str | None

    def columns(self) -> list[Any]:
        named = [self.time, *self.states.values(), *self.inputs.values(), self.trajectory]
        return [column for column in named if column is not None]


@dataclass(frozen=True, eq=False)
class _Table:
    """Columns as they were found, with the words that messages use for them."""

    source: str  # "file 'bench.csv'"
    row_word: str  # "line" or "row"
    frame: pd.DataFrame  # its index holds the line numbers or the user's row labels
    run: str  # the trajectory's name where no column tells it

    def where(self, column: Any, i: int) -> str:
        (label,) = self.frame.index[[i]].tolist()  # a Python object: its repr is 3, not np.int64(3)
        return f"{self.source}, column {column!r}, {self.row_word} {label!r}:"


def _column_map(columns: Any, what: str) -> Mapping[str, Any]:
    if columns is None and what == "inputs":
        return {}
    if isinstance(columns, Mapping):
        if what == "inputs" and None in columns.values():
            raise DataError(f"inputs={dict(columns)!r} has an input without a column; inputs must be measured.")
        return dict(columns)
    names = _checked_names(columns, what)
    _check_unique(names, "name")
    return {name: name for name in names}


def _trajectories(tables: Sequence[_Table], layout: _Layout) -> tuple[Trajectory, ...]:
    return tuple(run for table in tables for run in _table_trajectories(table, layout, len(tables) > 1))


def _table_trajectories(table: _Table, layout: _Layout, one_of_several: bool) -> list[Trajectory]:
    _check_columns(table, layout)
    n_rows = len(table.frame)
    t = _numbers(table, layout.time, may_be_missing=False)
    x, u = np.full((n_rows, len(layout.states)), np.nan), np.empty((n_rows, len(layout.inputs)))
    for i, column in enumerate(layout.states.values()):
        if column is not None:
            x[:, i] = _numbers(table, column, may_be_missing=True)
    for i, column in enumerate(layout.inputs.values()):
        u[:, i] = _numbers(table, column, may_be_missing=False)
    if layout.trajectory is None:
        return [Trajectory(table.run, t, x, u)]
    prefix = f"{table.run}/" if one_of_several else ""
    return [Trajectory(prefix + name, t[k], x[k], u[k]) for name, k in _rows_by_run(table, layout.trajectory)]


def _check_columns(table: _Table, layout: _Layout) -> None:
    found = table.frame.columns.tolist()
    for column in layout.columns():
        if column not in found:
            hint = did_you_mean(column, found)
            raise DataError(f"{table.source} has no column {column!r}; expected one of its columns {found}.{hint}")
        if found.count(column) > 1:
            raise DataError(
                f"{table.source} has {found.count(column)} columns called {column!r}; expected one. "
                "Rename them so that it is clear which one is meant."
            )
        if layout.columns().count(column) > 1:
            raise DataError(f"{table.source}: the column {column!r} is asked for twice; expected one column per name.")
    if table.frame.empty:
        raise DataError(f"{table.source} has no samples; expected at least 2 rows of numbers below the header.")


def _rows_by_run(table: _Table, column: str) -> Iterator[tuple[str, np.ndarray]]:
    """Name and row numbers of each run, in the order in which the runs begin."""
    cells = table.frame[column]
    names = cells.astype(str).str.strip()
    missing = (cells.isna() | (names == "")).to_numpy()
    if missing.any():
        where = table.where(column, int(np.argmax(missing)))
        raise DataError(f"{where} the trajectory's name is missing; every sample must name its trajectory.")
    codes, labels = pd.factorize(names)
    ends = np.cumsum(np.bincount(codes))
    for label, rows in zip(labels, np.split(np.argsort(codes, kind="stable"), ends[:-1]), strict=True):
        yield str(label), rows


def _numbers(table: _Table, column: Any, may_be_missing: bool) -> np.ndarray:
    cells = table.frame[column]
    if pd.api.types.is_numeric_dtype(cells) and not pd.api.types.is_complex_dtype(cells):
        values: np.ndarray = cells.to_numpy(dtype=np.float64, na_value=np.nan)
    else:
        values = np.empty(len(cells))
        for i, (cell, is_missing) in enumerate(zip(cells, cells.isna(), strict=True)):
            values[i] = np.nan if is_missing else _number(cell, table, column, i)
    _check_values(values, lambda i: f"{table.where(column, i)} the value", may_be_missing)
    return values


def _number(cell: Any, table: _Table, column: Any, i: int) -> float:
    if isinstance(cell, str) and cell.strip().lower() in MISSING_CELLS:
        return float("nan")
    try:
        return float(cell)
    except (TypeError, ValueError):
        raise DataError(f"{table.where(column, i)} {cell!r} is not a real number. {_repair(cell)}") from None


def _repair(cell: Any) -> str:
    if isinstance(cell, str) and re.fullmatch(r"\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*", cell):
        return (
            "Decimal commas are not read: write decimal points, or give "
            "pandas.read_csv(file, sep=';', decimal=',') to Measurements.from_dataframe."
        )
    if isinstance(cell, str):
        return "Correct the cell, or leave it empty where a state was not measured."
    return "Convert the column to numbers first (times: seconds since the start)."


# ---- text files ------------------------------------------------------------------------------------------------------


def _sources(source: Any) -> list[Any]:
    if isinstance(source, str | os.PathLike) or hasattr(source, "read"):
        return [source]
    if not isinstance(source, list | tuple | Iterator):
        raise DataError(f"source is a {type(source).__name__}; expected a path, a list of paths or an open text file.")
    sources = list(source)
    if not sources:
        raise DataError("source is an empty list; expected at least one path.")
    return sources


def _csv_tables(sources: list[Any], layout: _Layout) -> list[_Table]:
    paths = [_path(source) for source in sources]
    stems = [f"run {i}" if path is None else Path(path).stem for i, path in enumerate(paths, start=1)]
    names = [stem if stems.count(stem) == 1 else str(path) for stem, path in zip(stems, paths, strict=True)]
    titles = ["open file" if path is None else f"file {path!r}" for path in paths]
    frames = [_csv_frame(_text(s, title), title, layout) for s, title in zip(sources, titles, strict=True)]
    return [_Table(*row) for row in zip(titles, ["line"] * len(titles), frames, names, strict=True)]


def _path(source: Any) -> str | None:
    """The path as the user wrote it; None for an open file without one."""
    if isinstance(source, str | os.PathLike):
        return str(source)
    name = getattr(source, "name", None)
    return name if isinstance(name, str) and name else None


def _text(source: Any, title: str) -> str:
    try:
        if hasattr(source, "read"):
            text = source.read()
        elif isinstance(source, str | os.PathLike):
            text = Path(source).read_text(encoding="utf-8")
        else:
            raise DataError(f"source holds a {type(source).__name__}; expected paths or open text files.")
    except UnicodeDecodeError as error:
        raise DataError(f"{title} is not UTF-8 text ({error}). Save it as 'CSV UTF-8'.") from error
    except OSError as error:
        raise DataError(f"{title} cannot be read ({error}). Check the path and the permissions.") from error
    if not isinstance(text, str):
        raise DataError(f"{title} gives {type(text).__name__}; expected text. Open it in text mode: open(path).")
    return text.removeprefix("\ufeff")  # the byte order mark which spreadsheets write


def _csv_frame(text: str, title: str, layout: _Layout) -> pd.DataFrame:
    """The cells as text; the index holds the line numbers. Empty lines are skipped."""
    header: list[str] = []
    rows: dict[int, list[str]] = {}
    reader = csv.reader(io.StringIO(text), delimiter=_separator(text, layout), skipinitialspace=True)
    try:
        for cells in reader:
            stripped = [cell.strip() for cell in cells]
            if not any(stripped):
                continue
            if header:
                rows[reader.line_num] = _fitted(stripped, len(header), f"{title}, line {reader.line_num}")
            else:
                header = _without_trailing_empties(stripped)
    except csv.Error as error:
        raise DataError(f"{title}, line {reader.line_num}: {error}. Save the table again as CSV.") from error
    if not header:
        raise DataError(f"{title} is empty; expected a header line and at least 2 lines of numbers.")
    return pd.DataFrame(list(rows.values()), columns=header, index=list(rows), dtype=object)


def _separator(text: str, layout: _Layout) -> str:
    """The separator with which the header shows most of the wanted columns, then most columns."""
    header = next((line for line in io.StringIO(text) if line.strip()), "")

    def score(separator: str) -> tuple[int, int]:
        cells = [cell.strip() for cell in next(csv.reader([header], delimiter=separator, skipinitialspace=True), [])]
        return len(set(cells) & {str(column) for column in layout.columns()}), len(cells)

    return max(",;\t", key=score)


def _without_trailing_empties(cells: list[str]) -> list[str]:
    n_filled = max(i for i, cell in enumerate(cells, start=1) if cell)
    return cells[:n_filled]


def _fitted(cells: list[str], width: int, where: str) -> list[str]:
    """The cells of one line below the header; only empty cells may be too many."""
    if len(cells) < width or any(cells[width:]):
        raise DataError(
            f"{where} has {len(cells)} cells; expected {width}, as in the header. Complete or remove the line. If its "
            "numbers have decimal commas, write decimal points."
        )
    return cells[:width]


# ---- small things ----------------------------------------------------------------------------------------------------


def _as_tuple(values: Any) -> Any:
    """Lists and other sequences as tuples; texts and what is no sequence stay as they are, to be refused by name."""
    return tuple(values) if isinstance(values, Sequence) and not isinstance(values, str) else values


def _as_columns(values: Any) -> Any:
    """(n,) as (n, 1); everything else as it is, to be checked where its name is known."""
    try:
        array = np.ma.asanyarray(values)
    except ValueError:
        return values
    return array[:, np.newaxis] if array.ndim == 1 else array


def _numbered(prefix: str, n: int) -> list[str]:
    return [f"{prefix}{i}" for i in range(1, n + 1)]


def _check_same_length(sizes: Mapping[str, Any], expected: str) -> None:
    lengths = {name: len(value) if hasattr(value, "__len__") else None for name, value in sizes.items()}
    if len(set(lengths.values())) > 1:
        raise DataError(f"the lengths differ: {lengths}; expected {expected}. Check that the lists belong together.")


def _share(fraction: float, n: int, at_least: int) -> int:
    return min(max(round(fraction * n), at_least), n - at_least)


def _count(n: int, one: str, many: str) -> str:
    return f"{n} {one if n == 1 else many}"


def _unit(unit: str) -> str:
    return f" [{unit}]" if unit else ""


def _summary(values: np.ndarray) -> str:
    seen = values[np.isfinite(values)]
    if not seen.size:
        return "not measured"
    return f"{seen.size} of {values.size} samples measured, {seen.min():g} to {seen.max():g}"

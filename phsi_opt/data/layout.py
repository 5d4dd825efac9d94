"""Which column of a table plays which part, and the trajectories that follow.

Files and data frames meet here: both are tables by now, read by `tables`.
"""

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from phsi_opt.data.checks import check_unique, checked_names
from phsi_opt.data.tables import Table, numbers_in
from phsi_opt.data.times import Times, are_dates, origin_in, times_in
from phsi_opt.data.trajectory import Trajectory
from phsi_opt.errors import DataError, did_you_mean

# name -> column, or a list of names which are columns
ColumnMap = Mapping[str, Any] | Sequence[str]


@dataclass(frozen=True)
class Layout:
    """Which column plays which part.

    Attributes:
        times: Where the times come from.
        states: The column of each state, or None: not measured.
        inputs: The column of each input.
        trajectory: The column which names each row's trajectory, or None: the whole
            table is one trajectory.
    """

    times: Times
    states: Mapping[str, Any]
    inputs: Mapping[str, Any]
    trajectory: str | None

    def columns(self) -> list[Any]:
        """The columns that are asked for, in the order of the parts."""
        columns = [
            self.times.column,
            *self.states.values(),
            *self.inputs.values(),
            self.trajectory,
        ]
        return [column for column in columns if column is not None]


def table_layout(
    time: Any,
    states: Any,
    inputs: Any,
    trajectory: str | None,
    step: float | None = None,
    start: Any = None,
    date_format: str | None = None,
) -> Layout:
    """The layout in a user's words: maps from names to columns, or lists of columns.

    Raises:
        DataError: A name cannot be used, an input has no column, or the times have
            none and no step, or both.
    """
    times = Times(time, step, start, date_format)
    return Layout(times, _state_columns(states), _input_columns(inputs), trajectory)


def _state_columns(states: Any) -> Mapping[str, Any]:
    if isinstance(states, Mapping):
        return dict(states)
    return _columns_of_their_names(states, "states")


def _input_columns(inputs: Any) -> Mapping[str, Any]:
    if inputs is None:
        return {}
    if not isinstance(inputs, Mapping):
        return _columns_of_their_names(inputs, "inputs")
    if None in inputs.values():
        raise DataError(
            f"inputs={dict(inputs)!r} has an input without a column; "
            "inputs must be measured."
        )
    return dict(inputs)


def _columns_of_their_names(names: Any, what: str) -> Mapping[str, Any]:
    checked = checked_names(names, what)
    check_unique(checked, "name")
    return dict(zip(checked, checked, strict=True))


def trajectories_in(tables: Sequence[Table], layout: Layout) -> tuple[Trajectory, ...]:
    """The trajectories of all tables, in the order in which they begin.

    Where several tables have a column that names the trajectory, the table's own name
    comes first: "bench/run 3".

    Raises:
        DataError: A column or a value is missing, or cannot be used.
    """
    trajectories = []
    for table in tables:
        _check_columns(table, layout)
        rows_by_name = _rows_by_name(table, layout)
        samples = _samples(table, layout, rows_by_name)
        is_named = layout.trajectory is not None
        prefix = f"{table.run}/" if is_named and len(tables) > 1 else ""
        for name, rows in rows_by_name.items():
            origin = origin_in(table, layout.times, rows)
            trajectories.append(samples.trajectory(prefix + name, rows, origin))
    return tuple(trajectories)


def with_unit_of_dates(
    units: Mapping[str, str] | None, tables: Sequence[Table], layout: Layout
) -> Mapping[str, str]:
    """The units, with seconds as that of the time where times are dates.

    Raises:
        DataError: The user gave another unit.
    """
    given: Any = {} if units is None else units
    if not isinstance(given, Mapping):
        return given  # refused by `checked_units`
    if not any(are_dates(table, layout.times) for table in tables):
        return given
    unit = given.get("t", "s")
    if unit != "s":
        raise DataError(
            f"units: the time 't' has the unit {unit!r}, and times that are dates are "
            "read in seconds; expected 's'. Leave 't' out of units."
        )
    return {**given, "t": "s"}


@dataclass(frozen=True, eq=False)
class _Samples:
    """The numbers of a whole table, one sample per row, trajectories not yet apart."""

    t: np.ndarray  # (n_rows,)
    x: np.ndarray  # (n_rows, n_states)
    u: np.ndarray  # (n_rows, n_inputs)

    def trajectory(
        self, name: str, rows: np.ndarray, origin: dt.datetime | None
    ) -> Trajectory:
        return Trajectory(name, self.t[rows], self.x[rows], self.u[rows], origin)


def _samples(
    table: Table, layout: Layout, rows_by_name: Mapping[str, np.ndarray]
) -> _Samples:
    n_rows = len(table.frame)
    t = times_in(table, layout.times, rows_by_name.values())
    x = np.full((n_rows, len(layout.states)), np.nan)
    for i, column in enumerate(layout.states.values()):
        if column is not None:
            x[:, i] = numbers_in(table, column, may_be_missing=True)
    u = np.empty((n_rows, len(layout.inputs)))
    for i, column in enumerate(layout.inputs.values()):
        u[:, i] = numbers_in(table, column, may_be_missing=False)
    return _Samples(t, x, u)


def _check_columns(table: Table, layout: Layout) -> None:
    found = table.frame.columns.tolist()
    wanted = layout.columns()
    for column in wanted:
        if column not in found:
            hint = did_you_mean(column, found)
            raise DataError(
                f"{table.title} has no column {column!r}; "
                f"expected one of its columns {found}.{hint}"
            )
        n_found = found.count(column)
        if n_found > 1:
            raise DataError(
                f"{table.title} has {n_found} columns called {column!r}; expected one. "
                "Rename them so that it is clear which one is meant."
            )
        if wanted.count(column) > 1:
            raise DataError(
                f"{table.title}: the column {column!r} is asked for twice; "
                "expected one column per name."
            )
    if table.frame.empty:
        raise DataError(
            f"{table.title} has no samples; "
            "expected at least 2 rows of numbers below the header."
        )


def _rows_by_name(table: Table, layout: Layout) -> dict[str, np.ndarray]:
    """Row numbers of each trajectory, in the order in which the trajectories begin."""
    import pandas as pd

    column = layout.trajectory
    if column is None:
        return {table.run: np.arange(len(table.frame))}
    cells = table.frame[column]
    names = cells.astype(str).str.strip()
    is_missing = (cells.isna() | (names == "")).to_numpy()
    if is_missing.any():
        place = table.place(column, int(np.argmax(is_missing)))
        raise DataError(
            f"{place} the trajectory's name is missing; "
            "every sample must name its trajectory."
        )
    numbers, labels = pd.factorize(names)
    order = np.argsort(numbers, kind="stable")
    ends = np.cumsum(np.bincount(numbers))
    rows = np.split(order, ends[:-1])
    return dict(zip(map(str, labels), rows, strict=True))

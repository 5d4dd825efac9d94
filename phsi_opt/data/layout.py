"""Which column of a table plays which part, and the trajectories that follow.

Files and data frames meet here: both are tables by now, read by `tables`.
"""

import datetime as dt
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from phsi_opt.data.checks import check_unique, checked_names
from phsi_opt.data.tables import Table, numbers_in
from phsi_opt.data.times import Moment, Times, clock_of
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

    @property
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
    step: float | None,
    start: Any,
    date_format: str | None,
) -> Layout:
    """The layout in a user's words: maps from names to columns, or lists of columns.

    Raises:
        DataError: A name cannot be used, an input has no column, or the times have
            none and no step, or both.
    """
    times = Times(time, step, start, date_format)
    of_inputs = _columns_by_name({} if inputs is None else inputs, "inputs")
    if None in of_inputs.values():
        raise DataError(
            f"inputs={of_inputs!r} has an input without a column; "
            "inputs must be measured."
        )
    return Layout(times, _columns_by_name(states, "states"), of_inputs, trajectory)


def _columns_by_name(columns: Any, what: str) -> dict[str, Any]:
    if isinstance(columns, Mapping):
        return dict(columns)
    names = checked_names(columns, what)
    check_unique(names, "name")
    return dict(zip(names, names, strict=True))


def trajectories_in(
    tables: Sequence[Table], layout: Layout, units: Mapping[str, str] | None
) -> tuple[tuple[Trajectory, ...], Mapping[str, str]]:
    """The trajectories of all tables, in the order in which they begin, and the units.

    Where several tables have a column that names the trajectory, the table's own name
    comes first: "bench/run 3". Times that are dates have the unit s.

    Raises:
        DataError: A column or a value is missing, or cannot be used; or times that are
            dates have another unit.
    """
    trajectories = []
    origins: list[Moment] = []
    for table in tables:
        _check_columns(table, layout)
        rows_by_name = _rows_by_name(table, layout)
        clock = clock_of(table, layout.times, list(rows_by_name.values()))
        x = _values(table, layout.states.values(), may_be_missing=True)
        u = _values(table, layout.inputs.values(), may_be_missing=False)
        is_named = layout.trajectory is not None
        prefix = f"{table.run}/" if is_named and len(tables) > 1 else ""
        for number, (name, rows) in enumerate(rows_by_name.items()):
            origin = clock.origins[number] if clock.origins else None
            moment = origin if isinstance(origin, dt.datetime) else None
            run = Trajectory(prefix + name, clock.t[rows], x[rows], u[rows], moment)
            trajectories.append(run)
        origins += clock.origins
    return tuple(trajectories), _with_seconds(units, bool(origins))


def _values(table: Table, columns: Collection[Any], may_be_missing: bool) -> np.ndarray:
    """The values of columns, (n_rows, n_columns); NaN where there is no column."""
    values = np.full((len(table.frame), len(columns)), np.nan)
    for i, column in enumerate(columns):
        if column is not None:
            values[:, i] = numbers_in(table, column, may_be_missing)
    return values


def _with_seconds(units: Any, are_dates: bool) -> Mapping[str, str]:
    """The units, with seconds as that of the time where times are dates."""
    given = {} if units is None else units
    if not are_dates or not isinstance(given, Mapping):
        return given  # what is no mapping is refused by `checked_by_name`
    unit = given.get("t", "s")
    if unit != "s":
        raise DataError(
            f"units: the time 't' has the unit {unit!r}, and times that are dates are "
            "read in seconds; expected 's'. Leave 't' out of units."
        )
    return {**given, "t": "s"}


def _check_columns(table: Table, layout: Layout) -> None:
    found = table.frame.columns.tolist()
    wanted = layout.columns
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
    names = names.reset_index(drop=True)
    rows = names.groupby(names, sort=False).indices
    return {name: np.asarray(rows[name]) for name in names.unique()}

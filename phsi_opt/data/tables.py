"""TODO."""

import csv
import io
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import pandas as pd

from phsi_opt.data.checks import check_unique, check_values, checked_names
from phsi_opt.data.trajectory import Trajectory
from phsi_opt.errors import DataError, did_you_mean

MISSING_CELLS = frozenset({"", "nan", "na", "n/a"})
ColumnMap = (
    Mapping[str, Any] | Sequence[str]
)  # name -> column, or names which are columns
Source = str | os.PathLike[str] | TextIO


@dataclass(frozen=True)
class Layout:
    """Which column plays which part."""

    time: str
    states: Mapping[str, Any]  # state -> column, or None: not measured
    inputs: Mapping[str, Any]
    trajectory: str | None

    def columns(self) -> list[Any]:
        named = [
            self.time,
            *self.states.values(),
            *self.inputs.values(),
            self.trajectory,
        ]
        return [column for column in named if column is not None]


@dataclass(frozen=True, eq=False)
class Table:
    """Columns as they were found, with the words that messages use for them."""

    source: str  # "file 'bench.csv'"
    row_word: str  # "line" or "row"
    frame: pd.DataFrame  # its index holds the line numbers or the user's row labels
    run: str  # the trajectory's name where no column tells it

    def where(self, column: Any, i: int) -> str:
        (label,) = self.frame.index[
            [i]
        ].tolist()  # a Python object: its repr is 3, not np.int64(3)
        return f"{self.source}, column {column!r}, {self.row_word} {label!r}:"


def column_map(columns: Any, what: str) -> Mapping[str, Any]:
    if columns is None and what == "inputs":
        return {}
    if isinstance(columns, Mapping):
        if what == "inputs" and None in columns.values():
            raise DataError(
                f"inputs={dict(columns)!r} has an input without a column; inputs must be measured."
            )
        return dict(columns)
    names = checked_names(columns, what)
    check_unique(names, "name")
    return {name: name for name in names}


def trajectories(tables: Sequence[Table], layout: Layout) -> tuple[Trajectory, ...]:
    return tuple(
        run
        for table in tables
        for run in _table_trajectories(table, layout, len(tables) > 1)
    )


def _table_trajectories(
    table: Table, layout: Layout, one_of_several: bool
) -> list[Trajectory]:
    _check_columns(table, layout)
    n_rows = len(table.frame)
    t = _numbers(table, layout.time, may_be_missing=False)
    x, u = (
        np.full((n_rows, len(layout.states)), np.nan),
        np.empty((n_rows, len(layout.inputs))),
    )
    for i, column in enumerate(layout.states.values()):
        if column is not None:
            x[:, i] = _numbers(table, column, may_be_missing=True)
    for i, column in enumerate(layout.inputs.values()):
        u[:, i] = _numbers(table, column, may_be_missing=False)
    if layout.trajectory is None:
        return [Trajectory(table.run, t, x, u)]
    prefix = f"{table.run}/" if one_of_several else ""
    return [
        Trajectory(prefix + name, t[k], x[k], u[k])
        for name, k in _rows_by_run(table, layout.trajectory)
    ]


def _check_columns(table: Table, layout: Layout) -> None:
    found = table.frame.columns.tolist()
    for column in layout.columns():
        if column not in found:
            hint = did_you_mean(column, found)
            raise DataError(
                f"{table.source} has no column {column!r}; expected one of its columns {found}.{hint}"
            )
        if found.count(column) > 1:
            raise DataError(
                f"{table.source} has {found.count(column)} columns called {column!r}; expected one. "
                "Rename them so that it is clear which one is meant."
            )
        if layout.columns().count(column) > 1:
            raise DataError(
                f"{table.source}: the column {column!r} is asked for twice; expected one column per name."
            )
    if table.frame.empty:
        raise DataError(
            f"{table.source} has no samples; expected at least 2 rows of numbers below the header."
        )


def _rows_by_run(table: Table, column: str) -> Iterator[tuple[str, np.ndarray]]:
    """Name and row numbers of each run, in the order in which the runs begin."""
    cells = table.frame[column]
    names = cells.astype(str).str.strip()
    missing = (cells.isna() | (names == "")).to_numpy()
    if missing.any():
        where = table.where(column, int(np.argmax(missing)))
        raise DataError(
            f"{where} the trajectory's name is missing; every sample must name its trajectory."
        )
    codes, labels = pd.factorize(names)
    ends = np.cumsum(np.bincount(codes))
    for label, rows in zip(
        labels, np.split(np.argsort(codes, kind="stable"), ends[:-1]), strict=True
    ):
        yield str(label), rows


def _numbers(table: Table, column: Any, may_be_missing: bool) -> np.ndarray:
    cells = table.frame[column]
    if pd.api.types.is_numeric_dtype(cells) and not pd.api.types.is_complex_dtype(
        cells
    ):
        values: np.ndarray = cells.to_numpy(dtype=np.float64, na_value=np.nan)
    else:
        values = np.empty(len(cells))
        for i, (cell, is_missing) in enumerate(zip(cells, cells.isna(), strict=True)):
            values[i] = np.nan if is_missing else _number(cell, table, column, i)
    check_values(
        values, lambda i: f"{table.where(column, i)} the value", may_be_missing
    )
    return values


def _number(cell: Any, table: Table, column: Any, i: int) -> float:
    if isinstance(cell, str) and cell.strip().lower() in MISSING_CELLS:
        return float("nan")
    try:
        return float(cell)
    except (TypeError, ValueError):
        raise DataError(
            f"{table.where(column, i)} {cell!r} is not a real number. {_repair(cell)}"
        ) from None


def _repair(cell: Any) -> str:
    if isinstance(cell, str) and re.fullmatch(
        r"\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*", cell
    ):
        return (
            "Decimal commas are not read: write decimal points, or give "
            "pandas.read_csv(file, sep=';', decimal=',') to Measurements.from_dataframe."
        )
    if isinstance(cell, str):
        return "Correct the cell, or leave it empty where a state was not measured."
    return "Convert the column to numbers first (times: seconds since the start)."


def sources(source: Any) -> list[Any]:
    if isinstance(source, str | os.PathLike) or hasattr(source, "read"):
        return [source]
    if not isinstance(source, list | tuple | Iterator):
        raise DataError(
            f"source is a {type(source).__name__}; expected a path, a list of paths or an open text file."
        )
    sources = list(source)
    if not sources:
        raise DataError("source is an empty list; expected at least one path.")
    return sources


def csv_tables(sources: list[Any], layout: Layout) -> list[Table]:
    paths = [_path(source) for source in sources]
    stems = [
        f"run {i}" if path is None else Path(path).stem
        for i, path in enumerate(paths, start=1)
    ]
    names = [
        stem if stems.count(stem) == 1 else str(path)
        for stem, path in zip(stems, paths, strict=True)
    ]
    titles = ["open file" if path is None else f"file {path!r}" for path in paths]
    frames = [
        _csv_frame(_text(s, title), title, layout)
        for s, title in zip(sources, titles, strict=True)
    ]
    return [
        Table(*row)
        for row in zip(titles, ["line"] * len(titles), frames, names, strict=True)
    ]


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
            raise DataError(
                f"source holds a {type(source).__name__}; expected paths or open text files."
            )
    except UnicodeDecodeError as error:
        raise DataError(
            f"{title} is not UTF-8 text ({error}). Save it as 'CSV UTF-8'."
        ) from error
    except OSError as error:
        raise DataError(
            f"{title} cannot be read ({error}). Check the path and the permissions."
        ) from error
    if not isinstance(text, str):
        raise DataError(
            f"{title} gives {type(text).__name__}; expected text. Open it in text mode: open(path)."
        )
    return text.removeprefix("\ufeff")  # the byte order mark which spreadsheets write


def _csv_frame(text: str, title: str, layout: Layout) -> pd.DataFrame:
    """The cells as text; the index holds the line numbers. Empty lines are skipped."""
    header: list[str] = []
    rows: dict[int, list[str]] = {}
    reader = csv.reader(
        io.StringIO(text), delimiter=_separator(text, layout), skipinitialspace=True
    )
    try:
        for cells in reader:
            stripped = [cell.strip() for cell in cells]
            if not any(stripped):
                continue
            if header:
                rows[reader.line_num] = _fitted(
                    stripped, len(header), f"{title}, line {reader.line_num}"
                )
            else:
                header = _without_trailing_empties(stripped)
    except csv.Error as error:
        raise DataError(
            f"{title}, line {reader.line_num}: {error}. Save the table again as CSV."
        ) from error
    if not header:
        raise DataError(
            f"{title} is empty; expected a header line and at least 2 lines of numbers."
        )
    return pd.DataFrame(
        list(rows.values()), columns=header, index=list(rows), dtype=object
    )


def _separator(text: str, layout: Layout) -> str:
    """The separator with which the header shows most of the wanted columns, then most
    columns.
    """
    header = next((line for line in io.StringIO(text) if line.strip()), "")

    def score(separator: str) -> tuple[int, int]:
        cells = [
            cell.strip()
            for cell in next(
                csv.reader([header], delimiter=separator, skipinitialspace=True), []
            )
        ]
        return len(set(cells) & {str(column) for column in layout.columns()}), len(
            cells
        )

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

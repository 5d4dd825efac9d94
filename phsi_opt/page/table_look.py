"""A first look at a table: its columns, what each may be, and what cannot be read.

A column is numeric where most of its cells are numbers; then a cell that is none is
refused with its line, since it is a mistake and not a name.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from phsi_opt.data.file_opening import text_files
from phsi_opt.data.tables import DECIMAL_COMMA, Table, numbers_in, table_of_csv
from phsi_opt.errors import DataError
from phsi_opt.page.drafts import (
    INPUT,
    RUN,
    STATE,
    TIME,
    UNUSED,
    ColumnDraft,
    DataDraft,
)

N_EXAMPLES = 3  # cells shown of each column
MOSTLY = 0.5  # share of numbers above which a column is meant to be numeric
UNIT_IN_BRACKETS = re.compile(r"^(.*?)[\s_]*[\[(]\s*([^\])]*?)\s*[\])]\s*$")
TIME_NAMES = frozenset({"t", "time", "times", "zeit", "seconds"})
RUN_NAMES = frozenset({"run", "trajectory", "experiment", "trial", "test", "record"})
INPUT_NAMES = frozenset({"u", "input", "force", "torque", "drive", "heater", "pump"})
# Units that end a header after an underscore, as in position_m.
SUFFIX_UNITS = frozenset(
    (
        *("s", "ms", "us", "min", "h", "m", "mm", "cm", "km", "rad", "deg", "Hz"),
        *("V", "mV", "A", "mA", "N", "Nm", "K", "degC", "bar", "Pa", "kPa", "L"),
        *("W", "kW"),
    )
)


def look_at(folder: Path, files: list[str]) -> DataDraft:
    """The columns of the files, with a guess of what each is.

    Args:
        folder: in which they are.
        files: tables with the same columns, a run each.

    Raises:
        DataError: a file cannot be read, or has other columns than the first.
    """
    draft = DataDraft(folder, files)
    try:
        for file in files:
            _take_file(draft, file)
    except DataError as error:
        raise DataError(without_folder(str(error), folder)) from error
    draft.runs = list(dict.fromkeys(draft.runs))
    return draft


def _take_file(draft: DataDraft, file: str) -> None:
    (text,) = text_files(draft.folder / file)
    table = table_of_csv(text, ())
    columns = _columns(table)
    if not draft.columns:
        draft.columns = columns
    _check_same_columns(draft.columns, columns, table.title)
    draft.n_samples += len(table.frame)
    draft.runs += _runs(table, columns)


def without_folder(said: str, folder: Path) -> str:
    """A message in which files have their names alone."""
    return said.replace(f"{folder}/", "")


def _columns(table: Table) -> list[ColumnDraft]:
    headers = [str(name) for name in table.frame.columns]
    for name in headers:
        if headers.count(name) > 1:
            raise DataError(
                f"{table.title}: the header has {name!r} twice; give each column a "
                "name of its own."
            )
    columns = []
    for name in headers:
        columns.append(_column(table, name))
    _guess_roles(table, columns)
    return columns


def _column(table: Table, name: str) -> ColumnDraft:
    cells = [str(cell) for cell in table.frame[name]]
    _check_numbers(table, name, cells)
    bare, unit = _name_and_unit(name)
    return ColumnDraft(
        name,
        name=_identifier(bare),
        unit=unit,
        examples=tuple(cells[:N_EXAMPLES]),
        is_numeric=_share_of_numbers(cells) > MOSTLY,
    )


def _check_numbers(table: Table, name: str, cells: list[str]) -> None:
    """Refuse a column of numbers with a cell that is none.

    Raises:
        DataError: with the file, the column and the line.
    """
    has_commas = bool(cells) and DECIMAL_COMMA.fullmatch(cells[0]) is not None
    if has_commas or _share_of_numbers(cells) > MOSTLY:
        numbers_in(table, name, may_be_missing=True)


def _share_of_numbers(cells: list[str]) -> float:
    n_numbers = 0
    n_filled = 0
    for cell in cells:
        n_filled += bool(cell.strip())
        n_numbers += _is_number(cell)
    return n_numbers / max(n_filled, 1)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _name_and_unit(header: str) -> tuple[str, str]:
    """'position_m' and 'position [m]' are both position, in m."""
    bracketed = UNIT_IN_BRACKETS.match(header)
    if bracketed:
        return bracketed[1], bracketed[2]
    bare, _, last = header.rpartition("_")
    if bare and last in SUFFIX_UNITS:
        return bare, last
    return header, ""


def _identifier(text: str) -> str:
    """A name that formulas may have."""
    name = re.sub(r"\W+", "_", text).strip("_")
    if not name or not name[0].isalpha():
        name = f"x{name}"
    return name


def _guess_roles(table: Table, columns: list[ColumnDraft]) -> None:
    for column in columns:
        name = column.name.lower()
        if name in RUN_NAMES or not column.is_numeric:
            column.role = RUN
        elif name in INPUT_NAMES or re.fullmatch(r"u\d*", name):
            column.role = INPUT
        else:
            column.role = STATE
    _keep_one(columns, RUN)
    time = _time_column(table, columns)
    if time is not None:
        time.role = TIME
        time.unit = time.unit or "s"


def _keep_one(columns: list[ColumnDraft], role: str) -> None:
    """Only the first column of a role keeps it."""
    of_role = [column for column in columns if column.role == role]
    for column in of_role[1:]:
        column.role = UNUSED


def _time_column(table: Table, columns: list[ColumnDraft]) -> ColumnDraft | None:
    """The column that is called time, else the first that increases."""
    states = [column for column in columns if column.role == STATE]
    for column in states:
        if column.name.lower() in TIME_NAMES:
            return column
    for column in states:
        t: Any = numbers_in(table, column.column, may_be_missing=True)
        if np.all(np.diff(t) > 0):
            return column
    return None


def _check_same_columns(
    first: list[ColumnDraft], columns: list[ColumnDraft], title: str
) -> None:
    expected = [column.column for column in first]
    found = [column.column for column in columns]
    if expected != found:
        raise DataError(
            f"{title} has the columns {', '.join(found)}; expected "
            f"{', '.join(expected)}, as in the first file."
        )


def _runs(table: Table, columns: list[ColumnDraft]) -> list[str]:
    for column in columns:
        if column.role == RUN:
            cells = table.frame[column.column]
            return [str(cell) for cell in cells.unique()]
    return [table.run]

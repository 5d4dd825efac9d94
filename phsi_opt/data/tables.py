"""Reading tables: text in columns, cell by cell, into numbers.

What a table may look like is decided here: comma, semicolon or tab between the cells,
decimal points (decimal commas are refused with advice), which cells count as missing,
and the line or row that a message names. Which column plays which part is not known
here: see `layout`.
"""

import csv
import io
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from phsi_opt.data.checks import check_values
from phsi_opt.data.file_opening import TextFile
from phsi_opt.errors import DataError

SEPARATORS = (",", ";", "\t")
MISSING_CELLS = frozenset({"", "nan", "na", "n/a"})  # in lower case
DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*")


@dataclass(frozen=True, eq=False)
class Table:
    """Columns as they were found, with the words that messages use for them.

    Attributes:
        title: What messages call the table: "file 'bench.csv'" or "data frame".
        row_word: What they call a row: "line" or "row".
        frame: The cells; the index holds the line numbers or the user's row labels.
        run: The name of the trajectory where no column tells it.
    """

    title: str
    row_word: str
    frame: pd.DataFrame
    run: str

    def place(self, column: Any, i: int) -> str:
        """The words for the i-th cell of a column."""
        (label,) = self.frame.index[[i]].tolist()  # as a list: 3, not np.int64(3)
        return f"{self.title}, column {column!r}, {self.row_word} {label!r}:"


def table_of_frame(frame: Any) -> Table:
    """A user's data frame, which is not changed.

    Raises:
        DataError: This is no data frame.
    """
    if not isinstance(frame, pd.DataFrame):
        raise DataError(
            f"frame is a {type(frame).__name__}; "
            "expected a pandas.DataFrame (files: from_csv)."
        )
    return Table("data frame", "row", frame, "run 1")


class _Line(NamedTuple):
    number: int  # the first line of the file is 1
    cells: list[str]


def table_of_csv(file: TextFile, wanted: Iterable[Any]) -> Table:
    """The cells of a text table with a header line, as text; empty lines are skipped.

    Args:
        file: Its text.
        wanted: The columns that are looked for; they tell the separator.

    Raises:
        DataError: There is no header, or a line has too few or too many cells.
    """
    separator = _separator(file.text, wanted)
    lines = _filled_lines(file, separator)
    first_line = next(lines, None)
    if first_line is None:
        raise DataError(
            f"{file.title} is empty; "
            "expected a header line and at least 2 lines of numbers."
        )
    header = _without_trailing_empties(first_line.cells)
    rows = {}
    for line in lines:
        place = f"{file.title}, line {line.number}"
        rows[line.number] = _of_header_width(line.cells, len(header), place)
    frame = pd.DataFrame(
        list(rows.values()), index=list(rows), columns=header, dtype=object
    )
    return Table(file.title, "line", frame, file.run)


def _separator(text: str, wanted: Iterable[Any]) -> str:
    """The separator with which the header shows most of the wanted columns.

    Of several the one that gives most columns; of those the first in `SEPARATORS`.
    """
    wanted_names = {str(column) for column in wanted}
    header = next(filter(str.strip, io.StringIO(text)), "")

    def score(separator: str) -> tuple[int, int]:
        cells: list[str] = next(_csv_reader(header, separator), [])
        names = set(map(str.strip, cells))
        n_wanted = len(names & wanted_names)
        return n_wanted, len(cells)

    return max(SEPARATORS, key=score)


def _csv_reader(text: str, separator: str) -> Any:
    """Rows of cells; it knows the number of the line that it read last."""
    lines = io.StringIO(text)
    return csv.reader(lines, delimiter=separator, skipinitialspace=True)


def _filled_lines(file: TextFile, separator: str) -> Iterator[_Line]:
    """The lines with at least one cell that is not empty, all cells stripped."""
    reader = _csv_reader(file.text, separator)
    try:
        for cells in reader:
            stripped = [cell.strip() for cell in cells]
            if any(stripped):
                yield _Line(reader.line_num, stripped)
    except csv.Error as error:
        raise DataError(
            f"{file.title}, line {reader.line_num}: {error}. "
            "Save the table again as CSV."
        ) from error


def _without_trailing_empties(cells: list[str]) -> list[str]:
    n_cells = len(cells)
    while not cells[n_cells - 1]:
        n_cells -= 1
    return cells[:n_cells]


def _of_header_width(cells: list[str], width: int, place: str) -> list[str]:
    """The cells of one line below the header; only empty cells may be too many."""
    if len(cells) < width or any(cells[width:]):
        raise DataError(
            f"{place} has {len(cells)} cells; expected {width}, as in the header. "
            "Complete or remove the line. "
            "If its numbers have decimal commas, write decimal points."
        )
    return cells[:width]


def numbers_in(table: Table, column: Any, may_be_missing: bool) -> np.ndarray:
    """The values of a column, (n_rows,), NaN for missing cells.

    Raises:
        DataError: A cell is no real number, infinite, huge, or missing where it may
            not be.
    """
    cells = table.frame[column]
    if _holds_real_numbers(cells):
        values: np.ndarray = cells.to_numpy(dtype=np.float64, na_value=np.nan)
    else:
        values = _parsed(table, column)

    def place_of(i: int) -> str:
        return f"{table.place(column, i)} the value"

    check_values(values, place_of, may_be_missing)
    return values


def _holds_real_numbers(cells: pd.Series) -> bool:
    is_complex = pd.api.types.is_complex_dtype(cells)
    return pd.api.types.is_numeric_dtype(cells) and not is_complex


def _parsed(table: Table, column: Any) -> np.ndarray:
    """The values (n_rows,) of a column of texts or other objects."""
    cells = table.frame[column]
    is_missing = cells.isna().to_numpy()
    values = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        if not is_missing[i]:
            values[i] = _number(cell, table, column, i)
    return values


def _number(cell: Any, table: Table, column: Any, i: int) -> float:
    if isinstance(cell, str) and cell.strip().lower() in MISSING_CELLS:
        return float("nan")
    try:
        return float(cell)
    except (TypeError, ValueError):
        raise DataError(
            f"{table.place(column, i)} {cell!r} is not a real number. {_repair(cell)}"
        ) from None


def _repair(cell: Any) -> str:
    if not isinstance(cell, str):
        return "Convert the column to numbers first (times: seconds since the start)."
    if DECIMAL_COMMA.fullmatch(cell):
        return (
            "Decimal commas are not read: write decimal points, or give "
            "pandas.read_csv(file, sep=';', decimal=',') "
            "to Measurements.from_dataframe."
        )
    return "Correct the cell, or leave it empty where a state was not measured."

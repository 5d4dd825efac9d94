"""Reading tables: text in columns, cell by cell, into numbers.

What a table may look like is decided here and in `text_cells`: with a header or
without, comma, semicolon, tab or blanks between the cells, decimal points or commas,
which cells count as missing, and the line or row that a message names. Which column
plays which part is not known here: see `layout`.
"""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from phsi_opt.data.checks import check_values
from phsi_opt.data.file_opening import TextFile
from phsi_opt.data.text_cells import (
    DECIMAL_COMMA,
    DECIMAL_POINT,
    MISSING_CELLS,
    Line,
    TextFormat,
    decimal_of,
    filled_lines,
    is_header,
    looks_like_a_value,
    separator_of,
    without_trailing_empties,
)
from phsi_opt.data.wording import number_of
from phsi_opt.errors import DataError

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Variable:
    """Something in a file that is no column of its table.

    Attributes:
        name: As in MATLAB; a field as "struct.field".
        said: What it is: "the number 9.81", "3 x 4 numbers", "text".
        value: Of a single real number; None for all others.
    """

    name: str
    said: str
    value: float | None = None


@dataclass(frozen=True, eq=False)
class Table:
    """Columns as they were found, with the words that messages use for them.

    Attributes:
        title: What messages call the table: "file 'bench.csv'" or "data frame".
        row_word: What they call a row: "line" or "row".
        frame: The cells; the index holds the line numbers or the user's row labels.
        run: The name of the trajectory where no column tells it.
        decimal: The sign before decimals in cells of text; None where they show two.
        remark: What was guessed of the file's encoding; "" where nothing was.
        further: What a MATLAB file holds beside the table, where nobody said which
            columns are looked for.
    """

    title: str
    row_word: str
    frame: "pd.DataFrame"
    run: str
    decimal: str | None = "."
    remark: str = ""
    further: tuple[Variable, ...] = ()

    def place(self, column: Any, i: int) -> str:
        """The words for the i-th cell of a column."""
        return f"{self.title}, column {column!r}, {self.row(i)}:"

    def row(self, i: int) -> str:
        """The words for the i-th row, such as "line 3"."""
        (label,) = self.frame.index[[i]].tolist()  # as a list: 3, not np.int64(3)
        return f"{self.row_word} {label!r}"


def table_of_frame(frame: Any) -> Table:
    """A user's data frame, which is not changed.

    Raises:
        DataError: This is no data frame.
    """
    import pandas as pd

    if not isinstance(frame, pd.DataFrame):
        raise DataError(
            f"frame is a {type(frame).__name__}; "
            "expected a pandas.DataFrame (files: from_csv)."
        )
    return Table("data frame", "row", frame, "run 1")


def table_of_csv(
    file: TextFile, wanted: Iterable[Any], text_format: TextFormat | None = None
) -> Table:
    """The cells of a text table, as text; empty lines are skipped.

    Args:
        file: Its text.
        wanted: The columns that are looked for, by name or by number from 0; names help
            to tell the separator.
        text_format: What the user said of the table; None: nothing.

    Raises:
        DataError: The table is empty, or a line has too few or too many cells.
    """
    import pandas as pd

    told = text_format or TextFormat()
    columns = list(wanted)
    names = {column for column in columns if isinstance(column, str)}
    separator = told.separator or separator_of(file, names)
    lines = list(filled_lines(file, separator))
    if not lines:
        raise DataError(
            f"{file.title} is empty; "
            "expected a header line and at least 2 lines of numbers."
        )
    if told.columns is None and is_header(lines[0].cells):
        header = without_trailing_empties(lines[0].cells)
        rows = _of_header_width(lines[1:], len(header), file.title)
    else:
        rows = _of_one_width(lines, file.title)
        header = names_by_position(told.columns, len(rows[0].cells), file.title)
        _check_no_header(told, rows[0], file.title)
    decimal = told.decimal
    if decimal is None:
        cells = itertools.chain.from_iterable(row.cells for row in rows)
        decimal = decimal_of(cells, separator)
    labels = labels_of(header, columns, file.title)
    frame = pd.DataFrame(
        [row.cells for row in rows],
        index=[row.number for row in rows],
        columns=pd.Index(labels, dtype=object),
        dtype=object,
    )
    return Table(file.title, "line", frame, file.run, decimal, file.remark)


def _of_header_width(lines: list[Line], width: int, title: str) -> list[Line]:
    """The lines below a header; only empty cells may be too many."""
    rows = []
    for line in lines:
        if len(line.cells) < width or any(line.cells[width:]):
            n_cells = number_of(len(line.cells), "cell")
            raise DataError(
                f"{title}, line {line.number} has {n_cells}; "
                f"expected {width}, as in the header. Complete or remove the line, or "
                "lines of text above the table. If its numbers have decimal commas, "
                "write decimal points, or another separator."
            )
        rows.append(Line(line.number, line.cells[:width]))
    return rows


def _of_one_width(lines: list[Line], title: str) -> list[Line]:
    """The lines of a table without a header, as wide as the widest of them."""
    filled = [len(without_trailing_empties(line.cells)) for line in lines]
    width = max(filled)
    widest = lines[filled.index(width)].number
    rows = []
    for line in lines:
        if len(line.cells) < width:
            n_cells = number_of(len(line.cells), "cell")
            raise DataError(
                f"{title}, line {line.number} has {n_cells}; "
                f"expected {width}, as in line {widest}. Complete or remove the line."
            )
        rows.append(Line(line.number, line.cells[:width]))
    return rows


def names_by_position(
    columns: Sequence[str] | None, width: int, title: str
) -> list[str]:
    """The names of the columns of a table without a header: given, or "0", "1", ...

    Args:
        columns: Those that the user gave.
        width: The number of columns.
        title: What messages call the table.

    Raises:
        DataError: There are more or fewer names than columns.
    """
    if columns is None:
        return [str(i) for i in range(width)]
    if len(columns) != width:
        raise DataError(
            f"{title} has {width} columns; columns={list(columns)} names "
            f"{len(columns)}. Name every column, in their order."
        )
    return list(columns)


def _check_no_header(told: TextFormat, first: Line, title: str) -> None:
    if told.columns is not None and is_header(first.cells):
        if any(map(looks_like_a_value, first.cells)):
            return  # a text among numbers is the name of a run, or a wrong cell
        raise DataError(
            f"{title}, line {first.number} holds names, {first.cells}, and columns "
            "names them too. Leave columns=... out, or remove the line."
        )


def labels_of(header: Sequence[str], wanted: Iterable[Any], title: str) -> list[Any]:
    """What the columns of a file are called: names, or numbers where these are asked.

    Args:
        header: Their names.
        wanted: The columns that are looked for; an integer is a position from 0.
        title: What messages call the table.

    Raises:
        DataError: There is no column of that number.
    """
    labels: list[Any] = list(header)
    for column in wanted:
        if isinstance(column, bool) or not isinstance(column, int | np.integer):
            continue
        if not 0 <= column < len(labels):
            raise DataError(
                f"{title} has no column {column}; it has {len(labels)} columns, "
                f"counted from 0: {list(header)}."
            )
        labels[column] = int(column)
    return labels


def numbers_in(table: Table, column: Any, may_be_missing: bool) -> np.ndarray:
    """The values of a column, (n_rows,), NaN for missing cells.

    Raises:
        DataError: A cell is no real number, infinite, huge, or missing where it may
            not be.
    """
    cells = table.frame[column]
    if holds_real_numbers(cells):
        values: np.ndarray = cells.to_numpy(dtype=np.float64, na_value=np.nan)
    else:
        values = _parsed(table, column)

    def place_of(i: int) -> str:
        return f"{table.place(column, i)} the value"

    check_values(values, place_of, may_be_missing)
    return values


def holds_real_numbers(cells: "pd.Series") -> bool:
    """Whether a column has a type of real numbers, so that no cell need be read."""
    import pandas as pd

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
    number = cell
    if isinstance(cell, str):
        number = cell.strip()
        if number.lower() in MISSING_CELLS:
            return float("nan")
        if table.decimal == ",":
            number = _with_point(number)
    try:
        return float(number)
    except (TypeError, ValueError):
        raise DataError(
            f"{table.place(column, i)} {cell!r} is not a real number. "
            f"{_repair(cell, table)}"
        ) from None


def _with_point(number: str) -> str:
    """A number with a decimal comma as Python writes it.

    A point could stand before thousands here: such a cell is no number.
    """
    if DECIMAL_POINT.fullmatch(number):
        return ""
    return number.replace(",", ".") if DECIMAL_COMMA.fullmatch(number) else number


def _repair(cell: Any, table: Table) -> str:
    if not isinstance(cell, str):
        return "Convert the column to numbers first (times: seconds since the start)."
    if DECIMAL_COMMA.fullmatch(cell):
        return (
            "A comma could stand before decimals or thousands here: say "
            'decimal = "," or write decimal points.'
        )
    if table.decimal == "," and DECIMAL_POINT.fullmatch(cell.strip()):
        return "The table has decimal commas: write all decimals in one way."
    return "Correct the cell, or leave it empty where a state was not measured."

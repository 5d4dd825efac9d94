"""Tables: cells in columns, as they were found, into numbers.

What a table may look like is decided here and in `text_cells`: with a header or
without, decimal points or commas, which cells count as missing, and the line or row
that a message names. Which column plays which part is not known here: see `layout`.
"""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from phsi_opt.arguments import short_number
from phsi_opt.data.checks import check_values
from phsi_opt.data.file_opening import OpenedFile
from phsi_opt.data.text_cells import (
    DECIMAL_COMMA,
    DECIMAL_POINT,
    MISSING_CELLS,
    TextFormat,
    decimal_of,
    filled_lines,
    is_header,
    looks_like_a_value,
    n_filled,
    separator_of,
)
from phsi_opt.errors import DataError
from phsi_opt.presentation.numbers import number_of

if TYPE_CHECKING:
    import pandas as pd

POINTS_FOR_COMMAS = str.maketrans(",.", ".,")  # and commas, which are no numbers
Rows = dict[int, list[Any]]  # the cells of each row that is not empty, by its number


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
    file: OpenedFile, wanted: Iterable[Any], text_format: TextFormat | None = None
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
    told = text_format or TextFormat()
    columns = list(wanted)
    names = {column for column in columns if isinstance(column, str)}
    separator = told.separator or separator_of(file, names)
    rows = dict(filled_lines(file, separator))
    if not rows:
        raise DataError(
            f"{file.title} is empty; "
            "expected a header line and at least 2 lines of numbers."
        )
    return table_of_rows(file, file.title, "line", rows, columns, told, separator)


def table_of_rows(
    file: OpenedFile,
    title: str,
    row_word: str,
    rows: Rows,
    wanted: Iterable[Any],
    told: TextFormat,
    separator: str,
) -> Table:
    """A table of cells whose first row may be a header.

    Args:
        file: From which they are.
        title: What messages call the table.
        row_word: What they call a row: a "line", none of which has filled cells beside
            the header, or a "row" of a sheet, where columns without a name may be.
        rows: The cells; empty ones are "".
        wanted: The columns that are looked for, by name or by number from 0.
        told: What the user said of the table.
        separator: The sign between the cells.

    Raises:
        DataError: A row has too few or too many cells, the columns are not those that
            the user named, or there is none of a number that is wanted.
    """
    import pandas as pd

    number, first = next(iter(rows.items()))
    widths = {i: n_filled(cells) for i, cells in rows.items()}
    widest = max(widths, key=widths.__getitem__)
    width = widths[widest]
    reference = f"in {row_word} {widest}"
    names = told.columns
    if names is None and is_header(first):
        if row_word == "line":
            width = widths[number]
            reference = "in the header"
        names = [str(cell) for cell in first[:width]]
        rows = {i: cells for i, cells in rows.items() if i != number}
    elif names is None:
        names = [str(i) for i in range(width)]
    elif not any(map(looks_like_a_value, first)):
        raise DataError(
            f"{title}, {row_word} {number} holds names, {first}, and columns "
            "names them too. Leave columns=... out, or remove the line."
        )
    if len(names) != width:
        raise DataError(
            f"{title} has {width} columns; columns={list(names)} names "
            f"{len(names)}. Name every column, in their order."
        )
    for i, cells in rows.items():
        if len(cells) < width or widths[i] > width:
            raise DataError(
                f"{title}, {row_word} {i} has {number_of(len(cells), 'cell')}; "
                f"expected {width}, as {reference}. Complete or remove the line, or "
                "lines of text above the table. If its numbers have decimal commas, "
                "write decimal points, or another separator."
            )
    decimal = told.decimal or decimal_of(itertools.chain(*rows.values()), separator)
    frame = pd.DataFrame(
        [cells[:width] for cells in rows.values()],
        index=list(rows),
        columns=pd.Index(_labels(names, wanted, title), dtype=object),
        dtype=object,
    )
    return Table(title, row_word, frame, file.run, decimal, file.remark)


def _labels(names: Sequence[str], wanted: Iterable[Any], title: str) -> list[Any]:
    """What columns are called: names, or their numbers from 0 where these are asked."""
    labels: list[Any] = list(names)
    for column in wanted:
        if isinstance(column, bool) or not isinstance(column, int | np.integer):
            continue
        if not 0 <= column < len(labels):
            raise DataError(
                f"{title} has no column {column}; it has {len(labels)} columns, "
                f"counted from 0: {list(names)}."
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
        values = np.empty(len(cells))
        for i, cell in enumerate(cells):
            try:
                values[i] = _number(cell, table.decimal)
            except (TypeError, ValueError, OverflowError):
                raise DataError(
                    f"{table.place(column, i)} {short_number(cell)} is not a real "
                    "number. "
                    f"{_repair(cell, table)}"
                ) from None

    def place_of(i: int) -> str:
        return f"{table.place(column, i)} the value"

    check_values(values, place_of, may_be_missing)
    return values


def rows_of_runs(names: "pd.Series") -> dict[str, np.ndarray]:
    """The row numbers of each run, (n_samples,) each, in the order in which they begin.

    Args:
        names: (n_rows,) of the runs.
    """
    import pandas as pd

    numbers, different = pd.factorize(names.astype(str).str.strip())
    order = np.argsort(numbers, kind="stable")
    rows = np.split(order, np.flatnonzero(np.diff(numbers[order])) + 1)
    return dict(zip(different.tolist(), rows, strict=True))


def holds_real_numbers(cells: "pd.Series") -> bool:
    """Whether a column has a type of real numbers, so that no cell need be read."""
    import pandas as pd

    is_complex = pd.api.types.is_complex_dtype(cells)
    return pd.api.types.is_numeric_dtype(cells) and not is_complex


def is_missing(cell: Any) -> bool:
    """Whether a cell says that nothing was measured."""
    if isinstance(cell, str):
        return cell.strip().lower() in MISSING_CELLS
    import pandas as pd

    return cell is None or bool(pd.isna(cell))


def _number(cell: Any, decimal: str | None) -> float:
    if is_missing(cell):
        return float("nan")
    if isinstance(cell, str):
        if "_" in cell:  # which Python takes for a sign between digits
            raise ValueError
        cell = cell.translate(POINTS_FOR_COMMAS) if decimal == "," else cell
    elif np.iscomplexobj(cell):  # of which NumPy would drop a part
        raise TypeError
    return float(cell)


def _repair(cell: Any, table: Table) -> str:
    if not isinstance(cell, str):
        return "Convert the column to numbers first (times: seconds since the start)."
    if DECIMAL_COMMA.fullmatch(cell):
        return (
            "A comma could stand before decimals or thousands here: say "
            'decimal = "," or write decimal points.'
        )
    if table.decimal == "," and DECIMAL_POINT.fullmatch(cell):
        return "The table has decimal commas: write all decimals in one way."
    return "Correct the cell, or leave it empty where a state was not measured."

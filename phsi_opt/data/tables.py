"""Tables: cells in columns, as they were found, into numbers.

Which cells count as missing, and the line or row that a message names. How text tables
are read is in `text_tables`, which column is what in `table_readers`.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from phsi_opt.arguments import require_known
from phsi_opt.data.checks import check_values
from phsi_opt.errors import DataError, shown

if TYPE_CHECKING:
    import pandas as pd

MISSING_CELLS = frozenset({"", "nan", "na", "n/a"})  # in lower case
DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*")
DECIMAL_POINT = re.compile(r"\s*[+-]?(\d*\.\d+|\d+\.)([eE][+-]?\d+)?\s*")
# Digits in groups of three: 1,234.5 or 1.234,5 or 1 234.
THOUSANDS = re.compile(
    r"[+-]?[1-9]\d{0,2}(?:(?P<mark>[,.' \u00a0\u2009\u202f\u2019])\d{3})"
    r"(?:(?P=mark)\d{3})*(?:(?!(?P=mark))(?P<sign>[,.])\d*)?"
)
POINTS_FOR_COMMAS = str.maketrans(",.", ".,")  # and commas, which are no numbers


@dataclass(frozen=True)
class Extent:
    """Where a table stands, in rows of its file, counted from 1."""

    header: int | None  # the row of the names; None: there is none
    units: int | None  # the row of the units
    rows: tuple[int, ...]  # of values
    names: tuple[Any, ...] = ()  # the cells of the header
    unit_of: tuple[str, ...] = ()  # what the row of the units says; "" where it is none
    above: int = 0  # the last row above the table
    below: int | None = None  # the first row below the table, which is not read
    # the row that separates the table from another one; None: there is no other
    cut: int | None = None


@dataclass(frozen=True)
class Variable:
    """Something in a file that is no column of its table."""

    name: str  # as in MATLAB; a field as "struct.field"
    said: str  # what it is: "the number 9.81", "3 x 4 numbers", "text"
    value: float | None = None  # of a single real number; None for all others
    unit: str = ""


@dataclass(frozen=True, eq=False)
class Table:
    """Columns as they were found, with the words that messages use for them."""

    title: str  # what messages call the table: "file 'bench.csv'" or "data frame"
    row_word: str  # what they call a row: "line" or "row"
    # the cells; the index holds the line numbers or the user's row labels
    frame: "pd.DataFrame"
    run: str  # the name of the trajectory where no column gives it
    # the sign before decimals in cells of text; None where they show two, or where a
    # comma may be either
    decimal: str | None = None
    remark: str = ""  # what was guessed of the file's encoding; "" where nothing was
    ending: str = ""  # why its last line may be cut; "" where it is not
    # sheets of a workbook, or groups of channels, that have content
    sheets: tuple[str, ...] = ()
    separator: str = ""  # between the cells of a text
    extent: Extent | None = None  # the rows of a text or a sheet
    # those of a row of units, or of a file's channels, by column
    units: Mapping[str, str] = field(default_factory=dict)
    # what a MATLAB file holds besides the table, where nobody said which columns are
    # looked for
    further: tuple[Variable, ...] = ()

    def place(self, column: Any, i: int) -> str:
        return f"{self.title}, column {shown(column)}, {self.row(i)}:"

    def row(self, i: int) -> str:
        """The words for the i-th row, such as "line 3"."""
        (label,) = self.frame.index[[i]].tolist()  # as a list: 3, not np.int64(3)
        return f"{self.row_word} {shown(label)}"


def chosen_part(
    name: str | None,
    known: Sequence[str],
    filled: Sequence[str],
    word: str,
    title: str,
    may_be_several: bool,
) -> str:
    """The sheet or group that is the table: the one named, or the only one filled."""
    if may_be_several and name not in filled:
        name = None
    if name is not None:
        require_known(name, known, f"{title} has no {word} {shown(name)}", DataError)
    elif len(filled) > 1 and not may_be_several:
        raise DataError(
            f"{title} has several {word}s with content: {filled}. Choose one: "
            f'{word} = "{filled[0]}".'
        )
    elif filled:
        name = filled[0]
    if name is None or name not in filled:
        what = "is empty" if name is None else f"has an empty {word} {shown(name)}"
        raise DataError(
            f"{title} {what}; expected a header row and at least 2 rows of numbers."
        )
    return name


def table_of_columns(
    file: Any, names: Sequence[Any], columns: Sequence[np.ndarray], **more: Any
) -> Table:
    """Columns of an opened file, whose rows are counted from 1."""
    import pandas as pd

    frame = pd.DataFrame(dict(enumerate(columns)))
    frame.columns = pd.Index(names, dtype=object)
    frame.index = pd.RangeIndex(1, len(frame) + 1)
    return Table(file.title, "row", frame, file.run, **more)


def numbers_in(table: Table, column: Any, may_be_missing: bool) -> np.ndarray:
    """The values of a column, (n_rows,), NaN for missing cells."""
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
                    f"{table.place(column, i)} {shown(cell)} is not a real "
                    f"number. {_repair(cell, table)}"
                ) from None
    check_values(
        values, lambda i: f"{table.place(column, i)} the value", may_be_missing
    )
    return values


def rows_of_runs(names: "pd.Series") -> dict[str, np.ndarray]:
    """The row numbers (n_samples,) of each run, of which every row has the name."""
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

    return pd.api.types.is_scalar(cell) and bool(pd.isna(cell))


def plain_number(cell: str, decimal: str | None) -> str:
    """A number with a decimal point and without marks of thousands; else the cell."""
    grouped = THOUSANDS.fullmatch(cell)
    if grouped is not None and decimal not in (None, grouped["mark"]):
        cell = cell.replace(grouped["mark"], "")
    has_sign = DECIMAL_COMMA.fullmatch(cell) or DECIMAL_POINT.fullmatch(cell)
    is_with_comma = decimal == "," and has_sign is not None
    return cell.translate(POINTS_FOR_COMMAS) if is_with_comma else cell


def _number(cell: Any, decimal: str | None) -> float:
    if is_missing(cell):
        return float("nan")
    if isinstance(cell, str):
        cell = plain_number(cell, decimal)
        if "_" in cell:  # which Python takes for a sign between digits
            raise ValueError
    elif np.iscomplexobj(cell):  # of which NumPy would drop a part
        raise TypeError
    return float(cell)


def _repair(cell: Any, table: Table) -> str:
    if not isinstance(cell, str):
        return "Convert the column to numbers first (times: seconds since the start)."
    if DECIMAL_COMMA.fullmatch(cell):
        return (
            'The comma may be a decimal or a thousands separator: set decimal = "," '
            "or write decimal points."
        )
    if table.decimal == "," and DECIMAL_POINT.fullmatch(cell):
        return "The table has decimal commas: write all numbers with decimal commas."
    return "Correct the cell, or leave it empty if the state was not measured."

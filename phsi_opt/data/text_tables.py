"""Tables of texts: what separates cells, the sign of decimals, a header or none.

What the user did not say is found by trying: the separator under which the cells look
most like numbers and moments. Cells become numbers in `tables`.
"""

import csv
import io
import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from phsi_opt.data.file_opening import OpenedFile
from phsi_opt.data.tables import DECIMAL_COMMA, DECIMAL_POINT, MISSING_CELLS, Table
from phsi_opt.errors import DataError
from phsi_opt.presentation.numbers import number_of

BLANKS = " "  # one blank or several, tabs among them
SEPARATORS = (",", ";", "\t", BLANKS)
NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?")
MOMENT = re.compile(
    r"\d{1,4}[-./:]\d{1,2}[-./:]\d[\d:.,]*([T ][\d:.,]+)?(Z|[+-][\d:]+)?"
)
SEPARATOR = re.compile(r"[^\"\r\n]")

Rows = dict[int, list[Any]]  # the cells of each row that is not empty, by its number


@dataclass(frozen=True)
class TextFormat:
    """How a text table is written; what is None is found in the text.

    Raises:
        DataError: it is nothing that a table can have.
    """

    # the names of the columns of a table without a header
    columns: Sequence[str] | None = None
    # the sign between cells; a blank stands for any number of blanks
    separator: str | None = None
    decimal: str | None = None  # the sign before the decimals, a point or a comma

    def __post_init__(self) -> None:
        columns: Any = self.columns
        is_list = isinstance(columns, Sequence) and not isinstance(columns, str)
        if columns is not None and (not is_list or not columns):
            raise DataError(
                f"columns={columns!r} is not a list of names; expected the name of "
                'each column, such as columns = ["t", "q"].'
            )
        for name in columns or ():
            if not isinstance(name, str) or not name:
                raise DataError(f"columns contains {name!r}; expected names as text.")
        separator = self.separator
        if separator is not None and not SEPARATOR.fullmatch(str(separator)):
            raise DataError(
                f"the separator {separator!r} is not a single character; expected "
                "',', ';', '\\t', or ' ' for blanks."
            )
        if self.decimal not in (None, ".", ","):
            raise DataError(
                f"the decimal separator {self.decimal!r} is unknown; expected '.' or "
                "','."
            )
        if self.decimal == separator == ",":
            raise DataError(
                "the comma cannot be both the column separator and the decimal "
                "separator; expected two different characters."
            )


def table_of_csv(file: OpenedFile, wanted: Iterable[Any], form: TextFormat) -> Table:
    """The cells of a text table, as text; empty lines are skipped.

    The columns that are looked for, by name or by number from 0, help to find the
    separator.

    Raises:
        DataError: the table is empty, or a line has too few or too many cells.
    """
    columns = list(wanted)
    names = {column for column in columns if isinstance(column, str)}
    separator = form.separator or _separator_of(file, names)
    rows = dict(_filled_lines(file, separator))
    if not rows:
        raise DataError(
            f"{file.title} is empty; "
            "expected a header line and at least 2 lines of numbers."
        )
    return table_of_rows(file, file.title, "line", rows, columns, form, separator)


def table_of_rows(
    file: OpenedFile,
    title: str,
    row_word: str,
    rows: Rows,
    wanted: Iterable[Any],
    form: TextFormat,
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
        form: What the user said of the table.
        separator: The sign between the cells.

    Raises:
        DataError: a row or the number of columns is not as the others say.
    """
    import pandas as pd

    number, first = next(iter(rows.items()))
    widths = {i: n_filled(cells) for i, cells in rows.items()}
    widest = max(widths, key=widths.__getitem__)
    width = widths[widest]
    reference = f"in {row_word} {widest}"
    names = form.columns
    if names is None and _is_header(first):
        if row_word == "line":
            width = widths[number]
            reference = "in the header"
        names = list(map(str, first[:width]))
        rows = {i: cells for i, cells in rows.items() if i != number}
    elif names is None:
        names = list(map(str, range(width)))
    elif not any(map(_looks_like_a_value, first)):
        raise DataError(
            f"{title}, {row_word} {number} contains names, {first}, and columns=... "
            "gives names, too. Omit columns=..., or remove the line."
        )
    if len(names) != width:
        raise DataError(
            f"{title} has {width} columns; columns={list(names)} names {len(names)}. "
            "Give the names of all columns, in their order."
        )
    for i, cells in rows.items():
        if len(cells) < width or widths[i] > width:
            raise DataError(
                f"{title}, {row_word} {i} has {number_of(len(cells), 'cell')}; "
                f"expected {width}, as {reference}. Complete or remove the line; "
                "remove lines of text above the table. If numbers have decimal "
                "commas, use decimal points or another separator."
            )
    labels: list[Any] = list(names)
    for column in wanted:  # those asked for by number are called so
        if isinstance(column, bool) or not isinstance(column, int | np.integer):
            continue
        if column not in range(width):
            raise DataError(
                f"{title} has no column {column}; it has {width} columns, "
                f"counted from 0: {list(names)}."
            )
        labels[column] = int(column)
    decimal = form.decimal or _decimal_of(itertools.chain(*rows.values()), separator)
    frame = pd.DataFrame(
        [cells[:width] for cells in rows.values()],
        index=list(rows),
        columns=pd.Index(labels, dtype=object),
        dtype=object,
    )
    return Table(title, row_word, frame, file.run, decimal, file.remark)


def n_filled(cells: Sequence[Any]) -> int:
    """The number of cells up to the last that is not empty."""
    n_cells = len(cells)
    while n_cells and cells[n_cells - 1] == "":
        n_cells -= 1
    return n_cells


def _filled_lines(file: OpenedFile, separator: str) -> Iterator[tuple[int, list[str]]]:
    """The lines with a cell that is not empty: their numbers, and stripped cells."""
    lines: Iterable[str] = io.StringIO(file.content)
    if separator == BLANKS:
        lines = (line.strip().replace("\t", BLANKS) for line in lines)
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    try:
        for cells in reader:
            stripped = [cell.strip() for cell in cells]
            if any(stripped):
                yield reader.line_num, stripped
    except csv.Error as error:
        raise DataError(
            f"{file.title}, line {reader.line_num}: {error}. "
            "Save the table again as CSV."
        ) from error


def _separator_of(file: OpenedFile, wanted_names: set[str]) -> str:
    """The separator under which a text looks most like a table.

    First comes the one with which the first line shows most of the wanted columns;
    then that with most cells that look like numbers in lines as wide as the first; then
    that with most columns; then the first in `SEPARATORS`.
    """

    def score(separator: str) -> tuple[int, float, int]:
        lines = []
        with suppress(DataError):  # told when the table is read with what is chosen
            for _, line in itertools.islice(_filled_lines(file, separator), 50):
                lines.append(line)  # more lines tell nothing else
        first = lines[0][: n_filled(lines[0])] if lines else []
        n_wanted = len(set(first) & wanted_names)
        width = len(first)
        if width < 2:  # a sign that separates nothing
            return n_wanted, 0.0, 0
        n_cells = n_readable = 0
        for line in lines[1:]:
            filled = line[: n_filled(line)]
            n_cells += len(filled)
            if len(line) >= width >= len(filled):
                n_readable += sum(map(_looks_like_a_value, filled))
        return n_wanted, n_readable / max(n_cells, 1), width

    return max(SEPARATORS, key=score)


def _looks_like_a_value(cell: Any) -> bool:
    """Whether a cell could be a number, a moment or a missing value."""
    if not isinstance(cell, str):
        return True
    is_value = NUMBER.fullmatch(cell) or MOMENT.fullmatch(cell)
    return cell.lower() in MISSING_CELLS or is_value is not None


def _is_header(cells: Sequence[Any]) -> bool:
    """Whether the cells of a first line are names rather than values.

    They are values where each could be a number, a moment or missing; but the line
    ",0,1,2" is what pandas writes above columns without names.
    """
    if not all(map(_looks_like_a_value, cells)):
        return True
    filled = [str(cell) for cell in cells if cell != ""]
    return cells[0] == "" and filled == list(map(str, range(len(filled))))


def _decimal_of(cells: Iterable[Any], separator: str) -> str | None:
    """The sign before the decimals; None where the cells show both.

    Beside a comma as separator, a quoted "1,234" could as well be a thousand, and is
    not taken for a decimal comma.
    """
    texts = [cell for cell in cells if isinstance(cell, str)]
    if not any(map(DECIMAL_COMMA.fullmatch, texts)):
        return "."
    has_point = any(map(DECIMAL_POINT.fullmatch, texts))
    return None if has_point or separator == "," else ","

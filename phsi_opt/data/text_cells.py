"""Cells of a table of texts: what separates them, the sign of decimals, a header.

What the user did not say is found by trying: the separator under which the cells look
most like numbers and moments. Nothing is converted here; `tables` does that.
"""

import csv
import io
import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from phsi_opt.data.file_opening import OpenedFile
from phsi_opt.errors import DataError

BLANKS = " "  # one blank or several, tabs among them
SEPARATORS = (",", ";", "\t", BLANKS)
MISSING_CELLS = frozenset({"", "nan", "na", "n/a"})  # in lower case
DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*")
DECIMAL_POINT = re.compile(r"\s*[+-]?(\d*\.\d+|\d+\.)([eE][+-]?\d+)?\s*")
NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?")
MOMENT = re.compile(
    r"\d{1,4}[-./:]\d{1,2}[-./:]\d[\d:.,]*([T ][\d:.,]+)?(Z|[+-][\d:]+)?"
)
SEPARATOR = re.compile(r"[^\"\r\n]")

Line = tuple[int, list[str]]  # its number in the file, from 1, and its cells


@dataclass(frozen=True)
class TextFormat:
    """How a text table is written; what is None is found in the text.

    Attributes:
        columns: The names of the columns of a table without a header.
        separator: The sign between cells; a blank stands for any number of blanks.
        decimal: The sign before the decimals, a point or a comma.

    Raises:
        DataError: It is nothing that a table can have.
    """

    columns: Sequence[str] | None = None
    separator: str | None = None
    decimal: str | None = None

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
                raise DataError(f"columns holds {name!r}; expected names as text.")
        separator = self.separator
        if separator is not None and not SEPARATOR.fullmatch(str(separator)):
            raise DataError(
                f"the separator {separator!r} is not a single sign; expected ',', ';', "
                "'\\t', or ' ' for blanks."
            )
        if self.decimal not in (None, ".", ","):
            raise DataError(
                f"the sign of decimals {self.decimal!r} is unknown; "
                "expected '.' or ','."
            )
        if self.decimal == separator == ",":
            raise DataError(
                "a comma as separator and as sign of decimals leaves no way to tell "
                "them apart; expected two signs."
            )


def filled_lines(file: OpenedFile, separator: str) -> Iterator[Line]:
    """The lines with at least one cell that is not empty, without blanks around cells.

    Raises:
        DataError: A cell is too long to be one.
    """
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


def separator_of(file: OpenedFile, wanted_names: set[str]) -> str:
    """The separator under which a text looks most like a table.

    First comes the one with which the first line shows most of the wanted columns;
    then that with most cells that look like numbers in lines as wide as the first; then
    that with most columns; then the first in `SEPARATORS`.

    Args:
        file: Its text.
        wanted_names: Names of columns that are looked for.
    """

    def score(separator: str) -> tuple[int, float, int]:
        lines = []
        with suppress(DataError):  # told when the table is read with what is chosen
            for _, line in itertools.islice(filled_lines(file, separator), 50):
                lines.append(line)  # more would tell nothing else
        first = lines[0][: n_filled(lines[0])] if lines else []
        n_wanted = len(set(first) & wanted_names)
        width = len(first)
        if width < 2:  # a sign that separates nothing
            return n_wanted, 0.0, 0
        n_cells = 0
        n_readable = 0
        for line in lines[1:]:
            filled = line[: n_filled(line)]
            n_cells += len(filled)
            if len(line) >= width >= len(filled):
                n_readable += sum(map(looks_like_a_value, filled))
        return n_wanted, n_readable / max(n_cells, 1), width

    return max(SEPARATORS, key=score)


def looks_like_a_value(cell: Any) -> bool:
    """Whether a cell could be a number, a moment or a missing value."""
    if not isinstance(cell, str):
        return True
    is_value = NUMBER.fullmatch(cell) or MOMENT.fullmatch(cell)
    return cell.lower() in MISSING_CELLS or is_value is not None


def n_filled(cells: Sequence[Any]) -> int:
    """The number of cells up to the last that is not empty."""
    n_cells = len(cells)
    while n_cells and cells[n_cells - 1] == "":
        n_cells -= 1
    return n_cells


def is_header(cells: Sequence[Any]) -> bool:
    """Whether the cells of a first line are names rather than values.

    They are values where each could be a number, a moment or missing; but the line
    ",0,1,2" is what pandas writes above columns without names.
    """
    if not all(map(looks_like_a_value, cells)):
        return True
    filled = [str(cell) for cell in cells if cell != ""]
    return cells[0] == "" and filled == [str(i) for i in range(len(filled))]


def decimal_of(cells: Iterable[Any], separator: str) -> str | None:
    """The sign before the decimals; None where the cells show both.

    Args:
        cells: All cells of the table.
        separator: The sign between them: beside a comma as separator, a quoted "1,234"
            could as well be a thousand, and is not taken for a decimal comma.
    """
    texts = [cell for cell in cells if isinstance(cell, str)]
    if not any(map(DECIMAL_COMMA.fullmatch, texts)):
        return "."
    has_point = any(map(DECIMAL_POINT.fullmatch, texts))
    return None if has_point or separator == "," else ","

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
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from phsi_opt.arguments import checked_types, types_of
from phsi_opt.data.file_opening import OpenedFile
from phsi_opt.data.table_extent import WORD, Rows, extent_of, kind, n_filled
from phsi_opt.data.tables import DECIMAL_COMMA, DECIMAL_POINT, THOUSANDS, Extent, Table
from phsi_opt.errors import DataError, shown
from phsi_opt.presentation.numbers import number_of

BLANKS = " "  # one blank or several, tabs among them
SEPARATORS = (",", ";", "\t", BLANKS)
SEPARATOR = re.compile(r"[^\"\r\n]")


@dataclass(frozen=True)
class TextFormat:
    """How a text table is written; what is None is found in the text."""

    # the names of the columns of a table without a header
    columns: Sequence[str] | None = None
    # the sign between cells; a blank stands for any number of blanks
    separator: str | None = None
    decimal: str | None = None  # the sign before the decimals, a point or a comma
    skip: int | None = None  # the number of rows above the table
    units_row: int | None = None  # the row of the units; 0: there is none

    def __post_init__(self) -> None:
        checked_types(vars(self), types_of(TextFormat), DataError)
        columns = self.columns
        if columns is not None and not (len(columns) and all(columns)):
            raise DataError(f"columns={shown(columns)} lacks names; expected one each.")
        separator = self.separator
        if separator is not None and not SEPARATOR.fullmatch(separator):
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
        for name in ("skip", "units_row"):
            row: Any = getattr(self, name)
            if row is not None and (type(row) is not int or row < 0):
                raise DataError(
                    f"{name}={row!r} is not a number of rows; expected a whole number "
                    "of at least 0, such as 12."
                )


def table_of_csv(file: OpenedFile, wanted: Iterable[Any], form: TextFormat) -> Table:
    """The cells of a text table, as text; empty lines are skipped.

    The columns that are looked for, by name or by number from 0, help to find the
    separator.
    """
    columns = list(wanted)
    names = {column for column in columns if isinstance(column, str)}
    separator = form.separator or _separator_of(file, names, form)
    rows = dict(_filled_lines(file, separator))
    if not rows:
        raise DataError(
            f"{file.title} is empty; "
            "expected a header line and at least 2 lines of numbers."
        )
    table = table_of_rows(file, file.title, "line", rows, columns, form, separator)
    return replace(table, ending=_ending(file.content, table))


def _ending(text: str, table: Table) -> str:
    """Why the last line may be cut: its number is shorter than those above it."""
    if len(table.frame) <= 10:  # among so few, a short number is no sign
        return ""
    cells = table.frame.iloc[:, -1]
    digits = cells.str.count(r"\d").tolist()
    is_cut = text.endswith(cells.iloc[-1]) and digits[-1] < min(digits[:-1])
    words = (
        f"the last line may be cut: {shown(cells.iloc[-1])} is shorter than all above"
    )
    return words if is_cut else ""


def table_of_rows(
    file: OpenedFile,
    title: str,
    row_word: str,
    rows: Rows,
    wanted: Iterable[Any],
    form: TextFormat,
    separator: str,
) -> Table:
    """The table in some rows of cells."""
    import pandas as pd

    extent = _extent(rows, form, separator, title)
    if extent.cut is not None:
        words = ", ".join(map(str, rows[extent.cut]))
        raise DataError(
            f"{title}, {row_word} {extent.cut} contains {shown(words)}, and samples "
            "stand above it and below it: these are several tables, or a comment in a "
            f"table. Cut the file here, so that each file has one table, or remove the "
            f"{row_word}."
        )
    cells_of = {i: rows[i] for i in extent.rows}
    head = extent.names
    widths = {i: n_filled(cells) for i, cells in cells_of.items()}
    widest = max(widths, key=widths.__getitem__, default=0)
    width = widths.get(widest, 0)
    reference = f"in {row_word} {widest}"
    if head and form.columns is not None:
        raise DataError(
            f"{title}, {row_word} {extent.header} contains names, {list(head)}, and "
            "columns=... gives names, too. Omit columns=..., or remove the line."
        )
    n_names = n_filled(head)
    is_too_wide = width < n_names
    if head and row_word == "line":  # a last name for comments that no line has is none
        width = n_names - (is_too_wide and str(head[n_names - 1]).lower() == "comment")
        reference = "in the header"
    elif is_too_wide:
        width = n_names
    names = form.columns or list(map(str, head[:width] or range(width)))
    if len(names) != width:
        raise DataError(
            f"{title} has {width} columns; columns={list(names)} names {len(names)}. "
            "Give the names of all columns, in their order."
        )
    for i, cells in cells_of.items():
        if len(cells) < width or widths[i] > width:
            raise DataError(
                f"{title}, {row_word} {i} has {number_of(len(cells), 'cell')}; "
                f"expected {width}, as {reference}. Complete or remove the line; set "
                "skip to the number of lines of text above the table. If numbers have "
                "decimal commas, use decimal points or another separator."
            )
    labels: list[Any] = list(names)
    for column in wanted:  # those asked for by number are called so
        if type(column) is bool or not isinstance(column, int | np.integer):
            continue
        if column not in range(width):
            raise DataError(
                f"{title} has no column {shown(column)}; it has {width} columns, "
                f"counted from 0: {list(names)}."
            )
        labels[column] = int(column)
    all_cells = itertools.chain(*cells_of.values())
    frame = pd.DataFrame(
        [cells[:width] for cells in cells_of.values()],
        index=list(cells_of),
        columns=pd.Index(labels, dtype=object),
        dtype=object,
    )
    return Table(
        title,
        row_word,
        frame,
        file.run,
        form.decimal or _decimal_of(all_cells, separator),
        file.remark,
        separator=separator,
        extent=extent,
        units=dict(zip(labels, extent.unit_of, strict=False)),
    )


def _extent(rows: Rows, form: TextFormat, separator: str, title: str) -> Extent:
    for name in ("skip", "units_row"):
        row = getattr(form, name) or 0
        is_last = row >= max(rows) if name == "skip" else row and row not in rows
        if is_last:
            raise DataError(
                f"{title}: {name}={row}, and there is no such row of the table; the "
                f"file has rows {min(rows)} to {max(rows)}."
            )
    return extent_of(rows, form.skip, form.units_row, separator == BLANKS)


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


def _separator_of(file: OpenedFile, wanted: set[str], form: TextFormat) -> str:
    """The separator under which a text looks most like a table.

    First comes the one with which a line shows most of the wanted columns; then that
    with most values among the cells of lines as wide as the header; then that with most
    columns; then the first in `SEPARATORS`.
    """

    def score(separator: str) -> tuple[int, float, int]:
        rows: Rows = {}
        with suppress(DataError):  # told when the table is read with what is chosen
            for number, line in itertools.islice(_filled_lines(file, separator), 500):
                rows[number] = line  # more lines tell nothing else
        rows = {i: one for i, one in rows.items() if i > (form.skip or 0)}
        if not rows:
            return 0, 0.0, 0
        n_wanted = max(len(wanted.intersection(line)) for line in rows.values())
        extent = extent_of(rows, form.skip, form.units_row, separator == BLANKS)
        lines = [rows[i] for i in extent.rows]
        width = n_filled(extent.names) or max(map(n_filled, lines), default=0)
        if width < 2:  # a sign that separates nothing
            return n_wanted, 0.0, 0
        n_cells = n_readable = 0
        for line in lines:
            filled = line[: n_filled(line)]
            n_cells += len(filled)
            if len(line) >= width >= len(filled):
                n_readable += sum(kind(cell) != WORD for cell in filled)
        return n_wanted, n_readable / max(n_cells, 1), width

    return max(SEPARATORS, key=score)


def _decimal_of(cells: Iterable[Any], separator: str) -> str | None:
    """The sign before the decimals; None where the cells show both, or may do so.

    Digits behind a comma may be decimals, or a group of three behind a thousand, and
    another cell has to tell. Tables between semicolons are of countries that write a
    comma. Beside a comma as separator, a quoted "1,5" is not taken for a number.
    """
    signs: set[str] = set()
    for cell in cells:
        if not isinstance(cell, str):
            continue
        grouped = THOUSANDS.fullmatch(cell)
        if grouped is not None and grouped["mark"] in ",.":
            signs.add(grouped["sign"] or f"{grouped['mark']}000")
        elif DECIMAL_COMMA.fullmatch(cell):
            signs.add(",")
        elif DECIMAL_POINT.fullmatch(cell):
            signs.add(".")
    if "," in signs:
        return None if "." in signs or separator == "," else ","
    if "." in signs or ",000" not in signs:
        return "."
    return "," if separator == ";" and ".000" not in signs else None

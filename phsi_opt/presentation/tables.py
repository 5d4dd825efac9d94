"""Tables as text that loses no column, as HTML, and as tables of a terminal.

Rich lays them out. A table that is too wide for its lines first gets headers and texts
of several lines, and is then cut into blocks, one below the other, in which the first
columns come again. No column is left out.
"""

import html
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd
    from rich.table import Table
    from rich.text import Text

LINE_WIDTH = 80  # characters in a line of a terminal that nobody has widened
COLUMN_GAP = 2  # characters between columns
MOST_ROWS = 60  # that are printed, as pandas does; of longer tables the ends
LEAST_TEXT = 12  # characters to which a column of texts is narrowed: a word or two
KEY_SHARE = 0.5  # of the line that the first columns may take in every block
HEADER_PIECE = re.compile(r"[^_\s]+_?|_")
CUT = "..."
UNKNOWN = "-"  # in place of NaN
CELL_STYLE = "padding: 0.15em 0.7em; vertical-align: top"


@dataclass(frozen=True)
class Column:
    """A column as it is shown.

    Attributes:
        header: Its name.
        cells: A text per row.
        is_number: Whether its cells are numbers, which stand at the right.
    """

    header: str
    cells: tuple[str, ...]
    is_number: bool

    @property
    def width(self) -> int:
        """Characters that it takes where nothing is broken into lines."""
        return max([len(self.header), *map(len, self.cells)])

    @property
    def least_width(self) -> int:
        """Characters that it takes where all is broken that may be."""
        longest = max([1, *map(len, self.cells)])
        if not self.is_number:
            longest = min(longest, LEAST_TEXT)
        return max([longest, *map(len, HEADER_PIECE.findall(self.header))])

    @property
    def broken_header(self) -> str:
        """Its name in lines, broken at blanks and behind underscores."""
        lines = [""]
        for word in self.header.split():
            for place, piece in enumerate(HEADER_PIECE.findall(word)):
                joint = " " if lines[-1] and place == 0 else ""
                joined = f"{lines[-1]}{joint}{piece}"
                if len(joined) <= self.least_width or not lines[-1]:
                    lines[-1] = joined
                else:
                    lines.append(piece)
        return "\n".join(lines)


def columns_of(table: "pd.DataFrame", most_rows: int = MOST_ROWS) -> list[Column]:
    """The columns of a table as texts, the index first where it holds names."""
    import pandas as pd

    half = most_rows // 2
    is_cut = len(table) > most_rows
    columns = []
    series = [table.iloc[:, number] for number in range(len(table.columns))]
    if not pd.api.types.is_integer_dtype(table.index):
        series.insert(0, table.index.to_series())
    for values in series:
        is_bool = pd.api.types.is_bool_dtype(values)
        is_number = pd.api.types.is_numeric_dtype(values) and not is_bool
        cells = list(map(text_of_cell, values.tolist()))
        if is_cut:
            cells = [*cells[:half], CUT, *cells[-half:]]
        name = "" if values.name is None else str(values.name)
        columns.append(Column(" ".join(name.split()), tuple(cells), is_number))
    return columns


def text_of_cell(value: Any) -> str:
    """A cell on one line: numbers with four digits, a dash for one that is not known.

    Nothing stands for None.
    """
    if value is None:
        return ""
    if isinstance(value, float | np.floating):
        return UNKNOWN if np.isnan(value) else f"{value:.4g}"
    return " ".join(str(value).split())


def text_of_table(
    table: "pd.DataFrame", width: int = LINE_WIDTH, most_rows: int = MOST_ROWS
) -> str:
    """A table as text with all of its columns.

    Args:
        table: With any names and cells.
        width: Characters of a line; a word that is longer is broken.
        most_rows: That are shown; of a longer table the ends.
    """
    from rich.console import Console

    printed = io.StringIO()
    console = Console(file=printed, width=width, color_system=None)
    for number, block in enumerate(_blocks(columns_of(table, most_rows), width)):
        console.print("\n" * min(number, 1), end="")
        console.print(_table(block, width))
    lines = [line.rstrip() for line in printed.getvalue().splitlines()]
    return "\n".join([*lines, *_remarks(table, most_rows)])


def rich_of_table(
    table: "pd.DataFrame", width: int, most_rows: int = MOST_ROWS
) -> "Iterator[Table | Text]":
    """A table for a console of rich, in which signs in names are no markup.

    Args:
        table: With any names and cells.
        width: Characters of a line of the console.
        most_rows: That are shown; of a longer table the ends.
    """
    from rich.text import Text

    for number, block in enumerate(_blocks(columns_of(table, most_rows), width)):
        if number:
            yield Text("")
        yield _table(block, width)
    for remark in _remarks(table, most_rows):
        yield Text(remark)


def _remarks(table: "pd.DataFrame", most_rows: int) -> list[str]:
    """How many rows there are, where they are not all to be seen."""
    if not len(table):
        return ["(no rows)"]
    return [f"({len(table)} rows)"] if len(table) > most_rows else []


def _table(columns: list[Column], width: int) -> "Table":
    """Columns as rich lays them out."""
    from rich.table import Table
    from rich.text import Text

    is_wide = _total([column.width for column in columns]) > width
    shown = Table(box=None, padding=(0, COLUMN_GAP, 0, 0), pad_edge=False)
    for column in columns:
        least = min(column.least_width, width)
        shown.add_column(
            Text(column.broken_header if is_wide else column.header),
            justify="right" if column.is_number else "left",
            min_width=least,
            overflow="fold",
        )
    for cells in zip(*(column.cells for column in columns), strict=True):
        shown.add_row(*map(Text, cells))
    return shown


def _blocks(columns: list[Column], width: int) -> Iterator[list[Column]]:
    """The columns, cut where they do not fit; the first ones come again."""
    key = _key_columns(columns, width)
    block: list[Column] = []
    for column in columns:
        larger = [*block, column]
        if len(block) > len(key) and _least(larger) > width:
            yield block
            larger = [*key, column]
        block = larger
    if block:
        yield block


def _key_columns(columns: list[Column], width: int) -> list[Column]:
    """The columns up to the first texts, which tell the rows apart; or none."""
    for number, column in enumerate(columns):
        if not column.is_number:
            key = columns[: number + 1]
            return key if _least(key) <= KEY_SHARE * width else []
    return []


def _least(columns: list[Column]) -> int:
    return _total([column.least_width for column in columns])


def _total(widths: list[int]) -> int:
    return sum(widths) + COLUMN_GAP * (len(widths) - 1)


def html_of_table(table: "pd.DataFrame", most_rows: int = MOST_ROWS) -> str:
    """A table as HTML, with names and cells escaped; numbers stand at the right."""
    columns = columns_of(table, most_rows)
    head = [_cell("th", column, column.header, ' scope="col"') for column in columns]
    rows = []
    for cells in zip(*(column.cells for column in columns), strict=True):
        pairs = zip(columns, cells, strict=True)
        row = "".join(_cell("td", column, cell) for column, cell in pairs)
        rows.append(f"<tr>{row}</tr>")
    body = "\n".join(rows)
    shown = (
        f"<table>\n<thead><tr>{''.join(head)}</tr></thead>\n<tbody>\n{body}\n</tbody>\n"
        "</table>"
    )
    return "\n".join([shown, *(f"<p>{one}</p>" for one in _remarks(table, most_rows))])


def _cell(tag: str, column: Column, text: str, attributes: str = "") -> str:
    side = "right; white-space: nowrap" if column.is_number else "left"
    style = f"text-align: {side}; {CELL_STYLE}"
    return f'<{tag}{attributes} style="{style}">{html.escape(text)}</{tag}>'

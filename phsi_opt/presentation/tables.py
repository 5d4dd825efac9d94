"""Tables as text that loses no column, as HTML, and as tables of a terminal.

A table that is too wide for its lines first gets headers of several lines, then texts
of several lines, and is then cut into blocks, one below the other, in which the first
columns come again. No column is left out.
"""

import html
import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd
    from rich.text import Text

LINE_WIDTH = 80  # characters in a line of a terminal that nobody has widened
COLUMN_GAP = "  "  # between columns
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
    def narrow_width(self) -> int:
        """Characters that it takes where its header is broken into lines."""
        return max([self.longest_piece, *map(len, self.cells)])

    @property
    def longest_piece(self) -> int:
        """Characters of the longest piece of the header that is not broken."""
        return max([1, *map(len, HEADER_PIECE.findall(self.header))])


def columns_of(table: "pd.DataFrame", most_rows: int = MOST_ROWS) -> list[Column]:
    """The columns of a table as texts, the index first where it holds names."""
    import pandas as pd

    rows = _shown_rows(len(table), most_rows)
    columns = []
    if not pd.api.types.is_integer_dtype(table.index):
        name = "" if table.index.name is None else str(table.index.name)
        columns.append(_column(name, table.index.tolist(), rows, False))
    for number, name in enumerate(table.columns):
        values = table.iloc[:, number]
        is_bool = pd.api.types.is_bool_dtype(values)
        is_number = pd.api.types.is_numeric_dtype(values) and not is_bool
        columns.append(_column(str(name), values.tolist(), rows, is_number))
    return columns


def _shown_rows(n_rows: int, most_rows: int) -> list[int | None]:
    """The numbers of the rows that are shown; None stands for those left out."""
    if n_rows <= most_rows:
        return list(range(n_rows))
    half = most_rows // 2
    return [*range(half), None, *range(n_rows - half, n_rows)]


def _column(
    header: str, values: list[Any], rows: list[int | None], is_number: bool
) -> Column:
    cells = tuple(CUT if row is None else text_of_cell(values[row]) for row in rows)
    return Column(" ".join(header.split()), cells, is_number)


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
    blocks = []
    for block in blocks_of(table, width, most_rows):
        blocks.append("\n".join([*block.header, *block.rows]))
    remark = _remark(table, most_rows)
    return "\n\n".join(blocks) + (f"\n{remark}" if remark else "")


def rich_of_table(
    table: "pd.DataFrame", width: int, most_rows: int = MOST_ROWS
) -> "Text":
    """A table for a console of rich, in which signs in names are no markup.

    Args:
        table: With any names and cells.
        width: Characters of a line of the console.
        most_rows: That are shown; of a longer table the ends.
    """
    from rich.text import Text

    shown = Text(no_wrap=True)
    for number, block in enumerate(blocks_of(table, width, most_rows)):
        shown.append("\n\n" if number else "")
        shown.append("\n".join(block.header), style="bold")
        shown.append("".join(f"\n{row}" for row in block.rows))
    remark = _remark(table, most_rows)
    return shown.append(f"\n{remark}" if remark else "")


def _remark(table: "pd.DataFrame", most_rows: int) -> str:
    """How many rows there are, where they are not all to be seen."""
    if not len(table):
        return "(no rows)"
    return f"({len(table)} rows)" if len(table) > most_rows else ""


@dataclass(frozen=True)
class Block:
    """Some columns of a table, as lines.

    Attributes:
        header: The lines of their names.
        rows: The lines of their cells.
    """

    header: tuple[str, ...]
    rows: tuple[str, ...]


def blocks_of(table: "pd.DataFrame", width: int, most_rows: int) -> list[Block]:
    """All columns in blocks, each of which fits into the width.

    Args:
        table: With any names and cells.
        width: Characters of a line; a word that is longer is broken.
        most_rows: That are shown; of a longer table the ends.
    """
    columns = columns_of(table, most_rows)
    return [_block(block, width) for block in _blocks(columns, width)]


def _blocks(columns: list[Column], width: int) -> Iterator[list[Column]]:
    """The columns, cut where they do not fit; the first ones come again."""
    if _total(_fitted(columns, width)) <= width:
        if columns:
            yield columns
        return
    key = _key_columns(columns, width)
    block = list(key)
    for column in columns[len(key) :]:
        larger = [*block, column]
        if len(block) > len(key) and _total(_fitted(larger, width)) > width:
            yield block
            larger = [*key, column]
        block = larger
    yield block


def _key_columns(columns: list[Column], width: int) -> list[Column]:
    """The columns up to the first texts, which tell the rows apart; or none."""
    for number, column in enumerate(columns):
        if not column.is_number:
            key = columns[: number + 1]
            fits = _total(_fitted(key, width)) <= KEY_SHARE * width
            return key if fits and len(key) < len(columns) else []
    return []


def _total(widths: list[int]) -> int:
    return sum(widths) + len(COLUMN_GAP) * (len(widths) - 1)


def _fitted(columns: list[Column], width: int) -> list[int]:
    """The widths of the columns, as narrow as needed and possible."""
    widths = [column.width for column in columns]
    if _total(widths) <= width:
        return widths
    _break_headers(columns, widths, width)
    while _total(widths) > width:
        widest = -1
        for number, column in enumerate(columns):
            least = max(LEAST_TEXT, column.longest_piece)
            can_shrink = not column.is_number and widths[number] > least
            if can_shrink and (widest < 0 or widths[number] > widths[widest]):
                widest = number
        if widest < 0:
            break
        widths[widest] -= 1
    return widths


def _break_headers(columns: list[Column], widths: list[int], width: int) -> None:
    """Narrow the columns whose headers can be broken, what gains most first."""
    gains = []
    for number, column in enumerate(columns):
        gains.append((column.width - column.narrow_width, number))
    for gain, number in sorted(gains, reverse=True):
        if gain == 0 or _total(widths) <= width:
            return
        widths[number] -= gain


def _block(columns: list[Column], width: int) -> Block:
    widths = [min(wide, width) for wide in _fitted(columns, width)]
    headers = []
    for column, wide in zip(columns, widths, strict=True):
        headers.append(_header_lines(column.header, wide))
    header = tuple(_row_lines(columns, widths, headers))
    rows: list[str] = []
    for cells in zip(*(column.cells for column in columns), strict=True):
        broken = []
        for cell, wide in zip(cells, widths, strict=True):
            broken.append(textwrap.wrap(cell, wide))
        rows += _row_lines(columns, widths, broken)
    return Block(header, tuple(rows))


def _header_lines(header: str, width: int) -> list[str]:
    """A header in lines, broken at blanks and behind underscores."""
    if len(header) <= width:
        return [header]
    lines = [""]
    for word in header.split():
        for place, piece in enumerate(HEADER_PIECE.findall(word)):
            joint = " " if lines[-1] and place == 0 else ""
            joined = f"{lines[-1]}{joint}{piece}"
            if len(joined) <= width or not lines[-1]:
                lines[-1] = joined
            else:
                lines.append(piece)
    broken = []
    for line in lines:
        broken += textwrap.wrap(line, width)
    return broken


def _row_lines(
    columns: Sequence[Column], widths: Sequence[int], cells: Sequence[list[str]]
) -> Iterator[str]:
    """The lines of one row whose cells are broken into lines."""
    for parts in zip_longest(*cells, fillvalue=""):
        placed = []
        for column, wide, part in zip(columns, widths, parts, strict=True):
            placed.append(part.rjust(wide) if column.is_number else part.ljust(wide))
        yield COLUMN_GAP.join(placed).rstrip()


def html_of_table(table: "pd.DataFrame", most_rows: int = MOST_ROWS) -> str:
    """A table as HTML, with names and cells escaped; numbers stand at the right."""
    columns = columns_of(table, most_rows)
    head = []
    for column in columns:
        name = html.escape(column.header)
        head.append(f'<th scope="col"{_align(column)}>{name}</th>')
    rows = [f"<tr>{''.join(head)}</tr>"]
    for cells in zip(*(column.cells for column in columns), strict=True):
        row = []
        for column, cell in zip(columns, cells, strict=True):
            row.append(f"<td{_align(column)}>{html.escape(cell)}</td>")
        rows.append(f"<tr>{''.join(row)}</tr>")
    body = "\n".join(rows[1:])
    shown = f"<table>\n<thead>{rows[0]}</thead>\n<tbody>\n{body}\n</tbody>\n</table>"
    remark = _remark(table, most_rows)
    return f"{shown}\n<p>{remark}</p>" if remark else shown


def _align(column: Column) -> str:
    side = "right" if column.is_number else "left"
    wrapping = "; white-space: nowrap" if column.is_number else ""
    return f' style="text-align: {side}; {CELL_STYLE}{wrapping}"'

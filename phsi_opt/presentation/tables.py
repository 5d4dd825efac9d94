"""Tables as text that loses no column, as HTML, and as tables of a terminal.

Rich lays them out. A table that is too wide for its lines first gets headers and texts
of several lines, and is then cut into blocks, one below the other, in which the first
columns come again. This module imports pandas: it is imported where a table is made.
"""

import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from phsi_opt.presentation.numbers import LINE_WIDTH
from phsi_opt.presentation.sentences import environment

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions
    from rich.table import Table
    from rich.text import Text

BREAKABLE = re.compile(r"[ \t\r\n]+")  # but for a blank at which no line breaks
MOST_ROWS = 60  # that are printed, as pandas does; of longer tables the ends


class PrintedTable(pd.DataFrame):
    """A `pandas.DataFrame` that prints all of its columns, numbers with four digits."""

    @property
    def _constructor(self) -> "type[PrintedTable]":
        return PrintedTable

    def __repr__(self) -> str:
        """All columns within 80 characters, in several blocks if need be."""
        return text_of_table(self)

    def _repr_html_(self) -> str:
        return html_of_table(self)

    def __rich_console__(
        self, console: "Console", options: "ConsoleOptions"
    ) -> "Iterator[Table | Text]":
        yield from rich_of_table(self, options.max_width)


@dataclass(frozen=True)
class Column:
    """A column as it is shown: a header, a text per row; numbers at the right."""

    header: str
    cells: tuple[str, ...]
    is_number: bool

    @property
    def least_width(self) -> int:
        """Characters that it takes where all is broken that may be."""
        longest = max(map(len, self.cells), default=1)
        if not self.is_number:  # texts are broken at blanks, after a word or two
            words = map(len, " ".join(self.cells).split(" "))
            longest = max(min(longest, 12), min(max(words, default=1), 34))
        return max(longest, 1, *map(len, re.split(r"[\s_]+", self.header)))


def columns_of(table: pd.DataFrame, most_rows: int = MOST_ROWS) -> list[Column]:
    """The columns of a table as texts, the index first where it holds names."""
    half = most_rows // 2
    columns = []
    series = [values for _, values in table.items()]
    if not pd.api.types.is_integer_dtype(table.index):
        series.insert(0, table.index.to_series())
    for values in series:
        is_bool = pd.api.types.is_bool_dtype(values)
        is_number = pd.api.types.is_numeric_dtype(values) and not is_bool
        cells = list(map(text_of_cell, values.tolist()))
        if len(table) > most_rows:
            cells[half:-half] = ["..."]
        columns.append(Column(text_of_cell(values.name), tuple(cells), is_number))
    return columns


def text_of_cell(value: Any) -> str:
    """A cell on one line: four digits, a dash for NaN, nothing for None."""
    if value is None:
        return ""
    if isinstance(value, float | np.floating):
        return "-" if np.isnan(value) else f"{value:.4g}"
    return BREAKABLE.sub(" ", str(value)).strip()


def text_of_table(
    table: pd.DataFrame, width: int = LINE_WIDTH, most_rows: int = MOST_ROWS
) -> str:
    """A table as text with all of its columns."""
    from rich.console import Console

    printed = io.StringIO()
    console = Console(file=printed, width=width, color_system=None)
    console.print(*rich_of_table(table, width, most_rows), sep="\n")
    return "\n".join(line.rstrip() for line in printed.getvalue().splitlines())


def rich_of_table(
    table: pd.DataFrame, width: int, most_rows: int = MOST_ROWS
) -> "Iterator[Table | Text]":
    """A table for a console of rich, as `text_of_table`; names are no markup."""
    from rich.text import Text

    for number, block in enumerate(_blocks(columns_of(table, most_rows), width)):
        if number:
            yield Text("")
        yield _laid_out(block, width)
    remark = _remark(table, most_rows)
    if remark:
        yield Text(remark)


def _remark(table: pd.DataFrame, most_rows: int) -> str:
    """How many rows there are, where they are not all to be seen."""
    if not len(table):
        return "(no rows)"
    return f"({len(table)} rows)" if len(table) > most_rows else ""


def _laid_out(columns: list[Column], width: int) -> "Table":
    from rich.table import Table
    from rich.text import Text

    widest = [max(map(len, (one.header, *one.cells))) for one in columns]
    is_wide = _with_gaps(widest) > width
    shown = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
    spare = max(width - _least(columns), 0)
    for one, most in zip(columns, widest, strict=True):
        least = min(one.least_width, width)
        more = min(max(most - least, 0), spare)
        spare -= more
        shown.add_column(
            Text(one.header.replace("_", "\n") if is_wide else one.header),
            justify="right" if one.is_number else "left",
            width=least + more,  # rich itself would break words
            overflow="fold",
        )
    for cells in zip(*(one.cells for one in columns), strict=True):
        shown.add_row(*map(Text, cells))
    return shown


def _blocks(columns: list[Column], width: int) -> Iterator[list[Column]]:
    """The columns, cut where they do not fit; the first ones come again."""
    texts = [k for k, column in enumerate(columns) if not column.is_number]
    key = columns[: texts[0] + 1] if texts else []
    if 2 * _least(key) > width:
        key = []
    block: list[Column] = []
    for column in columns:
        if len(block) > len(key) and _least([*block, column]) > width:
            yield block
            block = list(key)
        block.append(column)
    if block:
        yield block


def _least(columns: list[Column]) -> int:
    """Characters that columns take at least, with the gaps between them."""
    return _with_gaps([column.least_width for column in columns])


def _with_gaps(widths: list[int]) -> int:
    return sum(widths) + 2 * (len(widths) - 1)


def html_of_table(table: pd.DataFrame, most_rows: int = MOST_ROWS) -> str:
    """A table as HTML, with names and cells escaped."""
    columns = columns_of(table, most_rows)
    n_rows = len(columns[0].cells) if columns else 0
    return html_shown("table", columns, n_rows, _remark(table, most_rows))


def html_shown(name: str, *facts: Any) -> str:
    """What a macro of ``shown.html.jinja`` makes of facts, as safe markup."""
    found = environment("phsi_opt.presentation", "templates", autoescape=True)
    made: str = getattr(found.get_template("shown.html.jinja").module, name)(*facts)
    return made.strip()

"""A look at one column: numbers or not, how many cells are missing, which are wrong.

A column is meant to be numeric where most of its cells are numbers: then a cell that is
none is a mistake in the file, and it is told with its line.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from phsi_opt.data.dates_as_numbers import format_of_dates
from phsi_opt.data.tables import Table
from phsi_opt.data.text_cells import MISSING_CELLS
from phsi_opt.data.wording import number_of
from phsi_opt.study_file.headers import Header, header_of

DATES = "dates"
MOSTLY = 0.5  # share of the filled cells above which a column is of numbers, or dates
LOOKED_AT = 50  # cells that tell whether a column holds dates
DATE_FORMATS = tuple(  # day and month before the year, which ISO 8601 does not have
    f"{day}{clock}"
    for day in ("%d.%m.%Y", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y")
    for clock in ("", " %H:%M", " %H:%M:%S", " %H:%M:%S.%f")
)
OF_UNITS = "if that line has units, write them into the header: q [m]"
EXAMPLES = 3  # different texts that are shown of a column of text
CELL_CHARACTERS = 20  # of a cell


@dataclass(eq=False)
class Seen:
    """A column as it was seen.

    Attributes:
        header: what its header tells.
        cells: its cells as text, (n_lines,).
        lines: what messages call its rows: "line 3" or "row 3", (n_lines,).
        values: (n_lines,), NaN where missing or wrong; None: no numbers.
        is_missing: which cells are empty, (n_lines,).
        is_left_out: whether nothing can be made of it.
        is_dates: whether most of its cells are dates.
        date_format: how they are written, in the signs of strptime, where it is not as
            in ISO 8601; "" where it is, or where the cells do not tell.
        said: what was seen, in words.
        wrong: the first cell that is wrong, in words; "" where none is.
    """

    header: Header
    cells: pd.Series
    lines: list[str]
    is_missing: np.ndarray
    values: np.ndarray | None = None
    is_left_out: bool = False
    is_dates: bool = False
    date_format: str = ""
    said: str = ""
    wrong: str = ""

    @property
    def n_missing(self) -> int:
        """How many cells are empty."""
        return int(self.is_missing.sum())

    @property
    def is_counter(self) -> bool:
        """Whether it counts the lines."""
        return self.values is not None and bool(np.all(np.diff(self.values) == 1))

    def left_out(self, why: str) -> "Seen":
        """The same, left out."""
        self.is_left_out = True
        self.said = why
        return self


def columns_of(table: Table) -> list[Seen]:
    """All columns of a table, in its order."""
    headers = [str(column) for column in table.frame.columns]
    lines = [table.row(i) for i in range(len(table.frame))]
    seen = []
    for number, header in enumerate(headers):
        cells = table.frame.iloc[:, number].map(_as_text).str.strip()
        if table.decimal == ",":
            cells = cells.str.replace(",", ".", regex=False)
        is_missing = cells.str.lower().isin(MISSING_CELLS).to_numpy()
        one = Seen(header_of(header), cells, lines, is_missing)
        seen.append(_looked_at(one, headers.count(header)))
    return seen


def _as_text(cell: Any) -> str:
    return "" if cell is None else str(cell)


def _looked_at(one: Seen, n_of_this_name: int) -> Seen:
    is_missing = one.is_missing
    filled = one.cells.where(~is_missing)
    numbers = pd.to_numeric(filled, errors="coerce").to_numpy(float)
    is_number = np.isfinite(numbers)
    if is_missing.all():
        return one.left_out("empty")
    if n_of_this_name > 1:
        return one.left_out(f"{n_of_this_name} columns are called so")
    if not one.header.text:
        return one.left_out("no name in the header")
    if is_number.sum() <= MOSTLY * (~is_missing).sum():
        return _of_text(one)
    one.values = np.where(is_number, numbers, np.nan)
    one.wrong = _wrong_cells(one, np.flatnonzero(~is_number & ~is_missing))
    one.date_format = "" if one.wrong else format_of_dates(one.values)
    if one.date_format:
        one.values = None
        one.is_dates = True
        return one.left_out(DATES)
    low = np.nanmin(one.values)
    high = np.nanmax(one.values)
    if low == high and not one.wrong:
        return one.left_out(f"always {low:g}")
    one.said = f"{low:.4g} to {high:.4g}"
    if one.n_missing:
        one.said += f", {number_of(one.n_missing, 'cell')} missing"
    return one


def _wrong_cells(one: Seen, places: np.ndarray) -> str:
    """The first cell that is no finite number, and how many more there are."""
    if not places.size:
        return ""
    first = int(places[0])
    said = f"{one.lines[first]} holds {_shown(one.cells.iloc[first])}, no finite number"
    if places.size == 1:
        return f"{said}; {OF_UNITS}" if first == 0 else said
    return f"{said}; {number_of(places.size - 1, 'more such cell')}"


def _shown(cell: str) -> str:
    """A cell in quotes, cut where it is long."""
    one_line = " ".join(cell.split())
    if len(one_line) > CELL_CHARACTERS:
        one_line = f"{one_line[:CELL_CHARACTERS]}..."
    return f'"{one_line}"'


def _of_text(one: Seen) -> Seen:
    """A column of dates, or of texts, which are left out."""
    cells = one.cells[~one.is_missing]
    one.date_format = _date_format(cells)
    if one.date_format or _are_dates(cells):
        one.is_dates = True
        return one.left_out(DATES)
    different = cells[:LOOKED_AT].unique()
    shown = ", ".join(_shown(cell) for cell in different[:EXAMPLES])
    more = ", ..." if len(different) > EXAMPLES else ""
    return one.left_out(f"text: {shown}{more}")


def _date_format(cells: pd.Series) -> str:
    """The one way of `DATE_FORMATS` in which most of the cells are dates; else ""."""
    fitting = []
    for form in DATE_FORMATS:
        parsed = pd.to_datetime(cells, errors="coerce", format=form)
        if parsed.notna().mean() > MOSTLY:
            fitting.append((float(parsed.notna().mean()), form))
    best = max(fitting, default=(0.0, ""))
    is_clear = [share for share, _ in fitting].count(best[0]) == 1
    return best[1] if is_clear else ""


def _are_dates(cells: pd.Series) -> bool:
    try:
        parsed = pd.to_datetime(cells[:LOOKED_AT], errors="coerce", format="mixed")
    except (ValueError, TypeError):
        return False
    return bool(parsed.notna().mean() > MOSTLY)

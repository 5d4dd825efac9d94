"""A look at one column: numbers or not, how many cells are missing, which are wrong.

A column is meant to be numeric where most of its cells are numbers: then a cell that is
none is a mistake in the file, and it is told with its line.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from phsi_opt.data.tables import Table, rows_of_runs
from phsi_opt.data.text_cells import MISSING_CELLS
from phsi_opt.data.times import format_of_dates
from phsi_opt.presentation.numbers import number_of, shortened
from phsi_opt.study_file.headers import TIMES, Header

TIME = "time"
RUN = "run"
STATE = "state"
INPUT = "input"
UNUSED = "left out"
PERHAPS_INPUT = "perhaps an input"
DATES = "dates"
MOSTLY = 0.5  # share of the filled cells above which a column is of numbers, or dates
DATE_FORMATS = tuple(  # day and month before the year, which ISO 8601 does not have
    f"{day}{clock}"
    for day in ("%d.%m.%Y", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y")
    for clock in ("", " %H:%M", " %H:%M:%S", " %H:%M:%S.%f")
)
OF_UNITS = "if that line has units, write them into the header: q [m]"


@dataclass(eq=False)
class Column:
    """A column as it was seen, and what it may be.

    Attributes:
        header: what its header tells.
        cells: its cells as text, (n_lines,).
        lines: what messages call its rows: "line 3" or "row 3", (n_lines,).
        is_missing: which cells are empty, (n_lines,).
        values: (n_lines,), NaN where missing or wrong; None: nothing of numbers can be
            made of it, or they are always the same.
        is_numeric: whether most of its cells are numbers.
        date_format: how dates are written, in the signs of strptime, where it is not as
            in ISO 8601; "" where it is, or where the cells do not tell.
        said: what was seen, in words: its range, missing cells, why it is left out.
        wrong: the first cell that cannot be used, with its line; "" where none is.
        part: `TIME`, `RUN`, `STATE`, `INPUT` or `UNUSED`.
        name: what it could be called in formulas; "" where it is in none.
    """

    header: Header
    cells: pd.Series
    lines: list[str]
    is_missing: np.ndarray
    values: np.ndarray | None = None
    is_numeric: bool = False
    date_format: str = ""
    said: str = ""
    wrong: str = ""
    part: str = UNUSED
    name: str = ""

    @property
    def column(self) -> str:
        """Its header, as it stands in the table."""
        return self.header.text

    @property
    def unit(self) -> str:
        """As in the header; "" where it does not tell."""
        return self.header.unit

    @property
    def remark(self) -> str:
        """Everything that was seen, what is wrong first."""
        return "; ".join(filter(None, [self.wrong, self.said]))

    @property
    def content(self) -> dict[str, Any]:
        """What is told of it as JSON."""
        told = ("column", "part", "name", "unit", "said", "wrong")
        return {name: getattr(self, name) for name in told}

    @property
    def may_be_input(self) -> bool:
        """Whether it is a state, or an input."""
        return self.said.endswith(PERHAPS_INPUT)

    def becomes(self, part: str, remark: str = "") -> None:
        """Take a part, and say why."""
        self.part = part
        self.said = "; ".join(filter(None, [self.said, remark]))

    def left_out(self, why: str) -> None:
        """Nothing can be made of it."""
        self.values = None
        self.said = why

    @property
    def is_dates(self) -> bool:
        """Whether most of its cells are dates."""
        return self.said == DATES

    @property
    def n_missing(self) -> int:
        """How many cells are empty."""
        return int(self.is_missing.sum())

    @property
    def only_number(self) -> float | None:
        """The only number of the column, where it is above zero."""
        numbers = pd.to_numeric(self.cells, errors="coerce").dropna().unique()
        is_one = len(numbers) == 1 and 0 < numbers[0] < np.inf
        return float(numbers[0]) if is_one else None

    @property
    def may_be_time(self) -> bool:
        """Whether nothing speaks against a time, if the column increases."""
        if self.values is None or self.header.unit not in ("", *TIMES):
            return self.is_dates
        return not np.all(np.diff(self.values) == 1)  # a counter of lines

    def neighbours(self, run: "Column | None") -> np.ndarray:
        """The rows of each sample and of the next one of its run, (n_pairs, 2)."""
        runs = [np.arange(len(self.lines))]
        if run is not None:
            runs = list(rows_of_runs(run.cells).values())
        return np.vstack([np.column_stack([rows[:-1], rows[1:]]) for rows in runs])

    def wrong_time(self, run: "Column | None") -> str:
        """The first time that is missing, wrong or not after the one before it."""
        assert self.values is not None
        if self.wrong:
            return self.wrong
        if self.n_missing:
            return f"{self.lines[int(np.argmax(self.is_missing))]} has no time"
        pairs = self.neighbours(run)
        late = pairs[self.values[pairs[:, 1]] <= self.values[pairs[:, 0]]]
        if not len(late):
            return ""
        before, after = late[0]
        said = (
            f"{self.lines[after]} has {self.values[after]:.6g}, not after "
            f"{self.values[before]:.6g} of {self.lines[before]}"
        )
        return _and_more(said, len(late), "more such line")


def columns_of(table: Table) -> list[Column]:
    """All columns of a table, in its order."""
    headers = [str(column) for column in table.frame.columns]
    lines = [table.row(i) for i in range(len(table.frame))]
    seen = []
    for number, header in enumerate(headers):
        cells = table.frame.iloc[:, number].map(
            lambda cell: "" if cell is None else str(cell)
        )
        cells = cells.str.strip()
        if table.decimal == ",":
            cells = cells.str.replace(",", ".", regex=False)
        is_missing = cells.str.lower().isin(MISSING_CELLS).to_numpy()
        one = Column(Header.of(header), cells, lines, is_missing)
        _look_at(one, headers.count(header))
        seen.append(one)
    return seen


def _look_at(one: Column, n_of_this_name: int) -> None:
    filled = one.cells.where(~one.is_missing)
    numbers = pd.to_numeric(filled, errors="coerce").to_numpy(float)
    is_number = np.isfinite(numbers)
    if one.is_missing.all():
        return one.left_out("empty")
    if n_of_this_name > 1:
        return one.left_out(f"{n_of_this_name} columns are called so")
    if not one.header.text:
        return one.left_out("no name in the header")
    one.is_numeric = bool(is_number.sum() > MOSTLY * (~one.is_missing).sum())
    if not one.is_numeric:
        return _look_at_texts(one)
    one.values = np.where(is_number, numbers, np.nan)
    one.wrong = _wrong_cells(one, np.flatnonzero(~is_number & ~one.is_missing))
    one.date_format = "" if one.wrong else format_of_dates(one.values)
    if one.date_format:
        return one.left_out(DATES)
    low = np.nanmin(one.values)
    high = np.nanmax(one.values)
    if low == high and not one.wrong:
        return one.left_out(f"always {low:g}")
    one.said = f"{low:.4g} to {high:.4g}"
    if one.n_missing:
        one.said += f", {number_of(one.n_missing, 'cell')} missing"


def _wrong_cells(one: Column, places: np.ndarray) -> str:
    """The first cell that is no finite number, and how many more there are."""
    if not places.size:
        return ""
    first = int(places[0])
    said = f"{one.lines[first]} holds {_shown(one.cells.iloc[first])}, no finite number"
    if places.size == 1 and first == 0:
        return f"{said}; {OF_UNITS}"
    return _and_more(said, places.size, "more such cell")


def _and_more(said: str, n_found: int, noun: str) -> str:
    return said if n_found == 1 else f"{said}; {number_of(n_found - 1, noun)}"


def _shown(cell: str) -> str:
    """A cell in quotes, cut where it is long."""
    return f'"{shortened(" ".join(cell.split()), 20)}"'


def _look_at_texts(one: Column) -> None:
    """A column of dates, or of texts, which are left out."""
    cells = one.cells[~one.is_missing]
    one.date_format = _date_format(cells)
    some = cells[:50]  # more would tell nothing else
    if one.date_format or _share_of_dates(some, "mixed") > MOSTLY:
        return one.left_out(DATES)
    different = some.unique()
    more = ", ..." if len(different) > 3 else ""
    return one.left_out(f"text: {', '.join(map(_shown, different[:3]))}{more}")


def _date_format(cells: pd.Series) -> str:
    """The one way of `DATE_FORMATS` in which most of the cells are dates; else ""."""
    shares = {form: _share_of_dates(cells, form) for form in DATE_FORMATS}
    best = max(shares, key=shares.__getitem__)
    is_clear = list(shares.values()).count(shares[best]) == 1
    return best if is_clear and shares[best] > MOSTLY else ""


def _share_of_dates(cells: pd.Series, form: str) -> float:
    try:
        parsed = pd.to_datetime(cells, errors="coerce", format=form)
    except (ValueError, TypeError):
        return 0.0
    return float(parsed.notna().mean())

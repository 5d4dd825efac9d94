"""A column of a table: what it is, and a look at its cells, which tells what it may be.

A column is meant to be numeric where most of its cells are numbers: then a cell that is
none is a mistake in the file, and it is reported with its line.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from phsi_opt.data.headers import TIMES, Header, words_in
from phsi_opt.data.tables import MISSING_CELLS, Table, numbers_in, plain_number
from phsi_opt.data.times import (
    clock_of,
    format_of_dates,
    rounded_step,
)
from phsi_opt.data.trajectory import is_stepped
from phsi_opt.errors import DataError
from phsi_opt.presentation.numbers import number_of, shortened
from phsi_opt.study_file.keys import KEYS_OF, listed
from phsi_opt.study_file.sections import without

TIME = "time"
RUN = "run"
STATE = "state"
INPUT = "input"
UNUSED = "left out"
# Where a study file has the keys of a column that is this part.
KEYS_OF_PARTS = {TIME: "data.time", STATE: "data.states.*", INPUT: "data.inputs.*"}
PERHAPS_INPUT = "possibly an input"
DATES = "dates"
DAYS = (  # which ISO 8601 does not have
    *("%d.%m.%Y", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y", "%Y/%m/%d", "%d-%b-%Y"),
    *("%d.%m.%y", "%d/%m/%y", "%m/%d/%y"),
)
CLOCK_FORMATS = ("", " %H:%M", " %H:%M:%S", " %H:%M:%S.%f", " %I:%M:%S %p", " %I:%M %p")
DATE_FORMATS = tuple(f"{day}{clock}" for day in DAYS for clock in CLOCK_FORMATS)
TWO_NUMBERS = re.compile(r"\d\D+\d|\d{6}")  # every date has a day and a year
DATE_WORDS = words_in("date datum datetime timestamp zeitstempel")
ELECTRICAL_WORDS = words_in("volt volts voltage current pwm duty")
COUNTER_WORDS = words_in("no nr number sample index count scan row line point")


@dataclass(kw_only=True)
class Column(Header):
    """A column and what it is, as was guessed or as a user says.

    The names of the keys of a study file are those of the fields. A page, where they
    are typed, may have any text in them.
    """

    part: str = UNUSED  # `TIME`, `RUN`, `STATE`, `INPUT` or `UNUSED`
    name: str = ""  # what it is called in formulas; "" where it is in none
    # how dates are written, in the signs of strptime, where it is not as in ISO 8601;
    # "" where it is, or where the cells do not tell
    date_format: str = ""
    # "zero" where it is constant between jumps, as an input that is held; else ""
    hold: str = ""
    clock: str = ""  # the column of its own times; "": those of the others
    # What a user says of a state, and of a time that has dates; "": nothing.
    noise: float | str = ""
    measured: bool | str = ""
    start: str = ""
    examples: tuple[str, ...] = ()  # its first cells
    is_numeric: bool = True  # whether most of its cells are numbers
    # what was seen, in words: its range, missing cells, why it is left out
    said: str = ""
    # which part it is to the user, where a base model has no place for it
    lost: str = ""

    @property
    def heading(self) -> str:
        """Its header, or those from which it is put together."""
        return " + ".join(map(str, listed(self.column)))

    @property
    def may_be_input(self) -> bool:
        """Whether it is a state only for want of a better guess."""
        return self.said.endswith(PERHAPS_INPUT)

    def take(self, part: str, told: Mapping[str, Any]) -> None:
        """Be a part, of which a study file says this."""
        self.part = part
        for key in ("name", "unit", *TOLD):
            setattr(self, key, told.get(key, ""))

    def content(self) -> dict[str, Any]:
        """What a study file says of it as the part that it is."""
        content = {}
        for key in KEYS_OF[KEYS_OF_PARTS[self.part]]:
            content[key] = getattr(self, key, "")
        return without(content, "")


TOLD = ("date_format", "hold", "clock", "noise", "measured", "start")


@dataclass(eq=False, kw_only=True)
class SeenColumn(Column):
    """A column with its cells; all its arrays are (n_lines,)."""

    cells: pd.Series  # its cells as text, (n_lines,)
    is_missing: np.ndarray  # which cells are empty, (n_lines,)
    # (n_lines,), NaN where missing or wrong; None: nothing of numbers can be made of
    # it, or they are always the same
    values: np.ndarray | None = None
    is_numeric: bool = False
    other_format: str = ""  # which the dates fit as well
    # the first cell that cannot be used, with its line; "" where none is
    wrong: str = ""
    # columns of the time of day and of milliseconds, beside one of dates
    further: tuple[str, ...] = ()

    @property
    def remark(self) -> str:
        """Everything that was seen, what is wrong first."""
        return _joined(self.wrong, self.said, self.other_dates)

    @property
    def other_dates(self) -> str:
        """How else its dates could be read; "" where they tell."""
        return self.other_format and f'or date_format = "{self.other_format}"'

    @property
    def source(self) -> str | tuple[str, ...]:
        """The column, or those from which it is put together."""
        return (self.column, *self.further) if self.further else self.column

    @property
    def title(self) -> str:
        title = " ".join(self.column.split())
        is_told = not self.unit or self.unit in title
        return title if is_told else f"{title} [{self.unit}]"

    @property
    def is_counter(self) -> bool:
        """Whether it counts the lines, some of which may be missing, and says so."""
        is_named = self.label == "#" or self.has_one_of(COUNTER_WORDS)
        if not is_named or self.values is None:
            return False
        steps = np.diff(self.values)
        return bool(np.all((steps > 0) & (steps % 1 == 0)) and np.median(steps) == 1)

    @property
    def answer(self) -> dict[str, Any]:
        keys = ("column", "part", "name", "unit", "date_format", "hold", "clock")
        return {key: getattr(self, key) for key in (*keys, "said", "wrong")}

    def without_cells(self) -> Column:
        column = Column(self.source)
        for one in fields(Column)[1:]:
            setattr(column, one.name, getattr(self, one.name))
        column.examples = tuple(self.cells[:3])
        return column

    def take_dates_of(self, cells: pd.Series) -> None:
        """Say how texts are dates: of what fits, where they lie closest together."""
        found = []
        for form in DATE_FORMATS:
            if _share_of_dates(cells[:50], form) > 0.5:
                dates = _dates(cells, form)
                share = float(dates.notna().mean())
                found.append((-share, dates.max() - dates.min(), form))
        found.sort()
        best = [form for share, _, form in found if share == found[0][0] < -0.5]
        self.date_format, self.other_format = (*best, "", "")[:2]

    def becomes(self, part: str, remark: str = "") -> None:
        self.part = part
        self.said = _joined(self.said, remark)

    @property
    def is_dates(self) -> bool:
        return self.said == DATES

    @property
    def n_missing(self) -> int:
        return int(self.is_missing.sum())

    @property
    def only_number(self) -> float | None:
        numbers = pd.to_numeric(self.cells, errors="coerce").dropna().unique()
        is_one = len(numbers) == 1 and 0 < numbers[0] < np.inf
        return float(numbers[0]) if is_one else None

    @property
    def may_be_time(self) -> bool:
        """Whether nothing speaks against a time, if the column increases."""
        if self.values is None or self.unit not in ("", *TIMES):
            return self.is_dates
        return not np.all(np.diff(self.values) == 1)  # a number of the line

    def is_held(self, runs: Sequence[np.ndarray]) -> bool:
        """Whether it is constant between jumps, in its runs; gaps tell nothing.

        With cells missing, only what drives a machine is: voltage, current, duty cycle.
        """
        if self.values is None or self.wrong:
            return False
        is_electrical = self.unit in ("mV", "V", "kV", "mA", "A")
        is_electrical = is_electrical or self.has_one_of(ELECTRICAL_WORDS)
        if self.misses_samples and not is_electrical:
            return False
        return is_stepped(self.known_in(runs))

    def known_in(self, runs: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Its values in each run, given by its rows, where they are known."""
        assert self.values is not None
        known = []
        for rows in runs:
            own = self.values[rows]
            known.append(own[np.isfinite(own)])
        return known

    @property
    def misses_samples(self) -> bool:
        """Whether cells are empty that should not be; other clocks have fewer."""
        return self.n_missing > 0 and not self.clock

    def increases(self, runs: Sequence[np.ndarray]) -> bool:
        """Whether its values, where they are known, increase in each run."""
        return self.values is not None and all(
            np.all(np.diff(known) > 0) for known in self.known_in(runs)
        )

    @property
    def rounded_step(self) -> str:
        """The step of times that were rounded until some are equal; "" of others."""
        return "" if self.values is None else rounded_step(self.values)


def columns_of(table: Table) -> list[SeenColumn]:
    """All columns of a table, in its order."""
    headers = list(map(str, table.frame.columns))
    columns = []
    for number, header in enumerate(headers):
        cells = table.frame.iloc[:, number].map(
            lambda cell: "" if cell is None else str(cell)
        )
        cells = cells.str.strip()
        cells = cells.map(partial(plain_number, decimal=table.decimal))
        is_missing = cells.str.lower().isin(MISSING_CELLS).to_numpy()
        words = vars(Header.of(header))
        words["unit"] = table.units.get(header) or words["unit"]
        column = SeenColumn(**words, cells=cells, is_missing=is_missing)
        column.said = _look_at(column, table, headers.count(header))
        columns.append(column)
    return columns


def _look_at(column: SeenColumn, table: Table, n_of_this_name: int) -> str:
    """Find the values of a column; what was seen, in words."""
    filled = ~column.is_missing
    numbers = pd.to_numeric(column.cells.where(filled), errors="coerce").to_numpy(float)
    is_number = np.isfinite(numbers)
    if not filled.any():
        return "empty"
    if n_of_this_name > 1:
        return f"{n_of_this_name} columns have this name"
    if not column.column:
        return "no name in the header"
    column.is_numeric = bool(is_number.sum() > 0.5 * filled.sum())
    if not column.is_numeric:
        return _look_at_texts(column)
    values = np.where(is_number, numbers, np.nan)
    if np.any(~is_number & filled):
        read = partial(numbers_in, table, column.column, may_be_missing=True)
        column.wrong = fault_of(table, read)
    column.date_format = "" if column.wrong else _format_of_numbers(column, values)
    if column.date_format:
        return DATES
    low, high = np.nanmin(values), np.nanmax(values)
    if low == high and not column.wrong:
        return f"always {low:g}"
    column.values = values
    missing = f", {number_of(column.n_missing, 'cell')} missing"
    return f"{low:.4g} to {high:.4g}{missing if column.n_missing else ''}"


def _format_of_numbers(column: SeenColumn, values: np.ndarray) -> str:
    """How numbers are dates; days are, where the header says so."""
    clock = clock_of(values) if column.is_time and not column.unit else ""
    if clock == "excel" and not column.has_one_of(DATE_WORDS):
        clock = ""
    return format_of_dates(values) or clock


def fault_of(table: Table, read: Callable[[], Any]) -> str:
    """Why something of a table cannot be read, in the reader's words; "": it can."""
    try:
        read()
    except DataError as error:
        return str(error).removeprefix(f"{table.title}, ")
    return ""


def _joined(*parts: str) -> str:
    return "; ".join(filter(None, parts))


def _look_at_texts(column: SeenColumn) -> str:
    """What is in a column of dates, or of texts, which are left out."""
    cells = column.cells[~column.is_missing]
    some = cells[:50]  # more would tell nothing else
    if some.str.contains(TWO_NUMBERS).mean() > 0.5:
        column.take_dates_of(cells)
        if column.date_format or _share_of_dates(some, "mixed") > 0.5:
            return DATES
    different = some.unique()
    shown = []
    for cell in different[:3]:
        shown.append(f'"{shortened(" ".join(cell.split()), 20)}"')
    more = ", ..." if len(different) > 3 else ""
    return f"text: {', '.join(shown)}{more}"


def _share_of_dates(cells: pd.Series, form: str) -> float:
    try:
        return float(_dates(cells, form).notna().mean())
    except (ValueError, TypeError):
        return 0.0


def _dates(cells: pd.Series, form: str) -> pd.Series:
    return pd.to_datetime(cells, errors="coerce", format=form)

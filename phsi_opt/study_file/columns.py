"""A look at one column: what its header says, whether its cells are numbers.

Units stand in brackets ("q [m]", "T (degC)", "Time(s)"), after a stroke ("x / mm"), or
after the last underscore where it is one ("position_m", "Tempo_s"); "v_m_s" is in m/s,
"a_m_s2" in m/s2. A column of a MATLAB matrix, "X(:,2)", has none.

A column is meant to be numeric where most of its cells are numbers: then a cell that is
none is a mistake in the file, and it is reported with its line.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from phsi_opt.data.table_extent import unit_in
from phsi_opt.data.tables import MISSING_CELLS, Table, plain_number, rows_of_runs
from phsi_opt.data.text_tables import PART
from phsi_opt.data.times import clock_of, format_of_dates
from phsi_opt.data.trajectory import is_stepped
from phsi_opt.model.kinds import kind_of_unit
from phsi_opt.presentation.numbers import number_of, shortened

# ---- headers -------------------------------------------------------------------------

IN_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*$")
AFTER_STROKE = re.compile(r"^(.*?\S)(?:\s+(?:/|in)|,)\s+(\S+)$")
SERIAL = re.compile(r"\s*\([^)]*:[^)]*\)$")  # of a logger: "Temp, °C (S/N: 1234)"
OF_MATRIX = re.compile(r"([\w.]+)\((?::,\s*)?(\d+)(?:,\s*:)?\)")
TIMES = frozenset({"s", "sec", "ms", "us", "µs", "min", "h", "seconds", "d"})
# Words that are units behind a name; pint knows c and in, too.
UNIT_WORD = re.compile(
    "[nuµmcdkMG]?(m|V|rad|N|Nm|Ns|Nms|Pa|bar|[Ll]|A|C|Wb|Ah|K|J)"
    "|deg[CF]?|°[CF]?|rev|rpm|[cdm]?m3|psi|mH2O|Vs|k?Wh"
)
SPELLED = {"sec": "s", "seconds": "s"}
# Single letters after an underscore that are more often an index than a unit.
INDICES = frozenset({"l", "C", "d"})
WORD = re.compile(r"[^\W\d_]+\d*")

TIME_WORDS = frozenset(
    {
        *("t", "time", "times", "timestamp", "datetime", "date", "tempo", "zeit"),
        *("temps", "datum", "uhrzeit", "zeitstempel"),
    }
)
STEP_WORDS = frozenset({"ts", "dt", "step"})
RUN_WORDS = frozenset(
    {"run", "trajectory", "trial", "experiment", "versuch", "record", PART}
)
COUNTER_WORDS = frozenset(
    {"no", "nr", "number", "sample", "index", "count", "scan", "row", "line", "point"}
)
INPUT_WORDS = frozenset(
    {
        *("u", "in", "input", "command", "cmd", "controle", "control", "pwm", "duty"),
        *("force", "torque", "current", "heater", "pump", "valve", "throttle", "motor"),
        *("uest", "uval", "drive", "actuator", "thrust"),
    }
)
# These may be what drives a system, or what is to be found: only a remark is made.
PERHAPS_INPUT_WORDS = frozenset(
    {
        *("solar", "sun", "irradiance", "radiation", "ghi", "wind", "load", "power"),
        *("ambient", "outdoor", "outside", "supply", "inflow", "heating", "pulses"),
        *("disturbance", "ps", "ph", "ta", "thm", "qh"),
    }
)
SET_POINT_WORDS = frozenset(
    {"setpoint", "reference", "referencia", "referenz", "sollwert", "target", "desired"}
)


@dataclass(eq=False)
class Header:
    """A header."""

    column: str  # as it stands in the table
    label: str  # without the unit
    unit: str = ""  # "" where it does not tell one

    @classmethod
    def of(cls, text: str) -> "Header":
        """The label and the unit of a header."""
        of_matrix = OF_MATRIX.fullmatch(text)
        if of_matrix is not None:
            return Header(text, f"{of_matrix[1]}_{of_matrix[2]}")
        column = text
        text = SERIAL.sub("", column)
        for form in (IN_BRACKETS, AFTER_STROKE):
            found = form.match(text)
            is_after_comma = form is AFTER_STROKE and "," in text
            if found and found[1] and (not is_after_comma or unit_in(found[2])):
                return Header(column, found[1], SPELLED.get(found[2], found[2]))
        label, _, last = text.rpartition("_")
        name, _, numerator = label.rpartition("_")
        time = last.removesuffix("2")  # of a rate such as m/s, l/min, rad/s2
        may_be_rate = name and time in TIMES and UNIT_WORD.fullmatch(numerator)
        is_rate = may_be_rate and kind_of_unit(f"{numerator}/{time}") != ""
        if is_rate and not _any_of(_words(text)[:1], TIME_WORDS):
            return Header(column, name, f"{numerator}/{last}")
        is_unit = last in TIMES or UNIT_WORD.fullmatch(last)
        if label and last not in INDICES and is_unit:
            return Header(column, label, SPELLED.get(last, last))
        return Header(column, text)

    @property
    def is_time(self) -> bool:
        """Whether it says that it is the time; T is a temperature."""
        words = _words(self.label.rpartition(".")[2])  # of a field of a struct
        if not words or self.label == "T" or self.unit not in ("", *TIMES):
            return False
        return words[0] in TIME_WORDS or (words[-1] in TIME_WORDS and self.unit != "")

    @property
    def is_run(self) -> bool:
        """Whether it says that it names runs."""
        return _any_of(_words(self.label)[:1], RUN_WORDS)

    @property
    def is_step(self) -> bool:
        """Whether it says that it is the time between samples."""
        return _words(self.label) in ([word] for word in STEP_WORDS)

    def has_one_of(self, known: frozenset[str]) -> bool:
        """Whether one of its words is known, whatever the numbers behind them."""
        return _any_of((w.rstrip("0123456789") for w in _words(self.label)), known)

    @property
    def is_set_point(self) -> bool:
        """Whether it says that it is what a controller aims at."""
        words = [word.rstrip("0123456789") for word in _words(self.label)]
        is_reference = any(word.endswith("ref") for word in words)
        is_split = words[:2] == ["set", "point"]
        return is_reference or is_split or _any_of(words, SET_POINT_WORDS)

    @property
    def suggested_name(self) -> str:
        """A name that formulas can use, from the label."""
        name = re.sub(r"\W+", "_", self.label).strip("_")
        return f"x{name}" if name[:1].isdigit() else name


def _words(text: str) -> list[str]:
    """The words of a text, in lower case, with the numbers behind them."""
    return [word.lower() for word in WORD.findall(text)]


def _any_of(words: Iterable[str], known: frozenset[str]) -> bool:
    return not known.isdisjoint(words)


# ---- cells ---------------------------------------------------------------------------

TIME = "time"
RUN = "run"
STATE = "state"
INPUT = "input"
UNUSED = "left out"
PERHAPS_INPUT = "perhaps an input"
DATES = "dates"
MOSTLY = 0.5  # share of the filled cells above which a column is of numbers, or dates
DAYS = (  # which ISO 8601 does not have
    *("%d.%m.%Y", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y", "%Y/%m/%d", "%d-%b-%Y"),
    *("%d.%m.%y", "%d/%m/%y", "%m/%d/%y"),
)
CLOCK_FORMATS = ("", " %H:%M", " %H:%M:%S", " %H:%M:%S.%f", " %I:%M:%S %p", " %I:%M %p")
DATE_FORMATS = tuple(f"{day}{clock}" for day in DAYS for clock in CLOCK_FORMATS)
DATE_WORDS = frozenset({"date", "datum", "datetime", "timestamp", "zeitstempel"})


@dataclass(eq=False, kw_only=True)
class Column(Header):
    """A column as it was seen, and what it may be; all its arrays are (n_lines,)."""

    cells: pd.Series  # its cells as text, (n_lines,)
    lines: list[str]  # what messages call its rows: "line 3" or "row 3", (n_lines,)
    is_missing: np.ndarray  # which cells are empty, (n_lines,)
    # (n_lines,), NaN where missing or wrong; None: nothing of numbers can be made of
    # it, or they are always the same
    values: np.ndarray | None = None
    is_numeric: bool = False  # whether most of its cells are numbers
    # how dates are written, in the signs of strptime, where it is not as in ISO 8601;
    # "" where it is, or where the cells do not tell
    date_format: str = ""
    other_format: str = ""  # which the dates fit as well
    # what was seen, in words: its range, missing cells, why it is left out
    said: str = ""
    # the first cell that cannot be used, with its line; "" where none is
    wrong: str = ""
    part: str = UNUSED  # `TIME`, `RUN`, `STATE`, `INPUT` or `UNUSED`
    name: str = ""  # what it could be called in formulas; "" where it is in none
    # columns of the time of day and of milliseconds, beside one of dates
    further: tuple[str, ...] = ()
    # "zero" where it is constant between jumps, as an input that is held; else ""
    hold: str = ""

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
        """Its header with its unit."""
        title = " ".join(self.column.split())
        is_told = not self.unit or self.unit in title
        return title if is_told else f"{title} [{self.unit}]"

    @property
    def is_counter(self) -> bool:
        """Whether it counts the lines, and says so."""
        is_named = self.label == "#" or self.has_one_of(COUNTER_WORDS)
        return is_named and self.rises_by_one

    @property
    def rises_by_one(self) -> bool:
        """Whether each cell is one more than the cell above it."""
        return self.values is not None and bool(np.all(np.diff(self.values) == 1))

    @property
    def content(self) -> dict[str, Any]:
        """What JSON has of it."""
        names = ("column", "part", "name", "unit", "hold", "said", "wrong")
        return {name: getattr(self, name) for name in names}

    @property
    def may_be_input(self) -> bool:
        """Whether it is a state, or an input."""
        return self.said.endswith(PERHAPS_INPUT)

    def take_dates_of(self, cells: pd.Series) -> None:
        """Say how texts are dates: of what fits, where they lie closest together."""
        found = []
        for form in DATE_FORMATS:
            if _share_of_dates(cells[:50], form) > MOSTLY:
                dates = _dates(cells, form)
                share = float(dates.notna().mean())
                found.append((-share, dates.max() - dates.min(), form))
        found.sort()
        best = [form for share, _, form in found if share == found[0][0] < -MOSTLY]
        self.date_format, self.other_format = (*best, "", "")[:2]

    def becomes(self, part: str, remark: str = "") -> None:
        """Take a part, and say why."""
        self.part = part
        self.said = _joined(self.said, remark)

    @property
    def is_dates(self) -> bool:
        """Whether most of its cells are dates."""
        return self.said == DATES

    @property
    def n_missing(self) -> int:
        """How many cells are empty."""
        return int(self.is_missing.sum())

    @property
    def first_missing(self) -> str:
        """The line of the first cell that is empty."""
        return self.lines[int(np.argmax(self.is_missing))]

    @property
    def only_number(self) -> float | None:
        """The only number of the column, where it is above zero."""
        numbers = pd.to_numeric(self.cells, errors="coerce").dropna().unique()
        is_one = len(numbers) == 1 and 0 < numbers[0] < np.inf
        return float(numbers[0]) if is_one else None

    @property
    def may_be_time(self) -> bool:
        """Whether nothing speaks against a time, if the column increases."""
        if self.values is None or self.unit not in ("", *TIMES):
            return self.is_dates
        return not self.rises_by_one

    def rows_of(self, run: "Column | None") -> list[np.ndarray]:
        """The rows of each run."""
        if run is None:
            return [np.arange(len(self.lines))]
        return list(rows_of_runs(run.cells).values())

    def neighbours(self, run: "Column | None") -> np.ndarray:
        """The rows of each sample and of the next one of its run, (n_pairs, 2)."""
        runs = self.rows_of(run)
        return np.vstack([np.column_stack([rows[:-1], rows[1:]]) for rows in runs])

    def is_held(self, run: "Column | None") -> bool:
        """Whether it is constant between jumps, in its runs; gaps tell nothing."""
        if self.values is None or self.n_missing or self.wrong:
            return False
        return is_stepped([self.values[rows] for rows in self.rows_of(run)])

    def wrong_time(self, run: "Column | None") -> str:
        """The first time that is missing, wrong or not after the one before it."""
        assert self.values is not None
        if self.wrong:
            return self.wrong
        if self.n_missing:
            return f"{self.first_missing} has no time"
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
    headers = list(map(str, table.frame.columns))
    lines = list(map(table.row, range(len(table.frame))))
    columns = []
    for number, header in enumerate(headers):
        cells = table.frame.iloc[:, number].map(
            lambda cell: "" if cell is None else str(cell)
        )
        cells = cells.str.strip()
        cells = cells.map(lambda cell: plain_number(cell, table.decimal))
        is_missing = cells.str.lower().isin(MISSING_CELLS).to_numpy()
        words = vars(Header.of(header))
        words["unit"] = table.units.get(header) or words["unit"]
        column = Column(**words, cells=cells, lines=lines, is_missing=is_missing)
        column.said = _look_at(column, headers.count(header))
        columns.append(column)
    return columns


def _look_at(column: Column, n_of_this_name: int) -> str:
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
    column.is_numeric = bool(is_number.sum() > MOSTLY * filled.sum())
    if not column.is_numeric:
        return _look_at_texts(column)
    values = np.where(is_number, numbers, np.nan)
    column.wrong = _wrong_cells(column, np.flatnonzero(~is_number & filled))
    column.date_format = "" if column.wrong else _format_of_numbers(column, values)
    if column.date_format:
        return DATES
    low, high = np.nanmin(values), np.nanmax(values)
    if low == high and not column.wrong:
        return f"always {low:g}"
    column.values = values
    missing = f", {number_of(column.n_missing, 'cell')} missing"
    return f"{low:.4g} to {high:.4g}{missing if column.n_missing else ''}"


def _format_of_numbers(column: Column, values: np.ndarray) -> str:
    """How numbers are dates; days are, where the header says so."""
    clock = clock_of(values) if column.is_time and not column.unit else ""
    if clock == "excel" and not _any_of(_words(column.label), DATE_WORDS):
        clock = ""
    return format_of_dates(values) or clock


def _wrong_cells(column: Column, places: np.ndarray) -> str:
    """The first cell that is no finite number, and how many more there are."""
    if not places.size:
        return ""
    first = int(places[0])
    cell = _shown(column.cells.iloc[first])
    said = f"{column.lines[first]} contains {cell}, which is not a finite number"
    return _and_more(said, places.size, "more such cell")


def _and_more(said: str, n: int, noun: str) -> str:
    return said if n == 1 else f"{said}; {number_of(n - 1, noun)}"


def _joined(*parts: str) -> str:
    return "; ".join(filter(None, parts))


def _shown(cell: str) -> str:
    """A cell in quotes, cut where it is long."""
    return f'"{shortened(" ".join(cell.split()), 20)}"'


def _look_at_texts(column: Column) -> str:
    """What is in a column of dates, or of texts, which are left out."""
    cells = column.cells[~column.is_missing]
    column.take_dates_of(cells)
    some = cells[:50]  # more would tell nothing else
    if column.date_format or _share_of_dates(some, "mixed") > MOSTLY:
        return DATES
    different = some.unique()
    more = ", ..." if len(different) > 3 else ""
    return f"text: {', '.join(map(_shown, different[:3]))}{more}"


def _share_of_dates(cells: pd.Series, form: str) -> float:
    try:
        return float(_dates(cells, form).notna().mean())
    except (ValueError, TypeError):
        return 0.0


def _dates(cells: pd.Series, form: str) -> pd.Series:
    return pd.to_datetime(cells, errors="coerce", format=form)

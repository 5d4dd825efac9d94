"""The times of a table: numbers, dates, times of day, or even steps, as numbers.

Dates become seconds, exact to the microsecond. A moment with an offset ("Z" or
"+01:00") is taken as such; names of time zones are not read, and nothing is guessed: a
column that is partly without offset, a day and month in an unknown order and a clock
that was set back are refused with their row. A clock that goes back to its first time
begins a new run.

Date, time of day and milliseconds may stand in columns of their own, and a date may be
a number of days or seconds since another one.

A date may be written as one number, such as 20210131. As numbers the differences of
these are no times: from the 31st to the next day it is 70. Numbers of 8, 10, 12 or 14
digits are taken for dates where each of them has a year, month, day, hour, minute and
second that there can be. Seconds since 1970, and parts of seconds, have other lengths
or begin with no such year.
"""

import datetime as dt
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from phsi_opt.data.checks import LARGEST_EXACT, from_first
from phsi_opt.data.table_extent import NUMBER
from phsi_opt.data.tables import (
    DECIMAL_COMMA,
    Table,
    holds_real_numbers,
    is_missing,
    numbers_in,
    plain_number,
)
from phsi_opt.errors import DataError, shown, some_of

SECOND = dt.timedelta(seconds=1)
UNIX = dt.datetime(1970, 1, 1)
# Numbers that are dates, by the name of their format: when they count from, in what.
CLOCKS = {
    "excel": (dt.datetime(1899, 12, 30), dt.timedelta(days=1)),
    "unix": (UNIX, SECOND),
    "unix ms": (UNIX, SECOND / 1000),
    "unix us": (UNIX, SECOND / 1_000_000),
}
MILLISECONDS = re.compile(r"(?i)\b(ms|msec|millis\w*)\b")
TIME_OF_DAY = re.compile(r"(\d+):([0-5]\d):([0-5]\d(?:[.,]\d+)?)")
NUMBERS = (NUMBER, DECIMAL_COMMA, re.compile(r"[+-]?inf(inity)?", re.IGNORECASE))
# The signs of strptime, with the numbers that each may stand for.
DATE_PARTS = (
    ("%Y", 1900, 2100),
    ("%m", 1, 12),
    ("%d", 1, 31),
    ("%H", 0, 23),
    ("%M", 0, 59),
    ("%S", 0, 59),
)
WHOLE_NUMBER = re.compile(r"(\d+)(\.0*)?")

Moment = dt.datetime | dt.timedelta  # of a calendar, or since midnight


def times_in(
    table: Table,
    column: Any,
    runs: Sequence[np.ndarray],
    start: Any = None,
    date_format: str | None = None,
) -> tuple[np.ndarray, list[Moment]]:
    """The times in a column, in seconds where they are moments.

    Also the moments at which t is 0 in each trajectory: ``start``, or the first sample;
    none where the times are numbers. ``date_format`` is in the signs of strptime, or
    one of `CLOCKS`; None: ISO 8601; "": these are numbers.
    """
    further = dt.timedelta(0)
    if isinstance(column, list | tuple):
        table, column, further = _joined(table, column)
    cells = table.frame[column]
    if _are_moments(cells, date_format):
        moments = (np.array(_moments(table, column, date_format)) + further).tolist()
        begin = None if start is None else _start(start, date_format, moments[0])
        t = np.empty(len(moments))
        origins = []
        for rows in runs:
            origin: Any = moments[rows[0]] if begin is None else begin
            t[rows] = [(moments[i] - origin) / SECOND for i in rows]
            origins.append(origin)
        _check_increasing(table, column, t, moments, runs)
        return t, origins
    if start is not None:
        raise DataError(
            f"start={shown(start)} needs dates, but the column {column!r} of "
            f"{table.title} contains numbers; omit start."
        )
    t = numbers_in(table, column, may_be_missing=False)
    form = format_of_dates(t)
    if form and date_format is None:
        first = cells.iloc[0]
        moment = _date_in(first, form) or "a date"  # of a 31st of February
        raise DataError(
            f"{table.place(column, 0)} {first} looks like {moment} written as one "
            "number, and so do all others; expected times as numbers of one unit, or "
            f'dates. Set date_format = "{form}" if they are dates, and date_format = '
            '"" if they are numbers.'
        )
    if np.max(np.abs(t), initial=0.0) > LARGEST_EXACT:
        with suppress(ValueError, OverflowError):  # not whole, or beyond all bounds
            t = np.asarray(from_first([int(str(cell)) for cell in cells]), float)
    _check_increasing(table, column, t, t.tolist(), runs)
    return t, []


def runs_of_clock(t: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
    """The rows of a run, divided where its clock goes back to its first time.

    It may miss that by less than half of its typical step, the median.
    """
    steps = np.diff(t[rows])
    step = np.median(steps[steps > 0]) if np.any(steps > 0) else 0.0
    is_near = np.abs(t[rows[1:]] - t[rows[:1]]) < step / 2
    return np.split(rows, np.flatnonzero((steps < 0) & is_near) + 1)


def names_of_parts(run: str, n: int) -> list[str]:
    """The names of the n parts of a run that `runs_of_clock` divides."""
    return [run] if n == 1 else [f"{run}/{k}" for k in range(1, n + 1)]


def begun_anew(rows: Sequence[str]) -> str:
    """The remark about a clock that begins anew in rows; "" for none."""
    said = f"the clock begins anew in {some_of(rows)}: {len(rows) + 1} runs"
    return said if rows else ""


def rounded_step(t: np.ndarray) -> str:
    """The step of times that were rounded until some are equal; "" of other times.

    They never fall, and stay within their largest step of an even clock (the line
    through them), over ten of these steps at least.
    """
    steps = np.diff(t)
    if not np.any(steps == 0) or not np.ptp(t) > 10 * np.max(steps):  # or NaN
        return ""
    line = np.polyfit(np.arange(len(t)), t, 1)
    away = np.max(np.abs(t - np.polyval(line, np.arange(len(t)))))
    is_even = np.min(steps) == 0 and away <= np.max(steps)
    return f"{line[0]:.4g}" if is_even else ""


def clock_of(values: np.ndarray) -> str:
    """The clock by which numbers are dates from 2000 to 2050; "": none."""
    for name, (origin, unit) in CLOCKS.items():
        first = (dt.datetime(2000, 1, 1) - origin) / unit
        last = (dt.datetime(2050, 1, 1) - origin) / unit
        if values.size and np.all((values > first) & (values < last)):
            return name
    return ""


def is_milliseconds(column: Any) -> bool:
    """Whether a header says that a column has milliseconds."""
    return MILLISECONDS.search(str(column).replace("_", " ")) is not None


def _joined(table: Table, columns: Sequence[Any]) -> tuple[Table, Any, Any]:
    """The table with date and time of day as one text, its name, the milliseconds."""
    further: Any = dt.timedelta(0)
    texts: list[Any] = []
    for column in columns:
        if texts and is_milliseconds(column):
            milliseconds = numbers_in(table, column, may_be_missing=False).tolist()
            further = np.array([one * SECOND / 1000 for one in milliseconds])
        else:
            texts.append(table.frame[column].map(_date_text))
    name = " + ".join(map(str, columns))
    joined = texts[0].str.cat(texts[1:], sep=" ") if texts[1:] else texts[0]
    frame = table.frame.assign(**{name: joined})
    return replace(table, frame=frame), name, further


def _date_text(cell: Any) -> str:
    """A date of a spreadsheet without its midnight; else the cell as text."""
    is_day = isinstance(cell, dt.datetime) and cell.time() == dt.time()
    return str(cell.date() if is_day else cell)


def format_of_dates(values: np.ndarray) -> str:
    """How numbers are dates, in the signs of strptime; "" where they are none."""
    known = values[np.isfinite(values)]
    whole = np.floor(known)
    has_decimals = bool(np.any(known != whole))
    fewest = len(DATE_PARTS) if has_decimals else 3  # only seconds have decimals
    for n_parts in range(fewest, len(DATE_PARTS) + 1):
        rest = whole
        fits = known.size > 0
        for sign, low, high in reversed(DATE_PARTS[:n_parts]):
            part = rest if sign == "%Y" else rest % 100
            rest = rest // 100
            fits = fits and bool(np.all((part >= low) & (part <= high)))
        if fits:
            signs = "".join(sign for sign, _, _ in DATE_PARTS[:n_parts])
            return f"{signs}.%f" if has_decimals else signs
    return ""


def _are_moments(cells: Any, date_format: str | None) -> bool:
    """Whether times are dates or times of day, as the first filled cell tells."""
    if date_format is not None:
        return date_format != ""
    if holds_real_numbers(cells):
        return False
    first = next((cell for cell in cells if not is_missing(cell)), None)
    if not isinstance(first, str):
        return isinstance(first, dt.datetime | dt.time | dt.timedelta)
    return not any(form.fullmatch(first.strip()) for form in NUMBERS)


def _moments(table: Table, column: Any, date_format: str | None) -> list[Moment]:
    moments: list[Moment] = []
    for i, cell in enumerate(table.frame[column]):
        place = table.place(column, i)
        if date_format in CLOCKS and isinstance(cell, str):
            cell = plain_number(cell, table.decimal)
        moment = _moment(cell, date_format)
        if moment is None:
            raise DataError(f"{place} {_refused(cell, date_format)}")
        moments.append(moment)
        if _kind(moment) != _kind(moments[0]):
            raise DataError(
                f"{place} {shown(cell)} is {_kind(moment)}, and the first cell of the "
                f"column is {_kind(moments[0])}; expected the same kind in all cells."
            )
    return moments


def _moment(cell: Any, date_format: str | None) -> Moment | None:
    """What a cell says; None where it is no moment."""
    if is_missing(cell):  # NaT is a datetime
        return None
    if isinstance(cell, dt.datetime | dt.timedelta):
        return cell
    if isinstance(cell, dt.time) and cell.tzinfo is None:
        return dt.datetime.combine(dt.date.min, cell) - dt.datetime.min
    if date_format is not None:
        return _date_in(cell, date_format)
    if not isinstance(cell, str):
        return None
    clock = TIME_OF_DAY.fullmatch(cell.strip())
    with suppress(ValueError, OverflowError):
        if clock is not None:
            hours, minutes, seconds = clock.groups()
            whole = dt.timedelta(hours=int(hours), minutes=int(minutes))
            return whole + float(seconds.replace(",", ".")) * SECOND
        return dt.datetime.fromisoformat(cell.strip())
    return None


def _date_in(cell: Any, form: str) -> dt.datetime | None:
    """The date that a text or a number is; None where it is none of this form.

    Spreadsheets write 20210131 as 20210131.0.
    """
    text = str(cell).strip()
    if form in CLOCKS:
        origin, unit = CLOCKS[form]
        with suppress(ValueError, OverflowError):
            return origin + float(text) * unit
    whole = WHOLE_NUMBER.fullmatch(text)
    if whole is not None:
        text = f"{whole[1]}.0" if form.endswith("%f") else whole[1]
    with suppress(ValueError):
        return dt.datetime.strptime(text, form)
    return None


def _refused(cell: Any, date_format: str | None) -> str:
    if is_missing(cell):
        return (
            "the time is missing; times must be known at every sample. Drop the sample."
        )
    if date_format is not None:
        return (
            f"{shown(cell)} does not match date_format={date_format!r}. Correct the "
            "cell or the format."
        )
    return (
        f"{shown(cell)} is neither a number nor a date; write dates like '2021-11-22 "
        "09:15:00' or '2021-11-22 09:15:00+01:00' (names of time zones are not "
        'supported). For other dates set date_format: "%d.%m.%Y %H:%M:%S", or with the '
        'month first "%m/%d/%Y %H:%M:%S".'
    )


def _kind(moment: Moment) -> str:
    if isinstance(moment, dt.timedelta):
        return "a time of day"
    return f"a date with{'out' if moment.tzinfo is None else ''} time zone"


def _start(start: Any, date_format: str | None, first: Moment) -> Moment:
    moment = _moment(start, date_format) or _moment(start, None)
    if moment is None or _kind(moment) != _kind(first):
        raise DataError(
            f"start={shown(start)} is not {_kind(first)} like the times; expected a "
            f"form such as {str(first)!r}."
        )
    return moment


def _check_increasing(
    table: Table,
    column: Any,
    t: np.ndarray,
    told: Sequence[Any],
    runs: Sequence[np.ndarray],
) -> None:
    """Refuse a time of a run that is not after the one before it."""
    for own in runs:
        for part in runs_of_clock(t, own):
            for i in np.flatnonzero(np.diff(t[part]) <= 0)[:1]:
                before, after = part[i : i + 2].tolist()
                row = table.row(before)
                said = f"time goes back from {told[before]} in {row} to {told[after]}"
                if t[before] == t[after]:
                    said = f"{told[after]} repeats the time of {row}"
                raise DataError(
                    f"{table.place(column, after)} {said}; times must increase. "
                    f"{_advice(table, t[own], before, after)}"
                )


def _advice(table: Table, t: np.ndarray, before: int, after: int) -> str:
    advice = (
        "If the table contains several runs, name the column of the run (trajectory), "
        "or cut the file where a run begins; otherwise correct the times (a clock set "
        "back in autumn repeats an hour)."
    )
    n_equal = int(np.sum(np.diff(t) == 0))
    if n_equal and table.frame.iloc[before].equals(table.frame.iloc[after]):
        return "The rows are the same: remove one of them."
    step = rounded_step(t)
    if step:
        advice = (
            f"{n_equal} of {len(t)} rows repeat a time, as rounded times do: if the "
            "samples are even, give their step in place of the column: "
            f"step={step}, in a study file time = {{ step = {step} }}. {advice}"
        )
    return advice

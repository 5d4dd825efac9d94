"""The times of a table: numbers, dates, times of day, or even steps, as numbers.

Dates become seconds, exact to the microsecond. A moment with an offset ("Z" or
"+01:00") is taken as such; names of time zones are not read, and nothing is guessed: a
column that is partly without offset, a day and month in an unknown order and a clock
that was set back are refused with their row.
"""

import datetime as dt
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from phsi_opt.data.checks import LARGEST_EXACT, from_first
from phsi_opt.data.dates_as_numbers import format_of_dates, moment_in
from phsi_opt.data.tables import Table, holds_real_numbers, numbers_in
from phsi_opt.data.text_cells import DECIMAL_COMMA, MISSING_CELLS, NUMBER
from phsi_opt.errors import DataError

SECOND = dt.timedelta(seconds=1)
TIME_OF_DAY = re.compile(r"(\d+):([0-5]\d):([0-5]\d(?:[.,]\d+)?)")
NAMED_ZONE = re.compile(r".*\d ?[A-Z][A-Za-z/_]{2,}")
EXAMPLE = "'2021-11-22 09:15:00'"

Moment = dt.datetime | dt.timedelta  # of a calendar, or since midnight


@dataclass(frozen=True)
class Times:
    """Where the times of a table come from.

    Attributes:
        column: The column that holds them; None: they are counted.
        step: The time between neighbouring rows, where they are counted.
        start: The moment at which t is 0, where they are dates; None: the first sample
            of each trajectory.
        date_format: How dates are written, in the signs of strptime; None: as ISO 8601;
            "": the times are numbers, even where these look like dates.

    Raises:
        DataError: These do not go together.
    """

    column: Any
    step: float | None = None
    start: Any = None
    date_format: str | None = None

    def __post_init__(self) -> None:
        if (self.column is None) == (self.step is None):
            raise DataError(
                f"time={self.column!r} and step={self.step!r}; expected one of them: "
                "the column of the times, or the time between neighbouring rows."
            )
        if self.step is not None:
            _check_step(self.step)
            if self.start is not None or self.date_format is not None:
                raise DataError(
                    "start and date_format are for dates in a column; "
                    "with step=... leave them out."
                )


def _check_step(step: Any) -> None:
    is_number = isinstance(step, int | float | np.number)
    if isinstance(step, bool) or not is_number or not 0 < step < np.inf:
        raise DataError(
            f"step={step!r} is no time between rows; expected a positive number."
        )


def times_in(table: Table, times: Times, runs: Iterable[np.ndarray]) -> np.ndarray:
    """The times of all rows, (n_rows,).

    Args:
        table: As it was read.
        times: Where its times come from.
        runs: The row numbers of each trajectory, (n_samples,).

    Raises:
        DataError: A cell is no time, or not after the one before it in its trajectory.
    """
    if times.step is not None:
        counted = np.empty(len(table.frame))
        for rows in runs:
            counted[rows] = times.step * np.arange(len(rows))
        return counted
    if are_dates(table, times):
        return _seconds(table, times, runs)
    if times.start is not None:
        raise DataError(
            f"start={times.start!r} is for dates, and the column {times.column!r} of "
            f"{table.title} holds numbers; leave start out."
        )
    t = _from_first(table, times.column)
    if times.date_format is None:
        _check_no_dates(table, times.column, t)
    for rows in runs:
        _check_increasing(table, times.column, t, rows)
    return t


def origin_in(table: Table, times: Times, rows: np.ndarray) -> dt.datetime | None:
    """The moment at which t is 0 in a trajectory; None where times are no dates.

    Args:
        table: As it was read, its times checked by `times_in`.
        times: Where its times come from.
        rows: The row numbers of the trajectory, (n_samples,).

    Raises:
        DataError: The first time is no date, or ``start`` is of another kind.
    """
    if times.step is not None or not are_dates(table, times):
        return None
    place = int(rows[0])
    first = _moment_at(table, times, table.frame[times.column].iloc[place], place)
    origin = _start(times, first) or first
    return origin if isinstance(origin, dt.datetime) else None


def _check_no_dates(table: Table, column: Any, t: np.ndarray) -> None:
    """Refuse numbers such as 20210131: their differences are no times."""
    form = format_of_dates(t)
    if not form:
        return
    first = table.frame[column].iloc[0]
    moment = moment_in(first, form) or "a date"  # of a 31st of February
    raise DataError(
        f"{table.place(column, 0)} {first} looks like {moment} "
        "written as one number, and so do all others; expected times as numbers of one "
        f'unit, or dates. Say date_format = "{form}" where they are dates, and '
        'date_format = "" where they are numbers.'
    )


def _from_first(table: Table, column: Any) -> np.ndarray:
    """Times that are numbers, (n_rows,); see `checks.from_first`."""
    t = numbers_in(table, column, may_be_missing=False)
    if np.max(np.abs(t), initial=0.0) <= LARGEST_EXACT:
        return t
    try:
        whole = np.array([int(str(cell)) for cell in table.frame[column]])
    except (ValueError, OverflowError):  # not whole, or beyond all bounds
        return t
    return np.asarray(from_first(whole), dtype=float)


def are_dates(table: Table, times: Times) -> bool:
    """Whether the times are dates or times of day, as the first filled cell tells.

    Raises:
        DataError: It is neither a number nor a moment.
    """
    if times.column is None:
        return False
    if times.date_format is not None:
        return times.date_format != ""
    cells = table.frame[times.column]
    if holds_real_numbers(cells):
        return False
    for i, cell in enumerate(cells):
        if _is_missing(cell):
            continue
        if not isinstance(cell, str):
            return isinstance(cell, dt.datetime | dt.time | dt.timedelta)
        if _is_number(cell):
            return False
        _moment_at(table, times, cell, i)
        return True
    return False


def _is_number(cell: str) -> bool:
    stripped = cell.strip()
    is_number = NUMBER.fullmatch(stripped) or DECIMAL_COMMA.fullmatch(stripped)
    return is_number is not None or stripped.lstrip("+-").lower() in ("inf", "infinity")


def _is_missing(cell: Any) -> bool:
    import pandas as pd

    if isinstance(cell, str):
        return cell.strip().lower() in MISSING_CELLS
    return cell is None or bool(pd.isna(cell))


def _seconds(table: Table, times: Times, runs: Iterable[np.ndarray]) -> np.ndarray:
    """The times (n_rows,) in seconds, from moments."""
    moments: list[Moment] = []
    for i, cell in enumerate(table.frame[times.column]):
        moment = _moment_at(table, times, cell, i)
        if moments and _kind(moment) != _kind(moments[0]):
            raise DataError(
                f"{table.place(times.column, i)} {cell!r} is {_kind(moment)}, and the "
                f"first of the column is {_kind(moments[0])}; expected one kind. "
                "Write all in one way."
            )
        moments.append(moment)
    start = _start(times, moments[0])
    t = np.empty(len(moments))
    for rows in runs:
        origin: Any = moments[rows[0]] if start is None else start
        t[rows] = [(moments[i] - origin) / SECOND for i in rows]
        _check_increasing(table, times.column, t, rows, _as_moments(moments))
    return t


def _as_moments(moments: list[Moment]) -> Callable[[int], str]:
    return lambda i: str(moments[i])


def _moment_at(table: Table, times: Times, cell: Any, i: int) -> Moment:
    if _is_missing(cell):
        raise DataError(
            f"{table.place(times.column, i)} the time is missing; "
            "times must be known at every sample. Drop the sample."
        )
    moment = _moment(cell, times.date_format)
    if moment is None:
        raise DataError(f"{table.place(times.column, i)} {_refused(cell, times)}")
    return moment


def _moment(cell: Any, date_format: str | None) -> Moment | None:
    """What a cell says; None where it is no moment."""
    if isinstance(cell, dt.datetime | dt.timedelta):
        return cell
    if isinstance(cell, dt.time) and cell.tzinfo is None:
        return dt.datetime.combine(dt.date.min, cell) - dt.datetime.min
    if date_format is not None:
        return moment_in(cell, date_format)
    if not isinstance(cell, str):
        return None
    text = cell.strip()
    clock = TIME_OF_DAY.fullmatch(text)
    if clock is not None:
        hours, minutes, seconds = clock.groups()
        whole = dt.timedelta(hours=int(hours), minutes=int(minutes))
        return whole + float(seconds.replace(",", ".")) * SECOND
    try:
        return dt.datetime.fromisoformat(text)
    except ValueError:
        return None


def _refused(cell: Any, times: Times) -> str:
    if times.date_format is not None:
        return (
            f"{cell!r} is no moment as date_format={times.date_format!r} says. "
            "Correct the cell or the format."
        )
    if isinstance(cell, str) and NAMED_ZONE.fullmatch(cell.strip()):
        return (
            f"{cell!r} has the name of a time zone, which is not read; expected an "
            f"offset from UTC, such as {EXAMPLE[:-1]}+01:00', or none in all rows."
        )
    return (
        f"{cell!r} is neither a number nor a date; expected such as {EXAMPLE}. "
        'Dates in another order: say date_format = "%d.%m.%Y %H:%M:%S".'
    )


def _kind(moment: Moment) -> str:
    if isinstance(moment, dt.timedelta):
        return "a time of day"
    if moment.tzinfo is None:
        return "a date without time zone"
    return "a date with time zone"


def _start(times: Times, first: Moment) -> Moment | None:
    if times.start is None:
        return None
    start = _moment(times.start, times.date_format)
    if start is None and times.date_format is not None:
        start = _moment(times.start, None)
    if start is None or _kind(start) != _kind(first):
        raise DataError(
            f"start={times.start!r} is not {_kind(first)}, as the times are; "
            f"expected such as {str(first)!r}."
        )
    return start


def _check_increasing(
    table: Table,
    column: Any,
    t: np.ndarray,
    rows: np.ndarray,
    written: Callable[[int], str] | None = None,
) -> None:
    """Refuse a time of a trajectory's rows that is not after the one before it."""
    is_late = np.diff(t[rows]) <= 0
    if not is_late.any():
        return
    number = int(np.argmax(is_late))
    before = int(rows[number])
    after = int(rows[number + 1])
    said = written or (lambda i: str(float(t[i])))
    clock = " (a clock set back in autumn repeats an hour)" if written else ""
    raise DataError(
        f"{table.place(column, after)} {said(after)} is not after {said(before)} of "
        f"{table.row(before)}; times must increase strictly{clock}. "
        "Sort the samples or drop the duplicate; where runs follow each other, name "
        "the column that tells them apart (trajectory)."
    )

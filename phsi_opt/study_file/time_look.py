"""A look at the times of a table: which column has them, and what is wrong there."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from phsi_opt.data.text_cells import NUMBER
from phsi_opt.data.wording import number_of
from phsi_opt.study_file.column_look import Seen
from phsi_opt.study_file.headers import TIMES, is_step_word, is_time_word

EVEN_STEPS = 0.01  # share of the median step by which steps of a regular record differ
# From 2000 to 2050 as clocks count it: the unit, with its first and last number.
CLOCKS = {
    "days, as spreadsheets count them": ("d", 36526, 54789),
    "seconds since 1970": ("s", 946684800, 2524608000),
    "milliseconds since 1970": ("ms", 946684800e3, 2524608000e3),
    "microseconds since 1970": ("us", 946684800e6, 2524608000e6),
}
GAP_STEPS = 1.5  # median steps from which a step is a gap


@dataclass(frozen=True)
class Span:
    """From the first time to the last."""

    begin: float
    end: float


def named_time_column(columns: list[Seen], run: Seen | None) -> Seen | None:
    """The column that is called the time.

    A column that is called so and has a wrong or late time is still the one: a guess
    at another one would hide the mistake.
    """
    named = [one for one in columns if is_time_word(one.header)]
    for one in named:
        if one.is_dates or (_is_numeric(one) and not wrong_time(one, run)):
            return one
    for one in named:
        if _is_numeric(one):
            one.wrong = wrong_time(one, run)
            return one
    return None


def increasing_column(columns: list[Seen], run: Seen | None) -> Seen | None:
    """The first column that could be the time, whatever it is called."""
    for one in columns:
        if one.is_dates or (_may_be_time(one) and not wrong_time(one, run)):
            return one
    return None


def _is_numeric(one: Seen) -> bool:
    return one.values is not None and not one.is_left_out


def _may_be_time(one: Seen) -> bool:
    """Whether nothing speaks against a time, if the column increases."""
    has_other_unit = one.header.unit not in ("", *TIMES)
    return _is_numeric(one) and not has_other_unit and not one.is_counter


def wrong_time(one: Seen, run: Seen | None) -> str:
    """The first time that is missing, wrong or not after the one before it; else ""."""
    assert one.values is not None
    if one.wrong:
        return one.wrong
    is_missing = np.isnan(one.values)
    if is_missing.any():
        return f"{one.lines[int(np.argmax(is_missing))]} has no time"
    late = []
    for rows in _rows_of_runs(one, run):
        is_late = np.diff(one.values[rows]) <= 0
        late += [(int(rows[i]), int(rows[i + 1])) for i in np.flatnonzero(is_late)]
    if not late:
        return ""
    before, after = late[0]
    said = (
        f"{one.lines[after]} has {one.values[after]:.6g}, not after "
        f"{one.values[before]:.6g} of {one.lines[before]}"
    )
    return (
        said
        if len(late) == 1
        else f"{said}; {number_of(len(late) - 1, 'more such line')}"
    )


def _rows_of_runs(one: Seen, run: Seen | None) -> list[np.ndarray]:
    """The row numbers of each run."""
    if run is None:
        return [np.arange(len(one.cells))]
    numbers, _ = pd.factorize(run.cells)
    return [np.flatnonzero(numbers == n) for n in range(numbers.max() + 1)]


def step_column(columns: list[Seen]) -> Seen | None:
    """The column of a single value that is called the time between samples."""
    for one in columns:
        if is_step_word(one.header.words) and step_in(one) is not None:
            return one
    return None


def step_in(one: Seen) -> float | None:
    """The only number of a column, where it is above zero."""
    numbers = pd.to_numeric(one.cells, errors="coerce").dropna().unique()
    is_one = len(numbers) == 1 and 0 < numbers[0] < np.inf
    return float(numbers[0]) if is_one else None


def said_of_times(time: Seen | None, run: Seen | None) -> str:
    """Where the times begin and end, and how regular they are."""
    if time is None:
        return "no column increases from line to line: which one is the time?"
    if time.values is None:
        first = time.cells.iloc[0]
        is_number = NUMBER.fullmatch(first) is not None
        what = f"numbers such as {first} look like" if is_number else "the times are"
        return f"{what} dates"
    if time.wrong:
        return time.said
    all_steps = []
    for rows in _rows_of_runs(time, run):
        all_steps.append(np.diff(time.values[rows]))
    steps = np.concatenate(all_steps)
    typical = float(np.median(steps))
    n_gaps = int(np.sum(steps > GAP_STEPS * typical))
    said = f"{time.values.min():g} to {time.values.max():g}, every {typical:.4g}"
    if np.ptp(steps) <= EVEN_STEPS * typical:
        return f"{said}, regular"
    if n_gaps:
        gaps = "1 gap of" if n_gaps == 1 else f"{n_gaps} gaps, the longest"
        return f"{said}, {gaps} {steps.max():.4g}"
    return f"{said}, from {steps.min():.4g} to {steps.max():.4g}"


def unit_asked(span: Span | None) -> str:
    """A question for the unit of times that tell none, with what they look like."""
    for what, (unit, first, last) in CLOCKS.items():
        if span is not None and first <= span.begin < span.end <= last:
            return f'are they {what}? add unit = "{unit}", or the right one'
    return 'in seconds? add unit = "s"'


def span_of(time: Seen | None, step: float | None, n_lines: int) -> Span | None:
    """The first and the last time; None where these are dates, wrong or unknown."""
    if step is not None:
        return Span(0.0, step * (n_lines - 1))
    if time is None or time.values is None or time.wrong:
        return None
    return Span(float(time.values.min()), float(time.values.max()))

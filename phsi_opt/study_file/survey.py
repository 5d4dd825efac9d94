"""A look at a table nobody has described yet: which column is what, and its unit.

Guesses from headers and values, for a first study file that a person corrects. Nothing
is decided by them. The reader of ``phsi_opt.data`` reads the table, so that what is
seen here can be read later.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd

from phsi_opt.data.checks import checked_names
from phsi_opt.data.text_cells import MISSING_CELLS
from phsi_opt.errors import DataError, ModelError
from phsi_opt.model.checks import checked_names as usable_in_formulas
from phsi_opt.study_file.file_tables import whole_table
from phsi_opt.study_file.headers import (
    TIMES,
    Header,
    header_of,
    is_input_word,
    is_run_word,
    is_step_word,
    is_time_word,
    name_from,
)

TIME = "time"
RUN = "run"
STATE = "state"
INPUT = "input"
UNUSED = "left out"
MOST_RUNS = 1 / 3  # share of the lines that may be different runs
EVEN_STEPS = 0.01  # share of the median step by which steps of a regular record differ
GAP_STEPS = 1.5  # median steps from which a step is a gap
LOOKED_AT = 50  # cells that tell whether a column holds dates
FEW_BAD = 0.05  # share of the cells up to which text in a column of numbers is a slip
EXAMPLES = 3  # cells of a column of text that are told


@dataclass(frozen=True)
class ColumnSurvey:
    """A column.

    Attributes:
        column: its header.
        part: `TIME`, `RUN`, `STATE`, `INPUT` or `UNUSED`.
        name: what it could be called in formulas.
        unit: as in the header; "" where it does not tell.
        said: what else was seen: its range, missing cells, why it is left out.
    """

    column: str
    part: str
    name: str
    unit: str
    said: str


@dataclass(frozen=True)
class TableSurvey:
    """A table.

    Attributes:
        path: of the file.
        columns: in the order of the table.
        n_lines: below the header.
        said: about the times: where they begin and end, how regular they are.
        step: the time between samples, where a column tells it and none the time.
    """

    path: Path
    columns: tuple[ColumnSurvey, ...]
    n_lines: int
    said: str
    step: float | None = None

    def of_part(self, part: str) -> list[ColumnSurvey]:
        """The columns that are one thing."""
        return [column for column in self.columns if column.part == part]


@dataclass(eq=False)
class _Seen:
    """The cells of a column, as numbers where they are such."""

    header: Header
    cells: pd.Series
    values: np.ndarray | None = None  # (n_lines,), NaN where missing; None: no numbers
    n_missing: int = 0
    part: str = STATE
    said: str = ""
    used_names: set[str] = field(default_factory=set)

    @property
    def is_increasing(self) -> bool:
        return (
            self.values is not None
            and self.n_missing == 0
            and bool(np.all(np.diff(self.values) > 0))
        )


def survey(path: Path) -> TableSurvey:
    """Look at a table.

    Raises:
        DataError: it cannot be read as a table with a header line.
    """
    table = whole_table(path)
    frame = table.frame
    if frame.empty:
        raise DataError(f"{path} has no line below its header.")
    if len(frame) == 1:
        raise DataError(
            f"{path} has 1 line below its header; at least 2 are needed, and a study "
            "needs many more."
        )
    headers = [str(column) for column in frame.columns]
    seen = []
    for number, header in enumerate(headers):
        cells = frame.iloc[:, number].map(_as_text)
        if table.decimal == ",":
            cells = cells.str.replace(",", ".", regex=False)
        one = _looked_at(header, cells, headers)
        seen.append(one)
    run = _mark_run(seen)
    time = _mark_time(seen, run)
    step = None if time is not None else _step(seen)
    _mark_inputs(seen)
    columns = _named(seen)
    return TableSurvey(path, columns, len(frame), _said_of_times(time, run), step)


# ---- columns -------------------------------------------------------------------------


def _looked_at(header: str, cells: pd.Series, headers: list[str]) -> _Seen:
    one = _Seen(header_of(header), cells.str.strip())
    missing = one.cells.str.lower().isin(MISSING_CELLS).to_numpy()
    one.n_missing = int(missing.sum())
    numbers = pd.to_numeric(one.cells.where(~missing), errors="coerce").to_numpy(float)
    is_bad = ~np.isfinite(numbers) & ~missing
    if missing.all():
        return _left_out(one, "empty")
    if headers.count(header) > 1:
        return _left_out(one, f"{headers.count(header)} columns are called so")
    if not header:
        return _left_out(one, "no name in the header")
    if np.sum(is_bad) > FEW_BAD * np.sum(~missing):
        return _left_out(one, _said_of_text(one.cells[~missing]))
    numbers = np.where(is_bad, np.nan, numbers)
    one.values = numbers
    one.n_missing += int(np.sum(is_bad))
    low = np.nanmin(numbers)
    high = np.nanmax(numbers)
    if low == high:
        return _left_out(one, f"always {low:g}")
    one.said = f"{low:.4g} to {high:.4g}"
    if missing.any():
        one.said += f", {np.sum(missing)} cells missing"
    if is_bad.any():
        one.said += f"; {_said_of_bad(one.cells, is_bad)}"
    return one


def _said_of_bad(cells: pd.Series, is_bad: np.ndarray) -> str:
    """The first cell that is no number, with its line, and how many there are."""
    bad = cells[is_bad]
    said = f"line {bad.index[0]} holds {bad.iloc[0]!r}"
    if len(bad) > 1:
        said += f", and {len(bad) - 1} more are no numbers"
    return f"{said}: put them right, or leave such cells empty"


def _as_text(cell: object) -> str:
    return "" if cell is None else str(cell)


def _left_out(one: _Seen, why: str) -> _Seen:
    one.part = UNUSED
    one.said = why
    return one


def _said_of_text(cells: pd.Series) -> str:
    if _are_dates(cells):
        return "dates"
    examples = list(dict.fromkeys(cells[:LOOKED_AT]))
    more = ", ..." if len(examples) > EXAMPLES else ""
    return f"text: {', '.join(examples[:EXAMPLES])}{more}"


def _are_dates(cells: pd.Series) -> bool:
    try:
        parsed = pd.to_datetime(cells[:LOOKED_AT], errors="coerce", format="mixed")
    except (ValueError, TypeError):
        return False
    return bool(parsed.notna().all())


def _mark_run(seen: list[_Seen]) -> _Seen | None:
    """The column that names each line's run."""
    for one in seen:
        n_different = one.cells.nunique()
        is_few = 1 < n_different <= MOST_RUNS * len(one.cells)
        if is_run_word(one.header.words) and is_few and one.n_missing == 0:
            one.part = RUN
            one.said = f"{n_different} runs"
            return one
    return None


def _mark_time(seen: list[_Seen], run: _Seen | None) -> _Seen | None:
    """The column of the times: by its name, else the first one that increases."""
    named = [one for one in seen if is_time_word(one.header)]
    for one in named:
        if one.said == "dates":
            one.part = TIME
            return one
        if _is_time(one, run):
            one.part = TIME
            return one
    for one in seen:
        if one in named:
            continue
        if one.said == "dates" or (_may_be_time(one) and _is_time(one, run)):
            one.part = TIME
            return one
    for one in named:
        if one.part == STATE:
            one.part = TIME
            return one
    return None


def _may_be_time(one: _Seen) -> bool:
    """Whether nothing speaks against a time, if the column increases."""
    has_other_unit = one.header.unit not in ("", *TIMES)
    return one.part == STATE and not has_other_unit and not _is_counter(one)


def _is_time(one: _Seen, run: _Seen | None) -> bool:
    if one.values is None or one.n_missing:
        return False
    if run is None:
        return one.is_increasing
    return bool(np.all(_steps(one.values, run) > 0))


def _is_counter(one: _Seen) -> bool:
    return one.values is not None and bool(np.all(np.diff(one.values) == 1))


def _step(seen: list[_Seen]) -> float | None:
    """The time between samples, where a column of a single value is called so."""
    for one in seen:
        if is_step_word(one.header.words):
            numbers = pd.to_numeric(one.cells, errors="coerce").dropna().unique()
            if len(numbers) == 1 and numbers[0] > 0:
                one.part = UNUSED
                one.said = "the time between samples"
                return float(numbers[0])
    return None


def _mark_inputs(seen: list[_Seen]) -> None:
    for one in seen:
        if one.part == STATE and is_input_word(one.header.words):
            one.part = INPUT
            if one.n_missing:
                one.said += "; an input must be known at every sample"


def _named(seen: list[_Seen]) -> tuple[ColumnSurvey, ...]:
    """The columns with names that formulas can use, each once."""
    used: set[str] = set()
    columns = []
    for one in seen:
        name = ""
        if one.part in (STATE, INPUT):
            name = _free_name(name_from(one.header), used)
            used.add(name)
        header = one.header
        columns.append(ColumnSurvey(header.text, one.part, name, header.unit, one.said))
    return tuple(columns)


def _free_name(wanted: str, used: set[str]) -> str:
    try:
        checked_names([wanted], "states")
        usable_in_formulas([wanted], "states")
    except (DataError, ModelError):
        wanted = f"x_{wanted}" if wanted else "x"
    name = wanted
    number = 2
    while name in used:
        name = f"{wanted}_{number}"
        number += 1
    return name


# ---- times ---------------------------------------------------------------------------


def _said_of_times(time: _Seen | None, run: _Seen | None) -> str:
    if time is None:
        return "no column increases from line to line: which one is the time?"
    if time.values is None:
        return "the times are dates"
    if time.n_missing:
        return f"{time.said}: every line needs a time"
    offender = _not_increasing(time, run)
    if offender:
        return offender
    steps = _steps(time.values, run)
    typical = float(np.median(steps))
    n_gaps = int(np.sum(steps > GAP_STEPS * typical))
    said = f"{time.values.min():g} to {time.values.max():g}, every {typical:.4g}"
    if np.ptp(steps) <= EVEN_STEPS * typical:
        return f"{said}, regular"
    if n_gaps:
        return f"{said}, {n_gaps} gaps, the longest {steps.max():.4g}"
    return f"{said}, from {steps.min():.4g} to {steps.max():.4g}"


def _not_increasing(time: _Seen, run: _Seen | None) -> str:
    """The first line whose time is not after that before it; empty: there is none."""
    for of_run in _of_runs(time.cells, run):
        values = pd.to_numeric(of_run).to_numpy(float)
        late = np.flatnonzero(np.diff(values) <= 0)
        if len(late):
            i = int(late[0]) + 1
            return (
                f"line {of_run.index[i]} has the time {values[i]:g} after "
                f"{values[i - 1]:g}: put that right; where runs follow each other, "
                "name their column by trajectory"
            )
    return ""


def _of_runs(cells: pd.Series, run: _Seen | None) -> list[pd.Series]:
    """The cells of each run."""
    if run is None:
        return [cells]
    numbers, _ = pd.factorize(run.cells)
    return [cells[numbers == number] for number in range(numbers.max() + 1)]


def _steps(times: np.ndarray, run: _Seen | None) -> np.ndarray:
    """Differences of neighbouring times of each run, (n_steps,)."""
    runs = _of_runs(pd.Series(times), run)
    return np.concatenate([np.diff(of_run) for of_run in runs])


def with_part(table: TableSurvey, column: str, part: str) -> TableSurvey:
    """The survey with another guess for a column."""
    columns = []
    for one in table.columns:
        columns.append(replace(one, part=part) if one.column == column else one)
    return replace(table, columns=tuple(columns))

"""A look at a table nobody has described yet: which column is what, and its unit.

Guesses from headers and values, for a first study file that a person corrects. Nothing
is decided by them. The reader of ``phsi_opt.data`` reads the table, so that what is
seen here can be read later.
"""

from dataclasses import dataclass, replace

import numpy as np

from phsi_opt.data.checks import checked_names
from phsi_opt.data.file_opening import DataFile
from phsi_opt.data.tables import Variable
from phsi_opt.errors import DataError, ModelError
from phsi_opt.model.checks import checked_names as usable_in_formulas
from phsi_opt.study_file.column_look import Seen, columns_of
from phsi_opt.study_file.data_files import sheets_in, table_at
from phsi_opt.study_file.headers import (
    TIMES,
    is_input_word,
    is_run_word,
    is_set_point,
    is_step_word,
    may_be_input_word,
    name_from,
)
from phsi_opt.study_file.thinning_look import is_long, thinning_of
from phsi_opt.study_file.time_look import (
    Span,
    increasing_column,
    named_time_column,
    said_of_times,
    span_of,
    step_column,
    step_in,
)

TIME = "time"
RUN = "run"
STATE = "state"
INPUT = "input"
UNUSED = "left out"
MOST_RUNS = 1 / 3  # share of the lines that may be different runs
PERHAPS_INPUT = "perhaps an input"


@dataclass(frozen=True)
class ColumnSurvey:
    """A column.

    Attributes:
        column: its header.
        part: `TIME`, `RUN`, `STATE`, `INPUT` or `UNUSED`.
        name: what it could be called in formulas.
        unit: as in the header; "" where it does not tell.
        said: what else was seen: its range, missing cells, why it is left out.
        wrong: the first cell that cannot be used, with its line; "" where none is.
    """

    column: str
    part: str
    name: str
    unit: str
    said: str
    wrong: str = ""

    @property
    def remark(self) -> str:
        """Everything that was seen, what is wrong first."""
        return "; ".join(filter(None, [self.wrong, self.said]))


@dataclass(frozen=True)
class TableSurvey:
    """A table.

    Attributes:
        path: of the file.
        columns: in the order of the table.
        n_lines: below the header.
        said: about the times: where they begin and end, how regular they are.
        step: the time between samples, where a column tells it and none the time.
        n_runs: as the column of the runs tells; 1 where there is none.
        span: the first and the last time, where they are numbers.
        further: what a MATLAB file holds beside these columns.
        encoding: what was guessed of the text's encoding; "" where nothing was.
        date_format: how dates are written, where it is not as in ISO 8601.
        sheets: those of a workbook with content; the first was looked at.
        thinning: how many samples could become their mean, where runs are long and the
            means keep what the states do; 1 where not.
    """

    path: DataFile
    columns: tuple[ColumnSurvey, ...]
    n_lines: int
    said: str
    step: float | None = None
    n_runs: int = 1
    span: Span | None = None
    further: tuple[Variable, ...] = ()
    encoding: str = ""
    date_format: str = ""
    sheets: tuple[str, ...] = ()
    thinning: int = 1

    @property
    def is_long(self) -> bool:
        """Whether its runs have so many lines that a study takes long."""
        return is_long(self.n_lines, self.n_runs)

    def of_part(self, part: str) -> list[ColumnSurvey]:
        """The columns that are one thing."""
        return [column for column in self.columns if column.part == part]


def survey(path: DataFile) -> TableSurvey:
    """Look at a table.

    Raises:
        DataError: it cannot be read as a table, or has too few lines.
    """
    sheets = sheets_in(path)
    table = table_at(path)
    n_lines = len(table.frame)
    if n_lines == 0:
        raise DataError(f"{path} has no line below its header.")
    if n_lines == 1:
        raise DataError(
            f"{path} has 1 line below its header; at least 2 are needed, and a study "
            "needs many more."
        )
    seen = columns_of(table)
    run = _run_column(seen)
    others = [one for one in seen if one is not run]
    time = named_time_column(others, run)
    of_step = step_column(others) if time is None else None
    step = _step(of_step, table.further) if time is None else None
    if time is None and step is None:
        time = increasing_column(others, run)
    n_runs = 1 if run is None else run.cells.nunique()
    columns = _with_a_state(_named(seen, _Parts(time, run, of_step)))
    if not any(one.part == STATE for one in columns):
        listed = "; ".join(f"{one.column}: {one.remark}" for one in columns)
        raise DataError(
            f"{path} has no column of numbers that a state could be: {listed}."
        )
    return TableSurvey(
        path=path,
        columns=columns,
        n_lines=n_lines,
        said=said_of_times(time, run),
        step=step,
        n_runs=n_runs,
        span=span_of(time, step, n_lines),
        further=table.further,
        encoding=table.remark,
        date_format="" if time is None else time.date_format,
        sheets=tuple(sheets),
        thinning=thinning_of(_values_of_states(seen, columns), n_lines, n_runs),
    )


def _values_of_states(
    seen: list[Seen], columns: tuple[ColumnSurvey, ...]
) -> list[np.ndarray]:
    """The values of what is surely no input, (n_lines,) each."""
    values = []
    for one, column in zip(seen, columns, strict=True):
        is_state = column.part == STATE and not column.said.endswith(PERHAPS_INPUT)
        if is_state and one.values is not None:
            values.append(one.values)
    return values


def _run_column(seen: list[Seen]) -> Seen | None:
    """The column that names each line's run."""
    for one in seen:
        n_different = one.cells[~one.is_missing].nunique()
        is_few = 1 < n_different <= MOST_RUNS * len(one.cells)
        if is_run_word(one.header.words) and is_few:
            one.said = f"{n_different} runs"
            if one.n_missing:
                one.wrong = f"{one.lines[int(np.argmax(one.is_missing))]} names no run"
            return one
    return None


def _step(of_step: Seen | None, further: tuple[Variable, ...]) -> float | None:
    """The time between samples: of a column, or of a MATLAB file's variable."""
    if of_step is not None:
        return step_in(of_step)
    for variable in further:
        is_step = is_step_word([variable.name.lower()])
        if is_step and variable.value is not None and variable.value > 0:
            return variable.value
    return None


# ---- parts ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Parts:
    """The columns that are found by looking at all of them."""

    time: Seen | None
    run: Seen | None
    of_step: Seen | None

    def part_of(self, one: Seen) -> str:
        """What a column is; what its name says goes into its remark."""
        words = one.header.words
        if one is self.time:
            return TIME
        if one is self.run:
            return RUN
        if one is self.of_step:
            one.said = "the time between samples"
            return UNUSED
        if one.is_left_out:
            return UNUSED
        if one.header.unit in TIMES:
            one.said += "; in a unit of time, and another column has the times"
            return UNUSED
        if is_set_point(words):
            one.said += "; a set point, by its name"
            return UNUSED
        if is_input_word(words):
            if one.n_missing:
                one.said += "; an input must be known at every sample"
            return INPUT
        if may_be_input_word(words):
            one.said += f"; {PERHAPS_INPUT}"
        return STATE


def _named(seen: list[Seen], parts: _Parts) -> tuple[ColumnSurvey, ...]:
    """The columns with names that formulas can use, each once."""
    used: set[str] = set()
    columns = []
    for one in seen:
        part = parts.part_of(one)
        name = ""
        if part in (STATE, INPUT):
            name = _free_name(name_from(one.header), used)
            used.add(name)
        header = one.header
        columns.append(
            ColumnSurvey(header.text, part, name, header.unit, one.said, one.wrong)
        )
    return tuple(columns)


def _with_a_state(columns: tuple[ColumnSurvey, ...]) -> tuple[ColumnSurvey, ...]:
    """The columns; inputs become states where there is no other."""
    if any(one.part == STATE for one in columns):
        return columns
    changed = []
    for one in columns:
        if one.part == INPUT:
            one = replace(one, part=STATE, said=f"{one.said}; {PERHAPS_INPUT}")
        changed.append(one)
    return tuple(changed)


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

"""A look at a table nobody has described yet, and the first study file for it.

Which column is what, and its unit: guesses from headers and values, that a person
corrects. Nothing is decided by them. The reader of ``phsi_opt.data`` reads the table,
so that what is seen here can be read later. Also: what stands empty in a study file.
"""

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain, starmap
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from phsi_opt.data.checks import RESERVED_NAMES, checked_names
from phsi_opt.data.file_opening import DataFile
from phsi_opt.data.headers import TIMES, Header, words_in
from phsi_opt.data.table_extent import NUMBER
from phsi_opt.data.table_readers import rows_by_name
from phsi_opt.data.tables import Table, rows_of_runs
from phsi_opt.data.times import (
    begun_anew,
    clock_of,
    is_milliseconds,
    names_of_parts,
    runs_of_clock,
    times_in,
)
from phsi_opt.errors import DataError, some_of
from phsi_opt.model.expressions import RESERVED_IN_FORMULAS
from phsi_opt.presentation.units import are_alike
from phsi_opt.study_file.columns import (
    INPUT,
    PERHAPS_INPUT,
    RUN,
    STATE,
    TIME,
    UNUSED,
    SeenColumn,
    columns_of,
    fault_of,
)
from phsi_opt.study_file.gallery import BaseModel, give_parts
from phsi_opt.study_file.keys import Complaints, TooManyComplaintsError, usable
from phsi_opt.study_file.sections import DataSection, table_at
from phsi_opt.study_file.study_text import text_of
from phsi_opt.study_file.toml_text import tables_of, text_template, toml_value

INPUT_WORDS = words_in(
    "u in input command cmd controle control pwm duty force torque current heater pump "
    "valve throttle motor uest uval drive actuator thrust"
)
# These may be what drives a system, or what is to be found: only a remark is made.
PERHAPS_INPUT_WORDS = words_in(
    "solar sun irradiance radiation ghi wind load power ambient outdoor outside supply "
    "inflow heating pulses disturbance ps ph ta thm qh"
)

OTHER_CLOCK = "another time column"
PART_OF_TIME = "belongs to the times in"


class ReadKey(NamedTuple):
    """How a file was read, and the key of [data] that says otherwise."""

    key: str
    content: Any
    said: str
    is_set: bool = False  # whether the study file has to say it

    def __str__(self) -> str:
        entry = f"{self.key} = {toml_value(self.content)}"
        return f"{entry:<17} {self.said}"


@dataclass(frozen=True, eq=False)
class TableSurvey:
    """A table, and what its columns may be."""

    path: DataFile  # of the file
    # as it was read; its ``remark`` tells a guessed encoding, ``further`` what a MATLAB
    # file holds beside the columns
    table: Table
    columns: list[SeenColumn]  # in the order of the table
    run: SeenColumn | None  # the column that names each line's run; None: there is none
    time: SeenColumn | None  # the column of the times; None: there is none
    step: float | None  # the time between samples, where no column has the times
    rows: list[np.ndarray]  # those of each run that the column names

    def of_part(self, part: str) -> list[SeenColumn]:
        return [column for column in self.columns if column.part == part]

    @property
    def read(self) -> list[ReadKey]:
        return list(self._read_keys())

    def _read_keys(self) -> Iterator[ReadKey]:
        table = self.table
        extent = table.extent
        if len(table.sheets) > 1:
            part = "group" if extent is None else "sheet"
            said = f"others: {some_of(table.sheets[1:])}"
            yield ReadKey(part, table.sheets[0], said, is_set=True)
        if extent is None:
            return
        word = table.row_word
        header = extent.header
        units = extent.units
        said = f"header in {word} {header}" if header else "no header"
        said += f", samples in {word}s {extent.rows[0]} to {extent.rows[-1]}"
        if extent.below:
            said += f"; not read: {word}s from {extent.below} on"
        yield ReadKey("skip", extent.above, said)
        if header is None:
            names = list(map(str, table.frame.columns))
            yield ReadKey("columns", names, "no names in the file")
        said = f"units in {word} {units}" if units else f"no {word} of units"
        yield ReadKey("units_row", units or 0, said)
        if table.separator:
            yield ReadKey("separator", table.separator, "between cells")
        if table.decimal:
            other = "comma" if table.decimal == "." else "point"
            said = f"before decimals; a {other} marks thousands"
            yield ReadKey("decimal", table.decimal, said)

    @property
    def n_lines(self) -> int:
        return len(self.table.frame)

    @cached_property
    def runs(self) -> list[str]:
        """The names of the runs that a column tells, or a clock that begins anew."""
        if self.run is not None:
            return self.run.cells.unique().tolist()
        return names_of_parts(self.table.run, len(self._parts))

    @cached_property
    def _parts(self) -> list[np.ndarray]:
        """The rows of each run, divided where the clock goes back to its first time."""
        if self.time is None or self.time.values is None:
            return self.rows
        times = self.time.values
        return list(chain(*(runs_of_clock(times, rows) for rows in self.rows)))

    @property
    def is_long(self) -> bool:
        """Whether its runs have so many lines that a study takes long."""
        return self.n_lines / len(self.runs) > 5000

    @property
    def span(self) -> tuple[float, float] | None:
        """The first and the last time; None where these are dates, or wrong."""
        if self.step is not None:
            return 0.0, self.step * (self.n_lines - 1)
        time = self.time
        if time is None or time.values is None or time.wrong:
            return None
        return float(time.values.min()), float(time.values.max())

    @property
    def clock(self) -> str:
        """The clock by which the times may be dates; "" where they are not."""
        time = self.time
        return "" if time is None or time.values is None else clock_of(time.values)

    @cached_property
    def thinning(self) -> int:
        """How many samples could become their mean; 1 where that would lose much.

        At least 2000 of a run are left.
        """
        n = self.n_lines // len(self.runs) // 2000 if self.is_long else 1
        surely = [one for one in self.of_part(STATE) if not one.may_be_input]
        while n > 1 and not all(_is_kept(one.values, n) for one in surely):
            n //= 2
        return n

    @property
    def said(self) -> str:
        """Where the times begin and end, or why they do not tell."""
        time = self.time
        if time is None:
            return (
                "no column increases from line to line; name the column of the times."
            )
        if time.values is None:
            first = time.cells.iloc[0]
            is_number = NUMBER.fullmatch(first) is not None
            numbers = f"numbers such as {first} look like"
            said = f"{numbers if is_number else 'the times are'} dates"
            return "; ".join(filter(None, (said, time.other_dates)))
        if time.wrong:
            return time.said
        begins = [self.table.row(rows[0]) for rows in self._parts[1:]]
        anew = begun_anew(begins) if self.run is None else ""
        span = f"{time.values.min():g} to {time.values.max():g}"
        return "; ".join(filter(None, (span, anew)))


def survey(path: DataFile, part: str | None = None) -> TableSurvey:
    """Look at a table: of several in a file at that of a sheet or group, if any."""
    table = table_at(path, part=part)
    columns = columns_of(table)
    n_lines = len(table.frame)
    if n_lines < 2:
        raise DataError(
            f"{path} has {'1 line' if n_lines else 'no line'} below its header; at "
            "least 2 are needed, and a study needs many more."
        )
    run = next(filter(_is_run, columns), None) or _run_by_times(columns)
    rows = [np.arange(n_lines)]
    if run is not None:
        run.wrong = fault_of(table, partial(rows_by_name, table, run.column))
        rows = list(rows_of_runs(run.cells).values())
    others = [one for one in columns if one is not run]
    of_step = next((one for one in others if one.is_step and one.only_number), None)
    steps = [] if of_step is None else [of_step.only_number]
    steps += [one.value for one in table.further if Header.of(one.name).is_step]
    step = next((value for value in steps if value and value > 0), None)
    time = _time(table, others, rows, step)
    if time is not None:
        _put_together(time, others)
        _find_other_clocks(time, others, rows)
    measured = {one.unit for one in columns if not one.is_set_point}
    for one in columns:
        if not one.said.startswith((OTHER_CLOCK, PART_OF_TIME)):
            one.hold = "zero" if one.is_held(rows) else ""
            _take_part(one, time, run, of_step, measured)
    step = step if time is None else None
    seen = TableSurvey(path, table, columns, run, time, step, rows)
    if not seen.of_part(STATE):
        for one in seen.of_part(INPUT):
            one.becomes(STATE, PERHAPS_INPUT)
    used: dict[str, int] = {}
    for one in columns:
        if one.part in (STATE, INPUT):
            one.name = _free_name(one.suggested_name, used)
    if not seen.of_part(STATE):
        listed = "; ".join(f"{one.column}: {one.remark}" for one in columns)
        raise DataError(
            f"{path} has no column of numbers that could be a state: {listed}."
        )
    return seen


def surveys(paths: Iterable[DataFile], part: str | None = None) -> list[TableSurvey]:
    """A look at each of some files, which are runs of the same measurement."""
    first, *others = [survey(path, part) for path in paths]
    known = set(map(attrgetter("column"), first.columns))
    for other in others:
        own = set(map(attrgetter("column"), other.columns))
        differ = sorted(known ^ own)
        if differ:
            raise DataError(
                f"{other.path} has other columns than the first file: "
                f"{', '.join(differ)} are only in one of them. The files of a study "
                "are runs of the same machine with the same columns; rename the "
                "columns, or choose other files."
            )
    return [first, *others]


def _is_run(one: SeenColumn) -> bool:
    """Whether it names each line's run; then it says so."""
    n_different = one.cells[~one.is_missing].nunique()
    is_few = 1 < n_different <= len(one.cells) / 3
    if not one.is_run or not is_few:
        return False
    one.said = f"{n_different} runs"
    return True


def _run_by_times(columns: list[SeenColumn]) -> SeenColumn | None:
    """The column that changes just where the times begin anew, whatever its name."""
    times = [one.values for one in columns if one.is_time and one.values is not None]
    for values in times[:1]:
        numbers = np.cumsum(np.diff(values, prepend=-np.inf) < 0)  # of the runs
        for one in columns if numbers[-1] else ():
            if np.array_equal(pd.factorize(one.cells)[0], numbers):
                one.said = f"{numbers[-1] + 1} runs"
                return one
    return None


def _time(
    table: Table, others: list[SeenColumn], runs: list[np.ndarray], step: float | None
) -> SeenColumn | None:
    """What increases, or has dates; of several columns what is called the time.

    Without one: what is called so and is wrong, or what was rounded until times are
    equal, which is wrong, too.
    """
    usable = [one for one in others if one.values is not None or one.is_dates]
    named = [one for one in usable if one.is_time]

    def why_wrong(one: SeenColumn) -> str:
        return fault_of(table, partial(times_in, table, one.column, runs))

    for one in (*named, *usable):
        if one.is_dates or (one.is_time and not why_wrong(one)):
            return one
    if not named and step is None:
        free = list(filter(attrgetter("may_be_time"), usable))
        free.sort(key=lambda one: not one.unit)  # a unit of time first
        for one in free:
            if one.increases(runs) and not one.n_missing and not one.wrong:
                return one
        named = list(filter(attrgetter("rounded_step"), free))
    for one in named:
        one.wrong = why_wrong(one)
        return one
    return None


def _put_together(time: SeenColumn, others: list[SeenColumn]) -> None:
    """Add the columns of the time of day and of milliseconds to one of dates."""
    if not time.is_dates or len(time.cells.unique()) == len(time.cells):
        return
    for one in others:
        is_clock = one.is_dates and one.is_time
        if one is not time and (is_clock or is_milliseconds(one.column)):
            time.further += (one.column,)
            one.said = f"{PART_OF_TIME} {time.column}"
            if is_clock:
                time.cells = time.cells.str.cat(one.cells, sep=" ")
                time.take_dates_of(time.cells)


def _find_other_clocks(
    time: SeenColumn, others: list[SeenColumn], runs: list[np.ndarray]
) -> None:
    """Note the channels that follow another clock than the times."""
    clock = None
    for one in others:
        if one is time:
            clock = None
        elif one.is_time and one.increases(runs) and not one.is_counter:
            assert one.values is not None
            is_same = not one.n_missing and _runs_alike(time.values, one.values)
            clock = None if is_same else one
            said = f"same spacing as {time.column}" if is_same else "its own times"
            one.said = f"{OTHER_CLOCK} ({said})"
        elif clock and clock.unit == time.unit and one.values is not None:
            one.clock = clock.column
            one.said = f"{one.said}; times in {clock.column}"
        elif clock and one.values is not None:
            of = f"{clock.column}, in another unit than {time.column}"
            one.said = f"{OTHER_CLOCK}, {of}: put it on common times to use it"


def _runs_alike(times: np.ndarray | None, other: np.ndarray) -> bool:
    """Whether another clock counts the same moments, from elsewhere, in its unit."""
    if times is None:  # dates
        return True
    steps, own = np.diff(times), np.diff(other)
    scale = np.median(own) / np.median(steps)
    return bool(np.all(np.abs(own - scale * steps) <= 0.01 * np.abs(own)))


def _take_part(
    one: SeenColumn,
    time: SeenColumn | None,
    run: SeenColumn | None,
    of_step: SeenColumn | None,
    measured: set[str],
) -> None:
    """Say of a column what it is, beside others that are measured in these units.

    A set point in a unit in which nothing is measured is what an actuator is told.
    """
    if one is time:
        one.becomes(TIME)
    elif one is run:
        one.becomes(RUN)
    elif one is of_step and time is None:
        one.said = "the time between samples"
    elif one.values is None:
        pass  # its remark says why
    elif one.is_counter:
        one.becomes(UNUSED, "counts the lines")
    elif one.unit in TIMES:
        one.becomes(UNUSED, "in a unit of time, and another column has the times")
    elif one.is_set_point and any(
        not one.unit or are_alike(one.unit, unit) for unit in measured
    ):
        one.becomes(UNUSED, "a set point, by its name")
    elif one.is_set_point or one.hold or one.has_one_of(INPUT_WORDS):
        remarks = ["constant between jumps: held"] if one.hold else []
        if one.misses_samples:
            remarks.append("an input must be known at every sample")
        one.becomes(INPUT, "; ".join(remarks))
    else:
        is_unsure = one.has_one_of(PERHAPS_INPUT_WORDS)
        one.becomes(STATE, PERHAPS_INPUT if is_unsure else "")


def _is_kept(values: np.ndarray | None, n: int) -> bool:
    """Whether means of n neighbours have nearly the variance of the samples."""
    if values is None:
        return True
    known = values[np.isfinite(values)]
    n_groups = len(known) // n
    if n_groups < 2:
        return False
    means = known[: n_groups * n].reshape(n_groups, n).mean(axis=1)
    return bool(np.var(means) >= 0.95 * np.var(known))


def _free_name(wanted: str, used: dict[str, int]) -> str:
    """A name that formulas can use, and none of those that are used; it is then."""
    try:
        checked_names([wanted], "states", (*RESERVED_NAMES, *RESERVED_IN_FORMULAS))
    except DataError:
        wanted = f"x_{wanted}" if wanted else "x"
    name = wanted
    while name in used:
        used[wanted] += 1
        name = f"{wanted}_{used[wanted]}"
    used[name] = 1
    return name


# ---- what a person fills in ----------------------------------------------------------


def first_text(
    table: TableSurvey, files: list[Path], folder: Path, base: BaseModel | None = None
) -> str:
    """The study file of a folder for tables, of which the first one was looked at.

    With a base model of the gallery its columns become the states and inputs of that.
    """
    physics = ""
    lacking: dict[str, str] = {}
    if base is not None:
        base, lacking = give_parts(table.columns, base)
        for column in table.columns:
            if column.lost:
                column.name = ""
                column.becomes(UNUSED, f"the model {base.name} has no place for it")
        inputs = [one.name for one in table.of_part(INPUT)]
        model, parameters = base.sections(inputs)
        sections = {"model": model, "parameters": parameters}
        physics = text_of(sections, base.equation)
    places = []
    for file in files:  # as the folder calls it; absolute where that was meant
        place = Path(os.path.relpath(*map(os.path.realpath, (file, folder))))
        is_outside = place.parts[0] == os.pardir
        places.append((file if is_outside and file.is_absolute() else place).as_posix())
    template = text_template("first_study.toml.jinja")
    return template.render(table=table, files=places, physics=physics, lacking=lacking)


def known_values(tables: Mapping[str, Any]) -> list[str]:
    """The parameters of a study file that are not estimated, such as "m = 1 kg"."""
    parameters = tables.get("parameters", {})
    return list(filter(None, starmap(value_words, parameters.items())))


def value_words(name: str, parameter: Any) -> str:
    """Such as "m = 1 kg"; "" where the parameter is estimated."""
    told = parameter if isinstance(parameter, dict) else {"value": parameter}
    value = told.get("value", told.get("start") if told.get("fixed") else None)
    return "" if value is None else f"{name} = {value} {told.get('unit', '')}".rstrip()


def unfilled(path: Path, has_dates: bool = False) -> tuple[str, ...]:
    """What stands empty in a study file, a sentence each, with an example."""
    try:
        tables = tables_of(path)
        file = usable(tables, Complaints(tables))
    except TooManyComplaintsError:
        return ()
    model = file.get("model", {})
    formulas = list(map(model.get, ("H", "R", "F", "sensor")))
    words = re.findall(r"\w+", str([*formulas, file.get("effects")]))
    data = DataSection.of(file.get("data", {}))
    channels = {**data.states, **data.inputs}
    without_unit = [name for name, one in channels.items() if not one.unit]
    if data != DataSection() and not has_dates and not data.time.unit:
        without_unit.insert(0, "the time")
    text = text_template("unfilled.txt.jinja").render(
        file=file,
        idle=[name for name in model.get("inputs", ()) if name not in words],
        without_unit=without_unit,
    )
    return tuple(text.splitlines())

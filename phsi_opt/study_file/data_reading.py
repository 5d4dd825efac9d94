"""The sections [data] and [held_out]: what they say, and whether the files bear it out.

Every column of every file is looked at, so that one look tells all that is wrong.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from phsi_opt.data.checks import HOLDS, checked_names
from phsi_opt.data.file_opening import DataFile
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.tables import Table, numbers_in
from phsi_opt.data.times import Times, times_in
from phsi_opt.errors import DataError, did_you_mean
from phsi_opt.study_file.file_tables import table_at
from phsi_opt.study_file.part import Complaints, Part
from phsi_opt.study_file.sections import (
    READERS,
    TEXT_READER,
    Channel,
    DataSection,
    HeldOut,
)

TIME_KEY = "data.time.column"
WAYS_HELD_OUT = ("runs", "share", "after")


def read_data(file: Part) -> DataSection:
    """The section [data]."""
    data = file.part("data")
    if not data.content:
        said = "there is no section [data]; it names the files and their columns."
        file.complaints.add("data", said)
    else:
        _check_files_named(data)
    return DataSection(
        files=data.texts("files", '["bench.csv"]'),
        states=_channels(data, "states"),
        inputs=_channels(data, "inputs"),
        trajectory=data.text("trajectory") or None,
        hold=data.one_of("hold", HOLDS, "linear"),
        sheet=data.text("sheet") or None,
        columns=data.texts("columns", '["t", "q"]') or None,
        separator=data.text("separator") or None,
        decimal=data.text("decimal") or None,
        between=_between(data),
        thinned=data.whole("thinned"),
        **_time(data),
    )


def _check_files_named(data: Part) -> None:
    if data.content.get("files", []) in ([], "", [""]):
        said = 'expected the data file(s), such as ["bench.csv"].'
        data.complaints.add(data.path("files"), said)
    if not data.content.get("states"):
        said = (
            'expected a table for each state, such as q = { column = "q", unit = "m" }.'
        )
        data.complaints.add(data.path("states"), said)


def _between(data: Part) -> tuple[float, float] | None:
    if "between" not in data.content:
        return None
    times = data.numbers("between")
    if len(times) == 2 and times[0] < times[1]:
        return times[0], times[1]
    data.complain("between", "expected two times, the first and the last: [20, 80].")
    return None


def _time(data: Part) -> dict[str, Any]:
    """What the section says of the times: a column, dates, or a step."""
    part = data.part("time")
    given = part.content
    step = part.number("step")
    if step is not None and not 0 < step < float("inf"):
        part.complain("step", "expected the time between lines, a number above zero.")
    column = part.column("column")
    if column is not None and "step" in part.content:
        part.complain("step", "there is a column too; keep one of the two.")
    if data.content and column is None and "step" not in part.content:
        data.complaints.add(
            part.path("column"),
            'expected the column of the times, such as "t_s"; where no column has '
            "them, the time between lines: time = { step = 0.01 }.",
        )
    return {
        "time": Channel(column, part.text("unit")),
        "step": step,
        "start": part.text("start") or None,
        "date_format": part.text("date_format") if "date_format" in given else None,
    }


def _channels(data: Part, what: str) -> dict[str, Channel]:
    channels = {}
    section = data.part(what)
    for name, part in section.parts(f"data.{what}.*"):
        try:
            checked_names([name], what)
        except DataError as error:
            section.complaints.add(section.path(name), str(error))
            continue
        channels[name] = _state(part) if what == "states" else _input(part)
    return channels


def _state(part: Part) -> Channel:
    noise = part.number("noise")
    if noise is not None and not 0 < noise < float("inf"):
        said = "expected a positive number; leave it out where the noise is unknown."
        part.complain("noise", said)
        noise = None
    if part.flag("measured", default=True):
        return Channel(
            _column(part, " (or measured = false)"), part.text("unit"), noise
        )
    if "column" in part.content:
        part.complain("measured", "there is a column too; keep one of the two.")
    return Channel(None, part.text("unit"), noise)


def _input(part: Part) -> Channel:
    return Channel(_column(part, ""), part.text("unit"))


def _column(part: Part, otherwise: str) -> str | int | None:
    column = part.column("column")
    if column is None and part.content.get("column", "") == "":
        part.complaints.add(
            part.path("column"), f"expected the name of a column{otherwise}."
        )
    return column


def read_held_out(file: Part) -> HeldOut | None:
    """The section [held_out]; None where there is none, or it cannot be used."""
    if "held_out" not in file.content:
        return None
    part = file.part("held_out")
    way = part.exactly_one(WAYS_HELD_OUT)
    if way == "runs":
        return HeldOut(runs=part.texts("runs", '["run 7", "run 8"]'))
    if way == "after":
        return HeldOut(after=part.number("after"))
    share = part.number("share")
    if not way or share is None:
        return None
    if not 0 < share < 1:
        part.complain("share", "expected a number between 0 and 1, such as 0.3.")
        return None
    return HeldOut(share=share)


# ---- the files -----------------------------------------------------------------------


def check_measurements(
    section: DataSection, folder: Path, complaints: Complaints
) -> Measurements | None:
    """The measurements; None, and what is wrong noted, where they cannot be read."""
    if complaints.about("data"):
        return None
    for number, path in enumerate(section.paths(folder)):
        key = "data.files" if len(section.files) == 1 else f"data.files[{number}]"
        _check_file(section, path, section.files[number], key, complaints)
    if complaints.about("data", *_numbered(section)):
        return None
    try:
        return section.measurements(folder)
    except DataError as error:
        complaints.add("data", str(error))
        return None


def _numbered(section: DataSection) -> list[str]:
    return [f"data.files[{number}]" for number in range(len(section.files))]


def _check_file(
    section: DataSection, path: DataFile, name: str, key: str, complaints: Complaints
) -> None:
    """Look at each column by itself, for the first wrong cell of each."""
    wanted = _wanted(section)
    if not path.exists():
        said = "there is no such file; paths are relative to the study file."
        complaints.add(key, said, name)
        return
    if path.suffix.lower() != section.suffix:
        said = f"the first file is {section.suffix}; give files of one kind."
        if READERS.get(path.suffix.lower(), TEXT_READER) != section.reader:
            complaints.add(key, said, name)
            return
    try:
        table = table_at(path, wanted.values(), section)
    except DataError as error:
        complaints.add(key, str(error), name)
        return
    for where, column in wanted.items():
        _check_column(table, where, column, section, complaints)


def _wanted(section: DataSection) -> dict[str, str | int]:
    """The columns that are asked for, by their keys."""
    channels: dict[str, Channel] = {"data.time": section.time}
    for what, named in (("states", section.states), ("inputs", section.inputs)):
        for name, channel in named.items():
            channels[f"data.{what}.{name}"] = channel
    wanted: dict[str, str | int] = {}
    for key, channel in channels.items():
        if channel.column is not None:
            wanted[f"{key}.column"] = channel.column
    if section.trajectory is not None:
        wanted["data.trajectory"] = section.trajectory
    return wanted


def _check_column(
    table: Table,
    key: str,
    column: str | int,
    section: DataSection,
    complaints: Complaints,
) -> None:
    found = table.frame.columns.tolist()
    if column not in found:
        listed = ", ".join(map(str, found))
        complaints.add(
            key,
            f"{table.title} has no such column; it has {listed}."
            f"{did_you_mean(column, found)}",
            column,
        )
        return
    if found.count(column) > 1 or key == "data.trajectory":
        return  # told where the table is read as a whole
    try:
        if key == TIME_KEY:
            _check_times(table, column, section)
        else:
            is_state = key.startswith("data.states.")
            numbers_in(table, column, may_be_missing=is_state)
    except DataError as error:
        complaints.add(key, str(error), column)


def _check_times(table: Table, column: str | int, section: DataSection) -> None:
    """Refuse times that are neither numbers nor dates, or do not increase."""
    times = Times(column, None, section.start, section.date_format)
    times_in(table, times, _rows_of_runs(table, section.trajectory))


def _rows_of_runs(table: Table, column: str | None) -> list[np.ndarray]:
    """The row numbers of each run; none where their column cannot be used."""
    import pandas as pd

    if column is None:
        return [np.arange(len(table.frame))]
    if table.frame.columns.tolist().count(column) != 1:
        return []
    numbers, _ = pd.factorize(table.frame[column].astype(str).str.strip())
    return [np.flatnonzero(numbers == n) for n in range(numbers.max() + 1)]


def check_held_out(
    held_out: HeldOut | None,
    data: Measurements,
    content: Mapping[str, Any],
    complaints: Complaints,
) -> None:
    """Note what is held out and is not there, or leaves nothing to fit."""
    if held_out is None:
        return
    wrong_before = len(complaints.listed)
    for run in held_out.runs or ():
        try:
            data.trajectory_number(run)
        except DataError as error:
            complaints.add("held_out.runs", str(error), run)
    if len(complaints.listed) > wrong_before:
        return
    try:
        held_out.split(data)
    except DataError as error:
        complaints.add("held_out", str(error), content.get("held_out"))

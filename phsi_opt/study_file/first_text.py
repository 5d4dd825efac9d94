"""The text of a first study file: what a table shows, and where the physics goes.

What only a person knows stands there empty; `StudyFile.read` then says what is missing.
"""

import os
from pathlib import Path
from typing import Any

from phsi_opt.study_file.column_look import DATES
from phsi_opt.study_file.survey import (
    INPUT,
    PERHAPS_INPUT,
    RUN,
    STATE,
    TIME,
    UNUSED,
    ColumnSurvey,
    TableSurvey,
)
from phsi_opt.study_file.time_look import unit_asked
from phsi_opt.study_file.toml_text import key_text, toml_value

HELD_OUT_SHARE = 0.3  # of the runs, or of the time of a single one: the usual
PHYSICS_SECTION = """\
# ---- the physics: fill this in ------------------------------------------------------
# dx/dt = (S - R) grad H + F(x, t, u): H is the energy, R >= 0 the losses, F the forces.
# Names in formulas: states, inputs, t, the efforts dH_dq, dH_dp, ..., and parameters.
#
#   a body    states = ["q", "p"]   pairs = [["q", "p"]]   (this is dq/dt = dH/dp)
#             H = "k*q**2/2 + p**2/(2*m)"   R = { p = "c" }   F = { p = "u" }
#   a tank    states = ["V"]   pairs = []   H = "V**2/(2*A)"   R = { V = "k" }
#             F = { V = "g*u" }
#   a circuit states = ["Q", "L"]   pairs = [["Q", "L"]]   H = "Q**2/(2*C) + L**2/(2*I)"
#             R = { L = "r" }   F = { L = "u" }   kind = "electrical"
#   heat      states = ["T"]   pairs = []   H = "T**2/2"   R = { T = "a" }
#             F = { T = "a*outdoor + b*heater" }   kind = "thermal"
#
# A state that nobody measured is named here and above: p = { measured = false }.
"""
NUMBERS_SECTION = """\
# The numbers in the formulas: known ones as they are; start is where a search begins.
[parameters]
# m = 2.5
# k = { start = 10.0, lower = 0, unit = "N/m" }
"""
STUDY_SECTION = """\
# Effects added so far; `phsi-opt add` and `phsi-opt study --auto` tell which help.
[study]
added = []
"""


def first_text(table: TableSurvey, files: list[Path], folder: Path) -> str:
    """The study file for a table.

    Args:
        table: what was seen in the first file.
        files: all of them.
        folder: that of the study file.
    """
    named = [_relative(file, folder) for file in files]
    sections = [
        _head(table),
        _data(table, named),
        _states(table),
        _inputs(table),
        _left_out(table),
        _held_out(table, len(files)),
        f"{PHYSICS_SECTION}{_model(table)}",
        NUMBERS_SECTION,
        STUDY_SECTION,
    ]
    return "\n".join(filter(None, sections))


def _relative(file: Path, folder: Path) -> str:
    """The file as the study's folder calls it; absolute where that was meant."""
    place = folder.resolve()
    is_elsewhere = not file.resolve().is_relative_to(place)
    if file.is_absolute() and is_elsewhere:
        return file.as_posix()
    if is_elsewhere:
        return Path(os.path.relpath(file, folder)).as_posix()
    return file.resolve().relative_to(place).as_posix()


def _head(table: TableSurvey) -> str:
    lines = [
        f"# A study of {table.path.name}, written by phsi-opt init: guesses, to be put "
        "right.",
        "# `phsi-opt check` says what is missing; docs/command_line.md lists all keys.",
    ]
    if table.encoding:
        lines.append(f"# {table.path.name}: {table.encoding}; save it as UTF-8 where")
        lines.append("# letters look wrong.")
    return "\n".join(lines) + "\n"


def _data(table: TableSurvey, files: list[str]) -> str:
    lines = ["[data]", f"files = {toml_value(files)}  # {table.n_lines} lines"]
    if len(table.sheets) > 1:
        others = ", ".join(map(toml_value, table.sheets[1:]))
        lines.append(f"sheet = {toml_value(table.sheets[0])}  # others: {others}")
    runs = table.of_part(RUN)
    if runs:
        lines.append(f"trajectory = {toml_value(runs[0].column)}  # {runs[0].said}")
        lines += _to_correct(runs[0])
    if table.of_part(INPUT):
        lines.append(
            'hold = "linear"  # between samples; "zero" for a digital output, "cubic" '
            "for a smooth input"
        )
    lines += _time(table)
    lines.append("# Where it applies, without the # in front:")
    if not runs:
        lines.append('# trajectory = "run"  # the column that names each line\'s run')
    lines += [_between(table), *_thinned(table)]
    return "\n".join(lines) + "\n"


def _time(table: TableSurvey) -> list[str]:
    times = table.of_part(TIME)
    if times:
        return _of_column(times[0], table)
    if table.step is not None:
        step = f'{{ step = {table.step!r}, unit = "s" }}'
        return [f"time = {step}  # no column has the times; in seconds?"]
    return [
        'time = { column = "" }  # no column increases from line to line: name the one',
        "# with the times, or give the time between samples:",
        '# time = { step = 0.01, unit = "s" }',
    ]


def _of_column(time: ColumnSurvey, table: TableSurvey) -> list[str]:
    said = table.said
    content: dict[str, Any] = {"column": time.column}
    unit = "s" if time.said == DATES else time.unit
    if unit:
        content["unit"] = unit
    else:
        said += f"; {unit_asked(table.span)}"
    if table.date_format:
        content["date_format"] = table.date_format
    return [f"time = {toml_value(content)}  # {said}", *_to_correct(time)]


def _to_correct(column: ColumnSurvey) -> list[str]:
    """A comment on a cell that cannot be used; none where all can."""
    return [f"#   to correct in the file: {column.wrong}"] if column.wrong else []


def _between(table: TableSurvey) -> str:
    about = "the part of the times that is used"
    if table.span is None:
        has_dates = any(time.said == DATES for time in table.of_part(TIME))
        seconds = ", in s from the first" if has_dates else ""
        return f"# between = [0, 3600]  # {about}{seconds}"
    times = [table.span.begin, table.span.end]
    shown = ", ".join(f"{time:.6g}" for time in times)
    return f"# between = [{shown}]  # {about}; here: all"


def _thinned(table: TableSurvey) -> list[str]:
    example = "# thinned = 2  # so many neighbouring samples become their mean"
    if not table.is_long:
        return [example]
    n = table.thinning
    n_lines = table.n_lines // table.n_runs
    of_run = "lines" if table.n_runs == 1 else "lines in a run"
    if n == 1:
        return [
            f"# {n_lines} {of_run} take long; use a part of them (means of neighbours "
            "would lose",
            "# much of what the states do).",
            example,
        ]
    return [
        f"# {n_lines} {of_run} take long; use a part of them, or let so many become",
        f"# their mean, {n_lines // n} then:",
        f"# thinned = {n}",
    ]


def _states(table: TableSurvey) -> str:
    lines = [
        "# What was measured; delete what is not used, here and in model.states.",
        "[data.states]",
        *_channels(table.of_part(STATE)),
    ]
    return "\n".join(lines) + "\n"


def _inputs(table: TableSurvey) -> str:
    inputs = table.of_part(INPUT)
    if inputs:
        about = "# Inputs, known at every sample."
        return "\n".join([about, "[data.inputs]", *_channels(inputs)]) + "\n"
    lines = [
        "# Inputs drive the system and are known at every sample: move their lines",
        "# from the states to here, and their names from model.states to model.inputs.",
        "# [data.inputs]",
    ]
    examples = _channels(_perhaps_inputs(table)) or ['u = { column = "u", unit = "V" }']
    lines += [f"# {example}" for example in examples]
    return "\n".join(lines) + "\n"


def _perhaps_inputs(table: TableSurvey) -> list[ColumnSurvey]:
    states = table.of_part(STATE)
    return [state for state in states if state.said.endswith(PERHAPS_INPUT)]


def _channels(columns: list[ColumnSurvey]) -> list[str]:
    lines = []
    for column in columns:
        content = {"column": column.column}
        if column.unit:
            content["unit"] = column.unit
        entry = f"{key_text(column.name)} = {toml_value(content)}"
        lines.append(f"{entry}  # {column.said}")
        lines += _to_correct(column)
    return lines


def _left_out(table: TableSurvey) -> str:
    lines = []
    for column in table.of_part(UNUSED):
        if column.column:
            lines.append(f"#   {_on_one_line(column.column)}: {column.said}")
    for variable in table.further:
        lines.append(f"#   {variable.name}: {variable.said}")
    if not lines:
        return ""
    lines.insert(0, "# Left out:")
    return "\n".join(lines) + "\n"


def _on_one_line(header: str) -> str:
    return " ".join(header.split())


def _held_out(table: TableSurvey, n_files: int) -> str:
    several = table.of_part(RUN) or n_files > 1
    what = "the last runs" if several else "the last part of the record"
    about = f"# Kept from fitting, to judge by: {what}."
    return f"{about}\n[held_out]\nshare = {HELD_OUT_SHARE}\n"


def _model(table: TableSurvey) -> str:
    states = [column.name for column in table.of_part(STATE)]
    inputs = [column.name for column in table.of_part(INPUT)]
    lines = ["[model]", f"states = {toml_value(states)}"]
    perhaps = [column.name for column in _perhaps_inputs(table)] or ["u"]
    if inputs:
        lines.append(f"inputs = {toml_value(inputs)}")
    else:
        lines.append(f"# inputs = {toml_value(perhaps)}")
    lines += [
        "pairs = []",
        'H = ""  # fill in: the energy',
        "# R = { }  # losses by state",
        "# F = { }  # forces by state",
    ]
    return "\n".join(lines) + "\n"

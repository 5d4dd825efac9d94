"""The text of a first study file: what a table shows, and where the physics goes.

What only a person knows stands there empty; `StudyFile.read` then says what is missing.
"""

import os
from pathlib import Path
from typing import Any

from phsi_opt.study_file.survey import (
    INPUT,
    RUN,
    STATE,
    TIME,
    UNUSED,
    ColumnSurvey,
    TableSurvey,
)
from phsi_opt.study_file.toml_text import key_text, text_value, toml_value

HELD_OUT_SHARE = 0.3  # of the runs, or of the time of a single one: the usual
MANY_LINES = 5_000  # from which a fit takes long, and means are suggested
ENOUGH_LINES = 2_000
ABOUT_MEASURED = (
    "What was measured. Delete what is not used; move inputs to [data.inputs]."
)
NO_INPUTS = """\
# Inputs, known at every sample (a voltage, a pump, the weather): none was recognised.
# [data.inputs]
# u = { column = "...", unit = "V" }
"""
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
        _channels(table, STATE, "states", ABOUT_MEASURED),
        _channels(table, INPUT, "inputs", "Inputs, known at every sample."),
        _left_out(table),
        _held_out(table, len(files)),
        f"{PHYSICS_SECTION}{_model(table)}",
        NUMBERS_SECTION,
        STUDY_SECTION,
    ]
    return "\n".join(filter(None, sections))


def _relative(file: Path, folder: Path) -> str:
    """The file as the study's folder calls it; absolute where that was meant."""
    if file.is_absolute() and not file.is_relative_to(folder.resolve()):
        return file.as_posix()
    return Path(os.path.relpath(file, folder)).as_posix()


def _head(table: TableSurvey) -> str:
    return (
        f"# A study of {table.path.name}, written by phsi-opt init: guesses, to be put "
        "right.\n# `phsi-opt check` says what is missing; docs/command_line.md lists "
        "every key.\n"
    )


def _data(table: TableSurvey, files: list[str]) -> str:
    lines = ["[data]", f"files = {toml_value(files)}  # {table.n_lines} lines"]
    runs = table.of_part(RUN)
    if runs:
        lines.append(f"trajectory = {text_value(runs[0].column)}  # {runs[0].said}")
    if table.of_part(INPUT):
        lines.append('hold = "linear"  # between samples; "zero" for a digital output')
    lines.append(_time(table))
    if not runs:
        lines.append(
            '# trajectory = "run"  # the column that names the run of each line'
        )
    lines.append(
        "# between = [0, 20]  # first and last time that are used, of each run"
    )
    lines.append(_thinned(table))
    return "\n".join(lines) + "\n"


def _thinned(table: TableSurvey) -> str:
    """The key that makes neighbouring samples their mean, used where lines are many."""
    if table.n_lines <= MANY_LINES:
        return "# thinned = 10  # so many neighbouring samples become their mean"
    number = -(-table.n_lines // ENOUGH_LINES)
    return (
        f"# thinned = {number}  # so many neighbouring samples become their mean: with "
        f"{table.n_lines} lines\n# a fit takes long; a tenth of the shortest period "
        "may be a sample"
    )


def _time(table: TableSurvey) -> str:
    times = table.of_part(TIME)
    if times:
        content: dict[str, Any] = {"column": times[0].column}
        if times[0].said == "dates":
            content["unit"] = "s"
        elif times[0].unit:
            content["unit"] = times[0].unit
        unit = "" if "unit" in content else '; in seconds? add unit = "s"'
        return f"time = {toml_value(content)}  # {table.said}{unit}"
    if table.step is not None:
        step = f'{{ step = {table.step!r}, unit = "s" }}'
        return f"time = {step}  # no column has the times"
    return (
        'time = { column = "" }  # no column increases from line to line: name the one '
        "with the\n# times, or give the time between samples: "
        'time = { step = 0.01, unit = "s" }'
    )


def _channels(table: TableSurvey, part: str, what: str, about: str) -> str:
    columns = table.of_part(part)
    if not columns and part == INPUT:
        return NO_INPUTS
    lines = [f"# {about}", f"[data.{what}]"]
    for column in columns:
        content = {"column": column.column}
        if column.unit:
            content["unit"] = column.unit
        entry = f"{key_text(column.name)} = {toml_value(content)}"
        lines.append(f"{entry}  # {column.said}")
    return "\n".join(lines) + "\n"


def _left_out(table: TableSurvey) -> str:
    columns = [one for one in table.of_part(UNUSED) if one.column]
    if not columns:
        return ""
    lines = ["# Columns that are left out:"]
    lines += [f"#   {_named(one)}: {one.said}" for one in columns]
    return "\n".join(lines) + "\n"


def _named(column: ColumnSurvey) -> str:
    return column.column.replace("\n", " ")


def _held_out(table: TableSurvey, n_files: int) -> str:
    several = table.of_part(RUN) or n_files > 1
    what = "the last runs" if several else "the last part of the record"
    about = f"# Kept from fitting, to judge by: {what}."
    return f"{about}\n[held_out]\nshare = {HELD_OUT_SHARE}\n"


def _model(table: TableSurvey) -> str:
    states = [column.name for column in table.of_part(STATE)]
    inputs = [column.name for column in table.of_part(INPUT)]
    lines = ["[model]", f"states = {toml_value(states)}"]
    if inputs:
        lines.append(f"inputs = {toml_value(inputs)}")
    lines += [
        "pairs = []",
        'H = ""  # fill in: the energy',
        "# R = { }  # losses by state",
        "# F = { }  # forces by state",
    ]
    return "\n".join(lines) + "\n"

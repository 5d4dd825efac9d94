"""The text of a first study file: what a table shows, and where the physics goes.

The template decides what is told of which column.

What only a person knows stands there empty; `StudyFile.read` then says what is missing.
"""

import os
from pathlib import Path

from phsi_opt.study_file.survey import TableSurvey
from phsi_opt.study_file.toml_text import text_template

# From 2000 to 2050 as clocks count it: the unit, with its first and last number.
CLOCKS = (
    ("days, as spreadsheets count them", "d", 36526, 54789),
    ("seconds since 1970", "s", 946684800, 2524608000),
    ("milliseconds since 1970", "ms", 946684800e3, 2524608000e3),
    ("microseconds since 1970", "us", 946684800e6, 2524608000e6),
)


def first_text(table: TableSurvey, files: list[Path], folder: Path) -> str:
    """The study file for a table.

    Args:
        table: what was seen in the first file.
        files: all of them.
        folder: that of the study file.
    """
    places = [_relative(file, folder) for file in files]
    template = text_template("first_study.toml.jinja")
    return template.render(table=table, files=places, clocks=CLOCKS)


def _relative(file: Path, folder: Path) -> str:
    """The file as the study's folder calls it; absolute where that was meant."""
    place = folder.resolve()
    if file.resolve().is_relative_to(place):
        return file.resolve().relative_to(place).as_posix()
    if file.is_absolute():
        return file.as_posix()
    return Path(os.path.relpath(file, folder)).as_posix()

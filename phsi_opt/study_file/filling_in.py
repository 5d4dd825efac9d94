"""What a person fills in: the text of a first study file, and what stands empty in one.

What must be filled in is a complaint of `reading`; the templates decide what is told.
"""

import os
import re
from pathlib import Path

from phsi_opt.study_file.complaints import Complaints, TooManyComplaintsError
from phsi_opt.study_file.keys import usable
from phsi_opt.study_file.reading import tables_of
from phsi_opt.study_file.sections import DataSection
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
    place = Path(os.path.relpath(file.resolve(), folder.resolve()))
    is_outside = place.parts[0] == os.pardir
    return (file if is_outside and file.is_absolute() else place).as_posix()


def unfilled(path: Path, has_dates: bool = False) -> tuple[str, ...]:
    """What stands empty, a sentence each, with an example.

    Args:
        path: of the study file.
        has_dates: whether the times are dates, which are read in seconds.

    Raises:
        StudyFileError: it cannot be read, or is no TOML.
    """
    try:
        tables = tables_of(path)
        file = usable(tables, Complaints(tables))
    except TooManyComplaintsError:
        return ()
    model = file.get("model", {})
    formulas = [model.get(name) for name in ("H", "R", "F", "sensor")]
    words = re.findall(r"\w+", str([*formulas, file.get("effects")]))
    text = text_template("unfilled.txt.jinja").render(
        file=file,
        idle=[name for name in model.get("inputs", ()) if name not in words],
        without_unit=_without_unit(DataSection.of(file.get("data", {})), has_dates),
    )
    return tuple(text.splitlines())


def _without_unit(data: DataSection, has_dates: bool) -> list[str]:
    """Channels without a unit; these are printed beside numbers, no more."""
    channels = {**data.states, **data.inputs}
    without = [name for name, one in channels.items() if not one.unit]
    if data != DataSection() and not has_dates and not data.time.unit:
        without.insert(0, "the time")
    return without

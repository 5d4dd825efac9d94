"""The text of a first study file: what a table shows, and where the physics goes.

What only a person knows stands there empty; `StudyFile.read` then says what is missing.
"""

import os
from pathlib import Path
from typing import Any

from phsi_opt.study_file.columns import (
    DATES,
    INPUT,
    RUN,
    STATE,
    TIME,
    UNUSED,
    Column,
)
from phsi_opt.study_file.survey import TableSurvey
from phsi_opt.study_file.toml_text import key_text, toml_value

TEMPLATE = Path(__file__).with_name("templates") / "first_study.toml.jinja"
# From 2000 to 2050 as clocks count it: the unit, with its first and last number.
CLOCKS = {
    "days, as spreadsheets count them": ("d", 36526, 54789),
    "seconds since 1970": ("s", 946684800, 2524608000),
    "milliseconds since 1970": ("ms", 946684800e3, 2524608000e3),
    "microseconds since 1970": ("us", 946684800e6, 2524608000e6),
}


def first_text(table: TableSurvey, files: list[Path], folder: Path) -> str:
    """The study file for a table.

    Args:
        table: what was seen in the first file.
        files: all of them.
        folder: that of the study file.
    """
    from jinja2 import Environment, StrictUndefined

    def described(column: Column) -> str:
        content = {"column": column.column, "unit": column.unit}
        if column.part == TIME:
            content["unit"] = "s" if column.said == DATES else column.unit
            content["date_format"] = column.date_format
        return toml_value({name: told for name, told in content.items() if told})

    environment = Environment(
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
        autoescape=False,  # this is no page
    )
    environment.filters |= {"toml": toml_value, "key": key_text, "described": described}
    text = environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        table=table,
        files=[_relative(file, folder) for file in files],
        several=len(files) > 1 or bool(table.of_part(RUN)),
        **_parts(table),
    )
    return str(text)


def _parts(table: TableSurvey) -> dict[str, Any]:
    """What the text tells of the table's columns."""
    times = table.of_part(TIME)
    states = table.of_part(STATE)
    left_out = [(one.column, one.said) for one in table.of_part(UNUSED) if one.column]
    left_out += [(variable.name, variable.said) for variable in table.table.further]
    n_lines = table.n_lines // table.n_runs
    dated = any(time.said == DATES for time in times)
    is_asked = bool(times) and not dated and not times[0].unit
    return {
        "runs": table.of_part(RUN),
        "times": times,
        "states": states,
        "inputs": table.of_part(INPUT),
        "perhaps": [state for state in states if state.may_be_input],
        "left_out": [(" ".join(name.split()), said) for name, said in left_out],
        "length": f"{n_lines} lines{'' if table.n_runs == 1 else ' in a run'}",
        "dated": dated,
        "unit_asked": f"; {_unit_asked(table.span)}" if is_asked else "",
    }


def _unit_asked(span: tuple[float, float] | None) -> str:
    """A question for the unit of times that tell none, with what they look like."""
    for what, (unit, first, last) in CLOCKS.items():
        if span is not None and first <= span[0] < span[1] <= last:
            return f'are they {what}? add unit = "{unit}", or the right one'
    return 'in seconds? add unit = "s"'


def _relative(file: Path, folder: Path) -> str:
    """The file as the study's folder calls it; absolute where that was meant."""
    place = folder.resolve()
    if file.resolve().is_relative_to(place):
        return file.resolve().relative_to(place).as_posix()
    if file.is_absolute():
        return file.as_posix()
    return Path(os.path.relpath(file, folder)).as_posix()

"""What stands empty in a study file and may stay so: told, but no mistake.

What must be filled in is a complaint of `reading`.
"""

import re
from pathlib import Path

from phsi_opt.study_file.complaints import Complaints, TooManyComplaintsError
from phsi_opt.study_file.keys import usable
from phsi_opt.study_file.reading import tables_of
from phsi_opt.study_file.sections import DataSection
from phsi_opt.study_file.toml_text import text_template


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

"""From the text of a study file to its sections, with everything that is wrong in it.

The order: the text and its keys, the model with its formulas, effects and loss, the
data files, and at last what is held out of them. What depends on a part that is wrong
already is not looked at, so that one mistake is told once.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from phsi_opt.data.checks import checked_names
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import Complaint, DataError, ModelError, StudyFileError
from phsi_opt.reading import file_text, why_not_read
from phsi_opt.study_file.complaints import (
    Complaints,
    Part,
    TooManyComplaintsError,
    texts,
)
from phsi_opt.study_file.data_files import check_held_out, check_measurements
from phsi_opt.study_file.effects import check_effects, read_own_effects
from phsi_opt.study_file.keys import usable
from phsi_opt.study_file.model_reading import ModelReader, check_channels
from phsi_opt.study_file.sections import (
    OF_TIME,
    Channel,
    DataSection,
    HeldOut,
    Sections,
    StudySection,
)
from phsi_opt.study_file.toml_text import LARGEST_STUDY, lines_of, toml_tables
from phsi_opt.transcription.losses import MaximumLikelihood

MORE = "So much is wrong that the rest was not looked at."


def read_sections(
    path: Path, places: Mapping[str, Path] | None = None
) -> tuple[Sections, Measurements]:
    """Everything that a study file says, and all its measurements.

    Args:
        path: of the study file.
        places: where data files lie that are not where it says, by their names in it.

    Raises:
        StudyFileError: something in it, or in its data files, cannot be used; with all
            that is wrong.
    """
    text, tables = _read(path)
    found = Complaints()
    try:
        read = _sections(tables, found, path.parent, places or {})
    except TooManyComplaintsError:
        read = None
    if read is None or found.listed:
        raise StudyFileError(path, _told(found, lines_of(text)))
    return read


def _sections(
    tables: dict[str, Any], found: Complaints, folder: Path, places: Mapping[str, Path]
) -> tuple[Sections, Measurements] | None:
    file = Part("", usable(tables, found), found)
    reader = ModelReader.of(file)
    data = replace(_data(file), places=places)
    held_out = _held_out(file)
    own = read_own_effects(file, reader)
    model = reader.model(file)
    steps = _steps(file)
    loss = _loss(file)
    if model is not None:
        check_channels(model, data, found)
        if not found.about("effects"):
            check_effects(steps, model, own, data.units, found)
    measured = check_measurements(data, folder, found)
    if measured is not None and held_out is not None and not found.about("held_out"):
        check_held_out(held_out, measured, file)
    if model is None or measured is None:
        return None
    sections = Sections(
        base=model,
        data=data,
        held_out=held_out,
        steps=steps,
        own_effects=own,
        loss=loss,
    )
    return sections, measured


def _told(found: Complaints, lines: Mapping[str, int]) -> list[Complaint]:
    """The complaints with their lines, in the order of the file."""
    listed = []
    for complaint in found.listed:
        key = complaint.key
        while key and key not in lines:  # of the table that lacks it
            key = key.rpartition(".")[0]
        listed.append(replace(complaint, line=lines.get(key)))
    listed.sort(key=lambda complaint: complaint.line or LARGEST_STUDY)
    return [*listed, Complaint("", "", MORE)] if found.is_full else listed


def tables_of(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        StudyFileError: it cannot be read, or is no TOML.
    """
    return _read(path)[1]


def _read(path: Path) -> tuple[str, dict[str, Any]]:
    """The text and the tables of a TOML file."""
    try:
        text = file_text(path, LARGEST_STUDY)
        return text, toml_tables(text)
    except FileNotFoundError:
        said = "there is no such file; phsi-opt init DATA.csv writes one."
    except UnicodeDecodeError as error:
        byte = error.object[error.start]
        line = error.object[: error.start].count(b"\n") + 1
        said = f"line {line} is not UTF-8 text (byte {byte:#04x}); save it as UTF-8."
    except ValueError as error:
        said = f"this is not TOML: {error}. Texts stand in quotes, tables as [name]."
    except OSError as error:
        said = f"it cannot be read: {why_not_read(error)}."
    raise StudyFileError(path, [Complaint("", "", said)])


# ---- the sections about measurements -------------------------------------------------


def _data(file: Part) -> DataSection:
    data = file.part("data")
    if not data.content:
        file.need("data", "there is no section [data]; it names files and columns.")
    else:
        data.need("files", 'expected the data file(s), such as ["bench.csv"].')
        data.need(
            "states",
            "expected a table for each state, such as "
            'q = { column = "q", unit = "m" }.',
        )
    plain: dict[str, Any] = {}
    for name, value in data.content.items():
        if value and not isinstance(value, dict):
            plain[name] = tuple(value) if isinstance(value, list) else value
    for name in ("files", "columns"):
        plain[name] = texts(plain.get(name, ()))
    plain["columns"] = plain["columns"] or None
    return DataSection(
        **plain,
        **_time(data),
        states=_channels(data, "states"),
        inputs=_channels(data, "inputs"),
    )


def _time(data: Part) -> dict[str, Any]:
    """What the section says of the times: a column, dates, or a step."""
    part = data.part("time")
    if part.get("column", "") != "" and part.is_told("step"):
        part.complain("step", "there is a column too; keep one of the two.")
    if data.content and not part.is_told("step"):
        part.need(
            "column",
            'expected the column of the times, such as "t_s"; where no column has '
            "them, the time between lines: time = { step = 0.01 }.",
        )
    told = {name: part.content[name] for name in OF_TIME if name in part.content}
    if not told.get("start", True):
        told.pop("start")
    return {"time": _channel(part), **told}


def _channel(part: Part) -> Channel:
    column = part.get("column", "")
    unmeasured = column == "" or not part.get("measured", True)
    column = None if unmeasured else column
    return Channel(column, part.get("unit", ""), hold=part.get("hold", None))


def _channels(data: Part, what: str) -> dict[str, Channel]:
    channels = {}
    section = data.part(what)
    for name in section.content:
        part = section.part(name)
        try:
            checked_names([name], what)
        except DataError as error:
            data.complaints.add(part.key, error)
            continue
        if part.get("measured", True) is True:
            otherwise = " (or measured = false)" if what == "states" else ""
            part.need("column", f"expected the name of a column{otherwise}.")
        elif part.is_told("column"):
            part.complain("measured", "there is a column too; keep one of the two.")
        channels[name] = replace(_channel(part), noise=part.get("noise"))
    return channels


def _held_out(file: Part) -> HeldOut | None:
    """The section [held_out]; None where there is none, or it cannot be used."""
    if not file.is_told("held_out"):
        return None
    part = file.part("held_out")
    way = part.exactly_one("runs", "share", "after")
    told = {name: value for name, value in part.content.items() if name == way}
    if "runs" in told:
        told["runs"] = texts(told["runs"])
    return HeldOut(**told) if told else None


# ---- how to go on --------------------------------------------------------------------


def _steps(file: Part) -> StudySection:
    plain: dict[str, Any] = dict(file.part("study").content)
    for name in ("added", "effects", "without"):
        if name in plain:
            plain[name] = texts(plain[name])
    return StudySection(**plain)


def _loss(file: Part) -> MaximumLikelihood:
    """The loss; what is wrong is noted, and the default taken."""
    part = file.part("loss")
    for name in part.content:
        try:  # each by itself: it may be out of its range whatever the others are
            MaximumLikelihood(**{name: part.content[name]})
        except ModelError as error:
            part.complain(name, error)
    try:
        return MaximumLikelihood(**part.content)
    except ModelError as error:  # settings that do not go together
        if not file.complaints.about("loss"):
            file.complain("loss", error)
        return MaximumLikelihood()

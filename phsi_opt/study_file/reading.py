"""From the text of a study file to its sections, with everything that is wrong in it.

The order: the text and its keys, the model with its formulas, effects and loss, the
data files, and at last what is held out of them. What depends on a part that is wrong
already is not looked at, so that one mistake is told once.
"""

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from phsi_opt.data.checks import checked_names
from phsi_opt.data.file_opening import run_names
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.table_readers import TableError
from phsi_opt.errors import MOST_OF_A_KEY, Complaint, StudyFileError
from phsi_opt.model.catalogue import EffectChoice, effect_named
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.model.unit_checks import UnitCheck
from phsi_opt.presentation.units import in_si
from phsi_opt.reading import file_text
from phsi_opt.study_file.keys import (
    Complaints,
    Place,
    TooManyComplaintsError,
    is_number,
    usable,
)
from phsi_opt.study_file.model_reading import ModelReader, check_channels
from phsi_opt.study_file.sections import (
    DataSection,
    HeldOut,
    Sections,
    StudySection,
    own_effect,
    parts_of,
    reader_of,
    table_at,
)
from phsi_opt.study_file.toml_text import LARGEST_STUDY, lines_of, tables_of
from phsi_opt.transcription.losses import MaximumLikelihood

NEEDED = {
    ("data",): "the section [data] is missing; it names files and columns.",
    ("data", "files"): 'expected the data file(s), such as ["bench.csv"].',
    ("data", "states"): (
        'expected a table for each state, such as q = { column = "q", unit = "m" }.'
    ),
    ("model",): "the section [model] is missing; it contains the equations.",
    ("model", "states"): 'expected the names of the states, such as ["q", "p"].',
}
KEPT_APART = ("held_out", "final")  # sections of data that are not fitted
KEEP_ONE = "a column is given, too; keep one of the two."
MORE = "There are too many mistakes; the rest of the file was not checked."


def read_sections(
    path: Path, places: Mapping[str, Path] | None = None
) -> tuple[Sections, Measurements]:
    """Everything that a study file says, and all its measurements."""
    faults = Complaints(tables_of(path))
    sections = measured = None
    with suppress(TooManyComplaintsError):
        sections, measured = _sections(faults, path.parent, places or {})
    if sections is None or measured is None or faults.listed:
        raise StudyFileError(
            path, _in_order(faults, lines_of(file_text(path))), measured
        )
    return sections, measured


def _sections(
    faults: Complaints, folder: Path, places: Mapping[str, Path]
) -> tuple[Sections | None, Measurements | None]:
    """The sections without a fault, and the measurements; None: something is wrong."""
    file = usable(faults.content, faults)
    for (section, *names), said in NEEDED.items():
        if not names:
            faults.need(said, faults.content.get(section), section)
        elif file.get(section):
            faults.need(said, file[section].get(*names), section, *names)
    reader = ModelReader.of(file, faults)
    _check_data(file.get("data", {}), faults)
    data = DataSection.of(file.get("data", {}), places)
    kept: dict[str, HeldOut | None] = dict.fromkeys(KEPT_APART)
    for part in filter(file.__contains__, KEPT_APART):
        kept[part] = HeldOut(**file[part])
        faults.exactly_one(file[part], ("runs", "share", "after"), part)
    own = reader.effects()
    model = reader.model()
    steps = StudySection(**file.get("study", {}))
    loss = _loss(file.get("loss", {}), faults)
    measured = None if faults.about("data") else _measurements(data, folder, faults)
    if model is not None:
        check_channels(model, data, faults)
    if model is not None and not faults.about("effects"):
        units = data.units if measured is None else measured.units
        _check_effects(steps, model, own, units, faults)
    if measured is not None and model is not None and not faults.about("data"):
        _check_units(model, measured, faults)
    if measured is not None and not any(map(faults.about, KEPT_APART)):
        _check_parts(measured, kept, faults)
    if model is None:
        return None, measured
    parts: dict[str, Any] = {"base": model, "data": data, **kept}
    return Sections(**parts, steps=steps, own_effects=own, loss=loss), measured


def _measurements(
    section: DataSection, folder: Path, faults: Complaints
) -> Measurements | None:
    """The measurements; None, and what is wrong noted, where they cannot be read."""
    paths = section.paths(folder)
    names: list[str] = []
    with faults.noting("data", "files"):
        names = run_names(paths)
    tables = []
    for number, name in enumerate(names):
        path = paths[number]
        place: Place = ("data", "files", *([number] if len(names) > 1 else []))
        if not os.path.exists(path):  # nor where its name is too long
            said = "there is no such file; paths are relative to the study file."
            faults.add(said, *place)
        elif reader_of(path) != section.reader:
            suffix = paths[0].suffix.lower()
            faults.add(
                f"the first file is {suffix}; all files must be of the same kind.",
                *place,
            )
        else:
            with faults.noting(*place):
                tables.append(replace(table_at(path, section), run=name))
    if not tables:
        return None
    with faults.noting("data", value=""):
        try:
            return section.measured(tables)
        except TableError as error:
            for part, fault in error.by_part.items():
                faults.add(fault, "data", *part)
    return None


def _in_order(faults: Complaints, lines: Mapping[str, int]) -> list[Complaint]:
    """The complaints with their lines, in the order of the file."""
    listed = []
    for complaint in faults.listed:
        key = complaint.key
        while key and key not in lines:  # of the table that lacks it
            key = key.rpartition(".")[0]
        listed.append(replace(complaint, line=lines.get(key)))
    listed.sort(key=lambda complaint: complaint.line or LARGEST_STUDY)
    return [*listed, Complaint("", "", MORE)] if faults.is_full else listed


# ---- rules that need more than one key -----------------------------------------------


def _check_parts(
    data: Measurements, kept: Mapping[str, HeldOut | None], faults: Complaints
) -> None:
    """Note runs that are unknown, and parts of the data that cannot be."""
    known = {part: one for part, one in kept.items() if one is not None}
    for part, one in known.items():
        for run in one.runs or ():
            with faults.noting(part, "runs", value=run):
                data.trajectory_number(run)
    if known and not any(map(faults.about, known)):
        with faults.noting(next(iter(known))):
            parts_of(data, kept["held_out"], kept["final"])


def _check_data(data: Mapping[str, Any], faults: Complaints) -> None:
    if not data:
        return
    place = ("data", "time")
    time = data.get("time", {})
    if "step" not in time and not faults.about(*place, "step"):
        said = (
            'expected the column of the times, such as "t_s", or the time between '
            "lines: time = { step = 0.01 }."
        )
        faults.need(said, time.get("column"), *place, "column")
    elif time.get("column", "") != "":
        faults.add(KEEP_ONE, *place, "step")
    for what, otherwise in (("states", " (or measured = false)"), ("inputs", "")):
        for name, channel in data.get(what, {}).items():
            channel_place = ("data", what, name)
            with faults.noting(*channel_place, value=""):
                checked_names([name], what)
            if not channel.get("measured", True):
                if "column" in channel:
                    faults.add(KEEP_ONE, *channel_place, "measured")
            elif not faults.about(*channel_place, "measured"):
                said = f"expected the name of a column{otherwise}."
                faults.need(said, channel.get("column"), *channel_place, "column")


def _loss(settings: Mapping[str, Any], faults: Complaints) -> MaximumLikelihood:
    """The loss; what is wrong is noted, and the default taken."""
    for name, value in settings.items():
        with faults.noting("loss", name):  # whatever the others are
            MaximumLikelihood(**{name: value})
    if not faults.about("loss"):
        with faults.noting("loss"):  # settings that do not go together
            return MaximumLikelihood(**settings)
    return MaximumLikelihood()


def _check_units(model: Model, data: Measurements, faults: Complaints) -> None:
    """Note units that contradict each other, and numbers whose unit is not clear."""
    units = dict(data.units)
    if not units["t"] and in_si({**units, "t": "s"}) != {**units, "t": "s"}:
        said = (
            'expected the unit of the times, such as unit = "s": without it values in '
            "other units than those of SI cannot be converted."
        )
        faults.need(said, units["t"], "data", "time", "unit")
    check = UnitCheck(model, units, as_written=True)
    parameters = faults.content.get("parameters", {})
    first = check.negative or check.contradiction
    for fault in [first] if first else check.numbers_without_unit:
        place: Place = ("model", *filter(None, (fault.slot, fault.equation)))
        unit = () if fault.value is None or is_number(fault.value) else ("unit",)
        if fault.name == "t":
            place = ("data", "time", *unit)
        elif fault.name in parameters:
            place = ("parameters", fault.name, *unit)
        elif fault.name:
            part = "states" if fault.name in data.states else "inputs"
            place = ("data", part, fault.name, *unit)
        faults.add(fault.said, *place, value="" if fault.slot else fault.value)


def _check_effects(
    steps: StudySection,
    model: Model,
    own: Sequence[Effect],
    units: Mapping[str, str],
    faults: Complaints,
) -> None:
    """Note every name of the section [study] that stands for no effect."""
    larger = model
    for name in steps.added:
        if faults.about("study", "added"):
            break  # the model to which the others are added is not known
        with faults.noting("study", "added", value=name):
            effect = own_effect(name, own) or effect_named(larger, name, units=units)
            larger = larger.add(effect)
    for key in ("effects", "without"):
        names = [one for one in getattr(steps, key) or () if not own_effect(one, own)]
        for name in dict.fromkeys(names):
            wrong = [one for one in faults.listed if one.key == f"study.{key}"]
            if len(wrong) == MOST_OF_A_KEY:  # a message shows no more
                break
            with faults.noting("study", key, value=name):
                EffectChoice(**{key: (name,)}).checked(model, units)

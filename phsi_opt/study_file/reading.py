"""From the text of a study file to its parts, with everything that is wrong in it.

The order: the text, the model with its formulas, effects and loss, the data files, and
at last what is held out of them. What depends on a part that is wrong already is not
looked at, so that one mistake is told once.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import Complaint, StudyFileError
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.reading import file_text, why_not_read
from phsi_opt.study_file.data_reading import (
    check_held_out,
    check_measurements,
    read_data,
    read_held_out,
)
from phsi_opt.study_file.effect_reading import (
    StudySection,
    check_effects,
    read_own_effects,
    read_study,
)
from phsi_opt.study_file.loss_reading import read_loss
from phsi_opt.study_file.model_reading import check_channels, read_model, read_names
from phsi_opt.study_file.part import Complaints, Part, TooManyComplaintsError
from phsi_opt.study_file.sections import DataSection, HeldOut
from phsi_opt.study_file.toml_tables import LARGEST_STUDY, toml_tables
from phsi_opt.transcription.losses import MaximumLikelihood


@dataclass(frozen=True)
class Contents:
    """What a study file says, with the measurements that it names.

    Attributes:
        data: the section [data].
        held_out: the section [held_out]; None where there is none.
        model: the base model.
        own_effects: the sections [[effects]].
        study: the section [study].
        loss: the section [loss].
        measurements: of all files, training and held out.
    """

    data: DataSection
    held_out: HeldOut | None
    model: Model
    own_effects: tuple[Effect, ...]
    study: StudySection
    loss: MaximumLikelihood
    measurements: Measurements


def read_contents(path: Path, places: Mapping[str, Path] | None = None) -> Contents:
    """Everything that a study file says.

    Args:
        path: of the study file.
        places: where data files lie that are not where it says, by their names in it.

    Raises:
        StudyFileError: something in it, or in its data files, cannot be used; with all
            that is wrong.
    """
    found = Complaints()
    file = Part("", tables_of(path), found)
    try:
        return _contents(file, path, places or {})
    except TooManyComplaintsError:
        more = Complaint("", "", "So much is wrong that the rest was not looked at.")
        listed = [*_in_order(found.listed, list(file.content)), more]
        raise StudyFileError(path, listed) from None


def _contents(file: Part, path: Path, places: Mapping[str, Path]) -> Contents:
    found = file.complaints
    file.check_known("")
    names = read_names(file)
    data = replace(read_data(file), places=places)
    held_out = read_held_out(file)
    own_effects = read_own_effects(file, names)
    model = read_model(file, names)
    study = read_study(file)
    loss = read_loss(file)
    if model is not None:
        check_channels(model, data, found)
        check_effects(file, model, own_effects, data.units)
    measured = check_measurements(data, path.parent, found)
    if measured is not None and not found.about("held_out"):
        check_held_out(held_out, measured, file.content, found)
    if found.listed or model is None or measured is None:
        raise StudyFileError(path, _in_order(found.listed, list(file.content)))
    return Contents(data, held_out, model, own_effects, study, loss, measured)


def _in_order(listed: list[Complaint], sections: list[str]) -> list[Complaint]:
    """The complaints in the order of the file's sections; what is missing last."""

    def place(complaint: Complaint) -> int:
        section = re.split(r"[.\[]", complaint.key)[0]
        return sections.index(section) if section in sections else len(sections)

    return sorted(listed, key=place)


def tables_of(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        StudyFileError: it cannot be read, or is no TOML.
    """
    try:
        return toml_tables(file_text(path, LARGEST_STUDY))
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

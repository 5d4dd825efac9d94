"""A model in a file, to begin a study with: ``phsi-opt init data.csv --model FILE``.

A file is data, and nothing in it is run. One that ends in .toml is a study file, of
which the model and its parameters are taken, or has a diagram of blocks::

    [blocks]
    m = "mass: x"
    k = "spring: x, ground"
    u = "force: x, ground"

    [parameters]
    m = 2.5
    k = { start = 10.0, lower = 0 }

One that ends in .json is a fit that `Fit.save` wrote, such as that of a model of SymPy;
its estimates are the starting values.
"""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from phsi_opt.errors import Complaint, PhsiOptError, StudyFileError
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.blocks import blocks
from phsi_opt.model.model import Model
from phsi_opt.presentation.units import scale_of
from phsi_opt.study_file.gallery import OR_ANY, BaseModel
from phsi_opt.study_file.keys import Complaints, TooManyComplaintsError, usable
from phsi_opt.study_file.model_reading import ModelReader
from phsi_opt.study_file.study_text import model_sections
from phsi_opt.study_file.toml_text import tables_of

FIT_KIND = ".json"


def model_alone_in(path: Path) -> BaseModel | None:
    """That of a TOML file without data; None: it is a study file."""
    return None if "data" in tables_of(path) else base_model_in(path)


def base_model_in(path: Path) -> BaseModel:
    """The model of a file, as an entry of the gallery; columns find it by their names.

    Raises:
        DataError: the file has no model, or something in it is wrong.
    """
    if path.suffix.lower() == FIT_KIND:
        fit = Fit.load(path)
        model, parameters = model_sections(fit.model)
        for name, unit in fit.parameter_units.items():
            known = parameters.get(name, {})
            known = known if isinstance(known, dict) else {"value": known}
            if name in parameters and unit and "unit" not in known:
                parameters[name] = {**known, "unit": scale_of(unit).unit}
        return _entry(path, model, parameters, fit.units)
    tables = tables_of(path)
    if "blocks" in tables:
        return _entry(path, *model_sections(_of_blocks(path, tables)), {})
    parts = ("model", "parameters", "effects")
    content = {name: tables[name] for name in parts if name in tables}
    _, found = _read(path, {"model": {}, **content})
    assert found is not None  # what is wrong was raised
    data = {"data": tables.get("data", {})}
    channels = usable(data, Complaints(data)).get("data", {})
    units = {}
    for part in ("states", "inputs"):
        for name, channel in channels.get(part, {}).items():
            units[name] = channel.get("unit", "")
    return _entry(path, *model_sections(found), units)


def _of_blocks(path: Path, tables: Mapping[str, Any]) -> Model:
    reader, _ = _read(path, {"parameters": tables.get("parameters", {})})
    parameters: dict[str, Any] = reader.parameters
    try:
        found = blocks(tables["blocks"], tables.get("positions", []), **parameters)
    except (PhsiOptError, TypeError) as error:
        raise StudyFileError(path, [Complaint("blocks", "", str(error))]) from None
    return found.model


def _read(path: Path, content: Mapping[str, Any]) -> tuple[ModelReader, Model | None]:
    """Parameters, and the model if there is a section of it; all of it is valid."""
    faults = Complaints(content)
    with suppress(TooManyComplaintsError):
        reader = ModelReader.of(usable(content, faults), faults)
        reader.effects()  # which may use parameters that the model does not
        model = reader.model()
        if "model" in content and model is None:
            said = 'expected [model], or [blocks] such as m = "mass: x".'
            faults.need(said, content["model"], "model")
    if faults.listed:
        raise StudyFileError(path, faults.listed)
    return reader, model


def _entry(
    path: Path,
    model: Mapping[str, Any],
    parameters: Mapping[str, Any],
    units: Mapping[str, str],
) -> BaseModel:
    """These sections, with the units of the channels that are known."""
    parts = dict(model)
    inputs = {}
    for name in parts.pop("inputs", ()):
        inputs[name] = {"unit": units.get(name, "") + OR_ANY}
    states = {}
    for name in parts["states"]:
        if name not in parts.get("memory", ()):
            states[name] = units.get(name, "") + OR_ANY
    return BaseModel(
        name=path.stem,
        title=path.stem,
        about="",
        equation=f"from {path.name}",
        states=states,
        model=parts,
        parameters=parameters,
        inputs=inputs,
        is_named=True,
    )

"""The text of a study file: TOML with a comment for each section."""

from collections.abc import Mapping, Sequence
from typing import Any

from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.study_file.content import effect_content, loss_content, model_content
from phsi_opt.study_file.effect_reading import StudySection
from phsi_opt.study_file.keys import DEFAULT_MAX_STEPS
from phsi_opt.study_file.sections import Channel, DataSection, HeldOut
from phsi_opt.study_file.toml_text import key_text, toml_value
from phsi_opt.transcription.losses import MaximumLikelihood

TEXT_WIDTH = 88  # of a line, where a list can be broken
HEAD = """\
# A study of phsi_opt: what was measured, what is known, which effects were added.
# `phsi-opt check` reads it; docs/command_line.md lists every key.
"""
ABOUT_DATA = "Files and columns; paths are relative to this file."
ABOUT_STATES = "What was measured: column, unit, and, where it is known, the noise."
ABOUT_INPUTS = "Inputs, known at every sample."
ABOUT_HELD_OUT = "Kept from fitting, to judge by."
ABOUT_MODEL = "dx/dt = (S - R) grad H + F; names in formulas are states, inputs, t,"
ABOUT_EFFORTS = "efforts such as dH_dp, and the parameters below."
ABOUT_FIRST_ORDER = "dx/dt = F - R x; names in formulas are states, inputs, t and the"
ABOUT_PARAMETERS = "A number is a known value; start is where the search begins."
ABOUT_EFFECT = "An effect that is not in the catalogue."
ABOUT_STUDY = "Effects added so far, the oldest first; those to consider, or leave out."
ABOUT_LOSS = "How to fit."


def study_text(
    data: DataSection,
    held_out: HeldOut | None,
    model: Model,
    own_effects: Sequence[Effect],
    study: StudySection,
    loss: MaximumLikelihood,
) -> str:
    """The whole file.

    Raises:
        ModelError: a part has something that a study file cannot hold.
    """
    sections = [
        HEAD,
        *data_sections(data),
        _held_out_section(held_out),
        *_model_sections(model, own_effects),
    ]
    for effect in own_effects:
        sections.append(section("[effects]", effect_content(effect), ABOUT_EFFECT))
    sections.append(section("study", _study_content(study), ABOUT_STUDY))
    sections.append(section("loss", loss_content(loss), ABOUT_LOSS))
    return "\n".join(filter(None, sections))


def section(name: str, content: Mapping[str, Any], *about: str) -> str:
    """A table with its comments; nothing where it is empty."""
    if not content:
        return ""
    lines = [f"# {line}" for line in about]
    lines.append(f"[{name}]")
    for key, value in content.items():
        lines.append(_entry(key, value))
    return "\n".join(lines) + "\n"


def _entry(key: str, value: Any) -> str:
    """A key and its value; a list that is too long for a line has lines of its own."""
    line = f"{key_text(key)} = {toml_value(value)}"
    if len(line) <= TEXT_WIDTH or not isinstance(value, list):
        return line
    items = [f"    {toml_value(one)}," for one in value]
    return "\n".join([f"{key_text(key)} = [", *items, "]"])


def data_sections(data: DataSection) -> list[str]:
    """The sections about the measurements."""
    content: dict[str, Any] = {"files": list(data.files)}
    if data.trajectory is not None:
        content["trajectory"] = data.trajectory
    if data.inputs:
        content["hold"] = data.hold
    for name in ("sheet", "columns", "separator", "decimal", "between", "thinned"):
        if getattr(data, name) is not None:
            content[name] = getattr(data, name)
    content["time"] = _time_content(data)
    states = {name: _channel_content(one) for name, one in data.states.items()}
    inputs = {name: _channel_content(one) for name, one in data.inputs.items()}
    return [
        section("data", content, ABOUT_DATA),
        section("data.states", states, ABOUT_STATES),
        section("data.inputs", inputs, ABOUT_INPUTS),
    ]


def _time_content(data: DataSection) -> dict[str, Any]:
    content = {} if data.time.column is None else _channel_content(data.time)
    if data.time.column is None and data.time.unit:
        content["unit"] = data.time.unit
    for name in ("step", "start", "date_format"):
        if getattr(data, name) is not None:
            content[name] = getattr(data, name)
    return content


def _channel_content(channel: Channel) -> dict[str, Any]:
    content: dict[str, Any] = {"column": channel.column}
    if channel.column is None:
        content = {"measured": False}
    if channel.unit:
        content["unit"] = channel.unit
    if channel.noise is not None:
        content["noise"] = channel.noise
    return content


def _held_out_section(held_out: HeldOut | None) -> str:
    if held_out is None:
        return ""
    content: dict[str, Any] = {}
    if held_out.runs is not None:
        content["runs"] = list(held_out.runs)
    elif held_out.after is not None:
        content["after"] = held_out.after
    else:
        content["share"] = held_out.share
    return section("held_out", content, ABOUT_HELD_OUT)


def _model_sections(model: Model, own_effects: Sequence[Effect]) -> list[str]:
    content = model_content(model, own_effects)
    about = (ABOUT_MODEL, ABOUT_EFFORTS)
    if not model.has_energy:
        about = (ABOUT_FIRST_ORDER, "parameters below.")
    sections = [section("model", content.head, *about)]
    for slot, by_equation in content.slots.items():
        sections.append(section(f"model.{slot}", by_equation))
    sections.append(section("parameters", content.parameters, ABOUT_PARAMETERS))
    return sections


def _study_content(study: StudySection) -> dict[str, Any]:
    content: dict[str, Any] = {"added": list(study.added)}
    if study.effects is not None:
        content["effects"] = list(study.effects)
    if study.without:
        content["without"] = list(study.without)
    if study.max_steps != DEFAULT_MAX_STEPS:
        content["max_steps"] = study.max_steps
    return content

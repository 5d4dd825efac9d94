"""Drafts as the text of a study file.

``draft_reading`` goes the other way.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from phsi_opt.page.drafts import (
    AFTER,
    FIRST_ORDER,
    INPUT,
    RUN,
    RUNS,
    SHARE,
    STATE,
    TIME,
    ColumnDraft,
    DataDraft,
    ModelDraft,
    ParameterDraft,
)
from phsi_opt.study_file.study_text import text_of
from phsi_opt.study_file.toml_text import toml_tables

Content = dict[str, Any]


@dataclass(frozen=True)
class Drafted:
    """A draft as it was at one time, such as that of a fit.

    Attributes:
        text: the study file.
        places: where its data files lie, by name. No two uploads have one place.
    """

    text: str
    places: dict[str, Path]


@dataclass
class StudyDraft:
    """All that a user has filled in.

    Attributes:
        data: files and columns; None before there is a file.
        model: the base model.
        added: effects that a study file had already.
        kept: sections that the page does not show.
    """

    data: DataDraft | None = None
    model: ModelDraft = field(default_factory=ModelDraft)
    added: list[str] = field(default_factory=list)
    kept: Content = field(default_factory=dict)

    def as_it_is(self) -> Drafted:
        """What is filled in now."""
        return Drafted(self.text(), self.places)

    @property
    def places(self) -> dict[str, Path]:
        """Where each file of the data lies, by its name."""
        return {} if self.data is None else dict(self.data.places)

    def text(self) -> str:
        """The study file; it calls its data files as their owner does."""
        return text_of(self.content())

    def content(self) -> Content:
        """The tables of the study file."""
        content: Content = dict(self.kept)
        if self.data is not None:
            content["data"] = _data(self.data, self.model)
            content["held_out"] = _held_out(self.data)
        content["model"] = _model(self.model)
        parameters = {}
        for one in self.model.parameters:
            if one.name:
                parameters[one.name] = _parameter(one)
        content["parameters"] = parameters
        study = dict(self.kept.get("study", {}))
        content["study"] = {**study, "added": list(self.added)}
        return content


def _data(draft: DataDraft, model: ModelDraft) -> Content:
    content: Content = {"files": draft.files, **draft.further}
    for column in draft.with_role(RUN):
        content["trajectory"] = column.column
    inputs = _channels(draft, INPUT)
    if inputs:
        content["hold"] = draft.hold
    if draft.averaged:
        content["thinned"] = _whole(draft.averaged)
    content["time"] = _time(draft)
    states = _channels(draft, STATE)
    for name in model.state_names:
        if name not in states:
            states[name] = {"measured": False}
            if draft.unmeasured.get(name):
                states[name]["unit"] = draft.unmeasured[name]
    content["states"] = states
    if inputs:
        content["inputs"] = inputs
    return content


def _time(draft: DataDraft) -> Content:
    """The column of the times, or the time between lines."""
    for column in draft.with_role(TIME):
        return {**_channel(column), **draft.further_of_time}
    step = {"step": _number(draft.step)} if draft.step else {}
    return {**step, **draft.further_of_time}


def _channels(draft: DataDraft, role: str) -> Content:
    return {one.name or str(one.column): _channel(one) for one in draft.with_role(role)}


def _channel(column: ColumnDraft) -> Content:
    content: Content = {"column": column.column}
    if column.unit:
        content["unit"] = column.unit
    if column.noise and column.role == STATE:
        content["noise"] = _number(column.noise)
    return content


def _number(text: str) -> Any:
    """The number; the text itself where it is none, so that reading refuses it."""
    try:
        return float(text.strip())
    except ValueError:
        return text


def _whole(text: str) -> Any:
    """The whole number; the text itself where it is none, as reading refuses that."""
    try:
        return int(text.strip())
    except ValueError:
        return text


def _held_out(draft: DataDraft) -> Content:
    held_out = draft.held_out
    if held_out.way == SHARE:
        return {"share": _number(held_out.share)}
    if held_out.way == AFTER:
        return {"after": _number(held_out.after)}
    if held_out.way == RUNS:
        return {"runs": list(held_out.runs)}
    return {}


def _model(draft: ModelDraft) -> Content:
    content: Content = {"type": draft.type, "states": draft.state_names}
    if draft.input_names:
        content["inputs"] = draft.input_names
    content.update(draft.further)
    if draft.type != FIRST_ORDER:
        if "S" not in draft.further:
            content["pairs"] = pairs_in(draft.pairs)
        content["H"] = terms_in(draft.H)
    for slot, formulas in (("R", draft.R), ("F", draft.F)):
        terms = {}
        for name, text in formulas.items():
            if text.strip() and name in draft.state_names:
                terms[name] = terms_in(text)
        if terms:
            content[slot] = terms
    return content


def pairs_in(text: str) -> list[list[str]]:
    """The pairs of states of a text such as "q-p, r-s"."""
    pairs = []
    for pair in re.split(r"[,;\n]", text):
        if pair.strip():
            pairs.append(pair.replace("-", " ").split())
    return pairs


def terms_in(text: str) -> Any:
    """A formula as it is; a table or list of terms as TOML has it."""
    stripped = text.strip()
    if not stripped.startswith(("{", "[")):
        return stripped
    try:
        return toml_tables(f"terms = {stripped}")["terms"]
    except ValueError:
        return stripped


def _parameter(draft: ParameterDraft) -> Any:
    content: Content = dict(draft.further)
    if draft.value:
        content["value" if draft.is_known else "start"] = _number(draft.value)
    elif draft.is_known:
        content["fixed"] = True
    for name, bound in (("lower", draft.lower), ("upper", draft.upper)):
        if bound:
            content[name] = _number(bound)
    if draft.unit:
        content["unit"] = draft.unit
    return content

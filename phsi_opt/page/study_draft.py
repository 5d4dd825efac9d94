"""Drafts as the tables of a study file, and back.

Each part goes both ways here, side by side. What the page does not show (own effects,
the loss, kinds of states) is kept as it was.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from phsi_opt.page.drafts import (
    AFTER,
    FIRST_ORDER,
    INPUT,
    NOT_USED,
    NOTHING,
    RUN,
    RUNS,
    SHARE,
    STATE,
    TIME,
    ColumnDraft,
    DataDraft,
    HeldOutDraft,
    ModelDraft,
    ParameterDraft,
)
from phsi_opt.study_file.keys import listed
from phsi_opt.study_file.study_text import text_of
from phsi_opt.study_file.toml_text import toml_tables, toml_value

Content = dict[str, Any]
HELD_OUT_KEYS = {SHARE: "share", AFTER: "after", RUNS: "runs"}
KEPT = ("effects", "loss")  # sections that the page neither shows nor changes
# Keys of [data] that it shows.
SHOWN = ("files", "trajectory", "hold", "thinned", "time", "states", "inputs")


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

    @classmethod
    def of(cls, content: Mapping[str, Any], data: DataDraft) -> "StudyDraft":
        """The drafts of a study file that has been read without complaint.

        Args:
            content: its tables.
            data: its files, looked at.
        """
        _take_data(content["data"], data)
        data.held_out = _held_out_draft(content.get("held_out", {}))
        study = dict(content.get("study", {}))
        added = list(listed(study.pop("added", ())))
        kept = {name: content[name] for name in KEPT if name in content}
        if study:
            kept["study"] = study
        model = model_draft(content["model"], content.get("parameters", {}))
        return cls(data, model, added, kept)

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
            content["held_out"] = _held_out(self.data.held_out)
        content["model"] = _model(self.model)
        named = [one for one in self.model.parameters if one.name]
        content["parameters"] = {one.name: _parameter(one) for one in named}
        content["study"] = {**self.kept.get("study", {}), "added": list(self.added)}
        return content


def _number(text: str, kind: type[float] = float) -> Any:
    """The number; the text itself where it is none, so that reading refuses it."""
    try:
        return kind(text.strip())
    except ValueError:
        return text


def _written(value: Any) -> str:
    return "" if value is None else f"{value:.12g}"


def _filled(**told: Any) -> Content:
    """What is filled in."""
    return {name: value for name, value in told.items() if value not in ("", None)}


# ---- the measurements ----------------------------------------------------------------


def _data(draft: DataDraft, model: ModelDraft) -> Content:
    content: Content = {"files": draft.files, **draft.further}
    for column in draft.with_role(RUN):
        content["trajectory"] = column.column
    inputs = _channels(draft, INPUT)
    if inputs:
        content |= {"hold": draft.hold, "inputs": inputs}
    if draft.averaged:
        content["thinned"] = _number(draft.averaged, int)
    time = _filled(step=_number(draft.step))
    for column in draft.with_role(TIME):
        time = _channel(column)
    content["time"] = {**time, **draft.further_of_time}
    states = _channels(draft, STATE)
    for name in model.state_names:
        if name not in states:
            unit = draft.unmeasured.get(name, "")
            states[name] = {"measured": False, **_filled(unit=unit)}
    return {**content, "states": states}


def _take_data(content: Mapping[str, Any], data: DataDraft) -> None:
    for column in data.columns:
        column.role = NOT_USED
    data.hold = content.get("hold", data.hold)
    data.averaged = _written(content.get("thinned"))
    data.further = {name: content[name] for name in content if name not in SHOWN}
    by_column = {column.column: column for column in data.columns}
    if "trajectory" in content:
        by_column[content["trajectory"]].role = RUN
    time = dict(content["time"])
    if "column" in time:
        column = by_column[time.pop("column")]
        column.role = TIME
        column.unit = time.pop("unit", "")
    data.step = _written(time.pop("step", None))
    data.further_of_time = time
    for role, key in ((STATE, "states"), (INPUT, "inputs")):
        for name, channel in content.get(key, {}).items():
            if "column" not in channel:
                data.unmeasured[name] = channel.get("unit", "")
                continue
            column = by_column[channel["column"]]
            column.role = role
            column.name = name
            column.unit = channel.get("unit", "")
            column.noise = _written(channel.get("noise"))
            column.hold = channel.get("hold", "")


def told_columns(content: Mapping[str, Any]) -> list[str | int]:
    """The columns that a section [data] names, each once."""
    named = [content.get("trajectory"), content["time"].get("column")]
    for key in ("states", "inputs"):
        for channel in content.get(key, {}).values():
            named.append(channel.get("column"))
    return list(dict.fromkeys(one for one in named if one is not None))


def _channels(draft: DataDraft, role: str) -> Content:
    return {one.name or str(one.column): _channel(one) for one in draft.with_role(role)}


def _channel(column: ColumnDraft) -> Content:
    noise = _number(column.noise) if column.role == STATE else ""
    hold = column.hold if column.role == INPUT else ""
    filled = _filled(unit=column.unit, noise=noise, hold=hold)
    return {"column": column.column, **filled}


def _held_out(draft: HeldOutDraft) -> Content:
    key = HELD_OUT_KEYS.get(draft.way)
    if key is None:
        return {}
    value = getattr(draft, key)
    return {key: list(value) if key == "runs" else _number(value)}


def _held_out_draft(content: Mapping[str, Any]) -> HeldOutDraft:
    for way, key in HELD_OUT_KEYS.items():
        if key in content:
            told = content[key]
            value: Any = list(listed(told)) if key == "runs" else _written(told)
            return HeldOutDraft(way, **{key: value})
    return HeldOutDraft(NOTHING)


# ---- the model -----------------------------------------------------------------------


def _model(draft: ModelDraft) -> Content:
    content: Content = {"type": draft.type, "states": draft.state_names}
    if draft.input_names:
        content["inputs"] = draft.input_names
    content.update(draft.further)
    if draft.type != FIRST_ORDER:
        if "S" not in draft.further:
            content["pairs"] = _pairs_in(draft.pairs)
        content["H"] = _terms_in(draft.H)
    for slot, formulas in (("R", draft.R), ("F", draft.F)):
        filled = {name: text for name, text in formulas.items() if text.strip()}
        known = [name for name in filled if name in draft.state_names]
        if known:
            content[slot] = {name: _terms_in(filled[name]) for name in known}
    return content


def model_draft(
    content: Mapping[str, Any], parameters: Mapping[str, Any]
) -> ModelDraft:
    """The draft of the sections [model] and [parameters]."""
    further = dict(content)
    return ModelDraft(
        type=further.pop("type", ModelDraft.type),
        states=", ".join(listed(further.pop("states"))),
        inputs=", ".join(listed(further.pop("inputs", ()))),
        pairs=", ".join("-".join(pair) for pair in further.pop("pairs", [])),
        H=_terms_text(further.pop("H", "")),
        R={name: _terms_text(one) for name, one in further.pop("R", {}).items()},
        F={name: _terms_text(one) for name, one in further.pop("F", {}).items()},
        parameters=[_parameter_draft(name, one) for name, one in parameters.items()],
        further=further,
    )


def _pairs_in(text: str) -> list[list[str]]:
    """The pairs of states of a text such as "q-p, r-s"."""
    pairs = [pair.replace("-", " ").split() for pair in re.split(r"[,;\n]", text)]
    return [pair for pair in pairs if pair]


def _terms_in(text: str) -> Any:
    """A formula as it is; a table or list of terms as TOML has it."""
    stripped = text.strip()
    if not stripped.startswith(("{", "[")):
        return stripped
    try:
        return toml_tables(f"terms = {stripped}")["terms"]
    except ValueError:
        return stripped


def _terms_text(terms: Any) -> str:
    return terms if isinstance(terms, str) else toml_value(terms)


def _parameter(draft: ParameterDraft) -> Any:
    content = dict(draft.further)
    if draft.is_known and not draft.value:
        content["fixed"] = True
    numbers = _filled(
        **{"value" if draft.is_known else "start": draft.value},
        lower=draft.lower,
        upper=draft.upper,
    )
    content |= {name: _number(text) for name, text in numbers.items()}
    return {**content, **_filled(unit=draft.unit)}


def _parameter_draft(name: str, content: Any) -> ParameterDraft:
    if not isinstance(content, Mapping):
        return ParameterDraft(name, _written(content), is_known=True)
    further = dict(content)
    is_known = "value" in further or bool(further.pop("fixed", False))
    value = further.pop("value", further.pop("start", None))
    lower = _written(further.pop("lower", None))
    upper = _written(further.pop("upper", None))
    unit = further.pop("unit", "")
    return ParameterDraft(
        name, _written(value), is_known, lower, upper, unit, further=further
    )

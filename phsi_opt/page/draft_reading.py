"""The tables of a study file as drafts.

What the page does not show (own effects, the loss, kinds of states) is kept as it was.
"""

from collections.abc import Mapping
from typing import Any

from phsi_opt.page.drafts import (
    AFTER,
    DEFAULT_SHARE,
    INPUT,
    NOT_USED,
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
from phsi_opt.page.study_draft import Content, StudyDraft
from phsi_opt.study_file.toml_text import toml_value

# Keys of a study file that the page neither shows nor changes.
KEPT = ("effects", "loss")
# Keys of [data] that it shows.
SHOWN = ("files", "trajectory", "hold", "thinned", "time", "states", "inputs")


def draft_of(content: Mapping[str, Any], data: DataDraft) -> StudyDraft:
    """The drafts of a study file that has been read without complaint.

    Args:
        content: its tables.
        data: its files, looked at.
    """
    _take_data(content["data"], data)
    _take_held_out(content.get("held_out"), data)
    study = dict(content.get("study", {}))
    added = list(study.pop("added", []))
    kept = {name: content[name] for name in KEPT if name in content}
    if study:
        kept["study"] = study
    model = _model_draft(content["model"], content.get("parameters", {}))
    return StudyDraft(data, model, added, kept)


def _take_data(content: Mapping[str, Any], data: DataDraft) -> None:
    for column in data.columns:
        column.role = NOT_USED
    data.hold = content.get("hold", data.hold)
    data.averaged = _written(content.get("thinned"))
    further = dict(content)
    for name in SHOWN:
        further.pop(name, None)
    data.further = further
    by_column = {column.column: column for column in data.columns}
    if "trajectory" in content:
        by_column[content["trajectory"]].role = RUN
    _take_time(dict(content["time"]), data, by_column)
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


def _take_time(
    content: Content, data: DataDraft, by_column: Mapping[str | int, ColumnDraft]
) -> None:
    if "column" in content:
        column = by_column[content.pop("column")]
        column.role = TIME
        column.unit = content.pop("unit", "")
    data.step = _written(content.pop("step", None))
    data.further_of_time = content


def told_columns(content: Mapping[str, Any]) -> list[str | int]:
    """The columns that a section [data] names, each once."""
    named = [content.get("trajectory"), content["time"].get("column")]
    for key in ("states", "inputs"):
        for channel in content.get(key, {}).values():
            named.append(channel.get("column"))
    return list(dict.fromkeys(one for one in named if one is not None))


def _take_held_out(content: Mapping[str, Any] | None, data: DataDraft) -> None:
    held_out = data.held_out
    if not content:
        held_out.way = "nothing"
    elif "runs" in content:
        held_out.way = RUNS
        held_out.runs = list(content["runs"])
    elif "after" in content:
        held_out.way = AFTER
        held_out.after = _written(content["after"])
    else:
        held_out.way = SHARE
        held_out.share = _written(content.get("share")) or DEFAULT_SHARE


def _model_draft(
    content: Mapping[str, Any], parameters: Mapping[str, Any]
) -> ModelDraft:
    further = dict(content)
    pairs = further.pop("pairs", [])
    losses = further.pop("R", {})
    forces = further.pop("F", {})
    draft = ModelDraft(
        type=further.pop("type", ModelDraft.type),
        states=", ".join(further.pop("states")),
        inputs=", ".join(further.pop("inputs", [])),
        pairs=", ".join("-".join(pair) for pair in pairs),
        H=_terms_text(further.pop("H", "")),
        R={name: _terms_text(terms) for name, terms in losses.items()},
        F={name: _terms_text(terms) for name, terms in forces.items()},
        further=further,
    )
    for name, parameter in parameters.items():
        draft.parameters.append(_parameter_draft(name, parameter))
    return draft


def _terms_text(terms: Any) -> str:
    return terms if isinstance(terms, str) else toml_value(terms)


def _parameter_draft(name: str, content: Any) -> ParameterDraft:
    if not isinstance(content, Mapping):
        return ParameterDraft(name, _written(content), is_known=True)
    further = dict(content)
    is_known = "value" in further or bool(further.pop("fixed", False))
    value = further.pop("value", further.pop("start", None))
    return ParameterDraft(
        name,
        _written(value),
        is_known,
        _written(further.pop("lower", None)),
        _written(further.pop("upper", None)),
        further.pop("unit", ""),
        further=further,
    )


def _written(value: Any) -> str:
    return "" if value is None else f"{value:.12g}"

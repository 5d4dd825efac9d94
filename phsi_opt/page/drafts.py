"""What a user has filled in so far, before it is checked: texts, as they were typed.

A draft may be wrong: it is written as a study file, and reading that file tells what is
wrong. Tables say which fields are which keys of a study file, and how their texts are
written there; they are read both ways. What the page does not show (own effects, the
loss, kinds of states) is kept as it was. Drafts are the only records of the package
that change.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from phsi_opt.study_file.keys import listed
from phsi_opt.study_file.study_text import text_of
from phsi_opt.study_file.toml_text import toml_tables, toml_value

Content = dict[str, Any]

TIME = "time"
RUN = "run"
STATE = "state"
INPUT = "input"
NOT_USED = "not used"
ROLES = (TIME, RUN, STATE, INPUT, NOT_USED)
CHANNELS = {STATE: "states", INPUT: "inputs"}  # sections of [data]

NOTHING = "nothing"
SHARE = "the last share"
AFTER = "from a time on"
RUNS = "runs by name"
HELD_OUT_WAYS = (SHARE, AFTER, RUNS, NOTHING)
HELD_OUT_KEYS = {SHARE: "share", AFTER: "after", RUNS: "runs"}
DEFAULT_SHARE = "0.3"  # of the runs, or of the samples of a single run

ENERGY = "PseudoHamiltonian"
FIRST_ORDER = "FirstOrder"
KEPT = ("effects", "loss")  # sections that the page neither shows nor changes
# Keys of [data] that it shows.
SHOWN = ("files", "trajectory", "hold", "thinned", "time", "states", "inputs")


# ---- texts of fields, and what a study file has for them -----------------------------


class Kind(NamedTuple):
    """How the text of a field is made of a value, and written as one."""

    text: Callable[[Any], str]
    value: Callable[[str], Any]


def number_in(text: str, kind: type[float] = float) -> Any:
    """The number; the text itself where it is none, so that reading refuses it."""
    try:
        return kind(text.strip())
    except ValueError:
        return text


def names_in(text: str) -> list[str]:
    """Names of a text that are separated by commas or spaces, each once."""
    return list(dict.fromkeys(text.replace(",", " ").split()))


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


TEXT = Kind(str, str)
REAL = Kind("{:.12g}".format, number_in)
WHOLE = Kind(str, lambda text: number_in(text, int))
NAMES = Kind(lambda names: ", ".join(listed(names)), names_in)
PAIRS = Kind(lambda pairs: ", ".join(map("-".join, pairs)), _pairs_in)
TERMS = Kind(_terms_text, _terms_in)

COLUMN_FIELDS = {"unit": TEXT, "noise": REAL, "hold": TEXT}
SHOWN_OF_ROLE = {TIME: ("unit",), STATE: ("unit", "noise"), INPUT: ("unit", "hold")}
MODEL_FIELDS = {
    "type": TEXT,
    "states": NAMES,
    "inputs": NAMES,
    "pairs": PAIRS,
    "H": TERMS,
}
PARAMETER_FIELDS = {"lower": REAL, "upper": REAL, "unit": TEXT}


def _taken(content: Content, fields: Mapping[str, Kind]) -> dict[str, str]:
    """The texts of fields, whose keys are taken out of the content."""
    known = [name for name in fields if name in content]
    return {name: fields[name].text(content.pop(name)) for name in known}


def _filled(draft: Any, fields: Mapping[str, Kind]) -> Content:
    """What a study file has for the fields that are filled in."""
    written = {name: getattr(draft, name) for name in fields}
    return {name: fields[name].value(text) for name, text in written.items() if text}


# ---- the measurements ----------------------------------------------------------------


@dataclass
class ColumnDraft:
    """One column of the table and what it is.

    Attributes:
        column: its header, or its position where there is no header.
        role: one of ``ROLES``.
        name: in formulas, of a state or an input.
        unit: such as "m"; "" where it is unknown.
        noise: standard deviation of a state's noise; "" where it is unknown.
        hold: what an input does between samples; "": as the others.
        examples: its first cells.
        is_numeric: whether it holds numbers; else it can only name runs.
        fits_no_state: a state to the user, which the base model that was chosen last
            has no place for.
    """

    column: str | int
    role: str = NOT_USED
    name: str = ""
    unit: str = ""
    noise: str = ""
    examples: tuple[str, ...] = ()
    is_numeric: bool = True
    fits_no_state: bool = False
    hold: str = ""

    @property
    def called(self) -> str:
        """Its name in formulas, or else its header."""
        return self.name or str(self.column)

    def content(self) -> Content:
        """What a study file says of it."""
        fields = {name: COLUMN_FIELDS[name] for name in SHOWN_OF_ROLE[self.role]}
        return {"column": self.column, **_filled(self, fields)}

    def take(self, role: str, content: Mapping[str, Any], name: str = "") -> None:
        """Be what a study file says."""
        told = {"role": role, "name": name, **_taken(dict(content), COLUMN_FIELDS)}
        for key, text in told.items():
            setattr(self, key, text)


@dataclass
class HeldOutDraft:
    """What is kept from fitting, in one of the ``HELD_OUT_WAYS``."""

    way: str = SHARE
    share: str = DEFAULT_SHARE
    after: str = ""
    runs: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> "HeldOutDraft":
        """That of the section [held_out]."""
        for way, key in HELD_OUT_KEYS.items():
            if key in content:
                told = content[key]
                value = list(listed(told)) if key == "runs" else REAL.text(told)
                return cls(way, **{key: value})  # type: ignore[arg-type]
        return cls(NOTHING)

    def content(self) -> Content:
        """The section [held_out]."""
        key = HELD_OUT_KEYS.get(self.way)
        if key is None:
            return {}
        value = list(self.runs) if key == "runs" else number_in(getattr(self, key))
        return {key: value}


@dataclass
class DataDraft:
    """The files and their columns.

    Attributes:
        places: where each file lies, by the name that its owner gave it.
        columns: of the table.
        n_samples: lines of numbers, of all files.
        runs: names that the column of runs holds, or those of the files.
        held_out: what is kept from fitting.
        hold: what inputs do between samples.
        unmeasured: units of states that nobody measured.
        step: the time between lines, where no column has the times.
        averaged: how many neighbouring samples become their mean; "" for none.
        further: keys of [data] that the page does not show.
        further_of_time: keys of its time that the page does not show.
    """

    places: dict[str, Path]
    columns: list[ColumnDraft] = field(default_factory=list)
    n_samples: int = 0
    runs: list[str] = field(default_factory=list)
    held_out: HeldOutDraft = field(default_factory=HeldOutDraft)
    hold: str = "linear"
    unmeasured: dict[str, str] = field(default_factory=dict)
    step: str = ""
    averaged: str = ""
    further: Content = field(default_factory=dict)
    further_of_time: Content = field(default_factory=dict)

    @property
    def files(self) -> list[str]:
        """The names of the files, as their owner gave them."""
        return list(self.places)

    def with_role(self, role: str) -> list[ColumnDraft]:
        """The columns of a role."""
        return [column for column in self.columns if column.role == role]

    def column_named(self, role: str, name: str) -> ColumnDraft | None:
        """The column that is a state or an input of this name."""
        named = [column for column in self.with_role(role) if column.name == name]
        return named[0] if named else None

    def measure(self, role: str, name: str, column: str | None) -> None:
        """Let a column be the state or input of a name; None: no column is."""
        for known in self.columns:
            if known.role == role and known.name == name:
                known.role = NOT_USED
            if column is not None and str(known.column) == column:
                known.role = role
                known.name = name

    def content(self, states: list[str]) -> Content:
        """The section [data] for a model of these states."""
        content: Content = {"files": self.files, **self.further}
        for column in self.with_role(RUN):
            content["trajectory"] = column.column
        if self.averaged:
            content["thinned"] = WHOLE.value(self.averaged)
        time: Content = {"step": number_in(self.step)} if self.step else {}
        for column in self.with_role(TIME):
            time = column.content()
        content["time"] = {**time, **self.further_of_time}
        for role, section in CHANNELS.items():
            content[section] = {
                one.called: one.content() for one in self.with_role(role)
            }
        for name in states:
            unit = self.unmeasured.get(name, "")
            lacking = {"measured": False, **({"unit": unit} if unit else {})}
            content["states"].setdefault(name, lacking)
        if not content["inputs"]:
            del content["inputs"]
            return content
        return {**content, "hold": self.hold}

    def take(self, content: Mapping[str, Any]) -> None:
        """Be what the section [data] says of these columns."""
        for column in self.columns:
            column.role = NOT_USED
        by_column = {column.column: column for column in self.columns}
        self.hold = content.get("hold", self.hold)
        self.averaged = str(content.get("thinned", ""))
        self.further = {key: content[key] for key in content if key not in SHOWN}
        if "trajectory" in content:
            by_column[content["trajectory"]].role = RUN
        time = dict(content["time"])
        if "column" in time:
            by_column[time.pop("column")].take(TIME, time)
            time.pop("unit", None)
        self.step = _taken(time, {"step": REAL}).get("step", "")
        self.further_of_time = time
        for role, section in CHANNELS.items():
            for name, channel in content.get(section, {}).items():
                if "column" in channel:
                    by_column[channel["column"]].take(role, channel, name)
                else:
                    self.unmeasured[name] = channel.get("unit", "")


def told_columns(content: Mapping[str, Any]) -> list[str | int]:
    """The columns that a section [data] names, each once."""
    channels = [{"column": content.get("trajectory")}, content["time"]]
    for section in CHANNELS.values():
        channels += content.get(section, {}).values()
    named = dict.fromkeys(channel.get("column") for channel in channels)
    return [one for one in named if one is not None]


# ---- the model -----------------------------------------------------------------------


@dataclass
class ParameterDraft:
    """A number of the formulas.

    Attributes:
        name: in the formulas.
        value: known, or where the search begins; "" where it is found in the data.
        is_known: whether it is not estimated.
        lower: least value; "" for none.
        upper: largest value; "" for none.
        unit: such as "N/m".
        is_assumed: whether a known value is the gallery's, and not the user's.
        further: keys of a study file that the page does not show.
    """

    name: str
    value: str = ""
    is_known: bool = False
    lower: str = ""
    upper: str = ""
    unit: str = ""
    is_assumed: bool = False
    further: Content = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, content: Any) -> "ParameterDraft":
        """That of an entry of [parameters]."""
        if not isinstance(content, Mapping):
            return cls(name, REAL.text(content), is_known=True)
        further = dict(content)
        is_known = "value" in further or bool(further.pop("fixed", False))
        value = _taken(further, {"value": REAL, "start": REAL})
        shown: dict[str, Any] = _taken(further, PARAMETER_FIELDS)
        text = next(iter(value.values()), "")
        return cls(name, text, is_known, further=further, **shown)

    def content(self) -> Content:
        """The entry of [parameters]."""
        content = {**self.further, **_filled(self, PARAMETER_FIELDS)}
        if self.value:
            content["value" if self.is_known else "start"] = number_in(self.value)
        elif self.is_known:
            content["fixed"] = True
        return content


@dataclass
class ModelDraft:
    """The base model as it is written.

    Attributes:
        title: of the entry of the gallery that it came from; "" where it is written.
        type: ``ENERGY`` or ``FIRST_ORDER``.
        states: names, separated by commas.
        inputs: names, separated by commas.
        pairs: such as "q-p, r-s": dq/dt = dH/dp, dp/dt = -dH/dq.
        H: the energy.
        R: losses by state.
        F: forces by state.
        parameters: in their order.
        further: keys of [model] that the page does not show.
    """

    title: str = ""
    type: str = ENERGY
    states: str = ""
    inputs: str = ""
    pairs: str = ""
    H: str = ""
    R: dict[str, str] = field(default_factory=dict)
    F: dict[str, str] = field(default_factory=dict)
    parameters: list[ParameterDraft] = field(default_factory=list)
    further: Content = field(default_factory=dict)

    @classmethod
    def of(
        cls, content: Mapping[str, Any], parameters: Mapping[str, Any]
    ) -> "ModelDraft":
        """That of the sections [model] and [parameters]."""
        further = dict(content)
        told: dict[str, Any] = _taken(further, MODEL_FIELDS)
        for slot in "RF":
            formulas = further.pop(slot, {})
            told[slot] = {name: _terms_text(one) for name, one in formulas.items()}
        drafts = [ParameterDraft.of(name, one) for name, one in parameters.items()]
        return cls(parameters=drafts, further=further, **told)

    @property
    def state_names(self) -> list[str]:
        """The states, each once."""
        return names_in(self.states)

    @property
    def input_names(self) -> list[str]:
        """The inputs, each once."""
        return names_in(self.inputs)

    def content(self) -> Content:
        """The section [model]."""
        empty: Content = {"states": [], "pairs": [], "H": ""}
        content = {**empty, **_filled(self, MODEL_FIELDS), **self.further}
        if self.type == FIRST_ORDER or "S" in self.further:
            del content["pairs"]
        if self.type == FIRST_ORDER:
            del content["H"]
        for slot, formulas in (("R", self.R), ("F", self.F)):
            terms = {
                name: _terms_in(formulas.get(name, "")) for name in self.state_names
            }
            filled = {name: one for name, one in terms.items() if one}
            if filled:
                content[slot] = filled
        return content


# ---- all of it -----------------------------------------------------------------------


class Drafted(NamedTuple):
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
        data.take(content["data"])
        data.held_out = HeldOutDraft.of(content.get("held_out", {}))
        study = dict(content.get("study", {}))
        added = list(listed(study.pop("added", ())))
        kept = {name: content[name] for name in KEPT if name in content}
        if study:
            kept["study"] = study
        model = ModelDraft.of(content["model"], content.get("parameters", {}))
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
            content["data"] = self.data.content(self.model.state_names)
            content["held_out"] = self.data.held_out.content()
        content["model"] = self.model.content()
        named = [one for one in self.model.parameters if one.name]
        content["parameters"] = {one.name: one.content() for one in named}
        content["study"] = {**self.kept.get("study", {}), "added": list(self.added)}
        return content

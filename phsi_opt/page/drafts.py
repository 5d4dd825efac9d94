"""What a user has filled in so far: the tables of a study file, which may be wrong yet.

The fields of the page show texts. Their kinds say how a text stands in a study file,
both ways; what is no number stays a text, and reading the file refuses it. What the
page does not show stays in the tables as it was. Columns and parameters stand in lists
until the file is written: two of them may have one name while it is typed. Drafts are
the only records of the package that change.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from phsi_opt.data.checks import Hold
from phsi_opt.data.file_opening import READERS, NamedFile
from phsi_opt.errors import Complaint, DataError, PhsiOptError, StudyFileError
from phsi_opt.presentation.charts import Chart
from phsi_opt.presentation.numbers import shortened
from phsi_opt.study_file.columns import INPUT, RUN, STATE, TIME, UNUSED, Column
from phsi_opt.study_file.gallery import BaseModel, give_parts, with_units
from phsi_opt.study_file.keys import (
    Complaints,
    TooManyComplaintsError,
    listed,
    usable,
)
from phsi_opt.study_file.model_reading import WITH_ENERGY, WITHOUT_ENERGY
from phsi_opt.study_file.study_file import StudyFile
from phsi_opt.study_file.study_text import text_of
from phsi_opt.study_file.survey import surveys
from phsi_opt.study_file.toml_text import tables_of, toml_tables, toml_value

Content = dict[str, Any]

PARTS_OF_COLUMNS = (TIME, RUN, STATE, INPUT, UNUSED)  # that a column may be
CHANNELS = {STATE: "states", INPUT: "inputs"}  # sections of [data]

# How data are chosen that are not fitted: by one of these keys, or without words.
WAYS = {"share": "the last part", "after": "from a time on", "runs": "runs by name"}
NOTHING = "nothing"
USUAL = "one of three or more runs"
# Sections of data that are not fitted: the way that needs no words, and what it means.
USUAL_WAYS = {"held_out": NOTHING, "final": USUAL}

KEPT = ("effects", "study", "loss")  # sections that the page does not show

# Bytes of one uploaded file. A table of a million numbers takes about 10 MB.
MOST_UPLOADED = 20_000_000
MOST_FILES = 50  # of one study; each is a run
# What the name of an uploaded table may end in; the ending tells how it is read.
TABLE_KINDS = (".csv", ".txt", ".tsv", ".dat", *READERS)
STUDY_KIND = ".toml"  # of a study file


# ---- texts of fields, and what a study file has for them -----------------------------


class Kind(NamedTuple):
    """How the text of a field is made of a value, and written as one."""

    text: Callable[[Any], str]
    value: Callable[[str], Any]


def _number_in(text: str, kind: type[float] = float) -> Any:
    try:
        return kind(text.strip())
    except ValueError:
        return text


def _pairs_in(text: str) -> list[list[str]]:
    pairs = [pair.replace("-", " ").split() for pair in re.split(r"[,;\n]", text)]
    return [pair for pair in pairs if pair]


def _terms_in(text: str) -> Any:
    if not text.startswith(("{", "[")):
        return text
    try:
        return toml_tables(f"terms = {text}")["terms"]
    except ValueError:
        return text


def value_text(value: Any) -> str:
    """A value as a field shows it."""
    if isinstance(value, str):
        return value
    return f"{value:.12g}" if isinstance(value, float) else toml_value(value)


TEXT = Kind(str, str)
REAL = Kind(value_text, _number_in)
WHOLE = Kind(value_text, lambda text: _number_in(text, int))
NAMES = Kind(
    lambda names: ", ".join(listed(names)),
    lambda text: list(dict.fromkeys(text.replace(",", " ").split())),
)
SPAN = Kind(
    lambda ends: ", ".join(map(value_text, listed(ends))),
    lambda text: [_number_in(one) for one in text.replace(",", " ").split()],
)
PAIRS = Kind(lambda pairs: ", ".join(map("-".join, pairs)), _pairs_in)
TERMS = Kind(value_text, _terms_in)


def _without(table: Mapping[str, Any], *keys: str) -> Content:
    return {key: one for key, one in table.items() if key not in keys}


# ---- the measurements ----------------------------------------------------------------


def way_of(section: str, told: Mapping[str, Any]) -> str:
    """In which way data are held out, or kept for the end, as a study file says it."""
    if told.get("runs") == []:
        return NOTHING
    return next(filter(told.__contains__, WAYS), USUAL_WAYS[section])


@dataclass
class DataDraft:
    """The files and their columns."""

    places: dict[str, Path]  # where each file lies, by the name that its owner gave it
    columns: list[Column] = field(default_factory=list)  # of the table
    n_samples: int = 0  # lines of numbers, of all files
    # Names that the column of runs holds, or those of the files.
    runs: list[str] = field(default_factory=list)
    # The sections of ``USUAL_WAYS``, each with the way in which its data are chosen.
    parts: dict[str, Content] = field(
        default_factory=lambda: {
            "held_out": {"way": "share", "share": 0.3},
            "final": {"way": USUAL},
        }
    )
    # Keys of [data] that are no columns, such as ``thinned``.
    settings: Content = field(default_factory=dict)
    # Of the first file: sheets of a workbook or groups of channels, that shown first.
    sheets: tuple[str, ...] = ()
    # The step between lines, where no column has the times.
    time: Content = field(default_factory=dict)
    # Units of states that nobody measured.
    unmeasured: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, content: Mapping[str, Any], places: dict[str, Path]) -> "DataDraft":
        """That of a study file that has been read without complaint.

        Columns are those of its tables; where no look helps (no header, or MATLAB's
        variables), those that it names.
        """
        data = content["data"]
        try:
            draft = look_at(places, sheet_of(data))
        except DataError:
            draft = cls(places)
        by_column = {column.column: column for column in draft.columns}
        for column in draft.columns:
            column.part = UNUSED
        others = ("files", "trajectory", "time", "hold", *CHANNELS.values())
        draft.settings = _without(data, *others)
        draft.time = {}
        told = [(TIME, "", data["time"])]
        if "trajectory" in data:
            told.append((RUN, "", {"column": data["trajectory"]}))
        for part, section in CHANNELS.items():
            of_all = {"hold": data["hold"]} if "hold" in data else {}
            channels = data.get(section, {}).items()
            told += [(part, name, {**of_all, **table}) for name, table in channels]
        for part, name, table in told:
            if "column" in table:
                source = table["column"]
                if isinstance(source, list):  # date and time of day
                    source = tuple(source)
                if source not in by_column:
                    by_column[source] = Column(source)
                    draft.columns.append(by_column[source])
                by_column[source].take(part, {**table, "name": name})
            elif part == TIME:
                draft.time = dict(table)
            else:
                draft.unmeasured[name] = table.get("unit", "")
        for section in USUAL_WAYS:
            part = content.get(section, {})
            draft.parts[section] = {"way": way_of(section, part), **part}
        return draft

    @property
    def headers(self) -> list[Any]:
        return list(map(attrgetter("column"), self.columns))

    def of_part(self, part: str) -> list[Column]:
        return [column for column in self.columns if column.part == part]

    def content(self, states: list[str]) -> Content:
        """The section [data] for a model of these states."""
        content: Content = {
            "files": list(self.places),
            **self.settings,
            "time": self.time,
        }
        for column in self.of_part(RUN):
            content["trajectory"] = column.column
        for column in self.of_part(TIME):
            content["time"] = column.content()
        for part, section in CHANNELS.items():
            columns = self.of_part(part)
            content[section] = {
                one.name or one.heading: one.content() for one in columns
            }
        for name in states:
            unit = self.unmeasured.get(name, "")
            lacking = {"measured": False, **({"unit": unit} if unit else {})}
            content["states"].setdefault(name, lacking)
        return content

    def take_files(self, found: "DataDraft") -> None:
        """Take the files of another draft; the columns are the same, and stay."""
        self.places = found.places
        self.runs = found.runs
        self.n_samples = found.n_samples
        for part in self.parts.values():
            runs = listed(part.get("runs", ()))
            part["runs"] = [run for run in runs if run in found.runs]


def sheet_of(settings: Mapping[str, Any]) -> str | None:
    """The sheet of a workbook, or the group of channels, that keys of [data] name."""
    return settings.get("sheet") or settings.get("group")


def look_at(places: Mapping[str, Path], sheet: str | None = None) -> DataDraft:
    """The columns of the files, with a guess of what each is.

    Args:
        places: tables with the same columns, a run each; where they lie, by name.
        sheet: that of workbooks, or the group of channels, where the files have it.
    """
    draft = DataDraft(dict(places))
    files = [NamedFile(place, name) for name, place in places.items()]
    seen = surveys(files, sheet)
    for one in seen:
        draft.n_samples += one.n_lines
        draft.runs += one.runs
        if one.step is not None:
            draft.time = {"step": one.step}
    draft.runs = list(dict.fromkeys(draft.runs))
    draft.sheets = seen[0].table.sheets
    draft.settings = {one.key: one.content for one in seen[0].read if one.is_set}
    for column in seen[0].columns:
        draft.columns.append(column.without_cells())
    return draft


def in_megabytes(size: int) -> str:
    """A number of bytes in words: '20 MB'."""
    return f"{size / 1e6:.3g} MB"


def suffix_of(name: str) -> str:
    """What a name ends in, in lower case, such as ".csv"."""
    return PurePosixPath(name).suffix.lower()


def refusal_of(name: str, n_bytes: int) -> str:
    """Why a file is not even looked at, in a sentence; "" where it is."""
    shown = repr(shortened(name, 40))
    if not name.isprintable():
        return f"the name {shown} has control characters; expected letters."
    if suffix_of(name) not in (*TABLE_KINDS, STUDY_KIND):
        kinds = ", ".join((*TABLE_KINDS, STUDY_KIND))
        return f"{shown} is no table or study file by its ending; expected {kinds}."
    if n_bytes > MOST_UPLOADED:
        return (
            f"{name} has {in_megabytes(n_bytes)}; at most "
            f"{in_megabytes(MOST_UPLOADED)} are accepted. Keep every tenth sample, or "
            "read the file in Python."
        )
    return ""


# ---- the model -----------------------------------------------------------------------


def parameter_of(name: str, told: Any) -> Content:
    """A number of the formulas: its table in a study file, and its name."""
    table = told if isinstance(told, Mapping) else {"value": told}
    known = {"fixed": True} if "value" in table else {}
    return {"name": name, **table, **known}


def let_be_known(parameter: Content, is_known: bool) -> None:
    """Let the number be known, or where the search begins."""
    number = parameter.pop("start", None)
    number = parameter.pop("value", number)
    parameter.pop("fixed", None)
    if is_known:
        parameter["fixed"] = True
    if number is not None:
        parameter["value" if is_known else "start"] = number


@dataclass
class ModelDraft:
    """The base model as it is written."""

    # The section [model]; R and F are there, perhaps empty.
    table: Content = field(default_factory=lambda: {"R": {}, "F": {}})
    # In their order, each with its name and whether its value is the gallery's, not
    # the user's.
    parameters: list[Content] = field(default_factory=list)
    # Name of the entry of the gallery that it came from; "" where it is written.
    title: str = ""

    @classmethod
    def of(
        cls, content: Mapping[str, Any], parameters: Mapping[str, Any], title: str = ""
    ) -> "ModelDraft":
        slots = {slot: dict(content.get(slot, {})) for slot in "RF"}
        rows = [parameter_of(*one) for one in parameters.items()]
        return cls({**content, **slots}, rows, title)

    @property
    def type(self) -> str:
        """``WITH_ENERGY`` or ``WITHOUT_ENERGY``."""
        return str(self.table.get("type", WITH_ENERGY))

    def names(self, what: str) -> list[str]:
        return list(dict.fromkeys(listed(self.table.get(what, ()))))

    def content(self) -> Content:
        content: Content = {"pairs": [], "type": self.type, **self.table}
        if self.type == WITHOUT_ENERGY:
            content = _without(content, "pairs", "H")
        if "S" in content:
            del content["pairs"]
        states = self.names("states")
        for key in ("R", "F", "kind"):
            told = content.pop(key, {})
            if isinstance(told, Mapping):
                directions = [one for one in told if not one.isidentifier()]
                kept = [name for name in (*states, *directions) if name in told]
                told = {name: told[name] for name in kept}
            if told:
                content[key] = told
        return content


# ---- all of it -----------------------------------------------------------------------


class Drafted(NamedTuple):
    """A draft as it was at one time: the study file, and where its data files lie."""

    text: str
    places: dict[str, Path]


@dataclass
class StudyDraft:
    """All that a user has filled in."""

    data: DataDraft | None = None  # files and columns; None before there is a file
    model: ModelDraft = field(default_factory=ModelDraft)  # the base model
    kept: Content = field(default_factory=dict)  # sections that the page does not show

    @classmethod
    def read(cls, path: Path, places: dict[str, Path] | None = None) -> "StudyDraft":
        """Drafts of a study file; its tables lie beside it unless told otherwise."""
        if places is None:
            folder = path.parent.absolute()
            places = {file: folder / file for file in files_of(path)}
        measured = StudyFile.read(path, places).measurements()
        content = tables_of(path)
        kept = {name: content[name] for name in KEPT if name in content}
        model = ModelDraft.of(content["model"], content.get("parameters", {}))
        data = DataDraft.of(content, places)
        data.n_samples = measured.n_samples
        data.runs = [run.name for run in measured.trajectories]
        return cls(data, model, kept)

    @property
    def places(self) -> dict[str, Path]:
        return {} if self.data is None else dict(self.data.places)

    def as_it_is(self) -> Drafted:
        return Drafted(text_of(self.content()), self.places)

    def content(self) -> Content:
        content: Content = {**self.kept, "model": self.model.content()}
        if self.data is not None:
            content["data"] = self.data.content(self.model.names("states"))
            for name, part in self.data.parts.items():
                way = part["way"]
                told = {way: part.get(way, "")} if way in WAYS else {"runs": []}
                content[name] = {} if way == USUAL_WAYS[name] else told
        named = {}
        for one in self.model.parameters:
            named[one.get("name", "")] = _without(one, "name", "is_assumed")
        content["parameters"] = _without(named, "")
        return content


# ---- base models of the gallery ------------------------------------------------------


def draft_of(base: BaseModel, data: DataDraft | None) -> ModelDraft:
    """A fresh draft; its inputs are those of the data, after `match_states`."""
    inputs = [one.name for one in data.of_part(INPUT)] if data else []
    draft = ModelDraft.of(*base.sections(inputs), base.name)
    for one in draft.parameters:
        one["is_assumed"] = bool(one.get("fixed"))
    return draft


def match_states(data: DataDraft, base: BaseModel) -> BaseModel:
    """Let columns be states of the model, inputs that it lacks, or unused.

    Returns:
        The model, in position and velocity if that was measured.
    """
    for column in data.of_part(UNUSED):
        column.part = column.lost or UNUSED
    for column in data.columns:
        column.lost = ""
    base, data.unmeasured = give_parts(data.columns, base)
    return base


def left_over(columns: Sequence[Column], base: BaseModel) -> str:
    """Which columns have no place in a base model, in a sentence; "": all have."""
    left = {one.heading: one.unit for one in columns if one.lost}
    verb = "fits" if len(left) == 1 else "fit"
    said = (
        f"{with_units(left)} {verb} no state or input of {base.title} ({base.names}) "
        "by its unit and is left out; you can change this in part 1."
    )
    return said if left else ""


# ---- what is read of a draft ---------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Seen:
    """The measurements as they are seen before there is a model."""

    key: str = ""  # tells them from others; "" where they cannot be read yet
    chart: Chart | None = None
    rows: tuple[dict[str, Any], ...] = ()  # what was noticed of each channel
    spectrum: Chart | None = None


def files_of(path: Path) -> list[str]:
    """The data files that a study file names."""
    content = tables_of(path)
    with suppress(TooManyComplaintsError):
        file = usable(content, Complaints(content))
        return list(file.get("data", {}).get("files", ()))
    return []


def checked(
    path: Path, places: Mapping[str, Path], known: str
) -> tuple[tuple[Complaint, ...], Seen | None]:
    """What is wrong with a draft that was written, and its measurements.

    Args:
        path: of the draft as a study file.
        places: of its data files.
        known: the key of the measurements that are seen; None is returned for these.
    """
    measured = None
    parts = None
    complaints: tuple[Complaint, ...] = ()
    try:
        file = StudyFile.read(path, places)
        measured = file.measurements()
        parts = file.parts()
        file.check_formulas()
    except StudyFileError as error:
        complaints = error.complaints
        measured = error.measurements
    except PhsiOptError as error:
        complaints = (Complaint("model", "", str(error)),)
    if measured is None:
        return complaints, Seen() if known else None
    train, held_out, final = parts or (measured, None, None)
    digests = list(map(attrgetter("digest"), filter(None, (train, held_out, final))))
    key = repr((digests, dict(measured.units), measured.hold))
    if key == known:
        return complaints, None
    chart = train.chart(held_out, final)
    return complaints, Seen(key, chart, measured.look.rows, measured.spectrum)


def fitted_file(
    path: Path, places: Mapping[str, Path], added: Sequence[str], hold: Hold
) -> StudyFile:
    """A draft that was written, with the effects added and the inputs held so."""
    file = StudyFile.read(path, places)
    new = [one for one in added if one not in file.steps.added]
    return file.with_added(*new).with_hold(hold)

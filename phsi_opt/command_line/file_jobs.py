"""What the commands on study files do: init, check, add, the demonstration's files.

Nothing is solved here, so that none of the solver's rooms is loaded.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from hashlib import sha256
from importlib.resources import files
from itertools import filterfalse
from pathlib import Path
from textwrap import fill, wrap
from typing import Any

from phsi_opt.command_line.job import Answer, answer_to
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import Complaint, DataError, ModelError, StudyFileError
from phsi_opt.estimation.identifiability import cautions
from phsi_opt.initialization.relative_guesses import fast_motion
from phsi_opt.model.catalogue import catalogue, effects_told
from phsi_opt.model.laws import law_of, laws_told
from phsi_opt.model.model import Model
from phsi_opt.model.parameter_units import parameter_units
from phsi_opt.presentation.numbers import LINE_WIDTH
from phsi_opt.presentation.sentences import lines
from phsi_opt.presentation.units import in_si
from phsi_opt.reading import file_bytes, why_not_read
from phsi_opt.study_file.gallery import GALLERY, base_model
from phsi_opt.study_file.study_file import StudyFile
from phsi_opt.study_file.survey import first_text, known_values, surveys, unfilled
from phsi_opt.study_file.toml_text import add_effects, tables_of
from phsi_opt.transcription.grid import AlignedData
from phsi_opt.writing import make_folder, write_new, write_whole

DEMO_FILES = ("friction_spring.csv", "study.toml")
PICTURE_MARK = b"<!-- measurements drawn by phsi-opt:"


def gallery() -> Answer:
    """The base models of the gallery."""
    models = list(GALLERY.values())
    wrapped = partial(fill, width=80, initial_indent="    ", subsequent_indent="    ")
    text = lines(__package__, "gallery", models=models, wrapped=wrapped)
    return Answer(text, {"models": list(map(vars, models))})


def first_study(
    tables: list[Path],
    study: Path,
    force: bool,
    model: str | None = None,
    draws: bool = True,
) -> Answer:
    """Write a study file; nothing that is there is overwritten unless forced.

    Without the name of a base model, or a file that has one, the model stays empty.
    """
    base = None
    if model is not None and Path(model).suffix.lower() in (".toml", ".json"):
        from phsi_opt.study_file.model_file import base_model_in  # slow to load

        base = base_model_in(Path(model))
    elif model is not None:
        base = base_model(model)
    if os.path.exists(study) and not force:
        raise DataError(
            f"{study} exists already; nothing was written. Give another name with "
            "--study, or overwrite it with --force."
        )
    table, *_ = surveys(tables)
    write_whole(study, first_text(table, tables, study.parent, base))
    needs: tuple[Complaint, ...] = ()
    try:
        data: object = StudyFile.read(study).measurements()
    except StudyFileError as error:
        needs = error.complaints
        data = error.measurements
    shown = _shown(data, study, draws)
    facts = {"table": table, "study": study, "path": tables[0], "needs": needs}
    facts |= {"data": data, "picture": shown.get("picture")}
    facts["known"] = known_values(tables_of(study))
    content = {
        "study_file": str(study),
        "read": {one.key: one.content for one in table.read},
        "columns": [column.answer for column in table.columns],
        "further": list(map(vars, table.table.further)),
        "needs": list(map(vars, needs)),
    }
    return Answer(lines(__package__, "first_study", **facts), content | shown)


def _shown(data: object, study: Path, draws: bool) -> dict[str, object]:
    """What measurements show, and their picture, written unless it is there already."""
    if not isinstance(data, Measurements):
        return {}
    rows = data.noticed.to_json(orient="records", double_precision=15)  # no NaN
    shown: dict[str, object] = {"noticed": json.loads(rows)}
    if not draws:
        return shown
    path = study.with_name(f"{study.stem}_data.svg")
    try:
        _draw(data, path)
    except DataError as error:
        return shown | {"picture": f"none: {error}"}
    return shown | {"picture": str(path)}


def _draw(data: Measurements, path: Path) -> None:
    drawn = repr((data.digest, sorted(data.look.units.items()), data.look.hold))
    mark = PICTURE_MARK + sha256(drawn.encode()).hexdigest().encode() + b" -->\n"
    try:
        there = file_bytes(path) if os.path.exists(path) else b""
    except OSError as error:
        raise DataError(f"{path} cannot be read ({why_not_read(error)}).") from None
    if there and PICTURE_MARK not in there:
        raise DataError(f"{path} exists already and is no such picture; rename it.")
    if not there.endswith(mark):
        from phsi_opt.presentation.charts import svg  # matplotlib is slow to load

        write_whole(path, svg(data.chart()).encode() + mark)


def checked(path: Path, draws: bool = True) -> Answer:
    """A summary of a study file, or everything that is wrong, and what stands empty."""
    empty = unfilled(path)
    try:
        file = StudyFile.read(path)
        file.check_formulas()
        answer = _summary(path, file, _shown(file.measurements(), path, draws))
        has_dates = any(run.origin is not None for run in file.measurements())
        empty = unfilled(path, has_dates)
    except StudyFileError as error:
        answer = answer_to(error)
    except ModelError as error:
        wrong = StudyFileError(path, [Complaint("model", "", str(error))])
        answer = answer_to(wrong)
    text = lines(__package__, "checked", text=answer.text, empty=empty)
    return Answer(text, {**answer.content, "empty": list(empty)}, answer.code)


def _summary(path: Path, file: StudyFile, shown: dict[str, object]) -> Answer:
    """What a study file that can be used holds, and what is shown of its data."""
    train, held_out, final = file.parts()
    model = file.model()
    aligned = AlignedData.of(model, train)
    caution = fast_motion(model, aligned.grid, train.units)
    notes = [*aligned.notes, *cautions(model, train)]
    data = file.measurements()
    content = {
        "states": list(model.states),
        "inputs": list(model.inputs),
        "measured": list(train.measured),
        "free": list(model.free),
        "added": list(file.steps.added),
        "n_runs": data.n_trajectories,
        "n_samples": data.n_samples,
        "n_held_out": 0 if held_out is None else held_out.n_samples,
        "warnings": [*filter(None, (caution,)), *notes],
    }
    text = lines(
        __package__,
        "summary",
        path=path,
        data=data,
        picture=shown.get("picture"),
        train=train,
        held_out=held_out,
        final=final,
        content=content,
        known=known_values(tables_of(path)),
        kind=type(model).__name__,
        n_effects=len(catalogue(model, train.units)),
        notes=notes,
    )
    return Answer(f"{caution}\n{text}".lstrip(), content | shown)


def add_effect(path: Path, name: str, equation: str | None) -> Answer:
    """Write an effect into a study file, if the model can have it."""
    file = StudyFile.read(path)
    model = file.model()
    if equation is not None:
        model.index(equation, "--equation")
        place = f" on {equation}"
        name = name.removesuffix(place) + place
    effect = file.meant(model, name)
    free = model.add(effect).free
    backup = add_effects(path, [str(effect)])
    content = {
        "added": str(effect),
        "unknowns": [one for one in free if one not in model.entries],
        "study_file": str(path),
        "backup": str(backup),
    }
    return Answer(lines(__package__, "added", **content), content)


def effects_of(path: Path | None) -> Answer:
    """The catalogue: of the model of a study file, or (None) all of it."""
    if path is None:
        rows = [_told(name, adds, {}) for name, adds in laws_told().items()]
    else:
        file = StudyFile.read(path)
        rows = list(_effects_told(file, file.model()))
    text = lines(__package__, "effects", path=path, listing=_listing(rows))
    return Answer(text, {"effects": rows})


def _effects_told(file: StudyFile, model: Model) -> Iterator[dict[str, Any]]:
    units = in_si(file.data.units)
    for effect, adds in effects_told(model, units):
        if effect.slot != "sensor" or file.data.states[effect.equation].measured:
            larger = model.add(effect)
            known = parameter_units(larger, units)
            new = filterfalse(model.entries.__contains__, larger.free)
            yield _told(str(effect), adds, {name: known[name] for name in new})
    for effect in file.own_effects:
        yield _told(str(effect), "an effect of your own", {})


def _told(name: str, adds: str, units: Mapping[str, str]) -> dict[str, Any]:
    others = list(law_of(name).others)
    return {"effect": name, "adds": adds, "units": units, "also_called": others}


def _listing(rows: Sequence[Mapping[str, Any]]) -> str:
    """Names with what is told of each beside it, within the width of a terminal."""
    width = 2 + max(len(row["effect"]) for row in rows)
    listed = []
    for row in rows:
        units = [f"{name} in {unit}" for name, unit in row["units"].items() if unit]
        head = row["effect"]
        for text in (row["adds"], ", ".join(units), ", ".join(row["also_called"])):
            for line in wrap(text, LINE_WIDTH - width):
                listed.append(f"{head:{width}}{line}")
                head = ""
    return "\n".join(listed)


def written_demonstration(folder: Path) -> Path:
    """Write table and study file into a folder; the path of the study file."""
    shipped = files("phsi_opt.study_file") / "examples" / "spring"
    make_folder(folder)
    for name in DEMO_FILES:
        otherwise = "give another folder: phsi-opt demo FOLDER."
        write_new(folder / name, (shipped / name).read_bytes(), otherwise)
    return folder / "study.toml"

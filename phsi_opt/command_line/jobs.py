"""What the commands do.

Here: init, check, add, and the files of the demonstration. In the working process:
fit, compare, diagnose, and study.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from phsi_opt.command_line.job import (
    COMPARE,
    DIAGNOSE,
    FIT,
    Answer,
    ExitCode,
    Finished,
    Job,
    Message,
    answer_to,
)
from phsi_opt.comparison.compare import Comparison, compare
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Verdict
from phsi_opt.diagnosis.diagnose import diagnose
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.errors import (
    Complaint,
    DataError,
    ModelError,
    SolveError,
    StudyFileError,
)
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.catalogue import catalogue
from phsi_opt.presentation.numbers import number_of
from phsi_opt.presentation.sentences import lines
from phsi_opt.reading import file_bytes
from phsi_opt.study import Study
from phsi_opt.study_file.study_file import StudyFile
from phsi_opt.study_file.survey import check_alike, first_text, survey, unfilled
from phsi_opt.study_file.toml_text import add_effects
from phsi_opt.transcription.grid import AlignedData
from phsi_opt.writing import write_whole

Tell = Callable[[Message], None]
DEMO_FILES = ("friction_spring.csv", "study.toml")


# ---- the study file itself -----------------------------------------------------------


def first_study(tables: list[Path], study: Path, force: bool) -> Answer:
    """Write a study file; nothing that is there is overwritten unless forced.

    Raises:
        DataError: the table cannot be read, or the study file is there already.
    """
    if study.exists() and not force:
        raise DataError(
            f"{study} exists already; nothing was written. Give another name with "
            "--study, or overwrite it with --force."
        )
    table = survey(tables[0])
    for further in tables[1:]:
        other = survey(further)
        check_alike(table.columns, other.columns, str(other.path))
    write_whole(study, first_text(table, tables, study.parent))
    needs: tuple[Complaint, ...] = ()
    try:
        StudyFile.read(study)
    except StudyFileError as error:
        needs = error.complaints
    facts = {"table": table, "study": study, "path": tables[0], "needs": needs}
    content = {
        "study_file": str(study),
        "columns": [column.content for column in table.columns],
        "further": list(map(vars, table.table.further)),
        "needs": list(map(vars, needs)),
    }
    return Answer(lines(__package__, "first_study", **facts), content)


def checked(path: Path) -> Answer:
    """A summary of a study file, or everything that is wrong, and what stands empty.

    Raises:
        StudyFileError: it cannot be read, or is no TOML.
    """
    empty = unfilled(path)
    try:
        file = StudyFile.read(path)
        file.check_formulas()
        answer = _summary(path, file)
        has_dates = any(run.origin is not None for run in file.measurements())
        empty = unfilled(path, has_dates)
    except StudyFileError as error:
        answer = answer_to(error)
    except ModelError as error:
        wrong = StudyFileError(path, [Complaint("model", "", str(error))])
        answer = answer_to(wrong)
    text = lines(__package__, "checked", text=answer.text, empty=empty)
    content = {**answer.content, "empty": list(empty)}
    return Answer(text, content, answer.code)


def _summary(path: Path, file: StudyFile) -> Answer:
    """What a study file that can be used holds."""
    train, held_out = file.split()
    model = file.model()
    notes = AlignedData.of(model, train).notes
    text = lines(
        __package__,
        "summary",
        path=path,
        measurements=file.measurements(),
        train=train,
        held_out=held_out,
        runs=_runs,
        model=model,
        kind=type(model).__name__,
        added=file.steps.added,
        n_effects=len(catalogue(model, file.data.units)),
        notes=notes,
    )
    content = {
        "states": list(model.states),
        "inputs": list(model.inputs),
        "measured": list(train.measured),
        "free": list(model.free),
        "added": list(file.steps.added),
        "n_runs": file.measurements().n_trajectories,
        "n_samples": file.measurements().n_samples,
        "n_held_out": 0 if held_out is None else held_out.n_samples,
        "warnings": list(notes),
    }
    return Answer(text, content)


def _runs(data: Measurements) -> str:
    return f"{number_of(data.n_trajectories, 'run')}, {data.n_samples} samples"


def add_effect(path: Path, name: str, equation: str | None) -> Answer:
    """Write an effect into a study file, if the model can have it.

    Raises:
        StudyFileError: the file cannot be used as it is.
        DataError: the file is written in a way that cannot be changed safely.
        ModelError: there is no such effect, or the model has it.
    """
    file = StudyFile.read(path)
    model = file.model()
    if equation is not None:
        model.index(equation, "--equation")
        place = f" on {equation}"
        name = name.removesuffix(place) + place
    effect = file.meant(model, name)
    larger = model.add(effect)
    backup = add_effects(path, [str(effect)])
    free = [one for one in larger.free if one not in model.entries]
    facts = {"effect": effect, "path": path, "free": free, "backup": backup}
    content = {
        "added": str(effect),
        "unknowns": free,
        "study_file": str(path),
        "backup": str(backup),
    }
    return Answer(lines(__package__, "added", **facts), content)


def written_demonstration(folder: Path) -> Path:
    """Write table and study file into a folder; the path of the study file.

    Raises:
        DataError: another file is there, or the folder cannot be written.
    """
    shipped = files("phsi_opt.command_line") / "demo_data"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in DEMO_FILES:
            text = (shipped / name).read_bytes()
            place = folder / name
            if place.exists() and file_bytes(place) != text:
                raise DataError(
                    f"{place} exists already with changes, and was not overwritten. "
                    "Give another folder: phsi-opt demo FOLDER."
                )
            place.write_bytes(text)
    except OSError as error:
        raise DataError(f"{folder} cannot be written ({error}).") from None
    return folder / "study.toml"


# ---- fit, compare, diagnose, study ---------------------------------------------------


def run(job: Job, tell: Tell) -> Answer:
    """Do a job.

    Args:
        job: what to do.
        tell: called with what is being done, and after every step that is finished.

    Raises:
        PhsiOptError: something cannot be used, or no solution was found.
    """
    tell("reading the study file and the data")
    file = StudyFile.read(job.study)
    if job.fit is not None:
        return _of_saved_fit(job, file, tell)
    keeper = _Keeper(job, tell, len(file.steps.added))
    study = file.study(keeper.progress, keeper.step_finished)
    if job.kind == FIT:
        answer = _fit_answer(study.fit)
    elif job.kind == COMPARE:
        answer = _compare_answer(study.compare())
    elif job.kind == DIAGNOSE:
        answer = _diagnose_answer(study.diagnose(), job)
    else:
        try:
            answer = _study_answer(study, job, file)
        except Exception as error:
            why = f"the study failed: {error}"
            study.record = replace(study.record, stopped=why)
            keeper.step_finished(study)
            raise
    keeper.step_finished(study, is_last=True)
    return answer


def _of_saved_fit(job: Job, file: StudyFile, tell: Tell) -> Answer:
    """Compare or diagnose a fit that was saved."""
    fit = Fit.load(str(job.fit))
    train, held_out = file.split()
    if job.kind == COMPARE:
        return _compare_answer(compare(fit, held_out or train))
    found = diagnose(
        fit,
        train,
        held_out,
        effects=file.effects(),
        without=file.steps.without,
        loss=file.loss,
        progress=tell,
    )
    return _diagnose_answer(found, job)


# ---- what is kept --------------------------------------------------------------------


@dataclass
class _Keeper:
    """Writes fit and report after each step, and tells what there is."""

    job: Job
    tell: Tell
    n_known: int  # effects that the study file has
    study: Study | None = None
    n_kept: int = 0

    def progress(self, line: str) -> None:
        if self.study is not None and len(self.study.steps) != self.n_kept:
            self.step_finished(self.study)
        self.tell(line)

    def step_finished(self, study: Study, is_last: bool = False) -> None:
        self.study = study
        self.n_kept = len(study.steps)
        files: list[Path] = []
        if self.job.save is not None:
            study.fit.save(self.job.save)
            files.append(self.job.save)
        if self.job.report is not None:
            try:
                files.append(study.report(self.job.report))
            except SolveError as error:
                if is_last:  # on the way it does not end the study
                    raise
                self.tell(f"no report of this step: {error}")
        found = tuple(map(str, study.added[self.n_known :]))
        content = plain({"history": study.history, "found": found})
        self.tell(Finished(str(study.history), content, tuple(files), found))


# ---- answers -------------------------------------------------------------------------


def _fit_answer(fit: Fit) -> Answer:
    text = "\n".join([str(fit), "", *fit.equations()])
    content = {
        "equations": fit.equations(),
        "parameters": fit.parameters,
        "noise": fit.noise,
        "bic": fit.bic,
        "success": fit.outcome.success,
        "outcome": str(fit.outcome),
        "warnings": fit.warnings,
        "provenance": fit.provenance,
    }
    return Answer(text, plain(content))


def _compare_answer(comparison: Comparison) -> Answer:
    content = {
        "rmse": comparison.rmse,
        "noise_floor": comparison.noise_floor,
        "n_samples": comparison.data.n_samples,
        "states": comparison.table,
        "warning": comparison.warning,
    }
    return Answer(str(comparison), plain(content))


def _diagnose_answer(found: Diagnosis, job: Job) -> Answer:
    content = {
        "verdict": str(found.verdict),
        "reason": found.reason,
        "proposed": found.proposed,
        "sentences": found.sentences,
        "next": str(found.next_step),
        "candidates": found.candidates,
    }
    text = lines(__package__, "diagnosis", found=found)
    return Answer(text, plain(content), _code(found, job))


def _code(found: Diagnosis, job: Job) -> int:
    is_missing = found.verdict != Verdict.NOTHING_MISSING
    return ExitCode.MISSING if job.exit_code and is_missing else ExitCode.DONE


def _study_answer(study: Study, job: Job, file: StudyFile) -> Answer:
    code = ExitCode.DONE
    advice = ""
    if job.is_auto:
        study.auto(job.max_steps or file.steps.max_steps, reach=job.reach)
        code = ExitCode(_code(study.diagnose(), job))
        advice = str(study.diagnose().next_step)
    content = study.content()
    told = {one.question: str(one) for one in content.headline.answers}
    listed = {
        "next": advice,
        "stopped": study.stopped,
        "history": study.history,
        "added": content.added,
        "unestablished": content.unestablished,
        "verdict": content.headline.status if job.is_auto else None,
        "sentence": content.headline.sentence,
        "answers": told,
        "equations": study.fit.equations(),
        "unit": study.unit,
    }
    text = lines(__package__, "study", study=study, content=content, advice=advice)
    return Answer(text, plain(listed), code)


# ---- tables and numbers --------------------------------------------------------------


def plain(value: Any) -> Any:
    """A value for JSON: rows of tables, null for what is not finite, else its text."""
    text = json.dumps(value, default=_simpler)
    return json.loads(text, parse_constant=lambda _: None)


def _simpler(value: Any) -> Any:
    if isinstance(value, pd.DataFrame):
        return value.to_dict("records")
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return dict(value) if isinstance(value, Mapping) else str(value)

"""What the commands do in the working process: fit, compare, diagnose, and study."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from phsi_opt.arguments import require
from phsi_opt.command_line.job import (
    COMPARE,
    DIAGNOSE,
    EXPERIMENT,
    EXPORT,
    FIT,
    Answer,
    ExitCode,
    ExperimentPlan,
    Finished,
    Job,
    Message,
)
from phsi_opt.comparison.compare import Comparison, compare
from phsi_opt.diagnosis.candidate import Verdict
from phsi_opt.diagnosis.diagnose import diagnose
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.errors import SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.presentation.content import Answer as Told
from phsi_opt.presentation.units import scale_of
from phsi_opt.study import Study
from phsi_opt.study_file.kept_fits import KeptFits
from phsi_opt.study_file.study_file import StudyFile

Tell = Callable[[Message], None]


# ---- fit, compare, diagnose, study ---------------------------------------------------


def run(job: Job, tell: Tell) -> Answer:
    """Do a job."""
    tell("reading the study file and the data")
    file = StudyFile.read(job.study)
    if job.fit is not None:
        return _of_saved_fit(job, file, tell)
    kept = KeptFits.of(job.study, file, file.split()[0])
    if kept.with_effects() is not None:
        tell(f"reusing earlier fits ({kept.path})")
    keeper = _Keeper(job, tell, len(file.steps.added), kept)
    study = file.study(keeper.progress, keeper.step_finished, kept)
    if job.kind == FIT:
        answer = _fit_answer(study.fit)
    elif job.kind == COMPARE:
        answer = _compare_answer(study.compare())
    elif job.kind == DIAGNOSE:
        answer = _diagnose_answer(study.diagnose(), job)
    elif job.kind == EXPERIMENT and job.plan is not None:
        answer = _experiment_answer(study, job.plan)
    elif job.figures is not None:
        study.diagnose()
        answer = _export_answer(study.export_figures(job.figures, job.kinds))
    elif job.kind == EXPORT:
        answer = _exported(study.fit, study.record.last.held_out, job)
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
    fit = Fit.load(str(job.fit))
    train, held_out = file.split()
    if job.kind == COMPARE:
        return _compare_answer(compare(fit, held_out or train))
    if job.kind == EXPORT:
        compared = None if held_out is None else compare(fit, held_out)
        return _exported(fit, compared, job)
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
    kept: KeptFits  # what the next command need not fit
    study: Study | None = None
    n_kept: int = 0

    def progress(self, line: str) -> None:
        if self.study is not None and len(self.study.steps) != self.n_kept:
            self.step_finished(self.study)
        self.tell(line)

    def step_finished(self, study: Study, is_last: bool = False) -> None:
        self.study = study
        self.n_kept = len(study.steps)
        self.kept.keep(study)
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
        content = plain({"history": study.history})
        self.tell(Finished(str(study.history), content, tuple(files), found))


# ---- answers -------------------------------------------------------------------------


def _fit_answer(fit: Fit) -> Answer:
    equations = fit.equations()
    scales = {name: scale_of(fit.units.get(name, "")) for name in fit.noise}
    content = {
        "equations": equations,
        "parameters": fit.parameters,
        "noise": {name: sd / scales[name].size for name, sd in fit.noise.items()},
        "units": {name: scale.unit for name, scale in scales.items()},
        "bic": fit.bic,
        "success": fit.outcome.success,
        "outcome": str(fit.outcome),
        "warnings": fit.warnings,
        "provenance": fit.provenance,
    }
    return Answer("\n".join([str(fit), "", *equations]), plain(content))


def _compare_answer(comparison: Comparison) -> Answer:
    content = {
        "rmse": comparison.rmse,
        "noise_floor": comparison.noise_floor,
        "unit": comparison.error_unit,
        "n_samples": comparison.data.n_samples,
        "states": comparison.table,
        "warning": comparison.warning,
    }
    return Answer(str(comparison), plain(content))


def _exported(fit: Fit, compared: Comparison | None, job: Job) -> Answer:
    assert job.export is not None
    path = fit.export(job.export, compared)
    content = {
        "exported": path,
        "states": fit.model.states,
        "inputs": fit.model.inputs,
        "parameters": fit.values,
        "rmse": None if compared is None else compared.rmse,
        "unit": None if compared is None else compared.error_unit,
    }
    return Answer(f"exported: {path}", plain(content))


def _diagnose_answer(found: Diagnosis, job: Job) -> Answer:
    content = {
        "verdict": str(found.verdict),
        "reason": found.reason,
        "proposed": found.proposed,
        "answers": list(map(_listed, found.answers)),
        "warning": found.warning,
        "candidates": found.candidates,
    }
    return Answer(str(found), plain(content), _code(found, job))


def _experiment_answer(study: Study, plan: ExperimentPlan) -> Answer:
    units = study.train.units
    limits = dict(_ranges(text, units, "--limit") for text in plan.limits)
    starts = dict(_ranges(text, units, "--start") for text in plan.starts)
    if plan.sharpen is None:
        study.diagnose()
    found = study.next_experiment(limits, starts, plan.sharpen)
    content = {
        "kind": found.kind,
        "log_bayes": found.log_bayes,
        "std_errors": found.std_errors,
        "x0": found.x0,
        "table": str(found.to_csv(plan.table)),
    }
    text = f"{found}\nTimes and inputs: {plan.table}"
    return Answer(text, plain({"sentence": found.sentence, **content}))


def _ranges(text: str, units: Mapping[str, str], option: str) -> tuple[str, Any]:
    """A name with a number, or with two, in the units that are computed with."""
    name, _, values = text.rpartition("=")
    try:
        numbers = [float(value) for value in values.split(":")]
    except ValueError:
        numbers = []
    expected = "a name with a number, or with two, such as u=-5:5"
    require(bool(name) and len(numbers) in (1, 2), option, text, expected)
    scale = scale_of(units.get(name.strip(), ""))
    read = [float(scale.read(number)) for number in numbers]
    return name.strip(), read[0] if len(read) == 1 else tuple(read)


def _export_answer(paths: list[Path]) -> Answer:
    files = list(map(str, paths))
    return Answer("\n".join([f"{len(files)} files:", *files]), {"files": files})


def _listed(one: Told) -> dict[str, Any]:
    return {"kind": one.question, "sentence": str(one), "numbers": one.numbers}


def _code(found: Diagnosis, job: Job) -> int:
    is_missing = found.verdict != Verdict.NOTHING_MISSING
    return ExitCode.MISSING if job.exit_code and is_missing else ExitCode.DONE


def _study_answer(study: Study, job: Job, file: StudyFile) -> Answer:
    code = ExitCode.DONE
    if job.is_auto:
        study.auto(job.max_steps or file.steps.max_steps, reach=job.reach)
        code = ExitCode(_code(study.diagnose(), job))
    content = study.content()
    discovery = replace(content.headline.discovery, question="What was found")
    listed = {
        "stopped": study.stopped,
        "history": study.history,
        "final_rmse": [one.rmse for one in study.record.final_comparisons],
        "added": content.added,
        "unestablished": [one.name for one in study.record.unestablished],
        "verdict": content.headline.status if job.is_auto else None,
        "answers": [*map(_listed, (discovery, *content.headline.answers))],
        "equations": study.fit.equations(),
        "unit": study.unit,
    }
    return Answer(f"{study.fit}\n\n{study}", plain(listed), code)


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

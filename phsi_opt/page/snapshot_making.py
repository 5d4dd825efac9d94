"""Snapshots from a study, in the worker."""

from typing import Any

import pandas as pd

from phsi_opt.comparison.compare import Comparison
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.estimation.fit_report import equation_lines
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.localization import window_of
from phsi_opt.force_analysis.units import scale_of_rate
from phsi_opt.page.snapshot import (
    HELD_OUT,
    TRAINING,
    CandidateRow,
    ChannelCurves,
    Diagnosed,
    ErrorStep,
    ForceCurve,
    ParameterRow,
    RunCurves,
    Snapshot,
)
from phsi_opt.presentation.numbers import short_constants
from phsi_opt.presentation.units import scale_of_errors
from phsi_opt.study import Study
from phsi_opt.study.answers import (
    nearest_candidate,
    samples_to_average,
    where_answer,
    wrong_answer,
)
from phsi_opt.study.certainty import (
    certainty_words,
    disturbance_word,
    evidence_words,
    undetermined_words,
)
from phsi_opt.study.headline import verdict_sentence
from phsi_opt.study.since_when import since_when
from phsi_opt.study.step import Step
from phsi_opt.study.summary import unestablished_words


def snapshot_of(study: Study, diagnosis: Diagnosis | None) -> Snapshot:
    """A study as it stands.

    Args:
        study: with at least its base model fitted.
        diagnosis: of the present model; None where there is none yet.
    """
    step = study.steps[-1]
    runs = _runs(step.train, TRAINING)
    if step.held_out is not None:
        runs += _runs(step.held_out, HELD_OUT)
    forces = _forces(step.train.record, TRAINING)
    if step.held_out is not None:
        forces += _forces(step.held_out.record, HELD_OUT)
    return Snapshot(
        unit=scale_of_errors(study.unit)[1],
        t_unit=study.train.units.get("t", ""),
        steps=tuple(_steps(study)),
        added=tuple(str(effect) for effect in study.added),
        equations=tuple(map(short_constants, equation_lines(study.fit))),
        parameters=tuple(_parameters(study.fit.parameters)),
        warning=step.judged.warning,
        caution=undetermined_words(study.fit.parameters),
        runs=tuple(runs),
        forces=tuple(forces),
        diagnosed=None if diagnosis is None else _diagnosed(diagnosis, step),
        stopped=study.stopped,
        unestablished=unestablished_words(study.record),
    )


def _steps(study: Study) -> list[ErrorStep]:
    size, _ = scale_of_errors(study.unit)
    steps = []
    for number, step in enumerate(study.steps):
        held_out = None if step.held_out is None else size * step.held_out.rmse
        train = size * step.train.rmse
        floor = size * step.judged.noise_floor
        steps.append(ErrorStep(number, step.label, train, held_out, floor))
    return steps


def _parameters(table: pd.DataFrame) -> list[ParameterRow]:
    rows = []
    for _, row in table.iterrows():
        value = float(row["value"])
        std_error = float(row["std_error"])
        rows.append(ParameterRow(str(row["name"]), value, std_error, str(row["unit"])))
    return rows


def _runs(comparison: Comparison, part: str) -> list[RunCurves]:
    runs = []
    for number, run in enumerate(comparison.data.trajectories):
        channels = []
        for k, name in enumerate(comparison.model.states):
            if name in comparison.data.measured:
                unit = comparison.data.units.get(name, "")
                shown = comparison.shown[number][:, k]
                noise = float(comparison.sigma[k])
                measured = run.x[:, k]
                channels.append(ChannelCurves(name, unit, measured, shown, noise))
        curves = RunCurves(run.name, part, run.t, tuple(channels), run.origin)
        runs.append(curves)
    return runs


def _diagnosed(diagnosis: Diagnosis, step: Step) -> Diagnosed:
    is_held_out = step.held_out is not None
    proposed = "".join(map(str, diagnosis.proposed[:1]))
    nearest = nearest_candidate(diagnosis)
    return Diagnosed(
        verdict=str(diagnosis.verdict),
        reason=diagnosis.reason,
        is_missing=diagnosis.verdict != Verdict.NOTHING_MISSING,
        is_named=bool(diagnosis.findings),
        certainty=certainty_words(diagnosis),
        beside=disturbance_word(diagnosis),
        sentences=tuple(diagnosis.sentences),
        **_strongest(diagnosis),
        missing=verdict_sentence(diagnosis, is_held_out),
        wrong=wrong_answer(diagnosis, is_held_out),
        where=where_answer(diagnosis),
        since=since_when(diagnosis, step.train),
        to_do=diagnosis.next_step,
        proposed=proposed,
        nearest="" if nearest is None else nearest.name,
        averaged=samples_to_average(diagnosis),
        candidates=tuple(_candidates(diagnosis, proposed)),
    )


def _strongest(diagnosis: Diagnosis) -> dict[str, Any]:
    """Equation, run and window of the surest missing force; empty where none is."""
    force = diagnosis.analysis.force_in()
    if force.is_uncertain:
        return {"equation": "", "run": "", "window": None}
    return {
        "equation": force.equation,
        "run": str(force.where["trajectory"]),
        "window": window_of(str(force.where["time_window"])),
    }


def _candidates(diagnosis: Diagnosis, proposed: str) -> list[CandidateRow]:
    size, _ = scale_of_errors(diagnosis.base.error_unit)
    rows = []
    for candidate in diagnosis.ranking:
        rows.append(
            CandidateRow(
                effect=candidate.name,
                evidence=evidence_words(candidate),
                coefficient=float(candidate.coefficient),
                std_error=float(candidate.std_error),
                unit=candidate.unit,
                train=size * float(candidate.train_rmse),
                held_out=size * float(candidate.held_out_rmse),
                confusable_with=candidate.confusable_with,
                lost=candidate.lost,
                is_proposed=candidate.name == proposed,
            )
        )
    return rows


def _forces(record: Record, part: str) -> list[ForceCurve]:
    """The missing force of a record, by equation and run."""
    estimate = record.estimate
    grid = estimate.grid
    t = grid.t[grid.begin] + grid.h / 2
    run_of = grid.trajectory[grid.begin]
    deviation = estimate.posterior.deviation
    units = record.data.units
    longest = float(t.max())
    forces = []
    for number, run in enumerate(record.data.trajectories):
        inside = run_of == number
        for column, row in enumerate(estimate.rows):
            equation = record.model.states[row]
            scale = scale_of_rate(equation, units, longest)
            forces.append(
                ForceCurve(
                    run=run.name,
                    part=part,
                    equation=equation,
                    unit=scale.unit,
                    t=t[inside],
                    force=estimate.w[inside, column] / scale.size,
                    std=deviation[inside, column] / scale.size,
                    origin=run.origin,
                )
            )
    return forces

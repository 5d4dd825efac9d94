"""The content of a study: numbers, arrays and words, in the order of reading."""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from itertools import starmap
from typing import Any

import numpy as np
import pandas as pd

from phsi_opt.comparison.compare import HORIZON_RESIDUAL, Comparison
from phsi_opt.criteria import FAILING_ERROR, SURE_LEVEL, WHITE_ERROR
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.errors import some_of
from phsi_opt.estimation.fit import Fit, equation_lines
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.pictures import force_of, force_runs, samples_of_each
from phsi_opt.model.kinds import MECHANICAL
from phsi_opt.model.laws import parameter_symbols, parameter_words
from phsi_opt.model.structure import kind_of, position_of_momentum
from phsi_opt.model.typeset import typeset_equations
from phsi_opt.presentation.content import (
    BAD,
    GOOD,
    HELD_OUT,
    LOOK,
    TRAINING,
    Answer,
    Check,
    Diagnosed,
    Equations,
    Follows,
    ForceRun,
    Headline,
    ParameterRow,
    Ranked,
    Run,
    StudyContent,
    foremost,
    thinned,
)
from phsi_opt.presentation.numbers import (
    called,
    label,
    number_of,
    proper_names,
    said,
    short_constants,
    short_repr,
    with_error,
)
from phsi_opt.presentation.sentences import say
from phsi_opt.presentation.units import Scale, scale_of, scale_of_time
from phsi_opt.screening.effect_size import NOT_DETERMINED, names_beside_size
from phsi_opt.study.answers import (
    evidence_words,
    headline_of,
    nearest_candidate,
    odds_words,
    said_of,
    samples_to_average,
    stopped_words,
)
from phsi_opt.study.record import Step, StudyRecord

HOLD_WORDS = {
    "zero": "constant until the next sample (zero-order hold)",
    "linear": "linear between samples",
    "cubic": "smooth, by a cubic spline through the samples",
}
SUBJECTS = {
    "size": "size of residuals",
    "whiteness": "correlation of the residuals",
    "horizon": "length of a good free run",
}
HELPS = "not fitted; they help to choose effects"  # of held-out data
SEEDS = "fixed in the package: the same data and settings give the same numbers"
LIBRARIES = ("phsi_opt", "casadi", "numpy", "scipy", "pandas")


def study_content(
    study: StudyRecord,
    laws: tuple[Follows, ...] = (),
    *,
    forces: bool = False,
    written: str = "",
    most: int | None = None,
) -> StudyContent:
    """What is told of a study; of each run so many samples are drawn at most."""
    data = filter(None, (study.train, study.held_out))
    longest = max(float(run.t[-1]) for part in data for run in part)
    time = scale_of_time(longest, study.train.units.get("t", ""))
    last = len(study.steps) - 1
    # Whose free runs are drawn: base, first, last.
    steps = {k: study.steps[k] for k in sorted({0, min(1, last), last})}
    runs = _runs(study, list(steps.values()), time, most)
    size, unit = study.error_scale
    errors = study.errors(size)
    names = [steps[0].label]
    for k in list(steps)[1:]:
        names.append(f"step {k}: {proper_names(errors[k].change(k))}")
    labels = study.train.labels
    models = [_model("Base model", study.steps[0].fit, labels)]
    if last:
        added = study.told(*study.last.added)
        heading = f"Present model: with {added}" if added else "Present model"
        models.append(_model(heading, study.last.fit, labels))
    measured = study.train.measured
    units = (scale_of(study.train.units.get(name, "")).unit for name in measured)
    channels = list(map(partial(called, labels=labels), measured))
    # The run that judges, and its channel, in which the models differ most.
    judging = [run for run in runs if run.part == runs[0].part]  # the first ones
    shown, shown_channel = foremost(judging, lambda one: one.change)
    described = said_of(study, "subtitle", origin=runs[0].origin, written=written)
    floor = study.last.judged.noise_floor
    is_overfitted = study.last.judged.rmse > 2 * floor > 0
    is_overfitted = is_overfitted and study.last.train.rmse < FAILING_ERROR * floor
    errors_told = said_of(study, "how_errors_stand", is_overfitted=is_overfitted)
    headline = headline_of(study)
    return StudyContent(
        title=study.title or f"Study of {', '.join(map(label, channels, units))}",
        subtitle=described.lead,
        headline=headline,
        steps=errors,
        unit=unit,
        errors=errors_told.lead,
        models=tuple(models),
        symbols=_symbols(study, models[-1]),
        time=time,
        names=tuple(names),
        runs=runs,
        shown=shown,
        shown_channel=shown_channel,
        runs_caption=said_of(study, "runs", n_drawn=len(runs)).lead,
        forces=_all_forces(study, time) if forces else (),
        laws=laws,
        diagnoses=tuple(_diagnosed(study, k, time) for k in sorted(study.diagnoses)),
        is_diagnosed=study.present is not None,
        checks=_checks(study),
        settings=_settings(study, headline),
        code=_code(study),
        added=tuple(map(str, study.last.added)),
        stopped=stopped_words(study),
        unestablished=tuple(study.told(one.effect) for one in study.unestablished),
        hold=study.train.hold,
    )


# ---- models --------------------------------------------------------------------------


def _model(heading: str, fit: Fit, labels: Mapping[str, str]) -> Equations:
    intervals = fit.intervals()
    rows = []
    for _, row in fit.parameters.iterrows():
        rows.append(_parameter(fit, row, intervals, labels))
    lines = tuple(map(short_constants, equation_lines(fit)))
    equations = typeset_equations(fit.model, fit.values, fit.units.get("t", ""))
    return Equations(proper_names(heading), lines, tuple(rows), equations)


def _symbols(study: StudyRecord, present: Equations) -> str:
    """What the letters in equations are, as far as their names do not tell."""
    model = study.last.fit.model
    told = dict(study.train.labels)
    for momentum, position in position_of_momentum(model).items():
        is_body = model.has_energy and kind_of(model, position) in ("", MECHANICAL)
        if is_body and momentum not in study.train.measured:
            told[momentum] = f"the momentum of {called(position, study.train.labels)}"
    for one in present.parameters:
        if one.symbol:
            told[one.symbol] = one.name
    return ", ".join(starmap("{} is {}".format, told.items()))


def _parameter(
    fit: Fit, row: pd.Series, intervals: pd.DataFrame, labels: Mapping[str, str]
) -> ParameterRow:
    name = str(row["name"])
    value = float(row["value"])
    std_error = float(row["std_error"])
    entry = fit.entry(name)
    parameter = entry.parameter
    scale = scale_of(fit.parameter_units[entry.name])
    ends: tuple[float | None, float | None] = (None, None)
    remark = "no standard error"
    if name in intervals.index:
        lower, upper = map(float, intervals.loc[name, ["ci_lower", "ci_upper"]])
        low = max(lower, parameter.lower)
        high = min(upper, parameter.upper)
        if np.isfinite([lower, upper, low, high]).all():
            ends = (scale.shown(low), scale.shown(high))
            remark = "" if (low, high) == (lower, upper) else "cut at its bound"
    if name in fit.outcome.at_bounds:
        remark = "at its bound"
        value = scale.shown(parameter.nearest_bound(scale.read(value)))
        std_error = np.nan
    elif row["fixed"]:
        remark = "fixed"
    told = proper_names(parameter_words(fit.model, name, labels))
    symbol = parameter_symbols(fit.model).get(name, "") if "." not in name else ""
    unit = str(row["unit"])
    return ParameterRow(told, value, std_error, *ends, remark, unit, symbol)


# ---- measurements beside free runs ---------------------------------------------------


def _runs(
    study: StudyRecord, steps: Sequence[Step], time: Scale, most: int | None
) -> tuple[Run, ...]:
    """The trajectories that are drawn, at most 200, those held out first."""
    held_out = [step.held_out for step in steps if step.held_out is not None]
    parts = {HELD_OUT: held_out, TRAINING: [step.train for step in steps]}
    places = []
    for part, compared in parts.items():
        places += [(part, k) for k in range(len(compared[0].data) if compared else 0)]
    places = places[:200]
    most = most or samples_of_each(len(places) * len(study.last.judged.noise))
    return tuple(_run(part, parts[part], k, most, time) for part, k in places)


def _run(
    part: str, comparisons: list[Comparison], place: int, most: int, time: Scale
) -> Run:
    run = comparisons[0].data.trajectories[place]
    channels = []
    of_each = [one.channels(place) for one in comparisons]
    for alike in zip(*of_each, strict=True):
        last = alike[-1]
        shown = [one.models[0] for one in alike]
        kept = thinned([last.measured, *shown], most)
        channel = replace(
            last,
            t=last.t[kept] / time.size,
            measured=last.measured[kept],
            models=tuple(one[kept] for one in shown),
            errors=tuple(one.errors[0] for one in alike),
        )
        channels.append(channel)
    return Run(run.name, part, tuple(channels), run.origin)


# ---- what is missing -----------------------------------------------------------------


def _diagnosed(study: StudyRecord, place: int, time: Scale) -> Diagnosed:
    """The diagnosis of a step's model; ``place``: number of the step."""
    diagnosis = study.diagnoses[place]
    label = study.called(study.steps[place].label)
    heading = f"After step {place} ({label})"
    if place == 0:
        heading = f"Base model ({label})".replace(" (base model)", "")
    nearest = nearest_candidate(diagnosis)
    forces = diagnosis.analysis.strongest_first
    sure = [force for force in forces if not force.is_uncertain]
    return Diagnosed(
        proper_names(heading),
        diagnosis.answers,
        str(diagnosis.verdict),
        tuple(force_of(force, time) for force in sure[:4]),
        _ranking(study, place),
        tuple(map(str, diagnosis.proposed)),
        "" if nearest is None else nearest.name,
        samples_to_average(diagnosis),
    )


def _all_forces(study: StudyRecord, time: Scale) -> tuple[ForceRun, ...]:
    """The missing force of the present model, by part, equation and run."""
    found: list[ForceRun] = []
    parts = {TRAINING: study.last.train, HELD_OUT: study.last.held_out}
    for part, compared in parts.items():
        for force in ForceAnalysis.of(compared.record).forces if compared else ():
            found += force_runs(force, part, time)
    return tuple(found)


def _ranking(study: StudyRecord, place: int) -> tuple[Ranked, ...]:
    """The candidates, best first; errors in the unit in which they are told."""
    diagnosis = study.diagnoses[place]
    size, _ = study.error_scale
    classes: dict[str, list[str]] = {}
    for finding in diagnosis.findings:
        names = list(map(str, finding.effects))
        classes |= dict.fromkeys(names, names)
    words = {}
    for one in diagnosis.ranking:
        words[one.name] = study.told(one.effect)
    ranked = []
    for one in diagnosis.ranking:
        alike = dict.fromkeys([*classes.get(one.name, []), *one.confusable_with])
        alike.pop(one.name, None)
        is_sized = not one.lost or np.isfinite(one.std_error)
        size_words = said(one.size.words(one.effect)) if is_sized else NOT_DETERMINED
        found = Ranked(
            one.name,
            "; ".join(filter(None, (size_words, _beside_size(diagnosis, one)))),
            evidence_words(one),
            _known(np.clip(one.share, 0.0, 1.0)),
            _known(size * one.train_rmse),
            _known(size * one.held_out_rmse),
            tuple(words.get(name, name) for name in alike),
            one.lost,
            "" if one.lost else odds_words(one.log_evidence),
            one.was_weighed and one.log_evidence > 0,
            words[one.name],
        )
        ranked.append(found)
    return tuple(ranked)


def _beside_size(diagnosis: Diagnosis, one: Candidate) -> str:
    """The other parameters of an effect that was re-fitted."""
    if one.fit is None:
        return ""
    names = names_beside_size(diagnosis.base.fit.model, one.effect, one.fit.names)
    rows: Any = one.fit.parameters.set_index("name").loc[names].itertuples()
    told = []
    for row in rows:
        size = with_error(row.value, row.std_error, row.unit)
        words = parameter_words(one.fit.model, row.Index, diagnosis.data.labels)
        told.append(f"{words} = {size}")
    return ", ".join(told)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


# ---- checks of what remains --------------------------------------------------------


def _checks(study: StudyRecord) -> tuple[Check, ...]:
    """Size, whiteness and horizon by channel; then the fit's and the data's."""
    judged = study.last.judged
    checks: list[Check] = []
    for _, row in judged.table.iterrows():
        checks += _of_channel(row, judged, study.train)
    fit = study.last.fit
    if study.last.cautioned.caution or not fit.outcome.success:
        severity = LOOK if fit.outcome.success else BAD
        told = f"{fit.outcome.sentence} {fit.outcome.advice}".strip()
        checks.append(Check("solver", severity, told))
    if fit.outcome.at_bounds:
        words = partial(parameter_words, fit.model, labels=study.train.labels)
        bounds = ", ".join(map(words, fit.outcome.at_bounds))
        checks.append(Check("bounds", LOOK, f"at a bound: {bounds}"))
    checks += (Check("fit", LOOK, remark) for remark in fit.warnings)
    notes = study.judging_notes
    if study.judging is None:
        notes = ("no data were held out; errors are those of the training data",)
    checks += (Check("data held out", LOOK, note) for note in notes)
    return tuple(checks)


def _of_channel(row: pd.Series, judged: Comparison, data: Measurements) -> list[Check]:
    """Whether residuals are as small and as random as noise, and for how long."""
    unit_of_time = data.units.get("t", "")
    ratio = float(row["rmse"]) / float(row["noise_floor"])
    shortest = min(float(run.t[-1] - run.t[0]) for run in judged.data.trajectories)
    horizon = float(row["horizon"]) * scale_of(unit_of_time).size
    whiteness = float(row["whiteness"])  # NaN: of too few samples
    is_small = ratio <= FAILING_ERROR
    is_far = ratio > WHITE_ERROR
    is_white = whiteness >= SURE_LEVEL
    is_coloured = whiteness < SURE_LEVEL and not is_small
    holds = horizon > 0.999 * shortest  # but for rounding
    # Whether each is good, and whether it is bad.
    found = {
        "size": (is_small, is_far),
        "whiteness": (is_white, is_coloured),
        "horizon": (holds, is_far),
    }
    checks = []
    for name, (is_good, is_bad) in found.items():
        severity = GOOD if is_good else BAD if is_bad else LOOK
        told = say(
            __package__,
            f"{name}_check",
            row=row,
            ratio=ratio,
            shortest=shortest,
            horizon=horizon,
            scale=scale_of_time(shortest, unit_of_time),
            most=HORIZON_RESIDUAL,
            sure_level=SURE_LEVEL,
            severity=severity,
        )
        subject = f"{called(row['state'], data.labels)}: {SUBJECTS[name]}"
        checks.append(Check(subject, severity, said(told.lead)))
    return checks


# ---- how it is repeated --------------------------------------------------------------


def _settings(study: StudyRecord, headline: Headline) -> tuple[Answer, ...]:
    units = []
    for name, unit in study.train.units.items():
        scale = scale_of(unit)
        computed = f" (computed in {unit})" if scale.unit != unit else ""
        units += [f"{name}: {scale.unit}{computed}"] if unit else []
    versions = [f"{name} {version(name)}" for name in LIBRARIES]
    hold = study.train.hold
    if not isinstance(hold, str):
        told_holds = (f"{name}: {HOLD_WORDS[word]}" for name, word in hold.items())
        hold = "; ".join(told_holds)
    hold = HOLD_WORDS.get(hold, hold)
    told = {
        "Training data": _data(study.train, "all parameters are fitted to them"),
        "Held-out data": _data(study.held_out, HELPS),
        "Final test": _data(study.final, "looked at once, at the end"),
        "Before fitting": _preparation(study.train),
        "Starting states": "estimated from each whole run, also of held-out data",
        "Units": ", ".join(units) or "not given",
        "Inputs between samples": hold if study.train.inputs else "",
        "Loss": short_repr(study.loss),
        "Solver": study.last.fit.outcome.sentence,
        "How to do what is proposed": headline.next_step.how,
        "Standard errors": str(study.last.fit.std_error_source),
        "Intervals": "95 %, Student's distribution",
        "Seeds": SEEDS,
        "Versions": ", ".join([*versions, f"Python {platform.python_version()}"]),
    }
    return tuple(Answer(one, question=name) for name, one in told.items() if one)


def _preparation(data: Measurements) -> str:
    """What was done to the samples, and what their reader noticed; "" for nothing."""
    remarks = dict.fromkeys(run.remark for run in data.trajectories if run.remark)
    return some_of(list(remarks))


def _data(data: Measurements | None, use: str) -> str:
    if data is None:
        return "none"
    lengths = [float(run.t[-1] - run.t[0]) for run in data.trajectories]
    scale = scale_of_time(max(lengths), data.units.get("t", ""))
    extent = f"{min(lengths) / scale.size:.4g}"
    if max(lengths) > min(lengths):
        extent += f" to {max(lengths) / scale.size:.4g}"
    size = f"{number_of(len(lengths), 'run')}, {data.n_samples} samples"
    told = f"{size}, {extent} {scale.unit}".rstrip()
    return f"{told} each; SHA-256 {data.digest}; {use}"


def _code(study: StudyRecord) -> str:
    """The calls that repeat the steps, beside the user's data and base model."""
    held_out = ", held_out" if study.held_out is not None else ""
    final = ", final=final" if study.final is not None else ""
    hold = study.train.hold
    lines = [] if hold == "linear" else [f"# all data are read with hold={hold!r}"]
    lines.append(f"study = ph.Study(model, train{held_out}{final})")
    for effect in study.last.added:
        lines.append(f"study.add({effect.name!r}, {effect.equation!r})")
    lines.append('study.report("report.html")')
    return "\n".join(lines)

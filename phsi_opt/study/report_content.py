"""A study as the content of a report: numbers and words, in the order of reading."""

import platform
from collections.abc import Sequence
from importlib.metadata import version

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.fit_report import equation_lines
from phsi_opt.model.parameters import Parameter
from phsi_opt.presentation.durations import scale_of_time
from phsi_opt.presentation.numbers import (
    number,
    proper_names,
    short_constants,
    with_error,
)
from phsi_opt.presentation.report_content import (
    Equations,
    ErrorStep,
    Fact,
    Failure,
    Glance,
    ParameterRow,
    Report,
    Runs,
    Staircase,
)
from phsi_opt.presentation.units import STANDARD_DEVIATIONS, scale_of_errors
from phsi_opt.study.checks import checks_of
from phsi_opt.study.effect_law import EffectLaw
from phsi_opt.study.force_content import failure_of, law_of
from phsi_opt.study.glance import glance_of
from phsi_opt.study.headline import errors_in_words, headline_of, telling_diagnosis
from phsi_opt.study.off_words import NEAR_FLOOR, only_follows
from phsi_opt.study.record import StudyRecord
from phsi_opt.study.run_content import runs_of
from phsi_opt.study.step import Step
from phsi_opt.study.step_story import step_story

ENDED_AT_BOUND = "at its bound"
LEVEL = 0.95  # of the intervals: the convention of most tables
HOLD_WORDS = {
    "zero": "constant until the next sample (zero-order hold)",
    "linear": "on a straight line to the next sample",
    "cubic": "smooth, on the cubic spline through the samples",
}
LIBRARIES = ("phsi_opt", "casadi", "numpy", "scipy", "pandas")


def report_content(study: StudyRecord, laws: Sequence[EffectLaw] = ()) -> Report:
    """What an HTML report of the study says.

    Args:
        study: as it stands.
        laws: of the effects that were added.
    """
    runs = runs_of(study)
    failures = _failures(study)
    return Report(
        f"Study of {', '.join(study.train.measured)}",
        headline_of(study),
        _staircase(study),
        _glance(study, failures, runs),
        _equations(study),
        runs,
        tuple(law_of(law) for law in laws),
        failures,
        checks_of(study),
        _settings(study),
        _code(study),
    )


def _staircase(study: StudyRecord) -> Staircase:
    size, unit = scale_of_errors(study.unit)
    steps = []
    for step in study.steps:
        held_out = None if step.held_out is None else size * step.held_out.rmse
        train = size * step.train.rmse
        floor = size * step.judged.noise_floor
        steps.append(
            ErrorStep(proper_names(step.label), train, held_out, floor, step.fit.bic)
        )
    said = errors_in_words(study)
    sentence = f"{said[:1].upper()}{said[1:]}."
    if only_follows(study.last.train, study.last.judged):
        sentence += (
            " The model fits the training data to the noise, but not the data held "
            "out: it follows what it was fitted to."
        )
    else:
        sentence += _at_floor(study.last, size)
    if study.unit == STANDARD_DEVIATIONS:
        sentence += (
            " The movement of a channel is the standard deviation of its measurements."
        )
    return Staircase(tuple(steps), unit, sentence)


def _at_floor(step: Step, size: float) -> str:
    """What errors just below the noise floor mean; ``size``: factor on errors."""
    floor = step.judged.noise_floor
    errors = {"": step.judged.rmse}
    if step.held_out is not None:
        errors[" (training)"] = step.train.rmse
    told = []
    for which, error in errors.items():
        if is_just_below(error, floor):
            told.append(f"{number(size * error, 3)}{which}")
    if not told:
        return ""
    verb = "equals" if len(told) == 1 else "equal"
    listed = " and ".join(told)
    return f" {listed} {verb} the noise floor within its own uncertainty."


def is_just_below(error: float, floor: float) -> bool:
    """Whether an error is below the noise floor, and no further than it is known."""
    return floor / NEAR_FLOOR < error < floor


def _equations(study: StudyRecord) -> tuple[Equations, ...]:
    first = _model("Base model", study.steps[0].fit)
    if len(study.steps) == 1:
        return (first,)
    added = " and ".join(str(effect) for effect in study.last.added)
    heading = f"Present model: with {added}" if added else "Present model"
    return (first, _model(heading, study.last.fit))


def _model(heading: str, fit: Fit) -> Equations:
    intervals = fit.intervals(LEVEL)
    rows = []
    for _, row in fit.parameters.iterrows():
        name = str(row["name"])
        interval = ""
        remark = "fixed" if row["fixed"] else ""
        if name in fit.outcome.at_bounds:
            remark = ENDED_AT_BOUND
        if name in intervals.index:
            lower = float(intervals["ci_lower"][name])
            upper = float(intervals["ci_upper"][name])
            parameter = fit.entry(name).parameter
            interval = interval_within(parameter, lower, upper)
            if lower < parameter.lower or upper > parameter.upper:
                remark = remark or "cut at its bound"
        if not interval and not remark:
            remark = "no standard error"
        value = with_error(float(row["value"]), float(row["std_error"]))
        if remark == ENDED_AT_BOUND:
            parameter = fit.entry(name).parameter
            value = number(parameter.nearest_bound(float(row["value"])))
        known = ", ".join(one for one in (interval, remark) if one)
        rows.append(ParameterRow(name, value, known, str(row["unit"])))
    lines = tuple(short_constants(line) for line in equation_lines(fit))
    return Equations(proper_names(heading), lines, tuple(rows))


def interval_within(parameter: Parameter, lower: float, upper: float) -> str:
    """An interval in words, as far as the parameter's bounds let it go."""
    lower = max(lower, parameter.lower)
    upper = min(upper, parameter.upper)
    if not np.isfinite([lower, upper]).all():
        return ""
    return f"{number(lower)} to {number(upper)}"


def _failures(study: StudyRecord) -> tuple[Failure, ...]:
    """Every diagnosis, each under the model that it looks at."""
    failures = []
    for number_of_step, diagnosis in sorted(study.diagnoses.items()):
        label = study.steps[number_of_step].label
        heading = f"Base model: what it lacks ({label})"
        if number_of_step:
            heading = f"After step {number_of_step} ({label})"
        else:
            heading = heading.replace(" (base model)", "")
        told = step_story(study, number_of_step)
        heading = proper_names(heading)
        failures.append(failure_of(diagnosis, heading, study.unit, told))
    return tuple(failures)


def _glance(
    study: StudyRecord, failures: Sequence[Failure], runs: Runs
) -> Glance | None:
    """Where what the verdict tells of is seen best."""
    telling = telling_diagnosis(study)
    told = [diagnosis for _, diagnosis in sorted(study.diagnoses.items())]
    for diagnosis, failure in zip(told, failures, strict=True):
        if diagnosis is telling:
            return glance_of(diagnosis, failure, runs)
    return None


def _settings(study: StudyRecord) -> tuple[Fact, ...]:
    facts = [Fact("Training data", _data(study.train))]
    held_out = "none"
    if study.held_out is not None:
        held_out = _data(study.held_out)
    facts.append(Fact("Data held out", held_out))
    starts = "estimated from the whole record of each run, held out or not"
    facts.append(Fact("Starting states", starts))
    facts.append(Fact("Units", _units(study.train)))
    if study.train.inputs:
        facts.append(Fact("Inputs between samples", _hold(study.train)))
    facts.append(Fact("Loss", str(study.loss)))
    facts.append(Fact("Standard errors", str(study.last.fit.std_error_source)))
    facts.append(Fact("Intervals", f"{100 * LEVEL:.0f} %, Student's distribution"))
    seeds = "fixed in the package, none taken from a clock: the same data and "
    seeds += "settings give the same numbers"
    facts.append(Fact("Seeds", seeds))
    versions = [f"{name} {version(name)}" for name in LIBRARIES]
    versions.append(f"Python {platform.python_version()}")
    facts.append(Fact("Versions", ", ".join(versions)))
    return tuple(facts)


def _hold(data: Measurements) -> str:
    if isinstance(data.hold, str):
        return HOLD_WORDS[data.hold]
    words = [f"{name}: {HOLD_WORDS[word]}" for name, word in data.hold.items()]
    return "; ".join(words)


def _data(data: Measurements) -> str:
    lengths = [float(run.t[-1] - run.t[0]) for run in data.trajectories]
    scale = scale_of_time(max(lengths), data.units.get("t", ""))
    extent = f"{min(lengths) / scale.size:.4g}"
    if max(lengths) > min(lengths):
        extent += f" to {max(lengths) / scale.size:.4g}"
    n_runs = len(lengths)
    runs = "1 run" if n_runs == 1 else f"{n_runs} runs"
    return (
        f"{runs}, {data.n_samples} samples, {extent} {scale.unit}".rstrip()
        + f" each; SHA-256 {data.digest}"
    )


def _units(data: Measurements) -> str:
    known = [f"{name}: {unit}" for name, unit in data.units.items() if unit]
    return ", ".join(known) or "not given"


def _code(study: StudyRecord) -> str:
    """The calls that repeat the steps, beside the user's data and base model."""
    held_out = ", held_out" if study.held_out is not None else ""
    lines = ["study = ph.Study(model, train" + held_out + ")"]
    for effect in study.last.added:
        lines.append(f"study.add({effect.name!r}, {effect.equation!r})")
    lines.append('study.report("report.html")')
    return "\n".join(lines)

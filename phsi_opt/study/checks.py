"""Checks of what a study's present model leaves, each with a severity and a word."""

import numpy as np
import pandas as pd

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import FAILING_ERROR, WHITE_ERROR, WHITENESS_LEVEL
from phsi_opt.force_analysis.units import spaced
from phsi_opt.presentation.content import BAD, GOOD, LOOK, Check
from phsi_opt.presentation.durations import scale_of_time
from phsi_opt.presentation.numbers import number, p_value_words
from phsi_opt.study.record import StudyRecord

# Share of the longest record from which on a free run counts as good to its end.
WHOLE_RECORD = 0.999
FROM_START = 0.01  # share of it below which it never was good


def checks_of(study: StudyRecord) -> tuple[Check, ...]:
    """Size, whiteness and horizon by channel; then the fit's and the data's."""
    judged = study.last.judged
    unit_of_time = study.train.units.get("t", "")
    checks: list[Check] = []
    for _, row in judged.table.iterrows():
        checks.append(_size(row))
        checks.append(_whiteness(row))
        checks.append(_horizon(row, judged, unit_of_time))
    if judged.warning:
        checks.append(Check("free run", BAD, judged.warning))
    checks += _of_fit(study)
    return tuple(checks)


def _size(row: pd.Series) -> Check:
    subject = f"{row['state']}: size of residuals"
    rmse = float(row["rmse"])
    floor = float(row["noise_floor"])
    if not np.isfinite(rmse) or not floor > 0:
        return Check(subject, LOOK, "could not be compared with the noise")
    ratio = rmse / floor
    unit = spaced(str(row["unit"]))
    said = (
        f"rmse {number(rmse, 3)}{unit} is {ratio:.3g} times the noise "
        f"({number(floor, 3)}{unit})"
    )
    if ratio <= FAILING_ERROR:
        return Check(subject, GOOD, f"{said}: what noise alone leaves")
    severity = LOOK if ratio <= WHITE_ERROR else BAD
    return Check(subject, severity, f"{said}: more than noise leaves")


def _whiteness(row: pd.Series) -> Check:
    subject = f"{row['state']}: neighbouring residuals"
    p_value = float(row["whiteness"])
    if not np.isfinite(p_value):
        return Check(subject, LOOK, "too few samples to compare neighbours")
    said = f"Ljung and Box's test, p-value {p_value_words(p_value)}"
    if p_value >= WHITENESS_LEVEL:
        return Check(subject, GOOD, f"not alike, as white noise has them ({said})")
    is_small = float(row["rmse"]) <= FAILING_ERROR * float(row["noise_floor"])
    severity = LOOK if is_small else BAD
    return Check(subject, severity, f"alike: a pattern is left in them ({said})")


def _horizon(row: pd.Series, judged: Comparison, unit_of_time: str) -> Check:
    subject = f"{row['state']}: how long the free run holds"
    horizon = float(row["horizon"])
    shortest = min(float(run.t[-1] - run.t[0]) for run in judged.data.trajectories)
    scale = scale_of_time(shortest, unit_of_time)
    unit = spaced(scale.unit)
    if horizon >= WHOLE_RECORD * shortest:
        return Check(subject, GOOD, "within the noise to the end of every run")
    is_far = float(row["rmse"]) > WHITE_ERROR * float(row["noise_floor"])
    severity = BAD if is_far else LOOK
    said = "in the worst run a residual leaves the noise "
    if horizon < FROM_START * shortest:
        return Check(subject, severity, f"{said}from the start on")
    said += f"after {horizon / scale.size:.3g} of {shortest / scale.size:.3g}{unit}"
    return Check(subject, severity, said)


def _of_fit(study: StudyRecord) -> list[Check]:
    """The solver, its bounds, the warnings of the fit, and what the data lack."""
    fit = study.last.fit
    checks = []
    severity = GOOD if fit.outcome.success else BAD
    said = f"{fit.outcome.sentence} {fit.outcome.advice}".strip()
    checks.append(Check("solver", severity, said))
    if fit.outcome.at_bounds:
        names = ", ".join(fit.outcome.at_bounds)
        checks.append(Check("bounds", LOOK, f"at a bound: {names}"))
    for warning in fit.warnings:
        checks.append(Check("fit", LOOK, warning))
    if study.last.held_out is not None:
        for note in study.last.held_out.record.aligned.notes:
            checks.append(Check("data held out", LOOK, note))
    if study.held_out is None:
        said = "nothing was held out; errors are those of the training data"
        checks.append(Check("data held out", LOOK, said))
    return checks

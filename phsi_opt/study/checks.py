"""Checks of what a study's present model leaves, each with a severity and a word."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import FAILING_ERROR, SURE_LEVEL, WHITE_ERROR
from phsi_opt.presentation.content import BAD, GOOD, LOOK, Check
from phsi_opt.presentation.durations import scale_of_time
from phsi_opt.presentation.sentences import say
from phsi_opt.study.record import StudyRecord


def checks_of(study: StudyRecord) -> tuple[Check, ...]:
    """Size, whiteness and horizon by channel; then the fit's and the data's."""
    judged = study.last.judged
    checks: list[Check] = []
    for _, row in judged.table.iterrows():
        checks += _of_channel(row, judged, study.train.units.get("t", ""))
    if judged.warning:
        checks.append(Check("free run", BAD, judged.warning))
    checks += _of_fit(study)
    return tuple(checks)


def _of_channel(row: pd.Series, judged: Comparison, unit_of_time: str) -> list[Check]:
    """Whether residuals are as small and as random as noise, and for how long."""
    floor = float(row["noise_floor"])
    ratio = float(row["rmse"]) / floor if floor > 0 else np.nan
    shortest = min(float(run.t[-1] - run.t[0]) for run in judged.data.trajectories)
    horizon = float(row["horizon"])
    whiteness = float(row["whiteness"])
    facts = {
        "row": row,
        "ratio": ratio,
        "shortest": shortest,
        "scale": scale_of_time(shortest, unit_of_time),
        "is_from_start": horizon < 0.01 * shortest,  # it never was good
    }
    is_small = ratio <= FAILING_ERROR
    is_far = ratio > WHITE_ERROR
    is_white = whiteness >= SURE_LEVEL
    holds = horizon > 0.999 * shortest  # but for rounding
    asked = (
        ("size", "size of residuals", ratio, is_small, is_far),
        ("whiteness", "neighbouring residuals", whiteness, is_white, not is_small),
        ("horizon", "how long the free run holds", horizon, holds, is_far),
    )
    checks = []
    for name, subject, value, is_good, is_bad in asked:
        known = bool(np.isfinite(value))
        severity = GOOD if is_good else BAD if known and is_bad else LOOK
        facts |= {"severity": severity, "known": known}
        said = say(__package__, f"{name}_check", **facts).lead
        checks.append(Check(f"{row['state']}: {subject}", severity, said))
    return checks


def _of_fit(study: StudyRecord) -> list[Check]:
    """The solver, its bounds, the warnings of the fit, and what the data lack."""
    fit = study.last.fit
    severity = GOOD if fit.outcome.success else BAD
    said = f"{fit.outcome.sentence} {fit.outcome.advice}".strip()
    checks = [Check("solver", severity, said)]
    bounds = ", ".join(fit.outcome.at_bounds)
    notes: Sequence[str] = [
        "nothing was held out; errors are those of the training data"
    ]
    if study.last.held_out is not None:
        notes = study.last.held_out.record.aligned.notes
    looks = {
        "bounds": [f"at a bound: {bounds}"] if bounds else [],
        "fit": fit.warnings,
        "data held out": notes,
    }
    for subject, remarks in looks.items():
        checks += (Check(subject, LOOK, remark) for remark in remarks)
    return checks

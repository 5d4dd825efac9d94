"""What the fits of the coverage benchmark say: a row per scenario, runs, parameter and
method.
"""

import numpy as np
import pandas as pd

from problems.benchmarks.coverage_fits import (
    DEFAULT,
    SCENARIOS,
    WHITE,
    WITH_FORCE,
    Job,
    jobs,
)
from problems.benchmarks.disturbed_oscillator import TRUTH
from problems.benchmarks.estimate_limits import estimate_limits
from problems.tools.intervals import wilson

PLAIN = "plain likelihood"
METHODS = {PLAIN: DEFAULT, DEFAULT: DEFAULT, WITH_FORCE: WITH_FORCE}
PHYSICAL = "physical"
LIMIT = "limit of the estimate"
SAME_WIDTH = 0.05  # share by which an interval may differ where nothing is to be lost
SOURCES = (WHITE, "model error", "scatter between trajectories")


def summary(fits: pd.DataFrame) -> pd.DataFrame:
    """Of all fits that were made.

    Args:
        fits: a row per parameter of every fit, as `FitRow`.
    """
    rows = []
    for job in jobs():
        of_job = fits[
            (fits["scenario"] == job.scenario)
            & (fits["runs"] == job.layout.runs)
            & (fits["samples"] == job.layout.samples)
            & (fits["method"] == job.method)
        ]
        if of_job.empty:
            continue
        for method, made_by in METHODS.items():
            if made_by == job.method:
                rows += _rows(job, method, of_job)
    return pd.DataFrame(rows)


def _rows(job: Job, method: str, fits: pd.DataFrame) -> list[dict[str, object]]:
    """By truth and parameter."""
    rows = []
    for kind, truth in truths(job).items():
        for parameter, value in truth.items():
            of_parameter = fits[fits["parameter"] == parameter]
            rows.append(
                {
                    "scenario": job.scenario,
                    "runs": job.layout.runs,
                    "samples": job.layout.samples,
                    "truth": kind,
                    "parameter": parameter,
                    "method": method,
                    "value": value,
                    **measures(of_parameter, value, method == PLAIN),
                }
            )
    return rows


def truths(job: Job) -> dict[str, dict[str, float]]:
    """What an interval may be asked to hold: two truths where the model is wrong."""
    disturbance = SCENARIOS[job.scenario]
    if not disturbance.cubic_share:
        return {PHYSICAL: TRUTH}
    limit = estimate_limits(disturbance, job.layout.samples)
    return {PHYSICAL: TRUTH, LIMIT: limit}


def measures(fits: pd.DataFrame, truth: float, is_plain: bool) -> dict[str, object]:
    """Coverage, distances and widths of one parameter.

    A fit that failed holds no truth; distances and widths are those of the others.

    Args:
        fits: a row per fit.
        truth: what the intervals should hold.
        is_plain: whether intervals and standard errors count residuals as white noise.
    """
    estimate = fits["estimate"]
    half = fits["white_half"]
    std_error = fits["white"]
    if not is_plain:
        half = fits["half"]
        std_error = fits["std_error"]
    distance = estimate - truth
    n = len(fits)
    is_held = distance.abs() <= half
    n_held = int(is_held.sum())
    lower, upper = wilson(n_held, n)
    ratio = half / fits["white_half"]
    found: dict[str, object] = {
        "n": n,
        "n_failed": int(estimate.isna().sum()),
        "coverage": 100 * n_held / n,
        "coverage_lower": 100 * lower,
        "coverage_upper": 100 * upper,
        "rms_z": _root_mean_square(distance / std_error),
        "bias": float(distance.mean()),
        "rms_error": _root_mean_square(distance),
        "median_half_width": float(half.median()),
        "median_width_ratio": float(ratio.median()),
        "mean_width_ratio": float(half.mean() / fits["white_half"].mean()),
        "same_width": 100 * float((abs(ratio - 1) <= SAME_WIDTH).mean()),
    }
    for source in SOURCES:
        is_from = fits["source"] == source
        found[source] = float("nan") if is_plain else 100 * float(is_from.mean())
    is_white = fits["source"] == WHITE
    found["coverage_if_white"] = 100 * float(is_held[is_white].mean())
    found["coverage_if_more"] = 100 * float(is_held[~is_white].mean())
    return found


def _root_mean_square(values: pd.Series) -> float:
    return float(np.sqrt(np.mean(values**2)))

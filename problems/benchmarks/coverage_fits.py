"""The fits of the coverage benchmark: kept in a table each as soon as it is made."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import pandas as pd
from scipy.stats import t as student_t

import phsi_opt as ph
from problems.benchmarks.disturbed_oscillator import (
    TRUTH,
    Disturbance,
    Layout,
    model,
)
from problems.benchmarks.oscillator_records import records
from problems.tools import provenance

SCENARIOS = {
    "none": Disturbance(),
    "OU 0.2 m/s^2, 1 s": Disturbance(force_size=0.2, force_time=1.0),
    "OU 0.05 m/s^2, 0.3 s": Disturbance(force_size=0.05, force_time=0.3),
    "OU 0.1 m/s^2, 5 s": Disturbance(force_size=0.1, force_time=5.0),
    "nonlinearity 1 to 5 %": Disturbance(drawn_shares=(0.01, 0.05)),
    "cubic spring 1 %": Disturbance(cubic_share=0.01),
    "cubic spring 3 %": Disturbance(cubic_share=0.03),
    "cubic spring 5 %": Disturbance(cubic_share=0.05),
    "AR(1) noise 0.7": Disturbance(noise_correlation=0.7),
    "quantised": Disturbance(step=0.2, noise=0.02),
}
ONE = Layout(1, 400)
SEVERAL = Layout(4, 200)
MANY = Layout(16, 100)
DEFAULT = "default"
WITH_FORCE = "model_error=True"
WHITE = "white noise"  # the source of standard errors that no model error widens
BATCH = 20  # seeds that are simulated at once
DIGITS = "%.6g"  # of what is kept: an estimate to a three-hundredth of its error
LEVEL = 0.95


@dataclass(frozen=True)
class Job:
    """Fits in one way of the records of one kind."""

    scenario: str
    layout: Layout
    method: str


@dataclass(frozen=True)
class FitRow:
    """One parameter of one fit.

    Attributes:
        scenario: name of the disturbance.
        runs: trajectories of the record.
        samples: of each.
        method: how the parameters were estimated.
        seed: of the record.
        parameter: its name.
        estimate: its value.
        std_error: the one that the fit gives.
        half: half width of the fit's 95 % interval.
        white: the standard error if residuals were white noise.
        white_half: half width of the interval from it.
        source: where the fit's standard errors come from, or why there is no fit.
        commit: of the code.
    """

    scenario: str
    runs: int
    samples: int
    method: str
    seed: int
    parameter: str
    estimate: float
    std_error: float
    half: float
    white: float
    white_half: float
    source: str
    commit: str


COLUMNS = [field.name for field in fields(FitRow)]
KEY = ["scenario", "runs", "samples", "method", "seed"]


WAYS = (
    (ONE, DEFAULT),
    (SEVERAL, DEFAULT),
    (ONE, WITH_FORCE),
    (MANY, DEFAULT),
    (SEVERAL, WITH_FORCE),
)
N_DEFAULT = 2  # of these ways, those that are asked of the default and come first


def jobs() -> list[Job]:
    """All jobs; what says most comes first, for a run may be cut short."""
    found = []
    for layout, method in WAYS:
        for scenario in SCENARIOS:
            found.append(Job(scenario, layout, method))
    return found


def make_all(seeds: Sequence[int], path: Path) -> None:
    """All fits that are missing; a run that is cut short has its scenarios alike.

    The default comes first, in one run and several, springs of fixed size after all
    that is drawn.
    """
    fixed = [name for name, found in SCENARIOS.items() if found.cubic_share]
    drawn = [name for name in SCENARIOS if name not in fixed]
    for ways in (WAYS[:N_DEFAULT], WAYS[N_DEFAULT:]):
        for scenarios in (drawn, fixed):
            for first in range(0, len(seeds), BATCH):
                batch = seeds[first : first + BATCH]
                for layout, method in ways:
                    for scenario in scenarios:
                        make(Job(scenario, layout, method), batch, path)


def fit_rows(job: Job, seed: int, data: ph.Measurements) -> list[FitRow]:
    """The parameters of one fit; without numbers where it failed."""
    loss = ph.MaximumLikelihood(model_error=job.method == WITH_FORCE)
    try:
        fit = ph.identify(model(), data, loss)
    except ph.PhsiOptError as error:
        return _failed(job, seed, type(error).__name__)
    lower = fit.intervals(LEVEL)["ci_lower"].to_dict()
    upper = fit.intervals(LEVEL)["ci_upper"].to_dict()
    std_errors = fit.standard_errors["std_error"].to_dict()
    of_white_noise = fit.standard_errors[WHITE].to_dict()
    white_freedom = max(fit.n_values - len(fit.names), 1)
    quantile = float(student_t.isf((1 - LEVEL) / 2, white_freedom))
    rows = []
    for parameter in TRUTH:
        white = float(of_white_noise[parameter])
        row = FitRow(
            scenario=job.scenario,
            runs=job.layout.runs,
            samples=job.layout.samples,
            method=job.method,
            seed=seed,
            parameter=parameter,
            estimate=float(fit.estimates[parameter]),
            std_error=float(std_errors[parameter]),
            half=float(upper[parameter] - lower[parameter]) / 2,
            white=white,
            white_half=quantile * white,
            source=str(fit.std_error_source),
            commit=provenance.commit(),
        )
        rows.append(row)
    return rows


def _failed(job: Job, seed: int, reason: str) -> list[FitRow]:
    nothing = float("nan")
    rows = []
    for parameter in TRUTH:
        row = FitRow(
            scenario=job.scenario,
            runs=job.layout.runs,
            samples=job.layout.samples,
            method=job.method,
            seed=seed,
            parameter=parameter,
            estimate=nothing,
            std_error=nothing,
            half=nothing,
            white=nothing,
            white_half=nothing,
            source=reason,
            commit=provenance.commit(),
        )
        rows.append(row)
    return rows


def kept(path: Path) -> pd.DataFrame:
    """The rows of all fits that were made, each once."""
    if not path.exists():
        return pd.DataFrame(columns=COLUMNS)
    rows = pd.read_csv(path, keep_default_na=False, na_values=[""])
    return rows.drop_duplicates([*KEY, "parameter"])


def make(job: Job, seeds: Sequence[int], path: Path) -> None:
    """Make the fits of a job that are missing, and keep each at once."""
    missing = _missing(job, seeds, kept(path))
    for first in range(0, len(missing), BATCH):
        batch = missing[first : first + BATCH]
        data = records(batch, SCENARIOS[job.scenario], job.layout)
        for seed, record in zip(batch, data, strict=True):
            _append(path, fit_rows(job, seed, record))
    print(job.scenario, job.layout, job.method, f"{len(missing)} fits", flush=True)


def _missing(job: Job, seeds: Sequence[int], rows: pd.DataFrame) -> list[int]:
    """Seeds whose fit has not all its parameters."""
    of_job = rows[
        (rows["scenario"] == job.scenario)
        & (rows["runs"] == job.layout.runs)
        & (rows["samples"] == job.layout.samples)
        & (rows["method"] == job.method)
    ]
    counts = of_job["seed"].value_counts()
    return [seed for seed in seeds if counts.get(seed, 0) < len(TRUTH)]


def _append(path: Path, rows: Sequence[FitRow]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    frame = pd.DataFrame([vars(row) for row in rows], columns=COLUMNS)
    text = frame.to_csv(index=False, header=not path.exists(), float_format=DIGITS)
    with path.open("a", encoding="utf-8") as file:
        file.write(text)

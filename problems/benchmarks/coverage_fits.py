"""The fits of the coverage benchmark: kept in a table each as soon as it is made."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import pandas as pd
from scipy.stats import t as student_t

import phsi_opt as ph
from phsi_opt.sweeps.sweep import sweep
from problems.benchmarks.disturbed_oscillator import (
    TRUTH,
    Disturbance,
    Layout,
    model,
)
from problems.benchmarks.oscillator_records import records
from problems.tools import provenance
from problems.tools.kept_tables import append_rows
from problems.tools.workers import workers

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


@dataclass(frozen=True)
class Batch:
    """Fits whose records are simulated at once."""

    job: Job
    seeds: tuple[int, ...]

    @property
    def key(self) -> str:
        """What it is called while it is computed."""
        job = self.job
        kind = f"{job.scenario}, {job.layout.runs} x {job.layout.samples}"
        return f"{kind}, {job.method}, seeds {self.seeds[0]} to {self.seeds[-1]}"


def make_all(seeds: Sequence[int], path: Path) -> None:
    """All fits that are missing; a run that is cut short has its scenarios alike.

    The default comes first, in one run and several, springs of fixed size after all
    that is drawn.
    """
    fixed = [name for name, found in SCENARIOS.items() if found.cubic_share]
    drawn = [name for name in SCENARIOS if name not in fixed]
    wanted = []
    for ways in (WAYS[:N_DEFAULT], WAYS[N_DEFAULT:]):
        for scenarios in (drawn, fixed):
            for first in range(0, len(seeds), BATCH):
                batch = tuple(seeds[first : first + BATCH])
                for layout, method in ways:
                    for scenario in scenarios:
                        wanted.append(Batch(Job(scenario, layout, method), batch))
    make_batches(wanted, path)


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
    """Make the fits of a job that are missing."""
    wanted = []
    for first in range(0, len(seeds), BATCH):
        wanted.append(Batch(job, tuple(seeds[first : first + BATCH])))
    make_batches(wanted, path)


def make_batches(wanted: Sequence[Batch], path: Path) -> None:
    """Make the fits that are missing, side by side, and keep each batch when made."""
    rows = kept(path)
    missing = {}
    for batch in wanted:
        seeds = tuple(_missing(batch.job, batch.seeds, rows))
        if seeds:
            left = Batch(batch.job, seeds)
            missing[left.key] = left
    jobs = 1 if len(missing) == 1 else None
    with workers(jobs) as executor:
        for done in sweep(_made, missing, executor=executor, progress=_say):
            frame = pd.DataFrame(done.result, columns=COLUMNS)
            append_rows(path, frame, DIGITS)


def _made(batch: Batch) -> list[dict[str, object]]:
    data = records(list(batch.seeds), SCENARIOS[batch.job.scenario], batch.job.layout)
    rows = []
    for seed, record in zip(batch.seeds, data, strict=True):
        rows += [vars(row) for row in fit_rows(batch.job, seed, record)]
    return rows


def _say(line: str) -> None:
    print(line, flush=True)


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

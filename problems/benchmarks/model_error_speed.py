"""What honest standard errors cost: processor time beside the plain likelihood.

Three ways on the same records of an oscillator, in turns: the maximum of the likelihood
alone, `identify` with its standard errors, and with a random force in the equations.

    python -m problems.benchmarks.model_error_speed [--rounds=N]
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable

import pandas as pd

import phsi_opt as ph
from phsi_opt.estimation.estimate import Task
from phsi_opt.estimation.identify import estimate_by
from phsi_opt.transcription.grid import AlignedData
from problems.benchmarks.coverage import SCENARIOS
from problems.benchmarks.oscillator import Layout, model, records
from problems.tools.command_line import option
from problems.tools.pages import render
from problems.tools.provenance import write

N_ROUNDS = 3
N_SAMPLES = (400, 10_000)
FORCED = "OU 0.2 m/s^2, 1 s"
SEEDS = {"none": 6200, FORCED: 6201}
ASKED = 2.0  # times the plain likelihood, at 10 000 samples
PLAIN = "likelihood alone"
DEFAULT = "identify"
WITH_FORCE = "model_error=True"


def likelihood_alone(data: ph.Measurements) -> None:
    """The maximum and the covariance by white noise, without anything else."""
    aligned = AlignedData.of(model(), data)
    task = Task(model(), aligned, l1={}, pruning=None, settings=ph.SolverSettings())
    _ = estimate_by(ph.MaximumLikelihood(), task, None).uncertainty


def by_default(data: ph.Measurements) -> None:
    """As users call it."""
    _ = ph.identify(model(), data).std_errors


def with_force(data: ph.Measurements) -> None:
    """With a random force in the equations."""
    _ = ph.identify(model(), data, ph.MaximumLikelihood(model_error=True)).std_errors


WAYS: dict[str, Callable[[ph.Measurements], None]] = {
    PLAIN: likelihood_alone,
    DEFAULT: by_default,
    WITH_FORCE: with_force,
}


def measured(scenario: str, n_samples: int, n_rounds: int) -> list[dict[str, object]]:
    """Processor seconds of every way, round after round."""
    layout = Layout(1, n_samples)
    (data,) = records([SEEDS[scenario]], SCENARIOS[scenario], layout)
    rows = []
    for number in range(n_rounds):
        for name, way in WAYS.items():
            began = time.process_time()
            way(data)
            seconds = time.process_time() - began
            place = {"scenario": scenario, "n_samples": n_samples}
            rows.append({**place, "round": number, "way": name, "seconds": seconds})
            print(rows[-1], flush=True)
    return rows


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """Medians, and the median over the rounds of the ratio to the likelihood alone."""
    keys = ["scenario", "n_samples", "round"]
    table = rows.pivot_table(index=keys, columns="way", values="seconds")
    lines = []
    for place, group in table.groupby(["scenario", "n_samples"]):
        line: dict[str, object] = {"beside the model": place[0], "samples": place[1]}
        line[f"{PLAIN}, s"] = f"{group[PLAIN].median():.2f}"
        for name in (DEFAULT, WITH_FORCE):
            ratio = (group[name] / group[PLAIN]).median()
            line[f"{name}, times that"] = f"{ratio:.2f}"
        lines.append(line)
    return pd.DataFrame(lines)


def page(rows: pd.DataFrame) -> str:
    """The result as Markdown."""
    table = summary(rows)
    long = table[table["samples"] == max(N_SAMPLES)]
    columns = [f"{name}, times that" for name in (DEFAULT, WITH_FORCE)]
    return render(
        "benchmarks/pages/model_error_speed.md",
        n_rounds=rows["round"].nunique(),
        n_samples=max(N_SAMPLES),
        worst=long[columns].astype(float).max(),
        asked=ASKED,
        table=table,
    )


def main() -> None:
    """All records."""
    n_rounds = int(option("rounds", str(N_ROUNDS)))
    rows = []
    for n_samples in N_SAMPLES:
        for scenario in SEEDS:
            rows += measured(scenario, n_samples, n_rounds)
    write("model_error_speed.md", page(pd.DataFrame(rows)))


if __name__ == "__main__":
    main()

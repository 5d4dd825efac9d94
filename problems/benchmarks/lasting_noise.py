"""Correlated noise of a sensor, and nothing else: is a force said to be missing?

    python -m problems.benchmarks.lasting_noise [--first=SEED] [--seeds=N] [--jobs=N]

The oscillator of ``oscillator``, five runs of 160 samples, three of them for the fit.
Neighbouring samples of its noise have a correlation of 0.7. Seeds 0 to 39 are for
development; the page has those of its first line.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.benchmarks.oscillator import Disturbance, Layout, model, records
from problems.tools.intervals import share
from problems.tools.pages import render
from problems.tools.seeds import ask_and_write

FIRST_SEED = 30_000
N_SEEDS = 100
CORRELATION = 0.7
LAYOUT = Layout(runs=5, samples=160)
TRAINING = 0.6


def answer(seed: int) -> dict[str, Any]:
    """What is said of the record of one seed."""
    noise = Disturbance(noise_correlation=CORRELATION)
    (data,) = records([seed], noise, LAYOUT)
    train, test = data.split(TRAINING)
    fit = ph.identify(model(), train)
    diagnosis = ph.diagnose(fit, train, test)
    estimate = diagnosis.record.estimate
    rates = estimate.grid.rates(estimate.x)[:, list(estimate.rows)]
    kinds = set(fit.model_error["kind"])
    return {
        "verdict": str(diagnosis.verdict),
        "has_force": "force" in kinds,
        "has_sensor_error": "sensor error" in kinds,
        "force": float(np.sqrt(np.mean(estimate.w**2) / np.mean(rates**2))),
    }


def page(by_seed: dict[str, dict[str, Any]]) -> str:
    """The page of all answers."""
    answers = pd.DataFrame(by_seed.values())
    n = len(answers)
    is_silent = answers["verdict"] == str(ph.Verdict.NOTHING_MISSING)
    return render(
        "benchmarks/pages/lasting_noise.md",
        layout=LAYOUT,
        correlation=CORRELATION,
        seeds=list(by_seed),
        n=n,
        silent=share(int(is_silent.sum()), n),
        verdicts=answers["verdict"].value_counts().to_dict(),
        without_force=share(int((~answers["has_force"]).sum()), n),
        with_sensor_error=share(int(answers["has_sensor_error"].sum()), n),
        force=answers["force"],
    )


if __name__ == "__main__":
    ask_and_write(answer, FIRST_SEED, N_SEEDS, page, "lasting_noise.md")

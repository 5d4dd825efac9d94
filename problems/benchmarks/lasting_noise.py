"""Noise of a sensor that lasts, and nothing else: is a force said to be missing?

    python -m problems.benchmarks.lasting_noise [--first=SEED] [--seeds=N] [--jobs=N]

The oscillator of `disturbed_oscillator`, five runs of 160 samples, three of them for
the fit. Neighbouring samples of its noise have a correlation of 0.7. Seeds 0 to 39 are
for development; the page has those of its first line.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from dataclasses import dataclass

import numpy as np

import phsi_opt as ph
from problems.benchmarks.disturbed_oscillator import Disturbance, Layout, model
from problems.benchmarks.oscillator_records import records
from problems.tools.intervals import share
from problems.tools.seeds import ask_and_write

FIRST_SEED = 30_000
N_SEEDS = 100
CORRELATION = 0.7
LAYOUT = Layout(runs=5, samples=160)
TRAINING = 0.6


@dataclass(frozen=True)
class Answer:
    """What is said of one record.

    Attributes:
        verdict: of the diagnosis.
        kinds: of what the fit found beside the model.
        force: root mean square of the missing force over that of the rate.
    """

    verdict: str
    kinds: tuple[str, ...]
    force: float


def answer(seed: int) -> Answer:
    """The answer to the record of one seed."""
    noise = Disturbance(noise_correlation=CORRELATION)
    (data,) = records([seed], noise, LAYOUT)
    train, test = data.split(TRAINING)
    fit = ph.identify(model(), train)
    diagnosis = ph.diagnose(fit, train, test)
    estimate = diagnosis.record.estimate
    rates = estimate.grid.rates(estimate.x)[:, list(estimate.rows)]
    force = np.sqrt(np.mean(estimate.w**2) / np.mean(rates**2))
    kinds = tuple(fit.model_error["kind"])
    return Answer(str(diagnosis.verdict), kinds, float(force))


def page(by_seed: dict[str, Answer]) -> str:
    """The page of all answers."""
    seeds, answers = list(by_seed), list(by_seed.values())
    n = len(answers)
    silent = sum(one.verdict == ph.Verdict.NOTHING_MISSING for one in answers)
    forces = sum("force" in one.kinds for one in answers)
    sensors = sum("sensor error" in one.kinds for one in answers)
    sizes = np.array([one.force for one in answers])
    others = sorted(one.verdict for one in answers)
    by_verdict = {verdict: others.count(verdict) for verdict in dict.fromkeys(others)}
    return f"""# Noise that lasts, and nothing else

A driven oscillator whose model is right, its position alone measured, in {LAYOUT.runs}
runs of {LAYOUT.samples} samples. The noise of 0.02 m has a lag-one correlation of
{CORRELATION}. Seeds {seeds[0]} to {seeds[-1]}, not looked at before.

- Verdict "nothing missing": {share(silent, n)} of {n}. All verdicts: {by_verdict}.
- The fit finds no force by evidence: {share(n - forces, n)} of {n}.
- It finds errors of the sensor that last: {share(sensors, n)}.
- The missing force of the diagnosis, as a share of the motion's own (rms): median
  {np.median(sizes):.4f}, at most {sizes.max():.3f}.
"""


if __name__ == "__main__":
    ask_and_write(answer, FIRST_SEED, N_SEEDS, page, "lasting_noise.md")

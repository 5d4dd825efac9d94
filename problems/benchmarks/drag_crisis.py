"""A falling body whose drag coefficient drops at speed, which no catalogue has.

    python -m problems.benchmarks.drag_crisis [--first=SEED] [--seeds=N] [--jobs=N]

Drops from four heights, three of them for the fit; the height is measured. The model
has gravity g and a quadratic drag, both open. Round a drawn speed the drag coefficient
falls to 30 to 60 % of itself. `Study.auto` is asked: no sensor and no clock has
anything to do with it. Seeds 0 to 19 are for development; the page has those of its
first line.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from typing import Any

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

import phsi_opt as ph
from problems.tools.intervals import share
from problems.tools.pages import render
from problems.tools.seeds import ask_and_write

FIRST_SEED = 40_000
N_SEEDS = 40
GRAVITY = 9.81
SHARES = (1.0, 0.75, 0.5, 0.9)  # of the highest drop; the last is held out
N_TRAINING = 3
N_SAMPLES = 150  # of the highest drop
NOISE = 0.002  # of the highest drop
FAR_OFF = 3.0  # standard errors


def measured(rng: np.random.Generator, mass: float) -> ph.Measurements:
    """Heights along the drops."""
    highest = float(rng.uniform(30.0, 120.0))
    fastest = np.sqrt(2 * GRAVITY * highest)
    terminal = float(rng.uniform(0.5, 0.9)) * fastest
    drag = mass * GRAVITY / terminal**2
    turn = float(rng.uniform(0.35, 0.6)) * fastest
    left = float(rng.uniform(0.3, 0.6))
    width = 0.1 * turn

    def rates(_: float, x: np.ndarray) -> list[float]:
        v = x[1] / mass
        fall = (1 + np.tanh((abs(v) - turn) / width)) / 2
        c = drag * (1 - (1 - left) * fall)
        return [v, -mass * GRAVITY - c * v * abs(v)]

    times, states = [], []
    whole = np.linspace(0.0, 1.15 * fastest / GRAVITY, N_SAMPLES)
    for one in SHARES:
        t = whole[: int(N_SAMPLES * np.sqrt(one))]
        solution = solve_ivp(
            rates, (0, t[-1]), [one * highest, 0.0], t_eval=t, rtol=1e-9
        )
        h = solution.y[0] + NOISE * highest * rng.normal(size=len(t))
        times.append(t)
        states.append(np.column_stack([h, np.full_like(h, np.nan)]))
    return ph.Measurements.from_arrays(times, states, states=["h", "p"])


def model(mass: float) -> ph.PseudoHamiltonian:
    """Gravity and a quadratic drag."""
    g = ph.Parameter(9.0, lower=0)
    c = ph.Parameter(0.01 * mass, lower=0)
    return ph.PseudoHamiltonian(
        states=["h", "p"],
        S=ph.canonical(1),
        H=ph.formula(f"{mass!r}*g*h + p**2/(2*{mass!r})", g=g),
        R={"p": ph.formula("c*(dH_dp**2 + 1e-6)**0.5", c=c)},
    )


def answer(seed: int) -> dict[str, Any]:
    """What `Study.auto` makes of one body; a sensor or a clock is absurd."""
    rng = np.random.default_rng(seed)
    mass = float(np.exp(rng.uniform(*np.log((0.05, 2.0)))))
    train, test = measured(rng, mass).split(N_TRAINING / len(SHARES))
    study = ph.Study(model(mass), train, test)
    verdict = str(study.diagnose().verdict)
    study.auto()
    fit = study.fit
    return {
        "seed": seed,
        "verdict": verdict,
        "added": ", ".join(map(str, study.added)) or "nothing",
        "absurd": any(one.slot == "sensor" or one.needs_clock for one in study.added),
        "error": (fit.estimates["g"] - GRAVITY) / fit.std_errors["g"],
    }


def page(by_seed: dict[str, dict[str, Any]]) -> str:
    """The page of all answers."""
    answers = pd.DataFrame(by_seed.values())
    n = len(answers)
    head = "error of g, in standard errors"
    shown = answers.assign(**{head: answers["error"].map("{:.1f}".format)})
    return render(
        "benchmarks/pages/drag_crisis.md",
        noise=NOISE,
        first=next(iter(by_seed)),
        n=n,
        far_off=FAR_OFF,
        sane=share(int((~answers["absurd"]).sum()), n),
        near=share(int((answers["error"].abs() <= FAR_OFF).sum()), n),
        shown=shown[["seed", "verdict", "added", head]],
    )


if __name__ == "__main__":
    ask_and_write(answer, FIRST_SEED, N_SEEDS, page, "drag_crisis.md")

"""Functions that no law of the catalogue describes, and storages that nobody measures.

    python -m problems.judges.functions [--first=SEED] [--cases=N]

A body on a spring under a held input, of which the position is measured. Drawn by seed,
1 or 3 % of noise, every second run shaken by a random force of 5 % of the first rates.
A study goes on by itself, as in `searches`, which says what is right; where nothing is
hidden, a study that names nothing is. A function is right as bells or as a formula.
Seeds from 89100 on are reported; 14000 to 14099 were used to build it.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable
from functools import partial

import numpy as np

import phsi_opt as ph
from problems.judges.couplings import measured, simulated
from problems.judges.searches import Case, Draw, report

FIRST = 89_100
Forces = Callable[..., float]


def laws(s: float, w: float) -> dict[str, tuple[str, Forces, float]]:
    """By kind the beginning of a true name, the force f(q, v, z, w), and a size."""

    def humps(q: float) -> float:
        return np.exp(-(((q - 0.5) / 0.3) ** 2)) + np.exp(-(((q + 0.6) / 0.25) ** 2))

    loss, force = "unknown loss r(q)", "unknown force f(q)"
    none = np.nan
    return {
        "loss at one place": (
            loss,
            lambda q, v, *_: -2 * s * np.exp(-((q / (0.25 * w)) ** 2)) * v,
            none,
        ),
        "loss at two places": (loss, lambda q, v, *_: -1.5 * s * humps(q) * v, none),
        "spring that hardens": (
            force,
            lambda q, v, *_: -s * np.sinh(2.5 * w * q),
            none,
        ),
        "force that repeats": (
            force,
            lambda q, v, *_: 1.5 * s * np.sin(9 * w * q + 0.5),
            none,
        ),
        "stop at one side": (
            force,
            lambda q, v, *_: -30 * s * max(q - 0.5 * w, 0.0),
            none,
        ),
        "damper in one direction": (
            "unknown force f(dH_dp)",
            lambda q, v, *_: -s * max(v, 0.0),
            none,
        ),
        "maxwell element": (
            "maxwell element on p",
            lambda q, v, z, _: -8 * s * (q - z),
            8 * s,
        ),
        "resonance": (
            "resonance on p",
            lambda q, v, z, r: 0.4 * s * ((7 * w) ** 2 * (z - q) + 2 * w * (r - v)),
            0.4 * s,
        ),
        "nothing hidden": ("", lambda q, v, *_: 0.0, none),
    }


def body(kind: str, rng: np.random.Generator) -> Case:
    """Three runs of 400 samples, of which the last is held out."""
    m, k, c = rng.uniform(0.5, 2), rng.uniform(5, 20), rng.uniform(0.1, 0.5)
    s, w = rng.uniform(0.6, 1.4, 2)
    told, law, size = laws(s, w)[kind]

    def rates(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        q, v, z, r = x
        memory = [r, (7 * w) ** 2 * (q - z) + 2 * w * (v - r)]
        if kind == "maxwell element":
            memory = [(q - z) / (0.3 * w), 0.0]
        return np.array([v, (-k * q - c * v + u[0] + law(*x)) / m, *memory])

    u = [np.repeat(rng.uniform(-8, 8, (40, 1)), 10, axis=0) for _ in range(3)]
    runs = []
    for one in u:
        start = np.array([0.4, 0.0, 0.0, 0.0])
        runs.append(simulated(rng, rates, start, one, 0.05, shaken=(1,))[:, :1])
    data = measured(rng, runs, u, 0.05, states=["q"], inputs=["u"], hold="zero")
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=f"k*q**2/2 + p**2/(2*{m})",
        R={"p": "c"},
        F={"p": "u"},
    )
    true = frozenset(filter(None, [told]))
    return Case(model, data, true, {told: size} if np.isfinite(size) else {})


KINDS: dict[str, Draw] = {kind: partial(body, kind) for kind in laws(1.0, 1.0)}


if __name__ == "__main__":
    report("functions", KINDS, FIRST)

"""How the L1 weights decide what is called energy and what force (thesis Section 5.2).

A mass-spring without damping or force, dq/dt = p, dp/dt = -q, is fitted by S grad H + F
with polynomials of degree 2 in q and p for H and for both equations of F. F alone can
be all of it, H alone too, and so can any sum of the two: the weights lambda_H and
lambda_F choose. Four pairs of weights, three random starts each, by the solver (from
its convex start, and from the random starts) and by gradient descent from random
starts.

    python -m problems.thesis.regularization [--quick]
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis.regularization_page import (
    Run,
    figure,
    inner_part,
    outer_part,
    text,
)
from problems.tools.command_line import flag
from problems.tools.provenance import write

WEIGHTS = ((0.0, 0.0), (0.1, 0.0), (0.0, 0.1), (0.1, 0.1))  # lambda_H, lambda_F
STARTS = (0, 1, 2)
SPREAD = 0.5  # standard deviation of the random starts (thesis Section 5.1)
LEARNING_RATE = 5e-3
EPOCHS = 100
BATCH = 32
# Coefficients of the table as the model and as the page names them.
MAIN = {
    "H[q**2]": "H[q^2]",
    "H[p**2]": "H[p^2]",
    "F_q[p]": "F_q[p]",
    "F_p[q]": "F_p[q]",
}
HEADS = {
    "solver": "By the solver (PHSI loss, SRK4, no pruning)",
    "descent": f"By gradient descent (same loss; Adam, rate {LEARNING_RATE:g}, "
    f"{EPOCHS} epochs, batch {BATCH}, no pruning, L1 to the end)",
}


def data(n: int = 30, seed: int = 1) -> ph.Measurements:
    """``n`` trajectories of 50 steps of 0.1 without noise.

    They start in a ring of radius 1 to 4.5.
    """
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 5.0, 51)
    radius = 1 + 3.5 * np.sqrt(rng.random(n))
    angle = 2 * np.pi * rng.random(n)
    runs = []
    for r, a in zip(radius, angle, strict=True):
        runs.append(r * np.column_stack([np.cos(a - t), np.sin(a - t)]))
    return ph.Measurements.from_arrays([t] * n, runs, states=["q", "p"])


def model() -> ph.PseudoHamiltonian:
    """S grad H + F with everything of degree 2 in both."""
    both = ph.polynomials(["q", "p"], degree=2)
    return ph.PseudoHamiltonian(
        states=["q", "p"], S=ph.canonical(1), H=both, F={"q": both, "p": both}
    )


def random_values(seed: int) -> dict[str, float]:
    """N(0, 0.5^2) for every coefficient."""
    rng = np.random.default_rng(seed)
    names = model().free
    return dict(zip(names, rng.normal(0.0, SPREAD, len(names)).tolist(), strict=True))


def by_solver(measured: ph.Measurements, starts: tuple[int, ...]) -> Iterator[Run]:
    """From the solver's own convex start, and from random starts.

    A random start is given as a fit, which replaces the convex one.
    """
    loss = ph.PHSILoss()
    for weights in WEIGHTS:
        l1 = dict(zip("HF", weights, strict=True))
        own = ph.identify(model(), measured, loss, l1)
        yield Run("solver", weights, "convex", own)
        for seed in starts:
            random = replace(own, model=model().with_values(random_values(seed)))
            fit = ph.identify(model(), measured, loss, l1, start=random)
            yield Run("solver", weights, f"random {seed}", fit)


def by_descent(measured: ph.Measurements, starts: tuple[int, ...]) -> Iterator[Run]:
    """Adam from random starts, L1 to the end and no pruning."""
    from phsi_opt.baselines.gradient_descent import Descent, gradient_descent

    for weights in WEIGHTS:
        settings = Descent(
            learning_rate=LEARNING_RATE,
            epochs=EPOCHS,
            batch=BATCH,
            prune_every=None,
            l1=dict(zip("HF", weights, strict=True)),
            l1_off_after=None,
            start="normal",
        )
        for seed in starts:
            found = gradient_descent(model(), measured, settings, seed=seed)
            yield Run("descent", weights, f"random {seed}", found)


def attribution(runs: list[Run], measured: ph.Measurements) -> pd.DataFrame:
    """Rms of S grad H and of F over the data, the share of F, and the coefficients."""
    x = np.concatenate([run.x for run in measured.trajectories])
    return pd.DataFrame([_row(run, x) for run in runs])


def _row(run: Run, x: np.ndarray) -> dict[str, object]:
    """``x``: states (n_samples, 2) at which the two parts are compared."""
    truth = np.column_stack([x[:, 1], -x[:, 0]])
    inner = _rates(inner_part(run.result), x)
    outer = _rates(outer_part(run.result), x)
    h = _rms(inner)
    f = _rms(outer)
    values = run.result.values
    others = [value for name, value in values.items() if name not in MAIN]
    return {
        "method": run.method,
        "lambda_H": run.weights[0],
        "lambda_F": run.weights[1],
        "start": run.start,
        "rms S grad H": h,
        "rms F": f,
        "share of F": f / (h + f),
        **{shown: values.get(name, 0.0) for name, shown in MAIN.items()},
        "largest other": np.abs(others).max(),
        "relative error": _rms(inner + outer - truth) / _rms(truth),
    }


def _rms(rates: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(rates**2, axis=1))))


def _rates(part: ph.Model, x: np.ndarray) -> np.ndarray:
    """Right-hand side (n_samples, n_states) of a part at the states ``x``."""
    n = len(x)
    no_inputs = np.zeros((0, n))
    times = np.zeros((1, n))
    theta = np.tile(part.theta, (n, 1)).T
    return np.array(part.rhs().map(n)(x.T, no_inputs, times, theta)).T


def warnings_of(runs: list[Run]) -> pd.DataFrame:
    """What the fits of the solver warn of."""
    rows = []
    for run in runs:
        if isinstance(run.result, ph.Fit):
            rows += [(*run.weights, run.start, note) for note in run.result.warnings]
    return pd.DataFrame(rows, columns=["lambda_H", "lambda_F", "start", "warning"])


def main(quick: bool = False) -> dict[str, pd.DataFrame]:
    """Tables attribution and warnings; written under results/thesis unless ``quick``
    (few data, one start, solver only).
    """
    measured = data(n=6 if quick else 30)
    runs = list(by_solver(measured, STARTS[:1] if quick else STARTS))
    if not quick:
        runs += by_descent(measured, STARTS)
    table = attribution(runs, measured)
    warnings = warnings_of(runs)
    page = text(table, warnings, HEADS)
    print(page)
    if not quick:
        figure(runs)
        write("thesis/regularization.md", page)
    return {"attribution": table, "warnings": warnings}


if __name__ == "__main__":
    main(quick=flag("quick"))

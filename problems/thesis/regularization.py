"""How the L1 weights decide what is called energy and what force (thesis Section 5.2).

A mass-spring without damping or force, dq/dt = p, dp/dt = -q, is fitted by S grad H + F
with polynomials of degree 2 in q and p for H and for both equations of F. F alone can
be all of it, H alone too, and so can any sum of the two: the weights lambda_H and
lambda_F choose. Four pairs of weights, three random starts each, by the solver (from
its convex start, and from the random starts) and by gradient descent from random
starts.

    python -m problems.thesis.regularization [--quick]
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

import phsi_opt as ph
from problems.thesis.scores import model_rates
from problems.tools.command_line import flag
from problems.tools.pages import render
from problems.tools.pictures import plt, save
from problems.tools.provenance import write

WEIGHTS = ((0.0, 0.0), (0.1, 0.0), (0.0, 0.1), (0.1, 0.1))  # lambda_H, lambda_F
SPREAD = 0.5  # standard deviation of the random starts (thesis Section 5.1)
LEARNING_RATE = 5e-3
EPOCHS = 100
BATCH = 32
TRUE_COEFFICIENT = 0.5  # of q^2 and p^2 in the energy
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
START = np.array([2.0, 0.0])  # of the trajectories that are drawn
EDGE = 4.0  # where a drawn trajectory that runs away is cut


@dataclass(frozen=True)
class Run:
    """One model: by which method, with which weights, from which start."""

    method: str
    weights: tuple[float, float]
    start: str
    result: Any


def data(n: int = 30, seed: int = 1) -> ph.Measurements:
    """``n`` trajectories of 50 steps of 0.1 without noise.

    They start in a ring of radius 1 to 4.5.
    """
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 5.0, 51)
    radius = 1 + 3.5 * np.sqrt(rng.random(n))
    angle = 2 * np.pi * rng.random(n)
    runs = [
        r * np.column_stack([np.cos(a - t), np.sin(a - t)])
        for r, a in zip(radius, angle, strict=True)
    ]
    return ph.Measurements.from_arrays([t] * n, runs, states=["q", "p"])


def model() -> ph.PseudoHamiltonian:
    """S grad H + F with everything of degree 2 in both."""
    both = ph.polynomials(["q", "p"], degree=2)
    return ph.PseudoHamiltonian(
        states=["q", "p"], S=ph.canonical(1), H=both, F={"q": both, "p": both}
    )


def energy_part(model: ph.Model) -> ph.Model:
    """S grad H alone."""
    return replace(model, F={})


def force_part(model: ph.Model) -> ph.Model:
    """F alone."""
    return ph.FirstOrder(model.states, dict(model.F))


def random_values(seed: int) -> dict[str, float]:
    """N(0, 0.5^2) for every coefficient."""
    names = model().free
    drawn = np.random.default_rng(seed).normal(0.0, SPREAD, len(names))
    return dict(zip(names, drawn.tolist(), strict=True))


def by_solver(measured: ph.Measurements, starts: Sequence[int]) -> Iterator[Run]:
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


def by_descent(measured: ph.Measurements, starts: Sequence[int]) -> Iterator[Run]:
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
    truth = np.column_stack([x[:, 1], -x[:, 0]])
    times = np.zeros(len(x))
    rows = []
    for run in runs:
        energy = model_rates(energy_part(run.result.model), x, times)
        force = model_rates(force_part(run.result.model), x, times)
        h, f = _rms(energy), _rms(force)
        values = run.result.values
        others = [abs(value) for name, value in values.items() if name not in MAIN]
        row = {"method": run.method, "lambda_H": run.weights[0]}
        row |= {"lambda_F": run.weights[1], "start": run.start}
        row |= {"rms S grad H": h, "rms F": f, "share of F": f / (h + f)}
        row |= {shown: values.get(name, 0.0) for name, shown in MAIN.items()}
        row |= {"largest other": max(others)}
        row |= {"relative error": _rms(energy + force - truth) / _rms(truth)}
        rows.append(row)
    return pd.DataFrame(rows)


def _rms(rates: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(rates**2, axis=1))))


def warnings_of(runs: list[Run]) -> pd.DataFrame:
    """What the fits of the solver warn of."""
    rows = [
        (*run.weights, run.start, note)
        for run in runs
        if isinstance(run.result, ph.Fit)
        for note in run.result.warnings
    ]
    return pd.DataFrame(rows, columns=["lambda_H", "lambda_F", "start", "warning"])


def page(table: pd.DataFrame, warnings: pd.DataFrame) -> str:
    """The page results/thesis/regularization.md."""
    weights = ["lambda_H", "lambda_F"]
    solver = table[table["method"] == "solver"]
    # By how much a weight on H takes the energy's coefficients below the truth.
    shrunk = 1 - solver[["H[q^2]", "H[p^2]"]].max(axis=1) / TRUE_COEFFICIENT
    on_force, on_both = solver["lambda_F"] > 0, solver["lambda_H"] > 0
    free = warnings[(warnings[weights] == 0).all(axis=1)]
    return render(
        "thesis/pages/regularization.md",
        table=table,
        heads=HEADS,
        shares={
            method: part.groupby(weights, sort=False)["share of F"].agg(["min", "max"])
            for method, part in table.groupby("method", sort=False)
        },
        shrunk_by_both=shrunk[on_force & on_both].max(),
        shrunk_by_force=abs(shrunk[on_force & ~on_both]).max(),
        warning=free["warning"].iloc[0] if len(free) else None,
        start=START,
    )


def figure(runs: Sequence[Run]) -> None:
    """Phase plots as in Figure 5.1: a column per pair of weights, a row per part.

    Drawn are the models of the solver from its random starts.
    """
    drawn = [r for r in runs if r.method == "solver" and r.start != "convex"]
    parts: dict[str, Callable[[ph.Model], ph.Model]] = {
        "S grad H + F": lambda whole: whole,
        "S grad H alone": energy_part,
        "F alone": force_part,
    }
    size: Any = {"figsize": (10.0, 7.8), "layout": "constrained"}
    fig, axes = plt.subplots(len(parts), len(WEIGHTS), sharex=True, sharey=True, **size)
    for row, (label, part) in zip(axes, parts.items(), strict=True):
        row[0].set_ylabel(f"{label}\n\np (-)")
        for ax, weights in zip(row, WEIGHTS, strict=True):
            of = [run.result.model for run in drawn if run.weights == weights]
            _panel(ax, [part(whole) for whole in of])
    for ax, (on_energy, on_force) in zip(axes[0], WEIGHTS, strict=True):
        ax.set_title(f"$\\lambda_H$ = {on_energy:g}, $\\lambda_F$ = {on_force:g}")
    for ax in axes[-1]:
        ax.set_xlabel("q (-)")
    handles, names = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, names, loc="outside lower center", ncols=4, frameon=False)
    save(fig, "thesis/regularization.png", dpi=120)


def _panel(ax: plt.Axes, parts: Sequence[ph.Model]) -> None:
    """Orbits of one part of the models of all starts, thinner from start to start."""
    angle = np.linspace(0, 2 * np.pi, 200)
    circle = np.linalg.norm(START) * np.array([np.cos(angle), np.sin(angle)])
    ax.plot(*circle, color="0.75", lw=6, label="truth")
    for k, part in enumerate(parts):
        orbit = _orbit(part)
        look: Any = {"color": f"C{k}", "lw": 2.4 - 0.7 * k, "ls": ("-", "--", ":")[k]}
        ax.plot(*orbit, label=f"random start {k}", **look)
        ax.plot(*orbit[:, -1], "o", color=f"C{k}", ms=5 - k)
    ax.plot(*START, "k+", ms=9)
    ax.set(xlim=(-EDGE, EDGE), ylim=(-EDGE, EDGE), aspect="equal")


def _orbit(part: ph.Model) -> np.ndarray:
    """Trajectory (2, n) from `START` over one period of the truth.

    Cut where it leaves the picture.
    """
    rhs = part.rhs()
    theta = part.theta

    def rates(t: float, x: np.ndarray) -> np.ndarray:
        return np.array(rhs(x, [], t, theta)).ravel()

    def inside(t: float, x: np.ndarray) -> float:
        return EDGE - float(np.abs(x).max())

    inside.terminal = True  # type: ignore[attr-defined]
    limits = {"rtol": 1e-8, "atol": 1e-8, "max_step": 0.05, "events": inside}
    return solve_ivp(rates, (0.0, 2 * np.pi), START, "RK45", **limits).y


def main(quick: bool = False) -> dict[str, pd.DataFrame]:
    """Tables attribution and warnings; written under results/thesis unless ``quick``
    (few data, one start, solver only).
    """
    measured = data(n=6 if quick else 30)
    starts = range(1 if quick else 3)
    runs = list(by_solver(measured, starts))
    if not quick:
        runs += by_descent(measured, starts)
    table, warnings = attribution(runs, measured), warnings_of(runs)
    text = page(table, warnings)
    print(text)
    if not quick:
        figure(runs)
        write("thesis/regularization.md", text)
    return {"attribution": table, "warnings": warnings}


if __name__ == "__main__":
    main(quick=flag("quick"))

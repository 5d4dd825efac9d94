"""How the L1 weights decide what is called energy and what force: thesis Section 5.2
and Figure 5.1.

A mass-spring without damping or force, dq/dt = p, dp/dt = -q, is fitted by S grad H + F
with polynomials of degree 2 in q and p for H and for both equations of F. F alone can
be all of it, H alone too, and so can any sum of the two: the weights choose.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

import phsi_opt as ph
from problems.thesis.runs import shown
from problems.thesis.scores import model_rates
from problems.tools.pages import render
from problems.tools.pictures import legend_below, panels, save

WEIGHTS = ((0.0, 0.0), (0.1, 0.0), (0.0, 0.1), (0.1, 0.1))  # lambda_H, lambda_F
SPREAD = 0.5  # standard deviation of the random starts (thesis Section 5.1)
START = np.array([2.0, 0.0])  # of the trajectories that are drawn
EDGE = 4.0  # where a drawn trajectory that runs away is cut


@dataclass(frozen=True)
class Split:
    """One model: by which method, with which weights, from which start."""

    method: str
    weights: tuple[float, float]
    start: str
    result: Any


def data(n: int = 30, seed: int = 1) -> ph.Measurements:
    """``n`` trajectories of 50 steps of 0.1 without noise, from a ring of radius 1 to
    4.5.
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


def parts(whole: ph.Model) -> dict[str, ph.Model]:
    """The model, its energy alone and its force alone."""
    force = ph.FirstOrder(whole.states, dict(whole.F))
    energy = replace(whole, F={})
    return {"S grad H + F": whole, "S grad H alone": energy, "F alone": force}


def splits(measured: ph.Measurements, starts: Sequence[int]) -> Iterator[Split]:
    """The solver from its convex start and from random ones, which are given as a fit,
    and gradient descent from random ones.
    """
    from phsi_opt.baselines.gradient_descent import Descent, gradient_descent

    loss = ph.PHSILoss()
    for weights in WEIGHTS:
        l1 = dict(zip("HF", weights, strict=True))
        own = ph.identify(model(), measured, loss, l1)
        yield Split("solver", weights, "convex", own)
        settings = Descent(
            learning_rate=5e-3,
            epochs=100,
            prune_every=None,
            l1=l1,
            l1_off_after=None,
            start="normal",
        )
        for seed in starts:
            drawn = np.random.default_rng(seed).normal(0.0, SPREAD, len(own.names))
            values = dict(zip(model().free, drawn.tolist(), strict=True))
            random = replace(own, model=model().with_values(values))
            fit = ph.identify(model(), measured, loss, l1, start=random)
            yield Split("solver", weights, f"random {seed}", fit)
            found = gradient_descent(model(), measured, settings, seed=seed)
            yield Split("descent", weights, f"random {seed}", found)


def attribution(found: Sequence[Split], measured: ph.Measurements) -> pd.DataFrame:
    """Rms of S grad H and of F over the data, and the share of F."""
    x = np.concatenate([run.x for run in measured.trajectories])
    truth = np.column_stack([x[:, 1], -x[:, 0]])
    rows = []
    for one in found:
        _, energy, force = (
            model_rates(part, x, np.zeros(len(x)))
            for part in parts(one.result.model).values()
        )
        h, f = _rms(energy), _rms(force)
        row = {"method": one.method, "lambda_H": one.weights[0]}
        row |= {"lambda_F": one.weights[1], "start": one.start}
        row |= {"rms S grad H": h, "rms F": f, "share of F": f / (h + f)}
        error = _rms(energy + force - truth) / _rms(truth)
        rows.append(row | {"relative error": error})
    return pd.DataFrame(rows)


def _rms(rates: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(rates**2, axis=1))))


def warning_of(found: Sequence[Split]) -> str:
    """What the fit of the solver without weights warns of."""
    for one in found:
        if one.method == "solver" and one.weights == WEIGHTS[0]:
            return "; ".join(one.result.warnings)
    return ""


def regularization_page(quick: bool) -> str:
    """The page of the weights; the figure is drawn unless ``quick``."""
    measured = data(n=6 if quick else 30)
    found = list(splits(measured, range(1 if quick else 3)))
    rows = attribution(found, measured)
    by = rows.groupby(["method", "lambda_H", "lambda_F"], sort=False)["share of F"]
    shares = by.agg(["min", "max"]).reset_index()
    if not quick:
        draw([one for one in found if one.method == "solver"])
    return render(
        "thesis/pages/regularization.md",
        rows=shown(rows),
        shares=shown(shares),
        warning=warning_of(found),
        start=START,
    )


def draw(found: Sequence[Split]) -> None:
    """Figure 5.1: phase plots, a column per pair of weights, a row per part."""
    names = list(parts(found[0].result.model))
    figure, axes = panels(3, len(WEIGHTS), (10.0, 7.8), shared=True)
    circle = np.linspace(0, 2 * np.pi, 200)
    for row, name in zip(axes, names, strict=True):
        row[0].set_ylabel(f"{name}\n\np (-)")
        for ax, weights in zip(row, WEIGHTS, strict=True):
            ax.plot(2 * np.cos(circle), 2 * np.sin(circle), color="0.75", lw=6)
            own = [d for d in found if d.weights == weights and d.start != "convex"]
            for k, one in enumerate(own):
                orbit = _orbit(parts(one.result.model)[name])
                ax.plot(*orbit, color=f"C{k}", lw=2.4 - 0.7 * k, label=one.start)
                ax.plot(*orbit[:, -1], "o", color=f"C{k}", ms=5 - k)
            ax.set(xlim=(-EDGE, EDGE), ylim=(-EDGE, EDGE), aspect="equal")
    for ax, (on_energy, on_force) in zip(axes[0], WEIGHTS, strict=True):
        ax.set_title(f"$\\lambda_H$ = {on_energy:g}, $\\lambda_F$ = {on_force:g}")
    for ax in axes[-1]:
        ax.set_xlabel("q (-)")
    legend_below(axes[0, 0])
    save(figure, "thesis/regularization.png", dpi=110)


def _orbit(part: ph.Model) -> np.ndarray:
    """Trajectory (2, n) over one period, cut where it leaves the picture."""
    rhs, theta = part.rhs(), part.theta

    def rates(t: float, x: np.ndarray) -> np.ndarray:
        return np.array(rhs(x, [], t, theta)).ravel()

    def inside(t: float, x: np.ndarray) -> float:
        return EDGE - float(np.abs(x).max())

    inside.terminal = True  # type: ignore[attr-defined]
    limits = {"rtol": 1e-8, "atol": 1e-8, "max_step": 0.05, "events": inside}
    return solve_ivp(rates, (0.0, 2 * np.pi), START, "RK45", **limits).y

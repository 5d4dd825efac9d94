"""Section 6.5: how much L1 and pruning? Free-run error over grids of both, on clean
data.

Gradient descent: lambda_H x pruning interval P, with the few epochs of the thesis.
Solver: lambda_H x threshold; the leak of the tanks has its known form there, so that
only H and R are at stake. The error is the l2 norm over all states, averaged over the
test time and 30 unseen starts.

    python -m problems.thesis.grids [--quick] [system ...]
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis.methods import descent
from problems.thesis.scores import free_run, score
from problems.thesis.systems import (
    SYSTEMS,
    System,
    known_leak,
    tank_model,
    thesis_data_present,
)
from problems.tools.command_line import chosen, flag
from problems.tools.provenance import RESULTS, write

THRESHOLDS = (0.0, 0.05, 0.2)
COLUMNS = [
    "system",
    "method",
    "lambda_H",
    "pruning",
    "error",
    "spurious",
    "missed",
    "seconds",
]


@dataclass(frozen=True)
class Grid:
    """What the thesis varies for one system, and for how many epochs it trains."""

    weights: tuple[float, ...]
    intervals: tuple[int, ...]
    epochs: int


GRIDS = {
    "henon_heiles": Grid((0.0, 0.05, 0.5), (1, 2, 4), 3),
    "schrodinger": Grid((0.0, 0.05, 0.5), (1, 5, 10), 10),
    "mass_spring": Grid((0.0, 0.1, 0.5), (20, 40, 80), 80),
    "tanks": Grid((0.0, 0.05, 0.5), (10, 40, 80), 80),
}


def by_descent(
    system: System, data: ph.Measurements, weight: float, interval: int, epochs: int
) -> Any:
    """Gradient descent with one weight and one interval; pruning begins after the first
    interval (Algorithm 6).
    """
    l1 = {**system.descent.l1, "H": weight}
    chosen = replace(
        system.descent, epochs=epochs, prune_every=interval, prune_from=interval, l1=l1
    )
    return descent(replace(system, descent=chosen), data, "clean")


def by_solver(
    system: System, data: ph.Measurements, weight: float, threshold: float
) -> Any:
    """The solver with one weight and one threshold, without significance."""
    model = tank_model(known_leak()) if system.name == "tanks" else system.model()
    settings = ph.SolverSettings(
        max_iterations=200
    )  # without any L1 the tanks' Casimir leaves a direction free
    return ph.identify(
        model,
        data,
        ph.PHSILoss(),
        {**system.l1, "H": weight},
        ph.Pruning(threshold),
        settings=settings,
        raise_on_failure=False,
    )


def main(quick: bool = False, names: list[str] | None = None) -> pd.DataFrame:
    """A row per system, method and point of the grid."""
    rows: list[tuple[Any, ...]] = []
    for name in names or list(SYSTEMS):
        system, grid = SYSTEMS[name], GRIDS[name]
        if quick:
            data, (t, tests) = (
                system.data(1, 0.0, n=400 if name == "henon_heiles" else 6),
                system.tests(3),
            )
            grid = Grid(grid.weights[:2], (1,), 1)
        else:
            data = (
                system.thesis_data("clean")
                if thesis_data_present()
                else system.data(1, 0.0)
            )
            t, tests = system.tests(30)
        points: list[tuple[str, float, str, tuple[Any, ...]]] = []
        points += [
            ("descent", w, f"P = {p}", (w, p, grid.epochs))
            for w in grid.weights
            for p in grid.intervals
        ]
        points += [
            ("solver", w, f"threshold {e:g}", (w, e))
            for w in grid.weights
            for e in THRESHOLDS
        ]
        for method, weight, pruning, settings in points:
            by: Callable[..., Any] = by_descent if method == "descent" else by_solver
            try:
                fit = by(system, data, *settings)
            except ph.PhsiOptError as failed:  # such as: every term was pruned
                print(
                    f"... {name}, {method}, {weight:g}, {pruning}: {failed}", flush=True
                )
                rows.append(
                    (
                        name,
                        method,
                        weight,
                        pruning,
                        np.inf,
                        0,
                        len(system.truth),
                        np.nan,
                    )
                )
                continue
            s = score(system, fit)
            n_spurious = len([n for n in s.spurious if n not in ("slope", "limit")])
            error = float(free_run(fit, t, tests).mean())
            rows.append(
                (
                    name,
                    method,
                    weight,
                    pruning,
                    error,
                    n_spurious,
                    len(s.missed),
                    fit.seconds,
                )
            )
            print("... " + ", ".join(str(v) for v in rows[-1]), flush=True)
    table = pd.DataFrame(rows, columns=COLUMNS)
    if not quick and names is None:
        draw(table)
        write("thesis/grids.md", page(table))
    return table


def draw(table: pd.DataFrame) -> None:
    """A row of two panels per system: descent and solver, a cell per point with its
    error.
    """
    figure, axes = plt.subplots(len(GRIDS), 2, figsize=(8.5, 11), layout="constrained")
    for pair, (name, rows) in zip(
        axes, table.groupby("system", sort=False), strict=True
    ):
        finite = rows["error"][np.isfinite(rows["error"])]
        low, high = np.log10(finite.min()), np.log10(finite.max())
        for ax, method in zip(pair, ("descent", "solver"), strict=True):
            part = rows[rows["method"] == method]
            cells = part.pivot(index="lambda_H", columns="pruning", values="error")
            cells = cells[list(dict.fromkeys(part["pruning"]))]
            values = np.log10(np.where(np.isfinite(cells), cells, 10**high))
            ax.imshow(
                values, cmap="viridis_r", vmin=low - 0.1, vmax=high + 0.1, aspect="auto"
            )
            for (i, j), v in np.ndenumerate(cells.to_numpy()):
                dark = np.isfinite(v) and np.log10(v) > (low + high) / 2
                text = f"{v:.1e}" if np.isfinite(v) else "no model"
                ax.text(
                    j,
                    i,
                    text,
                    ha="center",
                    va="center",
                    color="white" if dark or not np.isfinite(v) else "black",
                )
            ax.set_xticks(range(cells.shape[1]), cells.columns)
            ax.set_yticks(range(cells.shape[0]), [f"{w:g}" for w in cells.index])
            ax.set_ylabel("lambda_H")
            epochs = (
                f", {GRIDS[str(name)].epochs} epochs" if method == "descent" else ""
            )
            ax.set_title(f"{SYSTEMS[str(name)].title}: {method}{epochs}", fontsize=10)
    figure.savefig(RESULTS / "thesis" / "grids.png", dpi=120)
    plt.close(figure)


def page(table: pd.DataFrame) -> str:
    """The grids as text."""
    lines = [
        "# L1 and pruning (thesis Section 6.5)",
        "",
        "![grids](grids.png)",
        "",
        "Mean l2 error of free runs from 30 unseen starts, clean data; dark is worse; both panels of a system share",
        "their colours. Left: gradient descent over L1 weight and pruning interval P, with the few epochs of the",
        "thesis (P equal to the epochs prunes once, at the end). Right: the solver over L1 weight and threshold (0:",
        "nothing is pruned; the last solve is always without L1). No model: every term was pruned, or it diverges.",
        "",
    ]
    for name, rows in table.groupby("system", sort=False):
        shown = rows.drop(columns="system").to_string(
            index=False, float_format=lambda v: f"{v:.3g}"
        )
        lines += [f"## {SYSTEMS[str(name)].title}", "", "```text", shown, "```", ""]
        for method in ("descent", "solver"):
            part = rows[rows["method"] == method].sort_values("error")
            best, worst = part.iloc[0], part.iloc[-1]
            lines += [
                f"{method.capitalize()}: best {best['error']:.2g} at lambda_H {best['lambda_H']:g}, {best['pruning']}; "
                f"worst {worst['error']:.2g} at {worst['lambda_H']:g}, {worst['pruning']}.",
                "",
            ]
    return "\n".join(lines)


if __name__ == "__main__":
    main(flag("quick"), chosen() or None)

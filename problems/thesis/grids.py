"""Section 6.5: how much L1 and pruning? Free-run error over grids of both, on clean
data.

Gradient descent: lambda_H x pruning interval P, with the few epochs of the thesis.
Solver: lambda_H x threshold; the leak of the tanks has its known form there, so that
only H and R are at stake. The error is the l2 norm over all states, averaged over the
test time and the unseen starts.

    python -m problems.thesis.grids [--quick] [system ...]
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis.methods import descent
from problems.thesis.scores import free_run, score
from problems.thesis.systems import SYSTEMS, System, known_leak, tank_model
from problems.tools import markdown
from problems.tools.command_line import chosen, flag
from problems.tools.pictures import plt, save
from problems.tools.provenance import write

THRESHOLDS = (0.0, 0.05, 0.2)
METHODS = ("descent", "solver")
N_TESTS = 30
KNOWN_FORM = ("slope", "limit")  # of the leak; no terms
# Without any L1 the tanks' Casimir leaves a direction free, where iterations end late.
SETTINGS = ph.SolverSettings(max_iterations=200)


@dataclass(frozen=True)
class Grid:
    """What the thesis varies for one system, and for how many epochs it trains."""

    weights: tuple[float, ...]
    intervals: tuple[int, ...]
    epochs: int


@dataclass(frozen=True)
class Point:
    """A point of a grid: ``size`` is the pruning interval or the threshold."""

    method: str
    weight: float
    size: float

    @property
    def pruning(self) -> str:
        """The label of the column."""
        if self.method == "descent":
            return f"P = {self.size:g}"
        return f"threshold {self.size:g}"


GRIDS = {
    "henon_heiles": Grid((0.0, 0.05, 0.5), (1, 2, 4), 3),
    "schrodinger": Grid((0.0, 0.05, 0.5), (1, 5, 10), 10),
    "mass_spring": Grid((0.0, 0.1, 0.5), (20, 40, 80), 80),
    "tanks": Grid((0.0, 0.05, 0.5), (10, 40, 80), 80),
}
QUICK_N = {"henon_heiles": 400}  # trajectories of a quick run; others: 6


def points(grid: Grid) -> Iterator[Point]:
    """All points of a grid, gradient descent first."""
    for weight in grid.weights:
        for interval in grid.intervals:
            yield Point("descent", weight, interval)
    for weight in grid.weights:
        for threshold in THRESHOLDS:
            yield Point("solver", weight, threshold)


def by_descent(system: System, data: ph.Measurements, point: Point, epochs: int) -> Any:
    """Gradient descent; pruning begins after the first interval (Algorithm 6)."""
    interval = int(point.size)
    settings = replace(
        system.descent,
        epochs=epochs,
        prune_every=interval,
        prune_from=interval,
        l1={**system.descent.l1, "H": point.weight},
    )
    return descent(replace(system, descent=settings), data, "clean")


def by_solver(system: System, data: ph.Measurements, point: Point) -> Any:
    """The solver with one weight and one threshold, without significance."""
    model = tank_model(known_leak()) if system.name == "tanks" else system.model()
    return ph.identify(
        model,
        data,
        ph.PHSILoss(),
        {**system.l1, "H": point.weight},
        ph.Pruning(point.size),
        settings=SETTINGS,
        raise_on_failure=False,
    )


def main(quick: bool = False, names: list[str] | None = None) -> pd.DataFrame:
    """A row per system, method and point of the grid."""
    parts = [study(name, quick) for name in names or SYSTEMS]
    table = pd.concat(parts, ignore_index=True)
    if not quick and names is None:
        draw(table)
        write("thesis/grids.md", page(table))
    return table


def study(name: str, quick: bool) -> pd.DataFrame:
    """The grid of one system."""
    system = SYSTEMS[name]
    grid = GRIDS[name]
    if quick:
        grid = Grid(grid.weights[:2], (1,), 1)
        data = system.data(1, 0.0, n=QUICK_N.get(name, 6))
    else:
        data = system.training_data("clean")
    t, tests = system.tests(3 if quick else N_TESTS)
    rows = []
    for point in points(grid):
        key = {
            "system": name,
            "method": point.method,
            "lambda_H": point.weight,
            "pruning": point.pruning,
        }
        try:
            if point.method == "descent":
                fit = by_descent(system, data, point, grid.epochs)
            else:
                fit = by_solver(system, data, point)
        except ph.PhsiOptError as failed:  # such as: every term was pruned
            shown = f"{name}, {point.method}, {point.weight:g}, {point.pruning}"
            print(f"... {shown}: {failed}", flush=True)
            rows.append(key | _no_model(system))
            continue
        rows.append(key | _scored(system, fit, t, tests))
        print("... " + ", ".join(str(v) for v in rows[-1].values()), flush=True)
    return pd.DataFrame(rows)


def _no_model(system: System) -> dict[str, Any]:
    return {
        "error": np.inf,
        "spurious": 0,
        "missed": len(system.truth),
        "seconds": np.nan,
    }


def _scored(
    system: System, fit: Any, t: np.ndarray, tests: np.ndarray
) -> dict[str, Any]:
    s = score(system, fit)
    return {
        "error": float(free_run(fit, t, tests).mean()),
        "spurious": len(set(s.spurious) - set(KNOWN_FORM)),
        "missed": len(s.missed),
        "seconds": fit.seconds,
    }


# --- figure and page


def draw(table: pd.DataFrame) -> None:
    """A row of two panels per system, a cell per point with its error."""
    figure, axes = plt.subplots(len(GRIDS), 2, figsize=(8.5, 11), layout="constrained")
    systems = table.groupby("system", sort=False)
    for pair, (name, rows) in zip(axes, systems, strict=True):
        finite = rows["error"][np.isfinite(rows["error"])]
        ends = (np.log10(finite.min()), np.log10(finite.max()))
        for ax, method in zip(pair, METHODS, strict=True):
            _panel(ax, rows[rows["method"] == method], ends)
            title = f"{SYSTEMS[str(name)].title}: {method}"
            if method == "descent":
                title += f", {GRIDS[str(name)].epochs} epochs"
            ax.set_title(title, fontsize=10)
    save(figure, "thesis/grids.png", dpi=120)


def _panel(ax: plt.Axes, part: pd.DataFrame, ends: tuple[float, float]) -> None:
    """One grid; ``ends``: log10 of the smallest and largest error of the system."""
    low, high = ends
    cells = part.pivot(index="lambda_H", columns="pruning", values="error")
    cells = cells[list(dict.fromkeys(part["pruning"]))]
    values = np.log10(np.where(np.isfinite(cells), cells, 10**high))
    ax.imshow(values, cmap="viridis_r", vmin=low - 0.1, vmax=high + 0.1, aspect="auto")
    for (i, j), value in np.ndenumerate(cells.to_numpy()):
        is_model = bool(np.isfinite(value))
        is_dark = not is_model or np.log10(value) > (low + high) / 2
        ax.text(
            j,
            i,
            f"{value:.1e}" if is_model else "no model",
            ha="center",
            va="center",
            color="white" if is_dark else "black",
        )
    ax.set_xticks(range(cells.shape[1]), cells.columns)
    ax.set_yticks(range(cells.shape[0]), [f"{w:g}" for w in cells.index])
    ax.set_ylabel("lambda_H")


def page(table: pd.DataFrame) -> str:
    """The grids as text."""
    lines = ["# L1 and pruning (thesis Section 6.5)", "", "![grids](grids.png)", ""]
    lines += [INTRODUCTION, ""]
    for name, rows in table.groupby("system", sort=False):
        lines += [f"## {SYSTEMS[str(name)].title}", ""]
        lines += markdown.frame(rows.drop(columns="system"))
        for method in METHODS:
            lines += [_extremes(method, rows[rows["method"] == method]), ""]
    return "\n".join(lines)


INTRODUCTION = markdown.paragraph(f"""
    Mean l2 error of free runs from {N_TESTS} unseen starts, clean data; dark is worse;
    both panels of a system share their colours. Left: gradient descent over L1 weight
    and pruning interval P, with the few epochs of the thesis (P equal to the epochs
    prunes once, at the end). Right: the solver over L1 weight and threshold (0: nothing
    is pruned; the last solve is always without L1). No model: every term was pruned, or
    it diverges.
    """)


def _extremes(method: str, part: pd.DataFrame) -> str:
    ordered = part.sort_values("error")
    best = ordered.iloc[0]
    worst = ordered.iloc[-1]
    return (
        f"{method.capitalize()}: best {best['error']:.2g} at lambda_H "
        f"{best['lambda_H']:g}, {best['pruning']}; worst {worst['error']:.2g} at "
        f"{worst['lambda_H']:g}, {worst['pruning']}."
    )


if __name__ == "__main__":
    main(flag("quick"), chosen() or None)

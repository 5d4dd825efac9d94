"""Section 6.5: how much L1 and pruning? Free-run error over grids of both, on clean
data: Figures 6.9 to 6.16.

Gradient descent: lambda_H x pruning interval P, with the few epochs of the thesis and
its lambda_F (0.01 on the mass-spring's force). Solver: lambda_H x threshold; the leak
of the tanks has its known form there, so that only H and R are at stake.

The text and the code of the thesis differ in what the loss sums, and with it in how
heavy a given lambda is; so the diagonal of the descent's grid is run for both.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis import figures
from problems.thesis.methods import descent
from problems.thesis.runs import Done, Setting, done, shown, table
from problems.thesis.systems import SYSTEMS, System, known_leak, tank_model
from problems.tools.pages import number, render

# Without any L1 the tanks' Casimir leaves a direction free, where iterations end late.
SETTINGS = ph.SolverSettings(max_iterations=200)
THRESHOLDS = (0.0, 0.05, 0.2)
SPARSITY = ("least", "middle", "most")
BATCH = 32  # samples in a batch of the descent
ALIKE = 1.5  # errors within this factor count as neither better nor worse
QUICK_N = {"henon_heiles": 400}  # trajectories of a quick run
N_TESTS = 10


@dataclass(frozen=True)
class Grid:
    """What the thesis varies for one system, for how many epochs it trains, what it
    says, and the weight of L1 on the coefficients of the force.
    """

    weights: tuple[float, ...]
    intervals: tuple[int, ...]
    epochs: int
    thesis: str
    force_weight: float = 0.0


GRIDS = {
    "henon_heiles": Grid(
        (0.0, 0.05, 0.5), (1, 2, 4), 3, "neither improves nor worsens"
    ),
    "schrodinger": Grid(
        (0.0, 0.05, 0.5), (1, 5, 10), 10, "helps (error about 5 times smaller)"
    ),
    "mass_spring": Grid((0.0, 0.1, 0.5), (20, 40, 80), 80, "helps, L1 most", 0.01),
    "tanks": Grid(
        (0.0, 0.05, 0.5), (10, 40, 80), 80, "helps (error about 60 times smaller)"
    ),
}
CODE, TEXT = "mean of squares (code)", "sum of squares (text, Eq. 5.6)"


def by_descent(
    system: System,
    data: ph.Measurements,
    grid: Grid,
    weight: float,
    interval: int,
    is_sum: bool = False,
) -> Any:
    """Gradient descent at a point; ``is_sum``: of the loss, over batch and states."""
    n_states = len(system.states)
    share = 1 / (BATCH * n_states) if is_sum else 1.0
    l1 = {"H": weight * share * n_states}
    if grid.force_weight:
        l1["F"] = grid.force_weight * share * n_states
    settings = replace(
        system.descent,
        epochs=grid.epochs,
        prune_every=interval,
        prune_from=interval,
        l1=l1,
    )
    return descent(replace(system, descent=settings), data, "clean")


def by_solver(
    system: System, data: ph.Measurements, weight: float, threshold: float
) -> Any:
    """The solver with one weight and one threshold, without significance."""
    model = tank_model(known_leak()) if system.name == "tanks" else system.model()
    return ph.identify(
        model,
        data,
        ph.PHSILoss(),
        {**system.l1, "H": weight},
        ph.Pruning(threshold),
        settings=SETTINGS,
        raise_on_failure=False,
    )


def runs_of(system: System, grid: Grid, quick: bool) -> list[Done]:
    """Both grids, and the diagonal of the descent with the loss of the text."""
    data = system.few("clean", QUICK_N) if quick else system.training_data("clean")
    setting = Setting(system, data, system.tests(2 if quick else N_TESTS))
    found = []

    def ran(method: str, weight: float, pruning: str, made: Any) -> None:
        keys = {"system": system.title, "method": method, "lambda_H": weight}
        found.append(done(setting, made, **keys, pruning=pruning))

    for weight in grid.weights:
        for interval in grid.intervals:
            made = partial(by_descent, system, data, grid, weight, interval)
            ran(f"descent, {CODE}", weight, f"P = {interval}", made)
    for weight in grid.weights:
        for threshold in THRESHOLDS:
            made = partial(by_solver, system, data, weight, threshold)
            ran("solver", weight, f"threshold {threshold:g}", made)
    for weight, interval in diagonal(grid):
        made = partial(by_descent, system, data, grid, weight, interval, True)
        ran(f"descent, {TEXT}", weight, f"P = {interval}", made)
    return found


def diagonal(grid: Grid) -> list[tuple[float, int]]:
    """From the least sparsity (no L1, latest pruning) to the most."""
    return list(zip(grid.weights, grid.intervals[::-1], strict=False))


def verdict(errors: Sequence[float]) -> str:
    """Whether sparsity helps, from the errors at the least, middle and most."""
    least, best = errors[0], min(errors[1:])
    if not np.isfinite(best):
        return "no model" if not np.isfinite(least) else "hurts"
    if not np.isfinite(least):
        return "helps (alone gives a model)"
    if best < least / ALIKE:
        return f"helps ({number(least / best)} times)"
    if best > least * ALIKE:
        return f"hurts ({number(best / least)} times)"
    return "neither"


def verdicts(name: str, grid: Grid, rows: pd.DataFrame) -> list[dict[str, object]]:
    """A line for each way to read the thesis."""
    lines = []
    for words in (CODE, TEXT):
        own = rows[rows["method"] == f"descent, {words}"]
        errors = []
        for weight, interval in diagonal(grid):
            is_here = own["lambda_H"] == weight
            is_here &= own["pruning"] == f"P = {interval}"
            errors.append(float(own.loc[is_here, "l2 whole"].iloc[0]))
        line: dict[str, object] = {"system": SYSTEMS[name].title, "loss": words}
        for sparsity, error in zip(SPARSITY, errors, strict=False):
            line[f"error, {sparsity}"] = f"{error:.2g}".replace("inf", "no model")
        lines.append(line | {"here": verdict(errors), "thesis": grid.thesis})
    return lines


def grids_page(quick: bool) -> str:
    """The page of the grids; figures are drawn unless ``quick``."""
    rows, lines = [], []
    for name in ("henon_heiles",) if quick else GRIDS:
        system, grid = SYSTEMS[name], GRIDS[name]
        if quick:
            grid = replace(grid, weights=grid.weights[:2], intervals=(1, 2), epochs=2)
        found = runs_of(system, grid, quick)
        rows.append(table(found))
        lines += verdicts(name, grid, rows[-1])
        if not quick:
            draw_paths(system, grid, found)
    every = pd.concat(rows, ignore_index=True)
    if not quick:
        figures.grids("grids", every[~every["method"].str.contains("text")])
    kept = every.drop(columns=["covered", "largest error", "loss", "l2 inside"])
    return render(
        "thesis/pages/grids.md", verdicts=lines, rows=shown(kept), alike=ALIKE
    )


def draw_paths(system: System, grid: Grid, found: Sequence[Done]) -> None:
    """Figures 6.10, 6.12, 6.14, 6.16: trajectories at three points of each grid."""
    sizes = {f"descent, {CODE}": [f"P = {p}" for p in grid.intervals[::-1]]}
    sizes["solver"] = [f"threshold {size:g}" for size in THRESHOLDS]
    rows = []
    for method, prunings in sizes.items():
        panels = []
        for weight, pruning in zip(grid.weights, prunings, strict=True):
            wanted = {"method": method, "lambda_H": weight, "pruning": pruning}
            one = next(d for d in found if wanted.items() <= d.row.items())
            title = f"{method.split(',')[0]}: lambda_H {weight:g}, {pruning}"
            panels.append((title, {method: one.result}))
        rows.append(panels)
    figures.trajectories(f"grid_{system.name}", system, rows)

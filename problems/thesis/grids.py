"""Section 6.5: how much L1 and pruning? Free-run error over grids of both, on clean
data.

Gradient descent: lambda_H x pruning interval P, with the few epochs of the thesis and
its lambda_F (0.01 on the mass-spring's force). Solver: lambda_H x threshold; the leak
of the tanks has its known form there, so that only H and R are at stake. The error is
the l2 norm over all states, averaged over the test time and the unseen starts.

Three points of each grid, from the least sparsity to the most, are drawn as
trajectories, and trained once more as `grid_readings` reads the thesis.

    python -m problems.thesis.grids [--quick] [system ...]
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis import grid_page, grid_readings
from problems.thesis.figures import EXAMPLES, INSIDE, simulated
from problems.thesis.grid_points import (
    GRIDS,
    Grid,
    Point,
    diagonal,
    error_row,
    points,
    trained,
)
from problems.thesis.systems import SYSTEMS, System, known_leak, tank_model
from problems.tools.command_line import chosen, flag
from problems.tools.kept_tables import rewrite
from problems.tools.provenance import RESULTS, write

N_TESTS = 30
N_SAMPLES = 501  # of a trajectory that is drawn
# Without any L1 the tanks' Casimir leaves a direction free, where iterations end late.
SETTINGS = ph.SolverSettings(max_iterations=200)
QUICK_N = {"henon_heiles": 400}  # trajectories of a quick run; others: 6
TANK_EXAMPLE = replace(INSIDE, end=1.0)  # twice the training time


@dataclass(frozen=True, eq=False)
class Study:
    """The grids of one system.

    ``rows``: one per point; ``paths``: by point of the diagonals, the trajectory from
    the example's start, or why there is none.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    paths: dict[Point, Any] = field(default_factory=dict)


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
    """A row per system, method and point of the grid; the page is written where all
    systems were run, unless ``quick``.
    """
    parts = []
    readings = []
    for name in names or SYSTEMS:
        system = SYSTEMS[name]
        grid = _quick(GRIDS[name]) if quick else GRIDS[name]
        found = study(system, grid, quick)
        parts.append(pd.DataFrame(found.rows))
        readings.append(grid_readings.study(system, grid, _n_tests(quick), quick))
        if not quick:
            grid_page.draw_paths(system, grid, _truth(system), found.paths)
    table = pd.concat(parts, ignore_index=True)
    of_readings = pd.concat(readings, ignore_index=True)
    if not quick and names is None:
        grid_page.draw(table)
        rewrite(RESULTS / "thesis/grids.csv", table)
        rewrite(RESULTS / "thesis/grid_readings.csv", of_readings)
        write("thesis/grids.md", grid_page.page(table, of_readings, N_TESTS))
    return table


def _quick(grid: Grid) -> Grid:
    return replace(grid, weights=grid.weights[:2], intervals=(1,), epochs=1)


def _n_tests(quick: bool) -> int:
    return 3 if quick else N_TESTS


def study(system: System, grid: Grid, quick: bool) -> Study:
    """The grids of one system, gradient descent first."""
    if quick:
        data = system.data(1, 0.0, n=QUICK_N.get(system.name, 6))
    else:
        data = system.training_data("clean")
    t, tests = system.tests(_n_tests(quick))
    drawn = set(diagonal(grid, "descent")) | set(diagonal(grid, "solver"))
    found = Study()
    for point in points(grid):
        fit = _fitted(system, data, point, grid)
        row = {**_key(system, point), **error_row(system, fit, t, tests)}
        found.rows.append(row)
        print("... " + ", ".join(str(value) for value in row.values()), flush=True)
        if point in drawn:
            found.paths[point] = _path(system, fit)
    return found


def _key(system: System, point: Point) -> dict[str, Any]:
    return {
        "system": system.name,
        "method": point.method,
        "lambda_H": point.weight,
        "pruning": point.pruning,
    }


def _fitted(system: System, data: ph.Measurements, point: Point, grid: Grid) -> Any:
    """The result, or the error where there is none, such as: every term was pruned."""
    try:
        if point.method == "descent":
            return trained(system, data, point, grid)
        return by_solver(system, data, point)
    except ph.PhsiOptError as failed:
        return failed


def _path(system: System, fit: Any) -> np.ndarray | str:
    """The trajectory of the example, (n_samples, n_states), or why there is none."""
    if isinstance(fit, ph.PhsiOptError):
        return "every term was pruned"
    example = EXAMPLES.get(system.name, TANK_EXAMPLE)
    t = np.linspace(0.0, example.end, N_SAMPLES)
    x = simulated(fit, t, example.start)
    return "diverges" if x is None else np.asarray(x)


def _truth(system: System) -> grid_page.Truth:
    example = EXAMPLES.get(system.name, TANK_EXAMPLE)
    t = np.linspace(0.0, example.end, N_SAMPLES)
    return grid_page.Truth(example, t, system.solve(np.array(example.start), t))


if __name__ == "__main__":
    main(flag("quick"), chosen() or None)

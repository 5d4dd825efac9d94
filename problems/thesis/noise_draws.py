"""Noisy data, many draws: solver, maximum likelihood and gradient descent on identical
data; medians over the draws.

    python -m problems.thesis.noise_draws [--quick] [--page] [system ...]

A row per draw is kept in results/thesis; --page writes the page anew from these rows.
"""

import os

# Before NumPy is loaded: equal terms for all.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.sweeps.sweep import sweep
from problems.thesis.methods import descent, likelihood, solver, solver_threshold
from problems.thesis.scores import attempted, coverage, free_run, score, trained
from problems.thesis.systems import SYSTEMS, System
from problems.tools import provenance
from problems.tools.command_line import chosen, flag, option
from problems.tools.kept_tables import rewrite
from problems.tools.pages import render
from problems.tools.workers import workers

N_DRAWS = 10
FIRST_DRAW = 200  # draws that nothing was tuned on
N_TESTS = 10  # unseen starts per draw
QUICK_N = {"henon_heiles": 1000}  # trajectories of a quick run; others: 20
COMPARED = {
    "relative": "relative error",
    "inside": "free run inside",
    "whole": "whole free run",
}


def draw(system: System, seed: int, n: int | None = None) -> list[dict[str, Any]]:
    """A row per method on one draw; beside the thesis' threshold, descent gets no
    second chance.
    """
    data = system.data(seed, n=n)
    t, tests = system.tests(N_TESTS, seed=10_000 + seed)
    fitted = solver(system, data, seed=seed)
    methods: dict[str, Callable[[], Any]] = {
        "solver": lambda: fitted,
        "solver, plain threshold": lambda: solver_threshold(system, data, seed=seed),
        "solver, then likelihood": lambda: likelihood(system, data, fitted),
        "descent": lambda: descent(system, data, "noisy", seed),
    }
    rows = []
    for name, run in methods.items():
        found = _row(system, attempted(run), t, tests)
        print(f"... {system.name}, draw {seed}, {name}: {found}", flush=True)
        rows.append({"draw": seed, "method": name, **found})
    return rows


def _row(
    system: System, result: Any, t: np.ndarray, tests: np.ndarray
) -> dict[str, Any]:
    if isinstance(result, ph.PhsiOptError):
        return dict.fromkeys(COMPARED, np.inf)
    found = score(system, result)
    curve = free_run(result, t, tests)
    errors = result.std_errors
    known = [name for name in system.truth if np.isfinite(errors.get(name, np.nan))]
    return {
        "relative": found.relative,
        **found.counts,
        "inside": curve[trained(system, t)].mean(),
        "whole": curve.mean(),
        "covered": coverage(system, result, known),
        "seconds": result.seconds,
    }


def main(
    quick: bool = False, names: list[str] | None = None
) -> dict[str, pd.DataFrame]:
    """A table per system; one draw at a time unless ``--jobs`` says otherwise."""
    tables = {}
    for name in names or SYSTEMS:
        seeds = range(FIRST_DRAW, FIRST_DRAW + (1 if quick else N_DRAWS))
        tasks = {f"{name}, draw {seed}": (name, seed, quick) for seed in seeds}
        with workers(1 if quick else int(option("jobs", "1"))) as executor:
            found = {d.key: d.result for d in sweep(_drawn, tasks, executor=executor)}
        tables[name] = pd.DataFrame([row for key in tasks for row in found[key]])
        if not quick:
            rewrite(_path(name), tables[name], "%.6g")
    if not quick:
        write_page()
    return tables


def _drawn(task: tuple[str, int, bool]) -> list[dict[str, Any]]:
    name, seed, quick = task
    if quick:
        return draw(SYSTEMS[name].shortened(2), seed, QUICK_N.get(name, 20))
    return draw(SYSTEMS[name], seed)


def _path(name: str) -> Path:
    return provenance.RESULTS / "thesis" / f"noise_draws_{name}.csv"


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Medians over the draws per method; shares of draws with exact support."""
    exact = (table["spurious"] == 0) & (table["missed"] == 0)
    by = table.assign(exact=exact).groupby("method", sort=False)
    return (
        by[list(COMPARED)]
        .median()
        .assign(
            exact=by["exact"].mean(),
            spurious=by["spurious"].mean(),
            covered=by["covered"].mean(),
            seconds=by["seconds"].median(),
        )
    )


def write_page() -> None:
    """Write the page from the tables of all systems that have been run."""
    tables = {n: pd.read_csv(_path(n)) for n in SYSTEMS if _path(n).exists()}
    provenance.write("thesis/noise_draws.md", page(tables))


def page(tables: Mapping[str, pd.DataFrame]) -> str:
    """The page as Markdown."""
    found = [
        (SYSTEMS[name], table["draw"].nunique(), summary(table))
        for name, table in tables.items()
    ]
    values = {"found": found, "compared": COMPARED, "n_tests": N_TESTS}
    return render("thesis/pages/noise_draws.md", **values)


if __name__ == "__main__":
    if flag("page"):
        write_page()
    else:
        main(flag("quick"), chosen() or None)

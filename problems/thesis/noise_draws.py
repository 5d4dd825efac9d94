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
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.sweeps.sweep import sweep
from problems.thesis.methods import descent, likelihood, solver, solver_threshold
from problems.thesis.scores import coverage, distilled, free_run, score, trained
from problems.thesis.systems import SYSTEMS, System
from problems.tools import markdown, provenance
from problems.tools.command_line import chosen, flag, option
from problems.tools.kept_tables import rewrite
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
FAILED = {
    "relative": np.inf,
    "spurious": np.nan,
    "missed": np.nan,
    "inside": np.inf,
    "whole": np.inf,
    "covered": np.nan,
    "seconds": np.nan,
}

Task = tuple[str, int, bool]  # system, draw, whether quick


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
        key = {"draw": seed, "method": name}
        label = f"... {system.name}, draw {seed}, {name}"
        try:
            row = _row(system, run(), t, tests)
        except ph.PhsiOptError as error:
            print(f"{label}: {error}", flush=True)
            rows.append(key | FAILED)
            continue
        rows.append(key | row)
        print(f"{label}: {row['relative']:.3g} {row['whole']:.3g}", flush=True)
    return rows


def _row(
    system: System, result: Any, t: np.ndarray, tests: np.ndarray
) -> dict[str, Any]:
    s = score(system, result)
    curve = free_run(result, t, tests)
    known = [name for name in system.truth if name in result.std_errors]
    finite = [name for name in known if np.isfinite(result.std_errors[name])]
    return {
        "relative": s.relative,
        "spurious": len(s.spurious) - len(distilled(s.spurious)),
        "missed": len(s.missed),
        "inside": curve[trained(system, t)].mean(),
        "whole": curve.mean(),
        "covered": coverage(system, result, finite),
        "seconds": result.seconds,
    }


def main(
    quick: bool = False, names: list[str] | None = None
) -> dict[str, pd.DataFrame]:
    """A table per system."""
    tables = {}
    for name in names or SYSTEMS:
        tables[name] = study(name, quick)
        if not quick:
            rewrite(_path(name), tables[name], "%.6g")
    if not quick:
        write_page()
    return tables


def study(name: str, quick: bool) -> pd.DataFrame:
    """All draws of one system; one at a time unless ``--jobs`` says otherwise."""
    tasks = {}
    for k in range(1 if quick else N_DRAWS):
        tasks[f"{name}, draw {FIRST_DRAW + k}"] = (name, FIRST_DRAW + k, quick)
    found = {}
    with workers(1 if quick else int(option("jobs", "1"))) as executor:
        for done in sweep(_drawn, tasks, executor=executor):
            found[done.key] = done.result
    rows = []
    for key in tasks:
        rows += found[key]
    return pd.DataFrame(rows)


def _drawn(task: Task) -> list[dict[str, Any]]:
    name, seed, quick = task
    system = SYSTEMS[name]
    if not quick:
        return draw(system, seed)
    short = replace(system.descent_noisy, epochs=2)
    system = replace(system, descent_noisy=short)
    return draw(system, seed, QUICK_N.get(name, 20))


def _path(name: str) -> Path:
    return provenance.RESULTS / "thesis" / f"noise_draws_{name}.csv"


# --- the page


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Medians over the draws per method; shares of draws with exact support."""
    exact = (table["spurious"] == 0) & (table["missed"] == 0)
    by = table.assign(exact=exact).groupby("method", sort=False)
    medians = by[list(COMPARED)].median()
    return medians.assign(
        exact=by["exact"].mean(),
        spurious=by["spurious"].mean(),
        covered=by["covered"].mean(),
        seconds=by["seconds"].median(),
    )


def write_page() -> None:
    """Write the page from the tables of all systems that have been run."""
    tables = {n: pd.read_csv(_path(n)) for n in SYSTEMS if _path(n).exists()}
    provenance.write("thesis/noise_draws.md", page(tables))


def page(tables: Mapping[str, pd.DataFrame]) -> str:
    """The page as Markdown."""
    lines = ["# Noisy data, many draws", "", INTRODUCTION, ""]
    for name, table in tables.items():
        system = SYSTEMS[name]
        found = summary(table)
        n_draws = table["draw"].nunique()
        lines += [f"## {system.title}: noise {system.noise:g}, {n_draws} draws", ""]
        lines += markdown.block(found.map("{:.3g}".format).to_string())
        lines += [_reading(found), ""]
    return "\n".join(lines)


INTRODUCTION = markdown.paragraph(f"""
    Medians over the draws. relative: largest relative error of any true coefficient;
    inside and whole: l2 of free runs within the training time and over the test time,
    {N_TESTS} unseen starts a draw; exact: share of draws with exact support; spurious:
    mean number of spurious terms; covered: share of the 95 % intervals of true
    coefficients that hold the truth (selection not accounted for).
    """)


def _reading(found: pd.DataFrame) -> str:
    ours = found.loc["solver"]
    theirs = found.loc["descent"]
    verdicts = []
    for name, what in COMPARED.items():
        verdict = "not worse" if ours[name] <= theirs[name] else "WORSE"
        verdicts.append(
            f"{what} {ours[name]:.3g} against {theirs[name]:.3g} ({verdict})"
        )
    return f"Solver against gradient descent: {', '.join(verdicts)}."


if __name__ == "__main__":
    if flag("page"):
        write_page()
    else:
        main(flag("quick"), chosen() or None)

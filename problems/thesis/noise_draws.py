"""Noisy data, many draws: solver, maximum likelihood and gradient descent on identical
data; medians over the draws.

python -m problems.thesis.noise_draws [--quick] [system ...]     (a row per draw is kept
in results/thesis)
"""

import os

os.environ.setdefault(
    "OMP_NUM_THREADS", "1"
)  # before NumPy is loaded: equal terms for all
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis.methods import descent, likelihood, solver, solver_threshold
from problems.thesis.scores import free_run, score
from problems.thesis.systems import SYSTEMS, System
from problems.tools.command_line import chosen, flag
from problems.tools.provenance import RESULTS, write

N_DRAWS = 10
FIRST_DRAW = 200  # draws that nothing was tuned on
COLUMNS = [
    "draw",
    "method",
    "relative",
    "spurious",
    "missed",
    "inside",
    "whole",
    "covered",
    "seconds",
]


def draw(system: System, seed: int, n: int | None = None) -> list[tuple[Any, ...]]:
    """A row per method on one draw; beside the thesis' threshold, descent gets no
    second chance.
    """
    data = system.data(seed, n=n)
    t, tests = system.tests(10, seed=10_000 + seed)
    fitted = solver(system, data, seed=seed)
    methods: dict[str, Callable[[], Any]] = {
        "solver": lambda: fitted,
        "solver, plain threshold": lambda: solver_threshold(system, data, seed=seed),
        "solver, then likelihood": lambda: likelihood(system, data, fitted),
        "descent": lambda: descent(system, data, "noisy", seed),
    }
    rows = []
    for name, run in methods.items():
        try:
            result = run()
        except ph.PhsiOptError as error:
            print(f"... {system.name}, draw {seed}, {name}: {error}", flush=True)
            rows.append(
                (seed, name, np.inf, np.nan, np.nan, np.inf, np.inf, np.nan, np.nan)
            )
            continue
        s = score(system, result)
        curve, trained = (
            free_run(result, t, tests),
            t <= system.n_steps * system.step + 1e-9,
        )
        spurious = [
            term for term in s.spurious if not term.startswith("F_mu4")
        ]  # the distilled network
        errors = {k: result.std_errors.get(k, np.nan) for k in system.truth}
        z = [
            abs(result.values[k] - v) / errors[k]
            for k, v in system.truth.items()
            if np.isfinite(errors[k])
        ]
        covered = float(np.mean(np.array(z) < 1.96)) if z else np.nan
        rows.append(
            (
                seed,
                name,
                s.relative,
                len(spurious),
                len(s.missed),
                curve[trained].mean(),
                curve.mean(),
                covered,
                result.seconds,
            )
        )
        print(
            f"... {system.name}, draw {seed}, {name}: {s.relative:.3g} {curve.mean():.3g}",
            flush=True,
        )
    return rows


def main(
    quick: bool = False, names: list[str] | None = None
) -> dict[str, pd.DataFrame]:
    """A table per system."""
    tables = {}
    for name in names or list(SYSTEMS):
        system, n = SYSTEMS[name], None
        if quick:
            fast, n = (
                replace(system.descent_noisy, epochs=2),
                1000 if name == "henon_heiles" else 20,
            )
            system = replace(system, descent_noisy=fast)
        rows = [
            row
            for k in range(1 if quick else N_DRAWS)
            for row in draw(system, FIRST_DRAW + k, n)
        ]
        tables[name] = pd.DataFrame(rows, columns=COLUMNS)
        if not quick:
            tables[name].to_csv(
                RESULTS / "thesis" / f"noise_draws_{name}.csv",
                index=False,
                float_format="%.6g",
            )
    if not quick:
        collect()
    return tables


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Medians over the draws per method; shares of draws with exact support."""
    by = table.assign(exact=(table["spurious"] == 0) & (table["missed"] == 0)).groupby(
        "method", sort=False
    )
    columns = ["relative", "inside", "whole"]
    medians = by[columns].median()
    return medians.assign(
        exact=by["exact"].mean(),
        spurious=by["spurious"].mean(),
        covered=by["covered"].mean(),
        seconds=by["seconds"].median(),
    )


def collect() -> None:
    """Write the page from the tables of all systems that have been run."""
    lines = ["# Noisy data, ten draws", ""]
    lines += [
        "Medians over the draws. relative: largest relative error of any true coefficient; inside and whole: l2 of",
        "free runs within the training time and over the test time, ten unseen starts a draw; exact: share of draws",
        "with exact support; spurious: mean number of spurious terms; covered: share of the 95 % intervals of true",
        "coefficients that hold the truth (selection not accounted for).",
        "",
    ]
    for name, system in SYSTEMS.items():
        path = RESULTS / "thesis" / f"noise_draws_{name}.csv"
        if path.exists():
            table = pd.read_csv(path)
            shown = summary(table).map(lambda v: f"{v:.3g}").to_string()
            lines += [
                f"## {system.title}: noise {system.noise:g}, {table['draw'].nunique()} draws",
                "",
            ]
            lines += ["```text", shown, "```", "", _reading(summary(table)), ""]
    write("thesis/noise_draws.md", "\n".join(lines))


def _reading(s: pd.DataFrame) -> str:
    ours, theirs = s.loc["solver"], s.loc["descent"]
    verdicts = [
        f"{what} {ours[key]:.3g} against {theirs[key]:.3g} ({'not worse' if ours[key] <= theirs[key] else 'WORSE'})"
        for key, what in (
            ("relative", "relative error"),
            ("inside", "free run inside"),
            ("whole", "whole free run"),
        )
    ]
    return "Solver against gradient descent: " + ", ".join(verdicts) + "."


if __name__ == "__main__":
    if flag("page"):
        collect()
    else:
        main(flag("quick"), chosen() or None)

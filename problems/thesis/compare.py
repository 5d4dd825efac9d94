"""Solver against gradient descent, side by side: the same model, the same data, the
same measures.

Each system, clean and noisy (the data of the thesis where they are present); all runs
of a system in one process, one after the other, with one thread. Both are started three
times: gradient descent from the thesis' starting values and twice at random; the solver
from its convex program and twice at random values (tanks: seeds of the network).

    python -m problems.thesis.compare [--quick] [--page] [system ...]

--page writes the page alone, from the tables that are kept in results/thesis.
"""

import os

# Before NumPy is loaded: equal terms for both.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis.compare_page import page
from problems.thesis.methods import SIGNIFICANCE, by_solver, descent, likelihood
from problems.thesis.scores import distilled, inside_and_beyond, phsi_loss, score
from problems.thesis.systems import SYSTEMS, System
from problems.tools import provenance
from problems.tools.command_line import chosen, flag

N_STARTS = 3
QUICK_N = {"henon_heiles": 400}  # trajectories of a quick run; others: 8
# Without any weight on H the sum of the levels of the tanks is not determined.
LEAST = {"tanks": {"H": 1e-6}}


@dataclass(frozen=True)
class Task:
    """One system with one set of data, ``kind`` "clean" or "noisy"."""

    system: System
    data: ph.Measurements
    kind: str


@dataclass(frozen=True)
class Run:
    """A result by one method from one start."""

    method: str
    start: str
    result: Any


def runs(task: Task) -> list[Run]:
    """Every method on one set of data."""
    system = task.system
    by_start = _solver_runs(task)
    weights = LEAST.get(system.name, {})
    all_terms = by_solver(system, task.data, None, l1=weights)
    found = [*by_start, Run("solver, all terms", "convex", all_terms)]
    if task.kind == "noisy":  # without noise there is nothing to weigh
        refined = likelihood(system, task.data, by_start[0].result)
        found.append(Run("solver, then likelihood", "from the first", refined))
    return [*found, *_descent_runs(task)]


def _solver_runs(task: Task) -> list[Run]:
    """The solver from its own and random starts; tanks: seeds of the network."""
    system = task.system
    data = task.data
    pruning = ph.Pruning(system.threshold, significance=SIGNIFICANCE)
    if system.name == "tanks":
        return [
            Run("solver", f"seed {k}", by_solver(system, data, pruning, seed=k))
            for k in range(N_STARTS)
        ]
    own = by_solver(system, data, pruning)
    found = [Run("solver", "convex", own)]
    for k in range(1, N_STARTS):
        fit = from_random(task, own, pruning, seed=k)
        found.append(Run("solver", f"random {k}", fit))
    return found


def _descent_runs(task: Task) -> list[Run]:
    """Gradient descent from the thesis' starting values and from random ones."""
    found = []
    for k in range(N_STARTS):
        start = "normal" if k else "thesis"
        result = descent(task.system, task.data, task.kind, k, start)
        found.append(Run("descent", f"random {k}" if k else "thesis", result))
    return found


def from_random(task: Task, own: ph.Fit, pruning: ph.Pruning, seed: int) -> ph.Fit:
    """The solver without its starting values: coefficients from N(0, 0.5^2).

    Damping and frequency are made positive. ``own``: a fit from its own start.
    """
    system = task.system
    model = system.model()
    rng = np.random.default_rng(seed)
    drawn = 0.5 * rng.normal(size=len(model.free))
    values = {}
    for name, value in zip(model.free, drawn, strict=True):
        values[name] = abs(value) if _is_positive(name) else value
    return ph.identify(
        model,
        task.data,
        ph.PHSILoss(),
        dict(system.l1),
        pruning,
        start=replace(own, model=model.with_values(values)),
        raise_on_failure=False,
    )


def _is_positive(name: str) -> bool:
    """A damping or a frequency."""
    return name.startswith("R") or "omega_t" in name.split("[")[0]


def row(task: Task, run: Run) -> dict[str, Any]:
    """One row of the table."""
    system = task.system
    result = run.result
    s = score(system, result)
    # Hinges that stand for the network of the tanks are no coefficients.
    hinges = distilled(s.spurious)
    largest = s.largest
    if hinges:
        largest = max(
            abs(result.values.get(name, 0.0) - true)
            for name, true in system.truth.items()
        )
    inside, whole = inside_and_beyond(system, result)
    return {
        "system": system.title,
        "data": task.kind,
        "method": run.method,
        "start": run.start,
        "largest error": largest,
        "relative error": s.relative,
        "spurious": len(s.spurious) - len(hinges),
        "missed": len(s.missed),
        "PHSI loss": phsi_loss(result, task.data),
        "l2 inside": inside,
        "l2 whole": whole,
        "seconds": result.seconds,
    }


def main(quick: bool = False, names: list[str] | None = None) -> pd.DataFrame:
    """The table of all runs.

    Each system's is kept in results/thesis, and the page is made of those that are
    there.
    """
    tables = [measured(SYSTEMS[name], quick) for name in names or SYSTEMS]
    if not quick:
        write_page()
    return pd.concat(tables, ignore_index=True)


def write_page() -> None:
    """Write the page anew from the tables that are kept."""
    kept = [pd.read_csv(_path(name)) for name in SYSTEMS if _path(name).exists()]
    provenance.write("solver_vs_gradient_descent.md", page(pd.concat(kept)))


def _path(name: str) -> Path:
    return provenance.RESULTS / "thesis" / f"compare_{name}.csv"


def measured(system: System, quick: bool) -> pd.DataFrame:
    """All runs on one system."""
    rows = []
    for kind in ("clean", "noisy"):
        task = _task(system, kind, quick)
        for run in runs(task):
            rows.append(row(task, run))
            shown = [
                f"{value:.3g}" if isinstance(value, float) else str(value)
                for value in rows[-1].values()
            ]
            print("... " + ", ".join(shown), flush=True)
    table = pd.DataFrame(rows)
    if not quick:
        table.to_csv(_path(system.name), index=False, float_format="%.6g")
    return table


def _task(system: System, kind: str, quick: bool) -> Task:
    if not quick:
        return Task(system, system.training_data(kind), kind)
    noise = 0.0 if kind == "clean" else None
    data = system.data(1, noise, n=QUICK_N.get(system.name, 8))
    return Task(system.with_epochs(2), data, kind)


if __name__ == "__main__":
    if flag("page"):
        write_page()
    else:
        main(flag("quick"), chosen() or None)

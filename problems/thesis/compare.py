"""Solver against gradient descent, side by side: the same model, the same data, the
same measures, both rules of pruning on both.

Each system, clean and noisy (the data of the thesis where they are present); all runs
of a system in one process, one after the other, with one thread; two systems at a time
(--jobs=N: so many). Both are started three
times: gradient descent from the thesis' starting values and twice at random; the solver
from its convex program and twice at random values (tanks: seeds of the network). The
thesis' own settings of the descent, and its other descents (BSI, and PHNN on the
mass-spring), are run once each, and a tuned one beside them.

    python -m problems.thesis.compare [--quick] [--page] [system ...]

--page writes the page alone, from the tables that are kept in results/thesis.
"""

import os

# Before NumPy is loaded: equal terms for both.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis import methods
from problems.thesis.compare_page import ALL_TERMS, BOTH, NO_RULE, SIZE, page
from problems.thesis.methods import SIGNIFICANCE, THESIS, TUNED, by_solver, likelihood
from problems.thesis.scores import distilled, inside_and_beyond, phsi_loss, score
from problems.thesis.systems import SYSTEMS, System
from problems.tools import provenance
from problems.tools.command_line import chosen, flag
from problems.tools.kept_tables import rewrite
from problems.tools.workers import workers

N_STARTS = 3
QUICK_STARTS = {"tanks": 1}  # others: 2; a hybrid takes seconds on any data
QUICK_N = {"henon_heiles": 400}  # trajectories of a quick run; others: 8
QUICK_EPOCHS = 2
# Without any weight on H the sum of the levels of the tanks is not determined.
LEAST = {"tanks": {"H": 1e-6}}
LONGEST_FIRST = ("tanks", "mass_spring", "henon_heiles", "schrodinger")
RULES = {SIZE: None, BOTH: SIGNIFICANCE}
NO_SETTINGS = "-"  # the solver has none


@dataclass(frozen=True)
class Task:
    """One system with one set of data, ``kind`` "clean" or "noisy".

    ``n_starts``: of each method; ``quick``: networks too are trained for a few epochs.
    """

    system: System
    data: ph.Measurements
    kind: str
    n_starts: int = N_STARTS
    quick: bool = False


@dataclass(frozen=True)
class Run:
    """A result by one method from one start, with the processor time it took."""

    method: str
    rule: str
    settings: str
    start: str
    result: Any
    seconds: float


def timed(
    method: str, rule: str, settings: str, start: str, made: Callable[[], Any]
) -> Run:
    """The run of a call, in processor seconds: other processes do not count."""
    began = time.process_time()
    result = made()
    seconds = time.process_time() - began
    return Run(method, rule, settings, start, result, seconds)


def runs(task: Task) -> Iterator[Run]:
    """Every method on one set of data."""
    system = task.system
    data = task.data
    for rule in RULES:
        yield from _solver_runs(task, rule)
    weights = LEAST.get(system.name, {})
    yield timed(
        ALL_TERMS,
        NO_RULE,
        NO_SETTINGS,
        "convex",
        lambda: by_solver(system, data, None, l1=weights),
    )
    for rule in RULES:
        yield from _descent_runs(task, rule)
    yield from _other_descents(task)


def _solver_runs(task: Task, rule: str) -> Iterator[Run]:
    """The solver from its own and random starts; tanks: seeds of the network.

    Without noise there is nothing for the likelihood to weigh.
    """
    first = _solved(task, rule, None, 0)
    yield first
    if task.kind == "noisy":
        yield timed(
            "solver, then likelihood",
            rule,
            NO_SETTINGS,
            "from the first",
            lambda: likelihood(task.system, task.data, first.result),
        )
    for k in range(1, task.n_starts):
        yield _solved(task, rule, first.result, k)


def _solved(task: Task, rule: str, own: Any, k: int) -> Run:
    """The solver from its k-th start; ``own`` is the result of the first."""
    system = task.system
    pruning = ph.Pruning(system.threshold, significance=RULES[rule])
    start = f"random {k}" if k else "convex"
    if system.name == "tanks":
        start = f"seed {k}"

    def made() -> Any:
        if k == 0 or system.name == "tanks":
            return by_solver(system, task.data, pruning, seed=k)
        return from_random(task, own, pruning, seed=k)

    return timed("solver", rule, NO_SETTINGS, start, made)


def _descent_runs(task: Task, rule: str) -> Iterator[Run]:
    """Gradient descent: tuned from every start, the thesis' settings from its own."""
    yield _descended(task, rule, THESIS, 0)
    for k in range(task.n_starts):
        yield _descended(task, rule, TUNED, k)


def _descended(task: Task, rule: str, settings: str, k: int) -> Run:
    def made() -> Any:
        start = "normal" if k else "thesis"
        return methods.descent(
            task.system, task.data, task.kind, k, start, settings, RULES[rule]
        )

    return timed("descent", rule, settings, f"random {k}" if k else "thesis", made)


def _other_descents(task: Task) -> Iterator[Run]:
    """BSI by descent, and the PHNN where the thesis has one."""
    system = task.system
    for settings in (THESIS, TUNED):
        yield _by(methods.bsi_descent, "BSI, descent", task, SIZE, settings)
    if system.name != "mass_spring":
        return
    epochs = QUICK_EPOCHS if task.quick else None
    for settings in (THESIS, TUNED):
        yield _by(methods.phnn, "PHNN", task, NO_RULE, settings, epochs=epochs)


def _by(
    method: Callable[..., Any],
    label: str,
    task: Task,
    rule: str,
    settings: str,
    **options: Any,
) -> Run:
    def made() -> Any:
        return method(
            task.system, task.data, task.kind, 0, settings=settings, **options
        )

    return timed(label, rule, settings, "thesis", made)


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
    """One row of the table of every run."""
    inside, whole = inside_and_beyond(task.system, run.result)
    return {
        "system": task.system.title,
        "data": task.kind,
        "method": run.method,
        "rule": run.rule,
        "settings": run.settings,
        "start": run.start,
        "intervals": sum(len(one.t) - 1 for one in task.data.trajectories),
        **_of_coefficients(task, run),
        "l2 inside": inside,
        "l2 whole": whole,
        "seconds": run.seconds,
    }


def _of_coefficients(task: Task, run: Run) -> dict[str, Any]:
    """Errors of the coefficients and the loss; a PHNN has no coefficients."""
    system = task.system
    result = run.result
    if run.method == "PHNN":
        names = ("largest error", "relative error", "spurious", "missed")
        return {**dict.fromkeys(names, np.nan), "PHSI loss": result.loss_value}
    s = score(system, result)
    # Hinges that stand for the network of the tanks are no coefficients.
    hinges = [] if isinstance(result.model, ph.FirstOrder) else distilled(s.spurious)
    largest = s.largest
    if hinges:
        largest = max(
            abs(result.values.get(name, 0.0) - true)
            for name, true in system.truth.items()
        )
    return {
        "largest error": largest,
        "relative error": s.relative,
        "spurious": len(s.spurious) - len(hinges),
        "missed": len(s.missed),
        "PHSI loss": phsi_loss(result, task.data),
    }


def main(quick: bool = False, names: list[str] | None = None) -> pd.DataFrame:
    """The table of all runs.

    Each system's is kept in results/thesis, and the page is made of those that are
    there.
    """
    wanted = names or list(SYSTEMS)
    asked = {}
    with workers(1 if quick else None) as executor:
        for name in sorted(wanted, key=_position):
            asked[name] = executor.submit(measured, name, quick)
        tables = [asked[name].result() for name in wanted]
    table = pd.concat(tables, ignore_index=True)
    if quick:
        print(page(table, quick=True))
    else:
        write_page()
    return table


def write_page() -> None:
    """Write the page anew from the tables that are kept."""
    provenance.write("solver_vs_gradient_descent.md", page(kept_table()))


def kept_table() -> pd.DataFrame:
    """The tables that are kept."""
    kept = [pd.read_csv(_path(name)) for name in SYSTEMS if _path(name).exists()]
    return pd.concat(kept, ignore_index=True)


def _path(name: str) -> Path:
    return provenance.RESULTS / "thesis" / f"compare_{name}.csv"


def _position(name: str) -> int:
    """Where a system stands among those that begin, the longest first."""
    return LONGEST_FIRST.index(name)


def measured(name: str, quick: bool) -> pd.DataFrame:
    """All runs on one system."""
    system = SYSTEMS[name]
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
        rewrite(_path(system.name), table, "%.6g")
    return table


def _task(system: System, kind: str, quick: bool) -> Task:
    if not quick:
        return Task(system, system.training_data(kind), kind)
    noise = 0.0 if kind == "clean" else None
    data = system.data(1, noise, n=QUICK_N.get(system.name, 8))
    short = system.with_epochs(QUICK_EPOCHS)
    n_starts = QUICK_STARTS.get(system.name, 2)
    return Task(short, data, kind, n_starts, quick=True)


if __name__ == "__main__":
    if flag("page"):
        write_page()
    else:
        main(flag("quick"), chosen() or None)

"""The four experiments of thesis Chapter 6 with every method beside the solver: Tables
6.1-6.4 and Figures 6.1-6.8.

Every method gets the same data: those of the thesis where they are present, else newly
drawn ones. A page per system, results/thesis/<system>.md, and its figures beside it.

    python -m problems.thesis.experiments [--quick] [system ...]
"""

import os

# Before NumPy is loaded: equal terms for all.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import pandas as pd

import phsi_opt as ph
from problems.thesis import figures, methods
from problems.thesis.experiment_pages import page
from problems.thesis.experiment_tables import (
    DESCENT,
    LIKELIHOOD,
    N_TESTS,
    SOLVER,
    Results,
    Scores,
    coefficients,
    scores,
    steps,
    tank_table,
    tried,
)
from problems.thesis.systems import SYSTEMS, System
from problems.tools.command_line import chosen, flag
from problems.tools.provenance import write

THRESHOLD = "PHSI, threshold alone"
KINDS = ("clean", "noisy")
# The program was stopped after seven minutes.
UNENDED = (
    "not run: on exact data the program of this size did not end within seven minutes"
)
# Of the larger systems in a quick run; Henon-Heiles has all methods.
QUICK = ("SINDy, STLSQ", "SINDy, SR3")
QUICK_N = {"henon_heiles": 150}  # trajectories of a quick run; others: 8
# Data of the coefficient tables; of the other systems: noisy.
TABLE_DATA = {"mass_spring": KINDS}


@dataclass(frozen=True, eq=False)
class Study:
    """Everything of one system; results, scores and data by kind."""

    system: System
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)
    data: dict[str, ph.Measurements] = field(default_factory=dict)
    results: dict[str, Results] = field(default_factory=dict)
    scores: dict[str, Scores] = field(default_factory=dict)


def training_data(system: System, kind: str, quick: bool) -> ph.Measurements:
    """Data of the thesis, or newly drawn; few of them in quick mode."""
    if not quick:
        return system.training_data(kind)
    noise = 0.0 if kind == "clean" else None
    return system.data(1, noise, n=QUICK_N.get(system.name, 8))


def methods_of(system: System, kind: str, quick: bool) -> dict[str, methods.Method]:
    """The methods of one system in the order of the table; the likelihood, which starts
    from the solver, is apart.
    """
    found: dict[str, methods.Method] = {SOLVER: methods.solver}
    if kind == "noisy":
        found[THRESHOLD] = methods.solver_threshold
    found |= {
        DESCENT: methods.descent,
        "BSI, solver": methods.bsi_solver,
        "PHSI, descent, thesis": partial(methods.descent, settings=methods.THESIS),
        "BSI, descent": methods.bsi_descent,
        "BSI, descent, thesis": partial(methods.bsi_descent, settings=methods.THESIS),
        "SINDy, STLSQ": methods.stlsq,
        "SINDy, SR3": methods.sr3,
        "LASSO": methods.lasso,
    }
    if system.name == "henon_heiles":
        found["SSINN"] = methods.ssinn
    epochs = 2 if quick else None
    found["PHNN"] = partial(methods.phnn, epochs=epochs)
    found["PHNN, tuned"] = partial(methods.phnn, settings=methods.TUNED, epochs=epochs)
    if quick and system.name != "henon_heiles":
        return {label: found[label] for label in QUICK}
    return found


def identified(
    system: System, data: ph.Measurements, kind: str, quick: bool
) -> dict[str, Any]:
    """Result of every method, or the error it raised."""
    if quick:
        system = system.with_epochs(2)
    results: dict[str, Any] = {}
    for label, method in methods_of(system, kind, quick).items():
        results[label] = tried(partial(method, system, data, kind, 0))
        if label == SOLVER:
            results[LIKELIHOOD] = likelihood(system, data, kind, results[SOLVER])
        print(f"... {system.name}, {kind}, {label}", flush=True)
    return results


def likelihood(system: System, data: ph.Measurements, kind: str, start: Any) -> Any:
    """Maximum likelihood from the solver's result, or why there is none."""
    if isinstance(start, ph.PhsiOptError):
        return start
    if system.name == "tanks" and kind == "clean":
        return ph.SolveError(UNENDED)
    return tried(lambda: methods.likelihood(system, data, start))


def study(system: System, quick: bool) -> Study:
    """Run all methods on one system, clean and noisy, and make its tables."""
    name = system.name
    found = Study(system)
    tables = found.tables
    t, truth = system.tests(2 if quick else N_TESTS)
    for kind in KINDS:
        data = training_data(system, kind, quick)
        results = identified(system, data, kind, quick)
        found.data[kind] = data
        found.results[kind] = results
        found.scores[kind] = scores(system, kind, results, t, truth)
        if kind in TABLE_DATA.get(name, ("noisy",)):
            tables[f"{name}, coefficients, {kind}"] = coefficients(system, results)
            if name == "mass_spring":
                tables[f"{name}, first order, {kind}"] = coefficients(
                    system, results, first_order=True
                )
    by_kind = [found.scores[kind].table for kind in KINDS]
    tables[f"{name}, scores"] = pd.concat(by_kind, ignore_index=True)
    if not quick:
        tables[f"{name}, steps"] = steps(system)
        if name == "tanks":
            tables["tanks, checks"] = tank_table(
                system, found.data["noisy"], found.results["noisy"]
            )
    return found


def main(
    quick: bool = False, names: list[str] | None = None
) -> dict[str, pd.DataFrame]:
    """The tables of all systems by name; pages and figures are written under
    results/thesis unless ``quick``.
    """
    tables: dict[str, pd.DataFrame] = {}
    for name in names or SYSTEMS:
        system = SYSTEMS[name]
        found = study(system, quick)
        tables |= found.tables
        if quick:
            shown = found.tables[f"{name}, scores"].drop(columns="reason")
            print(shown.to_string(index=False))
        else:
            curves = {kind: found.scores[kind].curves for kind in KINDS}
            noisy = found.data["noisy"]
            drawn = figures.draw(system, noisy, found.results, curves)
            write(f"thesis/{name}.md", page(system, found.tables, drawn))
    return tables


if __name__ == "__main__":
    main(flag("quick"), chosen() or None)

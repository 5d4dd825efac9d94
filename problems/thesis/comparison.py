"""The systems of thesis Chapter 6 with every method beside the solver, and the solver
beside gradient descent: Tables 6.1 to 6.3, Figures 6.1 to 6.8.

Every method gets the same data: those of the thesis where they are present, else newly
drawn ones.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis import figures, methods
from problems.thesis.methods import SIGNIFICANCE, THESIS, TUNED, Method
from problems.thesis.runs import Done, Setting, done, medians, shown, table
from problems.thesis.scores import common_name, is_coefficient, is_frequency
from problems.thesis.systems import (
    FLOWS,
    LEVELS,
    SYSTEMS,
    System,
    coefficients,
    thesis_data_present,
)
from problems.tools.pages import render

SOLVER, LIKELIHOOD, DESCENT = "PHSI, solver", "PHSI, likelihood", "PHSI, descent"
KINDS = ("clean", "noisy")
N_TESTS = 20  # unseen starts of free runs
MOST_EXTRA = 12  # coefficients too many that a method adds to the table
TANK_NOISE = 0.03  # of thesis Section 6.4; its code and its Figure 6.8 have 0.005
QUICK_N = {"henon_heiles": 150}  # trajectories of a quick run; others: 8
# Lines of the figures.
DRAWN = (SOLVER, DESCENT, "BSI, solver", "SINDy, STLSQ")

# What the thesis prints: Table 6.1 (noisy), 6.2 (clean), 6.3 (noise 0.03).
TANK_ENERGIES = (24.94, 24.98, 24.98, 24.95, 24.97, 4.93, 4.96, 4.89, 4.93)
TANK_DAMPING = (0.031, 0.029, 0.086, 0.051, 0.041)
PRINTED: dict[tuple[str, str], dict[str, dict[str, float]]] = {
    ("henon_heiles", "noisy"): {
        "PHSI": coefficients(
            "H",
            "q1**2 0.509, q2**2 0.495, q1**2*q2 1.009, q2**3 -0.338, p1**2 0.501, "
            "p2**2 0.477, q2*p1**2 0.124",
        ),
        "SSINN": coefficients(
            "H",
            "q1**2 0.421, q2**2 0.378, q1**2*q2 0.569, q2**3 -0.195, p1**2 0.484, "
            "p2**2 0.443, q2 0.004, q1*q2 0.002, p2 -0.006, p1*p2 -0.006",
        ),
    },
    ("mass_spring", "clean"): {
        "PHSI": {
            **coefficients("H", "q**2 0.473, p**2 0.484"),
            "R_p": 0.3,
            **coefficients("F_p", "sin(omega_t*t) 1.984"),
            "F_p.omega_t": 0.505,
        }
    },
    ("tanks", f"noise {TANK_NOISE:g}"): {
        "PHSI": {
            f"H[{state}**2]": energy
            for state, energy in zip(FLOWS + LEVELS, TANK_ENERGIES, strict=True)
        }
        | {f"R_{flow}": r for flow, r in zip(FLOWS, TANK_DAMPING, strict=True)}
    },
}
# What its text says.
SAYS = {
    "henon_heiles": "On noisy data PHSI is an order of magnitude before SSINN in free "
    "runs; both and BSI are before SINDy.",
    "schrodinger": "On clean data PHSI and SINDy reach 1e-5 and BSI 1e-3; on noisy "
    "data PHSI 0.1, SINDy and BSI 1 or worse.",
    "mass_spring": "On noisy data PHSI predicts well to twice the training time, BSI "
    "and PHNN inside it only, SINDy poorly.",
    "tanks": "At noise 0.005 PHSI is before BSI and BSI before SINDy; outside the "
    "training range PHSI alone predicts.",
}


# --- every method on one system


# In the order of the table.
METHODS: dict[str, Method] = {
    SOLVER: methods.solver,
    "PHSI, threshold alone": methods.solver_threshold,
    DESCENT: methods.descent,
    "BSI, solver": methods.bsi_solver,
    "BSI, descent": methods.bsi_descent,
    "SINDy, STLSQ": methods.stlsq,
    "SINDy, SR3": methods.sr3,
    "LASSO": methods.lasso,
}


def runs_of(system: System, kind: str, quick: bool) -> list[Done]:
    """All methods on clean or noisy data; the likelihood starts from the solver."""
    data = system.few(kind, QUICK_N) if quick else system.training_data(kind)
    setting = Setting(system, data, system.tests(2 if quick else N_TESTS))
    found: list[Done] = []
    for label, method in METHODS.items():
        made = partial(method, system, data, kind, 0)
        found.append(done(setting, made, data=kind, method=label))
        # On exact data the program of the tanks does not end within minutes.
        is_ending = (system.name, kind) != ("tanks", "clean")
        if label == SOLVER and found[0].is_model and is_ending:
            made = partial(methods.likelihood, system, data, found[0].result)
            found.append(done(setting, made, data=kind, method=LIKELIHOOD))
    return found


def tanks_of_the_text(system: System) -> list[Done]:
    """The solver at the noise that the thesis' text has."""
    data = system.data(0, TANK_NOISE)
    setting = Setting(system, data, system.tests(N_TESTS))
    made = partial(methods.solver, system, data)
    return [done(setting, made, data=f"noise {TANK_NOISE:g}", method=SOLVER)]


def system_page(name: str, quick: bool) -> str:
    """The page of one system; its figures are drawn unless ``quick``."""
    system = SYSTEMS[name].shortened(2) if quick else SYSTEMS[name]
    found = {kind: runs_of(system, kind, quick) for kind in KINDS}
    if not quick:
        draw(system, found)
        if name == "tanks":
            found[f"noise {TANK_NOISE:g}"] = tanks_of_the_text(system)
    every = table(one for runs in found.values() for one in runs)
    tables = {}
    for kind, runs in found.items():
        printed = PRINTED.get((name, kind), {})
        if kind == "noisy" or printed:
            tables[kind] = coefficient_table(system, runs, printed)
    return render(
        "thesis/pages/methods.md",
        system=system,
        source="of the thesis" if thesis_data_present() else "drawn anew",
        n_tests=N_TESTS,
        rows=shown(every),
        says=SAYS[name],
        tables=tables,
        wrong_frequency=methods.WRONG_FREQUENCY,
    )


def coefficient_table(
    system: System, found: Sequence[Done], printed: Mapping[str, Mapping[str, float]]
) -> pd.DataFrame:
    """True value beside the value of every method that learns H, R and F."""
    columns: dict[str, dict[str, str]] = {}
    for one in found:
        if one.is_model and not isinstance(one.result.model, ph.FirstOrder):
            columns[one.method] = _column(system, one.result)
    for label, values in printed.items():
        columns[f"thesis, {label}"] = {n: f"{v:g}" for n, v in values.items()}
    names = list(system.truth)
    for column in columns.values():
        extra = [n for n in column if n not in names and not is_frequency(n)]
        names += extra if len(extra) <= MOST_EXTRA else []
    frame = pd.DataFrame({"coefficient": names})
    frame["true"] = [f"{system.truth.get(name, 0.0):.4g}" for name in names]
    for label, column in columns.items():
        frame[label] = [column.get(name, "0") for name in names]
    return frame


def _column(system: System, result: Any) -> dict[str, str]:
    """Coefficients of one method that are not zero, as they are shown."""
    column = {}
    for own_name, value in result.values.items():
        name = common_name(own_name)
        if value and (is_frequency(name) or is_coefficient(name, system.truth)):
            error = result.std_errors.get(own_name, np.nan)
            spread = f" +- {error:.1g}" if np.isfinite(error) else ""
            column[name] = f"{value:.4f}{spread}"
    return column


def draw(system: System, found: Mapping[str, Sequence[Done]]) -> None:
    """The figures of one system."""
    rows = []
    for kind, runs in found.items():
        of_kind = {one.method: one.result for one in runs}
        chosen = [label for label in DRAWN if label in of_kind]
        rows.append([(f"{n}, {kind} data", {n: of_kind[n]}) for n in chosen])
    figures.trajectories(f"{system.name}_trajectory", system, rows)
    figures.errors_over_time(f"{system.name}_error", found)
    by = {one.method: one for one in found["noisy"]}
    if system.name == "schrodinger":
        labels = (SOLVER, "BSI, solver", "SINDy, STLSQ")
        own = [by[label] for label in labels]
        figures.learned_coefficients("schrodinger_coefficients", own)
    if system.name == "tanks":
        own = [by[label] for label in (SOLVER, LIKELIHOOD) if by[label].is_model]
        figures.leaks("tanks_leak", own)
        outside = "tanks_trajectory_outside"
        figures.trajectories(outside, system, rows[1:], figures.OUTSIDE)


# --- the solver beside gradient descent

SIZE, BOTH = "size", "size and significance"
ALL_TERMS = "solver, all terms"
# Without any weight on H the sum of the levels of the tanks is not determined.
LEAST = {"tanks": {"H": 1e-6}}
ROUNDING = 1e-9  # relative difference at which two losses are the same


def descent_runs(system: System, kind: str, quick: bool) -> list[Done]:
    """Solver and descent on the same data; the solver is pruned by either rule."""
    data = system.few(kind, QUICK_N) if quick else system.training_data(kind)
    setting = Setting(system, data, system.tests(2 if quick else 10))
    descent = partial(methods.descent, system, data, kind)
    all_terms = partial(methods.by_solver, l1=LEAST.get(system.name, {}))
    wanted: list[tuple[str, str, str, Callable[[], Any]]] = [
        ("solver", SIZE, "-", partial(methods.solver_threshold, system, data)),
        ("descent", SIZE, TUNED, partial(descent, 0, "thesis", TUNED)),
        ("solver", BOTH, "-", partial(methods.solver, system, data)),
        ("descent, random start", SIZE, TUNED, partial(descent, 1, "normal", TUNED)),
        ("descent", SIZE, THESIS, partial(descent, 0, "thesis", THESIS)),
        (ALL_TERMS, "-", "-", partial(all_terms, system, data, None)),
    ]
    found = []
    for method, rule, settings, make in wanted:
        keys = {"system": system.title, "data": kind, "method": method}
        found.append(done(setting, make, **keys, rule=rule, settings=settings))
    return found


def descent_page(quick: bool) -> str:
    """The page of the solver beside gradient descent."""
    names = ("henon_heiles", "mass_spring") if quick else SYSTEMS
    found: list[Done] = []
    for name in names:
        system = SYSTEMS[name].shortened(2) if quick else SYSTEMS[name]
        for kind in KINDS:
            found += descent_runs(system, kind, quick)
    rows = table(found)
    beside = ratios(rows)
    tables = {"rows": shown(rows), "shown": shown(beside)}
    return render("thesis/pages/descent.md", ratios=beside, quick=quick, **tables)


def ratios(rows: pd.DataFrame) -> pd.DataFrame:
    """A line per system and data: both methods' errors, terms, losses and times."""
    lines = []
    for (system, kind), part in rows.groupby(["system", "data"], sort=False):
        ours = part[part["rule"] == BOTH].iloc[0]
        theirs = part[part["settings"] == TUNED].iloc[0]
        loss = part.loc[part["method"] == ALL_TERMS, "loss"].iloc[0]
        best = part.loc[part["method"].str.startswith("descent"), "loss"].min()
        line: dict[str, Any] = {"system": system, "data": kind}
        for who, one in (("solver", ours), ("descent", theirs)):
            line[f"error, {who}"] = one["largest error"]
            line[f"wrong terms, {who}"] = one["spurious"] + one["missed"]
        line |= {"loss, solver, all terms": loss, "loss, best descent": best}
        line["not higher"] = bool(loss <= best * (1 + ROUNDING))
        lines.append(line | {"time, share": ours["seconds"] / theirs["seconds"]})
    return pd.DataFrame(lines)


# --- many draws of the noise

N_DRAWS, N_RULED = 5, 30
FIRST_DRAW = 200  # draws that nothing was tuned on


def draws_page(quick: bool) -> str:
    """The page of noise draws: methods on every system, rules of pruning on one."""
    found, ruled = [], []
    for name in ("henon_heiles",) if quick else SYSTEMS:
        system = SYSTEMS[name].shortened(2) if quick else SYSTEMS[name]
        for seed in range(FIRST_DRAW, FIRST_DRAW + (1 if quick else N_DRAWS)):
            found += drawn(system, seed, 400 if quick else None)
    system = SYSTEMS["henon_heiles"]
    for seed in range(2 if quick else N_RULED):
        data = system.data(seed, n=1000 if quick else None)
        for threshold, level in RULED:
            pruning = ph.Pruning(threshold, significance=level)
            words = f"size {threshold:g}" + (f", significance {level}" if level else "")
            made = partial(methods.by_solver, system, data, pruning)
            setting = Setting(system, data, system.tests(3))
            ruled.append(done(setting, made, rule=words))
    return render(
        "thesis/pages/draws.md",
        medians=medians(table(found), ["system", "method"]),
        ruled=medians(table(ruled), ["rule"]),
        n_draws=N_DRAWS,
        n_ruled=N_RULED,
    )


RULED = ((0.05, None), (0.1, None), (0.15, None), (0.05, SIGNIFICANCE))


def drawn(system: System, seed: int, n: int | None) -> list[Done]:
    """The methods on one draw."""
    data = system.data(seed, n=n)
    setting = Setting(system, data, system.tests(10, seed=10_000 + seed))
    keys: dict[str, object] = {"system": system.title, "draw": seed}
    found: list[Done] = []
    for label, method in (
        ("solver", methods.solver),
        ("solver, threshold alone", methods.solver_threshold),
        ("descent", methods.descent),
    ):
        made = partial(method, system, data, "noisy", seed)
        found.append(done(setting, made, **keys, method=label))
    made = partial(methods.likelihood, system, data, found[0].result)
    label = "solver, then likelihood"
    found.append(done(setting, made, **keys, method=label))
    return found

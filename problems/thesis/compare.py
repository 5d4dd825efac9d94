"""Solver against gradient descent, side by side: the same model, the same data, the
same measures, both rules of pruning on both.

Each system, clean and noisy (the data of the thesis where they are present); all runs
of a system in one process, one after the other, with one thread; two systems at a time
(--jobs=N: so many). Both are started three times: gradient descent from the thesis'
starting values and twice at random; the solver from its convex program and twice at
random values (tanks: seeds of the network). The thesis' own settings of the descent,
and its other descents (BSI, and PHNN on the mass-spring), are run once each, and a
tuned one beside them.

    python -m problems.thesis.compare [--quick] [--page] [system ...]

--page writes the page alone, from the tables that are kept in results/thesis.
"""

import os

# Before NumPy is loaded: equal terms for both.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis import methods
from problems.thesis.methods import SIGNIFICANCE, THESIS, TUNED, by_solver, likelihood
from problems.thesis.scores import inside_and_beyond, phsi_loss, score
from problems.thesis.systems import SYSTEMS, System
from problems.tools import provenance
from problems.tools.command_line import chosen, flag
from problems.tools.kept_tables import rewrite
from problems.tools.pages import render
from problems.tools.workers import workers

N_STARTS = 3
QUICK_STARTS = {"tanks": 1}  # others: 2; a hybrid takes seconds on any data
QUICK_N = {"henon_heiles": 400}  # trajectories of a quick run; others: 8
QUICK_EPOCHS = 2
# Without any weight on H the sum of the levels of the tanks is not determined.
LEAST = {"tanks": {"H": 1e-6}}
LONGEST_FIRST = ("tanks", "mass_spring", "henon_heiles", "schrodinger")
SIZE = "size"  # the thesis' rule (Algorithm 6)
BOTH = "size and significance"
RULES = {SIZE: None, BOTH: SIGNIFICANCE}
ALL_TERMS = "solver, all terms"
ROUNDING = 1e-9  # relative difference at which two losses are the same
GROUP = ["system", "data", "method", "rule", "settings"]
# Seconds of the thesis' own code: its notebooks run unchanged on its data (Henon-Heiles
# clean with the rate of its appendix B), one thread of a machine with two shared cores,
# torch 2.13 in float32.
THESIS_CODE_SECONDS: dict[Any, dict[Any, float]] = {
    "Henon-Heiles": {"clean": 183.0, "noisy": 145.0},
    "Schroedinger": {"clean": 916.0, "noisy": 959.0},
    "Mass-spring": {"clean": 249.0, "noisy": 240.0},
    "Tanks and pipes": {"clean": 539.0, "noisy": 526.0},
}

# Method, rule, settings and start of a run, and the call that makes its result.
Run = tuple[str, str, str, str, Callable[[], Any]]


def runs(
    system: System, data: ph.Measurements, kind: str, n_starts: int, epochs: int | None
) -> Iterator[Run]:
    """Every method on one set of data, clean or noisy; ``epochs``: of a PHNN."""
    own: dict[str, Any] = {}  # by rule, the solver's result from its own start

    def solved(rule: str, k: int) -> Any:
        pruning = ph.Pruning(system.threshold, significance=RULES[rule])
        if k and system.name != "tanks":
            return from_random(system, data, own[rule], pruning, seed=k)
        found = by_solver(system, data, pruning, seed=k)
        own.setdefault(rule, found)
        return found

    def refined(rule: str) -> Any:
        return likelihood(system, data, own[rule])

    for rule in RULES:
        for k in range(n_starts):
            start = f"seed {k}" if system.name == "tanks" else f"random {k}"
            if k == 0 and system.name != "tanks":
                start = "convex"
            yield "solver", rule, "-", start, partial(solved, rule, k)
            # Without noise there is nothing for the likelihood to weigh.
            if k == 0 and kind == "noisy":
                made = partial(refined, rule)
                yield "solver, then likelihood", rule, "-", "from the first", made
    weights = LEAST.get(system.name, {})
    made = partial(by_solver, system, data, None, l1=weights)
    yield ALL_TERMS, "-", "-", "convex", made
    descended = partial(methods.descent, system, data, kind)
    for rule, significance in RULES.items():
        made = partial(descended, 0, "thesis", THESIS, significance)
        yield "descent", rule, THESIS, "thesis", made
        for k in range(n_starts):
            begin = "normal" if k else "thesis"
            made = partial(descended, k, begin, TUNED, significance)
            yield "descent", rule, TUNED, f"random {k}" if k else "thesis", made
    for settings in (THESIS, TUNED):
        made = partial(methods.bsi_descent, system, data, kind, 0, settings)
        yield "BSI, descent", SIZE, settings, "thesis", made
    if system.name == "mass_spring":
        for settings in (THESIS, TUNED):
            made = partial(methods.phnn, system, data, kind, 0, settings, epochs)
            yield "PHNN", "-", settings, "thesis", made


def from_random(
    system: System, data: ph.Measurements, own: ph.Fit, pruning: ph.Pruning, seed: int
) -> ph.Fit:
    """The solver without its starting values: coefficients from N(0, 0.5^2).

    Damping and frequency are made positive. ``own``: a fit from its own start.
    """
    model = system.model()
    drawn = 0.5 * np.random.default_rng(seed).normal(size=len(model.free))
    values = dict(zip(model.free, drawn, strict=True))
    for name, value in values.items():
        if name.startswith("R") or "omega_t" in name.split("[")[0]:
            values[name] = abs(value)
    return ph.identify(
        model,
        data,
        ph.PHSILoss(),
        dict(system.l1),
        pruning,
        start=replace(own, model=model.with_values(values)),
        raise_on_failure=False,
    )


def measured(name: str, quick: bool) -> pd.DataFrame:
    """All runs on one system, in processor seconds: other processes do not count."""
    system = SYSTEMS[name].shortened(QUICK_EPOCHS) if quick else SYSTEMS[name]
    n_starts = QUICK_STARTS.get(name, 2) if quick else N_STARTS
    epochs = QUICK_EPOCHS if quick else None
    rows = []
    for kind in ("clean", "noisy"):
        data = system.few(kind, QUICK_N) if quick else system.training_data(kind)
        for method, rule, settings, start, made in runs(
            system, data, kind, n_starts, epochs
        ):
            began = time.process_time()
            result = made()
            seconds = time.process_time() - began
            row: dict[str, Any] = {"system": system.title, "data": kind}
            row |= {"method": method}
            row |= {"rule": rule, "settings": settings, "start": start}
            row |= {"intervals": sum(len(run.t) - 1 for run in data.trajectories)}
            found = errors(system, data, result, 1 if quick else None)
            rows.append(row | found | {"seconds": seconds})
            print("...", *rows[-1].values(), sep=", ", flush=True)
    table = pd.DataFrame(rows)
    if not quick:
        rewrite(_path(name), table, "%.6g")
    return table


def errors(
    system: System, data: ph.Measurements, result: Any, n_tests: int | None = None
) -> dict[str, Any]:
    """Errors of coefficients and free runs, and the loss; a PHNN has no terms."""
    found = score(system, result)
    is_network = not hasattr(result, "model")
    counts = dict.fromkeys(found.counts, np.nan) if is_network else found.counts
    inside, whole = inside_and_beyond(system, result, n_tests)
    loss = result.loss_value if is_network else phsi_loss(result, data)
    return {
        "largest error": found.largest,
        "relative error": found.relative,
        **counts,
        "PHSI loss": loss,
        "l2 inside": inside,
        "l2 whole": whole,
    }


def main(quick: bool = False, names: list[str] | None = None) -> pd.DataFrame:
    """The table of all runs.

    Each system's is kept in results/thesis, and the page is made of those that are
    there.
    """
    wanted = names or list(SYSTEMS)
    with workers(1 if quick else None) as executor:
        ordered = sorted(wanted, key=LONGEST_FIRST.index)
        asked = {name: executor.submit(measured, name, quick) for name in ordered}
        tables = [asked[name].result() for name in wanted]
    table = pd.concat(tables, ignore_index=True)
    if quick:
        print(page(table, quick=True))
    else:
        write_page()
    return table


def _path(name: str) -> Path:
    return provenance.RESULTS / "thesis" / f"compare_{name}.csv"


def kept_table() -> pd.DataFrame:
    """The tables that are kept."""
    kept = [pd.read_csv(_path(name)) for name in SYSTEMS if _path(name).exists()]
    return pd.concat(kept, ignore_index=True)


# --- the page


def write_page() -> None:
    """Write the page anew from the tables that are kept."""
    provenance.write("solver_vs_gradient_descent.md", page(kept_table()))


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """A row per system, data, method, rule and settings; ``n`` runs from n starts."""
    by = table.groupby(GROUP, sort=False)
    return pd.DataFrame(
        {
            "n": by.size(),
            "error, median": by["largest error"].median(),
            "error, first": by["largest error"].agg(lambda values: values.iloc[0]),
            "error, worst": by["largest error"].max(),
            "spurious, first": by["spurious"].agg(lambda values: values.iloc[0]),
            "spurious, most": by["spurious"].max(),
            "missed, most": by["missed"].max(),
            "loss, best": by["PHSI loss"].min(),
            "l2 whole, median": by["l2 whole"].median(),
            "seconds, median": by["seconds"].median(),
        }
    ).reset_index()


def ratios(table: pd.DataFrame, rule: str = BOTH) -> pd.DataFrame:
    """A row per system and data: both methods' errors, losses and times, one rule.

    The solver is its first start, gradient descent (tuned) the median or best of its
    starts.
    """
    rows = []
    for (system, kind), part in table.groupby(["system", "data"], sort=False):
        of_rule = part[part["rule"] == rule]
        ours = of_rule[of_rule["method"] == "solver"].iloc[0]
        is_tuned = (of_rule["method"] == "descent") & (of_rule["settings"] == TUNED)
        theirs = of_rule[is_tuned]
        all_terms = part[part["method"] == ALL_TERMS]["PHSI loss"].iloc[0]
        # Whatever its rule and settings.
        best_loss = part.loc[part["method"] == "descent", "PHSI loss"].min()
        rows.append(
            {
                "system": system,
                "data": kind,
                "error, solver": ours["largest error"],
                "error, descent": theirs["largest error"].median(),
                "wrong terms, solver": ours["spurious"] + ours["missed"],
                "wrong terms, descent": (
                    theirs["spurious"] + theirs["missed"]
                ).median(),
                "loss, all terms": all_terms,
                "loss, best descent": best_loss,
                "not higher": bool(all_terms <= best_loss * (1 + ROUNDING)),
                "times as fast": theirs["seconds"].median() / ours["seconds"],
                "thesis, times": THESIS_CODE_SECONDS[system][kind] / ours["seconds"],
            }
        )
    return pd.DataFrame(rows)


def page(table: pd.DataFrame, quick: bool = False) -> str:
    """The page that users read; ``quick``: a run that shows only that it runs."""
    found = {rule: ratios(table, rule) for rule in RULES}
    both = found[BOTH]
    is_right = (table["spurious"] == 0) & (table["missed"] == 0)
    is_random = table["start"].str.startswith("random") & (table["rule"] == BOTH)
    is_first = (table["start"] == "thesis") & (table["rule"] == SIZE)
    from_thesis = table[is_first].set_index(["system", "data", "settings"])
    first = {
        method: from_thesis[from_thesis["method"] == method]["largest error"].unstack()
        for method in ("descent", "BSI, descent")
    }
    shown = summary(table)
    for name in shown.columns[len(GROUP) + 1 :]:
        shown[name] = shown[name].map(_three_digits)
    every = table.copy()
    for name in [*table.columns[table.columns.get_loc("largest error") : -1]]:
        every[name] = every[name].map(_three_digits)
    every["seconds"] = every["seconds"].map("{:.1f}".format)
    return render(
        "thesis/pages/compare.md",
        quick=quick,
        systems=table["system"].unique(),
        found=found,
        both=both,
        excess=both["loss, best descent"] / both["loss, all terms"] - 1,
        slower=both[both["times as fast"] < 1],
        by_random={
            method: is_right[is_random & (table["method"] == method)].groupby(
                table["system"], sort=False
            )
            for method in ("solver", "descent")
        },
        first=first,
        shown=shown,
        every=every,
        test_times=[f"{system.test_time:g}" for system in SYSTEMS.values()],
    )


def _three_digits(value: float) -> str:
    return "-" if pd.isna(value) else f"{value:.3g}"


if __name__ == "__main__":
    if flag("page"):
        write_page()
    else:
        main(flag("quick"), chosen() or None)

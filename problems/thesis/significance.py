"""Which terms stay: pruning by size (the thesis) beside size and significance, over
many noise draws of Henon-Heiles.

Each draw has new starts and new noise (3000 pairs, noise 0.02, dictionary of 34 terms,
6 of them true).

    python -m problems.thesis.significance [--quick]
"""

import re

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis.methods import SIGNIFICANCE, by_solver
from problems.thesis.scores import coverage, score
from problems.thesis.systems import SYSTEMS
from problems.tools.command_line import flag
from problems.tools.pages import render
from problems.tools.provenance import write

SYSTEM = SYSTEMS["henon_heiles"]
N_DRAWS = 60
THRESHOLDS = (0.05, 0.1, 0.15)  # the first is that of the thesis
BY_SIZE = "size 0.05 alone"
BOTH = f"size 0.05 and significance {SIGNIFICANCE:g}"
RULES = {
    **{f"size {e:g} alone": ph.Pruning(e) for e in THRESHOLDS},
    BOTH: ph.Pruning(THRESHOLDS[0], significance=SIGNIFICANCE),
    f"significance {SIGNIFICANCE:g} alone": ph.Pruning(0.0, significance=SIGNIFICANCE),
}


def main(quick: bool = False) -> pd.DataFrame:
    """A row per draw and rule."""
    rows = []
    for seed in range(2 if quick else N_DRAWS):
        data = SYSTEM.data(seed, n=1000 if quick else None)
        for rule, pruning in RULES.items():
            fit = by_solver(SYSTEM, data, pruning)
            found = score(SYSTEM, fit)
            names = fit.model.free
            cubic = [fit.std_errors[name] for name in names if degree(name) == 3]
            kept = [name for name in names if name in SYSTEM.truth]
            row = {"draw": seed, "rule": rule, **found.counts}
            row |= {"largest_error": found.largest, "seconds": fit.seconds}
            row |= {"covered": coverage(SYSTEM, fit, kept)}
            row |= {"least_cubic_error": min(cubic, default=np.nan)}
            rows.append(row | {"largest_cubic_error": max(cubic, default=np.nan)})
        print(f"... draw {seed}", flush=True)
    table = pd.DataFrame(rows)
    if not quick:
        write("thesis/significance.md", page(table))
    return table


def degree(name: str) -> int:
    """Degree of the monomial in a name such as H[q1**2*q2]."""
    powers = re.findall(r"[qp]\d(?:\*\*(\d))?", name)
    return sum(int(power or 1) for power in powers)


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Per rule: shares of draws and medians."""
    table = table.assign(
        without_spurious=table["spurious"] == 0, without_missed=table["missed"] == 0
    )
    by = table.groupby("rule", sort=False)
    return pd.DataFrame(
        {
            "draws without a spurious term": by["without_spurious"].mean(),
            "draws without a missed term": by["without_missed"].mean(),
            "most spurious terms": by["spurious"].max(),
            "median largest error": by["largest_error"].median(),
            "true terms within 95 % interval": by["covered"].mean(),
            "median seconds": by["seconds"].median(),
        }
    )


def page(table: pd.DataFrame) -> str:
    """The result as Markdown; numbers in its text are those of the table."""
    found = summary(table)
    by_size = table[table["rule"] == BY_SIZE]
    return render(
        "thesis/pages/significance.md",
        system=SYSTEM,
        n_draws=table["draw"].nunique(),
        n_terms=len(SYSTEM.model().free),
        found=found,
        plain=found.loc[BY_SIZE],
        both=found.loc[BOTH],
        least=by_size["least_cubic_error"].median(),
        largest=by_size["largest_cubic_error"].median(),
        smallest_true=min(abs(value) for value in SYSTEM.truth.values()),
        threshold=THRESHOLDS[0],
        significance=SIGNIFICANCE,
    )


if __name__ == "__main__":
    main(quick=flag("quick"))

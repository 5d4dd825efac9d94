"""Which terms stay: pruning by size (the thesis) beside size and significance, over
many noise draws of Henon-Heiles.

Each draw has new starts and new noise (3000 pairs, noise 0.02, dictionary of 34 terms,
6 of them true).

    python -m problems.thesis.significance [--quick]
"""

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis.methods import SIGNIFICANCE, by_solver
from problems.thesis.scores import score
from problems.thesis.systems import SYSTEMS
from problems.tools.command_line import flag
from problems.tools.provenance import write

N_DRAWS = 60
THRESHOLDS = (0.05, 0.1, 0.15)


def main(quick: bool = False) -> pd.DataFrame:
    """A row per draw and rule."""
    system = SYSTEMS["henon_heiles"]
    rules = {f"size {e:g} alone": ph.Pruning(e) for e in THRESHOLDS}
    rules[f"size 0.05 and significance {SIGNIFICANCE:g}"] = ph.Pruning(
        0.05, significance=SIGNIFICANCE
    )
    rules[f"significance {SIGNIFICANCE:g} alone"] = ph.Pruning(
        0.0, significance=SIGNIFICANCE
    )
    rows = []
    for seed in range(2 if quick else N_DRAWS):
        data = system.data(seed, n=1000 if quick else None)
        for rule, pruning in rules.items():
            fit = by_solver(system, data, pruning)
            s = score(system, fit)
            truth = [
                system.truth[name] for name in fit.model.free if name in system.truth
            ]
            z = [
                (fit.values[n] - system.truth[n]) / fit.std_errors[n]
                for n in fit.model.free
                if n in system.truth
            ]
            covered = float(np.mean(np.abs(z) < 1.96)) if truth else np.nan
            rows.append(
                (
                    seed,
                    rule,
                    len(s.spurious),
                    len(s.missed),
                    s.largest,
                    s.relative,
                    covered,
                    fit.seconds,
                )
            )
        print(f"... draw {seed}", flush=True)
    columns = [
        "draw",
        "rule",
        "spurious",
        "missed",
        "largest_error",
        "relative_error",
        "covered",
        "seconds",
    ]
    table = pd.DataFrame(rows, columns=columns)
    if not quick:
        write("thesis/significance.md", _page(table))
    return table


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Per rule: shares of draws and medians."""
    by = table.groupby("rule", sort=False)
    return pd.DataFrame(
        {
            "draws without a spurious term": by["spurious"].apply(
                lambda c: float((c == 0).mean())
            ),
            "draws without a missed term": by["missed"].apply(
                lambda c: float((c == 0).mean())
            ),
            "most spurious terms": by["spurious"].max(),
            "median largest error": by["largest_error"].median(),
            "true terms within 95 % interval": by["covered"].mean(),
            "median seconds": by["seconds"].median(),
        }
    )


def _page(table: pd.DataFrame) -> str:
    s = summary(table)
    n = int(table["draw"].nunique())
    best = s[s.index.str.startswith("size 0.05 and")].iloc[0]
    plain = s.iloc[0]
    return "\n".join(
        [
            "# Pruning by size and by significance",
            "",
            f"Henon-Heiles, {n} noise draws (3000 pairs, noise 0.02), PHSI loss by the solver, 34 candidate terms.",
            "",
            "```text",
            s.round(3).to_string(),
            "```",
            "",
            f"The thesis' threshold of 0.05 leaves no spurious term in {plain.iloc[0]:.0%} of the draws: the standard",
            "errors of the cubic terms are 0.02 to 0.05, so noise alone lifts many above it. A higher threshold helps only",
            "because every true coefficient here is known to be at least 1/3. With significance besides, which does not",
            f"need that, {best.iloc[0]:.0%} of the draws have no spurious term and {best.iloc[1]:.0%} miss none. The level",
            f"{SIGNIFICANCE:g} is the chance, per dictionary, that any term stays whose coefficient is zero. The intervals",
            "of the last but one column are those of the true terms that stay; they do not account for the selection.",
        ]
    )


if __name__ == "__main__":
    main(quick=flag("quick"))

"""The figure of the page."""

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from problems.hidden_effects.rows import NOISE_LEVELS, ROWS
from problems.hidden_effects.scores import scored
from problems.tools.provenance import RESULTS


def figure(found: dict[str, pd.DataFrame]) -> None:
    """Share of cases that are right, per effect and noise, with 95 % intervals."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    effects = list(dict.fromkeys(ROWS[name].effects[0] for name in found))
    colours = dict(zip(NOISE_LEVELS, ("#0072b2", "#009e73", "#d55e00"), strict=True))
    fig, ax = plt.subplots(figsize=(8, 1.2 + 0.34 * len(effects)), layout="constrained")
    lowest = 80.0
    for k, noise in enumerate(NOISE_LEVELS):
        shown = {
            e: scored(r)
            for n, r in found.items()
            for e in ROWS[n].effects
            if ROWS[n].noise[0] == noise and len(r)
        }
        tests = {
            e: binomtest(int(r["good"].sum()), len(r))
            for e, r in shown.items()
            if len(r)
        }
        heights = [effects.index(e) + 0.22 * (k - 1) for e in tests]
        middles = [100 * test.statistic for test in tests.values()]
        spans = [test.proportion_ci(method="wilson") for test in tests.values()]
        ends = [
            [m - 100 * s.low, 100 * s.high - m]
            for m, s in zip(middles, spans, strict=True)
        ]
        lowest = min([lowest, *(100 * s.low for s in spans)])
        errors = np.maximum(np.array(ends).reshape(-1, 2).T, 0.0)
        ax.errorbar(
            middles,
            heights,
            xerr=errors,
            fmt="o",
            ms=4,
            lw=1,
            color=colours[noise],
            label=f"{noise:.0%} noise",
        )
    for target, style in ((95, "-"), (85, ":")):
        ax.axvline(target, color="0.5", lw=1, ls=style, label=f"target {target} %")
    ax.set(
        yticks=range(len(effects)),
        yticklabels=effects,
        xlim=(10 * (lowest // 10), 101),
        ylim=(-0.7, len(effects) - 0.3),
    )
    ax.set_xlabel(
        "cases with the right effect in the right equation (%), 95 % intervals"
    )
    ax.invert_yaxis()
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    fig.savefig(RESULTS / "hidden_effects.png", dpi=150)
    plt.close(fig)

"""The figure of the page: how often each hidden effect is found."""

import pandas as pd
from scipy.stats import binomtest

from problems.hidden_effects.rows import NOISE_LEVELS, ROWS
from problems.hidden_effects.scores import TARGETS, scored
from problems.tools.pictures import plt, save

COLOURS = dict(zip(NOISE_LEVELS, ("#0072b2", "#009e73", "#d55e00"), strict=True))
LINES = ("-", ":")  # of the targets, from the highest on
HIGHEST_LEFT_END = 80.0  # %, of the axis


def figure(found: dict[str, pd.DataFrame]) -> None:
    """Share of cases that are right, per effect and noise, with 95 % intervals.

    ``found``: the cases of the rows with one hidden effect.
    """
    effects = list(dict.fromkeys(ROWS[name].effects[0] for name in found))
    height = 1.2 + 0.34 * len(effects)
    fig, ax = plt.subplots(figsize=(8, height), layout="constrained")
    lowest = HIGHEST_LEFT_END
    for k, noise in enumerate(NOISE_LEVELS):
        rows = {
            ROWS[name].effects[0]: scored(cases)
            for name, cases in found.items()
            if ROWS[name].noise[0] == noise
        }
        shift = 0.22 * (k - 1)
        for effect, kept in rows.items():
            if len(kept):
                place = effects.index(effect) + shift
                lowest = min(lowest, _point(ax, place, kept, COLOURS[noise]))
        ax.plot([], [], "o", ms=4, color=COLOURS[noise], label=f"{noise:.0%} noise")
    targets = sorted(set(TARGETS.values()), reverse=True)
    for target, style in zip(targets, LINES, strict=True):
        label = f"target {100 * target:g} %"
        ax.axvline(100 * target, color="0.5", lw=1, ls=style, label=label)
    ax.set(
        yticks=range(len(effects)),
        yticklabels=effects,
        xlim=(10 * (lowest // 10), 101),
        ylim=(-0.7, len(effects) - 0.3),
        xlabel="cases with the right effect in the right equation (%), 95 % intervals",
    )
    ax.invert_yaxis()
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    save(fig, "hidden_effects.png", dpi=150)


def _point(ax: plt.Axes, place: float, kept: pd.DataFrame, colour: str) -> float:
    """One share with its interval (Wilson); the interval's lower end in per cent."""
    test = binomtest(int(kept["good"].sum()), len(kept))
    interval = test.proportion_ci(method="wilson")
    middle = 100 * test.statistic
    below = max(middle - 100 * interval.low, 0.0)
    above = max(100 * interval.high - middle, 0.0)
    ax.errorbar(
        middle, place, xerr=[[below], [above]], fmt="o", ms=4, lw=1, color=colour
    )
    return 100 * interval.low

"""The page results/efficiency.md and its figure, from the tables of the experiments."""

from collections.abc import Mapping

import matplotlib.ticker
import numpy as np
import pandas as pd

from problems.benchmarks.efficiency.cases import (
    CASES,
    DUFFING_TIMES,
    NOISE_LEVELS,
    THESIS_CASES,
    Case,
)
from problems.tools.intervals import HALF_WIDTH
from problems.tools.pages import render
from problems.tools.pictures import plt, save

FAR = 10.0  # bounds: beyond, an estimate has ended far away
LEVEL = 0.95  # of the intervals
# What is asked for: the ratio to the bound, and the coverage of the intervals.
TARGET_RATIO = 1.1
TARGET_COVERAGE = (0.93, 0.97)
COLOURS = {"likelihood": "#0072b2", "one-step": "#d55e00"}
TICKS = (0.8, 0.9, 1.0, 1.1, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
# Lines of the figure by method and measured states: label and style.
LINES = {
    ("one-step", "qp"): ("one-step loss, q and p measured", "s-"),
    ("likelihood", "qp"): ("maximum likelihood, q and p measured", "o-"),
    ("likelihood", "q"): ("maximum likelihood, q alone measured", "^--"),
}

Tables = Mapping[str, pd.DataFrame]  # kept rows by experiment

# --- scores


def scores(rows: pd.DataFrame) -> pd.DataFrame:
    """A row per parameter of one method.

    Errors over the bound of their own seed, coverage of the 95 % intervals. No estimate
    or no standard error is an interval that does not hold the truth.
    """
    error = rows["estimate"] - rows["truth"]
    z = error / rows["bound"]
    rows = rows.assign(
        z=z,
        square=z**2,
        excess=z**2 - (rows["efficient"] / rows["bound"]) ** 2,
        is_far=z.abs() > FAR,
        covered=error.abs() <= HALF_WIDTH * rows["std_error"],
        share=rows["std_error"] / rows["bound"],
    )
    by = rows.groupby("parameter", sort=False)
    beside = np.sqrt(np.maximum(1 + by["excess"].mean(), 0.0))
    return pd.DataFrame(
        {
            "truth": by["truth"].first(),
            "bound": by["bound"].mean(),
            "rmse/bound": np.sqrt(by["square"].mean()),
            "beside": beside,
            "beside +-": by["excess"].sem() / (2 * beside),
            "bias/bound": by["z"].mean(),
            "coverage": by["covered"].mean(),
            "std_error/bound": by["share"].mean(),
            "far": by["is_far"].sum(),
        }
    )


def joint(rows: pd.DataFrame) -> str:
    """Root mean square error over bound in all directions of the parameters together,
    with what chance makes of it.
    """
    by_seed = rows.groupby("seed")["joint"].first().dropna()
    if by_seed.empty:
        return "no estimate"
    chance = by_chance(len(by_seed) * rows["parameter"].nunique())
    return f"{np.sqrt(by_seed.mean()):.3f} +- {chance:.3f}"


def beside_efficient(found: pd.DataFrame) -> str:
    """The worst parameter's rmse over bound, without most of what chance does to it."""
    worst = found.sort_values("beside").iloc[-1]
    return f"{worst['beside']:.3f} +- {worst['beside +-']:.3f}"


def by_chance(n: int) -> float:
    """Standard deviation of a root mean square of ``n`` standard normal numbers."""
    return 1 / np.sqrt(2 * n)


def failures(rows: pd.DataFrame) -> int:
    """Number of fits that gave no estimate."""
    return int(rows[rows["outcome"] != "solved"]["seed"].nunique())


def summary_row(case: Case, rows: pd.DataFrame) -> dict[str, object]:
    """The line of an experiment in the summary."""
    likelihood = rows[rows["method"] == "likelihood"]
    one_step = rows[rows["method"] == "one-step"]
    found = scores(likelihood)
    n = rows["seed"].nunique()
    worst = found["rmse/bound"].max()
    one_step_worst = "needs all states"
    if len(one_step):
        one_step_worst = f"{scores(one_step)['rmse/bound'].max():.3g}"
    seconds = likelihood.groupby("seed")["seconds"].first().median()
    return {
        "experiment": case.title,
        "seeds": n,
        "failed": failures(likelihood),
        "worst rmse/bound": f"{worst:.3f} +- {by_chance(n):.3f}",
        "beside the efficient estimate": beside_efficient(found),
        "joint rmse/bound": joint(likelihood),
        "largest bias/bound": f"{found['bias/bound'].abs().max():.3f}",
        "coverage, pooled": f"{found['coverage'].mean():.1%}",
        "coverage, lowest": f"{found['coverage'].min():.1%}",
        "one-step: worst rmse/bound": one_step_worst,
        "seconds per fit": f"{seconds:.2g}",
    }


def verdict(rows: pd.DataFrame) -> str:
    """One experiment in a line."""
    parts = []
    for method, part in rows.groupby("method", sort=False):
        found = scores(part)
        ratio = found["rmse/bound"]
        parts.append(
            f"{method}: rmse/bound {ratio.min():.3f} to {ratio.max():.3f}, "
            f"joint {joint(part)}, coverage {found['coverage'].mean():.3f}, "
            f"failed {failures(part)}"
        )
    return "; ".join(parts)


def page(found: Tables) -> str:
    """The page as Markdown."""
    of_thesis = []
    for name in THESIS_CASES:
        rows = found.get(name)
        row: dict[str, object] = {"title": CASES[name].title.split(",")[0]}
        if rows is not None:
            likelihood = rows[rows["method"] == "likelihood"]
            by = scores(likelihood)
            row |= {"beside": beside_efficient(by), "worst": by["rmse/bound"].max()}
            row |= {"is_within": by["beside"].max() <= TARGET_RATIO}
            row |= {"n": likelihood["seed"].nunique(), "joint": joint(likelihood)}
        of_thesis.append(row)
    details = []
    for name, rows in found.items():
        parts = []
        for method, part in rows.groupby("method", sort=False):
            failed = part[part["outcome"] != "solved"]
            form = "{:.4g}".format
            row = {"method": method, "n": part["seed"].nunique(), "joint": joint(part)}
            row |= {"failed": failures(part)}
            row |= {"reasons": failed.groupby("outcome")["seed"].nunique()}
            shown = scores(part).to_string(float_format=form, index_names=False)
            parts.append(row | {"shown": shown})
        details.append((CASES[name], parts))
    return render(
        "benchmarks/pages/efficiency.md",
        summary=[summary_row(CASES[name], rows) for name, rows in found.items()],
        of_thesis=of_thesis,
        details=details,
        by_chance=by_chance,
        far=FAR,
        level=LEVEL,
        spread=np.sqrt(LEVEL * (1 - LEVEL)),
        ratio=TARGET_RATIO,
        coverage=TARGET_COVERAGE,
    )


# --- the figure


def figure(found: Tables) -> None:
    """Worst rmse over bound, over the noise level of the Duffing oscillator."""
    fig, ax = plt.subplots(figsize=(8.5, 4.2), layout="constrained")
    for (method, channels), (label, style) in LINES.items():
        worst = {}
        for noise in NOISE_LEVELS:
            rows = found.get(f"duffing_{channels}_{noise:g}")
            if rows is not None:
                part = rows[rows["method"] == method]
                worst[100 * noise] = scores(part)["rmse/bound"].max()
        if worst:
            ax.plot(
                *zip(*worst.items(), strict=True),
                style,
                color=COLOURS[method],
                label=label,
            )
    ax.axhline(1.0, color="0.4", ls="-", lw=1, label="Cramer-Rao bound")
    target = f"target: {TARGET_RATIO:g}"
    ax.axhline(TARGET_RATIO, color="0.4", ls=":", lw=1, label=target)
    ax.set(
        xscale="log",
        yscale="log",
        xlabel="noise (% of each channel's standard deviation)",
        ylabel="rmse / bound, worst parameter",
        title=f"Driven Duffing oscillator, {len(DUFFING_TIMES)} samples",
    )
    low, high = ax.get_ylim()
    shown = [tick for tick in TICKS if low <= tick <= high]
    ax.set_yticks(shown, [f"{tick:g}" for tick in shown])
    ax.yaxis.set_minor_locator(matplotlib.ticker.NullLocator())
    percent = [100 * noise for noise in NOISE_LEVELS]
    ax.set_xticks(percent, [f"{noise:g}" for noise in percent], minor=False)
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    save(fig, "efficiency.png", dpi=150)

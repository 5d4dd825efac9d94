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
from problems.tools import markdown
from problems.tools.intervals import HALF_WIDTH
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

INTRODUCTION = markdown.paragraph("""
    No unbiased estimate has a smaller standard deviation than the bound. It is computed
    without phsi_opt (`problems/benchmarks/efficiency/cramer_rao.py`), for each seed's
    own starts and missing samples, with the starting states unknown. All methods see
    the same data; the noise level is estimated, not given; no starting value is the
    truth. The command and the commit above are those of the run that wrote this page;
    rows of experiments that it did not name are kept from earlier runs.
    """)
TERMS = markdown.paragraph(f"""
    rmse/bound: root mean square over the seeds of error over bound. A fit that failed
    has no estimate and is not in it, but it is counted (failed), and its intervals
    count as not holding the truth; fits that end far away (beyond {FAR:g} bounds: far)
    are in it with their full error. +-: standard deviation of such a ratio, 1/sqrt(2
    seeds). Coverage: share of the {LEVEL:.0%} intervals that hold the truth; with n
    seeds that of one parameter has a standard deviation of
    {np.sqrt(LEVEL * (1 - LEVEL)):.0%}/sqrt(n), so the lowest of several lies below
    {LEVEL:.0%} by chance. Joint: the same in every direction of the parameters (sqrt of
    the mean of e' C^-1 e / number of parameters); it sees errors that hide where the
    estimates of two parameters are correlated. Beside the efficient estimate: least
    squares on the experiment linearised at the truth attains the bound, and its error
    on each seed's own noise is known; sqrt(1 + mean of (error^2 - its error^2) /
    bound^2) is rmse/bound without most of what the draw of the noise does to it, +- the
    standard deviation of that mean. Target: rmse/bound at most {TARGET_RATIO:g},
    coverage {TARGET_COVERAGE[0]:.0%} to {TARGET_COVERAGE[1]:.0%}.
    """)


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


# --- the page


def page(found: Tables) -> str:
    """The page as Markdown."""
    summary = [summary_row(CASES[name], rows) for name, rows in found.items()]
    lines = ["# How close to the Cramer-Rao bound?", "", INTRODUCTION, "", TERMS, ""]
    lines += [markdown.table(summary), "", *_of_thesis(found)]
    lines += ["![rmse over bound](efficiency.png)", ""]
    for name, rows in found.items():
        lines += _details(CASES[name], rows)
    return "\n".join(lines)


def _of_thesis(found: Tables) -> list[str]:
    """Whether the likelihood reaches the target on the systems of the thesis."""
    said = []
    for name in THESIS_CASES:
        if name not in found:
            said.append(f"{CASES[name].title.split(',')[0]} not run")
            continue
        rows = found[name]
        likelihood = rows[rows["method"] == "likelihood"]
        found_scores = scores(likelihood)
        worst = found_scores["rmse/bound"].max()
        beside = found_scores["beside"].max()
        n = likelihood["seed"].nunique()
        is_within = "within" if beside <= TARGET_RATIO else "above"
        said.append(
            f"{CASES[name].title.split(',')[0]} {beside_efficient(found_scores)} "
            f"({is_within} {TARGET_RATIO:g}; by itself {worst:.3f} +- "
            f"{by_chance(n):.3f}; {n} seeds; joint {joint(likelihood)})"
        )
    head = (
        "Worst rmse/bound of the likelihood on the systems of the thesis, beside the "
        "efficient estimate:"
    )
    return [f"{head} {'; '.join(said)}.", ""]


def _details(case: Case, rows: pd.DataFrame) -> list[str]:
    lines = [f"## {case.title}", ""]
    for method, part in rows.groupby("method", sort=False):
        n = part["seed"].nunique()
        spread = np.sqrt(LEVEL * (1 - LEVEL) / n)
        lines += [
            f"{method}: {n} seeds, {failures(part)} failed; "
            f"joint rmse/bound {joint(part)}; "
            f"by chance rmse/bound +- {by_chance(n):.3f}, coverage +- {spread:.1%}",
            "",
        ]
        shown = scores(part).to_string(float_format="{:.4g}".format, index_names=False)
        lines += [*markdown.block(shown), *_reasons(part)]
    if not case.one_step:
        lines += ["one-step: needs all states", ""]
    return lines


def _reasons(part: pd.DataFrame) -> list[str]:
    """Why fits failed, and how many."""
    failed = part[part["outcome"] != "solved"]
    counts = failed.groupby("outcome")["seed"].nunique()
    if counts.empty:
        return []
    return [*(f"- {count} x {reason}" for reason, count in counts.items()), ""]


# --- the figure


def figure(found: Tables) -> None:
    """Worst rmse over bound, over the noise level of the Duffing oscillator."""
    fig, ax = plt.subplots(figsize=(8.5, 4.2), layout="constrained")
    for (method, channels), (label, style) in LINES.items():
        worst = _worst_by_noise(found, method, channels)
        if worst:
            ax.plot(
                [100 * noise for noise in worst],
                list(worst.values()),
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


def _worst_by_noise(found: Tables, method: str, channels: str) -> dict[float, float]:
    """The worst parameter's rmse over bound per noise level that was run."""
    worst = {}
    for noise in NOISE_LEVELS:
        name = f"duffing_{channels}_{noise:g}"
        if name in found:
            rows = found[name]
            part = rows[rows["method"] == method]
            worst[noise] = scores(part)["rmse/bound"].max()
    return worst

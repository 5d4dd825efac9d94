"""The page of the coverage benchmark: what holds and what does not, and the tables."""

import pandas as pd

from problems.benchmarks.coverage_fits import SCENARIOS, jobs
from problems.benchmarks.coverage_stress import DRAWN, by_kind, stress_test, why_wide
from problems.benchmarks.coverage_summary import PHYSICAL, PLAIN, SOURCES
from problems.benchmarks.coverage_tables import (
    ASKED_FOR,
    FIXED,
    UNDISTURBED,
    coverage_table,
    numbers_table,
)
from problems.benchmarks.coverage_verdict import chance, verdict, verdict_table
from problems.tools import markdown

INTRODUCTION = markdown.paragraph("""
    An oscillator of 1 kg (k = 4 N/m, R_v = 0.3 N s/m, g = 1 N/V), driven by a known
    voltage of 1 V, its position measured every 0.1 s with noise of 0.02 m (position:
    0.45 m, both root mean square). The model has a linear spring, a linear damper and a
    gain; what the first column names acts beside it. OU: an Ornstein-Uhlenbeck force of
    that standard deviation and correlation time; the drive has 1 m/s^2. Quantised:
    positions in steps of 0.2 m, about 12 levels. One run has 400 samples, 4 runs 200
    each, 16 runs 100 each.
    """)
NONLINEARITY = markdown.paragraph("""
    Nonlinearity 1 to 5 %: every seed draws a smooth static one: a cubic spring
    (stiffening or softening), a one-sided spring a q^2 (to either side), cogging a
    sin(2 pi q / lambda + phase) with lambda 0.3 to 1 of the range of motion, quadratic
    drag a v |v|, or friction a tanh(v / corner) with a corner of 0.3 to 1 of the root
    mean square velocity. What a linear spring, a damper and a constant can do of it
    (least squares over 200 runs of that seed's own simulation, without noise) belongs
    to k and R_v: it is taken off before anything is simulated. So the coefficients of
    the simulation are the truth, and the share, drawn evenly from 1 to 5 % of the
    spring's force, root mean square, is that of what remains.
    """)
CELLS = markdown.paragraph("""
    Of exact intervals: how many coverages would lie within on average if all intervals
    held with 95 % exactly; of few records they are counted outside by chance. Interval
    meets: of how many coverages the own 95 % interval (Wilson) meets the limits.
    Three numbers in a cell belong to k, R_v and g. n: seeds. Plain likelihood: the
    default's estimates with standard errors that count residuals as white noise.
    Default: `identify` and `Fit.intervals()`. model_error=True: parameters, states and
    force found together.
    """)


def page(rows: pd.DataFrame, fits: pd.DataFrame) -> str:
    """The page in Markdown.

    Args:
        rows: of `summary`.
        fits: a row per parameter of every fit, as `FitRow`.
    """
    seeds = f"Seeds {fits['seed'].min()} to {fits['seed'].max()}"
    commits = markdown.enumerated(sorted(set(fits["commit"].astype(str))))
    asked = rows[rows["scenario"].isin([*ASKED_FOR, UNDISTURBED])]
    parts = ["# Coverage of 95 % intervals under model error", ""]
    parts += [verdict(rows), "", verdict_table(rows, ASKED_FOR), ""]
    parts += [INTRODUCTION, "", NONLINEARITY, "", CELLS, ""]
    parts += [f"{seeds}; development used none above 320. Fits: commit {commits}.", ""]
    parts += [_missing(rows), "", "## Coverage in %", "", chance(rows), ""]
    parts += [coverage_table(asked), ""]
    if DRAWN in set(rows["scenario"]):
        parts += ["## By kind of nonlinearity", "", why_wide(rows), ""]
        parts += [by_kind(fits), ""]
    if set(FIXED) & set(rows["scenario"]):
        parts += [stress_test(rows, fits), ""]
    parts += ["## Root mean square of z", ""]
    parts += ["Distance from the truth over the standard error.", ""]
    parts += [numbers_table(rows, "rms_z", ".2f"), "", "## Widths", ""]
    parts += ["Median half width over that of the plain likelihood.", ""]
    parts += [numbers_table(_once(rows), "median_width_ratio", ".2f"), ""]
    parts += ["## Errors of the estimates", "", ERRORS, ""]
    parts += [numbers_table(rows, "rms_error", ".4f"), ""]
    parts += ["## Sources of the standard errors", "", _sources(_once(rows)), ""]
    parts += ["Coverage in % of the records where more than white noise was found", ""]
    parts += [numbers_table(rows, "coverage_if_more", ".1f"), ""]
    parts += ["and of those where it was not:", ""]
    parts += [numbers_table(rows, "coverage_if_white", ".1f"), ""]
    parts += ["## Without model error", "", *_undisturbed(rows)]
    return "\n".join(parts)


ERRORS = markdown.paragraph("""
    Root mean square, in N/m, N s/m and N/V. The plain likelihood's estimates are the
    default's.
    """)


def _missing(rows: pd.DataFrame) -> str:
    """Jobs without fits, and those with fewer than others."""
    n_all = int(rows["n"].max())
    absent: dict[str, list[str]] = {}
    fewer: dict[str, list[str]] = {}
    for job in jobs():
        found = rows[
            (rows["scenario"] == job.scenario)
            & (rows["runs"] == job.layout.runs)
            & (rows["method"] == job.method)
        ]
        way = f"{job.method}, {job.layout.runs} x {job.layout.samples}"
        if found.empty:
            absent.setdefault(way, []).append(job.scenario)
        elif found["n"].iloc[0] < n_all:
            way = f"{way}, n {found['n'].iloc[0]}"
            fewer.setdefault(way, []).append(job.scenario)
    sentences = [f"Not measured: {_ways(absent) or 'nothing'}."]
    if fewer:
        sentences.append(f"Cut short: {_ways(fewer)}.")
    failed = int(rows.drop_duplicates(_FIT)["n_failed"].sum())
    sentences.append(f"Fits that failed, counted as not holding: {failed}.")
    return " ".join(sentences)


def _ways(found: dict[str, list[str]]) -> str:
    """Every way with its scenarios, which go without saying where they are all."""
    said = []
    for way, scenarios in found.items():
        is_all = len(scenarios) == len(SCENARIOS)
        said.append(way if is_all else f"{way} ({'; '.join(scenarios)})")
    return ". ".join(said)


_FIT = ["scenario", "runs", "method"]


# --- tables


def _once(rows: pd.DataFrame) -> pd.DataFrame:
    """What does not depend on the truth."""
    return rows[rows["truth"] == PHYSICAL]


def _sources(rows: pd.DataFrame) -> str:
    """Shares of the seeds in percent."""
    header = ["beside the model", "runs", "method", "n", *(f"{s}, %" for s in SOURCES)]
    lines = []
    chosen = rows[rows["method"] != PLAIN].drop_duplicates(_FIT)
    for _, row in chosen.iterrows():
        runs = f"{row['runs']} x {row['samples']}"
        shares = [f"{row[source]:.1f}" for source in SOURCES]
        lines.append([row["scenario"], runs, row["method"], row["n"], *shares])
    return markdown.lines(header, lines)


def _undisturbed(rows: pd.DataFrame) -> list[str]:
    """Widths of the intervals where nothing is to be lost."""
    header = ["runs", "method", "parameter", "n", "median", "mean", "within 5 %, %"]
    lines = []
    is_chosen = (rows["scenario"] == UNDISTURBED) & (rows["method"] != PLAIN)
    for _, row in rows[is_chosen].iterrows():
        widths = [row["median_width_ratio"], row["mean_width_ratio"]]
        shown = [f"{width:.3f}" for width in widths]
        runs = f"{row['runs']} x {row['samples']}"
        head = [runs, row["method"], row["parameter"], row["n"]]
        lines.append([*head, *shown, f"{row['same_width']:.1f}"])
    text = "Half widths over those of the plain likelihood on the same record."
    return [text, "", markdown.lines(header, lines)]

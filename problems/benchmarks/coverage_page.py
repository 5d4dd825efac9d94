"""The page of the coverage benchmark: what holds and what does not, and the tables."""

from collections.abc import Callable

import numpy as np
import pandas as pd
from scipy.stats import binom

from problems.benchmarks.coverage_fits import (
    DEFAULT,
    LEVEL,
    MANY,
    ONE,
    SCENARIOS,
    SEVERAL,
    jobs,
)
from problems.benchmarks.coverage_summary import (
    LIMIT,
    METHODS,
    PHYSICAL,
    PLAIN,
    SAME_WIDTH,
    SOURCES,
)
from problems.benchmarks.disturbed_oscillator import TRUTH, cubic_coefficient
from problems.tools import markdown

LOWEST = 92.0  # %, of the coverage that is asked for
HIGHEST = 97.0
LAYOUTS = {"one run": ONE, "4 runs": SEVERAL, "16 runs": MANY}
UNDISTURBED = "none"

INTRODUCTION = markdown.paragraph("""
    An oscillator of 1 kg (k = 4 N/m, R_v = 0.3 N s/m, g = 1 N/V), driven by a known
    voltage of 1 V, its position measured every 0.1 s with noise of 0.02 m (position:
    0.45 m, both root mean square). The model has a linear spring, a linear damper and a
    gain; what the first column names acts beside it. OU: an Ornstein-Uhlenbeck force of
    that standard deviation and correlation time; the drive has 1 m/s^2. Cubic spring:
    with that share of the whole spring force, root mean square. Quantised: positions in
    steps of 0.2 m, about 12 levels. One run has 400 samples, 4 runs 200 each, 16 runs
    100 each.
    """)
TWO_TRUTHS = markdown.paragraph("""
    A cubic spring has two truths. Physical: the coefficients of the simulation, of
    which the linear stiffness is not what a linear spring would best be. Limit: the
    values to which the estimates tend as records of this kind grow (White, Econometrica
    50, 1982), by least squares on 1000 runs without noise.
    """)
CELLS = markdown.paragraph("""
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
    parts = ["# Coverage of 95 % intervals under model error", ""]
    parts += [reading(rows), "", INTRODUCTION, "", TWO_TRUTHS, "", CELLS, ""]
    parts += [f"{seeds}; development used none above 320. Fits: commit {commits}.", ""]
    parts += [_missing(rows), "", "## Coverage in %", "", _chance(rows), ""]
    parts += [_table(rows, _coverage), "", "## Root mean square of z", ""]
    parts += ["Distance from the truth over the standard error.", ""]
    parts += [_table(rows, _in("rms_z", ".2f")), "", "## Widths", ""]
    parts += ["Median half width over that of the plain likelihood.", ""]
    parts += [_table(_once(rows), _in("median_width_ratio", ".2f"), False), ""]
    parts += ["## Errors of the estimates", "", ERRORS, ""]
    parts += [_table(rows, _in("rms_error", ".4f")), ""]
    parts += ["## Sources of the standard errors", "", _sources(_once(rows)), ""]
    parts += ["Coverage in % of the records where more than white noise was found", ""]
    parts += [_table(rows, _in("coverage_if_more", ".1f")), ""]
    parts += ["and of those where it was not:", ""]
    parts += [_table(rows, _in("coverage_if_white", ".1f")), ""]
    parts += ["## Without model error", "", *_undisturbed(rows)]
    return "\n".join(parts)


ERRORS = markdown.paragraph("""
    Root mean square, in N/m, N s/m and N/V. The plain likelihood's estimates are the
    default's.
    """)


# --- in words


def reading(rows: pd.DataFrame) -> str:
    """What holds and what does not, for the first paragraph."""
    sentences = [
        f"Asked for: {LOWEST:g} to {HIGHEST:g} % under model error. Counted are the",
        "coverages of three parameters in every scenario that was not cut short.",
    ]
    is_whole = rows["n"] == rows["n"].max()
    disturbed = rows[is_whole & (rows["scenario"] != UNDISTURBED)]
    for name, layout in LAYOUTS.items():
        of_layout = disturbed[disturbed["runs"] == layout.runs]
        for method in METHODS:
            of_method = of_layout[of_layout["method"] == method]
            if not of_method.empty:
                sentences.append(f"{method}, {name}: {_verdict(of_method)}.")
    sentences.append(_nothing_lost(rows))
    return markdown.paragraph(" ".join(sentences))


def _verdict(rows: pd.DataFrame) -> str:
    """How many coverages keep the limits, for every truth, and which do not."""
    physical = rows[rows["truth"] == PHYSICAL]
    cubic = rows[rows["truth"] == LIMIT]
    is_cubic = physical["scenario"].isin(cubic["scenario"])
    said = [_kept(physical[~is_cubic], "")]
    if not cubic.empty:
        said.append(_kept(cubic, "cubic springs to their limit: "))
        said.append(_kept(physical[is_cubic], "to the physical values: "))
    return "; ".join(text for text in said if text)


def _kept(rows: pd.DataFrame, what: str) -> str:
    if rows.empty:
        return ""
    is_kept = rows["coverage"].between(LOWEST, HIGHEST)
    text = f"{what}{is_kept.sum()} of {len(rows)} coverages lie within"
    spread = f"{rows['coverage'].min():.0f} to {rows['coverage'].max():.0f} %"
    below = rows[rows["coverage"] < LOWEST]["scenario"].unique()
    above = rows[rows["coverage"] > HIGHEST]["scenario"].unique()
    said = [spread]
    if len(below):
        said.append(f"too low in {'; '.join(below)}")
    if len(above):
        said.append(f"too high in {'; '.join(above)}")
    return f"{text} ({', '.join(said)})"


def _nothing_lost(rows: pd.DataFrame) -> str:
    """Of the records without model error."""
    of_default = rows[(rows["scenario"] == UNDISTURBED) & (rows["method"] == DEFAULT)]
    if of_default.empty:
        return ""
    same = of_default.groupby("runs")["same_width"].min()
    mean = of_default.groupby("runs")["mean_width_ratio"].max()
    parts = []
    for name, layout in LAYOUTS.items():
        if layout.runs in same.index:
            parts.append(
                f"{name}: {same[layout.runs]:.0f} % of the half widths are within"
                f" {100 * SAME_WIDTH:g} % of the plain ones, whose mean they have"
                f" {mean[layout.runs]:.2f} times"
            )
    return (
        "Without model error the estimates of the default are those of the plain"
        " likelihood by construction; of the intervals, by the parameter where they"
        f" differ most: {'; '.join(parts)}."
    )


def _chance(rows: pd.DataFrame) -> str:
    """How often intervals that hold with 95 % would be found outside the limits."""
    n = int(rows["n"].max())
    lowest = int(np.ceil(LOWEST / 100 * n))
    highest = int(np.floor(HIGHEST / 100 * n))
    within = binom.cdf(highest, n, LEVEL) - binom.cdf(lowest - 1, n, LEVEL)
    return markdown.paragraph(f"""
        Of {n} records, intervals that hold with {100 * LEVEL:g} % exactly are counted
        within {LOWEST:g} to {HIGHEST:g} % in {100 * within:.0f} % of the cases: single
        coverages just outside are chance.
        """)


def _missing(rows: pd.DataFrame) -> str:
    """Jobs without fits, and those with fewer than others."""
    n_all = int(rows["n"].max())
    absent: dict[str, list[str]] = {}
    fewer: list[str] = []
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
            fewer.append(f"{way}, {job.scenario} (n {found['n'].iloc[0]})")
    said = []
    for way, scenarios in absent.items():
        said.append(f"{way} ({'; '.join(scenarios)})")
    sentences = [f"Not measured: {'. '.join(said) or 'nothing'}."]
    if fewer:
        sentences.append(f"Cut short: {'. '.join(fewer)}.")
    failed = int(rows.drop_duplicates(_FIT)["n_failed"].sum())
    sentences.append(f"Fits that failed, counted as not holding: {failed}.")
    return " ".join(sentences)


_FIT = ["scenario", "runs", "method"]


# --- tables


def _once(rows: pd.DataFrame) -> pd.DataFrame:
    """What does not depend on the truth."""
    return rows[rows["truth"] == PHYSICAL]


Cell = Callable[[pd.DataFrame], str]


def _in(column: str, form: str) -> Cell:
    """A cell with a column's numbers of all parameters."""

    def cell(found: pd.DataFrame) -> str:
        return _numbers(found, column, form)

    return cell


def _coverage(found: pd.DataFrame) -> str:
    return f"{_numbers(found, 'coverage', '.1f')} (n {found['n'].iloc[0]})"


def _numbers(found: pd.DataFrame, column: str, form: str) -> str:
    by_parameter = found.set_index("parameter")[column]
    if by_parameter.isna().all():
        return "-"
    return " / ".join(format(by_parameter[name], form) for name in TRUTH)


def _table(rows: pd.DataFrame, cell: Cell, has_truth: bool = True) -> str:
    """Scenarios, runs and truths in rows, methods in columns."""
    header = ["beside the model", "runs", *(["truth"] if has_truth else []), *METHODS]
    lines = []
    for scenario in SCENARIOS:
        for truth in (PHYSICAL, LIMIT):
            for layout in LAYOUTS.values():
                of_line = rows[
                    (rows["scenario"] == scenario)
                    & (rows["truth"] == truth)
                    & (rows["runs"] == layout.runs)
                ]
                if of_line.empty:
                    continue
                head = [scenario, f"{layout.runs} x {layout.samples}"]
                head += [truth] if has_truth else []
                lines.append([*head, *_cells(of_line, cell)])
    return markdown.lines(header, lines)


def _cells(rows: pd.DataFrame, cell: Cell) -> list[str]:
    cells = []
    for method in METHODS:
        found = rows[rows["method"] == method]
        cells.append("-" if found.empty else cell(found))
    return cells


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
    return [text, "", markdown.lines(header, lines), "", _cubics()]


def _cubics() -> str:
    parts = []
    for name, disturbance in SCENARIOS.items():
        if disturbance.cubic_share:
            coefficient = cubic_coefficient(disturbance.cubic_share)
            parts.append(f"{name}: {coefficient:.3f} N/m^3")
    return f"Coefficients of the cubic springs: {'; '.join(parts)}."

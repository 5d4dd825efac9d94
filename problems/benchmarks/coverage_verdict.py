"""Whether intervals hold as often as asked: a sentence and a small table."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.stats import binom

from problems.benchmarks.coverage_fits import DEFAULT, LEVEL, Layout
from problems.benchmarks.coverage_summary import (
    METHODS,
    PHYSICAL,
    SAME_WIDTH,
)
from problems.benchmarks.coverage_tables import ASKED_FOR, LAYOUTS, UNDISTURBED
from problems.tools import markdown
from problems.tools.intervals import wilson

LOWEST = 92.0  # %, of the coverage that is asked for
HIGHEST = 97.0


@dataclass(frozen=True, eq=False)
class Group:
    """The coverages of one method over records of one layout.

    Attributes:
        method: one of `METHODS`.
        layout: of the records.
        truth: what the intervals should hold.
        rows: of `summary`, as many seeds in each scenario.
    """

    method: str
    layout: Layout
    truth: str
    rows: pd.DataFrame

    @property
    def n_kept(self) -> int:
        """How many of the coverages lie within the limits."""
        return int(self.rows["coverage"].between(LOWEST, HIGHEST).sum())

    @property
    def n_by_chance(self) -> float:
        """How many would on average if all intervals held with 95 % exactly."""
        return len(self.rows) * chance_within(int(self.rows["n"].max()))

    @property
    def n_meeting(self) -> int:
        """Of how many the 95 % interval (Wilson) meets the limits."""
        meeting = 0
        for coverage, n in zip(self.rows["coverage"], self.rows["n"], strict=True):
            lower, upper = wilson(round(coverage / 100 * n), int(n))
            meeting += 100 * lower <= HIGHEST and 100 * upper >= LOWEST
        return meeting

    @property
    def below(self) -> str:
        """Scenarios with a coverage below the limits."""
        return self._named(self.rows["coverage"] < LOWEST)

    @property
    def above(self) -> str:
        """Scenarios with a coverage above them."""
        return self._named(self.rows["coverage"] > HIGHEST)

    def _named(self, is_meant: pd.Series) -> str:
        return "; ".join(self.rows[is_meant]["scenario"].unique()) or "-"


def groups(
    rows: pd.DataFrame, scenarios: Sequence[str], truth: str = PHYSICAL
) -> Iterator[Group]:
    """By layout and method; scenarios that were cut short are left out."""
    chosen = rows[rows["scenario"].isin(list(scenarios)) & (rows["truth"] == truth)]
    for layout in LAYOUTS.values():
        for method in METHODS:
            is_meant = (chosen["runs"] == layout.runs) & (chosen["method"] == method)
            found = chosen[is_meant]
            found = found[found["n"] == found["n"].max()]
            if not found.empty:
                yield Group(method, layout, truth, found)


def verdict(rows: pd.DataFrame) -> str:
    """What holds and what does not, in a few words."""
    found = list(groups(rows, ASKED_FOR))
    said = []
    for method in METHODS:
        of_method = [group for group in found if group.method == method]
        n = sum(len(group.rows) for group in of_method)
        if n:
            n_kept = sum(group.n_kept for group in of_method)
            said.append(f"{method} {n_kept} of {n}")
    sentences = [
        f"Asked for: {LOWEST:g} to {HIGHEST:g} % under model error, one run and",
        f"several. Coverages within: {', '.join(said) or 'none was measured'}.",
        _nothing_lost(rows),
    ]
    return markdown.paragraph(" ".join(sentences))


def verdict_table(
    rows: pd.DataFrame, scenarios: Sequence[str], truths: Sequence[str] = (PHYSICAL,)
) -> str:
    """How many coverages lie within, by method, runs and truth, and which do not."""
    header = ["method", "runs", "n", "within", "of exact intervals", "interval meets"]
    header += ["lowest, %", "highest, %"]
    header += ["too low in", "too high in"]
    header += ["truth"] if len(truths) > 1 else []
    lines = []
    for truth in truths:
        for group in groups(rows, scenarios, truth):
            coverage = group.rows["coverage"]
            line = [group.method, f"{group.layout.runs} x {group.layout.samples}"]
            line += [str(group.rows["n"].iloc[0])]
            line += [f"{group.n_kept} of {len(group.rows)}", f"{group.n_by_chance:.0f}"]
            line += [f"{group.n_meeting} of {len(group.rows)}"]
            line += [f"{coverage.min():.1f}", f"{coverage.max():.1f}"]
            line += [group.below, group.above]
            line += [truth] if len(truths) > 1 else []
            lines.append(line)
    return markdown.lines(header, lines)


def _nothing_lost(rows: pd.DataFrame) -> str:
    """Of the records without model error."""
    of_default = rows[(rows["scenario"] == UNDISTURBED) & (rows["method"] == DEFAULT)]
    if of_default.empty:
        return ""
    same = of_default.groupby("runs")["same_width"].min()
    parts = []
    for name, layout in LAYOUTS.items():
        if layout.runs in same.index:
            parts.append(f"{same[layout.runs]:.0f} % in {name}")
    return (
        "Without model error the default has the estimates of the plain likelihood, and"
        f" half widths within {100 * SAME_WIDTH:g} % of its own in"
        f" {markdown.enumerated(parts)}."
    )


def chance_within(n: int) -> float:
    """Chance that intervals of 95 % are counted within the limits on n records."""
    lowest = int(np.ceil(LOWEST / 100 * n))
    highest = int(np.floor(HIGHEST / 100 * n))
    return float(binom.cdf(highest, n, LEVEL) - binom.cdf(lowest - 1, n, LEVEL))


def chance(rows: pd.DataFrame) -> str:
    """How often intervals that hold with 95 % would be found outside the limits."""
    said = []
    for n in sorted(set(rows["n"]), reverse=True):
        said.append(f"{100 * chance_within(n):.0f} % of the cases with n {n}")
    return markdown.paragraph(f"""
        Intervals that hold with {100 * LEVEL:g} % exactly are counted within
        {LOWEST:g} to {HIGHEST:g} % in {markdown.enumerated(said)}: single coverages
        just outside are chance.
        """)

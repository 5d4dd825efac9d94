"""Does sparsity help? The verdicts of the readings, as a part of the page of grids."""

import numpy as np
import pandas as pd

from problems.thesis.grid_points import GRIDS, SPARSITY
from problems.thesis.grid_readings import AS_HERE
from problems.thesis.systems import SYSTEMS
from problems.tools import markdown

# Errors that differ by less than this factor count as neither better nor worse.
ALIKE = 1.5
THESIS = {
    "henon_heiles": "neither improves nor worsens",
    "schrodinger": "helps (error about 5 times smaller)",
    "mass_spring": "helps, L1 most",
    "tanks": "helps (error about 60 times smaller)",
}


def section(readings: pd.DataFrame) -> list[str]:
    """Question, verdicts, reason and all rows."""
    lines = ["## Does sparsity help?", ""]
    lines += [markdown.paragraph(QUESTION), "", markdown.table(verdicts(readings)), ""]
    lines += [_answer(readings), "", markdown.paragraph(WHY), "", _prices(readings)]
    lines += ["", *markdown.frame(readings.drop(columns="seconds"))]
    return lines


QUESTION = f"""
    The thesis concludes that sparsity improves three of the four systems and neither
    improves nor worsens Henon-Heiles. Below: gradient descent with the least sparsity
    (no L1, latest pruning), in the middle and with the most (largest L1, earliest
    pruning), for the readings that its text and its code allow. It helps where the most
    sparsity, or the middle, has an error more than {ALIKE:g} times smaller than the
    least; it hurts where both are more than {ALIKE:g} times larger or leave no model.
    """

WHY = """
    The weight of lambda is the reason. The price is the L1 penalty of the true H over
    the loss of a model with no term at all: above 1 the objective prefers to explain
    nothing, and what the loss brings back after the L1 is switched off (half of the
    epochs) has often been pruned for good. The thesis' code takes the mean over batch
    and states, its Eq. 5.6 the sum, which divides the price by the samples of a batch
    times the states; and the Schroedinger system of its text starts within +-1, that of
    its stored data within +-0.2, where its cubic rates are far smaller.
    """


def verdicts(readings: pd.DataFrame) -> pd.DataFrame:
    """A row per system and reading: errors by sparsity, and whether it helps."""
    rows = []
    for (name, reading), part in readings.groupby(["system", "reading"], sort=False):
        by = part.set_index("sparsity")["error"]
        row: dict[str, object] = {"system": SYSTEMS[str(name)].title}
        row["reading"] = reading
        missed = part.set_index("sparsity")["missed"]
        n_terms = len(SYSTEMS[str(name)].truth)
        for sparsity in SPARSITY:
            is_empty = missed[sparsity] == n_terms
            row[f"error, {sparsity}"] = _shown(by[sparsity], bool(is_empty))
        row["here"] = verdict(by)
        row["thesis"] = THESIS[str(name)]
        rows.append(row)
    return pd.DataFrame(rows)


def _shown(error: float, is_empty: bool) -> str:
    if np.isfinite(error):
        return f"{error:.2g}"
    return "all pruned" if is_empty else "diverges"


def verdict(errors: pd.Series) -> str:
    """Whether sparsity helps, from the errors by sparsity."""
    least = errors["least"]
    best = min(errors["middle"], errors["most"])
    if not np.isfinite(best):
        return "no model" if not np.isfinite(least) else "hurts"
    if not np.isfinite(least):
        return "helps (alone gives a model)"
    if best < least / ALIKE:
        return f"helps ({markdown.number(least / best)} times)"
    if best > least * ALIKE:
        return f"hurts ({markdown.number(best / least)} times)"
    return "neither"


def _answer(readings: pd.DataFrame) -> str:
    """How many systems it helps as in the grids, and in which readings the others."""
    helped = []
    elsewhere = []
    others = []
    for name, part in readings.groupby("system", sort=False):
        by = {}
        for reading, rows in part.groupby("reading", sort=False):
            by[str(reading)] = verdict(rows.set_index("sparsity")["error"])
        title = SYSTEMS[str(name)].title
        readings_that_help = [k for k, said in by.items() if said.startswith("helps")]
        if AS_HERE in readings_that_help:
            helped.append(title)
        elif readings_that_help:
            elsewhere.append(f"{title} ({'; '.join(readings_that_help)})")
        else:
            others.append(title)
    said = f"As in the grids it helps on {len(helped)} of {len(GRIDS)} systems"
    said += f" ({', '.join(helped)})." if helped else "."
    if elsewhere:
        said += f" Under another reading also on: {', '.join(elsewhere)}."
    if others:
        said += f" Under none: {', '.join(others)}."
    return said


def _prices(readings: pd.DataFrame) -> str:
    """The price of the largest weight by system and reading, in a sentence."""
    most = readings[readings["sparsity"] == SPARSITY[-1]]
    words = []
    for name, part in most.groupby("system", sort=False):
        prices = [
            f"{price:.2g} ({reading})"
            for price, reading in zip(part["price"], part["reading"], strict=True)
        ]
        words.append(f"{SYSTEMS[str(name)].title} {', '.join(prices)}")
    return f"Price of the largest lambda_H: {'; '.join(words)}."

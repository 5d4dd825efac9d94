"""Does sparsity help? The verdicts of the readings, as a part of the page of grids."""

import numpy as np
import pandas as pd

from problems.thesis.grid_points import GRIDS, OF_LEVELS, SPARSITY
from problems.thesis.grid_readings import AS_HERE, SUM, WIDE, WIDE_SUM
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


HELPS = "helps"
NEITHER = "neither"
EXPECTED = {
    "henon_heiles": NEITHER,
    "schrodinger": HELPS,
    "mass_spring": HELPS,
    "tanks": HELPS,
}
# Readings that belong together: of the Schroedinger system either data.
FAMILIES = {
    "the mean of the code": (AS_HERE, WIDE),
    "the sum of Eq. 5.6": (SUM, WIDE_SUM),
}


def section(table: pd.DataFrame, readings: pd.DataFrame) -> list[str]:
    """Question, verdicts, reason and all rows.

    Args:
        table: of the grids, with a row per point.
        readings: with a row per reading and point.
    """
    return [
        "## Does sparsity help?",
        "",
        markdown.paragraph(QUESTION),
        "",
        markdown.table(verdicts(readings)),
        "",
        _answer(readings),
        "",
        markdown.paragraph(WHY),
        "",
        _prices(readings),
        "",
        markdown.paragraph(APART),
        "",
        markdown.table(apart(table)),
        "",
        "All rows of the readings; price: see above.",
        "",
        *markdown.frame(readings.drop(columns=["seconds", OF_LEVELS])),
    ]


QUESTION = f"""
    The thesis concludes that sparsity improves three of the four systems and neither
    improves nor worsens Henon-Heiles. Below: gradient descent with the least sparsity
    (no L1, latest pruning), in the middle and with the most (largest L1, earliest
    pruning), for the readings that its text and its code allow. It helps where the most
    sparsity, or the middle, has an error more than {ALIKE:g} times smaller than the
    least; it hurts where both are more than {ALIKE:g} times larger or leave no model.
    """

WHY = """
    Where it hurts, the weight of lambda is the reason. The price is the L1 penalty of
    the true H over the loss of a model with no term at all: above 1 the objective
    prefers to explain nothing, and what the loss would bring back after the L1 is
    switched off (half of the epochs) has been pruned for good. The thesis' code takes
    the mean over batch and states, its Eq. 5.6 the sum, which divides the price by the
    samples of a batch times the states. And the Schroedinger system of the thesis' text
    starts within +-1, that of its stored data within +-0.2, where cubic rates are far
    smaller: with those data an L1 of these weights leaves nothing. With starts within
    +-1 the few epochs leave poor models, whose errors are as large as the states.
    """

APART = """
    L1 and pruning apart, in the grids: the error with neither (no L1, latest pruning),
    with one alone (largest L1; earliest pruning) and with both.
    """


def apart(table: pd.DataFrame) -> pd.DataFrame:
    """A row per system: errors of the descent with L1 and pruning alone."""
    rows = []
    for name, part in table[table["method"] == "descent"].groupby("system", sort=False):
        grid = GRIDS[str(name)]
        late = f"P = {max(grid.intervals)}"
        early = f"P = {min(grid.intervals)}"
        largest = max(grid.weights)
        chosen = {
            "neither": (0.0, late),
            f"L1 alone (lambda_H {largest:g})": (largest, late),
            "pruning alone": (0.0, early),
            "both": (largest, early),
        }
        row: dict[str, object] = {"system": SYSTEMS[str(name)].title}
        for words, (weight, pruning) in chosen.items():
            is_here = (part["lambda_H"] == weight) & (part["pruning"] == pruning)
            row[words] = _shown_row(part[is_here].iloc[0], str(name))
        rows.append(row)
    return pd.DataFrame(rows)


def _shown_row(row: pd.Series, name: str) -> str:
    is_empty = row["missed"] == len(SYSTEMS[name].truth)
    return _shown(float(row["error"]), bool(is_empty))


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
        return f"{HELPS} (alone gives a model)"
    if best < least / ALIKE:
        return f"{HELPS} ({markdown.number(least / best)} times)"
    if best > least * ALIKE:
        return f"hurts ({markdown.number(best / least)} times)"
    return NEITHER


def _answer(readings: pd.DataFrame) -> str:
    """How many systems it helps as in the grids, and which readings agree."""
    said_by = _verdicts_by_reading(readings)
    helped = []
    for name, by in said_by.items():
        if by[AS_HERE].startswith(HELPS):
            helped.append(SYSTEMS[name].title)
    text = f"As in the grids it helps on {len(helped)} of {len(said_by)} systems"
    text += f" ({', '.join(helped)})." if helped else "."
    agreeing = {family: _agreeing(said_by, family) for family in FAMILIES}
    for family, titles in agreeing.items():
        text += f" With {family} it is as the thesis says on {_listed(titles)}."
    if not any(len(titles) == len(said_by) for titles in agreeing.values()):
        text += " Neither gives the thesis' conclusion on all of them."
    return f"{text} (Of the Schroedinger system one of the two data sets suffices.)"


def _listed(titles: list[str]) -> str:
    return markdown.enumerated(titles) if titles else "no system"


def _verdicts_by_reading(readings: pd.DataFrame) -> dict[str, dict[str, str]]:
    """The verdict by system and reading."""
    found: dict[str, dict[str, str]] = {}
    for (name, reading), part in readings.groupby(["system", "reading"], sort=False):
        errors = part.set_index("sparsity")["error"]
        found.setdefault(str(name), {})[str(reading)] = verdict(errors)
    return found


def _agreeing(said_by: dict[str, dict[str, str]], family: str) -> list[str]:
    """Titles of the systems where a reading of a family says what the thesis says."""
    titles = []
    for name, by in said_by.items():
        said = [by[reading] for reading in FAMILIES[family] if reading in by]
        if any(one.startswith(EXPECTED[name]) for one in said):
            titles.append(SYSTEMS[name].title)
    return titles


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

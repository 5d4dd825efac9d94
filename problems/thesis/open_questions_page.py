"""The page results/thesis/open_questions.md, from the rows that were kept.

Every number of its sentences is counted from these rows.
"""

from collections.abc import Callable

import numpy as np
import pandas as pd

from problems.thesis.methods import SIGNIFICANCE
from problems.thesis.systems import SYSTEMS
from problems.tools import markdown
from problems.tools.intervals import share

# What is wanted, by question and answer, in the order of the page.
WANTED = {
    ("mass_spring_place", "place"): "force in p, and in no other equation",
    ("tanks_place", "place"): "force in tank 4, and in no other equation",
    ("large", "large"): "every superfluous term goes, no true one",
    ("guess", "small"): "the verdict says that something is missing",
    ("guess", "wrong"): "the verdict is missing: unexplained",
}
TITLES = {
    "place": "Where the external force acts is unknown",
    "large": "The dictionary is too large",
    "small": "The dictionary is too small",
    "wrong": "The dictionary is wrong",
}
HOW = {
    "place": markdown.paragraph(f"""
        The dictionary of the force stands on every equation, and pruning by size (the
        thesis' threshold) and by significance ({SIGNIFICANCE:g}, over the whole
        dictionary) takes out what the data do not need. Mass-spring: the thesis'
        dictionary (polynomials of the time to degree 3, a wave) on both equations.
        Tanks: on each of the nine equations 1, x^2 and x^3 of the equation's own state
        and the clipped x, whose limit is known. x itself is left out: on a pipe it is
        the damping. All trajectories of the thesis, PHSI loss.
        """),
    "large": markdown.paragraph("""
        The energy of Henon-Heiles is of degree 3, the dictionary of degree 4. Below it
        the dictionaries of the first question, which are too large too: here every
        superfluous term counts, those of the energy as well.
        """),
    "small": markdown.paragraph("""
        The model of the mass-spring has the true energies and losses and no force at
        all. It is fitted by maximum likelihood to three trajectories and diagnosed with
        two more held out, with the whole catalogue to choose from. The force's period,
        12.6, is longer than the record of 10: what swings so slowly is not named.
        """),
    "wrong": markdown.paragraph("""
        The same model and data, but the effects to choose from do not hold the true
        one: the catalogue without what swings by itself.
        """),
}


def page(rows: pd.DataFrame) -> str:
    """The page as Markdown."""
    parts = ["# Open questions of the thesis (its Section 6.6)", "", INTRODUCTION, ""]
    for answer, title in TITLES.items():
        parts += [f"## {title}", "", HOW[answer], ""]
        parts += [markdown.table(_shares(rows, answer)), "", _reading(rows, answer), ""]
    failed = rows[rows["answer"] == "failed"]
    for row in failed.itertuples():
        parts.append(f"- {row.ask}, draw {row.draw}: {row.said}")
    return "\n".join(parts)


INTRODUCTION = markdown.paragraph("""
    The thesis assumes that the place of the external force is known and says that one
    has to guess what belongs into the dictionary; it made no experiment on either.
    Shares of draws (new starts, new noise, sizes and noise of the thesis) with their 95
    % interval (Wilson).
    """)


def _of(rows: pd.DataFrame, ask: str, answer: str) -> pd.DataFrame:
    """The rows of a question; a draw that failed counts for each of its answers."""
    is_asked = rows["ask"] == ask
    return rows[is_asked & rows["answer"].isin([answer, "failed"])]


def _shares(rows: pd.DataFrame, answer: str) -> list[dict[str, object]]:
    """The table of one section."""
    table = []
    for (ask, kind), wanted in WANTED.items():
        part = _of(rows, ask, kind)
        if kind != answer or part.empty:
            continue
        table.append(_line(part, wanted, _right(part, kind)))
    if answer == "large":
        for ask in ("mass_spring_place", "tanks_place"):
            part = _of(rows, ask, "place")
            if len(part):
                table.append(_line(part, WANTED["large", "large"], _exact(part)))
    return table


def _line(part: pd.DataFrame, wanted: str, is_right: pd.Series) -> dict[str, object]:
    """One row: a share with n."""
    n = len(part)
    draws = f"{part['draw'].min()} to {part['draw'].max()}"
    return {
        "system": SYSTEMS[part["system"].iloc[0]].title,
        "wanted": wanted,
        "share of draws": share(int(is_right.sum()), n),
        "n": n,
        "draws": draws,
        "seconds of processor time": f"{part['seconds'].median():.2g}",
    }


def _right(part: pd.DataFrame, kind: str) -> pd.Series:
    if kind == "large":
        return _exact(part)
    return part["is_right"].astype(bool)


def _exact(part: pd.DataFrame) -> pd.Series:
    """Whether exactly the true terms stay."""
    return (part["superfluous"] == 0) & (part["missed"] == 0)


# --- the readings


def _reading(rows: pd.DataFrame, answer: str) -> str:
    read: dict[str, Callable[[pd.DataFrame], str]] = {
        "place": _of_places,
        "large": _of_terms,
        "small": lambda found: _of_verdicts(found, "small"),
        "wrong": lambda found: _of_verdicts(found, "wrong"),
    }
    return read[answer](rows)


def _of_places(rows: pd.DataFrame) -> str:
    """Where the force ended up, and what else was not as it should be."""
    said = []
    for ask in ("mass_spring_place", "tanks_place"):
        part = _of(rows, ask, "place")
        found = part["said"].fillna("nowhere").value_counts()
        counts = [f"{count} x {place}" for place, count in found.items()]
        if counts:
            missed = int((part["missed"] > 0).sum())
            title = SYSTEMS[part["system"].iloc[0]].title
            said.append(
                f"{title}: force found in {', '.join(counts)}; a true term is missed "
                f"in {missed} of {len(part)} draws."
            )
    return " ".join(said)


def _of_terms(rows: pd.DataFrame) -> str:
    """How many terms were too many, and how many of them stayed."""
    said = []
    for ask, kind in WANTED:
        part = _of(rows, ask, kind)
        if kind not in ("large", "place") or part["n_candidates"].isna().all():
            continue
        title = SYSTEMS[part["system"].iloc[0]].title
        most = np.nanmax(part["superfluous"])
        said.append(
            f"{title}: {part['n_candidates'].max():.0f} free numbers too many; of the "
            f"superfluous terms {part['superfluous'].mean():.2g} stay on average, "
            f"{most:.0f} at most."
        )
    return " ".join(said)


def _of_verdicts(rows: pd.DataFrame, answer: str) -> str:
    """Every verdict and the candidate in front, with their counts."""
    part = _of(rows, "guess", answer)
    if part.empty:
        return ""
    verdicts = _counts(part["said"])
    nearest = _counts(part["nearest"].fillna("none"))
    return f"Verdicts: {verdicts}. The candidate in front: {nearest}."


def _counts(texts: pd.Series) -> str:
    return ", ".join(f"{n} x {text}" for text, n in texts.value_counts().items())

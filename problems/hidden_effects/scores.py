"""What counts as right, and the lines of the page that say how often.

A tie counts as right where it is true; an effect from outside the catalogue that one of
its effects imitates is not counted.
"""

import pandas as pd

import phsi_opt as ph
from problems.hidden_effects.examination import DETECTED
from problems.hidden_effects.rows import ROWS, Row
from problems.tools.intervals import share

# Largest held-out error over the noise floor with the right effect in the model.
AT_FLOOR = 1.1
# Shares of right cases that are asked for: one hidden effect by noise, the other kinds
# of rows.
TARGETS = {0.01: 0.95, 0.03: 0.95, 0.1: 0.85}
OTHER_TARGETS = {
    "nothing": 0.95,
    "two": 0.9,
    "outside": 0.9,
    "sensor": 0.9,
    "tanks": 0.95,
}
TEXTS = ("first", "first_equation", "verdict", "added", "truth", "equation")


def scored(rows: pd.DataFrame) -> pd.DataFrame:
    """The cases with ``good``: right, or a tie that is declared and true.

    Cases that are imitated or not drawn are left out. A tie is true where the effect
    named explains the noise-free data to below what a test would detect. An effect from
    outside that a catalogue's effect imitates as closely is no effect from outside, and
    leaves the count.
    """
    is_alike = rows["misfit"] < DETECTED
    tie_true = rows["tie"].astype(bool) & is_alike
    good = rows["right"].astype(bool) | tie_true
    imitated = rows["row"].eq("outside") & is_alike
    drawn = ~rows["outcome"].astype(str).str.startswith("not drawn")
    rows = rows.assign(tie_true=tie_true, good=good)
    return rows[~imitated & drawn]


def share_right(kept: pd.DataFrame) -> str:
    """The share of good cases with its interval, from `scored` cases."""
    return share(int(kept["good"].sum()), len(kept))


def _share_of(values: pd.Series) -> str:
    known = values.dropna().astype(float)
    return share(int(known.sum()), len(known))


def summary_row(label: str, rows: pd.DataFrame, target: float) -> dict[str, object]:
    """A line of the page."""
    kept = scored(rows)
    right = kept["right"].astype(bool)
    is_tie = kept["tie_true"] & ~right
    # Where there is an effect to add; without one there is nothing after it.
    has_effect = right & ~kept["row"].isin(["nothing", "outside"])
    after = kept.loc[has_effect, "after"].dropna()
    is_met = len(kept) > 0 and kept["good"].sum() / len(kept) >= target
    return {
        "row": label,
        "cases": len(kept),
        "right": share_right(kept),
        "target": f"{target:.0%}",
        "met": "yes" if is_met else "no",
        "of these true ties": int(is_tie.sum()),
        "coefficient covered": _share_of(kept["covered"]),
        f"held-out at most {AT_FLOOR:g} x floor": _share_of(after <= AT_FLOOR),
        "error before / floor": f"{kept['base_error'].median():.1f}",
        "failed": int((kept["outcome"] != "examined").sum()),
        "seconds": f"{kept['seconds'].median():.1f}",
    }


def summary_line(name: str, rows: pd.DataFrame) -> str:
    """`summary_row` as one line of text."""
    row = summary_row(name, rows, target_of(ROWS[name]))
    return ", ".join(f"{key} {value}" for key, value in row.items())


def target_of(row: Row) -> float:
    """The share of right cases that is asked for."""
    return TARGETS[row.noise[0]] if row.kind == "one" else OTHER_TARGETS[row.kind]


def confusions(rows: pd.DataFrame) -> pd.DataFrame:
    """What came instead of the truth.

    Truth, verdict and name, number of cases, declared ties, true ties, misfit.
    """
    wrong = scored(rows)
    wrong = wrong[~wrong["right"].astype(bool)]
    for name in TEXTS:
        text = wrong[name].astype(object)
        wrong = wrong.assign(**{name: text.where(wrong[name].notna(), "")})
    wrong = wrong.assign(truth=_truths(wrong), came=_outcomes(wrong))
    counted = wrong.groupby(["truth", "came"]).agg(
        cases=("seed", "size"),
        declared_ties=("tie", "sum"),
        true_ties=("tie_true", "sum"),
        median_misfit=("misfit", "median"),
    )
    return counted.reset_index().sort_values(
        ["cases", "truth"], ascending=[False, True], ignore_index=True
    )


def _truths(wrong: pd.DataFrame) -> pd.Series:
    """What was hidden and where."""
    is_hidden = wrong["truth"].ne("")
    return (wrong["truth"] + " on " + wrong["equation"]).where(is_hidden, "nothing")


def _outcomes(wrong: pd.DataFrame) -> pd.Series:
    """What was named; else the verdict; of two effects what the study added."""
    first = wrong["first"] + " on " + wrong["first_equation"]
    verdict = wrong["verdict"].replace("", "failed")
    came = first.where(wrong["verdict"].eq(ph.Verdict.NAMED), verdict)
    added = "added: " + wrong["added"]
    return added.where(wrong["row"].eq("two_effects"), came)

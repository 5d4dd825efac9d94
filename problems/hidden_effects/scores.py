"""What counts as right, and the lines of the page that say how often."""

import pandas as pd
from scipy.stats import binomtest

from problems.hidden_effects.examination import DETECTED, NAMED
from problems.hidden_effects.rows import ROWS, Row

# largest held-out error over the noise floor with the right effect in the model
AT_FLOOR = 1.1


TARGETS = {0.01: 0.95, 0.03: 0.95, 0.1: 0.85}


OTHER_TARGETS = {
    "nothing": 0.95,
    "two": 0.9,
    "outside": 0.9,
    "sensor": 0.9,
    "tanks": 0.95,
}


def scored(rows: pd.DataFrame) -> pd.DataFrame:
    """The cases with ``good``: right, or a tie that is declared and true; without those
    that are imitated or not drawn.

    A tie is true where the effect named explains the noise-free data to below what a
    test would detect. An effect from outside that a catalogue's effect imitates as
    closely is no effect from outside, and leaves the count.
    """
    rows = rows.assign(tie_true=rows["tie"].astype(bool) & (rows["misfit"] < DETECTED))
    imitated = rows["row"].eq("outside") & (rows["misfit"] < DETECTED)
    drawn = ~rows["outcome"].astype(str).str.startswith("not drawn")
    rows = rows.assign(good=rows["right"].astype(bool) | rows["tie_true"])
    return rows[~imitated & drawn]


def share(count: int, n: int) -> str:
    """A share with its 95 % interval (Wilson)."""
    if n == 0:
        return "-"
    low, high = binomtest(count, n).proportion_ci(method="wilson")
    return f"{count / n:.0%} ({low:.0%} to {high:.0%})"


def _share_of(values: pd.Series) -> str:
    known = values.dropna().astype(float)
    return share(int(known.sum()), len(known))


def summary_row(label: str, rows: pd.DataFrame, target: float) -> dict[str, object]:
    """A line of the page."""
    kept = scored(rows)
    good, n = int(kept["good"].sum()), len(kept)
    is_named = kept["right"].astype(bool) & ~kept["row"].isin(
        ["nothing", "outside"]
    )  # where there is one to add
    after = kept.loc[is_named, "after"].dropna()
    return {
        "row": label,
        "cases": n,
        "right": share(good, n),
        "target": f"{target:.0%}",
        "met": "yes" if n and good / n >= target else "no",
        "of these true ties": int(
            (kept["tie_true"] & ~kept["right"].astype(bool)).sum()
        ),
        "coefficient covered": _share_of(kept["covered"]),
        f"held-out at most {AT_FLOOR:g} x floor": _share_of(after <= AT_FLOOR)
        if len(after)
        else "-",
        "error before / floor": f"{kept['base_error'].median():.1f}",
        "failed": int((kept["outcome"] != "examined").sum()),
        "seconds": f"{kept['seconds'].median():.1f}",
    }


def summary_line(name: str, rows: pd.DataFrame) -> str:
    return ", ".join(
        f"{key} {value}"
        for key, value in summary_row(name, rows, target_of(ROWS[name])).items()
    )


def target_of(row: Row) -> float:
    return TARGETS[row.noise[0]] if row.kind == "one" else OTHER_TARGETS[row.kind]


_TEXTS = ("first", "first_equation", "verdict", "added", "truth", "equation")


def confusions(rows: pd.DataFrame) -> pd.DataFrame:
    """What came instead of the truth: truth, verdict and name, number of cases,
    declared ties, true ties, misfit.
    """
    wrong = scored(rows)
    wrong = wrong[~wrong["right"].astype(bool)]
    wrong = wrong.assign(
        **{
            name: wrong[name].astype(object).where(wrong[name].notna(), "")
            for name in _TEXTS
        }
    )
    first = wrong["first"] + " on " + wrong["first_equation"]
    two = wrong["row"].eq("two_effects")
    came = first.where(
        wrong["verdict"].eq(NAMED), wrong["verdict"].replace("", "failed")
    )
    came = came.where(~two, "added: " + wrong["added"])
    truth = (wrong["truth"] + " on " + wrong["equation"]).where(
        wrong["truth"].ne(""), "nothing"
    )
    by = wrong.assign(truth=truth, came=came).groupby(["truth", "came"])
    counted = by.agg(
        cases=("seed", "size"),
        declared_ties=("tie", "sum"),
        true_ties=("tie_true", "sum"),
        median_misfit=("misfit", "median"),
    )
    return counted.reset_index().sort_values(
        ["cases", "truth"], ascending=[False, True], ignore_index=True
    )

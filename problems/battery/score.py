"""What counts as right, and the lines of the pages that say how often.

A tie counts as right where it is true; an effect from outside the catalogue that one of
its effects imitates is not counted.
"""

from collections.abc import Mapping

import pandas as pd

import phsi_opt as ph
from problems.battery.ask import CLASS, DETECTED, FALSE, NAME, NOTHING, SILENT
from problems.battery.draw import KINDS, ROWS
from problems.tools.intervals import share

# Largest held-out error over the noise floor with the right effect in the model.
AT_FLOOR = 1.1
Record = dict[str, object]

# --- hidden effects


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


def share_of(values: pd.Series) -> str:
    """The share of true values with its interval; unknown ones are not counted."""
    known = values.dropna().astype(float)
    return share(int(known.sum()), len(known))


def summary_row(label: str, rows: pd.DataFrame) -> Record:
    """A line of the page."""
    kept = scored(rows)
    right = kept["right"].astype(bool)
    is_tie = kept["tie_true"] & ~right
    # Where there is an effect to add; without one there is nothing after it.
    kinds = kept["row"].map(lambda name: ROWS[name].kind)
    has_effect = right & ~kinds.isin([*NOTHING, "outside"])
    after = kept.loc[has_effect, "after"].dropna()
    return {
        "row": label,
        "cases": len(kept),
        "right": share_of(kept["good"]),
        "of these true ties": int(is_tie.sum()),
        "coefficient covered": share_of(kept["covered"]),
        f"held-out at most {AT_FLOOR:g} x floor": share_of(after <= AT_FLOOR),
        "error before / floor": f"{kept['base_error'].median():.1f}",
        "failed": int((kept["outcome"] != "examined").sum()),
        "seconds": f"{kept['seconds'].median():.1f}",
    }


def hidden_rows(hidden: pd.DataFrame) -> list[Record]:
    """A line for all, for one effect, at each noise too, for each kind and effect."""
    kinds = hidden["row"].map(lambda name: ROWS[name].kind)
    one = hidden[kinds.eq("one")]
    by_effect = one["row"].map(lambda name: ROWS[name].effects[0])
    parts = [("all", hidden), ("one effect", one)]
    parts += [(f"one effect, noise {n:g}", rows) for n, rows in one.groupby("noise")]
    parts += [(str(k), rows) for k, rows in hidden[kinds.ne("one")].groupby(kinds)]
    parts += [(str(effect), rows) for effect, rows in one.groupby(by_effect)]
    return [summary_row(label, rows) for label, rows in parts]


def confusions(rows: pd.DataFrame) -> pd.DataFrame:
    """What came instead of the truth.

    Truth, verdict and name, number of cases, declared ties, true ties, misfit.
    """
    wrong = scored(rows)
    wrong = wrong[~wrong["right"].astype(bool)]
    names = ["first", "first_equation", "verdict", "added", "truth", "equation"]
    texts = wrong[names].astype(object).where(wrong[names].notna(), "")
    truth = (texts["truth"] + " on " + texts["equation"]).where(
        texts["truth"].ne(""), "nothing"
    )
    first = texts["first"] + " on " + texts["first_equation"]
    verdict = texts["verdict"].replace("", "failed")
    came = first.where(texts["verdict"].eq(ph.Verdict.NAMED), verdict)
    added = "added: " + texts["added"]
    came = added.where(wrong["row"].eq("two_effects"), came)
    counted = wrong.assign(truth=truth, came=came).groupby(["truth", "came"])
    table = counted.agg(
        cases=("seed", "size"),
        declared_ties=("tie", "sum"),
        true_ties=("tie_true", "sum"),
        median_misfit=("misfit", "median"),
    )
    ordered = table.reset_index().sort_values(
        ["cases", "truth"], ascending=[False, True], ignore_index=True
    )
    return ordered.round(1)


# --- machines of the field


def answers(title: str, rows: pd.DataFrame) -> Record:
    """A line: shares of each answer, and the median of the seconds."""
    record: Record = {"kind": title, "n": len(rows)}
    for each in (NAME, CLASS, FALSE, SILENT):
        record[each] = share_of(rows["answer"].eq(each))
    return record | {"median seconds": f"{rows['seconds'].median():.1f}"}


def by_kind(found: Mapping[str, pd.DataFrame]) -> list[Record]:
    """A line for each kind; two where in some of its cases nothing is to be named."""
    records = []
    for name, rows in found.items():
        named = rows["listed"].astype(bool)
        title = KINDS[name].title
        if named.any():
            records.append(answers(title, rows[named]))
        if not named.all():
            other = title if not named.any() else f"{title}, no name is right"
            records.append(answers(other, rows[~named]))
    everything = pd.concat(found.values(), ignore_index=True)
    listed = everything["listed"].astype(bool)
    records.append(answers("all with a name", everything[listed]))
    return [*records, answers("all without", everything[~listed])]


def by_noise(rows: pd.DataFrame) -> list[Record]:
    """A line for each noise level, where something is to be named."""
    listed = rows[rows["listed"].astype(bool)]
    return [
        answers(f"noise {100 * float(str(noise)):g} %", part)
        for noise, part in listed.groupby("noise")
    ]

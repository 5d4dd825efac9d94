"""The page results/solver_vs_gradient_descent.md, from the tables that are kept.

Every sentence that states a number computes it from the table it stands beside.
"""

import pandas as pd

from problems.thesis.systems import SYSTEMS
from problems.tools import markdown

# Seconds of the thesis' own code: its notebooks run unchanged on its data (Henon-Heiles
# clean with the rate of its appendix B), one thread of a machine with two shared cores,
# torch 2.13 in float32.
THESIS_CODE_SECONDS = {
    ("henon_heiles", "clean"): 183.0,
    ("henon_heiles", "noisy"): 145.0,
    ("schrodinger", "clean"): 916.0,
    ("schrodinger", "noisy"): 959.0,
    ("mass_spring", "clean"): 249.0,
    ("mass_spring", "noisy"): 240.0,
    ("tanks", "clean"): 539.0,
    ("tanks", "noisy"): 526.0,
}
ROUNDING = 1e-9  # relative difference at which two losses are the same
ERRORS = ["largest error", "relative error", "PHSI loss", "l2 inside", "l2 whole"]


def ratios(table: pd.DataFrame) -> pd.DataFrame:
    """A row per system and data: both methods' errors, losses and times.

    The solver is its first start, gradient descent the median or best of its starts.
    """
    rows = []
    for (system, kind), part in table.groupby(["system", "data"], sort=False):
        rows.append({"system": system, "data": kind, **_ratio_row(part)})
    return pd.DataFrame(rows)


def _ratio_row(part: pd.DataFrame) -> dict[str, object]:
    ours = part[part["method"] == "solver"].iloc[0]
    all_terms = part[part["method"] == "solver, all terms"].iloc[0]
    theirs = part[part["method"] == "descent"]
    best_loss = theirs["PHSI loss"].min()
    not_higher = all_terms["PHSI loss"] <= best_loss * (1 + ROUNDING)
    return {
        "error, solver": ours["largest error"],
        "error, descent": theirs["largest error"].median(),
        "error, best descent": theirs["largest error"].min(),
        "loss, pruned": ours["PHSI loss"],
        "loss, all terms": all_terms["PHSI loss"],
        "loss, best descent": best_loss,
        "not higher": bool(not_higher),
        "l2 whole, solver": ours["l2 whole"],
        "l2 whole, best descent": theirs["l2 whole"].min(),
        "times as fast": theirs["seconds"].median() / ours["seconds"],
    }


def page(table: pd.DataFrame) -> str:
    """The page that users read."""
    found = ratios(table)
    return "\n".join(
        [
            "# Solver against gradient descent",
            "",
            _introduction(table),
            "",
            f"**What it means.** {' '.join(reading(table, found))}",
            "",
            *markdown.block(_shown_ratios(found).to_string(index=False)),
            _caption(),
            "",
            "## Every run",
            "",
            *markdown.block(_shown_runs(table).to_string(index=False)),
        ]
    )


def _introduction(table: pd.DataFrame) -> str:
    both = table[table["method"].isin(["solver", "descent"])]
    starts = both.groupby(["system", "data", "method"])["start"].nunique()
    return markdown.paragraph(f"""
        The same pseudo-Hamiltonian model is identified from the same data by IPOPT
        (`identify`, `hybrid`) and by gradient descent (Algorithm 6 of the thesis in
        torch, with a vectorised dictionary and tuned settings, see
        `problems/thesis/systems.py`), each from {starts.min()} starts. All runs on a
        system ran one after the other in one process with one thread.
        """)


def reading(table: pd.DataFrame, found: pd.DataFrame) -> list[str]:
    """What the table says, in sentences."""
    n = len(found)
    better = int((found["error, solver"] <= found["error, descent"]).sum())
    not_higher = int(found["not higher"].sum())
    excess = found["loss, best descent"] / found["loss, all terms"] - 1
    return [
        f"On {better} of {n} data sets the largest coefficient error of the solver is "
        "at most that of the median start of gradient descent.",
        "Its PHSI loss with all terms, evaluated by one function for both, is not "
        "higher than that of the best start of gradient descent on "
        f"{not_higher} of {n}; that of gradient descent is larger by "
        f"{excess.median():.1%} in the median, by {excess.max():.0%} at most.",
        *_of_time(table, found),
        "This gradient descent was tuned, on draws that appear in no table; what the "
        "solver saves is the tuning: it has no rate, batch, number of epochs or decay, "
        "and one start is enough.",
    ]


def _of_time(table: pd.DataFrame, found: pd.DataFrame) -> list[str]:
    ratio = found["times as fast"]
    slower = found[ratio < 1]
    text = (
        f"It was {ratio.min():.1f} to {ratio.max():.1f} times as fast as one run of "
        "this gradient descent"
    )
    if len(slower):
        names = markdown.enumerated(slower["system"].unique())
        text += f", and slower on {len(slower)} data sets ({names})"
    thesis = pd.Series(THESIS_CODE_SECONDS)
    times = _times_of_thesis(table)
    return [
        f"{text}.",
        "The thesis' own code, whose dictionary is a Python loop, was measured at "
        f"{thesis.min():.0f} to {thesis.max():.0f} s for the same runs on another "
        f"machine: {times.min():.0f} to {times.max():.0f} times the solver's time "
        "here.",
    ]


def _times_of_thesis(table: pd.DataFrame) -> pd.Series:
    """Seconds of the thesis' code over those of the solver's first start."""
    solver = table[table["method"] == "solver"]
    times = []
    for (name, kind), seconds in THESIS_CODE_SECONDS.items():
        is_one = (solver["system"] == SYSTEMS[name].title) & (solver["data"] == kind)
        times += [seconds / ours for ours in solver.loc[is_one, "seconds"][:1]]
    return pd.Series(times, dtype=float)


def _caption() -> str:
    times = markdown.enumerated(f"{s.test_time:g}" for s in SYSTEMS.values())
    return markdown.paragraph(f"""
        Error: the largest absolute error of any coefficient, spurious and missed terms
        included. l2: norm of the error of free runs from unseen starts, over all
        states, averaged over time and runs; inside the training time and over the whole
        test time ({times}). Loss: mean squared defect of SRK4, networks included.
        Pruning raises the loss a little: it gives up what noise alone explains. Random
        starts of the solver leave out its convex program and its scan of frequencies,
        which are what finds the frequency of the mass-spring.
        """)


def _shown_ratios(found: pd.DataFrame) -> pd.DataFrame:
    shown = found.copy()
    for name in shown.columns[2:]:
        if name == "not higher":
            shown[name] = shown[name].astype(str)
        else:
            shown[name] = shown[name].map("{:.3g}".format)
    return shown


def _shown_runs(table: pd.DataFrame) -> pd.DataFrame:
    shown = table.copy()
    for name in ERRORS:
        shown[name] = shown[name].map("{:.3g}".format)
    shown["seconds"] = shown["seconds"].map("{:.1f}".format)
    return shown

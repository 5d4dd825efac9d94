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
SIZE = "size"  # the thesis' rule (Algorithm 6)
BOTH = "size and significance"
NO_RULE = "-"  # nothing is pruned
ALL_TERMS = "solver, all terms"
GROUP = ["system", "data", "method", "rule", "settings"]


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """A row per system, data, method, rule and settings; ``n`` runs from n starts."""
    rows = []
    for key, part in table.groupby(GROUP, sort=False):
        rows.append(
            {
                **dict(zip(GROUP, key, strict=True)),
                "n": len(part),
                "error, median": part["largest error"].median(),
                "error, first": part["largest error"].iloc[0],
                "error, worst": part["largest error"].max(),
                "spurious, first": part["spurious"].iloc[0],
                "spurious, most": part["spurious"].max(),
                "missed, most": part["missed"].max(),
                "loss, best": part["PHSI loss"].min(),
                "l2 whole, median": part["l2 whole"].median(),
                "seconds, median": part["seconds"].median(),
            }
        )
    return pd.DataFrame(rows)


def ratios(table: pd.DataFrame, rule: str = BOTH) -> pd.DataFrame:
    """A row per system and data: both methods' errors, losses and times, one rule.

    The solver is its first start, gradient descent (tuned) the median or best of its
    starts.
    """
    rows = []
    for (system, kind), part in table.groupby(["system", "data"], sort=False):
        rows.append({"system": system, "data": kind, **_ratio_row(part, rule)})
    return pd.DataFrame(rows)


def _ratio_row(part: pd.DataFrame, rule: str) -> dict[str, object]:
    of_rule = part[part["rule"] == rule]
    ours = of_rule[of_rule["method"] == "solver"].iloc[0]
    is_theirs = (of_rule["method"] == "descent") & (of_rule["settings"] == "tuned")
    theirs = of_rule[is_theirs]
    all_terms = part[part["method"] == ALL_TERMS].iloc[0]
    # Whatever its rule and settings.
    best_loss = part.loc[part["method"] == "descent", "PHSI loss"].min()
    not_higher = all_terms["PHSI loss"] <= best_loss * (1 + ROUNDING)
    return {
        "error, solver": ours["largest error"],
        "error, descent": theirs["largest error"].median(),
        "error, best descent": theirs["largest error"].min(),
        "wrong terms, solver": ours["spurious"] + ours["missed"],
        "wrong terms, descent": (theirs["spurious"] + theirs["missed"]).median(),
        "loss, pruned": ours["PHSI loss"],
        "loss, all terms": all_terms["PHSI loss"],
        "loss, best descent": best_loss,
        "not higher": bool(not_higher),
        "times as fast": theirs["seconds"].median() / ours["seconds"],
    }


def page(table: pd.DataFrame, quick: bool = False) -> str:
    """The page that users read; ``quick``: a run that shows only that it runs."""
    head = []
    if quick:
        head = [
            "**Quick mode: few data and two epochs. It shows that everything runs; its "
            "numbers compare nothing.**",
            "",
        ]
    else:
        head = [f"**What it means.** {' '.join(reading(table))}", ""]
    return "\n".join(
        [
            "# Solver against gradient descent",
            "",
            _introduction(table),
            "",
            *head,
            "## Both rules on both methods",
            "",
            *markdown.block(_shown(summary(table)).to_string(index=False)),
            _caption(),
            "",
            "## Every run",
            "",
            *markdown.block(_shown_runs(table).to_string(index=False)),
        ]
    )


def _introduction(table: pd.DataFrame) -> str:
    names = markdown.enumerated(table["system"].unique())
    return markdown.paragraph(f"""
        The same pseudo-Hamiltonian model is identified from the same data by IPOPT
        (`identify`, `hybrid`) and by gradient descent (Algorithm 6 of the thesis in
        torch, with slopes from CasADi): {names}. Both prune by both rules: "size"
        is the thesis' (a coefficient below the threshold goes), "{BOTH}" takes out as
        well what the data do not tell from zero; in the descent from half of the
        epochs on, with the same test. Settings "thesis" are those of its appendix B as
        printed (constant rate, weight decay 1e-4), "tuned" those of
        `problems/thesis/systems.py` and `methods.py`, tuned on a draw that appears in
        no table. BSI is the dictionary of right-hand sides, PHNN has networks for H and
        F. All runs on a system ran one after the other in one process with one thread,
        beside those of one other system.
        """)


def reading(table: pd.DataFrame) -> list[str]:
    """What the table says, in sentences."""
    found = ratios(table)
    n = len(found)
    not_higher = int(found["not higher"].sum())
    excess = found["loss, best descent"] / found["loss, all terms"] - 1
    return [
        *[_of_rule(table, rule) for rule in (SIZE, BOTH)],
        f"The PHSI loss of the solver with all terms, evaluated by one function for "
        "both, is not higher than that of the best run of gradient descent on "
        f"{not_higher} of {n} data sets; that of gradient descent is larger by "
        f"{100 * excess.median():.1f}% in the median, by {100 * excess.max():.0f}% at "
        "most.",
        _of_random_starts(table),
        _of_settings(table),
        *_of_time(table, found),
        "The solver has no rate, batch, number of epochs or decay to set.",
    ]


def _of_rule(table: pd.DataFrame, rule: str) -> str:
    """How both methods end with one rule of pruning."""
    found = ratios(table, rule)
    n = len(found)
    lower = int((found["error, solver"] <= found["error, descent"]).sum())
    ours = int((found["wrong terms, solver"] == 0).sum())
    theirs = int((found["wrong terms, descent"] == 0).sum())
    return (
        f"Pruned by {rule}, the largest coefficient error of the solver (first start) "
        f"is at most that of the median start of the tuned descent on {lower} of {n} "
        f"data sets; the solver has exactly the true terms on {ours}, the median start "
        f"of the descent on {theirs} of {n}."
    )


def _of_random_starts(table: pd.DataFrame) -> str:
    """How often either method finds exactly the true terms from random values."""
    is_random = table["start"].str.startswith("random") & (table["rule"] == BOTH)
    counts = []
    for method, name in (("solver", "the solver"), ("descent", "the tuned descent")):
        of_method = table[is_random & (table["method"] == method)]
        is_right = (of_method["spurious"] == 0) & (of_method["missed"] == 0)
        text = f"{name} in {is_right.sum()} of {len(of_method)} runs"
        wrong = of_method.loc[~is_right, "system"].unique()
        if len(wrong):
            text += f" (not always: {markdown.enumerated(wrong)})"
        counts.append(text)
    return (
        f"From random values, pruned by {BOTH}, exactly the true terms are found by "
        f"{markdown.enumerated(counts)}."
    )


def _of_settings(table: pd.DataFrame) -> str:
    """What tuning does for the descents, each from the thesis' starting values."""
    is_first = table["start"] == "thesis"
    texts = []
    for method in ("descent", "BSI, descent"):
        of_method = table[is_first & (table["method"] == method)]
        of_size = of_method[of_method["rule"] == SIZE]
        indexed = of_size.set_index(["system", "data", "settings"])
        by = indexed["largest error"].unstack()
        n_lower = int((by["thesis"] < by["tuned"]).sum())
        texts.append(f"{n_lower} of {len(by)} for {method}")
    return (
        "With the settings of the thesis (size, its starting values) the largest error "
        f"is lower than with the tuned ones on {markdown.enumerated(texts)}."
    )


def _of_time(table: pd.DataFrame, found: pd.DataFrame) -> list[str]:
    ratio = found["times as fast"]
    slower = found[ratio < 1]
    text = (
        f"With significance it took {1 / ratio.max():.2g} to {1 / ratio.min():.2g} "
        "times the processor time of one run of the tuned descent"
    )
    if len(slower):
        names = markdown.enumerated(slower["system"].unique())
        text += f", and was slower on {len(slower)} of {len(found)} ({names})"
    times = _times_of_thesis(table)
    return [
        f"{text}.",
        "The thesis' own code, whose dictionary is a Python loop, was measured on "
        f"another machine at {times.min():.0f} to {times.max():.0f} times the solver's "
        "time here, in seconds of the clock.",
    ]


def _times_of_thesis(table: pd.DataFrame) -> pd.Series:
    """Seconds of the thesis' code over those of the solver's first start."""
    is_ours = (table["method"] == "solver") & (table["rule"] == BOTH)
    solver = table[is_ours]
    times = []
    for (name, kind), seconds in THESIS_CODE_SECONDS.items():
        is_one = (solver["system"] == SYSTEMS[name].title) & (solver["data"] == kind)
        times += [seconds / ours for ours in solver.loc[is_one, "seconds"][:1]]
    return pd.Series(times, dtype=float)


def _caption() -> str:
    times = markdown.enumerated(f"{s.test_time:g}" for s in SYSTEMS.values())
    return markdown.paragraph(f"""
        n: runs, from as many starts. Error: the largest absolute error of any
        coefficient, spurious and missed terms included; that of BSI is of the
        coefficients of the right-hand sides. First: from the method's own start. l2:
        norm of the error of free runs from unseen starts, over all states, averaged
        over time and runs; inside the training time and over the whole test time
        ({times}). Loss: mean squared defect of SRK4, networks included; pruning raises
        it a little, since it gives up what noise alone explains. Seconds: of the
        processor; those of the likelihood come on top of the solver's. Random starts
        of the solver leave out its convex program and its scan of frequencies, which
        are what finds the frequency of the mass-spring. The weight decay of the thesis'
        text is what its settings lose on the first two systems: its code has none there
        (docs/thesis.md).
        """)


def _shown(found: pd.DataFrame) -> pd.DataFrame:
    """Numbers with three digits; what does not exist, as a dash."""
    shown = found.copy()
    for name in shown.columns[len(GROUP) + 1 :]:
        shown[name] = [_three_digits(value) for value in shown[name]]
    return shown


def _shown_runs(table: pd.DataFrame) -> pd.DataFrame:
    shown = table.copy()
    for name in [*ERRORS, "spurious", "missed"]:
        shown[name] = [_three_digits(value) for value in shown[name]]
    shown["seconds"] = shown["seconds"].map("{:.1f}".format)
    return shown


def _three_digits(value: float) -> str:
    return "-" if pd.isna(value) else f"{value:.3g}"

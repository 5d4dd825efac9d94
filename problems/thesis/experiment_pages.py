"""The pages that `experiments` writes: a reading with the numbers of the run, the
tables, the figures.
"""

from typing import Any

import numpy as np
import pandas as pd

from problems.thesis.systems import System, thesis_data_present

Tables = dict[str, pd.DataFrame]
HEADS = {
    "henon_heiles": "Henon-Heiles (thesis Section 6.1)",
    "schrodinger": "Nonlinear Schroedinger, two particles (thesis Section 6.2)",
    "mass_spring": "Forced and damped mass-spring (thesis Section 6.3)",
    "tanks": "Tanks and pipes with a leak (thesis Section 6.4)",
}
LIMITS = {
    "0.005": (0.005, 0.03),
    "0.03": (0.01, 0.10),
}  # worst H, worst r that were asked for
NOTES = {
    "henon_heiles": "The training data are single steps, so inside the training time means up to t = 0.1.",
    "schrodinger": "The first-order dictionary has degree 3, that of the energy degree 4.",
    "mass_spring": "SINDy and LASSO cannot learn a frequency (thesis Section 6.3) and get a wrong one, 1: alone a "
    "coefficient error of 0.5. The wave stands in the equation of p only. The thesis' Table 6.2 is on clean data; it "
    "is repeated beside the noisy ones.",
    "tanks": "The first-order dictionary (degree 1) has no term for the leak: what BSI, SINDy and LASSO put into the "
    "equation of mu4 counts as spurious. Standard errors of the solver's hybrid leave out the network; those of the "
    "likelihood, which has twelve hinges and a line in its place, do not.",
}


def page(system: System, tables: Tables, figures: list[tuple[str, str]]) -> str:
    """The page of one system."""
    scores: Any = tables[f"{system.name}, scores"]
    source = (
        "Data of the thesis."
        if thesis_data_present()
        else "Data drawn anew from the thesis' distributions."
    )
    said = [f"- {line}" for line in reading(system, tables)]
    parts = [
        f"# {HEADS[system.name]}",
        "",
        f"{source} {_plain(system)}",
        "",
        "**What it means.**",
        "",
        *said,
        "",
    ]
    parts += ["## Every method", "", *_block(_shown(scores)), "", _caption(system), ""]
    failed = scores[scores["reason"] != ""]
    parts += [f"- {r.method}, {r.data}: {r.reason}" for r in failed.itertuples()] + (
        [""] if len(failed) else []
    )
    for name, table in tables.items():
        if "coefficients" in name or "first order" in name:
            kind = name.rsplit(", ", 1)[1]
            what = "the right-hand side" if "first order" in name else "H, R and F"
            parts += [f"## Coefficients of {what}, {kind} data", "", *_block(table), ""]
    if any("coefficients" in name for name in tables):
        parts += [
            "+-: standard error. 0: the term is not there. Thesis: as printed there, from its own run.",
            "",
        ]
    if "tanks, checks" in tables and system.name == "tanks":
        parts += [
            "## Claims about the tanks, in numbers",
            "",
            *_block(_percent(tables["tanks, checks"])),
            "",
            CHECKS,
            "",
        ]
    if f"{system.name}, steps" in tables:
        parts += [
            "## What the integrator allows: exact data at two steps, solver",
            "",
            *_block(_rounded(tables[f"{system.name}, steps"])),
            "",
        ]
    for name, caption in figures:
        parts += [f"![{system.title}]({name})", "", caption, ""]
    return "\n".join(parts)


CHECKS = (
    "Worst relative error of the nine H and of the five r; error of the leak over the levels of tank 4 in the training "
    "data as a share of its range 6, over all of them and over the central 95 %; l2 error (in the units of the states) "
    "with the leak shut, 30 unseen starts to t = 1. Noise 0.03 is a new draw (seed 0)."
)


def _plain(system: System) -> str:
    return f"Noise {system.noise:g} in the noisy ones. Free runs from 30 unseen starts to t = {system.test_time:g}."


def _caption(system: System) -> str:
    return (
        "Largest error: of any coefficient, spurious and missed terms included; relative error: the worst true term. "
        "The coefficients of PHSI, SSINN (of H, R, F) and of BSI, SINDy, LASSO (of the right-hand side) are not the "
        "same. SSINN prunes nothing. l2: norm of the error over all states, averaged over time and starts; inf: at "
        "least one start diverges; example: along the trajectory of the figure. The time of the likelihood is beside "
        f"the solver's, that of LASSO has the search of its weight. {NOTES[system.name]}"
    )


# --- the reading


def reading(system: System, tables: Tables) -> list[str]:
    """Sentences whose every claim is a comparison of this run's numbers."""
    scores: Any = tables[f"{system.name}, scores"]
    by: Any = {kind: part.set_index("method") for kind, part in scores.groupby("data")}
    clean, noisy = by["clean"], by["noisy"]
    names = [f"PHSI, {m}" for m in ("solver", "likelihood", "descent")]
    said = [
        "Largest coefficient error of solver, likelihood and descent: "
        + "; ".join(
            f"{_list(part, names, 'largest error')} on {kind} data"
            for kind, part in by.items()
        )
        + ".",
        *[_ranking(part, kind) for kind, part in by.items()],
        _example(system, noisy),
        _selection(noisy),
        f"Seconds on the noisy data: solver {_g(noisy.at[names[0], 'seconds'])}, descent "
        f"{_g(noisy.at[names[2], 'seconds'])}, likelihood {_g(noisy.at[names[1], 'seconds'])} after the solver.",
    ]
    step = tables.get(f"{system.name}, steps")
    if step is not None:
        first, half = step["relative error"]
        text = f"Exact data: the solver's worst relative error is {_g(first)} at the thesis' step, {_g(half)} at half"
        if max(first, half) < 1e-10:  # the data are computed to 1e-12
            said.append(
                f"{text} of it: both are the accuracy to which the data were computed."
            )
        else:
            said.append(
                f"{text} of it, a ratio of {first / half:.2g} (16 if the order 4 of the integrator were all)."
            )
    return said + SPECIFIC[system.name](clean, noisy, tables)


def _example(system: System, noisy: Any) -> str:
    """The one trajectory that the thesis shows."""
    l2 = noisy["l2 example"].dropna().sort_values()
    own = l2["PHSI, solver"]
    where = (
        "outside the training range " if system.name in ("tanks", "schrodinger") else ""
    )
    return (
        f"The thesis' own start {where}(figure), noisy data: the smallest error is that of {l2.index[0]} "
        f"({_g(l2.iloc[0])}); the solver has {_g(own)}, place {1 + int((l2 < own).sum())} of {len(l2)}."
    )


def _ranking(part: Any, kind: str) -> str:
    """Who predicts best and worst, and who does better than the solver."""
    l2 = part["l2 whole"].dropna()
    finite = l2[np.isfinite(l2)].sort_values()
    own = l2["PHSI, solver"]
    better = [f"{m} ({_g(v)})" for m, v in finite.items() if v < 0.95 * own]
    text = f"Free runs, {kind} data: the solver has {_g(own)} ("
    text += (
        f"smaller by more than 5 %: {', '.join(better)}"
        if better
        else "none is smaller by more than 5 %"
    )
    text += f"); the largest finite error is that of {finite.index[-1]} ({_g(finite.iloc[-1])})"
    lost = [
        f"{m} ({int(part.at[m, 'diverged'])} of 30 starts)"
        for m in l2.index[~np.isfinite(l2)]
    ]
    return text + (
        f", and {', '.join(lost)} {'diverges' if len(lost) == 1 else 'diverge'}."
        if lost
        else "."
    )


def _selection(noisy: Any) -> str:
    rows = [
        (m, r["spurious"], r["missed"])
        for m, r in noisy.iterrows()
        if m != "PHNN" and r["reason"] == ""
    ]
    exact = [str(m) for m, s, missed in rows if s == 0 and missed == 0]
    wrong = [
        f"{m} {int(s)}/{int(missed)}"
        for m, s, missed in rows
        if (s or missed) and "PHSI" in str(m)
    ]
    text = f"Exactly the true terms, noisy data: {'; '.join(exact) or 'none'}"
    return text + (f". Spurious/missed terms: {', '.join(wrong)}." if wrong else ".")


def _henon_heiles(clean: Any, noisy: Any, tables: Tables) -> list[str]:
    ours, other = noisy.at["PHSI, solver", "l2 whole"], noisy.at["SSINN", "l2 whole"]
    return [
        f"The thesis has SSINN an order of magnitude behind PHSI; with its author's schedule of steps it is "
        f"{other / ours:.2g} times here."
    ]


def _schrodinger(clean: Any, noisy: Any, tables: Tables) -> list[str]:
    errors = {m: noisy.at[f"{m}, solver", "largest error"] for m in ("PHSI", "BSI")}
    return [
        f"The thesis reaches a precision of 0.1 with PHSI on noisy data and 1 or worse with SINDy and BSI; here "
        f"PHSI by the solver has {_g(errors['PHSI'])}, BSI by the solver {_g(errors['BSI'])}, STLSQ "
        f"{_g(noisy.at['SINDy, STLSQ', 'largest error'])}."
    ]


def _mass_spring(clean: Any, noisy: Any, tables: Tables) -> list[str]:
    said = []
    for m in ("PHSI, solver", "BSI, solver", "BSI, descent", "PHNN"):
        inside, whole = noisy.at[m, "l2 inside"], noisy.at[m, "l2 whole"]
        said.append(f"{m} {_g(inside)} and {_g(2 * whole - inside)}")
    return [
        "The training ends at t = 10; l2 error before and after it (noisy data; half of the samples each): "
        + "; ".join(said)
        + "."
    ]


def _tanks(clean: Any, noisy: Any, tables: Tables) -> list[str]:
    if "tanks, checks" not in tables:
        return []
    said = []
    for row in tables["tanks, checks"].to_dict("records"):
        if row["method"] == "PHSI, descent":
            continue
        limits = LIMITS[row["noise"]]
        verdicts = [
            f"{what} {100 * row[f'worst {what}']:.2g} % ({'within' if row[f'worst {what}'] <= limit else 'above'} "
            f"{100 * limit:g} %)"
            for what, limit in zip(("H", "r"), limits, strict=True)
        ]
        of_leak = f"leak {100 * row['leak rms']:.2g} % rms and {100 * row['leak largest']:.2g} % at most of its range"
        said.append(
            f"{row['method']} at noise {row['noise']}: {', '.join(verdicts)}, {of_leak}"
        )
    return ["Worst relative errors: " + "; ".join(said) + "."]


SPECIFIC = {
    "henon_heiles": _henon_heiles,
    "schrodinger": _schrodinger,
    "mass_spring": _mass_spring,
    "tanks": _tanks,
}


# --- formats


def _g(value: float) -> str:
    return f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}"


def _list(part: Any, names: list[str], column: str) -> str:
    return ", ".join(
        _g(part.at[m, column]) if np.isfinite(part.at[m, column]) else "-"
        for m in names
    )


def _shown(scores: pd.DataFrame) -> pd.DataFrame:
    table = scores.drop(columns=["system", "reason"]).copy()
    network = table["method"] == "PHNN"
    for name in ("spurious", "missed", "diverged"):
        table[name] = [("-" if np.isnan(v) else str(int(v))) for v in table[name]]
    for name in ("spurious", "missed"):
        table.loc[network, name] = "-"
    table["seconds"] = table["seconds"].map(
        lambda v: "-" if np.isnan(v) else f"{v:.1f}"
    )
    return _rounded(table)


def _percent(table: pd.DataFrame) -> pd.DataFrame:
    shown = table.copy()
    for name in shown.columns[2:-1]:
        shown[name] = shown[name].map(lambda v: f"{100 * v:.2g} %")
    return _rounded(shown)


def _rounded(table: pd.DataFrame) -> pd.DataFrame:
    shown = table.copy()
    for name in shown.columns:
        if shown[name].dtype == float:
            shown[name] = shown[name].map(lambda v: "-" if np.isnan(v) else f"{v:.3g}")
    return shown


def _block(table: Any) -> list[str]:
    return ["```text", table.to_string(index=False), "```"]

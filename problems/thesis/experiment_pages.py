"""The pages that `experiments` writes: a reading with the numbers of the run, the
tables, the figures.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from problems.thesis import published
from problems.thesis.experiment_tables import (
    DESCENT,
    LEAK_RANGE,
    LIKELIHOOD,
    N_TESTS,
    SOLVER,
)
from problems.thesis.figures import CENTRAL, Figure
from problems.thesis.methods import WRONG_FREQUENCY
from problems.thesis.scores import trained
from problems.thesis.systems import FLOWS, LEVELS, OMEGA, System, thesis_data_present
from problems.tools import markdown
from problems.tools.markdown import number

Tables = dict[str, pd.DataFrame]
HEADS = {
    "henon_heiles": "Henon-Heiles (thesis Section 6.1)",
    "schrodinger": "Nonlinear Schroedinger, two particles (thesis Section 6.2)",
    "mass_spring": "Forced and damped mass-spring (thesis Section 6.3)",
    "tanks": "Tanks and pipes with a leak (thesis Section 6.4)",
}
# Largest relative errors of H and of the pipes' damping r that are asked for, by noise.
ASKED = {
    "0.005": {"H": 0.005, "r": 0.03},
    "0.03": {"H": 0.01, "r": 0.10},
}
CLEARLY = 0.05  # a free-run error is smaller where it is so by this share
EXACT = 1e-10  # the data are computed to 1e-12
OWN = (SOLVER, LIKELIHOOD, DESCENT)
COUNTS = ["spurious", "missed", "diverged"]


def page(system: System, tables: Tables, drawn: Sequence[Figure]) -> str:
    """The page of one system."""
    parts = [f"# {HEADS[system.name]}", "", _introduction(system), ""]
    parts += ["**What it means.**", ""]
    parts += [f"- {line}" for line in reading(system, tables)]
    parts += ["", *_every_method(system, tables), *_coefficients(tables)]
    if "tanks, checks" in tables:
        parts += ["## Claims about the tanks, in numbers", ""]
        parts += [*_block(_percent(tables["tanks, checks"])), CHECKS, ""]
    steps = tables.get(f"{system.name}, steps")
    if steps is not None:
        parts += ["## What the integrator allows: exact data at two steps, solver", ""]
        parts += _block(_rounded(steps))
    for figure in drawn:
        parts += [f"![{system.title}]({figure.name})", "", figure.caption, ""]
    return "\n".join(parts)


def _introduction(system: System) -> str:
    source = "Data drawn anew from the thesis' distributions."
    if thesis_data_present():
        source = "Data of the thesis."
    return markdown.paragraph(f"""
        {source} Noise {system.noise:g} in the noisy ones. Free runs from {N_TESTS}
        unseen starts to t = {system.test_time:g}.
        """)


def _every_method(system: System, tables: Tables) -> list[str]:
    scores: Any = tables[f"{system.name}, scores"]
    parts = ["## Every method", "", *_block(_shown(scores)), _caption(system), ""]
    failed = scores[scores["reason"] != ""]
    for row in failed.itertuples():
        parts.append(f"- {row.method}, {row.data}: {row.reason}")
    return [*parts, ""] if len(failed) else parts


def _coefficients(tables: Tables) -> list[str]:
    parts = []
    for name, table in tables.items():
        is_first_order = "first order" in name
        if is_first_order or "coefficients" in name:
            what = "the right-hand side" if is_first_order else "H, R and F"
            kind = name.rsplit(", ", 1)[1]
            parts += [f"## Coefficients of {what}, {kind} data", "", *_block(table)]
    if not parts:
        return []
    text = "+-: standard error. 0: the term is not there. "
    return [*parts, f"{text}Thesis: as printed there, from its own run.", ""]


CHECKS = markdown.paragraph(f"""
    Worst relative error of the {len(FLOWS + LEVELS)} H and of the {len(FLOWS)} r; error
    of the leak over the levels of tank 4 in the training data as a share of its range
    {LEAK_RANGE:g}, over all of them and over the central {CENTRAL[1] - CENTRAL[0]:.0%};
    l2 error (in the units of the states) with the leak shut, {N_TESTS} unseen starts to
    t = 1. Noise {published.TANK_NOISE:g} is a new draw (seed 0).
    """)


def _caption(system: System) -> str:
    return markdown.paragraph(f"""
        Largest error: of any coefficient, spurious and missed terms included; relative
        error: the worst true term. The coefficients of PHSI, SSINN (of H, R, F) and of
        BSI, SINDy, LASSO (of the right-hand side) are not the same. SSINN prunes
        nothing. l2: norm of the error over all states, averaged over time and starts;
        inf: at least one start diverges; example: along the trajectory of the figure.
        The time of the likelihood is beside the solver's, that of LASSO has the search
        of its weight. {_note(system)}
        """)


def _note(system: System) -> str:
    """What is special about a system."""
    if system.name == "henon_heiles":
        end = system.n_steps * system.step
        return (
            "The training data are single steps, so inside the training time means up "
            f"to t = {end:g}."
        )
    if system.name == "schrodinger":
        return "The first-order dictionary has degree 3, that of the energy degree 4."
    if system.name == "mass_spring":
        off = abs(WRONG_FREQUENCY - OMEGA)
        return (
            "SINDy and LASSO cannot learn a frequency (thesis Section 6.3) and get a "
            f"wrong one, {WRONG_FREQUENCY:g}: alone a coefficient error of {off:g}. "
            "The wave stands in the equation of p only. The thesis' Table 6.2 is on "
            "clean data; it is repeated beside the noisy ones."
        )
    return (
        "The first-order dictionary (degree 1) has no term for the leak: what BSI, "
        "SINDy and LASSO put into the equation of mu4 counts as spurious. Standard "
        "errors of the solver's hybrid leave out the network; those of the likelihood, "
        "which has hinges and a line in its place, do not."
    )


# --- the reading


def reading(system: System, tables: Tables) -> list[str]:
    """Sentences whose every claim is a comparison of this run's numbers."""
    scores: Any = tables[f"{system.name}, scores"]
    by: dict[str, Any] = {}
    for kind, part in scores.groupby("data"):
        by[str(kind)] = part.set_index("method")
    noisy = by["noisy"]
    said = [_largest_errors(by)]
    said += [_ranking(part, kind) for kind, part in by.items()]
    said += [_example(system, noisy), _selection(noisy), _times(noisy)]
    steps: Any = tables.get(f"{system.name}, steps")
    if steps is not None:
        said.append(_of_steps(steps))
    said += _beside_the_thesis(system, noisy)
    if "tanks, checks" in tables:
        said.append(_of_tanks(tables["tanks, checks"]))
    return said


def _largest_errors(by: dict[str, Any]) -> str:
    said = []
    for kind, part in by.items():
        errors = [part.at[label, "largest error"] for label in OWN]
        shown = [number(error) if np.isfinite(error) else "-" for error in errors]
        said.append(f"{', '.join(shown)} on {kind} data")
    return (
        f"Largest coefficient error of solver, likelihood and descent: "
        f"{'; '.join(said)}."
    )


def _times(noisy: Any) -> str:
    solver, likelihood, descent = (number(noisy.at[m, "seconds"]) for m in OWN)
    return (
        f"Seconds on the noisy data: solver {solver}, descent {descent}, "
        f"likelihood {likelihood} after the solver."
    )


def _of_steps(steps: Any) -> str:
    first, half = steps["relative error"]
    text = (
        f"Exact data: the solver's worst relative error is {number(first)} at the "
        f"thesis' step, {number(half)} at half of it"
    )
    if max(first, half) < EXACT:
        return f"{text}: both are the accuracy to which the data were computed."
    return (
        f"{text}, a ratio of {first / half:.2g} (16 if the order 4 of the integrator "
        "were all)."
    )


def _example(system: System, noisy: Any) -> str:
    """The one trajectory that the thesis shows."""
    l2 = noisy["l2 example"].dropna().sort_values()
    own = l2[SOLVER]
    is_outside = system.name in ("tanks", "schrodinger")
    where = "outside the training range " if is_outside else ""
    place = 1 + int((l2 < own).sum())
    return (
        f"The thesis' own start {where}(figure), noisy data: the smallest error is "
        f"that of {l2.index[0]} ({number(l2.iloc[0])}); the solver has {number(own)}, "
        f"place {place} of {len(l2)}."
    )


def _ranking(part: Any, kind: str) -> str:
    """Who predicts best and worst, and who does better than the solver."""
    l2 = part["l2 whole"].dropna()
    finite = l2[np.isfinite(l2)].sort_values()
    own = l2[SOLVER]
    better = [
        f"{method} ({number(error)})"
        for method, error in finite.items()
        if error < (1 - CLEARLY) * own
    ]
    smaller = f"none is smaller by more than {CLEARLY:.0%}"
    if better:
        smaller = f"smaller by more than {CLEARLY:.0%}: {', '.join(better)}"
    text = (
        f"Free runs, {kind} data: the solver has {number(own)} ({smaller}); the "
        f"largest finite error is that of {finite.index[-1]} "
        f"({number(finite.iloc[-1])})"
    )
    lost = [
        f"{method} ({int(part.at[method, 'diverged'])} of {N_TESTS} starts)"
        for method in l2.index[~np.isfinite(l2)]
    ]
    if not lost:
        return f"{text}."
    verb = "diverges" if len(lost) == 1 else "diverge"
    return f"{text}, and {', '.join(lost)} {verb}."


def _selection(noisy: Any) -> str:
    """Who found exactly the true terms, and what the others missed."""
    exact = []
    wrong = []
    for method, row in noisy.iterrows():
        if str(method).startswith("PHNN") or row["reason"] != "":
            continue
        if row["spurious"] == 0 and row["missed"] == 0:
            exact.append(str(method))
        elif "PHSI" in str(method):
            wrong.append(f"{method} {int(row['spurious'])}/{int(row['missed'])}")
    text = f"Exactly the true terms, noisy data: {'; '.join(exact) or 'none'}"
    if not wrong:
        return f"{text}."
    return f"{text}. Spurious/missed terms: {', '.join(wrong)}."


def _beside_the_thesis(system: System, noisy: Any) -> list[str]:
    """What the thesis claims of this system, and the same here."""
    if system.name == "henon_heiles":
        ratio = noisy.at["SSINN", "l2 whole"] / noisy.at[SOLVER, "l2 whole"]
        return [
            f"The thesis has SSINN {published.SSINN_BEHIND} behind PHSI; with its "
            f"author's schedule of steps it is {ratio:.2g} times here."
        ]
    if system.name == "schrodinger":
        largest = noisy["largest error"].map(number)
        claims = [f"{error} with {m}" for m, error in published.PRECISION.items()]
        return [
            "The thesis reaches, on noisy data, a precision of "
            f"{' and '.join(claims)}; here PHSI by the solver has {largest[SOLVER]}, "
            f"BSI by the solver {largest['BSI, solver']}, "
            f"STLSQ {largest['SINDy, STLSQ']}."
        ]
    if system.name == "mass_spring":
        return [_before_and_after(system, noisy)]
    return []


def _before_and_after(system: System, noisy: Any) -> str:
    said = []
    t, _ = system.tests(0)
    share = trained(system, t).mean()
    for method in (SOLVER, "BSI, solver", "BSI, descent", "PHNN"):
        inside = noisy.at[method, "l2 inside"]
        after = (noisy.at[method, "l2 whole"] - share * inside) / (1 - share)
        said.append(f"{method} {number(inside)} and {number(after)}")
    end = system.n_steps * system.step
    return (
        f"The training ends at t = {end:g}; l2 error until then and after it (noisy "
        f"data): {'; '.join(said)}."
    )


def _of_tanks(checks: pd.DataFrame) -> str:
    said = []
    for row in checks.to_dict("records"):
        if row["method"] != DESCENT:
            verdicts = []
            for what, asked in ASKED[row["noise"]].items():
                worst = row[f"worst {what}"]
                verdict = "within" if worst <= asked else "above"
                verdicts.append(
                    f"{what} {100 * worst:.2g} % ({verdict} {100 * asked:g} %)"
                )
            said.append(
                f"{row['method']} at noise {row['noise']}: {', '.join(verdicts)}, leak "
                f"{100 * row['leak rms']:.2g} % rms and "
                f"{100 * row['leak largest']:.2g} % at most of its range"
            )
    return f"Worst relative errors: {'; '.join(said)}."


# --- formats


def _shown(scores: pd.DataFrame) -> pd.DataFrame:
    """The table of all methods; a network has no terms."""
    table = scores.drop(columns=["system", "reason"]).copy()
    for name in COUNTS:
        table[name] = [("-" if np.isnan(v) else str(int(v))) for v in table[name]]
    is_network = table["method"].str.startswith("PHNN")
    table.loc[is_network, ["spurious", "missed"]] = "-"
    seconds = table["seconds"]
    table["seconds"] = [("-" if np.isnan(v) else f"{v:.1f}") for v in seconds]
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


def _block(table: pd.DataFrame) -> list[str]:
    return markdown.block(table.to_string(index=False))

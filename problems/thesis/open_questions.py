"""What the thesis leaves open (its Section 6.6), as experiments over many draws.

*Where* the external force acts is unknown: every equation gets the dictionary of the
force, and pruning (size and significance) has to leave it where it belongs. *What* to
put into a dictionary is a guess: too large (the energy of Henon-Heiles to degree 4, all
else of the first question), too small (no force at all: does the diagnosis say that
something is missing?), wrong (forces of another kind: does it say "missing:
unexplained"?).

    python -m problems.thesis.open_questions [--quick] [--page] [--draws=N]
        [question ...]

A row per draw and question is kept in results/thesis/open_questions.csv as it is
computed: a run goes on where another stopped, and --page writes the page anew. --quick
takes one draw with fewer trajectories and writes nothing.
"""

import os

# Before NumPy is loaded: one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

import phsi_opt as ph
from phsi_opt.model.terms import Dictionary, Term
from problems.thesis.methods import SIGNIFICANCE
from problems.thesis.scores import attempted, score
from problems.thesis.systems import (
    FLOWS,
    LEAK_LIMIT,
    LEVELS,
    SYSTEMS,
    System,
    tank_model,
)
from problems.tools import provenance
from problems.tools.command_line import chosen, flag, option
from problems.tools.intervals import share
from problems.tools.kept_tables import append_rows
from problems.tools.pages import render

MASS_SPRING = SYSTEMS["mass_spring"]
TANKS = SYSTEMS["tanks"]
HENON_HEILES = SYSTEMS["henon_heiles"]
FIRST_DRAW = 5000  # draws that nothing was tuned on
N_DRAWS = 50
QUICK_DRAW = 0
# Trajectories of a quick run, in which the questions have the same answers.
QUICK_N = {"mass_spring": 20, "tanks": 20, "henon_heiles": 1500}
DIAGNOSED, HELD_OUT = 3, 2  # trajectories of a diagnosis, which re-fits many times
TANK_STATES = FLOWS + LEVELS
# L1 of the thesis (appendix B); with 0.01 on H too, polynomials of the time take the
# place of the wave (draw 0).
MASS_SPRING_L1 = {"H": 0.1, "F": 0.01}
TANKS_L1 = {"H": 1e-3}  # what the directions need that the tanks' structure leaves free
COLUMNS = ["system", "ask", "draw", "answer", "is_right", "n_candidates"]
COLUMNS += ["superfluous", "missed", "said", "nearest", "seconds"]

Row = dict[str, Any]
# From a draw's seed and the number of trajectories (None: as in the thesis) to a row
# for each answer.
Question = Callable[[int, int | None], list[Row]]


# --- where the force acts


def mass_spring_everywhere() -> ph.PseudoHamiltonian:
    """The thesis' model with its dictionary of the force on both equations."""
    force = ph.polynomials(["t"], degree=3) + ph.trigonometric("t")
    return replace(MASS_SPRING.model(), F={"q": force, "p": force})


def tanks_everywhere() -> ph.PseudoHamiltonian:
    """The thesis' model with a force of its own state on every equation: 1, x^2, x^3,
    and x within the limits of the leak.
    """
    forces = {}
    for x in TANK_STATES:
        bodies = ("1", f"{x}**2", f"{x}**3", _clipped(x))
        forces[x] = Dictionary(tuple(Term(body, ph.Parameter()) for body in bodies))
    return replace(tank_model(), F=forces)


def _clipped(x: str) -> str:
    """The level within the limits of the leak."""
    return f"min(max({x}, -{LEAK_LIMIT}), {LEAK_LIMIT})"


def mass_spring_place(seed: int, n: int | None) -> list[Row]:
    """Whether the wave is found, in the equation of p alone."""
    model = mass_spring_everywhere()
    truth = MASS_SPRING.truth
    return [_selected(MASS_SPRING, model, MASS_SPRING_L1, truth, seed, n)]


def tanks_place(seed: int, n: int | None) -> list[Row]:
    """Whether the leak is found, in the equation of tank 4 alone."""
    truth = {**TANKS.truth, f"F_mu4[{_clipped('mu4')}]": -10.0}
    return [_selected(TANKS, tanks_everywhere(), TANKS_L1, truth, seed, n)]


def large(seed: int, n: int | None) -> list[Row]:
    """Whether an energy of degree 4 is cut down to the true one of degree 3."""
    energy = ph.polynomials(HENON_HEILES.states, degree=4)
    model = replace(HENON_HEILES.model(), H=energy)
    return [_selected(HENON_HEILES, model, {}, HENON_HEILES.truth, seed, n)]


def _selected(
    system: System,
    model: ph.PseudoHamiltonian,
    l1: Mapping[str, float],
    truth: Mapping[str, float],
    seed: int,
    n: int | None,
) -> Row:
    """What pruning by size and significance leaves of a dictionary."""
    began = time.process_time()
    pruning = ph.Pruning(system.threshold, significance=SIGNIFICANCE)
    data = system.data(seed, n=n)
    fit = ph.identify(model, data, ph.PHSILoss(), dict(l1), pruning)
    found = score(replace(system, truth=truth), fit)
    places = [equation for equation, terms in fit.model.F.items() if list(terms)]
    expected = {name.split("[")[0][2:] for name in truth if name.startswith("F_")}
    expected = {name.split(".")[0] for name in expected}
    return {
        "answer": "place" if expected else "large",
        "n_candidates": len(model.free) - len(truth),
        "is_right": set(places) == expected,
        "superfluous": len(found.spurious),
        "missed": len(found.missed),
        "said": " ".join(places),
        "seconds": time.process_time() - began,
    }


# --- the dictionary is a guess: too small, wrong


def guess(seed: int, n: int | None) -> list[Row]:
    """The verdicts on a mass-spring without its force, with the catalogue to choose
    from, and with the catalogue without what swings.

    A diagnosis re-fits many times, so ``n`` has no effect: it gets few trajectories.
    """
    model = without_force(MASS_SPRING)
    runs = DIAGNOSED + HELD_OUT
    train, test = MASS_SPRING.data(seed, n=runs).split(DIAGNOSED / runs)
    fit = ph.identify(model, train)
    rows = []
    choices = {"small": ph.catalogue(model), "wrong": _without_waves(model)}
    for answer, effects in choices.items():
        began = time.process_time()
        found = ph.diagnose(fit, train, test, effects=effects)
        is_missing = found.verdict != ph.Verdict.NOTHING_MISSING
        is_unexplained = found.verdict == ph.Verdict.UNEXPLAINED
        first = found.candidates.iloc[0]
        rows.append(
            {
                "answer": answer,
                "is_right": is_missing if answer == "small" else is_unexplained,
                "said": str(found.verdict),
                "nearest": f"{first['effect']} on {first['equation']}",
                "seconds": time.process_time() - began,
            }
        )
    return rows


def _without_waves(model: ph.Model) -> list[ph.Effect]:
    """The catalogue's effects that do not swing by themselves."""
    swinging = ("harmonic force", "parametric stiffness")
    return [effect for effect in ph.catalogue(model) if effect.name not in swinging]


def without_force(system: System) -> ph.Model:
    """The true energies and losses of a system, their sizes unknown; no force."""
    model = replace(system.model(), F={})
    terms = {name for name, entry in model.entries.items() if entry.prunable}
    return model.without(terms - set(system.truth))


# The system of each question, which is named after its function.
QUESTIONS: dict[Question, str] = {
    tanks_place: "tanks",
    mass_spring_place: "mass_spring",
    large: "henon_heiles",
    guess: "mass_spring",
}


# --- runs


def asked(question: Question, seed: int, n: int | None = None) -> list[Row]:
    """The rows of a question on one draw; a failure is an answer that is not right."""
    key = {"system": QUESTIONS[question], "ask": question.__name__, "draw": seed}
    rows = attempted(lambda: question(seed, n))
    if isinstance(rows, ph.PhsiOptError):
        rows = [{"answer": "failed", "is_right": False, "said": str(rows)[:200]}]
    return [key | row for row in rows]


def quick() -> pd.DataFrame:
    """One draw of each question with few trajectories; nothing is written."""
    rows = []
    for question, system in QUESTIONS.items():
        rows += asked(question, QUICK_DRAW, QUICK_N[system])
    return pd.DataFrame(rows)


def main(names: list[str] | None = None, n_draws: int = N_DRAWS) -> None:
    """Ask what has not been answered yet, draw by draw, and write the page."""
    done: set[tuple[str, int]] = set()
    if _path().exists():
        kept = pd.read_csv(_path())
        done = set(zip(kept["ask"], kept["draw"], strict=True))
    for seed in range(FIRST_DRAW, FIRST_DRAW + n_draws):
        for question in QUESTIONS:
            name = question.__name__
            if (name, seed) not in done and (not names or name in names):
                rows = pd.DataFrame(asked(question, seed), columns=COLUMNS)
                append_rows(_path(), rows, "%.4g")
                print(f"... {name}, draw {seed}", flush=True)
    write_page()


def _path() -> Path:
    return provenance.RESULTS / "thesis" / "open_questions.csv"


def write_page() -> None:
    """The page from the rows that are kept."""
    provenance.write("thesis/open_questions.md", page(pd.read_csv(_path())))


# --- the page

# What is wanted, by question and answer, in the order of the page.
WANTED = {
    ("mass_spring_place", "place"): "force in p, and in no other equation",
    ("tanks_place", "place"): "force in tank 4, and in no other equation",
    ("large", "large"): "every superfluous term goes, no true one",
    ("guess", "small"): "the verdict says that something is missing",
    ("guess", "wrong"): "the verdict is missing: unexplained",
}


def page(rows: pd.DataFrame) -> str:
    """The page as Markdown; every number of its sentences is counted from the rows."""
    parts = {}
    for ask, answer in WANTED:
        # A draw that failed counts for each of the answers of its question.
        is_meant = (rows["ask"] == ask) & rows["answer"].isin([answer, "failed"])
        if is_meant.any():
            parts[ask, answer] = rows[is_meant]
    shares: dict[str, list[Row]] = {}
    for (ask, answer), part in parts.items():
        exact = (part["superfluous"] == 0) & (part["missed"] == 0)
        is_right = exact if answer == "large" else part["is_right"].astype(bool)
        line = _line(part, WANTED[ask, answer], is_right)
        shares.setdefault(answer, []).append(line)
        if answer == "place":  # these dictionaries are too large too
            line = _line(part, WANTED["large", "large"], exact)
            shares.setdefault("also large", []).append(line)
    large = shares.get("large", []) + shares.pop("also large", [])
    return render(
        "thesis/pages/open_questions.md",
        parts=parts,
        shares=shares | {"large": large},
        titles={name: system.title for name, system in SYSTEMS.items()},
        failed=rows[rows["answer"] == "failed"].to_dict("records"),
        significance=SIGNIFICANCE,
    )


def _line(part: pd.DataFrame, wanted: str, is_right: pd.Series) -> Row:
    """One row: a share with n."""
    return {
        "system": SYSTEMS[part["system"].iloc[0]].title,
        "wanted": wanted,
        "share of draws": share(int(is_right.sum()), len(part)),
        "n": len(part),
        "draws": f"{part['draw'].min()} to {part['draw'].max()}",
        "seconds of processor time": f"{part['seconds'].median():.2g}",
    }


if __name__ == "__main__":
    if flag("quick"):
        print(quick().drop(columns="seconds").to_string(index=False))
    elif flag("page"):
        write_page()
    else:
        main(chosen(), int(option("draws", str(N_DRAWS))))

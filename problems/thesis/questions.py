"""What the thesis leaves open (its Section 6.6), over many draws.

*Where* the external force acts is unknown: every equation gets the dictionary of the
force, and pruning (size and significance) has to leave it where it belongs. *What* to
put into a dictionary is a guess: too large (the energy of Henon-Heiles to degree 4),
too small (no force at all: does the diagnosis say that something is missing?), wrong
(effects of another kind: does it say "missing: unexplained"?).
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

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
from problems.tools.intervals import share
from problems.tools.pages import render

MASS_SPRING, TANKS = SYSTEMS["mass_spring"], SYSTEMS["tanks"]
HENON_HEILES = SYSTEMS["henon_heiles"]
FIRST_DRAW = 5000  # draws that nothing was tuned on
N_DRAWS = 15
# Trajectories of a quick run, in which the questions have the same answers.
QUICK_N = {"mass_spring": 20, "tanks": 20, "henon_heiles": 1500}
DIAGNOSED, HELD_OUT = 3, 2  # trajectories of a diagnosis, which re-fits many times
# L1 of the thesis (appendix B); with 0.01 on H too, polynomials of the time take the
# place of the wave.
MASS_SPRING_L1 = {"H": 0.1, "F": 0.01}
TANKS_L1 = {"H": 1e-3}  # what the directions need that the tanks' structure leaves free

Row = dict[str, object]
# From a draw's seed and the number of trajectories (None: as in the thesis) to a line
# for each answer.
Question = Callable[[int, int | None], list[Row]]


def mass_spring_place(seed: int, n: int | None) -> list[Row]:
    """Whether the wave is found, in the equation of p alone."""
    force = ph.polynomials(["t"], degree=3) + ph.trigonometric("t")
    model = replace(MASS_SPRING.model(), F={"q": force, "p": force})
    truth = MASS_SPRING.truth
    return [_selected(MASS_SPRING, model, MASS_SPRING_L1, truth, seed, n)]


def tanks_place(seed: int, n: int | None) -> list[Row]:
    """Whether the leak is found, in the equation of tank 4 alone; every equation has 1,
    x^2, x^3 of its own state, and x within the limits of the leak.
    """
    forces = {}
    for x in FLOWS + LEVELS:
        bodies = ("1", f"{x}**2", f"{x}**3", _clipped(x))
        forces[x] = Dictionary(tuple(Term(body, ph.Parameter()) for body in bodies))
    truth = {**TANKS.truth, f"F_mu4[{_clipped('mu4')}]": -10.0}
    model = replace(tank_model(), F=forces)
    return [_selected(TANKS, model, TANKS_L1, truth, seed, n)]


def _clipped(x: str) -> str:
    return f"min(max({x}, -{LEAK_LIMIT}), {LEAK_LIMIT})"


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
    pruning = ph.Pruning(system.threshold, significance=SIGNIFICANCE)
    fit = ph.identify(model, system.data(seed, n=n), ph.PHSILoss(), dict(l1), pruning)
    found = score(replace(system, truth=truth), fit)
    places = {equation for equation, terms in fit.model.F.items() if list(terms)}
    expected = {name.split("[")[0][2:] for name in truth if name.startswith("F_")}
    expected = {name.split(".")[0] for name in expected}
    is_exact = not found.spurious and not found.missed
    row: Row = {"right": places == expected if expected else is_exact}
    row |= {"exact": is_exact, "candidates": len(model.free)}
    return row | {"said": "force on " + (", ".join(sorted(places)) or "nothing")}


def guess(seed: int, n: int | None) -> list[Row]:
    """The diagnosis of a mass-spring without a force, by the whole catalogue and by one
    without the effects that swing; it re-fits each effect: it gets few trajectories.
    """
    model: ph.Model = replace(MASS_SPRING.model(), F={})
    terms = {name for name, entry in model.entries.items() if entry.prunable}
    model = model.without(terms - set(MASS_SPRING.truth))
    runs = DIAGNOSED + HELD_OUT
    train, test = MASS_SPRING.data(seed, n=runs).split(DIAGNOSED / runs)
    fit = ph.identify(model, train)
    swinging = ("harmonic force", "parametric stiffness")
    catalogue = ph.catalogue(model)
    still = [effect for effect in catalogue if effect.name not in swinging]
    small = ph.diagnose(fit, train, test, effects=catalogue).verdict
    wrong = ph.diagnose(fit, train, test, effects=still).verdict
    is_missing = small != ph.Verdict.NOTHING_MISSING
    is_unexplained = wrong == ph.Verdict.UNEXPLAINED
    return [
        {"answer": "dictionary too small", "right": is_missing, "said": str(small)},
        {"answer": "dictionary wrong", "right": is_unexplained, "said": str(wrong)},
    ]


# By question, its system and what is wanted.
QUESTIONS: dict[Question, tuple[str, str]] = {
    mass_spring_place: ("mass_spring", "place of the force"),
    tanks_place: ("tanks", "place of the force"),
    large: ("henon_heiles", "dictionary too large"),
    guess: ("mass_spring", "diagnosis"),
}


def asked(question: Question, seed: int, n: int | None = None) -> list[Row]:
    """The lines of a question on one draw; a failure is an answer that is not right."""
    name, answer = QUESTIONS[question]
    rows = attempted(lambda: question(seed, n))
    if isinstance(rows, ph.PhsiOptError):
        rows = [{"right": False, "said": str(rows)[:100]}]
    return [{"system": SYSTEMS[name].title, "answer": answer} | row for row in rows]


def questions_page(quick: bool) -> str:
    """The page of the open questions."""
    rows = []
    for question, (name, _) in QUESTIONS.items():
        for seed in [0] if quick else range(FIRST_DRAW, FIRST_DRAW + N_DRAWS):
            rows += asked(question, seed, QUICK_N[name] if quick else None)
            print("...", *rows[-1].values(), sep=", ", flush=True)
    lines = []
    for (system, answer), part in pd.DataFrame(rows).groupby(
        ["system", "answer"], sort=False
    ):
        line = {"system": system, "question": answer}
        line["right"] = share(int(part["right"].sum()), len(part))
        exact = part["exact"].dropna()
        line["exactly the true terms"] = share(int(exact.sum()), len(exact))
        said = part["said"].value_counts().items()
        lines.append(line | {"said": "; ".join(f"{n} x {text}" for text, n in said)})
    return render("thesis/pages/open_questions.md", lines=lines, level=SIGNIFICANCE)

"""One case examined: what a study says is missing, beside what was hidden.

Whatever fails is recorded, and counts as silent.
"""

import time
from dataclasses import dataclass

import phsi_opt as ph
from problems.field_machines.cases import draw
from problems.field_machines.findings import Finding, as_text, findings_of
from problems.field_machines.kinds import Kind
from problems.field_machines.records import Case
from problems.tools.provenance import commit

MOST_STEPS = 3  # of a study
REASON_LENGTH = 200  # characters kept of an error's message
NAME, CLASS, FALSE, SILENT = "right name", "class", "false name", "silent"

Found = dict[str, object]  # columns of the kept tables


@dataclass(frozen=True, eq=False)
class Said:
    """What the diagnoses of a study said: all that was found, and each verdict."""

    findings: set[Finding]
    verdicts: tuple[str, ...]
    study: ph.Study


def examine(kind: Kind, seed: int) -> Found:
    """The record of a case: what was hidden, what was found."""
    record: Found = {
        "kind": kind.name,
        "seed": seed,
        "outcome": "examined",
        "commit": commit(),
    }
    began = time.perf_counter()
    try:
        case = draw(kind, seed)
    except (ArithmeticError, ValueError) as error:
        return record | {"outcome": f"not drawn: {str(error)[:REASON_LENGTH]}"}
    record |= described(case)
    record["drawing"] = time.perf_counter() - began
    began = time.perf_counter()
    try:
        record |= _answer(case)
    # Whatever goes wrong is a case that was not examined, and names nothing.
    except Exception as error:
        reason = str(error)[:REASON_LENGTH]
        record["outcome"] = f"{type(error).__name__}: {reason}"
        record["answer"] = SILENT
    return record | {"seconds": time.perf_counter() - began}


def described(case: Case) -> Found:
    """What was hidden, and how it shows."""
    coefficient = float("nan")
    if case.truths:
        coefficient = case.size * case.truths[0].coefficient
    return {
        "noise": case.noise,
        "hidden": case.hidden,
        "truth": " or ".join(sorted(case.places)),
        "coefficient": coefficient,
        "listed": case.is_listed,
        "disturbance": case.disturbance,
        "ratio": case.ratio,
        "disturbed": case.disturbed,
        **case.settings,
    }


def _answer(case: Case) -> Found:
    said = asked(case.model, case.train, case.test)
    last = said.study.history.iloc[-1]
    return {
        "answer": answer(case.places, said.findings),
        "findings": as_text(said.findings),
        "verdicts": "; ".join(said.verdicts),
        "added": "; ".join(str(effect) for effect in said.study.added),
        "after": last["held_out_rmse"] / last["noise_floor"],
    }


def asked(model: ph.Model, train: ph.Measurements, test: ph.Measurements) -> Said:
    """What a study finds that goes on by itself, all its diagnoses together."""
    study = ph.Study(model, train, held_out=test)
    found: set[Finding] = set()
    verdicts = []
    for _ in range(MOST_STEPS):
        diagnosis = study.diagnose()
        found |= findings_of(diagnosis)
        verdicts.append(str(diagnosis.verdict))
        n_steps = len(study.steps)
        study.auto(max_steps=1)
        if len(study.steps) == n_steps:
            break
    return Said(found, tuple(verdicts), study)


def answer(places: set[str], found: set[Finding]) -> str:
    """Whether all findings hold a true effect; ``places``: the names that are right."""
    if not found:
        return SILENT
    if not all(places & one for one in found):
        return FALSE
    return NAME if all(len(one) == 1 for one in found) else CLASS

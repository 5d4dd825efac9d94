"""One case examined: what the diagnosis says, beside what was hidden.

With hidden effects the first diagnosis answers (of several effects a study), with
machines of the field a study that goes on by itself. Whatever fails is recorded, and
counts as wrong or silent.
"""

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.battery.draw import TABLES, HiddenRow, draw
from problems.battery.masses import SEVERAL
from problems.battery.records import FIELD, HIDDEN, Case, Truth
from problems.tools.intervals import HALF_WIDTH
from problems.tools.provenance import commit

# Fall of the misfit, in noise variances, that a test at 1 % takes for real (chi-squared
# with one degree of freedom).
DETECTED = 6.63
MOST_STEPS = {HIDDEN: 4, FIELD: 3}  # of a study
REASON_LENGTH = 200  # characters kept of an error's message
NAME, CLASS, FALSE, SILENT = "right name", "class", "false name", "silent"
# How a name begins that is right of a force from outside the catalogue: functions of
# one quantity are asked for there.
TRUE_OUTSIDE = {
    "attached absorber": "resonance on ",
    "impact": "unknown force f(q",
    "damping in one direction": "unknown force f(dH_dp",
}
NOTHING = ("nothing", "lasting")  # kinds of rows in which nothing is hidden
ROW = {HIDDEN: "row", FIELD: "kind"}  # the column that names a case's row

Found = dict[str, object]  # columns of the kept tables
Finding = frozenset[str]  # "viscous damping on p", ...: all that do equally well


@dataclass(frozen=True)
class Task:
    """A case: its table of machines, its row, the seed."""

    battery: str
    row: str
    seed: int

    def __str__(self) -> str:
        return f"{self.battery} {self.row} {self.seed}"


def examined(task: Task) -> Found:
    """The record of a task: what was hidden, what was named."""
    row = TABLES[task.battery][task.row]
    record: Found = {ROW[task.battery]: row.name, "seed": task.seed, "commit": commit()}
    record["outcome"] = "examined"
    if isinstance(row, HiddenRow):
        record |= {"right": False, "tie": False}
    before = time.process_time()
    began = time.perf_counter()
    try:
        case = draw(row, task.seed)
    except (ArithmeticError, ValueError) as error:
        return record | {"outcome": f"not drawn: {str(error)[:REASON_LENGTH]}"}
    record |= described(case)
    record["drawing"] = time.perf_counter() - began
    began = time.perf_counter()
    try:
        if isinstance(row, HiddenRow):
            has_several = row.kind in SEVERAL
            record |= _several(case) if has_several else _one(case, row.kind)
        else:
            record |= _field_answer(case)
    # Whatever goes wrong is a case that was not examined, and names nothing.
    except Exception as error:
        reason = f"{type(error).__name__}: {str(error)[:REASON_LENGTH]}"
        record |= {"outcome": reason, "answer": SILENT}
    record["seconds"] = time.perf_counter() - began
    return record | {"processor": time.process_time() - before}


def described(case: Case) -> Found:
    """What was hidden, in which setting, and how it shows."""
    truths = case.truths
    listed = case.listed
    coefficient = case.size * truths[0].coefficient if truths else np.nan
    found: Found = {"noise": case.noise, "ratio": case.ratio}
    if case.clean is None:
        names = " or ".join(sorted(case.places))
        found |= {"hidden": case.hidden, "truth": names, "listed": bool(listed)}
        return found | {"coefficient": coefficient}
    return found | {
        "truth": " + ".join(truth.effect for truth in truths),
        "equation": " + ".join("|".join(truth.equations) for truth in truths),
        "value": coefficient if len(truths) == 1 else np.nan,
        "listed": all(truth.places & listed for truth in truths),
    }


# --- hidden effects: at most one is hidden


def _one(case: Case, kind: str) -> Found:
    """The first diagnosis."""
    fit = ph.identify(case.model, case.train)
    diagnosis = ph.diagnose(fit, case.train, held_out=case.test)
    verdict = diagnosis.verdict
    table = diagnosis.candidates
    found: Found = {"base_error": diagnosis.base.rmse / floor(case), "verdict": verdict}
    if kind in NOTHING:
        found["right"] = verdict == ph.Verdict.NOTHING_MISSING
    elif kind == "outside":
        found["right"] = is_right_outside(case.hidden, diagnosis)
    if table.empty:
        return found
    first = table.iloc[0]
    found |= {
        "first": first.effect,
        "first_equation": first.equation,
        "confusable_with": first.confusable_with,
        "coefficient": first.coefficient,
        "std_error": first.std_error,
        "after": first.held_out_rmse / floor(case),
    }
    is_named = verdict == ph.Verdict.NAMED
    if case.truths and kind != "outside":
        found |= _beside_the_truth(case.truths[0], table, is_named)
    if is_named and not found.get("right", False):
        named = fit.model.add(diagnosis.effects[0])
        found["misfit"] = misfit(case, named, diagnosis.proposed_fit)
    return found


def _beside_the_truth(truth: Truth, table: pd.DataFrame, is_named: bool) -> Found:
    """Whether the first candidate is the truth, or a tie with it, and its interval."""
    hits = (table["effect"] + " on " + table["equation"]).isin(truth.places).tolist()
    found: Found = {
        "rank": hits.index(True) + 1 if any(hits) else np.nan,
        "right": is_named and hits[0],
    }
    first = table.iloc[0]
    if is_named and hits[0]:
        found["covered"] = covered(
            truth.coefficient, first.coefficient, first.std_error
        )
    elif is_named:
        found["tie"] = bool(truth.places & set(str(first.confusable_with).split(", ")))
    return found


def covered(truth: float, estimate: float, error: float) -> float:
    """1 or 0: whether the 95 % interval holds the truth (without a standard error it
    does not); NaN: not comparable.
    """
    if not np.isfinite(truth):
        return np.nan
    return float(abs(estimate - truth) <= HALF_WIDTH * error)


# --- hidden effects: several are hidden


def _several(case: Case) -> Found:
    """The study adds by itself, a step at a time, until it stops."""
    study = ph.Study(case.model, case.train, held_out=case.test)
    before = study.history["held_out_rmse"].iloc[0]
    alike = _added(study)
    right = matches(case.truths, [{text} for text in alike])
    found: Found = {
        "base_error": before / floor(case),
        "verdict": study.diagnose().verdict,
        "added": "; ".join(alike),
        "right": right,
        "tie": matches(case.truths, list(alike.values())) and not right,
        "after": study.history["held_out_rmse"].iloc[-1] / floor(case),
    }
    if alike and not right:
        found["misfit"] = misfit(case, study.model, study.fit)
    return found


def _added(study: ph.Study) -> dict[str, set[str]]:
    """Each effect that the study added, with what it could not be told from."""
    alike: dict[str, set[str]] = {}
    for diagnosis, has_added in steps_of(study, MOST_STEPS[HIDDEN]):
        if has_added:
            table = diagnosis.candidates
            names = table["effect"] + " on " + table["equation"]
            ties = dict(zip(names, table["confusable_with"], strict=True))
            present = {}
            for text in map(str, study.added):
                known = {text, *ties.get(text, "").split(", ")}
                present[text] = alike.get(text, known)
            alike = present
    return alike


def steps_of(study: ph.Study, most: int) -> Iterator[tuple[ph.Diagnosis, bool]]:
    """The diagnoses of a study that goes on by itself until it stops, ``most`` at most,
    and whether it added something after each.
    """
    for _ in range(most):
        diagnosis = study.diagnose()
        n_steps = len(study.steps)
        study.auto(max_steps=1)
        has_added = len(study.steps) > n_steps
        yield diagnosis, has_added
        if not has_added:
            return


def matches(truths: tuple[Truth, ...], found: list[set[str]]) -> bool:
    """Whether each truth has an effect of its own among those found, and none is left
    over.
    """
    if len(truths) != len(found):
        return False
    if not truths:
        return True
    first, *others = truths
    for k, names in enumerate(found):
        rest = found[:k] + found[k + 1 :]
        if first.places & names and matches(tuple(others), rest):
            return True
    return False


# --- hidden effects: errors beside the noise that is known here


def floor(case: Case) -> float:
    """Root mean square of the noise that is in the held-out samples, on the scale of
    `Comparison.rmse`.
    """
    y = np.concatenate([run.x for run in case.test.trajectories])
    noise = np.concatenate(list(case.test_noise))
    seen = np.flatnonzero(np.isfinite(y).any(axis=0))
    scale = y[:, seen].std(axis=0) if len(seen) > 1 else np.ones(1)
    return float(np.sqrt(np.mean((noise[:, seen] / scale) ** 2)))


def misfit(case: Case, model: ph.Model, start: ph.Fit | None = None) -> float:
    """How far a model stays from the noise-free training data, in noise variances.

    The truth itself is at zero; below `DETECTED` the data cannot tell a model from it.
    Infinite where it could not be fitted, from ``start``.
    """
    assert case.clean is not None
    try:
        fit = ph.identify(model, case.clean, start=start)
        residuals = ph.compare(fit, case.clean).residuals
    except ph.PhsiOptError:
        return np.inf
    n_states = len(case.sigma)
    total = 0.0
    for residual, run in zip(residuals, case.clean.trajectories, strict=True):
        seen = np.where(np.isfinite(run.x), residual[:, :n_states], np.nan)
        total += np.nansum((seen / case.sigma) ** 2)
    return float(total)


# --- machines of the field: all that a study finds


def findings_of(diagnosis: ph.Diagnosis) -> set[Finding]:
    """What is established to be missing."""
    return {frozenset(map(str, finding.effects)) for finding in diagnosis.findings}


def is_right_outside(hidden: str, diagnosis: ph.Diagnosis) -> bool:
    """Of a force from outside: unexplained, or named by what it is a function of."""
    if diagnosis.verdict == ph.Verdict.UNEXPLAINED:
        return True
    true = TRUE_OUTSIDE.get(hidden, "none")
    named = [
        any(one.startswith(true) for one in each) for each in findings_of(diagnosis)
    ]
    return bool(named) and all(named)


def is_of_states(name: str) -> bool:
    """Whether an effect is an unknown function of a state or its effort."""
    return re.match(r"unknown (force f|loss r)\((?!u)", name) is not None


def as_text(found: set[Finding]) -> str:
    """Findings by semicolons, members of a class by "or"; sorted."""
    return "; ".join(sorted(" or ".join(sorted(each)) for each in found))


def answer(places: set[str], found: set[Finding]) -> str:
    """Whether all findings hold a true effect; ``places``: the names that are right."""
    if not found:
        return SILENT
    if not all(places & each for each in found):
        return FALSE
    return NAME if all(len(each) == 1 for each in found) else CLASS


def _field_answer(case: Case) -> Found:
    """What a study finds that goes on by itself, all its diagnoses together."""
    study = ph.Study(case.model, case.train, held_out=case.test)
    found: set[Finding] = set()
    verdicts = []
    for diagnosis, _ in steps_of(study, MOST_STEPS[FIELD]):
        found |= findings_of(diagnosis)
        if case.has_function:
            # Of what is beside the model it is true that a function is missing.
            found = {each for each in found if not all(map(is_of_states, each))}
        verdicts.append(str(diagnosis.verdict))
    last = study.history.iloc[-1]
    return {
        "answer": answer(case.places, found),
        "findings": as_text(found),
        "verdicts": "; ".join(verdicts),
        "added": "; ".join(str(effect) for effect in study.added),
        "after": last["held_out_rmse"] / last["noise_floor"],
    }

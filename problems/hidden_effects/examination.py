"""One case examined: what the diagnosis says, beside what was hidden.

Whatever fails is recorded, and counts as wrong.
"""

import time

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.hidden_effects.cases import draw
from problems.hidden_effects.rows import Case, Row, Truth
from problems.tools.intervals import HALF_WIDTH
from problems.tools.provenance import commit

# Fall of the misfit, in noise variances, that a test at 1 % takes for real (chi-squared
# with one degree of freedom).
DETECTED = 6.63
MOST_STEPS = 4  # of a study that looks for two effects
REASON_LENGTH = 200  # characters kept of an error's message

Found = dict[str, object]  # columns of the kept tables


def examine(row: Row, seed: int) -> Found:
    """The record of a case: what was hidden, what was named, with which coefficient."""
    record: Found = {
        "row": row.name,
        "seed": seed,
        "right": False,
        "tie": False,
        "outcome": "examined",
        "commit": commit(),
    }
    began = time.perf_counter()
    try:
        case = draw(row, seed)
    except (ArithmeticError, ValueError) as error:
        return record | {"outcome": f"not drawn: {str(error)[:REASON_LENGTH]}"}
    record |= _described(case)
    record["drawing"] = time.perf_counter() - began
    began = time.perf_counter()
    try:
        record |= _two(case) if row.kind == "two" else _one(case)
    # Whatever goes wrong is a case that was not examined, and is counted as wrong.
    except Exception as error:
        reason = str(error)[:REASON_LENGTH]
        record["outcome"] = f"{type(error).__name__}: {reason}"
    return record | {"seconds": time.perf_counter() - began}


def _described(case: Case) -> Found:
    """What was hidden, and in which setting."""
    truths = case.truths
    listed = {(e.name, e.equation) for e in ph.catalogue(case.model)}
    return {
        "noise": case.noise,
        **case.settings,
        "target": case.target,
        "base_ratio": case.base_ratio,
        "truth": " + ".join(truth.effect for truth in truths),
        "equation": " + ".join("|".join(truth.equations) for truth in truths),
        "value": truths[0].coefficient if len(truths) == 1 else np.nan,
        "listed": all(_is_listed(truth, listed) for truth in truths),
    }


def _is_listed(truth: Truth, listed: set[tuple[str, str]]) -> bool:
    """Whether the catalogue offers an effect in one of its right equations."""
    return any((truth.effect, equation) in listed for equation in truth.equations)


def is_right(truth: Truth, name: str, equation: str) -> bool:
    """Whether effect and place are those of the truth."""
    return name == truth.effect and equation in truth.equations


def places(truth: Truth) -> set[str]:
    """The names that are right, as a diagnosis prints them."""
    return {f"{truth.effect} on {equation}" for equation in truth.equations}


# --- at most one effect is hidden


def _one(case: Case) -> Found:
    """The first diagnosis."""
    fit = ph.identify(case.model, case.train)
    diagnosis = ph.diagnose(fit, case.train, held_out=case.test)
    verdict = diagnosis.verdict
    table = diagnosis.candidates
    found: Found = {
        "base_error": diagnosis.base.rmse / floor(case),
        "verdict": verdict,
    }
    if case.row.kind == "nothing":
        found["right"] = verdict == ph.Verdict.NOTHING_MISSING
    elif case.row.kind == "outside":
        found["right"] = verdict == ph.Verdict.UNEXPLAINED
    if table.empty:
        return found
    found |= _first_candidate(case, table)
    is_named = verdict == ph.Verdict.NAMED
    if case.truths and case.row.kind != "outside":
        found |= _beside_the_truth(case.truths[0], table, is_named)
    if is_named and not found.get("right", False):
        named = fit.model.add(diagnosis.effects[0])
        found["misfit"] = misfit(case, named, diagnosis.proposed_fit)
    return found


def _first_candidate(case: Case, table: pd.DataFrame) -> Found:
    first = table.iloc[0]
    return {
        "first": first.effect,
        "first_equation": first.equation,
        "confusable_with": first.confusable_with,
        "coefficient": first.coefficient,
        "std_error": first.std_error,
        "after": first.held_out_rmse / floor(case),
    }


def _beside_the_truth(truth: Truth, table: pd.DataFrame, is_named: bool) -> Found:
    """Whether the first candidate is the truth, or a tie with it, and its interval."""
    hits = []
    for name, equation in zip(table["effect"], table["equation"], strict=True):
        hits.append(is_right(truth, name, equation))
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
        alike = set(str(first.confusable_with).split(", "))
        found["tie"] = bool(places(truth) & alike)
    return found


def covered(truth: float, estimate: float, error: float) -> float:
    """1 or 0: whether the 95 % interval holds the truth (without a standard error it
    does not); NaN: not comparable.
    """
    if not np.isfinite(truth):
        return np.nan
    return float(abs(estimate - truth) <= HALF_WIDTH * error)


# --- two effects are hidden


def _two(case: Case) -> Found:
    """The study adds by itself, a step at a time, until it stops."""
    study = ph.Study(case.model, case.train, held_out=case.test)
    before = study.history["held_out_rmse"].iloc[0]
    alike = _added(study)
    right = matches(case.truths, [{text} for text in alike])
    with_ties = matches(case.truths, list(alike.values()))
    after = study.history["held_out_rmse"].iloc[-1]
    found: Found = {
        "base_error": before / floor(case),
        "verdict": study.diagnose().verdict,
        "added": "; ".join(alike),
        "right": right,
        "tie": with_ties and not right,
        "after": after / floor(case),
    }
    if alike and not right:
        found["misfit"] = misfit(case, study.model, study.fit)
    return found


def _added(study: ph.Study) -> dict[str, set[str]]:
    """Each effect that the study added, with what it could not be told from."""
    alike: dict[str, set[str]] = {}
    for _ in range(MOST_STEPS):
        table = study.diagnose().candidates
        n_steps = len(study.steps)
        study.auto(max_steps=1)
        if len(study.steps) == n_steps:
            break
        names = table["effect"] + " on " + table["equation"]
        ties = dict(zip(names, table["confusable_with"], strict=True))
        present = {}
        for effect in study.added:
            text = str(effect)
            known = {text, *ties.get(text, "").split(", ")}
            present[text] = alike.get(text, known)
        alike = present
    return alike


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
        if places(first) & names and matches(tuple(others), rest):
            return True
    return False


# --- errors beside the noise that is known here


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
    try:
        fit = ph.identify(model, case.clean, start=start)
        comparison = ph.compare(fit, case.clean)
    except ph.PhsiOptError:
        return np.inf
    n_states = len(case.sigma)
    squares = []
    for residual, run in zip(
        comparison.residuals, case.clean.trajectories, strict=True
    ):
        seen = np.where(np.isfinite(run.x), residual[:, :n_states], np.nan)
        squares.append(np.nansum((seen / case.sigma) ** 2))
    return float(sum(squares))

"""One case examined: what the diagnosis says, beside what was hidden."""

import time

import numpy as np

import phsi_opt as ph
from phsi_opt.model.model import Model
from problems.hidden_effects.cases import draw
from problems.hidden_effects.rows import Case, Row, Truth
from problems.tools.intervals import HALF_WIDTH
from problems.tools.provenance import commit

NOTHING, NAMED, UNEXPLAINED = (
    "nothing missing",
    "missing: named",
    "missing: unexplained",
)


DETECTED = (
    6.63  # fall of the misfit, in noise variances, that a test at 1 % takes for real
)


MOST_STEPS = 4


def examine(row: Row, seed: int) -> dict[str, object]:
    """The record of a case: what was hidden, what was named, with which coefficient;
    whatever fails is recorded.
    """
    began = time.perf_counter()
    record: dict[str, object] = {
        "row": row.name,
        "seed": seed,
        "right": False,
        "tie": False,
        "outcome": "examined",
    }
    record["commit"] = commit()
    try:
        case = draw(row, seed)
    except (ArithmeticError, ValueError) as error:
        return record | {"outcome": f"not drawn: {str(error)[:200]}"}
    record |= _described(case) | {"drawing": time.perf_counter() - began}
    began = time.perf_counter()
    try:
        record |= {"two": _two}.get(row.kind, _one)(case)
    # whatever goes wrong is a case that was not examined, and is counted as wrong
    except Exception as error:
        record["outcome"] = f"{type(error).__name__}: {str(error)[:200]}"
    return record | {"seconds": time.perf_counter() - began}


def _described(case: Case) -> dict[str, object]:
    listed = {(e.name, e.equation) for e in ph.catalogue(case.model)}
    return {
        "noise": case.noise,
        **case.settings,
        "target": case.target,
        "base_ratio": case.base_ratio,
        "truth": " + ".join(t.effect for t in case.truths),
        "equation": " + ".join("|".join(t.equations) for t in case.truths),
        "value": case.truths[0].coefficient if len(case.truths) == 1 else np.nan,
        "listed": all(
            any((t.effect, e) in listed for e in t.equations) for t in case.truths
        ),
    }


def is_right(truth: Truth, name: str, equation: str) -> bool:
    """Whether effect and place are those of the truth."""
    return name == truth.effect and equation in truth.equations


def _one(case: Case) -> dict[str, object]:
    """At most one effect is hidden: the first diagnosis."""
    fit = ph.identify(case.model, case.train)
    diagnosis = ph.diagnose(fit, case.train, held_out=case.test)
    table = diagnosis.candidates
    found: dict[str, object] = {
        "base_error": diagnosis.base.rmse / floor(case),
        "verdict": diagnosis.verdict,
    }
    if case.row.kind == "nothing":
        found["right"] = diagnosis.verdict == NOTHING
    elif case.row.kind == "outside":
        found["right"] = diagnosis.verdict == UNEXPLAINED
    if table.empty:
        return found
    first, named = table.iloc[0], diagnosis.verdict == NAMED
    found |= {
        "first": first.effect,
        "first_equation": first.equation,
        "confusable_with": first.confusable_with,
        "coefficient": first.coefficient,
        "std_error": first.std_error,
        "after": first.held_out_rmse / floor(case),
    }
    if case.row.kind in ("nothing", "outside"):
        return found | (
            {
                "misfit": misfit(
                    case, fit.model.add(diagnosis.effects[0]), diagnosis.proposed_fit
                )
            }
            if named
            else {}
        )
    (truth,) = case.truths
    hits = [
        is_right(truth, name, equation)
        for name, equation in zip(table["effect"], table["equation"], strict=True)
    ]
    found |= {
        "rank": hits.index(True) + 1 if any(hits) else np.nan,
        "right": named and hits[0],
    }
    if named and hits[0]:
        found["covered"] = covered(
            truth.coefficient, first.coefficient, first.std_error
        )
    elif named:
        texts = {f"{truth.effect} on {equation}" for equation in truth.equations}
        found["tie"] = bool(texts & set(str(first.confusable_with).split(", ")))
        found["misfit"] = misfit(
            case, fit.model.add(diagnosis.effects[0]), diagnosis.proposed_fit
        )
    return found


def covered(truth: float, estimate: float, error: float) -> float:
    """1 or 0: whether the 95 % interval holds the truth (without a standard error it
    does not); NaN: not comparable.
    """
    if not np.isfinite(truth):
        return np.nan
    return float(abs(estimate - truth) <= HALF_WIDTH * error)


def _two(case: Case) -> dict[str, object]:
    """Two effects are hidden: the study adds by itself, a step at a time, until it
    stops.
    """
    study = ph.Study(case.model, case.train, held_out=case.test)
    found: dict[str, object] = {
        "base_error": study.history["held_out_rmse"].iloc[0] / floor(case)
    }
    alike: dict[
        str, set[str]
    ] = {}  # each effect that was added, with what it could not be told from
    for _ in range(MOST_STEPS):
        table, n_steps = study.diagnose().candidates, len(study.steps)
        study.auto(max_steps=1)
        if len(study.steps) == n_steps:
            break
        ties = dict(
            zip(
                table["effect"] + " on " + table["equation"],
                table["confusable_with"],
                strict=True,
            )
        )
        alike = {
            str(e): alike.get(str(e), {str(e), *ties.get(str(e), "").split(", ")})
            for e in study.added
        }
    added = list(alike)
    right, with_ties = (
        matches(case.truths, [{text} for text in added]),
        matches(case.truths, list(alike.values())),
    )
    found |= {
        "verdict": study.diagnose().verdict,
        "added": "; ".join(added),
        "right": right,
        "tie": with_ties and not right,
        "after": study.history["held_out_rmse"].iloc[-1] / floor(case),
    }
    return found | (
        {} if right or not added else {"misfit": misfit(case, study.model, study.fit)}
    )


def matches(truths: tuple[Truth, ...], found: list[set[str]]) -> bool:
    """Whether each truth has an effect of its own among those found, and none is left
    over.
    """
    texts = [{f"{t.effect} on {equation}" for equation in t.equations} for t in truths]
    if len(texts) != len(found):
        return False
    if not texts:
        return True
    return any(
        texts[0] & found[k] and matches(truths[1:], found[:k] + found[k + 1 :])
        for k in range(len(found))
    )


def floor(case: Case) -> float:
    """Root mean square of the noise that is in the held-out samples, on the scale of
    `Comparison.rmse`.
    """
    y = np.concatenate([run.x for run in case.test.trajectories])
    noise = np.concatenate(list(case.test_noise))
    seen = np.flatnonzero(np.isfinite(y).any(axis=0))
    scale = y[:, seen].std(axis=0) if len(seen) > 1 else np.ones(1)
    return float(np.sqrt(np.mean((noise[:, seen] / scale) ** 2)))


def misfit(case: Case, model: Model, start: ph.Fit | None = None) -> float:
    """How far a model stays from the noise-free training data, in noise variances; the
    truth itself is at zero.

    Below `DETECTED` the data cannot tell it from the truth. Infinite where it could not
    be fitted, from ``start``.
    """
    try:
        comparison = ph.compare(ph.identify(model, case.clean, start=start), case.clean)
    except ph.PhsiOptError:
        return np.inf
    n = len(case.sigma)
    runs = zip(comparison.residuals, case.clean.trajectories, strict=True)
    return float(
        sum(
            np.nansum(
                (np.where(np.isfinite(run.x), r[:, :n], np.nan) / case.sigma) ** 2
            )
            for r, run in runs
        )
    )

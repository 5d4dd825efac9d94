"""The judges of a change: their cases build, and they tell a change from none."""

import copy
import json
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from problems.battery.ask import CLASS, FALSE, NAME, SILENT
from problems.battery.draw import KINDS, ROWS
from problems.battery.records import FIELD, HIDDEN
from problems.judges import fits, searches, verdicts
from problems.judges.cases import IN_ROUND, IN_VERDICTS, one_round, rounds
from problems.judges.fit_cases import PROBLEMS

DEVELOPED = 10_000  # first seed


@pytest.mark.slow
def test_a_problem_of_each_kind_builds_with_data_of_its_model() -> None:
    assert len(PROBLEMS) == 40
    kinds = {getattr(make, "func", make): make for make in PROBLEMS.values()}
    for kind, make in kinds.items():
        problem = make()
        assert set(problem.data.states) <= set(problem.model.states), kind
        assert problem.model.free, kind


@pytest.mark.parametrize("kind", searches.KINDS)
def test_a_search_is_asked_for_effects_that_its_model_may_have(kind: str) -> None:
    case = searches.KINDS[kind](np.random.default_rng(DEVELOPED))
    names = {str(effect) for effect in ph.catalogue(case.model, case.data.units)}
    assert case.true <= names and case.sizes.keys() <= case.true
    assert len(case.data) == 2 and case.data.states == case.model.states


@pytest.fixture(scope="module")
def reference() -> dict[str, Any]:
    """A fit as it is kept in a file."""
    found = fits.record(PROBLEMS["Duffing, q alone"])
    return dict(json.loads(json.dumps(found)))


def test_a_fit_agrees_with_itself_and_a_changed_estimate_is_told(reference) -> None:
    same = fits.compared(reference, fits.record(PROBLEMS["Duffing, q alone"]))
    assert (same["status"], same["objective"]) == (fits.SAME, fits.LIKELY)
    assert not fits.is_worse(same)
    moved = copy.deepcopy(reference)
    moved["estimates"]["k"] *= 1 + 1e-4  # some 0.01 of its standard errors
    row = fits.compared(reference, moved)
    assert row["estimates"] == pytest.approx(1e-4, rel=1e-6)
    assert row["status"] == fits.NEARBY
    moved["estimates"]["k"] += reference["std_errors"]["k"]
    moved["objective"] += 0.5
    row = fits.compared(reference, moved)
    assert (row["status"], row["objective"]) == (fits.OTHER, fits.LESS)
    assert fits.is_worse(row)
    # Far from the optimum of many steps, where the reference is near it.
    apart = fits.distances(PROBLEMS["Duffing, q alone"], reference, moved)
    assert apart[fits.NOW] == pytest.approx(1.0, abs=0.1)
    assert apart[fits.BEFORE] < 0.1
    assert fits.is_worse(row | apart)


def test_terms_failures_and_moved_predictions_are_told(reference) -> None:
    failed = {"success": False, "ending": "SolveError: no"}
    assert fits.compared(reference, failed)["status"] == fits.FAILED
    assert fits.compared(failed, reference)["status"] == fits.SOLVED
    other = copy.deepcopy(reference)
    del other["estimates"]["a"]
    assert fits.compared(reference, other)["status"] == fits.TERMS
    other = copy.deepcopy(reference)
    other["predicted"]["q"][3] += reference["noise"]["q"]
    row = fits.compared(reference, other)
    assert row["states"] == pytest.approx(1.0)
    assert row["status"] == fits.OTHER


@pytest.mark.parametrize("numbers", [IN_ROUND, IN_VERDICTS])
def test_a_list_is_balanced_and_the_same_whenever_it_is_made(numbers) -> None:
    tasks = one_round(DEVELOPED, numbers)
    assert tasks == one_round(DEVELOPED, numbers)
    assert {(task.battery, task.row) for task in tasks} == {
        *((HIDDEN, name) for name, row in ROWS.items() if numbers[row.kind]),
        *((FIELD, name) for name in KINDS),
    }
    seeds = [task.seed % 3 for task in tasks if task.row == "pendulum"]
    assert seeds.count(0) == seeds.count(1) == seeds.count(2)
    several = rounds(DEVELOPED, numbers, 3 * len(tasks))
    assert several[: len(tasks)] == tasks
    assert len(set(several)) == len(several)


def said(findings: str = "gap on p", answer: str = NAME) -> dict[str, Any]:
    """What is kept of a verdict."""
    return {
        "battery": HIDDEN,
        "row": "gap_0.01",
        "hidden": "gap",
        "noise": 0.01,
        "names": ["gap on p"],
        "verdict": "missing: named",
        "findings": findings,
        "sizes": {findings: [1.0, 0.1]},
        "answer": answer,
        "right": answer in (NAME, CLASS),
    }


def test_a_changed_verdict_is_told_with_its_interval() -> None:
    old = {"a": said(), "b": said("lag on p", FALSE), "c": said(), "d": said()}
    same = verdicts.report(old, old)
    assert "| all | 4 | 4 of 4, 100% (51% to 100%) | 3 of 4, 75% (30% to 95%) |" in same
    assert "became right:" not in same and "WRONG" not in same
    new = old | {"a": said("lag on p", FALSE), "b": said()}
    new["c"] = said() | {"sizes": {"gap on p": [1.2, 0.1]}}
    text = verdicts.report(old, new)
    assert "- became WRONG: a (gap): missing: named: gap on p -> " in text
    assert "- became right: b (gap)" in text
    assert "| all | 4 | 2 of 4, 50% (15% to 85%) |" in text
    assert f"- {NAME} -> {FALSE}: 1" in text
    assert "standard errors: 1 of 2" in text


def test_right_is_what_holds_a_true_effect_or_silence_where_nothing_has_a_name() -> (
    None
):
    names = {"gap on p"}
    assert verdicts.is_right(names, "", CLASS, "missing: named")
    assert not verdicts.is_right(names, "", SILENT, "missing: unexplained")
    quiet = "nothing missing"
    assert verdicts.is_right(set(), quiet, SILENT, quiet)
    assert not verdicts.is_right(set(), quiet, SILENT, "missing: unexplained")
    assert not verdicts.is_right(set(), quiet, FALSE, "missing: named")

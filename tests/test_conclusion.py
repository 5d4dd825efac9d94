"""Which effect is named, and what to do by a verdict."""

from typing import Any

import pytest

import phsi_opt as ph
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.conclusion import _Judge
from phsi_opt.diagnosis.next_step import next_step

DELAY = ph.Effect("sensor delay", "sensor", "q", ph.formula("a", a=ph.Parameter()))
FRICTION = ph.Effect("friction", "F", "p", ph.formula("b", b=ph.Parameter()))


def test_the_next_step_follows_from_the_verdict() -> None:
    name = ph.Finding((FRICTION,), "a loss", 1.0, 0.1, 0.9)
    of_class = ph.Finding((FRICTION, DELAY), "a loss", 1.0, 0.1, 0.9)

    def told(verdict: ph.Verdict, *findings: ph.Finding) -> str:
        analysis: Any = None  # what is found needs none
        return str(next_step(verdict, findings, analysis, {}))

    named = told(ph.Verdict.NAMED, name)
    assert named.startswith("Add friction on p.") and "study.auto" in named
    partly = told(ph.Verdict.PARTLY_NAMED, name)
    assert partly.startswith("Add friction on p, then diagnose again.")
    apart = told(ph.Verdict.NAMED, of_class)
    assert apart.startswith("Tell friction on p from sensor delay on q by")
    assert "found.separation" in apart
    assert told(ph.Verdict.NOTHING_MISSING).startswith("Nothing: what is left looks")


def candidate(name: str, log_bayes: float) -> Candidate:
    effect = ph.Effect(name, "F", "p", ph.formula("a", a=ph.Parameter()))
    return Candidate(effect, 1.0, 0.1, log_bayes=log_bayes, was_weighed=True)


@pytest.mark.parametrize(
    ("refused", "told", "tried"),
    [
        (set(), "first", ["first"]),
        ({"first"}, "third", ["first", "third"]),
        ({"first", "third"}, "nearest first", ["first", "third"]),
    ],
)
def test_what_is_refused_leaves_its_place_to_the_next_that_is_decisive(
    refused: set[str], told: str, tried: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With what the data do not tell from it; of all that are refused the first."""
    evidence = {"first": 60.0, "its twin": 59.0, "third": 30.0, "weak": 1.0}
    ranking = [candidate(name, value) for name, value in evidence.items()]
    base: Any = None
    judge = _Judge(base, base, [one.effect for one in ranking], ranking)
    refits: list[str] = []

    def refit(self: _Judge, place: int) -> str:
        refits.append(self.ranking[place].effect.name)
        return refits[-1]

    def named(self: _Judge, done: str, beside: None = None) -> str:
        return self.ranking[0].effect.name

    def not_named(self: _Judge, nearest: ph.Effect, done: str) -> str:
        assert done == nearest.name
        return f"nearest {nearest.name}"

    monkeypatch.setattr(_Judge, "refit", refit)
    monkeypatch.setattr(
        _Judge, "doubt", lambda _, done: "no" if done in refused else ""
    )
    monkeypatch.setattr(_Judge, "beside", lambda _, done: None)
    monkeypatch.setattr(_Judge, "named", named)
    monkeypatch.setattr(_Judge, "not_named", not_named)
    said: Any = judge.concluded()
    assert said == told
    assert refits == tried
    lost = {one.effect.name for one in judge.ranking if one.lost == "no"}
    assert lost == (refused | {"its twin"} if refused else set())

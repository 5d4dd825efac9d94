"""What a verdict makes of a pair that is not established, and what to do by it."""

from types import SimpleNamespace
from typing import Any

import pytest

import phsi_opt as ph
from phsi_opt.diagnosis import conclusion
from phsi_opt.diagnosis.conclusion import Conclusion
from phsi_opt.diagnosis.next_step import next_step

DELAY = ph.Effect("sensor delay", "sensor", "q", ph.formula("a", a=ph.Parameter()))
FRICTION = ph.Effect("friction", "F", "p", ph.formula("b", b=ph.Parameter()))
JUDGED = SimpleNamespace(rmse=0.0213, error_unit="rad")


def proposal_of(*effects: ph.Effect) -> Any:
    """What is proposed, as far as it is told."""
    partner = effects[1] if len(effects) > 1 else None
    candidate = SimpleNamespace(effect=effects[0], partner=partner, effects=effects)
    return SimpleNamespace(candidate=candidate, done=SimpleNamespace(judged=JUDGED))


BOTH, ALONE = proposal_of(FRICTION, DELAY), proposal_of(DELAY)
AGAINST = "the size of friction on p, 0.4 +- 0.1, is not clear enough"
UNCLEAR = Conclusion(ph.Verdict.UNEXPLAINED, "the nearest is both", against=AGAINST)
NAMED = Conclusion(
    ph.Verdict.PARTLY_NAMED,
    "sensor delay on q",
    (ph.Finding((DELAY,), "", 0.1, 0.01, 0.33),),
    (DELAY,),
)


def concluded(
    monkeypatch: pytest.MonkeyPatch, of_both: Conclusion, of_one: Conclusion
) -> Conclusion:
    """The verdict where each is judged so."""

    def judged(base: Any, proposed: Any, *others: Any) -> Conclusion:
        return of_both if proposed is BOTH else of_one

    monkeypatch.setattr(conclusion, "_concluded", judged)
    monkeypatch.setattr(conclusion, "parts_alone", lambda *_: [ALONE])
    nothing: Any = None
    return conclusion.conclusion(nothing, BOTH, (), ())


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


def test_of_a_pair_that_is_not_established_the_one_that_is_so_alone_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = concluded(monkeypatch, UNCLEAR, NAMED)
    assert found.verdict == ph.Verdict.PARTLY_NAMED
    assert found.effects == (DELAY,)
    assert found.reason == (
        "sensor delay on q. With friction on p too the error would be 0.0213 rad, "
        f"but {AGAINST}"
    )


def test_a_pair_stays_as_it_is_where_it_is_named_or_neither_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert concluded(monkeypatch, NAMED, UNCLEAR) is NAMED
    assert concluded(monkeypatch, UNCLEAR, UNCLEAR) is UNCLEAR

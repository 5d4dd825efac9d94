"""What to do by a verdict."""

from typing import Any

import phsi_opt as ph
from phsi_opt.diagnosis.record import next_step

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

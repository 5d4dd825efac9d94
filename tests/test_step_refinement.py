"""Steps between samples that follow from what they do to the estimates."""

import weakref
from dataclasses import replace

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem, StartingPoint
from phsi_opt.model_error.marginal_likelihood import OptimalitySystem

T = np.linspace(0.0, 12.0, 25)  # some six samples a period
STIFFNESS = 4.0


def coarse_record() -> ph.Measurements:
    rng = np.random.default_rng(0)
    runs = []
    for x0 in ([1.0, 0.0], [0.3, 1.5]):
        x = ph.simulate(spring(STIFFNESS), T, x0)
        runs.append(x + 0.01 * rng.normal(size=x.shape))
    return ph.Measurements.from_arrays([T] * 2, runs, states=["q", "p"])


def spring(k: float) -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/2", k=ph.Parameter(k, lower=0.0)),
    )


def test_coarse_samples_get_finer_steps() -> None:
    fit = ph.identify(spring(3.0), coarse_record())
    assert max(int(np.max(steps)) for steps in fit.steps) > 1
    assert abs(fit.estimates["k"] - STIFFNESS) < 4 * fit.std_errors["k"]


def test_where_finer_steps_lead_nowhere_the_optimum_stays_and_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    solve = LikelihoodProblem.solve

    def failing_beyond_one(
        self: LikelihoodProblem, start: StartingPoint, **options: object
    ) -> LikelihoodEstimate:
        found = solve(self, start, **options)  # type: ignore[arg-type]
        if not start.steps or max(int(np.max(s)) for s in start.steps) == 1:
            return found
        outcome = replace(found.solution.outcome, success=False)
        return replace(found, solution=replace(found.solution, outcome=outcome))

    monkeypatch.setattr(LikelihoodProblem, "solve", failing_beyond_one)
    fit = ph.identify(spring(3.0), coarse_record())
    assert fit.outcome.success
    assert max(int(np.max(steps)) for steps in fit.steps) == 1
    assert any("steps of integration are too long" in one for one in fit.warnings)


def test_finer_steps_have_the_room_of_the_factors_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    eliminate = OptimalitySystem.__init__
    solve = LikelihoodProblem.solve
    made: list[weakref.ref[OptimalitySystem]] = []
    n_finer = []

    def remembered(self: OptimalitySystem, *parts: object, **named: object) -> None:
        made.append(weakref.ref(self))
        eliminate(self, *parts, **named)  # type: ignore[arg-type]

    def with_room(
        self: LikelihoodProblem, start: StartingPoint, **options: object
    ) -> LikelihoodEstimate:
        if made:
            n_finer.append(True)
            assert all(before() is None for before in made)
        return solve(self, start, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(OptimalitySystem, "__init__", remembered)
    monkeypatch.setattr(LikelihoodProblem, "solve", with_room)
    ph.identify(spring(3.0), coarse_record())
    assert n_finer

"""A diagnosis with its re-fits side by side: the bits of one after the other."""

import pickle
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.comparison.compare import compare
from phsi_opt.diagnosis import refit_round
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.dry_friction import new_corners
from phsi_opt.diagnosis.friction_sharpening import may_extend
from phsi_opt.diagnosis.ranking import request_of
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.refit import Refit, RefitRequest, refit
from phsi_opt.diagnosis.refit_round import RefitRound, until_their_turn
from phsi_opt.estimation.problem import silent
from phsi_opt.optimization.settings import FEASIBLE_PATH
from phsi_opt.screening.prospects import Prospects
from phsi_opt.screening.score_test import ScoreTest
from phsi_opt.sweeps.local_workers import local_workers
from tests.sweep_tasks import Counted

# Stribeck's friction begins at a sharp fit of Coulomb's, hysteresis cannot be fitted,
# cubic stiffness is the second of a pair.
EFFECTS = [
    "coulomb friction",
    "stribeck friction",
    "hysteresis",
    "quadratic drag",
    "cubic stiffness",
    "gravity torque",
]
STIFFENS = "0.8*tanh(20*dH_dp) - 0.6*q**3"
STICKS = "0.8*tanh(200*dH_dp)"


def spring(
    k: ph.Parameter | float, c: ph.Parameter | float, force: str
) -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/2", k=k),
        R={"p": ph.formula("c", c=c)},
        F={"p": ph.formula(force)},
    )


def record(n_samples: int, seed: int, force: str = STIFFENS) -> ph.Measurements:
    """The position of a driven spring with a force that no model knows of."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n_samples)
    phases = np.outer(t, rng.uniform(0.3, 3.0, 6)) + rng.uniform(0, 2 * np.pi, 6)
    u = np.sin(phases).sum(axis=1, keepdims=True)
    x = ph.simulate(spring(2.0, 0.2, f"u - {force}"), t, [1.0, 0.0], u)
    y = x + 0.02 * x.std(axis=0) * rng.normal(size=x.shape)
    y[:, 1] = np.nan
    return ph.Measurements.from_arrays(t, y, u, states=["q", "p"], inputs=["u"])


@pytest.fixture(scope="module")
def workers() -> Iterator[Executor]:
    with local_workers(2) as found:
        yield found


def fitted(data: ph.Measurements) -> ph.Fit:
    unknown = ph.Parameter(1.0, lower=0)
    return ph.identify(spring(unknown, unknown, "u"), data)


@pytest.fixture(scope="module")
def fit() -> ph.Fit:
    return fitted(record(200, 0))


def diagnosed(fit: ph.Fit, executor: Any) -> tuple[Diagnosis, list[str]]:
    said: list[str] = []
    found = ph.diagnose(
        fit,
        record(200, 0),
        record(100, 1),
        effects=EFFECTS,
        executor=executor,
        progress=said.append,
    )
    # a solver that fails says at the end how many seconds it took
    return found, [line.split("(")[0] for line in said]


@pytest.fixture(scope="module")
def serial(fit: ph.Fit) -> tuple[Diagnosis, list[str]]:
    return diagnosed(fit, None)


def content(one: Candidate) -> list[Any]:
    """All numbers and words of a candidate."""
    found: list[Any] = []
    for name in one.__dataclass_fields__:
        if name not in ("effect", "partner", "fit", "trained", "comparison"):
            found.append(str(getattr(one, name)))
    found.append(one.name)
    if one.fit is not None and one.trained is not None and one.comparison is not None:
        found += [one.fit.estimates, one.fit.covariance.tobytes(), one.fit.noise]
        found += [run.tobytes() for run in one.trained.simulated]
        found += [run.tobytes() for run in one.comparison.simulated]
    return found


def assert_same(found: Diagnosis, expected: Diagnosis) -> None:
    assert found.verdict == expected.verdict
    assert found.reason == expected.reason
    assert found.proposed == expected.proposed
    assert found.candidates.equals(expected.candidates)
    pairs = zip(found.ranking, expected.ranking, strict=True)
    for one, other in pairs:
        assert content(one) == content(other)
    assert found.proposed_fit is not None and expected.proposed_fit is not None
    assert found.proposed_fit.estimates == expected.proposed_fit.estimates


def test_processes_and_threads_give_the_bits_of_one_process(
    fit: ph.Fit, serial: tuple[Diagnosis, list[str]], workers: Executor
) -> None:
    expected, said = serial
    assert any(line.startswith("not re-fitted: The solver failed") for line in said)
    assert [effect.name for effect in expected.proposed] == [
        "coulomb friction",
        "cubic stiffness",
    ]
    with ThreadPoolExecutor(2) as threads:
        for executor in (workers, threads):
            found, said_of_workers = diagnosed(fit, executor)
            assert_same(found, expected)
            assert said_of_workers == said


def test_re_fits_go_to_the_executor_and_share_the_records(fit: ph.Fit) -> None:
    counted = Counted()
    found, said = diagnosed(fit, counted)
    n_refits = sum(line.startswith("re-fitting") for line in said)
    assert 2 < len(counted.begun) <= n_refits
    for one in found.ranking:
        if one.trained is not None:
            assert one.trained.record.estimate is found.record.estimate
    pickle.dumps(found.proposed_fit)


def test_what_cannot_compute_is_refused(fit: ph.Fit) -> None:
    nothing: Any = 2
    with pytest.raises(ph.DataError, match="executor=2 has no submit"):
        diagnosed(fit, nothing)
    study = ph.Study(fit.model, record(200, 0))
    with pytest.raises(ph.DataError, match="executor=2 has no submit"):
        study.auto(executor=nothing)
    with pytest.raises(ph.DataError, match="executor=2 has no submit"):
        study.diagnose(executor=nothing)


def test_a_study_gives_the_bits_of_one_process(workers: Executor) -> None:
    train, held_out = record(200, 0, STICKS), record(100, 1, STICKS)
    model = fitted(train).model
    found = []
    for executor in (None, workers):
        study = ph.Study(model, train, held_out, effects=EFFECTS[:4])
        study.auto(max_steps=1, executor=executor)
        found.append(study)
    one, other = found
    assert one.added == other.added
    assert [effect.name for effect in one.added] == ["coulomb friction"]
    assert one.stopped == other.stopped
    assert one.history.equals(other.history)
    assert one.fit.estimates == other.fit.estimates
    # of a sharp fit, at which Stribeck's friction begins
    assert one.fit.outcome.way == FEASIBLE_PATH
    assert_same(other.record.diagnoses[0], one.record.diagnoses[0])


# ---- the turn of dry friction --------------------------------------------------------


@pytest.fixture(scope="module")
def base() -> DiagnosedModel:
    data = record(200, 0, STICKS)
    trained = compare(fitted(data), data)
    return DiagnosedModel(trained, trained, ph.MaximumLikelihood(), silent)


def requests(base: DiagnosedModel) -> dict[str, RefitRequest]:
    offered = ph.catalogue(base.fit.model)
    effects = [one for one in offered if one.name in EFFECTS]
    test = ScoreTest(base.record, base.trained.simulated)
    prospects = Prospects.of(test, effects, base.trained, None)
    return {one.effect.name: request_of(one, None, []) for one in prospects.singles}


def assert_same_refit(found: Refit | None, expected: Refit | None) -> None:
    assert found is not None and expected is not None
    assert found.fit.estimates == expected.fit.estimates
    assert found.fit.model.values == expected.fit.model.values
    assert found.trained.rmse == expected.trained.rmse
    assert found.before_sharpening is not None
    assert expected.before_sharpening is not None
    blunt = expected.before_sharpening.estimates
    assert found.before_sharpening.estimates == blunt


def is_sharpened(base: DiagnosedModel, done: Refit) -> bool:
    assert done.before_sharpening is not None
    blunt = done.before_sharpening.model.values
    sharp = done.fit.model.values
    widths = new_corners(done.fit.model, base.fit.model)
    return any(sharp[name] < blunt[name] for name in widths)


@pytest.mark.parametrize("has_rival", [True, False])
def test_dry_friction_that_is_not_first_is_sharpened_in_its_turn(
    base: DiagnosedModel, workers: Executor, has_rival: bool
) -> None:
    asked = requests(base)
    dry = asked["coulomb friction"]
    if has_rival:
        first = refit(base, dry)
        assert first is not None
        dry = RefitRequest(
            dry.effects, dry.values, dry.base_values, dry.states, rival=first.fit
        )
    expected = refit(base, dry)
    assert expected is not None
    assert is_sharpened(base, expected) != has_rival
    begun = until_their_turn({0: asked["quadratic drag"], 1: dry})
    assert begun[0].sharpens
    assert not begun[1].sharpens
    counted = Counted()
    for executor in (workers, counted):
        at_workers: Any = executor
        beside = DiagnosedModel(
            base.trained, base.judged, base.loss, silent, executor=at_workers
        )
        with RefitRound(beside, begun) as refits:
            assert_same_refit(refits.refit(1, dry), expected)
    assert len(counted.begun) == 2


def test_what_fails_before_its_turn_is_tried_in_it_where_that_may_differ(
    base: DiagnosedModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    dry = requests(base)["coulomb friction"]
    said: list[str] = []
    at: Any = Counted()

    def fails(*_: object) -> Refit:
        raise ph.SolveError("at a worker")

    monkeypatch.setattr(refit_round, "refitted", fails)
    beside = DiagnosedModel(
        base.trained, base.judged, base.loss, said.append, executor=at
    )
    with RefitRound(beside, until_their_turn({0: dry, 1: dry})) as refits:
        assert refits.refit(0, dry) is None
        assert said == ["not re-fitted: at a worker"]
        assert_same_refit(refits.refit(1, dry), refit(base, dry))
        assert len(said) == 1


def test_a_law_that_holds_another_begins_at_its_sharp_fit(base: DiagnosedModel) -> None:
    asked = requests(base)
    coulomb = asked["coulomb friction"].effects
    stribeck = asked["stribeck friction"].effects
    assert may_extend(base, stribeck, coulomb)
    assert not may_extend(base, coulomb, stribeck)
    assert not may_extend(base, asked["hysteresis"].effects, coulomb)
    assert not may_extend(base, coulomb, asked["quadratic drag"].effects)

"""A diagnosis with its models weighed side by side: the bits of one after the other."""

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.sweeps.local_workers import local_workers

EFFECTS = ["coulomb friction", "quadratic drag", "cubic stiffness", "gravity torque"]
STIFFENS = "1.2*q**3"
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
    return fitted(record(120, 0))


def diagnosed(fit: ph.Fit, executor: Any) -> tuple[Diagnosis, list[str]]:
    said: list[str] = []
    records = record(120, 0), record(60, 1)
    options: Any = {"effects": EFFECTS, "executor": executor, "progress": said.append}
    found = ph.diagnose(fit, *records, **options)
    # a solver that fails says at the end how many seconds it took
    return found, [line.split("(")[0] for line in said]


@pytest.fixture(scope="module")
def serial(fit: ph.Fit) -> tuple[Diagnosis, list[str]]:
    return diagnosed(fit, None)


def content(one: Candidate) -> list[Any]:
    """All numbers and words of a candidate."""
    found: list[Any] = []
    for name in one.__dataclass_fields__:
        if name not in ("effect", "states", "fit", "trained", "comparison"):
            found.append(str(getattr(one, name)))
    if one.states is not None:
        found.append(one.states.tobytes())
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
    assert sum(line.startswith("weighing") for line in said) > 1
    assert expected.findings
    with ThreadPoolExecutor(2) as threads:
        for executor in (workers, threads):
            found, said_of_workers = diagnosed(fit, executor)
            assert_same(found, expected)
            assert said_of_workers == said


def test_what_cannot_compute_is_refused(fit: ph.Fit) -> None:
    nothing: Any = 2
    with pytest.raises(ph.DataError, match="executor=2 has no submit"):
        diagnosed(fit, nothing)
    study = ph.Study(fit.model, record(120, 0))
    with pytest.raises(ph.DataError, match="executor=2 has no submit"):
        study.auto(executor=nothing)
    with pytest.raises(ph.DataError, match="executor=2 has no submit"):
        study.diagnose(executor=nothing)


def test_a_study_gives_the_bits_of_one_process(workers: Executor) -> None:
    train, held_out = record(120, 0, STICKS), record(60, 1, STICKS)
    model = fitted(train).model
    found = []
    for executor in (None, workers):
        study = ph.Study(model, train, held_out, effects=EFFECTS)
        study.auto(max_steps=1, executor=executor)
        found.append(study)
    one, other = found
    assert one.added == other.added
    assert [effect.name for effect in one.added] == ["coulomb friction"]
    assert one.stopped == other.stopped
    assert one.history.equals(other.history)
    assert one.fit.estimates == other.fit.estimates
    assert_same(other.record.diagnoses[0], one.record.diagnoses[0])

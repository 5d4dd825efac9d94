"""Diagnoses, starts and re-fits side by side: the bits of one after the other."""

import hashlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import phsi_opt as ph
from phsi_opt.blas import one_thread
from phsi_opt.sweeps.local_workers import THREAD_VARIABLES, local_workers
from phsi_opt.sweeps.sweep import ahead
from problems.judges.fit_cases import PROBLEMS
from tests import sweep_tasks
from tests.sweep_tasks import Counted
from tests.systems import spring

EFFECTS = ["coulomb friction", "quadratic drag", "cubic stiffness", "gravity torque"]
STIFFENS = "1.2*q**3"


def record(n_samples: int, seed: int, force: str = STIFFENS) -> ph.Measurements:
    """The position of a driven spring with a force that no model knows of."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n_samples)
    phases = np.outer(t, rng.uniform(0.3, 3.0, 6)) + rng.uniform(0, 2 * np.pi, 6)
    u = np.sin(phases).sum(axis=1, keepdims=True)
    x = ph.simulate(spring(2.0, 0.2, F=f"u - {force}"), t, [1.0, 0.0], u)
    y = x + 0.02 * x.std(axis=0) * rng.normal(size=x.shape)
    y[:, 1] = np.nan
    return ph.Measurements.from_arrays(t, y, u, states=["q", "p"], inputs=["u"])


@pytest.fixture(scope="module")
def workers() -> Iterator[Executor]:
    with local_workers(2) as found:
        yield found


def fitted(data: ph.Measurements) -> ph.Fit:
    unknown = ph.Parameter(1.0, lower=0)
    return ph.identify(spring(unknown, unknown, F="u"), data)


@pytest.fixture(scope="module")
def fit() -> ph.Fit:
    return fitted(record(120, 0))


def diagnosed(fit: ph.Fit, executor: Any) -> tuple[ph.Diagnosis, list[str]]:
    said: list[str] = []
    records = record(120, 0), record(60, 1)
    options: Any = {"effects": EFFECTS, "executor": executor, "progress": said.append}
    found = ph.diagnose(fit, *records, **options)
    # a solver that fails says at the end how many seconds it took
    return found, [line.split("(")[0] for line in said]


@pytest.fixture(scope="module")
def serial(fit: ph.Fit) -> tuple[ph.Diagnosis, list[str]]:
    return diagnosed(fit, None)


def content(one: ph.Candidate) -> list[Any]:
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


def assert_same(found: ph.Diagnosis, expected: ph.Diagnosis) -> None:
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
    fit: ph.Fit, serial: tuple[ph.Diagnosis, list[str]], workers: Executor
) -> None:
    expected, said = serial
    assert sum(line.startswith("computing the evidence of") for line in said) > 1
    assert expected.findings
    with ThreadPoolExecutor(2) as threads:
        for executor in (workers, threads):
            found, said_of_workers = diagnosed(fit, executor)
            assert_same(found, expected)
            assert said_of_workers == said


def test_what_cannot_compute_is_refused(fit: ph.Fit) -> None:
    nothing: Any = 2
    with pytest.raises(ph.DataError, match=r"executor=2 .* a method submit"):
        diagnosed(fit, nothing)
    study = ph.Study(fit.model, record(120, 0))
    with pytest.raises(ph.DataError, match=r"executor=2 .* a method submit"):
        study.auto(executor=nothing)
    with pytest.raises(ph.DataError, match=r"executor=2 .* a method submit"):
        study.diagnose(executor=nothing)


# ---- starts side by side

STARTS = ph.MaximumLikelihood(starts=4)


# ---- what is computed ahead ----------------------------------------------------------


def test_lines_and_errors_come_when_their_case_is_asked_for(workers: Executor) -> None:
    cases = {str(n): n for n in range(1, 5)}
    for executor in (None, workers):
        said: list[str] = []
        with closing(ahead(sweep_tasks.halved, cases, executor, said.append)) as calls:
            first, second, third = islice(calls, 3)
            assert second() == 1
            assert first() == 0.5
            with pytest.raises(ph.SolveError, match="three"):
                third()
        assert said == ["halving 2", "halving 1", "halving 3"]


# ---- starts --------------------------------------------------------------------------


def identified(executor: Any, **asked: Any) -> tuple[ph.Fit, list[str]]:
    said: list[str] = []
    fit = ph.identify(
        sweep_tasks.model(),
        sweep_tasks.data(3),
        STARTS,
        executor=executor,
        progress=said.append,
        **asked,
    )
    return fit, said


def assert_same_fit(found: ph.Fit, expected: ph.Fit) -> None:
    assert found.estimates == expected.estimates
    assert np.array_equal(found.covariance, expected.covariance)
    assert found.bic == expected.bic
    assert found.loss_value == expected.loss_value
    assert found.noise == expected.noise
    assert found.warnings == expected.warnings
    assert found.outcome.iterations == expected.outcome.iterations
    for x, of_expected in zip(found.states, expected.states, strict=True):
        assert np.array_equal(x, of_expected)


def test_starts_in_processes_give_the_bits_of_one_process(workers: Executor) -> None:
    serial, said = identified(None)
    found, said_of_workers = identified(workers)
    assert_same_fit(found, serial)
    counted = Counted()
    identified(counted)
    assert len(counted.begun) == STARTS.starts
    assert "4 of 4 starting points led to the best solution" in found.warnings
    # each line tells of a solve, and ends with its seconds
    assert [line.split("(")[0] for line in said_of_workers] == [
        line.split("(")[0] for line in said
    ]


def test_ctrl_c_cancels_the_starts_that_are_not_begun() -> None:
    class Pressed:
        begun: ClassVar[list[Future[Any]]] = []

        def submit(self, fn: Any, /, *args: Any) -> Future[Any]:
            if len(self.begun) == 2:
                signal.raise_signal(signal.SIGINT)
                pytest.fail("Ctrl-C was not raised")  # rather than wait for ever
            self.begun.append(Future())
            return self.begun[-1]

    with pytest.raises(KeyboardInterrupt):
        identified(Pressed())
    assert [future.cancelled() for future in Pressed.begun] == [True, True]


# ---- other processes -----------------------------------------------------------------


def fit_digest() -> str:
    """Of a fit with a large dictionary, solved by IPOPT, and its standard errors."""
    problem = PROBLEMS["Schroedinger, noisy, pruned"]()
    fit = ph.identify(problem.model, problem.data, **problem.options)
    parts = [fit.estimates, fit.std_errors]
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def study_digest(folder: Path) -> str:
    """Of a study with a diagnosis, an effect and a report."""
    unknown = ph.Parameter(1.0, lower=0)
    model = spring(unknown, unknown, F="u")
    study = ph.Study(model, record(150, 0), record(60, 1), effects=EFFECTS)
    study.auto(1)
    assert study.added
    report = study.report(folder / "report.html").read_text("utf-8")
    found = study.diagnose()
    parts = [study.fit.estimates, found.candidates.to_csv(), found.reason, report]
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def elsewhere(call: str, seed: str, n_threads: str) -> str:
    """What a process with another order of sets, and threads of BLAS, prints."""
    threads = dict.fromkeys(THREAD_VARIABLES, n_threads)
    environment = {**os.environ, **threads, "PYTHONHASHSEED": seed}
    code = f"from pathlib import Path\nfrom tests.test_executor import *\nprint({call})"
    run = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parents[1],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return run.stdout.strip()


@pytest.mark.slow
def test_a_study_and_its_report_are_the_same_in_another_process(tmp_path) -> None:
    expected = study_digest(tmp_path)
    there = elsewhere(f"study_digest(Path({str(tmp_path)!r}))", seed="7", n_threads="2")
    assert there == expected


@pytest.mark.slow
def test_a_large_fit_is_the_same_with_more_threads() -> None:
    with ThreadPoolExecutor(2) as threads:
        found = set(threads.map(partial(elsewhere, "fit_digest()", "3"), "124"))
    assert len(found) == 1


def test_blas_has_its_threads_again_after_a_long_call() -> None:
    def n_threads() -> list[int]:
        return [
            one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"
        ]

    with threadpool_limits(2, user_api="blas"):
        before = n_threads()
        with one_thread(), one_thread():
            assert set(n_threads()) == {1}
        assert n_threads() == before

"""Starts and re-fits side by side: the bits, lines and errors of one after the other."""

import signal
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from contextlib import closing
from typing import Any, ClassVar

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.sweeps.local_workers import local_workers
from phsi_opt.sweeps.sweep import Ahead
from tests import sweep_tasks
from tests.sweep_tasks import Counted

STARTS = ph.MaximumLikelihood(starts=4)
NOT_AN_EXECUTOR: Any = print


@pytest.fixture(scope="module")
def workers() -> Iterator[Executor]:
    with local_workers(2) as found:
        yield found


# ---- what is computed ahead ----------------------------------------------------------


def test_lines_and_errors_come_when_their_case_is_asked_for(workers: Executor) -> None:
    cases = {str(n): n for n in range(1, 5)}
    for executor in (None, workers):
        said: list[str] = []
        ahead = Ahead(sweep_tasks.halved, cases, executor, said.append)
        with closing(ahead):
            assert ahead.result("4") == 2
            assert ahead.result("1") == 0.5
            with pytest.raises(ph.SolveError, match="three"):
                ahead.result("3")
        assert said == ["halving 4", "halving 1", "halving 3"]


class Slow:
    """Has done the first of five cases when it has got all of them."""

    def __init__(self) -> None:
        self.begun: list[Future[Any]] = []

    def submit(self, fn: Any, /, *args: Any) -> Future[Any]:
        if not self.begun:
            self.first = fn(*args)
        self.begun.append(Future())
        if len(self.begun) == 5:
            self.begun[0].set_result(self.first)
        return self.begun[-1]


def test_what_is_not_asked_for_is_cancelled() -> None:
    slow = Slow()
    executor: Any = slow
    cases = {str(n): n for n in range(5)}
    ahead = Ahead(sweep_tasks.halved, cases, executor, print)
    assert ahead.result("0") == 0
    assert not any(future.cancelled() for future in slow.begun)
    ahead.close()
    assert [future.cancelled() for future in slow.begun] == [False, *4 * [True]]
    counted: Any = Counted()
    one_case = Ahead(sweep_tasks.halved, {"1": 1}, counted, print)
    assert one_case.result("1") == 0.5
    assert not counted.begun  # it would gain nothing elsewhere


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


def test_what_cannot_compute_is_refused() -> None:
    with pytest.raises(ph.DataError, match="has no submit"):
        identified(NOT_AN_EXECUTOR)
    with pytest.raises(ph.DataError, match="has no submit"):
        ph.sweep(sweep_tasks.square, {"a": 1}, executor=NOT_AN_EXECUTOR)

"""Ctrl-C ends a long call as KeyboardInterrupt wherever it comes, and nothing after it
is different.
"""

import contextlib
import signal
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.data.text_tables import table_of_csv
from phsi_opt.interrupts import interruptible, is_noted, solving
from phsi_opt.model_error.joint_estimate import JointProblem
from phsi_opt.optimization import ipopt
from phsi_opt.transcription.likelihood_values import LikelihoodValues, PointValues
from tests.systems import recorded, spring
from tests.waiting import HANGS_AFTER

T = np.linspace(0, 10, 101)
SPRING = spring(ph.Parameter(1.0))


def press() -> None:
    signal.raise_signal(signal.SIGINT)


def record(k: float = 1.4) -> ph.Measurements:
    truth = SPRING.with_values({"k": k, "R_p": 0.1})
    return recorded(truth, T, [1.0, 0.0], seed=1)


def is_quiet() -> bool:
    handler = signal.getsignal(signal.SIGINT)
    return handler is signal.default_int_handler and not is_noted()


@pytest.mark.parametrize(("place", "step", "loss"), [
    (ipopt._Listener, "eval", ph.MaximumLikelihood(huber=3.0)),  # by IPOPT
    (JointProblem, "_lower", ph.MaximumLikelihood()),  # by full steps
])  # fmt: skip
def test_a_solve_ends_after_the_step_in_which_ctrl_c_is_pressed(
    place: type, step: str, loss: ph.MaximumLikelihood, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = ph.identify(SPRING, record(), loss).values
    original = getattr(place, step)
    was_noted = []

    def pressed(self: Any, *given: Any) -> Any:
        was_noted.append(is_noted())
        if len(was_noted) == 2:
            press()
        return original(self, *given)

    with monkeypatch.context() as patched:
        patched.setattr(place, step, pressed)
        with pytest.raises(KeyboardInterrupt):
            ph.identify(SPRING, record(), loss)
    assert was_noted == [False, False]
    assert is_quiet()
    assert ph.identify(SPRING, record(), loss).values == expected


def test_reading_ends_where_a_called_library_loses_ctrl_c(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As a callback of Python itself does: it prints the exception and goes on."""
    file = tmp_path / "record.csv"
    file.write_text("t,q\n0,1\n1,2\n2,3\n")

    def lossy(*given: Any) -> Any:
        with contextlib.suppress(KeyboardInterrupt):
            press()
        return table_of_csv(*given)

    with monkeypatch.context() as patched:
        patched.setattr("phsi_opt.data.table_readers.table_of_csv", lossy)
        with pytest.raises(KeyboardInterrupt):
            ph.Measurements.from_csv(file, time="t", states=["q"])
    assert is_quiet()
    assert ph.Measurements.from_csv(file, time="t", states=["q"]).n_samples == 3


def test_an_interrupt_that_became_another_error_or_none_is_raised_as_what_it_is() -> (
    None
):
    @interruptible
    def another() -> None:
        try:
            press()
        except KeyboardInterrupt:
            raise RuntimeError("a result with an exception set") from None

    @interruptible
    def lost() -> int:
        try:
            press()
        except KeyboardInterrupt:
            return 1
        return 0

    @interruptible
    def swallowed() -> None:  # the next solve does not begin
        with contextlib.suppress(KeyboardInterrupt):
            press()
        with solving():
            pytest.fail("it begins")

    for call in (another, lost, swallowed):
        with pytest.raises(KeyboardInterrupt):
            call()
        assert is_quiet()


def test_a_second_ctrl_c_does_not_wait_for_the_solver() -> None:
    reached = []
    with pytest.raises(KeyboardInterrupt), solving():
        press()
        reached.append(1)
        press()
        reached.append(2)
    assert reached == [1]
    assert is_quiet()


def test_a_study_goes_on_after_an_interrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    study = ph.Study(SPRING, record())
    n_evaluated = 0
    values_at = LikelihoodValues.at

    def pressed(likelihood: LikelihoodValues, z: np.ndarray) -> PointValues:
        nonlocal n_evaluated
        n_evaluated += 1
        press()
        return values_at(likelihood, z)

    with monkeypatch.context() as patched:
        patched.setattr(LikelihoodValues, "at", pressed)
        with pytest.raises(KeyboardInterrupt):
            study.add("cubic stiffness")
    assert n_evaluated == 1
    assert list(study.history["effect"]) == ["base model"]
    study.add("cubic stiffness")
    assert len(study.history) == 2


def test_solvers_of_other_threads_leave_ctrl_c_to_the_main_one() -> None:
    """Two whose work overlaps, the one that began first ending first."""
    events = {name: threading.Event() for name in ("both solve", "first is done")}

    def first() -> None:
        with solving():
            second_thread.start()
            assert events["both solve"].wait(HANGS_AFTER)
        events["first is done"].set()

    def second() -> None:
        with solving():
            events["both solve"].set()
            assert events["first is done"].wait(HANGS_AFTER)

    second_thread = threading.Thread(target=second)
    first_thread = threading.Thread(target=first)
    first_thread.start()
    first_thread.join()
    second_thread.join()

    went_on = []

    @interruptible
    def pressed() -> None:
        press()
        went_on.append(True)

    with pytest.raises(KeyboardInterrupt):
        pressed()
    assert not went_on and is_quiet()

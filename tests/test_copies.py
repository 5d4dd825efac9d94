"""Runs that are copies of one another count once, and that is told."""

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.data.copies import check_can_judge, copies_in, sentence_about
from tests.systems import spring

T = np.linspace(0, 5, 51)
SPRING = spring(ph.Parameter(1.0))


def swing(seed: int, *hidden: int) -> np.ndarray:
    """A noisy swing of the spring, (n_samples, 2), NaN where a state is hidden."""
    truth = SPRING.with_values({"k": 1.4, "R_p": 0.1})
    x = ph.simulate(truth, T, [1.0, 0.0])
    noisy = x + 0.01 * np.random.default_rng(seed).normal(size=x.shape)
    noisy[:, list(hidden)] = np.nan
    return noisy


def runs(
    *x: np.ndarray, starts: tuple[float, ...] = (), names: list[str] | None = None
) -> ph.Measurements:
    starts = starts or (0.0,) * len(x)
    t = [T + start for start in starts]
    return ph.Measurements.from_arrays(t, list(x), states=["q", "p"], names=names)


@pytest.mark.parametrize("loss", [ph.MaximumLikelihood(), ph.PHSILoss()])
def test_copies_of_a_run_leave_the_fit_of_that_run(loss) -> None:
    one = ph.identify(SPRING, runs(swing(1)), loss)
    data = runs(*[swing(1)] * 200)
    fit = ph.identify(SPRING, data, loss)
    assert fit.std_errors == one.std_errors
    assert fit.values == one.values
    (warning,) = [said for said in fit.warnings if "copies" in said]
    assert warning.startswith("'run 2', 'run 3', 'run 4', ")
    assert " more are copies of 'run 1': used only once" in warning
    assert data.n_trajectories == 200


def test_a_copy_is_told_by_what_was_measured_whatever_its_name_and_clock() -> None:
    data = runs(
        *[swing(1, 1), swing(2, 1), swing(1, 1), swing(1), swing(1, 1)],
        starts=(0, 0, 1000.1, 0, 0),
        names=["a", "b", "later", "with p", "again"],
    )
    assert copies_in(data) == {"later": "a", "again": "a"}
    assert sentence_about(copies_in(data)).startswith(
        "'later', 'again' are copies of 'a': used only once"
    )


def test_runs_that_differ_or_are_equal_by_chance_are_no_copies() -> None:
    at_rest = np.zeros((len(T), 2))
    assert not copies_in(runs(at_rest, at_rest))
    x = swing(1)
    slower = ph.Measurements.from_arrays([T, 1.001 * T], [x, x], states=["q", "p"])
    assert not copies_in(slower)
    u = np.ones(len(T))
    driven = ph.Measurements.from_arrays(
        [T, T], [x, x], [u, 2 * u], states=["q", "p"], inputs=["u"]
    )
    assert not copies_in(driven)
    assert not copies_in(runs(x, swing(2), swing(3)))  # repetitions


@pytest.mark.parametrize("size", [1e-15, 1e-6, 3e-3])
def test_runs_with_the_same_noise_are_copies_with_another_noise_beside_it(size) -> None:
    rng = np.random.default_rng(5)
    exports = [swing(1) + size * rng.normal(size=(len(T), 2)) for _ in range(4)]
    data = runs(*exports)
    assert copies_in(data) == dict.fromkeys(["run 2", "run 3", "run 4"], "run 1")
    one = ph.identify(SPRING, runs(exports[0]))
    assert ph.identify(SPRING, data).std_errors == one.std_errors


def test_repetitions_of_a_fast_motion_are_no_copies() -> None:
    """The cubic through the neighbours misses all of them by the same, noise or not."""
    t = np.arange(60) * 1.0
    rng = np.random.default_rng(6)
    x = [np.sin(1.1 * t) + 0.002 * rng.normal(size=60) for _ in range(3)]
    data = ph.Measurements.from_arrays([t] * 3, x, states=["q"])
    assert not copies_in(data)


def test_repetitions_that_share_a_model_error_are_not_independent() -> None:
    """Their scatter does not show the error that all of them have."""
    stiffening = SPRING.add("cubic stiffness", "p")
    truth = stiffening.with_values({"k": 1.4, "R_p": 0.1, "cubic_stiffness_q": 0.3})
    x = ph.simulate(truth, T, [1.0, 0.3])
    rng = np.random.default_rng(7)
    noisy = [x + 0.01 * rng.normal(size=x.shape) for _ in range(12)]
    fit = ph.identify(SPRING, runs(*noisy))
    assert fit.std_error_source == "model error"
    assert fit.std_errors["k"] > 5 * fit.standard_errors["white noise"]["k"]


def test_a_study_tells_copies_and_refuses_a_judge_that_was_fitted() -> None:
    said: list[str] = []
    train = runs(swing(1), swing(2), swing(1))
    study = ph.Study(
        SPRING, train, runs(swing(3), swing(3)), effects=[], progress=said.append
    )
    assert any(line.startswith("'run 3' is a copy of 'run 1'") for line in said)
    assert any(line.startswith("held out: 'run 2' is a copy") for line in said)
    assert study.train.n_trajectories == 2
    assert study.held_out is not None and study.held_out.n_trajectories == 1
    held_out = runs(swing(3), swing(2), names=["new", "old"])
    message = "held out: 'old' is a copy of 'run 2' of the training data"
    with pytest.raises(ph.DataError, match=message):
        ph.Study(SPRING, train, held_out)
    with pytest.raises(ph.DataError, match=message):
        ph.diagnose(study.fit, train, held_out)
    check_can_judge(train, held_out[:1])
    with pytest.raises(ph.DataError, match="'run 1' is a copy of 'run 1'"):
        check_can_judge(train, train[:1])

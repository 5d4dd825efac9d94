"""The battery of simulated machines: motions, draws, answers, scores, pages (not the
diagnosis: that is what it examines).
"""

import numpy as np
import pytest

import phsi_opt as ph
from problems.battery import ask, score
from problems.battery import experiments as field
from problems.battery.ask import CLASS, FALSE, NAME, SILENT, Task
from problems.battery.draw import KINDS, ROWS, Row, draw
from problems.battery.effects import Hidden
from problems.battery.field_machines import spring, viscous
from problems.battery.masses import Machine, measured, simulate
from problems.battery.records import (
    FIELD,
    HIDDEN,
    Case,
    RunawayError,
    Truth,
    integrated,
)
from problems.battery.tanks import tank_states
from problems.judges import battery

ZERO = np.zeros(1)


def damped(t: np.ndarray, m: float, k: float, c: float) -> np.ndarray:
    """q(t) of a damped spring from q = 1 at rest, in closed form."""
    decay = c / m / 2
    omega = np.sqrt(k / m - decay**2)
    return np.exp(-decay * t) * (np.cos(omega * t) + decay / omega * np.sin(omega * t))


# --- motions


def test_machines_move_as_the_closed_form_says() -> None:
    t = np.linspace(0.0, 9.0, 91)
    starts = np.array([[1.0, 0.0]])
    machine = Machine(np.array([2.0]), np.array([3.0]), ZERO, ZERO, np.asarray(0.0))
    hidden = (Hidden("linear stiffness", 0, 0.4), Hidden("viscous damping", 0, 0.3))
    found = simulate(machine, hidden, starts, None, t)[:, 0, 0]
    # RTOL = 1e-8 per step, a few hundred steps
    assert found == pytest.approx(damped(t, 2.0, 3.4, 0.3), abs=1e-5)
    e = spring(2.0, 3.4, 0.0, viscous(2.0, 1.0), t, starts, 1)
    motion = field.simulate(e, 0.3)
    assert motion.x[:, 0, 0] == pytest.approx(damped(t, 2.0, 3.4, 0.3), abs=1e-5)


def test_a_delayed_sensor_shows_what_the_state_was() -> None:
    t = np.linspace(0.0, 5.0, 51)
    machine = Machine(np.ones(1), np.ones(1), ZERO, ZERO, np.asarray(0.0))
    delay = (Hidden("sensor delay", 0, 0.25),)
    y = measured(machine, delay, np.array([[1.0, 0.0]]), None, t)[:, 0]
    # the record begins one delay after the start: q(t) = cos(t + 0.25), shown late
    assert y[:, 0] == pytest.approx(np.cos(t), abs=1e-6)
    assert y[:, 1] == pytest.approx(-np.sin(t + 0.25), abs=1e-6)


def test_healthy_tanks_are_those_of_the_thesis_and_a_leak_empties_them() -> None:
    from problems.thesis.systems import closed_tanks, tank_matrix

    x = np.random.default_rng(0).normal(size=9)
    assert tank_matrix() @ x == pytest.approx(closed_tanks(0.0, x), rel=1e-12)
    starts, t = np.r_[np.zeros(5), np.ones(4)][None, :], np.linspace(0.0, 1.0, 11)
    held = tank_states(starts, t)[:, 0, 5:].sum(axis=1)
    left = tank_states(starts, t, "linear leak", 7, 0.5)[:, 0, 5:].sum(axis=1)
    assert held == pytest.approx(np.full(11, 4.0), abs=1e-6)
    assert np.all(np.diff(left) < 0)


@pytest.mark.parametrize("power", [2, 3])  # ends in infinity at t = 1 and at 1/2
def test_the_integration_of_a_motion_that_ends_in_infinity_ends(power: int) -> None:
    times = np.linspace(0.0, 4.0, 50)
    with pytest.raises(RunawayError, match="could not be simulated"):
        integrated(lambda _, x: x**power, np.ones(1), times, float(times[1]))


# --- cases


@pytest.mark.parametrize(("row", "seed"), [
    (ROWS["linear_stiffness_0.01"], 4),
    (ROWS["tanks"], 4),
    (KINDS["falling"], 4),
    (KINDS["closed_loop"], 4),
    (KINDS["chamber"], 4),
    (KINDS["starts_off"], 7),
    (KINDS["sensors"], 4),
    (KINDS["nothing"], 4),
], ids=lambda x: x if isinstance(x, int) else x.name)  # fmt: skip
def test_a_case_depends_on_row_and_seed_alone(row: Row, seed: int) -> None:
    first, again = draw(row, seed), draw(row, seed)
    assert first.train.digest == again.train.digest
    assert first.test.digest == again.test.digest
    assert first.model.values == again.model.values
    assert (first.truths, first.size) == (again.truths, again.size)
    assert first.train.n_samples < 1000


def test_the_calibrated_error_is_that_of_a_refit_and_the_truth_has_no_misfit() -> None:
    case = draw(ROWS["cubic_stiffness_0.03"], 4)
    comparison = ph.compare(ph.identify(case.model, case.train), case.train)
    ratio = case.ratio
    # the noise floor is estimated, and the noise moves the fit
    assert comparison.rmse / comparison.noise_floor == pytest.approx(ratio, rel=0.1)
    # two held-out runs: about a thousand values, 2 % by chance, and the held-out runs
    # have other deviations
    assert ask.floor(case) == pytest.approx(comparison.noise_floor, rel=0.25)
    # SRK4 between samples leaves an error far below the noise
    assert ask.misfit(case, case.model.add(true_effect(case))) < 0.1 * ask.DETECTED


def true_effect(case: Case) -> ph.Effect:
    """The catalogue's effect that was hidden."""
    (truth,) = case.truths
    return next(e for e in ph.catalogue(case.model) if str(e) in truth.places)


# --- answers and scores


def test_two_effects_are_right_only_when_each_is_found_once_and_nothing_else() -> None:
    gap, coupling = "gap on p1", "coupling stiffness on p2"
    truths = (Truth(("gap",), ("p1",)), Truth(("coupling stiffness",), ("p1", "p2")))
    assert ask.matches(truths, [{coupling}, {gap}])
    assert ask.matches(truths, [{coupling}, {"cubic stiffness on p1", gap}])
    assert not ask.matches(truths, [{gap}])
    assert not ask.matches(truths, [{gap}, {"gap on p2"}])
    assert not ask.matches(truths, [{gap}, {coupling}, {"constant force on p1"}])


def test_answers_are_right_false_or_silent() -> None:
    right = {"viscous damping on p", "linear leak on p"}
    one = frozenset({"viscous damping on p"})
    several = frozenset({"linear leak on p", "cubic drag on p"})
    wrong = frozenset({"hysteresis on p"})
    assert ask.answer(right, {one}) == NAME
    assert ask.answer(right, {several}) == CLASS
    assert ask.answer(right, {one, wrong}) == FALSE
    assert ask.answer(set(), {one}) == FALSE
    assert ask.answer(right, set()) == SILENT


def test_a_diagnosis_that_fails_is_recorded_and_counted(monkeypatch) -> None:
    def broken(*arguments: object, **options: object) -> None:
        raise ph.SolveError("no way")

    monkeypatch.setattr(ph, "diagnose", broken)
    found = ask.examined(Task(HIDDEN, "nothing", 1))
    assert (found["right"], found["outcome"]) == (False, "SolveError: no way")
    task = Task(HIDDEN, "nothing", 1)
    rows, _ = battery.tables({str(task): found}, [task])
    assert score.summary_row("nothing", rows)["failed"] == 1
    monkeypatch.setattr(ph, "Study", broken)
    found = ask.examined(Task(FIELD, "chamber", 0))
    assert (found["answer"], found["outcome"]) == (SILENT, "SolveError: no way")

"""The battery of hidden effects: its machines, its sizes, its scores (not the
diagnosis: that is what it examines).
"""

import numpy as np
import pandas as pd
import pytest

import phsi_opt as ph


def _free_fall_of_one_mass(**hidden: float) -> np.ndarray:
    """q(t) of m = 2, k = 3 with one hidden effect given as name=size, from q = 1 at
    rest.
    """
    from problems.hidden_effects.truth import Hidden, Machine, simulate

    zero = np.zeros(1)
    machine = Machine(np.array([2.0]), np.array([3.0]), zero, zero, np.asarray(0.0))
    effects = tuple(
        Hidden(name.replace("_", " "), 0, size, {"sign": 1.0})
        for name, size in hidden.items()
    )
    return simulate(
        machine, effects, np.array([[1.0, 0.0]]), None, np.linspace(0.0, 9.0, 91)
    )[:, 0, 0]


def test_hidden_stiffness_and_damping_move_the_mass_as_the_closed_form_says() -> None:
    t, k, c = np.linspace(0.0, 9.0, 91), 3.0 + 0.4, 0.3
    decay, omega = c / 4, np.sqrt(k / 2 - (c / 4) ** 2)
    expected = np.exp(-decay * t) * (
        np.cos(omega * t) + decay / omega * np.sin(omega * t)
    )
    found = _free_fall_of_one_mass(linear_stiffness=0.4, viscous_damping=0.3)
    # RTOL=1e-8 per step, a few hundred steps
    assert found == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("hold", ["linear", "zero"])
def test_quick_and_tight_simulation_agree_with_an_input_that_is_delayed_and_lagged(
    hold: str,
) -> None:
    from problems.hidden_effects.truth import Drive, Hidden, Machine, simulate

    rng, t = np.random.default_rng(3), np.linspace(0.0, 12.0, 61)
    machine = Machine(
        np.array([1.0, 2.0]),
        np.array([1.0, 1.5]),
        np.full(2, 0.2),
        np.full(2, 0.1),
        np.asarray(0.4),
        pushed=1,
    )
    drive = Drive(float(t[1]), rng.normal(size=(2, len(t))), hold)
    hidden = (
        Hidden("input delay", 1, 0.4),
        Hidden("input lag", 1, 0.5),
    )  # two samples late: jumps stay at samples
    starts = rng.normal(size=(2, 4))
    tight, quick = (
        simulate(machine, hidden, starts, drive, t, steps) for steps in (0, 16)
    )
    # Runge and Kutta of order 4 with h = 0.0125: about 1e-8; LSODA passes kinks at 1e-8
    # per step
    assert quick == pytest.approx(tight, abs=1e-5)


def test_a_drive_is_held_before_its_start_and_between_its_samples() -> None:
    from problems.hidden_effects.truth import Drive

    values = np.array([[2.0, 4.0, 1.0]])
    assert [Drive(0.5, values, "linear").at(t)[0] for t in (-1.0, 0.25, 0.5, 1.0)] == [
        2.0,
        3.0,
        4.0,
        1.0,
    ]
    assert [Drive(0.5, values, "zero").at(t)[0] for t in (-1.0, 0.25, 0.5, 1.0)] == [
        2.0,
        2.0,
        4.0,
        1.0,
    ]


def test_hysteresis_takes_energy_from_a_loop_and_keeps_within_its_yield_force() -> None:
    from problems.hidden_effects.truth import MEMORIES, Moment

    shape, q = {"beta": 2.0, "gamma": 2.0}, np.sin(np.linspace(0.0, 6 * np.pi, 6001))
    z, forces = np.zeros(1), []
    for dq in np.diff(q):  # explicit Euler along a prescribed path
        moment = Moment(0.0, z, np.full(1, dq), z, z[None, :], None)
        z = z + MEMORIES["hysteresis"].rates(1.0, shape, moment)[0]
        forces.append(float(z[0]))
    work = np.sum(np.array(forces)[2000:4000] * np.diff(q)[2000:4000])
    assert max(np.abs(forces)) <= 0.25 + 1e-6  # 1/(beta + gamma)
    # the parallelogram that is cut by the yield force: 4 z_max (q_max - z_max) at most
    # 1, rounded corners take some
    assert 0.5 < work < 1.0


def test_a_delayed_sensor_shows_what_the_state_was() -> None:
    from problems.hidden_effects.truth import Hidden, Machine, measured, simulate

    t, zero = np.linspace(0.0, 5.0, 51), np.zeros(1)
    machine = Machine(np.array([1.0]), np.array([1.0]), zero, zero, np.asarray(0.0))
    starts = np.array([[1.0, 0.0]])
    y = measured(machine, (Hidden("sensor delay", 0, 0.25),), starts, None, t)[:, 0]
    # the record begins one delay after the start: q(t) = cos(t + 0.25), shown late =
    # cos(t)
    assert y[:, 0] == pytest.approx(np.cos(t), abs=1e-6)
    assert y[:, 1] == pytest.approx(-np.sin(t + 0.25), abs=1e-6)
    assert simulate(machine, (), starts, None, t)[:, 0, 0] == pytest.approx(
        np.cos(t), abs=1e-6
    )


def test_healthy_tanks_are_those_of_the_thesis_and_a_leak_empties_them() -> None:
    from problems.hidden_effects.truth import Hidden, tank_states
    from problems.thesis.systems import closed_tanks, tank_matrix

    x = np.random.default_rng(0).normal(size=9)
    assert tank_matrix() @ x == pytest.approx(closed_tanks(0.0, x), rel=1e-12)
    starts, t = np.r_[np.zeros(5), np.ones(4)][None, :], np.linspace(0.0, 1.0, 11)
    held = tank_states(tank_matrix(), None, starts, t)[:, 0, 5:].sum(axis=1)
    left = tank_states(tank_matrix(), Hidden("linear leak", 7, 0.5), starts, t)[
        :, 0, 5:
    ].sum(axis=1)
    assert held == pytest.approx(np.full(11, 4.0), abs=1e-6)
    assert np.all(np.diff(left) < 0)


@pytest.mark.parametrize("name", ["linear_stiffness_0.01", "tanks"])
def test_a_case_depends_on_row_and_seed_alone(name: str) -> None:
    from problems.hidden_effects.cases import draw
    from problems.hidden_effects.rows import ROWS

    first, again, other = (draw(ROWS[name], seed) for seed in (4, 4, 5))
    for one, two in zip(
        first.train.trajectories, again.train.trajectories, strict=True
    ):
        assert np.array_equal(one.x, two.x, equal_nan=True)
    assert (first.truths, first.model.values) == (again.truths, again.model.values)
    assert first.train.trajectories[0].x.shape != other.train.trajectories[
        0
    ].x.shape or not np.array_equal(
        first.train.trajectories[0].x, other.train.trajectories[0].x, equal_nan=True
    )


def test_the_integration_of_a_motion_that_ends_in_infinity_ends() -> None:
    from problems.hidden_effects.truth import RunawayError, _tightly

    times = np.linspace(0.0, 4.0, 50)
    rates = (lambda _, x: x**2, lambda _, x: x**3)  # ends at 1 and at 1/2
    for rate in rates:
        with pytest.raises(RunawayError, match="could not be simulated"):
            _tightly(rate, np.ones(1), times)


def test_an_experiment_in_which_the_machine_runs_away_is_drawn_anew() -> None:
    from problems.hidden_effects.cases import draw
    from problems.hidden_effects.rows import ROWS
    from problems.hidden_effects.truth import RunawayError

    with pytest.raises(RunawayError, match="could not be simulated"):
        _free_fall_of_one_mass(
            quadratic_stiffness=-5.0
        )  # over the top of a spring that softens
    assert (
        draw(ROWS["quadratic_stiffness_0.03"], 3).truths[0].effect
        == "quadratic stiffness"
    )  # its first one does


def test_the_calibrated_error_is_that_of_a_refit_and_the_truth_has_no_misfit() -> None:
    from problems.hidden_effects.cases import draw
    from problems.hidden_effects.examination import DETECTED, floor, misfit
    from problems.hidden_effects.rows import ROWS

    case = draw(ROWS["cubic_stiffness_0.03"], 4)
    (truth,) = case.truths
    comparison = ph.compare(ph.identify(case.model, case.train), case.train)
    # the noise floor is estimated, and the noise moves the fit
    assert comparison.rmse / comparison.noise_floor == pytest.approx(
        case.base_ratio, rel=0.1
    )
    # two held-out runs: about a thousand values, 2 % by chance, and the held-out runs
    # have other deviations
    assert floor(case) == pytest.approx(comparison.noise_floor, rel=0.25)
    effect = next(
        e
        for e in ph.catalogue(case.model)
        if e.name == truth.effect and e.equation in truth.equations
    )
    # SRK4 between samples leaves an error far below the noise
    assert misfit(case, case.model.add(effect)) < 0.1 * DETECTED


def test_the_model_of_a_case_does_not_have_the_hidden_effect() -> None:
    from problems.hidden_effects.machines import draw_setting, model_of
    from problems.hidden_effects.rows import ONE

    assert "input delay" in ONE
    for name in (
        "viscous damping",
        "linear stiffness",
        "coupling stiffness",
        "input delay",
    ):
        rng = np.random.default_rng(7)
        model = model_of(draw_setting(rng, (name,)), rng)
        assert name in {effect.name for effect in ph.catalogue(model)}


def test_two_effects_are_right_only_when_each_is_found_once_and_nothing_else() -> None:
    from problems.hidden_effects.examination import matches
    from problems.hidden_effects.rows import Truth

    truths = (Truth("gap", ("p1",)), Truth("coupling stiffness", ("p1", "p2")))
    assert matches(truths, [{"coupling stiffness on p2"}, {"gap on p1"}])
    assert matches(
        truths, [{"coupling stiffness on p2"}, {"cubic stiffness on p1", "gap on p1"}]
    )
    assert not matches(truths, [{"gap on p1"}])
    assert not matches(truths, [{"gap on p1"}, {"gap on p2"}])
    assert not matches(
        truths, [{"gap on p1"}, {"coupling stiffness on p1"}, {"constant force on p1"}]
    )


def test_the_interval_covers_within_two_standard_errors_and_not_without_one() -> None:
    from problems.hidden_effects.examination import covered

    assert covered(1.0, 1.19, 0.1) == 1.0
    assert covered(1.0, 1.21, 0.1) == 0.0
    assert covered(1.0, 1.0, np.nan) == 0.0
    assert np.isnan(covered(np.nan, 1.0, 0.1))


def _record(**changes: object) -> dict[str, object]:
    from problems.hidden_effects.store import COLUMNS

    usual: dict[str, object] = {
        "row": "gap_0.01",
        "seed": 0,
        "noise": 0.01,
        "masses": 1,
        "measured": "q",
        "input": "none",
        "truth": "gap",
        "equation": "p",
        "verdict": "missing: named",
        "first": "gap",
        "first_equation": "p",
        "right": True,
        "tie": False,
        "covered": 1.0,
        "after": 1.0,
        "base_error": 5.0,
        "base_ratio": 5.0,
        "seconds": 1.0,
        "outcome": "examined",
    }
    return {name: {**usual, **changes}.get(name, np.nan) for name in COLUMNS}


def test_a_tie_counts_only_if_it_is_declared_and_true() -> None:
    from problems.hidden_effects.examination import DETECTED
    from problems.hidden_effects.scores import confusions, summary_row

    wrong = {"first": "cubic stiffness", "right": False, "covered": np.nan}
    rows = pd.DataFrame(
        [
            _record(),
            _record(seed=1, **wrong, tie=True, misfit=DETECTED / 2),
            _record(seed=2, **wrong, tie=True, misfit=DETECTED * 2),
            _record(seed=3, **wrong, tie=False, misfit=DETECTED / 2),
        ]
    )
    line = summary_row("gap", rows, 0.5)
    assert (line["cases"], line["of these true ties"], line["met"]) == (4, 1, "yes")
    assert str(line["right"]).startswith("50%")
    (came,) = confusions(rows).to_dict("records")
    assert (came["came"], came["cases"], came["declared_ties"], came["true_ties"]) == (
        "cubic stiffness on p",
        3,
        2,
        1,
    )


def test_an_effect_from_outside_that_the_catalogue_imitates_leaves_the_count() -> None:
    from problems.hidden_effects.scores import scored

    rows = pd.DataFrame(
        [
            _record(row="outside", truth="square wave", right=False, misfit=1.0),
            _record(
                row="outside", truth="square wave", right=False, misfit=1e3, seed=1
            ),
            _record(
                row="outside",
                truth="square wave",
                verdict="missing: unexplained",
                right=True,
                seed=2,
            ),
        ]
    )
    assert list(scored(rows)["seed"]) == [1, 2]


def test_a_diagnosis_that_fails_is_recorded_and_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from problems.hidden_effects.examination import examine
    from problems.hidden_effects.rows import ROWS
    from problems.hidden_effects.scores import summary_row
    from problems.hidden_effects.store import COLUMNS

    def broken(*arguments: object, **options: object) -> None:
        raise ph.SolveError("no way")

    monkeypatch.setattr(ph, "diagnose", broken)
    record = examine(ROWS["nothing"], 1)
    assert (record["right"], record["outcome"]) == (False, "SolveError: no way")
    rows = pd.DataFrame([record], columns=COLUMNS)
    assert summary_row("nothing", rows, 0.95)["failed"] == 1


def test_the_battery_goes_on_where_it_stopped_and_writes_its_page(
    tmp_path: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pathlib import Path

    from problems.hidden_effects import run
    from problems.hidden_effects.rows import ROWS
    from problems.tools import provenance

    assert isinstance(tmp_path, Path)
    examined: list[tuple[str, int]] = []

    def record(row: object, seed: int) -> dict[str, object]:
        assert isinstance(row, type(ROWS["gap_0.01"]))
        examined.append((row.name, seed))
        return _record(row=row.name, seed=seed, commit="abc1234")

    monkeypatch.setattr("sys.argv", ["run.py"])
    monkeypatch.setattr(provenance, "RESULTS", tmp_path)
    monkeypatch.setattr(run, "examine", record)
    run.main(["gap_0.01"], range(2), jobs=1)
    run.main(["gap_0.01", "nothing"], range(3), jobs=1)
    first, then = (
        [("gap_0.01", 0), ("gap_0.01", 1)],
        [("nothing", 0), ("nothing", 1), ("gap_0.01", 2), ("nothing", 2)],
    )
    assert (
        examined == first + then
    )  # nothing twice, and the first seeds of all rows first
    text = (tmp_path / "hidden_effects.md").read_text(encoding="utf-8")
    assert "| gap 0.01 | 3 | 100%" in text and "command:" in text
    assert "| abc1234 | 6 | 0 |" in text
    assert (tmp_path / "hidden_effects.png").exists()
    # New seeds stand beside the first ones and are not counted among them.
    run.main(["gap_0.01"], range(1000, 1002), jobs=1)
    text = (tmp_path / "hidden_effects.md").read_text(encoding="utf-8")
    assert "| gap 0.01 | 3 | 100%" in text and "| abc1234 | 8 | 2 |" in text
    all_three, both = "100% (44% to 100%)", "100% (34% to 100%)"
    told = f"| 3 | {all_three} | {all_three} | 2 | {both} | {both} |"
    (line,) = [x for x in text.splitlines() if x.startswith("| one effect")]
    assert line == f"| one effect, noise 1 % {told}"


def test_rows_are_chosen_by_their_beginning_and_an_unknown_one_is_refused() -> None:
    from problems.hidden_effects.rows import ROWS
    from problems.hidden_effects.run import chosen_rows

    assert chosen_rows(["input_gain"]) == [
        "input_gain_0.01",
        "input_gain_0.03",
        "input_gain_0.1",
    ]
    assert chosen_rows([]) == list(ROWS)
    with pytest.raises(SystemExit, match="no row begins with 'frition'"):
        chosen_rows(["frition"])

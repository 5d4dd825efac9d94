"""Inputs between their samples: smooth ones (`hold="cubic"`), and ways that differ from
input to input (`hold={"valve": "zero"}`).
"""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.data.noticed import breaks_of
from phsi_opt.data.trajectory import Trajectory, is_stepped
from phsi_opt.page.drafts import look_at
from phsi_opt.simulation.simulate import free_run
from phsi_opt.study_file.survey import first_text, survey
from phsi_opt.study_file.toml_text import toml_tables
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.grid import AlignedData, grid_of
from tests.systems import pushed_mass

# ---- smooth inputs

MASS = 2.0
OMEGA = 6.0  # rad/s of the faster wave of the push; six samples a period
NOISE = 1e-4  # m
TIMES = np.arange(0.0, 6.4, 0.17)


def push(t: np.ndarray) -> np.ndarray:
    return 3 * np.sin(OMEGA * t) + 2 * np.cos(OMEGA / 2 * t + 1)


def place(t: np.ndarray) -> np.ndarray:
    """Where a free mass is that the push moves from rest."""
    slow = OMEGA / 2
    fast_part = 3 / OMEGA * (t - np.sin(OMEGA * t) / OMEGA)
    turned = np.cos(1) - np.cos(slow * t + 1)
    slow_part = 2 / slow * (turned / slow - np.sin(1) * t)
    return np.asarray((fast_part + slow_part) / MASS)


def moved(hold: str) -> ph.Measurements:
    q = place(TIMES) + NOISE * np.random.default_rng(0).normal(size=len(TIMES))
    x = np.column_stack([q, np.full(len(TIMES), np.nan)])
    return ph.Measurements.from_arrays(
        TIMES, x, push(TIMES), states=["q", "p"], inputs=["u"], hold=hold
    )


def test_simulate_free_run_and_closed_form_agree() -> None:
    u = push(TIMES)[:, None]
    x = ph.simulate(pushed_mass(MASS), TIMES, [0.0, 0.0], u, hold="cubic")
    y = free_run(pushed_mass(MASS), TIMES, np.zeros(2), u, "cubic")
    np.testing.assert_allclose(y, x, atol=1e-6)
    lines = ph.simulate(pushed_mass(MASS), TIMES, [0.0, 0.0], u)
    error = np.max(np.abs(x[:, 0] - place(TIMES)))
    assert error < 0.2 * np.max(np.abs(lines[:, 0] - place(TIMES)))


def test_the_mass_is_found_from_six_samples_a_period() -> None:
    model = pushed_mass(ph.Parameter(1.0, lower=0))
    smooth = ph.identify(model, moved("cubic"))
    straight = ph.identify(model, moved("linear"))
    assert smooth.values["m"] == pytest.approx(MASS, abs=3e-3)
    assert abs(straight.values["m"] - MASS) > 0.03
    assert smooth.noise["q"] < 0.1 * straight.noise["q"]
    assert ph.compare(smooth, moved("cubic")).rmse < 3 * NOISE


# ---- a way for each input

T = np.arange(0.0, 12.0, 0.25)
PUSH = 2 * np.sin(2.5 * T)  # smooth, and coarsely sampled: ten samples a period
VALVE = np.where((T // 1.5) % 2 == 0, 1.0, -1.0)  # a digital output: it steps
U = np.column_stack([PUSH, VALVE])
HOLD = {"push": "cubic", "valve": "zero"}


def tank(k: float | ph.Parameter = 0.8) -> ph.FirstOrder:
    """A leaking tank with two inputs that add up."""
    rate = ph.formula("push + valve - k*q", k=k)
    return ph.FirstOrder(["q"], {"q": rate}, inputs=["push", "valve"])


def record(hold: Any = HOLD) -> ph.Measurements:
    """The tank's level where the push is smooth and the valve steps."""
    x = ph.simulate(tank(), T, [0.5], U, hold=HOLD)
    return ph.Measurements.from_arrays(
        T, x, U, states=["q"], inputs=["push", "valve"], hold=hold
    )


def test_inputs_that_are_left_out_are_linear_and_one_word_stays_a_word() -> None:
    assert record({"valve": "zero"}).hold == {"push": "linear", "valve": "zero"}
    assert record({"push": "zero", "valve": "zero"}).hold == "zero"
    assert record({}).hold == "linear"
    data = record()
    assert pickle.loads(pickle.dumps(data)).hold == data.hold
    with pytest.raises(TypeError):
        data.hold["valve"] = "linear"  # type: ignore[index]


UNKNOWN_NAME = r"hold names the unknown 'valv'; expected one of push, valve\. Did you "
UNKNOWN_WAY = "hold: 'valve' has the hold 'zeros'; expected 'linear', 'zero' or 'cubic'"


@pytest.mark.parametrize(("hold", "message"), [
    ({"valv": "zero"}, UNKNOWN_NAME + r"mean 'valve'\?"),
    ({"q": "zero"}, "hold names the unknown 'q'"),
    ({"valve": "zeros"}, UNKNOWN_WAY + r". Did you mean 'zero'\?"),
    ({"valve": None}, "hold(={|: )'valve'(: | has the hold )None"),
    (["zero", "linear"], r"hold=\['zero', 'linear'\] is (unknown|not possible)"),
])  # fmt: skip
def test_an_unknown_input_or_way_is_refused(hold: Any, message: str) -> None:
    with pytest.raises(ph.DataError, match=message):
        record(hold)
    for run in (ph.simulate, free_run):
        with pytest.raises(ph.PhsiOptError, match=message):
            run(tank(), T, [0.5], U, hold=hold)


def test_each_column_is_that_of_its_own_way() -> None:
    thin = record().thinned(3)
    assert thin.hold == HOLD
    assert all(part.hold == HOLD for part in record().split())
    grid = grid_of(record(), 3)
    for number, hold in enumerate(HOLD.values()):
        alone = grid_of(record(hold), 3)
        for name in ("u", "u0", "u1"):
            column = getattr(grid, name)[:, number]
            np.testing.assert_array_equal(column, getattr(alone, name)[:, number])
        run, other = thin.trajectories[0], record(hold).thinned(3).trajectories[0]
        both = np.isfinite(run.x[:, 0]), np.isfinite(other.x[:, 0])
        columns = run.u[both[0], number], other.u[both[1], number]
        np.testing.assert_array_equal(*columns)


def test_a_fit_needs_the_right_way_for_each_input_and_keeps_it(tmp_path: Path) -> None:
    model = tank(ph.Parameter(1.0, lower=0))
    fit = ph.identify(model, record())
    assert fit.values["k"] == pytest.approx(0.8, abs=1e-4)
    for hold in ("linear", "zero"):
        other = ph.identify(model, record(hold))
        assert abs(other.values["k"] - 0.8) > 20 * abs(fit.values["k"] - 0.8)
    path = tmp_path / "fit.json"
    fit.save(path)
    expected = fit.simulate(T, [0.5], U)
    for again in (fit, ph.Fit.load(path), pickle.loads(pickle.dumps(fit))):
        assert again.hold == HOLD
        np.testing.assert_array_equal(again.simulate(T, [0.5], U), expected)
    # As long as the record is, errors of the integrators and of k show.
    assert ph.compare(fit, record()).rmse < 1e-3


# ---- an input that is constant between jumps

LEVELS = np.random.default_rng(1).choice([-6.0, -3.0, 0.0, 3.0], 30)
CLOCK = 0.01 * np.arange(1200)
STEPS = np.repeat(LEVELS, 40)  # V, a step every 0.4 s
STEPPED = {
    "steps": STEPS,
    "one step": np.where(CLOCK > 3, 5.0, 0.0),
    "a relay": np.sign(np.sin(CLOCK)),
    "steps below half the spread": 12.0 * (CLOCK > 6) + np.repeat(LEVELS, 40) / 3,
    "measured steps": STEPS + 0.1 * np.random.default_rng(2).normal(size=1200),
    "a shift register of 3 samples": np.repeat(LEVELS > 0, 3).astype(float),
}
SMOOTH = {
    "a wave": np.sin(3 * CLOCK),
    "a wave of 3 samples": np.sin(2 * np.pi / 3 * np.arange(1200)),
    "noise": np.random.default_rng(0).normal(size=1200),
    "new values at every sample": np.random.default_rng(0).choice([-1.0, 1.0], 1200),
    "ramps that begin again": np.arange(1200) % 7.0,
    "a wave with one step": np.sin(CLOCK) + 3 * (CLOCK > 3),
    "ramps": np.abs(np.arange(1200) % 80 - 40.0),
    "a quantised wave": np.round(10 * np.sin(CLOCK)) / 10,
    "a constant": np.ones(1200),
}


def pushed(u: np.ndarray, hold: Any = "linear") -> ph.Measurements:
    x = np.column_stack([np.sin(CLOCK), CLOCK])[: len(u)]
    return ph.Measurements.from_arrays(
        CLOCK[: len(u)], x, u, states=["q", "p"], inputs=["u"], hold=hold
    )


@pytest.mark.parametrize("name", [*STEPPED, *SMOOTH])
def test_a_note_names_the_input_that_jumps_but_is_interpolated(name: str) -> None:
    u = {**STEPPED, **SMOOTH}[name]
    model = pushed_mass(MASS)
    (*notes,) = AlignedData.of(model, pushed(u)).notes
    assert len(notes) == (name in STEPPED)
    assert all('hold={"u": "zero"}' in note for note in notes)
    assert not AlignedData.of(model, pushed(u, hold={"u": "zero"})).notes


def test_runs_that_begin_elsewhere_are_no_jumps() -> None:
    waves = [np.sin(CLOCK), 5 + np.sin(CLOCK)]
    assert not is_stepped(waves)
    assert is_stepped([STEPS, 5 + STEPS])


def test_a_fit_tells_it() -> None:
    fit = ph.identify(pushed_mass(ph.Parameter(1.0, lower=0)), pushed(STEPS[:100]))
    assert 'hold={"u": "zero"}' in str(fit)


def test_init_and_page_hold_the_input_that_jumps(tmp_path: Path) -> None:
    table = tmp_path / "motor.csv"
    columns = np.column_stack([CLOCK, np.sin(CLOCK), STEPS, np.sin(3 * CLOCK)])
    header = "t_s,w_rad/s,voltage input_V,torque_Nm"
    np.savetxt(table, columns, delimiter=",", header=header, comments="")
    text = first_text(survey(table), [table], tmp_path)
    held = toml_tables(text)["data"]["inputs"]
    assert held["voltage_input"]["hold"] == "zero"
    assert "hold" not in held["torque"]
    assert "constant between jumps: held" in text
    draft = look_at({table.name: table})
    contents = draft.content([])["inputs"]
    assert contents["voltage_input"]["hold"] == "zero"
    assert "hold" not in contents["torque"]
    (column,) = [one for one in draft.columns if one.name == "voltage_input"]
    column.part = "state"
    assert "hold" not in column.content()
    column.part = "input"
    assert column.content()["hold"] == "zero"


# ---- a delay that is no delay

STEP = 0.02  # s between samples
PUSHES = np.random.default_rng(3).choice([-1.0, 0.0, 1.0], 80)


def first_order(gain: Any, loss: Any) -> ph.FirstOrder:
    return ph.FirstOrder(
        ["w"], {"w": ph.formula("g*u - a*w", g=gain, a=loss)}, inputs=["u"]
    )


def followed(hold: str, late: float = 0.0, noise: float = 0.02) -> ph.Measurements:
    """The truth has inputs ``hold`` that act late; the measurements say linear."""
    fine = np.arange(len(PUSHES) * 50) * STEP / 50
    samples = STEP * np.arange(len(PUSHES))
    u = np.interp(fine - late, samples, PUSHES)
    if hold == "zero":
        u = PUSHES[np.maximum(np.floor((fine - late) / STEP + 1e-9), 0).astype(int)]
    x = ph.simulate(first_order(3.0, 2.0), fine, [0.0], u[:, None], hold=hold)[::50]
    y = x + noise * np.random.default_rng(0).normal(size=x.shape)
    return ph.Measurements.from_arrays(
        samples, y, PUSHES, states=["w"], inputs=["u"], units={"t": "s"}
    )


def study_of(data: ph.Measurements) -> ph.Study:
    model = first_order(ph.Parameter(2.0, lower=0), ph.Parameter(1.0, lower=0))
    return ph.Study(model, data, effects=["input delay"])


def test_an_input_that_is_held_is_no_delay_of_half_a_sample() -> None:
    """It changes at every sample, so that no look at the samples could tell."""
    data = followed("zero")
    study = study_of(data)
    found = study.diagnose()
    assert not found.findings
    assert 'is taken of u (hold = "zero"): that' in found.reason
    assert "input delay in the equation of w (0.01" in found.reason
    assert found.reason.split(";")[0] in study.fit.warnings
    assert (data.hold, study.train.hold) == ("linear", "zero")
    assert study.fit.hold == "zero"
    assert study.fit.values["g"] == pytest.approx(3.0, abs=0.15)


def test_a_delay_of_one_sample_is_that_of_the_likelier_hold() -> None:
    """Interpolated, the held input acts half a sample early: the delay were 1.5."""
    study = study_of(followed("zero", late=STEP, noise=0.01))
    found = study.diagnose()
    (finding,) = found.findings
    assert str(finding.effects[0]) == "input delay on w"
    assert finding.coefficient == pytest.approx(STEP, abs=0.1 * STEP)
    assert study.train.hold == "zero"
    assert (
        'u (hold = "zero"): beside it input delay in the equation of w is likelier'
        in found.reason
    )


def test_a_delay_that_no_other_input_explains_is_named() -> None:
    study = study_of(followed("linear", late=0.02))
    (finding,) = study.diagnose().findings
    assert str(finding.effects[0]) == "input delay on w"
    assert finding.coefficient == pytest.approx(0.02, abs=0.002)
    assert study.train.hold == "linear"


# ---- gaps in which an input is unknown

LOST = np.arange(300, 330)  # 0.3 s, at a step of the input
LATER = np.where(CLOCK < 5, 1.0, 2.0)


@pytest.mark.parametrize(("u", "lost", "breaks"), [
    (STEPS, LOST, [299]),
    (STEPS, LOST + 21, []),  # the same input before and after
    (np.sin(CLOCK), LOST[:1], []),
    (np.sin(CLOCK), LOST, []),  # a twentieth of a period
    (np.sin(8 * CLOCK), LOST, [299]),  # 0.4 periods
    (np.random.default_rng(0).normal(size=1200), LOST[:1], [299]),
    (STEPS, np.r_[LOST, LOST + 33], [299]),  # three samples tell no state
    (LATER, np.r_[5:9, 499:501], [494]),  # nor do five; no other change tells its time
    (np.empty((1200, 0)), LOST, []),
])  # fmt: skip
def test_an_input_is_unknown_in_a_gap_that_interpolation_misses(
    u, lost, breaks
) -> None:
    kept = np.delete(np.arange(1200), lost)
    run = Trajectory("run", CLOCK[kept], CLOCK[kept, None], u[kept])
    assert breaks_of(run).tolist() == breaks


def motor(gain: Any, loss: Any, drag: float = 0.0) -> ph.FirstOrder:
    rate = ph.formula("g*u - a*w - d*w*abs(w)", g=gain, a=loss, d=drag)
    return ph.FirstOrder(["w"], {"w": rate}, inputs=["u"])


def with_gaps(drag: float, noise: float, hold: str) -> ph.Measurements:
    runs = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.choice([0.0, 3, 6, 9, 12, -6], 8), 40)
        u[120:160] = u[80:120] + 3
        t = STEP * np.arange(320)
        x = ph.simulate(motor(25.0, 2.0, drag), t, [0.0], u[:, None], hold="zero")
        kept = np.delete(np.arange(320), np.arange(120, 140))
        y = x + noise * rng.normal(size=x.shape)
        runs.append((t[kept], y[kept], u[kept]))
    units = {"t": "s", "w": "rad/s", "u": "V"}
    columns = map(list, zip(*runs, strict=True))
    return ph.Measurements.from_arrays(
        *columns, states=["w"], inputs=["u"], units=units, hold=hold
    )


def test_states_begin_anew_after_such_a_gap() -> None:
    data = with_gaps(0.0, 1e-3, "zero")
    free = motor(ph.Parameter(2.0, lower=0), ph.Parameter(0.5, lower=0))
    fit = ph.identify(free, data)
    assert [fit.values["g"], fit.values["a"]] == pytest.approx([25.0, 2.0], rel=1e-3)
    compared = ph.compare(fit, data)
    assert compared.rmse == pytest.approx(1e-3, rel=0.1)
    assert compared.data.n_trajectories == 2
    words = " ".join(str(data).split())
    assert "in run 1, an input changes in 2: the states begin anew there" in words


def test_a_memory_begins_anew_after_such_a_gap_at_rest() -> None:
    model = motor(25.0, 2.0)
    (lag,) = (one for one in ph.catalogue(model) if str(one) == "input lag on w")
    aligned = AlignedData.of(model.add(lag), with_gaps(0.0, 1e-3, "zero"))
    grid = aligned.grid_with([np.full(299, 3)] * 2)
    assert grid.n_intervals == 2 * 3 * 298
    states = with_memory(model.add(lag), grid, grid.y[:, :1], np.array([0.05]))
    np.testing.assert_allclose(states[grid.starts, 1], grid.u[grid.starts, 0])


def test_a_gap_makes_no_delay() -> None:
    model = motor(ph.Parameter(20.0, lower=0), ph.Parameter(1.0, lower=0))
    effects = ["input delay", "quadratic drag"]
    study = ph.Study(model, with_gaps(0.02, 0.4, "linear"), effects=effects)
    found = study.diagnose()
    assert [str(one) for one in found.proposed] == ["quadratic drag on w"]
    assert study.fit.hold == "zero"


# ---- fewer samples of a held input


@pytest.mark.parametrize(
    ("by", "noise"), [("mean", 0.01 / np.sqrt(5)), ("picking", 0.01)]
)
@pytest.mark.parametrize("length", [25, 7])  # of a step, in samples
def test_thinning_keeps_parameters_and_what_is_left_of_noise(by, noise, length) -> None:
    """A sensor that shows the input at once: none of both may be late."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-3.0, -1.5, 0.0, 2.0], 2000 // length), length)
    t = np.arange(len(u)) * 1.0

    def cell(tau: Any, r: Any) -> ph.FirstOrder:
        shown = {"v": ph.formula("r*i", r=r)}
        rate = {"v": ph.formula("(i - v)/tau", tau=tau)}
        return ph.FirstOrder(["v"], rate, inputs=["i"], sensor=shown)

    v = ph.simulate(cell(40.0, 1.5), t, [0.0], u[:, None], hold="zero")[:, 0]
    y = v + 1.5 * u + 0.01 * rng.normal(size=len(t))
    data = ph.Measurements.from_arrays(t, y, u, states=["v"], inputs=["i"], hold="zero")
    thin = data.thinned(5, by)
    fit = ph.identify(cell(ph.Parameter(20.0, lower=1), ph.Parameter(1.0)), thin)
    assert fit.values == pytest.approx({"tau": 40.0, "r": 1.5}, rel=0.005)
    assert ph.compare(fit, thin).rmse == pytest.approx(noise, rel=0.15)

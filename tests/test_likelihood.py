"""Maximum likelihood with data as they are: sensors, parameters per trajectory,
outliers, gaps, starts, steps.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.estimation import likelihood_problem
from phsi_opt.estimation.likelihood_steps import by_steps
from phsi_opt.initialization.scaling import point_at
from phsi_opt.model.terms import Dictionary
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.parameter_vector import Theta
from tests.systems import Number, pair, positive, spring

TRUTH = {"k": 1.2, "a": 0.8, "c": 0.15}
NOISE = 0.01


def duffing(
    sensor: dict[str, Dictionary] | None = None, **starts: ph.Parameter
) -> ph.PseudoHamiltonian:
    """A driven Duffing oscillator with free k, a, c."""
    start = {"k": ph.Parameter(1.0), "a": ph.Parameter(1.0), "c": positive(0.1)}
    energy = "k*q**2/2 + a*q**4/4 + p**2/2"
    return pair(energy, "c", "u", sensor=sensor, **(start | starts))


def record(
    n: int = 300, step: float = 0.05
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, true states and input; the noise is the caller's."""
    t = step * np.arange(n)
    u = 1.2 * np.cos(1.4 * t)[:, None]
    return t, ph.simulate(duffing().with_values(TRUTH), t, [1.0, 0.0], u), u


def measured(t: np.ndarray, y: np.ndarray, u: np.ndarray) -> ph.Measurements:
    return ph.Measurements.from_arrays(t, y, u, states=["q", "p"], inputs=["u"])


def noisy(x: np.ndarray, seed: int = 0, sigma: Any = NOISE) -> np.ndarray:
    return x + sigma * np.random.default_rng(seed).normal(size=x.shape)


def usual(n: int = 300) -> ph.Measurements:
    t, x, u = record(n)
    return measured(t, noisy(x), u)


def largest_z(fit: ph.Fit, truth: dict[str, float]) -> float:
    found, errors = fit.estimates, fit.std_errors
    return max(abs(found[name] - v) / errors[name] for name, v in truth.items())


# ---- sensors -------------------------------------------------------------------------

OFFSET_AND_GAIN = {
    "q": ph.formula("b + (g - 1)*q", b=ph.Parameter(0.0), g=ph.Parameter(1.0))
}


@pytest.mark.parametrize("only_position", [False, True])
def test_offset_and_gain_of_a_sensor_are_estimated_beside_the_dynamics(
    only_position: bool,
) -> None:
    t, x, u = record()
    shown = 1.1 * x[:, 0] + 0.3
    p = np.full(len(t), np.nan) if only_position else x[:, 1]
    data = measured(t, noisy(np.column_stack([shown, p])), u)
    fit = ph.identify(duffing(OFFSET_AND_GAIN), data)
    # Six estimates, each normal: beyond 3.5 standard errors in one data set of 400.
    assert largest_z(fit, {**TRUTH, "b": 0.3, "g": 1.1}) < 3.5
    np.testing.assert_allclose(fit.states[0][:, 0], x[:, 0], atol=10 * NOISE)
    if not only_position:  # the comparison sees what the sensor shows
        there = ph.compare(fit, data)
        np.testing.assert_allclose(there.shown[0][:, 0], shown, atol=NOISE)
        np.testing.assert_allclose(there.simulated[0][:, 0], x[:, 0], atol=NOISE)
        assert there.rmse < 1.05 * there.noise_floor


# ---- parameters per trajectory -------------------------------------------------------

MASSES = {"run 1": 1.0, "run 2": 1.5, "run 3": 2.2}
OWN_MASS = ph.Parameter(1.2, lower=0.1, per_trajectory=True)


def loaded(mass: Number, k: Number = 3.0) -> ph.PseudoHamiltonian:
    return spring(k, positive(0.1), mass)


@pytest.fixture(scope="module")
def loads() -> ph.Measurements:
    """Three runs with different masses: different lengths, one irregular, positions
    only, gaps.
    """
    rng = np.random.default_rng(3)
    irregular = np.cumsum(rng.uniform(0.02, 0.09, 180))
    times = [0.05 * np.arange(200), 0.07 * np.arange(150), irregular]
    runs = []
    for t, mass in zip(times, MASSES.values(), strict=True):
        x = ph.simulate(loaded(mass).with_values({"c": 0.2}), t, [1.0, 0.0])
        runs.append(noisy(x, int(10 * mass)))
        runs[-1][:, 1] = np.nan
        runs[-1][::7, 0] = np.nan
    return ph.Measurements.from_arrays(times, runs, states=["q", "p"])


@pytest.fixture(scope="module")
def loaded_fit(loads: ph.Measurements) -> ph.Fit:
    return ph.identify(loaded(OWN_MASS), loads)


def test_every_run_has_its_own_mass_and_all_share_the_damping(loaded_fit) -> None:
    own = {f"m[{run}]": mass for run, mass in MASSES.items()}
    assert loaded_fit.names == (*own, "c")
    assert largest_z(loaded_fit, {**own, "c": 0.2}) < 3.5
    mean = np.mean([loaded_fit.estimates[name] for name in own])
    assert loaded_fit.values["m"] == pytest.approx(mean)
    table = loaded_fit.parameters.set_index("name")
    assert table["value"]["m[run 2]"] == loaded_fit.by_trajectory["run 2"]["m"]


def test_a_common_factor_without_a_trace_is_named(loads: ph.Measurements) -> None:
    fit = ph.identify(loaded(OWN_MASS, ph.Parameter(2.0)), loads)
    said = "k, m[run 1], m[run 2], m[run 3], c: a common factor"
    assert any(said in warning for warning in fit.warnings)
    assert all(np.isnan(fit.std_errors[name]) for name in fit.names)


# ---- outliers ------------------------------------------------------------------------


def test_huber_keeps_its_accuracy_where_one_sample_in_ten_is_wrong() -> None:
    t, x, u = record()
    y = noisy(x)
    rng = np.random.default_rng(1)
    wrong = rng.choice(len(t), len(t) // 10, replace=False)
    y[wrong, 0] += rng.normal(size=len(wrong))  # a hundred times the noise
    data = measured(t, y, u)
    robust = ph.identify(duffing(), data, ph.MaximumLikelihood(huber=1.345))
    assert largest_z(robust, TRUTH) < 3.5
    # Squares take the noise of q for what the outliers make of it, 0.3; the robust one
    # stays near 0.01.
    assert robust.noise["q"] < 2 * NOISE
    squares = ph.identify(duffing(), data)
    assert squares.noise["q"] > 0.2
    (warning,) = (
        w for w in squares.warnings if "the scatter of neighbouring samples" in w
    )
    assert "outliers" in warning


# ---- steps, starts -------------------------------------------------------------------


def most_steps(fit: ph.Fit) -> int:
    return max(int(of_run.max()) for of_run in fit.steps)


def coarse(step: float, sigma: float = NOISE) -> ph.Measurements:
    t = step * np.arange(150)
    u = np.where(np.arange(150) % 2 == 0, 0.6, -0.3)[:, None]
    x = ph.simulate(duffing().with_values(TRUTH), t, [1.0, 0.0], u)
    return measured(t, noisy(x, 0, sigma), u)


def test_coarse_samples_get_steps_in_between_and_fine_ones_none() -> None:
    assert most_steps(ph.identify(duffing(), coarse(0.05))) == 1
    data = coarse(0.4, sigma=0.001)
    refined = ph.identify(duffing(), data)
    assert most_steps(refined) > 1
    finest = ph.identify(duffing(), data, ph.MaximumLikelihood(steps=16))
    crude = ph.identify(duffing(), data, ph.MaximumLikelihood(steps=1))
    errors = finest.std_errors
    shift = {
        fit: max(abs(fit.values[n] - finest.values[n]) / errors[n] for n in TRUTH)
        for fit in (refined, crude)
    }
    # Refinement ends below a tenth of a standard error.
    assert shift[refined] < 0.1
    assert shift[crude] > 0.5


def test_an_optimum_on_steps_that_are_too_long_stays_where_finer_ones_lead_nowhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = coarse(0.4, sigma=0.001)
    crude = ph.identify(duffing(), data, ph.MaximumLikelihood(steps=1))

    def stalled(values: LikelihoodValues, *others: Any) -> Any:
        found = by_steps(values, *others)
        if values.grid.n_intervals < 150:
            return found
        outcome = replace(found.solution.outcome, success=False)
        return replace(found, solution=replace(found.solution, outcome=outcome))

    monkeypatch.setattr(likelihood_problem, "by_steps", stalled)
    monkeypatch.delattr(likelihood_problem, "by_ipopt")  # would be many iterations
    fit = ph.identify(duffing(), data)
    assert most_steps(fit) == 1
    assert fit.values == pytest.approx(crude.values, rel=1e-6)
    (said,) = [one for one in fit.warnings if "integration steps are too long" in one]
    assert "the solver failed" in said


# ---- uncertainty ---------------------------------------------------------------------


def test_a_parameter_at_its_bound_is_named_in_the_warnings() -> None:
    fit = ph.identify(duffing(c=ph.Parameter(0.3, lower=0.3)), usual(100))
    assert any(w.startswith("c is at its lower bound 0.3") for w in fit.warnings)
    assert np.isnan(fit.std_errors["c"])


def test_a_parameter_that_starting_values_press_to_zero_is_at_its_bound() -> None:
    """Beside zero its value says nothing of its size, also where a fit starts there."""
    t = np.linspace(0, 60, 61)
    true = ph.FirstOrder(["n"], {"n": "-6 - 0.01*n - 1.1e-5*n*abs(n)"})
    y = noisy(ph.simulate(true, t, [3400.0]), sigma=3.0)
    data = ph.Measurements.from_arrays([t], [y], states=["n"])
    a, b = ph.Parameter(3.0, lower=0), ph.Parameter(0.02, lower=0)
    model = ph.FirstOrder(["n"], {"n": ph.formula("-a - b*n", a=a, b=b)})
    fit = ph.identify(model, data)
    for one in (fit, ph.identify(model, data, start=fit)):
        assert one.outcome.at_bounds == ("a",)
        assert any(w.startswith("a is at its lower bound 0") for w in one.warnings)
        assert not any("say nothing" in w for w in one.warnings)


# ---- refusals ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [{"huber": 0.0}, {"huber": np.inf}, {"steps": 0}, {"starts": 0}, {"starts": 1.5}],
)
def test_options_that_mean_nothing_are_refused(options: dict[str, Any]) -> None:
    said = f"{next(iter(options))}.*=.* is not possible; expected"
    with pytest.raises(ph.ModelError, match=said):
        ph.MaximumLikelihood(**options)


def test_sensors_and_parameters_per_trajectory_have_no_place_in_the_phsi_loss(
    loads: ph.Measurements,
) -> None:
    t, x, u = record(50)
    y = noisy(x)
    said = "PHSILoss cannot include the {}"
    with pytest.raises(ph.ModelError, match=said.format("sensor of 'q'")):
        ph.identify(duffing(OFFSET_AND_GAIN), measured(t, y, u), ph.PHSILoss())
    own = said.format("parameter per trajectory 'm'")
    with pytest.raises(ph.ModelError, match=own):
        ph.identify(loaded(OWN_MASS), loads, ph.PHSILoss())
    y[:, 0] = np.nan
    said = "has a sensor of 'q', but 'q' was never measured"
    with pytest.raises(ph.DataError, match=said):
        ph.identify(duffing(OFFSET_AND_GAIN), measured(t, y, u))


# ---- derivatives ---------------------------------------------------------------------


def test_the_exact_hessian_is_that_of_automatic_differentiation() -> None:
    rng = np.random.default_rng(0)
    times = [0.1 * np.arange(5), 0.13 * np.arange(4)]
    runs = [rng.normal(size=(5, 2)), rng.normal(size=(4, 2))]
    data = ph.Measurements.from_arrays(times, runs, states=["q", "p"])
    model = loaded(ph.Parameter(1.2, per_trajectory=True)).with_values({"c": 0.3})
    grid, unknown = grid_of(data), Theta.of(model, ("run 1", "run 2"))
    point = point_at(model, grid, unknown, np.array([1.2, 1.5, 0.3]), grid.y)
    values = LikelihoodValues(model, grid, "srk4", point, unknown)
    program = ph.MaximumLikelihood().program(values, {}, np.array([0.1, 0.2]))
    z = program.start + 0.01 * rng.normal(size=program.start.size)
    multipliers = rng.normal(size=program.g.numel())
    lagrangian = program.objective + ca.dot(ca.DM(multipliers), program.g)
    upper = ca.triu(ca.hessian(lagrangian, program.z)[0])
    whole = ca.Function("h", [program.z, program.settings], [upper])
    expected = np.array(whole(z, program.set_to))
    found = np.array(program.hessian(exact=True)(z, program.set_to, 1.0, multipliers))
    np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())


def test_the_jacobian_made_per_interval_is_that_of_automatic_differentiation() -> None:
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.05, 0.2, 7))
    data = measured(t, rng.normal(size=(7, 2)), rng.normal(size=(7, 1)))
    grid, sigma = grid_of(data, 2), np.array([0.1, 0.2])
    unknown = Theta.of(duffing(), ("run 1",))
    nodes = rng.normal(size=grid.y.shape)
    point = point_at(duffing(), grid, unknown, np.array([1.0, 0.7, 0.2]), nodes)
    values = LikelihoodValues(duffing(), grid, "srk4", point, unknown)
    program = ph.MaximumLikelihood(huber=1.0).program(values, {"H": 0.1}, sigma)
    z = program.start + 0.1 * rng.normal(size=program.start.size)
    slopes = ca.jacobian(program.g, program.z)
    whole = ca.Function("j", [program.z, program.settings], [slopes])
    expected = np.array(whole(z, program.set_to))
    ours = np.array(program.jacobian()(z, program.set_to)[1])
    np.testing.assert_allclose(ours, expected, rtol=1e-9, atol=1e-9)


# ---- awkward data and models

NOISE_OF_X = 0.02
HUBER = ph.MaximumLikelihood(huber=1.345)


def decay(sensor: dict[str, Dictionary] | None = None) -> ph.FirstOrder:
    falling = ph.formula("-a*x", a=ph.Parameter(0.5))
    return ph.FirstOrder(["x"], {"x": falling}, sensor=sensor or {})


def decaying(
    n: int = 60, seed: int = 0, noise: float = NOISE_OF_X
) -> tuple[np.ndarray, np.ndarray]:
    t = np.linspace(0.0, 4.0, n)
    normal = np.random.default_rng(seed).normal(size=(n, 1))
    return t, 2 * np.exp(-0.7 * t)[:, None] + noise * normal


def of_x(t: np.ndarray, y: np.ndarray) -> ph.Measurements:
    return ph.Measurements.from_arrays(t, y, states=["x"])


# ---- sensors -------------------------------------------------------------------------


@pytest.mark.parametrize("gain", [2.0, 10.0])
def test_a_known_gain_of_any_size_changes_neither_the_estimate_nor_the_noise_floor(
    gain: float,
) -> None:
    t, y = decaying()
    plain = ph.identify(decay(), of_x(t, y))
    data = of_x(t, gain * y)
    fit = ph.identify(decay({"x": ph.formula("(g - 1)*x", g=gain)}), data)
    assert fit.values["a"] == pytest.approx(plain.values["a"], rel=1e-4)
    assert fit.noise["x"] == pytest.approx(gain * plain.noise["x"], rel=1e-3)
    comparison = ph.compare(fit, data)
    assert comparison.noise["x"] == pytest.approx(fit.noise["x"], rel=0.1)
    # The band is that of what the sensor shows.
    unscaled = ph.compare(plain, of_x(t, y)).bands
    assert comparison.bands is not None and unscaled is not None
    np.testing.assert_allclose(comparison.bands[0], gain * unscaled[0], rtol=0.1)


# ---- outliers ------------------------------------------------------------------------


def test_the_standard_errors_of_huber_are_those_of_repeated_draws() -> None:
    draws = [of_x(*decaying(60, seed)) for seed in range(40)]
    fits = [ph.identify(decay(), data, HUBER) for data in draws]
    spread = np.std([fit.values["a"] for fit in fits], ddof=1)
    errors = [fit.std_errors["a"] for fit in fits]
    # 40 draws tell a standard deviation to 11 %.
    assert np.mean(errors) == pytest.approx(spread, rel=0.2)
    assert min(errors) > 0.7 * spread


# ---- starts and files ----------------------------------------------------------------


def test_a_loaded_fit_is_a_start_and_has_the_profile_of_the_fit_it_was(
    tmp_path: Path,
) -> None:
    t = np.linspace(0.0, 12.0, 150)
    y = 0.8 * np.sin(3.3 * t) + 0.05 * np.random.default_rng(0).normal(size=150)
    A, w = ph.Parameter(1.0), ph.Parameter(3.2)
    model = ph.FirstOrder(["x"], {"x": ph.formula("A*w*cos(w*t)", A=A, w=w)})
    data = of_x(t, y[:, None])
    fit = ph.identify(model, data)
    assert fit.values["w"] == pytest.approx(3.3, rel=0.01)
    fit.save(tmp_path / "fit.json")
    loaded = ph.Fit.load(tmp_path / "fit.json")
    again = ph.identify(model.with_values({"A": 1.0, "w": 1.0}), data, start=loaded)
    assert again.values["w"] == pytest.approx(fit.values["w"], rel=1e-5)
    assert [n.tolist() for n in loaded.steps] == [n.tolist() for n in fit.steps]
    lower = ph.profile(fit, data, "w").ci_lower
    assert ph.profile(loaded, data, "w").ci_lower == pytest.approx(lower, rel=1e-5)

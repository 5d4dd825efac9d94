"""Maximum likelihood with data as they are: sensors, parameters per trajectory,
outliers, gaps, starts.
"""

from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import least_squares

from phsi_opt.comparison.compare import compare
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, ModelError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify
from phsi_opt.initialization.scaling import point_at
from phsi_opt.model.model import FirstOrder, PseudoHamiltonian
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.structure import canonical
from phsi_opt.model.terms import Dictionary, formula
from phsi_opt.simulation.simulate import simulate
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.losses import (
    MaximumLikelihood,
    PHSILoss,
)
from phsi_opt.transcription.parameter_vector import Theta

TRUTH = {"k": 1.2, "a": 0.8, "c": 0.15}
NOISE = 0.01


def duffing(
    sensor: dict[str, Dictionary] | None = None, **starts: Any
) -> PseudoHamiltonian:
    """A driven Duffing oscillator with free k, a, c."""
    start = {
        "k": Parameter(1.0),
        "a": Parameter(1.0),
        "c": Parameter(0.1, lower=0.0),
        **starts,
    }
    return PseudoHamiltonian(
        states=("q", "p"),
        inputs=("u",),
        S=canonical(1),
        H=formula("k*q**2/2 + a*q**4/4 + p**2/2", k=start["k"], a=start["a"]),
        R={"p": formula("c", c=start["c"])},
        F={"p": formula("u")},
        sensor=sensor or {},
    )


def record(
    n: int = 300, seed: int = 0, step: float = 0.05
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, true states and input; the noise is the caller's."""
    t = step * np.arange(n)
    u = 1.2 * np.cos(1.4 * t)[:, None]
    return t, simulate(duffing().with_values(TRUTH), t, [1.0, 0.0], u), u


def measured(t: np.ndarray, y: np.ndarray, u: np.ndarray) -> Measurements:
    return Measurements.from_arrays(t, y, u, states=["q", "p"], inputs=["u"])


def noisy(x: np.ndarray, seed: int = 0, sigma: float = NOISE) -> np.ndarray:
    return x + sigma * np.random.default_rng(seed).normal(size=x.shape)


def largest_z(fit: Fit, truth: dict[str, float]) -> float:
    return max(
        abs(fit.estimates[name] - value) / fit.std_errors[name]
        for name, value in truth.items()
    )


# ---- sensors -------------------------------------------------------------------------

OFFSET_AND_GAIN = {"q": formula("b + (g - 1)*q", b=Parameter(0.0), g=Parameter(1.0))}


@pytest.mark.parametrize("only_position", [False, True])
def test_offset_and_gain_of_a_sensor_are_estimated_beside_the_dynamics(
    only_position: bool,
) -> None:
    t, x, u = record()
    y = noisy(
        np.column_stack(
            [1.1 * x[:, 0] + 0.3, np.full(len(t), np.nan) if only_position else x[:, 1]]
        )
    )
    fit = identify(duffing(OFFSET_AND_GAIN), measured(t, y, u))
    # Six estimates, each normal: beyond 3.5 standard errors in one data set of 400.
    assert largest_z(fit, {**TRUTH, "b": 0.3, "g": 1.1}) < 3.5
    np.testing.assert_allclose(fit.states[0][:, 0], x[:, 0], atol=10 * NOISE)


def test_the_comparison_sees_what_the_sensor_shows() -> None:
    t, x, u = record()
    data = measured(t, noisy(np.column_stack([1.1 * x[:, 0] + 0.3, x[:, 1]])), u)
    fit = identify(duffing(OFFSET_AND_GAIN), data)
    comparison = compare(fit, data)
    np.testing.assert_allclose(
        comparison.shown[0][:, 0], 1.1 * x[:, 0] + 0.3, atol=NOISE
    )
    np.testing.assert_allclose(comparison.simulated[0][:, 0], x[:, 0], atol=NOISE)
    assert comparison.rmse < 1.05 * comparison.noise_floor


def test_a_sensor_of_a_state_that_nobody_measured_is_refused() -> None:
    t, x, u = record(50)
    y = noisy(x)
    y[:, 0] = np.nan
    with pytest.raises(
        DataError, match="has a sensor of 'q', but 'q' was never measured"
    ):
        identify(duffing(OFFSET_AND_GAIN), measured(t, y, u))


def test_the_phsi_loss_refuses_a_sensor() -> None:
    t, x, u = record(50)
    with pytest.raises(ModelError, match="PHSILoss has no place for the sensor of 'q'"):
        identify(duffing(OFFSET_AND_GAIN), measured(t, noisy(x), u), PHSILoss())


# ---- parameters per trajectory -------------------------------------------------------

MASSES = {"run 1": 1.0, "run 2": 1.5, "run 3": 2.2}


def loaded(mass: Parameter | float) -> PseudoHamiltonian:
    return PseudoHamiltonian(
        states=("q", "p"),
        S=canonical(1),
        H=formula("k*q**2/2 + p**2/(2*m)", k=3.0, m=mass),
        R={"p": formula("c", c=Parameter(0.1, lower=0.0))},
    )


@pytest.fixture(scope="module")
def loads() -> Measurements:
    """Three runs with different masses: different lengths, one irregular, positions
    only, gaps.
    """
    rng = np.random.default_rng(3)
    times = [
        0.05 * np.arange(200),
        0.07 * np.arange(150),
        np.cumsum(rng.uniform(0.02, 0.09, 180)),
    ]
    runs = []
    for t, mass in zip(times, MASSES.values(), strict=True):
        x = noisy(
            simulate(loaded(mass).with_values({"c": 0.2}), t, [1.0, 0.0]),
            int(10 * mass),
        )
        x[:, 1] = np.nan
        x[::7, 0] = np.nan
        runs.append(x)
    return Measurements.from_arrays(times, runs, states=["q", "p"])


@pytest.fixture(scope="module")
def loaded_fit(loads: Measurements) -> Fit:
    return identify(loaded(Parameter(1.2, lower=0.1, per_trajectory=True)), loads)


def test_every_run_has_its_own_mass_and_all_share_the_damping(loaded_fit: Fit) -> None:
    assert loaded_fit.names == ("m[run 1]", "m[run 2]", "m[run 3]", "c")
    assert (
        largest_z(
            loaded_fit, {**{f"m[{run}]": m for run, m in MASSES.items()}, "c": 0.2}
        )
        < 3.5
    )
    assert loaded_fit.values["m"] == pytest.approx(
        np.mean([loaded_fit.estimates[f"m[{r}]"] for r in MASSES])
    )
    table = loaded_fit.parameters.set_index("name")
    assert table["value"]["m[run 2]"] == loaded_fit.by_trajectory["run 2"]["m"]


def test_alone_each_run_gives_the_same_mass_as_together_where_the_damping_is_known(
    loads: Measurements,
) -> None:
    model = loaded(Parameter(1.2, lower=0.1, per_trajectory=True)).with_fixed(
        {"c": 0.2}
    )
    together = identify(model, loads, MaximumLikelihood(noise={"q": NOISE}))
    for run in MASSES:
        alone = identify(model, loads[run], MaximumLikelihood(noise={"q": NOISE}))
        assert together.by_trajectory[run]["m"] == pytest.approx(
            alone.values["m"], rel=1e-6
        )
        assert together.std_errors[f"m[{run}]"] == pytest.approx(
            alone.std_errors["m"], rel=1e-4
        )


def test_a_run_that_the_fit_has_not_seen_gets_its_own_mass_in_a_comparison(
    loads: Measurements,
) -> None:
    fit = identify(loaded(Parameter(1.2, lower=0.1, per_trajectory=True)), loads[:2])
    comparison = compare(fit, loads)
    assert comparison.values["run 3"]["m"] == pytest.approx(MASSES["run 3"], rel=0.02)
    assert comparison.rmse < 1.1 * comparison.noise_floor
    assert fit.values["m"] != pytest.approx(MASSES["run 3"], rel=0.1)
    # Its mass follows from its own record alone: a band like that of a fit that saw the
    # run.
    seen = compare(
        identify(loaded(Parameter(1.2, lower=0.1, per_trajectory=True)), loads), loads
    )
    assert comparison.bands is not None
    assert seen.bands is not None
    ratio = comparison.bands[2][1:, 0] / seen.bands[2][1:, 0]
    assert 0.95 < np.median(ratio) < 1.5


def test_a_fit_with_parameters_per_run_survives_a_file_and_simulates_each(
    loaded_fit: Fit, tmp_path: Any
) -> None:
    loaded_fit.save(tmp_path / "fit.json")
    again = Fit.load(tmp_path / "fit.json")
    assert again.by_trajectory == loaded_fit.by_trajectory
    assert again.estimates == loaded_fit.estimates
    t = np.linspace(0.0, 2.0, 21)
    heavy = again.simulate(t, [1.0, 0.0], trajectory="run 3")
    np.testing.assert_allclose(
        heavy, simulate(loaded_fit.model_of("run 3"), t, [1.0, 0.0]), rtol=1e-12
    )
    with pytest.raises(
        DataError, match="trajectory 'run 9' has no parameters of its own"
    ):
        again.simulate(t, [1.0, 0.0], trajectory="run 9")


def test_the_phsi_loss_refuses_a_parameter_per_trajectory(loads: Measurements) -> None:
    with pytest.raises(
        ModelError, match="PHSILoss has no place for the parameter per trajectory 'm'"
    ):
        identify(loaded(Parameter(1.2, per_trajectory=True)), loads, PHSILoss())


# ---- outliers ------------------------------------------------------------------------


def test_huber_keeps_its_accuracy_where_one_sample_in_ten_is_wrong() -> None:
    t, x, u = record()
    y = noisy(x)
    rng = np.random.default_rng(1)
    wrong = rng.choice(len(t), len(t) // 10, replace=False)
    y[wrong, 0] += rng.normal(size=len(wrong))  # a hundred times the noise
    robust = identify(duffing(), measured(t, y, u), MaximumLikelihood(huber=1.345))
    assert largest_z(robust, TRUTH) < 3.5
    # Squares take the noise of q for what the outliers make of it, 0.3; the robust one
    # stays near 0.01.
    assert robust.noise["q"] < 2 * NOISE
    squares = identify(duffing(), measured(t, y, u))
    assert squares.noise["q"] > 0.2
    assert any(
        "times what neighbouring samples scatter" in w and "outliers" in w
        for w in squares.warnings
    )


def test_huber_is_the_squares_where_the_limit_is_beyond_every_residual() -> None:
    t, x, u = record(150)
    data = measured(t, noisy(x), u)
    noise = {"q": NOISE, "p": NOISE}
    squares = identify(duffing(), data, MaximumLikelihood(noise=noise))
    robust = identify(duffing(), data, MaximumLikelihood(noise=noise, huber=10.0))
    for name in TRUTH:
        assert robust.values[name] == pytest.approx(squares.values[name], rel=1e-6)


# ---- scales --------------------------------------------------------------------------


def test_parameters_ten_orders_of_magnitude_apart_are_found() -> None:
    # q in nm and p in ug nm/s: k is 1e3 units, the cubic spring 1e-6 of it, the input
    # gain 1e4.
    t, x, u = record()
    size = 1e3
    model = PseudoHamiltonian(
        states=("q", "p"),
        inputs=("u",),
        S=canonical(1),
        H=formula(
            "k*q**2/2 + a*q**4/4 + p**2/(2*m)",
            k=Parameter(1.0),
            a=Parameter(0.0),
            m=1e-4,
        ),
        R={"p": formula("c", c=Parameter(0.0, lower=0.0))},
        F={"p": formula("b*u", b=Parameter(0.0))},
    )
    # dq/dt = p/m, dp/dt = -k q - a q^3 - c p/m + b u, m = 1e-4: k = 1.2 m, a = 0.8
    # m/size^2, c = 0.15 m, b = m size.
    y = noisy(x) * np.array([size, 1e-4 * size])
    data = Measurements.from_arrays(t, y, 1e-6 * u, states=["q", "p"], inputs=["u"])
    truth = {"k": 1.2e-4, "a": 0.8e-4 / size**2, "c": 0.15e-4, "b": 1e-4 * size / 1e-6}
    assert truth["b"] / truth["a"] > 1e14
    fit = identify(model, data)
    assert largest_z(fit, truth) < 3.5
    assert all(fit.std_errors[name] < 0.05 * value for name, value in truth.items())


# ---- steps, starts -------------------------------------------------------------------


def test_coarse_samples_get_steps_in_between_and_fine_ones_none() -> None:
    fine = identify(duffing(), measured(*_noisy_record(0.05)))
    assert most_steps(fine) == 1
    t, y, u = _noisy_record(0.4, sigma=0.001)
    data = measured(t, y, u)
    coarse = identify(duffing(), data)
    assert most_steps(coarse) > 1
    finest = identify(duffing(), data, MaximumLikelihood(steps=16))
    crude = identify(duffing(), data, MaximumLikelihood(steps=1))
    # Refinement ends below a tenth of a standard error.
    assert largest_shift(coarse, finest) < 0.1
    assert largest_shift(crude, finest) > 0.5


def most_steps(fit: Fit) -> int:
    return max(int(of_run.max()) for of_run in fit.steps)


def largest_shift(fit: Fit, reference: Fit) -> float:
    """Of a parameter, in standard errors of the reference."""
    shifts = []
    for name in TRUTH:
        shift = abs(fit.values[name] - reference.values[name])
        shifts.append(shift / reference.std_errors[name])
    return max(shifts)


def _noisy_record(
    step: float, sigma: float = NOISE
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t = step * np.arange(150)
    u = np.where(np.arange(150) % 2 == 0, 1.0, -0.5)[:, None] * 0.6
    return (
        t,
        noisy(simulate(duffing().with_values(TRUTH), t, [1.0, 0.0], u), 0, sigma),
        u,
    )


def test_the_report_says_how_many_starts_agree() -> None:
    t, x, u = record(200)
    data = measured(t, noisy(x), u)
    fits = [identify(duffing(), data, MaximumLikelihood(starts=3)) for _ in range(2)]
    assert any(
        w == "3 of 3 starting points led to the best solution" for w in fits[0].warnings
    )
    assert fits[0].values == fits[1].values


def test_chaos_over_many_lyapunov_times_gives_the_right_parameters() -> None:
    def lorenz(
        s: Parameter | float, r: Parameter | float, b: Parameter | float
    ) -> FirstOrder:
        return FirstOrder(
            states=("x", "y", "z"),
            F={
                "x": formula("s*(y - x)", s=s),
                "y": formula("x*(r - z) - y", r=r),
                "z": formula("x*y - b*z", b=b),
            },
        )

    t = np.linspace(0.0, 20.0, 1001)  # 18 Lyapunov times of 1.1
    x = simulate(lorenz(10.0, 28.0, 8 / 3), t, [-8.0, 7.0, 27.0])
    y = x + 0.1 * x.std(axis=0) * np.random.default_rng(0).normal(size=x.shape)
    data = Measurements.from_arrays(t, y, states=["x", "y", "z"])
    fit = identify(lorenz(Parameter(), Parameter(), Parameter()), data)
    assert largest_z(fit, {"s": 10.0, "r": 28.0, "b": 8 / 3}) < 3.5
    assert fit.values["r"] == pytest.approx(28.0, rel=1e-3)


# ---- uncertainty ---------------------------------------------------------------------


def test_intervals_are_wider_than_the_normal_ones_where_few_values_tell_the_noise() -> (
    None
):
    t, x, u = record(12, step=0.4)
    fit = identify(duffing(), measured(t, noisy(x), u))
    interval = fit.intervals(0.95)
    half = (interval["ci_upper"] - interval["ci_lower"]).to_numpy() / 2
    errors = np.array([fit.std_errors[name] for name in interval.index])
    # Student's t with 24 - 3 degrees of freedom.
    np.testing.assert_allclose(half / errors, 2.0796, rtol=1e-4)
    correlations = fit.correlations.to_numpy()
    np.testing.assert_allclose(np.diag(correlations), 1.0)
    assert np.all(np.abs(correlations) <= 1 + 1e-12)


def test_a_parameter_at_its_bound_is_named_in_the_warnings() -> None:
    t, x, u = record(100)
    fit = identify(duffing(c=Parameter(0.3, lower=0.3)), measured(t, noisy(x), u))
    assert any(w.startswith("c ended at its lower bound 0.3") for w in fit.warnings)
    assert np.isnan(fit.std_errors["c"])


def test_a_parameter_that_starting_values_press_to_zero_is_at_its_bound() -> None:
    """Beside zero its value says nothing of its size, also where a fit starts there."""
    t = np.linspace(0, 60, 61)
    true = FirstOrder(["n"], {"n": formula("-6 - 0.01*n - 1.1e-5*n*abs(n)")})
    n = simulate(true, t, [3400.0])
    y = n + 3 * np.random.default_rng(0).normal(size=n.shape)
    data = Measurements.from_arrays([t], [y], states=["n"])
    a, b = Parameter(3.0, lower=0), Parameter(0.02, lower=0)
    model = FirstOrder(["n"], {"n": formula("-a - b*n", a=a, b=b)})
    fit = identify(model, data)
    for one in (fit, identify(model, data, start=fit)):
        assert one.outcome.at_bounds == ("a",)
        assert any(w.startswith("a ended at its lower bound 0") for w in one.warnings)
        assert not any("say nothing" in w for w in one.warnings)


def test_a_common_factor_without_a_trace_is_named(loads: Measurements) -> None:
    model = PseudoHamiltonian(
        states=("q", "p"),
        S=canonical(1),
        H=formula(
            "k*q**2/2 + p**2/(2*m)",
            k=Parameter(2.0),
            m=Parameter(1.2, lower=0.1, per_trajectory=True),
        ),
        R={"p": formula("c", c=Parameter(0.1, lower=0.0))},
    )
    fit = identify(model, loads)
    assert any(
        "k, m[run 1], m[run 2], m[run 3], c apart: a common factor" in w
        for w in fit.warnings
    )
    assert all(np.isnan(fit.std_errors[name]) for name in fit.names)


def test_the_band_of_a_run_is_what_it_scatters_by_when_the_noise_is_drawn_again() -> (
    None
):
    t, x, u = record(120)
    drawn = [measured(t, noisy(x, seed, 0.05), u) for seed in range(40)]
    fits = [
        identify(duffing(), data, MaximumLikelihood(noise={"q": 0.05, "p": 0.05}))
        for data in drawn
    ]
    comparison = compare(fits[0], drawn[0])
    assert comparison.bands is not None
    np.testing.assert_allclose(comparison.shown[0], fits[0].states[0], atol=1e-4)
    ratio = np.std([fit.states[0] for fit in fits], axis=0) / comparison.bands[0]
    # The scatter of 40 runs is known to 11 %; neighbouring times are not independent,
    # so their mean is not much better.
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.2)
    assert ratio.min() > 0.6
    assert ratio.max() < 1.6


# ---- refusals ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {"huber": 0.0},
        {"huber": np.inf},
        {"steps": 0},
        {"starts": 0},
        {"starts": 1.5},
    ],
)
def test_options_that_mean_nothing_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(
        ModelError, match=f"{next(iter(options))}.*=.* is not possible; expected"
    ):
        MaximumLikelihood(**options)


# ---- the exact Hessian ---------------------------------------------------------------


def test_the_exact_hessian_is_that_of_automatic_differentiation() -> None:
    rng = np.random.default_rng(0)
    data = Measurements.from_arrays(
        [0.1 * np.arange(5), 0.13 * np.arange(4)],
        [rng.normal(size=(5, 2)), rng.normal(size=(4, 2))],
        states=["q", "p"],
    )
    model = loaded(Parameter(1.2, per_trajectory=True)).with_values({"c": 0.3})
    grid, unknown = grid_of(data), Theta.of(model, ("run 1", "run 2"))
    point = point_at(model, grid, unknown, np.array([1.2, 1.5, 0.3]), grid.y)
    values = LikelihoodValues(model, grid, "srk4", point, unknown)
    program = MaximumLikelihood().program(values, {}, np.array([0.1, 0.2]))
    z = program.start + 0.01 * rng.normal(size=program.start.size)
    multipliers = rng.normal(size=program.g.numel())
    lagrangian = program.objective + ca.dot(ca.DM(multipliers), program.g)
    whole = ca.Function(
        "h",
        [program.z, program.settings],
        [ca.triu(ca.hessian(lagrangian, program.z)[0])],
    )
    expected = np.array(whole(z, program.set_to))
    found = np.array(program.hessian(exact=True)(z, program.set_to, 1.0, multipliers))
    np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())


def test_large_residuals_of_a_wrong_model_do_not_keep_the_solver_from_its_optimum() -> (
    None
):
    # Two tanks with an overflow, fitted by two without: residuals a hundred times the
    # noise, far from independent.
    def tanks(**values: Parameter | float) -> FirstOrder:
        b, a1, a2 = values["b"], values["a1"], values["a2"]
        over = (
            formula("-c*(h1 - 5 + sqrt((h1 - 5)**2 + 0.01))/2", c=values["c"])
            if "c" in values
            else Dictionary()
        )
        upper = formula("b*u - a1*sqrt(h1**2 + 0.01)**0.5", b=b, a1=a1) + over
        lower = formula(
            "a1*sqrt(h1**2 + 0.01)**0.5 - a2*sqrt(h2**2 + 0.01)**0.5", a1=a1, a2=a2
        )
        return FirstOrder(
            states=("h1", "h2"), inputs=("u",), F={"h1": upper, "h2": lower}
        )

    rng = np.random.default_rng(5)
    t = 4.0 * np.arange(300)
    u = np.repeat(rng.uniform(1.5, 4.0, 30), 10)[:, None]
    x = simulate(tanks(b=0.06, a1=0.07, a2=0.06, c=0.5), t, [2.0, 2.0], u, hold="zero")
    y = np.column_stack(
        [np.full(len(t), np.nan), x[:, 1] + 0.01 * rng.normal(size=len(t))]
    )
    data = Measurements.from_arrays(
        t, y, u, states=["h1", "h2"], inputs=["u"], hold="zero"
    )
    free = {name: Parameter(0.05, lower=0.0, upper=1.0) for name in ("b", "a1", "a2")}
    fit = identify(tanks(**free), data)
    assert fit.outcome.success
    comparison = compare(fit, data)

    def misfit(v: np.ndarray) -> np.ndarray:
        run = tanks(b=v[0], a1=v[1], a2=v[2])
        return np.asarray(simulate(run, t, v[3:], u, hold="zero")[:, 1] - y[:, 1])

    # Least squares over simulations, from the estimate on, finds nothing better.
    begin = np.r_[[fit.values[name] for name in free], comparison.simulated[0][0]]
    shooting = least_squares(
        misfit, begin, x_scale=np.abs(begin), diff_step=1e-4, max_nfev=4
    )
    assert np.sqrt(np.mean(misfit(begin) ** 2)) < 1.001 * np.sqrt(
        np.mean(shooting.fun**2)
    )
    assert fit.noise["h2"] > 5 * 0.01


def test_the_jacobian_made_per_interval_is_that_of_automatic_differentiation() -> None:
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.05, 0.2, 7))
    data = measured(t, rng.normal(size=(7, 2)), rng.normal(size=(7, 1)))
    grid, sigma = grid_of(data, 2), np.array([0.1, 0.2])
    unknown = Theta.of(duffing(), ("run 1",))
    nodes = rng.normal(size=grid.y.shape)
    point = point_at(duffing(), grid, unknown, np.array([1.0, 0.7, 0.2]), nodes)
    values = LikelihoodValues(duffing(), grid, "srk4", point, unknown)
    program = MaximumLikelihood(huber=1.0).program(values, {"H": 0.1}, sigma)
    z = program.start + 0.1 * rng.normal(size=program.start.size)
    whole = ca.Function(
        "j", [program.z, program.settings], [ca.jacobian(program.g, program.z)]
    )
    expected = np.array(whole(z, program.set_to))
    ours = np.array(program.jacobian()(z, program.set_to)[1])
    np.testing.assert_allclose(ours, expected, rtol=1e-9, atol=1e-9)

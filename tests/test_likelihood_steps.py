"""A likelihood by full steps: the optimum that IPOPT finds, from any start."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.diagnosis.refit import BRIEF
from phsi_opt.estimation.estimate import Task
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem, StartingPoint
from phsi_opt.estimation.maximum_likelihood import crude_start
from phsi_opt.model.base import built_of
from phsi_opt.model_error import joint_estimate
from phsi_opt.optimization import banded
from phsi_opt.optimization.ipopt import DIRECT_STEPS
from phsi_opt.transcription.grid import AlignedData
from problems.benchmarks import chains
from problems.benchmarks.peer_problems import PROBLEMS, drawn
from problems.judges import couplings
from tests import systems
from tests.systems import Number, pair, positive, recorded

T = np.linspace(0.0, 20.0, 201)
NOISE = 0.02
MANY_MASSES = 16
BY_IPOPT = ph.SolverSettings(solver="ipopt")


def spring(k: Number, c: Number, m: Number = 1.5) -> ph.Model:
    return systems.spring(k, c, m)


def unknown(k: float = 1.0, c: float = 0.1) -> ph.Model:
    return spring(positive(k), positive(c))


def swinging(
    truth: ph.Model | None = None, *, only_q: bool = True, seed: int = 0
) -> ph.Measurements:
    truth = truth or spring(1.7, 0.15)
    shown = "q" if only_q else "qp"
    return recorded(truth, T, [1.0, 0.0], noise=NOISE, seed=seed, shown=shown)


def assert_same(fit: ph.Fit, other: ph.Fit, share: float) -> None:
    """The values agree within a share of their standard errors."""
    for name in other.names:
        limit = share * other.std_errors[name]
        if np.isfinite(limit):
            assert fit.values[name] == pytest.approx(other.values[name], abs=limit)


# ---- the optimum of IPOPT ------------------------------------------------------------


@pytest.mark.parametrize("only_q", [True, False])
def test_full_steps_find_the_optimum_that_ipopt_finds(only_q: bool) -> None:
    data = swinging(only_q=only_q)
    fit = ph.identify(unknown(), data)
    careful = ph.identify(unknown(), data, settings=BY_IPOPT)
    assert fit.outcome.status == DIRECT_STEPS
    assert careful.outcome.solver == "IPOPT"
    # Two channels are weighed by noises that are known to 0.005.
    assert_same(fit, careful, 1e-4 if only_q else 1e-2)
    assert fit.std_errors == pytest.approx(careful.std_errors, rel=0.01, nan_ok=True)
    assert fit.noise["q"] == pytest.approx(careful.noise["q"], rel=0.005)
    assert fit.bic == pytest.approx(careful.bic, abs=0.01)


@pytest.mark.parametrize(
    "c", [positive(0.4, lower=0.155), positive(0.05, upper=0.145)], ids=str
)
def test_an_optimum_at_a_bound_is_that_of_ipopt(c: ph.Parameter) -> None:
    model, data = spring(positive(1.0), c), swinging(seed=4)
    fit = ph.identify(model, data)
    by_ipopt = ph.identify(model, data, settings=BY_IPOPT)
    assert fit.outcome.status == DIRECT_STEPS
    assert fit.outcome.at_bounds == by_ipopt.outcome.at_bounds == ("c",)
    assert fit.values["c"] in (0.155, 0.145)
    assert_same(fit, by_ipopt, 1e-4)
    expected = pytest.approx(by_ipopt.std_errors, rel=1e-4, nan_ok=True)
    assert fit.std_errors == expected and np.isnan(fit.std_errors["c"])
    assert fit.bic == pytest.approx(by_ipopt.bic, abs=1e-3)


def test_the_band_of_many_states_that_samples_measure_is_never_filled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # With 400 states it would take 54 gigabytes.
    monkeypatch.setattr(joint_estimate, "SLOW", 0.0)  # every step is slow
    monkeypatch.setattr(banded, "Banded", None)
    loss = ph.MaximumLikelihood(steps=1)
    data = chains.data(MANY_MASSES, 100)
    fit = ph.identify(chains.model(MANY_MASSES), data, loss)
    assert fit.outcome.status == DIRECT_STEPS and fit.outcome.success


# ---- starts --------------------------------------------------------------------------


def test_a_brief_solve_of_a_larger_model_begins_with_full_steps() -> None:
    data = swinging()
    best = ph.identify(unknown(), data)
    smaller = ph.identify(spring(positive(1.0), 0.2), data)
    fit = ph.identify(unknown(), data, start=smaller, settings=BRIEF)
    assert fit.outcome.status == DIRECT_STEPS
    assert_same(fit, best, 1e-3)
    # A first step may press it to a bound; the multiplier's sign lets it go.
    smaller = ph.identify(spring(positive(1.0), 0.0), data)
    fit = ph.identify(unknown(c=0.0), data, start=smaller, settings=BRIEF)
    assert fit.outcome.status == DIRECT_STEPS and not fit.outcome.at_bounds
    assert_same(fit, best, 1e-3)


def test_states_that_nothing_tells_begin_at_the_size_of_what_they_drive() -> None:
    """Two slow voltages of a cell, of which a first look at the data says nothing."""
    t = np.arange(0.0, 2400.0, 5.0)
    current = np.where(t % 800 < 100, -20.0, 0.0)
    current += np.where((t % 800 > 300) & (t % 800 < 340), 15.0, 0.0)
    truth = {"C": 3e5, "R1": 1e-3, "tau1": 20.0, "R2": 2e-3, "tau2": 300.0}
    truth["R0"] = 1.6e-3
    x = ph.simulate(cell(truth), t, [3.7, 0.0, 0.0], u=current)
    shown = x[:, 0] + truth["R0"] * current
    shown += 1e-4 * np.random.default_rng(3).normal(size=len(t))
    y = np.column_stack([shown, np.full((len(t), 2), np.nan)])
    data = ph.Measurements.from_arrays(
        t, y, current, states=["v", "v1", "v2"], inputs=["I"]
    )
    starts = map(positive, (1e6, 2e-3, 30.0, 3e-3, 600.0, 2e-3))
    fit = ph.identify(cell(dict(zip(truth, starts, strict=True))), data)
    for name, value in truth.items():
        assert abs(fit.values[name] - value) < 4 * fit.std_errors[name]
        assert fit.std_errors[name] < 0.05 * value


def cell(numbers: Mapping[str, Number]) -> ph.Model:
    """A voltage v with two slow parts v1 and v2, seen across an inner resistance."""
    rates = {}
    for part in ("1", "2"):
        own = {name: numbers[name] for name in (f"R{part}", f"tau{part}")}
        rates[f"v{part}"] = ph.formula(f"(R{part}*I - v{part})/tau{part}", **own)
    dynamic = {name: number for name, number in numbers.items() if name != "R0"}
    rates["v"] = ph.formula("I/C + (R1*I - v1)/tau1 + (R2*I - v2)/tau2", **dynamic)
    sensor = {"v": ph.formula("R0*I", R0=numbers["R0"])}
    return ph.FirstOrder(["v", "v1", "v2"], rates, inputs=["I"], sensor=sensor)


@pytest.mark.parametrize("mass", [0.7, 1.9])
@pytest.mark.parametrize("seed", [0, 1])
def test_what_the_data_are_silent_about_stays_where_it_was(seed, mass) -> None:
    """The position alone does not tell the scale of momentum, mass, and all forces."""
    model = spring(positive(1.0), positive(0.1), ph.Parameter(mass))
    fit = ph.identify(model, swinging(seed=seed))
    assert fit.outcome.success
    assert fit.values["k"] / fit.values["m"] == pytest.approx(1.7 / 1.5, rel=0.02)
    assert 0.5 * mass < fit.values["m"] < 2 * mass
    assert np.isnan(fit.std_errors["m"])


def test_a_bound_at_which_the_model_has_no_values_is_not_stepped_on() -> None:
    def lag(tau: Number) -> ph.Model:
        return ph.FirstOrder(["x"], {"x": ph.formula("(1 - x)/tau", tau=tau)})

    data = recorded(lag(1.0), T, [0.0], noise=NOISE)
    # A second step from here would end at zero.
    far = (ph.simulate(lag(6.0), T, [0.0]),)
    slow = replace(ph.identify(lag(1.0), data), states=far)
    fit = ph.identify(lag(positive(6.0)), data, start=slow, settings=BRIEF)
    assert fit.outcome.status == DIRECT_STEPS
    assert fit.values["tau"] == pytest.approx(1.0, abs=4 * fit.std_errors["tau"])


@pytest.mark.parametrize("seed", [102, 104])
def test_a_step_that_brings_the_defects_down_does_not_count_as_slow(seed: int) -> None:
    """From states that were interpolated to finer steps, which obey no model."""
    lorenz = PROBLEMS[2]
    case = drawn(lorenz, seed)
    guess = dict(zip(lorenz.truth, case.guess.tolist(), strict=True))
    model = lorenz.model().with_values(guess)
    data = ph.Measurements.from_arrays([lorenz.t], list(case.y), states=["x", "y", "z"])
    fit = ph.identify(model, data)
    assert np.max(fit.steps[0]) == 2
    assert fit.outcome.status == DIRECT_STEPS


def solver_and_start(
    model: ph.Model, data: ph.Measurements
) -> tuple[LikelihoodProblem, StartingPoint]:
    """From the parameters of the model as they are."""
    task = Task(model, AlignedData.of(model, data), {}, None, ph.SolverSettings())
    problem = LikelihoodProblem.of(task, ph.MaximumLikelihood())
    start = crude_start(problem)
    steps = (np.ones(len(start.states[0]) - 1, dtype=int),)
    return problem, replace(start, theta=model.theta, steps=steps)


def test_steps_that_lead_nowhere_say_so() -> None:
    solver, start = solver_and_start(unknown(), swinging())
    assert solver.solve(start, most_steps=20).is_success
    for wrong in (np.full(2, 1e200), np.array([np.inf, 1.0])):
        lost = replace(start, states=(start.states[0] * wrong,))
        with np.errstate(all="ignore"):
            try:
                assert not solver.solve(lost, most_steps=20).is_success
            except ph.ModelError as error:  # a start that is no number
                assert "not finite" in str(error)
    brief = solver.solve(start, most_steps=1)
    assert not brief.is_success
    assert "became too small" in str(brief.solution.outcome)


# ---- dry friction: a body that sticks ------------------------------------------------

STUCK_TIMES = np.linspace(0.0, 12.0, 161)
STARTS = ([1.0, 0.0], [-0.7, 0.9])
FINE_NOISE = 0.01
FRICTION, DAMPING = 0.25, 0.05


def rubbing(corner: float, friction: Number, damping: Number) -> ph.Model:
    """A spring and a mass with dry friction, whose sign turns over within the velocity
    ``corner``.
    """
    loss = "c + f*(dH_dp**4 + v0**4)**(-1/4)"
    return pair("1.7*q**2/2 + p**2/2", loss, c=damping, f=friction, v0=corner)


def rubbed(corner: float) -> ph.Measurements:
    """Positions of two runs that come to rest away from the middle."""
    truth = rubbing(corner, FRICTION, DAMPING)
    return recorded(truth, STUCK_TIMES, *STARTS, noise=FINE_NOISE, shown="q")


def friction_and_damping_free(corner: float) -> ph.Model:
    return rubbing(corner, positive(0.2), positive(0.1))


def test_a_body_that_sticks_is_fitted_beside_a_sharp_corner() -> None:
    data, loss = rubbed(0.002), ph.MaximumLikelihood(steps=6)
    fit = ph.identify(friction_and_damping_free(0.02), data, loss)
    for corner in (0.005, 0.002):  # sharper by up to four, as in a diagnosis
        model = friction_and_damping_free(corner)
        start = replace(fit, model=fit.model.with_values({"v0": corner}))
        fit = ph.identify(model, data, loss, start=start, settings=BRIEF)
    for name, value in (("f", FRICTION), ("c", DAMPING)):
        assert abs(fit.estimates[name] - value) < 4 * fit.std_errors[name]
    assert fit.noise["q"] == pytest.approx(FINE_NOISE, rel=0.15)


def test_the_limit_of_time_is_told() -> None:
    said = r"the time limit of 1e-06 s was reached.*Maximum_WallTime"
    brief = ph.SolverSettings(max_seconds=1e-6, thorough=False)
    with pytest.raises(ph.SolveError, match=f"{said}.*allow more time"):
        ph.identify(friction_and_damping_free(0.3), rubbed(0.3), settings=brief)


# ---- what is built once --------------------------------------------------------------


def test_a_fit_is_the_same_to_the_bit_whatever_was_fitted_before() -> None:
    data = swinging(seed=2)
    warm = ph.identify(unknown(), data)
    ph.identify(spring(ph.Parameter(1.0), 0.2), swinging(seed=3))
    again = ph.identify(unknown(), data)
    built_of.cache_clear()
    fresh = ph.identify(unknown(), data)
    for fit in (again, fresh):
        assert fit.values == warm.values
        np.testing.assert_array_equal(fit.covariance, warm.covariance)
        np.testing.assert_array_equal(fit.states[0], warm.states[0])


def test_states_that_meet_a_kink_go_to_and_fro_and_then_obey_the_dynamics() -> None:
    case = couplings.tanks("spill", np.random.default_rng(15085))
    name = "spill from h1 into h2"
    spill = next(one for one in ph.catalogue(case.model) if one.name == name)
    fit = ph.identify(case.model.add(spill), case.data[:-1])
    assert fit.outcome.infeasibility < 1e-7
    assert fit.outcome.iterations < 50  # IPOPT stops after 500
    assert fit.estimates["spill_from_h1_into_h2"] == pytest.approx(
        case.sizes[name], rel=0.01
    )

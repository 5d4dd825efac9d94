"""Full steps from a simple start: the optimum that IPOPT finds, or no answer."""

import weakref
from dataclasses import replace

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.diagnosis.refit_effort import BRIEF
from phsi_opt.estimation import direct_steps
from phsi_opt.estimation.direct_steps import DirectSteps
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem
from phsi_opt.estimation.likelihood_solve import LikelihoodSolver
from phsi_opt.estimation.likelihood_start import crude_start
from phsi_opt.estimation.problem import Task
from phsi_opt.estimation.starting_point import StartingPoint
from phsi_opt.initialization.kinematic_states import kinematic_states
from phsi_opt.model.model import Model, built_of
from phsi_opt.optimization.bounded_step import Room
from phsi_opt.optimization.chained import FEWEST_STATES
from phsi_opt.optimization.endings import DIRECT_STEPS
from phsi_opt.optimization.mixed_steps import MixedSteps
from phsi_opt.optimization.settings import EXACT, GAUSS_NEWTON
from phsi_opt.transcription.alignment import AlignedData
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.interval_map import mapped
from phsi_opt.transcription.optimality_system import Factored, OptimalitySystem
from phsi_opt.transcription.pattern import Pattern
from problems.benchmarks import state_growth
from problems.benchmarks.peer_cases import PROBLEMS, drawn

T = np.linspace(0.0, 20.0, 201)
NOISE = 0.02
MANY_MASSES = 16


def spring(
    k: ph.Parameter | float, c: ph.Parameter | float, m: ph.Parameter | float = 1.5
) -> ph.Model:
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/(2*m)", k=k, m=m),
        R={"p": ph.formula("c", c=c)},
    )


def unknown(k: float = 1.0, c: float = 0.1) -> ph.Model:
    return spring(ph.Parameter(k, lower=0), ph.Parameter(c, lower=0))


def swinging(
    truth: ph.Model | None = None, *, only_q: bool = True, seed: int = 0
) -> ph.Measurements:
    x = ph.simulate(truth or spring(1.7, 0.15), T, [1.0, 0.0])
    y = x + NOISE * np.random.default_rng(seed).normal(size=x.shape)
    if only_q:
        y[:, 1] = np.nan
    return ph.Measurements.from_arrays(T, y, states=["q", "p"])


@pytest.mark.parametrize("only_q", [True, False])
def test_full_steps_find_the_optimum_that_ipopt_finds(only_q: bool) -> None:
    data = swinging(only_q=only_q)
    fit = ph.identify(unknown(), data)
    assert fit.outcome.status == DIRECT_STEPS
    careful = ph.identify(unknown(), data, settings=ph.SolverSettings(solver="ipopt"))
    assert careful.outcome.solver == "IPOPT"
    for name in ("k", "c"):
        # Two channels are weighed by noises that are known to 0.005.
        limit = (1e-4 if only_q else 1e-2) * fit.std_errors[name]
        assert fit.values[name] == pytest.approx(careful.values[name], abs=limit)
        assert fit.std_errors[name] == pytest.approx(careful.std_errors[name], rel=0.01)
    assert fit.noise["q"] == pytest.approx(careful.noise["q"], rel=0.005)
    assert fit.bic == pytest.approx(careful.bic, abs=0.01)


def test_a_brief_solve_of_a_larger_model_begins_with_full_steps() -> None:
    data = swinging()
    smaller = ph.identify(spring(ph.Parameter(1.0, lower=0), 0.2), data)
    fit = ph.identify(unknown(), data, start=smaller, settings=BRIEF)
    assert fit.outcome.status == DIRECT_STEPS
    best = ph.identify(unknown(), data)
    for name in ("k", "c"):
        limit = 1e-3 * best.std_errors[name]
        assert fit.values[name] == pytest.approx(best.values[name], abs=limit)


def test_a_crude_start_leads_to_the_optimum_where_the_model_lacks_something() -> None:
    truth = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("1.7*q**2/2 + q**4 + p**2/3"),
        R={"p": ph.formula("0.15")},
    )
    data = swinging(truth)
    fit = ph.identify(unknown(), data)
    near = ph.identify(unknown(fit.values["k"], fit.values["c"]), data)
    assert fit.bic == pytest.approx(near.bic, abs=1e-3)
    assert fit.noise["q"] > 2 * NOISE


@pytest.mark.parametrize("mass", [0.7, 1.0, 1.9])
@pytest.mark.parametrize("seed", [0, 1])
def test_what_the_data_are_silent_about_stays_where_it_was(
    seed: int, mass: float
) -> None:
    """The position alone does not tell the scale of momentum, mass, and all forces.

    Nor may defects that do not hold yet, of a start that is off, seem to tell it.
    """
    model = spring(
        ph.Parameter(1.0, lower=0), ph.Parameter(0.1, lower=0), ph.Parameter(mass)
    )
    fit = ph.identify(model, swinging(seed=seed))
    assert fit.outcome.success
    assert fit.values["k"] / fit.values["m"] == pytest.approx(1.7 / 1.5, rel=0.02)
    assert 0.5 * mass < fit.values["m"] < 2 * mass
    assert np.isnan(fit.std_errors["m"])


@pytest.mark.parametrize("side", ["lower", "upper"])
def test_an_optimum_at_a_bound_is_that_of_ipopt(
    monkeypatch: pytest.MonkeyPatch, side: str
) -> None:
    c = ph.Parameter(0.4, lower=0.155)
    if side == "upper":
        c = ph.Parameter(0.05, lower=0, upper=0.145)
    model = spring(ph.Parameter(1.0, lower=0), c)
    data = swinging(seed=4)
    fit = ph.identify(model, data)
    assert fit.outcome.status == DIRECT_STEPS
    assert fit.outcome.at_bounds == ("c",)
    assert fit.values["c"] in (0.155, 0.145)
    monkeypatch.setattr(DirectSteps, "optimum", lambda *_: None)
    by_ipopt = ph.identify(model, data)
    assert by_ipopt.outcome.status != DIRECT_STEPS
    assert by_ipopt.outcome.at_bounds == ("c",)
    limit = 1e-4 * fit.std_errors["k"]
    assert fit.values["k"] == pytest.approx(by_ipopt.values["k"], abs=limit)
    assert fit.std_errors["k"] == pytest.approx(by_ipopt.std_errors["k"], rel=1e-4)
    assert np.isnan(fit.std_errors["c"]) and np.isnan(by_ipopt.std_errors["c"])
    assert fit.bic == pytest.approx(by_ipopt.bic, abs=1e-3)


def test_a_parameter_that_begins_at_its_bound_leaves_it() -> None:
    """A first step may press it there; the multiplier's sign lets it go."""
    data = swinging()
    held = spring(ph.Parameter(1.0, lower=0), 0.0)
    smaller = ph.identify(held, data)
    fit = ph.identify(unknown(c=0.0), data, start=smaller, settings=BRIEF)
    assert fit.outcome.status == DIRECT_STEPS and not fit.outcome.at_bounds
    best = ph.identify(unknown(), data)
    limit = 1e-3 * best.std_errors["c"]
    assert fit.values["c"] == pytest.approx(best.values["c"], abs=limit)


def test_an_optimum_at_a_bound_beside_which_nothing_is_told_is_left_to_ipopt() -> None:
    """Without the force its frequency is anything: another one may lead inside."""

    def wave(size: ph.Parameter | float, omega: ph.Parameter | float) -> ph.Effect:
        term = ph.formula("size*sin(omega*t)**2", size=size, omega=omega)
        return ph.Effect("a wave", "F", "p", term)

    size, omega = ph.Parameter(0.0, lower=0), ph.Parameter(3.0, lower=0)
    data = swinging(spring(1.7, 0.15).add(wave(-0.3, 3.0)))
    model = spring(1.7, 0.15).add(wave(size, omega))
    solver, start = solver_and_start(model, data)
    assert solver.solve_directly(start) is None
    # With a frequency that is known nothing is silent.
    model = spring(1.7, 0.15).add(wave(size, 3.0))
    solver, start = solver_and_start(model, data)
    found = solver.solve_directly(start)
    assert found is not None
    assert found.solution.outcome.at_bounds == ("size",)


def solver_and_start(
    model: ph.Model, data: ph.Measurements
) -> tuple[LikelihoodSolver, StartingPoint]:
    """From the parameters of the model as they are."""
    task = Task(model, AlignedData.of(model, data), {}, None, ph.SolverSettings())
    problem = LikelihoodProblem.of(task, ph.MaximumLikelihood())
    start = crude_start(problem)
    return LikelihoodSolver(problem), replace(start, theta=model.theta)


def test_a_bound_at_which_the_model_has_no_values_is_not_stepped_on() -> None:
    def lag(tau: ph.Parameter | float) -> ph.Model:
        return ph.FirstOrder(["x"], {"x": ph.formula("(1 - x)/tau", tau=tau)})

    x = ph.simulate(lag(1.0), T, [0.0])
    y = x + NOISE * np.random.default_rng(0).normal(size=x.shape)
    data = ph.Measurements.from_arrays(T, y, states=["x"])
    # A second step from here would end at zero.
    slow = replace(
        ph.identify(lag(1.0), data), states=(ph.simulate(lag(6.0), T, [0.0]),)
    )
    unknown_lag = lag(ph.Parameter(6.0, lower=0))
    fit = ph.identify(unknown_lag, data, start=slow, settings=BRIEF)
    assert fit.outcome.status == DIRECT_STEPS
    assert fit.values["tau"] == pytest.approx(1.0, abs=4 * fit.std_errors["tau"])


def large_residuals() -> tuple[ph.Model, ph.Measurements, ph.Fit]:
    """A model that lacks much, and a start from which full steps go to and fro."""
    truth = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("1.7*q**2/2 + 0.4*q**4 + p**2/3"),
        R={"p": ph.formula("0.15")},
    )
    data = swinging(truth)
    smaller = ph.identify(spring(ph.Parameter(1.0, lower=0), 0.2), data)
    return unknown(), data, smaller


def test_steps_that_leave_a_share_of_the_error_each_are_mixed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, data, start = large_residuals()
    fit = ph.identify(model, data, start=start, settings=BRIEF)
    assert fit.outcome.status == DIRECT_STEPS
    with monkeypatch.context() as patched:
        patched.setattr(MixedSteps, "end", lambda _, step, end, times: end)
        unmixed = ph.identify(model, data, start=start, settings=BRIEF)
    is_slower = unmixed.outcome.iterations > fit.outcome.iterations + 2
    assert unmixed.outcome.status != DIRECT_STEPS or is_slower
    monkeypatch.setattr(DirectSteps, "optimum", lambda *_: None)
    by_ipopt = ph.identify(model, data, start=start, settings=BRIEF)
    for name in ("k", "c"):
        limit = 1e-2 * fit.std_errors[name]
        assert fit.values[name] == pytest.approx(by_ipopt.values[name], abs=limit)
    assert fit.bic == pytest.approx(by_ipopt.bic, abs=0.1)


@pytest.mark.parametrize("seed", [102, 103, 104])
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


def test_where_full_steps_creep_the_exact_hessian_comes_first_on_a_problem_like_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, data, start = large_residuals()
    fit = ph.identify(model, data, start=start, settings=BRIEF)
    assert fit.outcome.way == GAUSS_NEWTON
    monkeypatch.setattr(direct_steps, "CONTRACTION", 0.05)
    monkeypatch.setattr(direct_steps, "FREE_STEPS", 20)
    fit = ph.identify(model, data, start=start, settings=BRIEF)
    assert fit.outcome.status == DIRECT_STEPS and fit.outcome.way == EXACT
    monkeypatch.setattr(DirectSteps, "optimum", lambda *_: None)
    assert ph.identify(model, data, start=fit, settings=BRIEF).outcome.is_exact


def test_steps_that_lead_nowhere_give_no_answer() -> None:
    solver, start = solver_and_start(unknown(), swinging())
    assert solver.solve_directly(start) is not None
    for wrong in (np.full(2, 1e200), np.array([np.inf, 1.0])):
        lost = replace(start, states=(start.states[0] * wrong,))
        with np.errstate(all="ignore"):
            try:
                assert solver.solve_directly(lost) is None
            except ph.ModelError as error:  # a start that is no number
                assert "not finite" in str(error)
    brief = replace(solver.task, settings=ph.SolverSettings(max_iterations=1))
    solver = LikelihoodSolver(replace(solver.problem, task=brief))
    assert solver.solve_directly(start) is None


def pattern_of(matrix: np.ndarray) -> Pattern:
    rows, columns = np.nonzero(matrix)
    return Pattern(rows, columns, (matrix.shape[0], matrix.shape[1]))


def test_a_step_is_that_of_dense_algebra() -> None:
    rng = np.random.default_rng(0)
    t = [np.arange(5.0), np.arange(4.0)]
    data = ph.Measurements.from_arrays(
        t, [rng.normal(size=(len(s), 2)) for s in t], states=["a", "b"]
    )
    grid = grid_of(data)
    n_theta, n_x, n_g = 2, 2 * grid.n_nodes, 2 * grid.n_intervals
    H = np.diag(rng.uniform(1.0, 2.0, n_theta + n_x))
    H[0, n_theta + 3] = 0.1  # as a sensor's gain would have it
    J = np.zeros((n_g, n_theta + n_x))
    J[:, :n_theta] = rng.normal(size=(n_g, n_theta))
    for interval, begin in enumerate(grid.begin):
        rows = slice(2 * interval, 2 * interval + 2)
        columns = slice(n_theta + 2 * begin, n_theta + 2 * begin + 4)
        J[rows, columns] = rng.normal(size=(2, 4))
    gradient, g = rng.normal(size=n_theta + n_x), rng.normal(size=n_g)
    system = OptimalitySystem(grid, 2, pattern_of(H), pattern_of(J))
    entries = H[np.nonzero(H)], J[np.nonzero(J)]
    free = Room(np.full(2, -1e9), np.full(2, 1e9))
    factored = system.factored(*entries)
    step = factored.step(gradient, g, free)
    whole = H + np.triu(H, 1).T
    matrix = np.block([[whole, J.T], [J, np.zeros((n_g, n_g))]])
    expected = np.linalg.solve(matrix, -np.r_[gradient, g])
    np.testing.assert_allclose(np.r_[step.z, step.multipliers], expected, rtol=1e-8)
    np.testing.assert_allclose(system.times(entries[0], step.z), whole @ step.z)
    left = system.lagrangian_gradient(gradient, entries[1], step.multipliers)
    np.testing.assert_allclose(left, gradient + J.T @ step.multipliers)
    # From another point, whose gradient and offset are those of the same quadratic.
    moved, multipliers = rng.normal(size=n_theta + n_x), rng.normal(size=n_g)
    there = gradient + whole @ moved
    lagrangian = system.lagrangian_gradient(there, entries[1], multipliers)
    again = factored.step(lagrangian, g + J @ moved, free)
    found = np.r_[moved + again.z, multipliers + again.multipliers]
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    # Held at zero, the first parameter has no row.
    one_held = Room(np.array([0.0, -1e9]), np.array([0.0, 1e9]))
    held = system.factored(*entries).step(gradient, g, one_held)
    matrix[0] = 0.0
    matrix[0, 0] = 1.0
    right = -np.r_[0.0, gradient[1:], g]
    found = np.r_[held.z, held.multipliers]
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), 1e-7, 1e-12)


def test_dear_factors_serve_several_steps_to_the_same_optimum(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    chain = state_growth.model(MANY_MASSES)
    data = state_growth.data(MANY_MASSES, 100)
    assert 2 * MANY_MASSES >= FEWEST_STATES
    factored = OptimalitySystem.factored
    points: list[weakref.ref[Factored]] = []

    def counted(system: OptimalitySystem, *entries: np.ndarray) -> Factored:
        assert all(of_earlier() is None for of_earlier in points)  # to make room
        found = factored(system, *entries)
        points.append(weakref.ref(found))
        return found

    monkeypatch.setattr(OptimalitySystem, "factored", counted)
    loss = ph.MaximumLikelihood(steps=1)
    kept = ph.identify(chain, data, loss)
    n_kept = len(points)
    assert kept.outcome.iterations > n_kept
    points.clear()
    monkeypatch.setattr(direct_steps, "AGAIN_IF_DEAR", 0.0)
    anew = ph.identify(chain, data, loss)
    assert anew.outcome.iterations == len(points)
    for name, value in anew.values.items():
        close = pytest.approx(value, abs=1e-4 * anew.std_errors[name])
        assert kept.values[name] == close
    assert kept.std_errors == pytest.approx(anew.std_errors, rel=1e-5)


def test_the_last_steps_take_the_factors_of_one_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    expected = ph.identify(unknown(), swinging())
    full: list[object] = []
    factored = OptimalitySystem.factored

    def counted(system: OptimalitySystem, *entries: np.ndarray) -> Factored:
        full.append(system)
        return factored(system, *entries)

    monkeypatch.setattr(OptimalitySystem, "factored", counted)
    fit = ph.identify(unknown(), swinging())
    assert 1 < len(full) <= fit.outcome.iterations - 2
    monkeypatch.setattr(direct_steps, "AGAIN", 0.0)
    full.clear()
    anew = ph.identify(unknown(), swinging())
    assert len(full) == anew.outcome.iterations
    for name, value in expected.values.items():
        assert anew.values[name] == pytest.approx(value, rel=1e-8)


# --- States by kinematics


def test_a_momentum_follows_from_the_rate_of_its_position() -> None:
    x = ph.simulate(spring(1.7, 0.15), T, [1.0, 0.0])
    y = x.copy()
    y[:, 1] = np.nan
    y[50:60, 0] = np.nan  # a gap
    data = ph.Measurements.from_arrays(T, y, states=["q", "p"])
    found = kinematic_states(spring(1.7, 0.15), grid_of(data))
    assert found.is_complete
    is_known = np.isfinite(y[:, 0])
    np.testing.assert_array_equal(found.x[is_known, 0], y[is_known, 0])
    inside = slice(70, 190)
    # Differences over two intervals of 0.1: the third derivative times h^2 / 6.
    np.testing.assert_allclose(found.x[inside, 1], x[inside, 1], atol=0.01)


def test_states_follow_in_turn_from_rates_that_follow() -> None:
    chain = ph.FirstOrder(
        ["a", "b", "c"],
        {"a": ph.formula("b"), "b": ph.formula("c"), "c": ph.formula("-a")},
    )
    x = ph.simulate(chain, T, [1.0, 0.0, 0.0])
    y = x.copy()
    y[:, 1:] = np.nan
    data = ph.Measurements.from_arrays(T, y, states=["a", "b", "c"])
    found = kinematic_states(chain, grid_of(data))
    assert found.is_complete
    size = np.max(np.abs(x), axis=0)
    # Differences of differences; the third derivative is of the size of the motion.
    inside = slice(10, -10)
    np.testing.assert_allclose(found.x[inside] / size, x[inside] / size, atol=0.02)


def test_a_state_that_moves_nothing_measured_is_not_guessed() -> None:
    model = ph.FirstOrder(
        ["a", "b", "c"],
        {"a": ph.formula("-a"), "b": ph.formula("-b + a"), "c": ph.formula("b - c")},
    )
    y = np.column_stack([np.exp(-T), np.full((len(T), 2), np.nan)])
    data = ph.Measurements.from_arrays(T, y, states=["a", "b", "c"])
    found = kinematic_states(model, grid_of(data))
    assert not found.is_complete
    np.testing.assert_array_equal(found.x[:, 1:], 0.0)


# --- What is built once


def test_a_second_fit_builds_no_function_of_the_formulas(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ph.identify(unknown(), swinging())
    built = Model.built

    def kept(model: Model, key: str, make: object) -> object:
        assert key in model._built, f"{key} was built again"
        return built(model, key, make)  # type: ignore[arg-type]

    monkeypatch.setattr(Model, "built", kept)
    # Another model object, with other values to start from, and other data.
    fit = ph.identify(unknown(1.2, 0.2), swinging(seed=1))
    assert fit.outcome.success


def test_what_is_built_depends_on_the_formulas_and_the_known_numbers_alone() -> None:
    one = unknown(1.0)._built
    assert unknown(2.0)._built is one
    assert spring(ph.Parameter(1.0), ph.Parameter(0.1))._built is one
    assert unknown().with_values({"k": 3.0})._built is one
    others = [
        spring(1.0, ph.Parameter(0.1)),
        spring(ph.Parameter(1.0), ph.Parameter(0.1), m=2.0),
        unknown().dynamics().with_free(["m"]),
    ]
    for other in others:
        assert other._built is not one


def test_a_fit_is_the_same_to_the_bit_whatever_was_fitted_before() -> None:
    data = swinging(seed=2)
    warm = ph.identify(unknown(), data)
    ph.identify(spring(ph.Parameter(1.0), 0.2), swinging(seed=3))
    again = ph.identify(unknown(), data)
    built_of.cache_clear()
    mapped.cache_clear()
    fresh = ph.identify(unknown(), data)
    for fit in (again, fresh):
        assert fit.values == warm.values
        np.testing.assert_array_equal(fit.covariance, warm.covariance)
        np.testing.assert_array_equal(fit.states[0], warm.states[0])

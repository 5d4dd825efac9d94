"""Fits along solutions of the model: the optimum of the same likelihood, also where a
body sticks.
"""

from dataclasses import replace

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.estimation import solver_chain
from phsi_opt.estimation.feasible_path import FeasiblePath
from phsi_opt.estimation.likelihood_solve import LikelihoodSolver
from phsi_opt.estimation.record_likelihood import RecordLikelihood
from phsi_opt.initialization.scaling import point_at
from phsi_opt.optimization.endings import PATH_ITERATIONS
from phsi_opt.optimization.ipopt import Solver
from phsi_opt.optimization.settings import EXACT, FEASIBLE_PATH, SolverSettings
from phsi_opt.transcription.alignment import AlignedData
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.parameter_vector import Theta

T = np.linspace(0.0, 12.0, 161)
STARTS = ([1.0, 0.0], [-0.7, 0.9])
NOISE = 0.01
FRICTION, DAMPING = 0.25, 0.05


def rubbing(
    corner: float, friction: ph.Parameter | float, damping: ph.Parameter | float
) -> ph.PseudoHamiltonian:
    """A spring and a mass with dry friction, whose sign turns over within the velocity
    ``corner``.
    """
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("1.7*q**2/2 + p**2/2"),
        R={
            "p": ph.formula(
                "c + f*(dH_dp**4 + v0**4)**(-1/4)", c=damping, f=friction, v0=corner
            )
        },
    )


def measured(corner: float) -> ph.Measurements:
    """Positions of two runs that come to rest away from the middle."""
    rng = np.random.default_rng(0)
    runs = [ph.simulate(rubbing(corner, FRICTION, DAMPING), T, x0) for x0 in STARTS]
    runs = [x + NOISE * rng.normal(size=x.shape) for x in runs]
    for x in runs:
        x[:, 1] = np.nan
    return ph.Measurements.from_arrays([T] * 2, runs, states=["q", "p"])


def friction_and_damping_free(corner: float) -> ph.PseudoHamiltonian:
    return rubbing(corner, ph.Parameter(0.2, lower=0.0), ph.Parameter(0.1, lower=0.0))


def path_of(model: ph.PseudoHamiltonian, data: ph.Measurements) -> FeasiblePath:
    """The steps from a simulation of the model with its present values."""
    loss = ph.MaximumLikelihood()
    grid = grid_of(data)
    unknown = Theta.of(model, ("run 1", "run 2"))
    nodes = np.concatenate([ph.simulate(model, T, x0) for x0 in STARTS])
    point = point_at(model, grid, unknown, model.theta, nodes)
    sigma = np.array([NOISE, 1.0])
    program = loss.program(model, grid, point, {}, sigma, unknown)
    return FeasiblePath(program, model, grid, unknown, loss)


def test_it_finds_the_optimum_that_ipopt_finds() -> None:
    # A corner as wide as this is no hindrance to either.
    data = measured(0.3)
    model = friction_and_damping_free(0.3)
    path = path_of(model, data)
    solver = Solver(path.program, SolverSettings())
    start = path.program.start
    sigma = path.program.set_to
    mine = path.solve(start, sigma)
    ipopt = solver.solve(start, sigma)
    assert mine.outcome.success and mine.outcome.infeasibility < 1e-7
    # A thousandth of a fall of -2 log likelihood is a thirtieth of a standard error.
    n = path.program.residual.numel()
    assert n * (mine.outcome.objective - ipopt.outcome.objective) == pytest.approx(
        0.0, abs=2e-3
    )
    np.testing.assert_allclose(mine.values["x"], ipopt.values["x"], atol=0.05 * NOISE)


def test_it_ends_as_soon_where_the_noise_is_assumed_far_too_small() -> None:
    # A wrong model leaves a thousand times the noise of its sensors. The last fall that
    # counts is one beside what is left, not beside that noise: it went on for 12 steps.
    path = path_of(friction_and_damping_free(0.003), measured(0.003))
    start = path.program.start
    true_noise = path.solve(start, path.program.set_to)
    too_small = path.solve(start, path.program.set_to * np.array([0.001, 1.0]))
    assert too_small.outcome.success
    assert too_small.outcome.iterations == true_noise.outcome.iterations
    # The same steps, but for rounding.
    np.testing.assert_allclose(
        too_small.values["theta"], true_noise.values["theta"], rtol=1e-6
    )


def test_a_parameter_stays_within_its_bounds() -> None:
    data = measured(0.3)
    model = rubbing(
        0.3, ph.Parameter(0.2, lower=0.0, upper=0.22), ph.Parameter(0.1, lower=0.0)
    )
    path = path_of(model, data)
    found = path.solve(path.program.start, path.program.set_to)
    assert found.outcome.success and found.outcome.at_bounds == ("f",)
    assert found.values["theta"][model.free.index("f")] == pytest.approx(0.22)


def test_the_limit_of_time_ends_it_and_says_so() -> None:
    path = path_of(friction_and_damping_free(0.3), measured(0.3))
    path.max_seconds = 0.0
    with pytest.raises(
        ph.SolveError,
        match="the time limit of 0 s ended the steps along solutions of the model"
        r".*allow more time",
    ):
        path.solve(path.program.start, path.program.set_to)
    outcome = path.solve(
        path.program.start, path.program.set_to, raise_on_failure=False
    ).outcome
    assert outcome.is_out_of_time and not outcome.is_out_of_iterations


def test_the_limit_of_iterations_ends_it_and_is_not_one_of_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = path_of(friction_and_damping_free(0.3), measured(0.3))
    monkeypatch.setattr("phsi_opt.estimation.feasible_path.MAX_ITERATIONS", 1)
    outcome = path.solve(
        path.program.start, path.program.set_to, raise_on_failure=False
    ).outcome
    assert not outcome.success and outcome.iterations == 1
    assert outcome.is_out_of_iterations and not outcome.is_out_of_time


def test_a_model_without_slopes_ends_it() -> None:
    # The square root is vertical at zero, where its parameter is: there is no step to
    # take, and no error from within.
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("1.7*q**2/2 + p**2/2"),
        R={"p": ph.formula("0.1 + sqrt(s)", s=ph.Parameter(0.0, lower=0.0))},
    )
    path = path_of(model, measured(0.3))
    with pytest.raises(
        ph.SolveError, match="the slopes of the model are not finite along its solution"
    ):
        path.solve(path.program.start, path.program.set_to)


def test_every_point_is_on_the_model_or_there_is_none() -> None:
    model = friction_and_damping_free(0.3)
    path = path_of(model, measured(0.3))
    z = path.program.start.copy()
    x = z[path.x].reshape(2, len(T), 2)
    x[:, 1:] = 0.0  # but for the starting states nothing is given
    found = path.follow(z, path.program.set_to)
    assert found is not None
    states = (found.z * path.program.scale)[path.x].reshape(2, len(T), 2)
    for x, x0 in zip(states, STARTS, strict=True):
        # The scheme takes one step per sample.
        np.testing.assert_allclose(x, ph.simulate(model, T, x0), atol=2e-4)
    z[path.theta.start] = -1e6
    assert path.follow(z, path.program.set_to) is None


def test_a_body_that_sticks_is_fitted_where_ipopt_is_not_quick() -> None:
    data, loss = measured(0.002), ph.MaximumLikelihood(steps=6)
    model = friction_and_damping_free(0.002)
    wide = ph.identify(model.with_values({"v0": 0.02}), data, loss)
    lines: list[str] = []
    start = replace(wide, model=wide.model.with_values({"v0": 0.002}))
    brief = SolverSettings(thorough=False)
    fit = ph.identify(
        model, data, loss, start=start, settings=brief, progress=lines.append
    )
    assert fit.outcome.way == FEASIBLE_PATH and any(
        "again along solutions of the model" in line for line in lines
    )
    for name, value in (("f", FRICTION), ("c", DAMPING)):
        assert abs(fit.estimates[name] - value) < 4 * fit.std_errors[name]
    assert fit.noise["q"] == pytest.approx(NOISE, rel=0.15)


def test_where_all_fails_ipopt_says_why() -> None:
    model = friction_and_damping_free(0.3)
    with pytest.raises(
        ph.SolveError,
        match=r"the time limit of 1e-06 s ended the solve.*Maximum_WallTime"
        r".*allow more time",
    ):
        ph.identify(
            model,
            measured(0.3),
            settings=SolverSettings(max_seconds=1e-6, thorough=False),
        )


def test_ways_that_the_settings_leave_out_are_not_taken() -> None:
    model = friction_and_damping_free(0.3)
    data = measured(0.3)
    for way, status in ((FEASIBLE_PATH, "Feasible_Path"), (EXACT, "Solve_Succeeded")):
        fit = ph.identify(model, data, settings=SolverSettings(ways=(way,)))
        assert (fit.outcome.success, fit.outcome.status) == (True, status)
        assert abs(fit.estimates["f"] - FRICTION) < 4 * fit.std_errors["f"]
    # Huber's outliers are slack variables: nothing can be solved along the model, the
    # exact Hessian stands in.
    loss = ph.MaximumLikelihood(huber=1.345)
    fit = ph.identify(model, data, loss, settings=SolverSettings(ways=(FEASIBLE_PATH,)))
    assert (fit.outcome.success, fit.outcome.status) == (True, "Solve_Succeeded")


def test_a_fit_along_solutions_is_compared_along_solutions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = measured(0.3)
    fit = ph.identify(friction_and_damping_free(0.3), data)
    along = replace(fit, outcome=replace(fit.outcome, status="Feasible_Path"))
    found = ph.compare(fit, data)
    used: list[str] = []
    monkeypatch.setattr(solver_chain, "Solver", lambda *a, **k: used.append("ipopt"))
    assert ph.compare(along, data).rmse == pytest.approx(found.rmse, rel=1e-4)
    assert not used


def test_what_settled_at_a_kink_stays_there_when_the_noise_is_estimated_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    solve, solved = FeasiblePath.solve, []

    def stuck_from_the_second_on(
        self: FeasiblePath, start: np.ndarray, set_to: np.ndarray, **options: bool
    ) -> object:
        found = solve(self, start, set_to, **options)
        solved.append(found)
        return (
            found
            if len(solved) == 1
            else replace(found, outcome=replace(found.outcome, success=False))
        )

    monkeypatch.setattr(FeasiblePath, "solve", stuck_from_the_second_on)
    model = friction_and_damping_free(0.3)
    only = SolverSettings(ways=(FEASIBLE_PATH,))
    # Two channels whose noise is not as it seems at the start, each by a factor of its
    # own.
    rng = np.random.default_rng(1)
    runs = [ph.simulate(rubbing(0.3, FRICTION, DAMPING), T, x0) for x0 in STARTS]
    runs = [x + np.array([NOISE, 5 * NOISE]) * rng.normal(size=x.shape) for x in runs]
    data = ph.Measurements.from_arrays([T] * 2, runs, states=["q", "p"])
    fit = ph.identify(model, data, settings=only)
    assert len(solved) == 2 and fit.outcome.success
    assert list(fit.estimates.values()) == list(solved[0].values["theta"])
    assert fit.noise == pytest.approx({"q": NOISE, "p": 5 * NOISE}, rel=0.15)
    # What fails at once has settled nowhere.
    with pytest.raises(ph.SolveError):
        ph.identify(model, data, settings=only)


def test_newton_caught_beyond_a_corner_begins_again_at_the_state_before() -> None:
    corner = 0.0005
    model = rubbing(
        corner, ph.Parameter(FRICTION, lower=0.0), ph.Parameter(DAMPING, lower=0.0)
    )
    path = path_of(model, measured(corner))
    z = path.program.start.copy()
    velocities = z[path.x].reshape(2, len(T), 2)[:, 1:, 1]
    velocities += 0.01  # guesses that slide where the body sticks
    assert path.follow(z, path.program.set_to) is not None
    path.march.careful = path.march.quick
    assert path.follow(z, path.program.set_to) is None


def test_a_solution_that_is_no_optimum_is_enough_to_start_a_free_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data, x = (
        measured(0.3),
        tuple(ph.simulate(rubbing(0.3, FRICTION, DAMPING), T, x0) for x0 in STARTS),
    )
    model, sigma, steps = (
        rubbing(0.3, 0.9 * FRICTION, DAMPING),
        np.array([NOISE, 1.0]),
        [np.ones(len(T) - 1, int)] * 2,
    )
    monkeypatch.setattr("phsi_opt.estimation.feasible_path.MAX_ITERATIONS", 1)
    monkeypatch.setattr(LikelihoodSolver, "continued", lambda *_: None)

    aligned = AlignedData.of(model, data)
    record = RecordLikelihood(aligned, sigma, ph.MaximumLikelihood())
    start = record.start_of_run(model, x, steps, FEASIBLE_PATH)
    best = record.maximum(model, x, steps, FEASIBLE_PATH)
    assert start is not None and best is not None
    assert start.solution.outcome.status == PATH_ITERATIONS
    assert best.solution.outcome.status == "Solve_Succeeded"


def test_a_parameter_at_its_bound_moves_inwards_alone() -> None:
    # Both begin at zero: friction is there and leaves it, damping is not and stays.
    data = measured(0.3)
    model = rubbing(0.3, ph.Parameter(0.0, lower=0.0), ph.Parameter(0.0, lower=0.0))
    path = path_of(model, data)
    start = path.program.start
    place = path.follow(start, path.program.set_to)
    assert place is not None
    step = path._step(place, 0.0, path.program.set_to)
    change = step.change[path.theta]
    # What is held has a very large information, not an infinite one.
    assert np.all(change > -1e-8) and change.max() > 0.01
    assert step.promise > 0
    found = path.solve(start, path.program.set_to)
    assert found.outcome.success
    theta = dict(zip(model.free, found.values["theta"], strict=True))
    assert theta["f"] == pytest.approx(FRICTION, rel=0.2)


def test_starting_states_stay_within_their_bounds() -> None:
    data = measured(0.3)
    path = path_of(friction_and_damping_free(0.3), data)
    first = path.x.start  # the position at which the first run begins
    scale = path.program.scale[first]
    path.program.upper[first] = 0.9 / scale
    start = path.program.start.copy()
    start[first] = 0.8 / scale
    found = path.solve(start, path.program.set_to, raise_on_failure=False)
    began = found.values["x"].reshape(2, len(T), 2)[0, 0, 0]
    assert began == pytest.approx(0.9, abs=1e-6)

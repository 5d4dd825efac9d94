"""Programs and IPOPT: against an independent convex formulation, closed forms and the
faster steps; what is refused, and how an end is told.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import cvxpy as cp
import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.initialization.scaling import MOST_RATIO, theta_scale
from phsi_opt.model.expressions import evaluate
from phsi_opt.optimization import ipopt
from phsi_opt.optimization.column_function import AT_ONCE, in_numbers
from phsi_opt.optimization.ipopt import Solver
from phsi_opt.optimization.program import Program
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.parameter_vector import Point
from problems.judges.fit_cases import PROBLEMS
from problems.thesis.systems import SYSTEMS
from tests.systems import pair, recorded

# ---- a convex loss, written out by hand

POWERS = [(1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)]


def features(x: np.ndarray) -> np.ndarray:
    """dx/dt of the canonical system per unit of each coefficient, (n, 2, 9)."""
    q, p = x.T
    columns = []
    for a, b in POWERS:
        dh_dq = a * q ** max(a - 1, 0) * p**b
        dh_dp = b * q**a * p ** max(b - 1, 0)
        columns.append(np.column_stack([dh_dp, -dh_dq]))
    return np.stack(columns, axis=2)


@pytest.mark.parametrize("scheme", ["euler", "midpoint"])
@pytest.mark.parametrize("lam", [0.0, 0.1, 1.0])
def test_ipopt_with_slacks_agrees_with_cvxpy_where_the_loss_is_convex(
    scheme: str, lam: float
) -> None:
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 6.0, 80)
    x = np.column_stack([np.cos(1.5 * t) + 0.4, -1.5 * np.sin(1.5 * t)])
    x = x + 0.02 * rng.normal(size=x.shape)
    model = pair(ph.polynomials(["q", "p"], 3))
    grid = grid_of(ph.Measurements.from_arrays([t], [x], states=["q", "p"]))
    point = Point(np.zeros(9), grid.y, np.ones(9), np.ones(2))
    program = ph.PHSILoss(scheme).program(model, grid, point, {"H": lam})
    solution = Solver(program, ph.SolverSettings(tolerance=1e-13)).solve()
    at = x[:-1] if scheme == "euler" else (x[:-1] + x[1:]) / 2
    rates = np.diff(x, axis=0) / np.diff(t)[:, None]
    matrix = features(at).reshape(-1, 9)
    xi = cp.Variable(9)
    squares = cp.sum_squares(matrix @ xi - rates.ravel()) / len(rates)
    tight = {"tol_gap_abs": 1e-13, "tol_gap_rel": 1e-13, "tol_feas": 1e-13}
    problem = cp.Problem(cp.Minimize(squares + lam * cp.norm1(xi)))
    problem.solve(solver=cp.CLARABEL, **tight)
    optimum = np.asarray(xi.value)
    # The barrier leaves coefficients off by about the tolerance over the curvature
    # (1e-13 over 1e-5 at the least).
    np.testing.assert_allclose(solution.values["theta"], optimum, atol=1e-7)
    assert lam < 0.1 or np.sum(np.abs(optimum) < 1e-6) >= 4  # the L1 term acts
    size = np.mean(np.sum(rates**2, axis=1))
    of_thesis = np.sum((matrix @ solution.values["theta"] - rates.ravel()) ** 2)
    # The same sum in another order: rounding only.
    ours = np.sum(solution.residual**2) / 2 * size
    assert ours == pytest.approx(of_thesis / len(rates), rel=1e-9)


# ---- small programs


def test_scaling_a_variable_changes_the_iteration_but_not_the_solution() -> None:
    for scale in (1.0, 1e3, 1e-3):
        program = Program()
        x = program.variable("x", np.array([5.0, 5.0]), scale=scale)
        program.add_residual(ca.vertcat(x[0] - 3, 2 * (x[1] + 1)))
        program.constrain("sum", x[0] + x[1] - 1)
        # By Lagrange ((a - 3)^2 + 4 (b + 1)^2) / 2 on a + b = 1 has its minimum at
        # a = 2.2, b = -1.2; the solver's tolerance is 1e-8.
        np.testing.assert_allclose(
            Solver(program).solve().values["x"], [2.2, -1.2], rtol=1e-7
        )


def test_bounds_are_kept_and_reported_by_name() -> None:
    program = Program()
    label = "stiffness".format
    theta = program.variable("theta", np.array([1.0]), lower=0.5, label=label)
    program.add_residual(theta)
    solution = Solver(program).solve()
    # the barrier's distance from a bound
    assert 0.5 <= solution.values["theta"][0] <= 0.5 + 1e-6
    assert solution.outcome.at_bounds == ("stiffness",)


def test_an_entry_is_named_by_its_block_and_a_start_that_is_not_finite_refused() -> (
    None
):
    program = Program()
    program.variable("x", np.zeros(2))
    y = program.variable("y", np.zeros(3), label=lambda i: f"node={i}")
    program.constrain("defect", y - 1)
    assert program.name_of(3, program.variables) == "y (node=1)"
    assert program.name_of(2, program.constraints) == "defect (2)"
    match = "1 of x starts at nan with the size 1 and the bounds -inf and inf; expected finite"
    with pytest.raises(ph.ModelError, match=match):
        Program().variable("x", np.array([0.0, np.nan]))
    with pytest.raises(
        ph.ModelError, match=r"0 of x .* size inf and the bounds -inf and inf"
    ):
        Program().variable("x", np.array([1.0]), scale=np.inf)


@pytest.mark.parametrize(("limit", "status", "advice"), [
    ({"max_seconds": 1e-9}, "Maximum_WallTime_Exceeded", "allow more time"),
    ({"max_iterations": 1}, "Maximum_Iterations_Exceeded", "more iterations"),
])  # fmt: skip
def test_a_limit_is_named_where_it_ends_a_solve(limit, status, advice) -> None:
    program = Program()  # Rosenbrock's valley, which takes more than one iteration
    x = program.variable("x", np.array([-1.2, 1.0]))
    program.add_residual(ca.vertcat(10 * (x[1] - x[0] ** 2), 1 - x[0]))
    settings = ph.SolverSettings(**limit)
    outcome = Solver(program, settings).solve().outcome
    assert not outcome.success
    assert outcome.status == status
    assert advice in outcome.advice
    assert Solver(program).solve().outcome.status == "Solve_Succeeded"


# ---- the program of the PHSI loss


@pytest.fixture
def solved(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Program, ipopt.Solution]]:
    """Every program that IPOPT is given, with its solution."""
    kept: list[tuple[Program, ipopt.Solution]] = []
    original = ipopt.Solver.solve

    def solve(self: ipopt.Solver, *args: Any, **kwargs: Any) -> ipopt.Solution:
        solution = original(self, *args, **kwargs)
        kept.append((self.program, solution))
        return solution

    monkeypatch.setattr(ipopt.Solver, "solve", solve)
    return kept


def test_every_program_is_symbolic_and_its_answer_is_the_fit(solved) -> None:
    system = replace(SYSTEMS["mass_spring"], n_trajectories=6)
    data = system.training_data("noisy")
    pruning = ph.Pruning(0.05, significance=0.01)
    fit = ph.identify(system.model(), data, ph.PHSILoss(), dict(system.l1), pruning)
    for program, solution in solved:
        assert solution.outcome.iterations > 0
        # CasADi expands MX to scalar instructions only where no callback is inside.
        whole = ca.Function("f", [program.z, program.settings], [program.objective])
        assert np.isfinite(float(whole.expand()(program.start, program.set_to)))
    (found,) = [solution for _, solution in solved if solution.outcome == fit.outcome]
    np.testing.assert_array_equal(found.values["theta"], list(fit.values.values()))
    said = f"IPOPT: Solve_Succeeded, {fit.outcome.iterations} iterations"
    assert said in " ".join(str(fit).split())


def test_without_l1_it_ends_where_directions_leave_no_trace_and_names_them() -> None:
    """Casimirs of S: any function of the tanks' whole volume adds to H unseen."""
    data = SYSTEMS["tanks"].data(5, 0.0, n=12)
    fit = ph.identify(SYSTEMS["tanks"].model(), data, ph.PHSILoss())
    assert fit.outcome.iterations < 50
    assert np.max(np.abs(list(fit.values.values()))) < 100
    notes = [note for note in fit.warnings if "cannot distinguish" in note]
    volume = "H[mu1], H[mu2], H[mu3], H[mu4]"
    starts = f"the data cannot distinguish {volume}: "
    assert any(note.startswith(starts) for note in notes)
    squared = [note for note in notes if "H[mu1*mu2]" in note and "H[mu4**2]" in note]
    assert len(squared) == 1 and len(notes) == 2
    assert np.isnan(fit.std_errors["H[mu1]"])
    assert fit.std_errors["R_phi3"] > 0


def test_the_size_of_a_parameter_at_its_bound_is_that_of_its_effect() -> None:
    t = np.linspace(0, 8, 81)
    data = ph.Measurements.from_arrays([t], [np.exp(-t)[:, None]], states=["v"])
    a, b = ph.Parameter(3.0, lower=0), ph.Parameter(0.5, lower=0)
    model = ph.FirstOrder(["v"], {"v": ph.formula("-a - b*v", a=a, b=b)})
    grid = grid_of(data)

    def size_of(a: float, *held: str) -> float:
        sizes = theta_scale(model, grid, np.array([a, 0.5]), grid.y, np.ones(1), held)
        return float(sizes[model.free.index("a")])

    assert size_of(1e-12, "a") == pytest.approx(size_of(3.0))
    assert size_of(1e-12) == pytest.approx(MOST_RATIO * 1e-12)


# ---- the program of a likelihood, and the faster steps

BOTH_WAYS = (
    "mass-spring, likelihood, free frequency",
    "Duffing, half of the values",
    "Duffing, irregular times",
    "double pendulum",
    "pendulum, half off",
    "driven oscillator, random force",
    "a mass for each trajectory",
    "only ratios can be told",
    "demonstration, friction",
    "demonstration, stiffness at a bound",
    "hysteresis",
    "sensor offset",
    "heated bodies",
)


@pytest.mark.parametrize("name", BOTH_WAYS)
def test_ipopt_and_the_faster_steps_agree_in_the_objective(name: str) -> None:
    """With the noise and the steps between samples given: else both are estimated, to
    half a percent and to a tenth of a standard error.
    """
    problem = PROBLEMS[name]()
    first = ph.identify(problem.model, problem.data, **problem.options)
    loss = problem.options.get("loss", ph.MaximumLikelihood())
    loss = replace(loss, noise=first.noise, steps=loss.steps or 2)
    by_steps, by_ipopt = (
        ph.identify(problem.model, problem.data, loss, start=first, settings=settings)
        for settings in (ph.SolverSettings(), ph.SolverSettings(solver="ipopt"))
    )
    assert by_ipopt.outcome.solver == "IPOPT"
    expected = by_steps.outcome.objective
    assert by_ipopt.outcome.objective == pytest.approx(expected, rel=1e-8)


# ---- functions of numbers at many places

FORMULAS = (
    "sin(a)*cos(b) - tan(a/4)",
    "atan(a) + exp(-b) + log(1 + b**2)",
    "sqrt(abs(a)) * tanh(b)",
    "sign(a) + min(a, b) - max(a, b)",
    "a**2 + 2*a + b**3 - b**0.5 + (a**2)**b",
    "(a**4 + 0.1)**(-0.25) / b",
)


def function_of(formulas: tuple[str, ...]) -> ca.Function:
    """Values of the formulas, and their slopes in a and b."""
    a, b = ca.SX.sym("a", 2), ca.SX.sym("b")
    values = []
    for text in formulas:
        for i in range(2):
            values.append(evaluate(text, {"a": a[i], "b": b}))
    column = ca.vertcat(*values)
    slopes = ca.jacobian(column, ca.vertcat(a, b))
    return ca.Function("values", [a, b], [column, slopes])


def by_casadi(function: ca.Function, a: np.ndarray, b: np.ndarray) -> list[np.ndarray]:
    """Entries of the results, a column per place."""
    columns: list[list[list[float]]] = [[] for _ in range(function.n_out())]
    for place in range(a.shape[1]):
        for found, one in zip(columns, function(a[:, place], b[:, place]), strict=True):
            found.append(one.nonzeros())
    return [np.array(found).T for found in columns]


@pytest.mark.parametrize("n", [1, 7, AT_ONCE, AT_ONCE + 7])
def test_it_finds_what_casadi_finds(n: int) -> None:
    rng = np.random.default_rng(0)
    function = function_of(FORMULAS)
    a, b = rng.uniform(-2, 2, (2, n)), rng.uniform(0.5, 2, (1, n))
    found = in_numbers(function, a, b)
    for own, expected in zip(found, by_casadi(function, a, b), strict=True):
        np.testing.assert_allclose(own, expected, rtol=1e-12, atol=1e-14)


def test_a_place_without_a_number_has_none_and_leaves_the_others() -> None:
    function = function_of(("log(a) + 1/b",))
    a = np.array([[1.0, -1.0, 2.0], [1.0, 1.0, 1.0]])
    values, _ = in_numbers(function, a, np.array([[1.0, 1.0, 0.0]]))
    assert np.isfinite(values[0]).tolist() == [True, False, False]
    assert values[1, 0] == 1.0


# ---- the program of a fit

NOISE = {"q": 0.001, "p": 0.002}


def spring_fit(
    loss: ph.PHSILoss | ph.MaximumLikelihood,
    prior: tuple[float, float] | None = None,
    **options: Any,
) -> ph.Fit:
    """A spring with unknown stiffness and damping, fitted to its own motion."""
    t = np.linspace(0.0, 4.0, 81)
    model = pair("k*q**2/2 + p**2/2", "c", k=ph.Parameter(prior=prior))
    truth = model.with_values({"k": 9.0, "c": 0.3})
    data = recorded(truth, t, [1.0, 0.5], noise=0.001)
    return ph.identify(model, data, loss, **options)


def theta_of(program: Program) -> np.ndarray:
    """Its parameters, by IPOPT as a user calls it."""
    options: Any = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}
    solver = ca.nlpsol("solver", "ipopt", program.nlp, options)
    z = np.array(solver(**program.arguments)["x"]).ravel()
    return program.values(z)["theta"]


@pytest.mark.parametrize(("loss", "options"), [
    (ph.PHSILoss(), {}),
    (ph.PHSILoss(), {"l1": {"R": 0.1}}),
    (ph.PHSILoss(), {"prior": (9.1, 0.01)}),
    (ph.MaximumLikelihood(NOISE), {}),
    (ph.MaximumLikelihood(NOISE), {"settings": ph.SolverSettings(solver="ipopt")}),
    (ph.MaximumLikelihood(NOISE, huber=1.345), {}),
])  # fmt: skip
def test_the_program_of_a_fit_has_its_optimum(loss: Any, options: Any) -> None:
    fit = spring_fit(loss, **options)
    # Both solvers end within 1e-8 of the scaled optimality conditions.
    expected = list(fit.estimates.values())
    assert theta_of(fit.program) == pytest.approx(expected, rel=1e-6)


def test_the_program_of_a_fit_can_be_changed_and_the_fit_stays() -> None:
    fit = spring_fit(ph.PHSILoss())
    program = fit.program
    k = program.column("theta")[fit.names.index("k")]
    program.constrain("k", (8.0 - k) / 8.0, np.inf)  # k <= 8
    assert theta_of(program)[fit.names.index("k")] == pytest.approx(8.0, rel=1e-6)
    assert "k" not in fit.program.constraints
    with pytest.raises(ph.ModelError, match=r"'thet' is not .* Did you mean 'theta'"):
        program.column("thet")


def test_a_fit_without_a_single_program_says_so(tmp_path: Path) -> None:
    fit = spring_fit(ph.MaximumLikelihood(model_error=True))
    with pytest.raises(ph.DataError, match=r"has no program: .* model_error=True"):
        _ = fit.program
    saved = tmp_path / "fit.json"
    spring_fit(ph.PHSILoss()).save(saved)
    with pytest.raises(ph.DataError, match="loaded from a file"):
        _ = ph.Fit.load(saved).program

"""The program and its solver, against an independent convex formulation and the
refusals of `Program`.
"""

import re
from typing import Any

import casadi as ca
import cvxpy as cp
import numpy as np
import pytest

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import ModelError, SolveError
from phsi_opt.model.model import PseudoHamiltonian
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.structure import canonical
from phsi_opt.model.terms import Dictionary, Term, polynomials
from phsi_opt.optimization.ipopt import SolverSettings, _is_settled, solve
from phsi_opt.optimization.program import Program
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.losses import PHSILoss
from phsi_opt.transcription.parameter_vector import Point

POWERS = [
    (1, 0),
    (0, 1),
    (2, 0),
    (1, 1),
    (0, 2),
    (3, 0),
    (2, 1),
    (1, 2),
    (0, 3),
]  # of q and p, total degree 1 to 3


def noisy_oscillator(n: int = 80) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 6.0, n)
    q = np.cos(1.5 * t) + 0.4
    return t, np.column_stack([q, -1.5 * np.sin(1.5 * t)]) + 0.02 * rng.normal(
        size=(n, 2)
    )


def features(x: np.ndarray) -> np.ndarray:
    """dx/dt of the canonical system per unit of each coefficient, written out by hand:
    (n, 2, 10).
    """
    q, p = x.T
    columns = []
    for a, b in POWERS:
        dh_dq = a * q ** max(a - 1, 0) * p**b
        dh_dp = b * q**a * p ** max(b - 1, 0)
        columns.append(np.column_stack([dh_dp, -dh_dq]))
    columns.append(np.column_stack([np.zeros_like(q), np.ones_like(q)]))
    return np.stack(columns, axis=2)


def convex_optimum(
    t: np.ndarray, x: np.ndarray, at: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    rates = np.diff(x, axis=0) / np.diff(t)[:, None]
    matrix, m = features(at).reshape(-1, 10), len(rates)
    xi = cp.Variable(10)
    loss = cp.sum_squares(matrix @ xi - rates.ravel()) / m + weights @ cp.abs(xi)
    cp.Problem(cp.Minimize(loss)).solve(
        solver=cp.CLARABEL, tol_gap_abs=1e-13, tol_gap_rel=1e-13, tol_feas=1e-13
    )
    return np.asarray(xi.value)


def loss_of(t: np.ndarray, x: np.ndarray, at: np.ndarray, xi: np.ndarray) -> float:
    rates = np.diff(x, axis=0) / np.diff(t)[:, None]
    return float(np.sum((features(at) @ xi - rates) ** 2) / len(rates))


@pytest.mark.parametrize("scheme", ["euler", "midpoint"])
@pytest.mark.parametrize("lam", [0.0, 0.01, 0.1, 1.0])
def test_ipopt_with_slacks_agrees_with_cvxpy_where_the_loss_is_convex(
    scheme: str, lam: float
) -> None:
    t, x = noisy_oscillator()
    force = {"p": Dictionary((Term("1", Parameter()),))}
    model = PseudoHamiltonian(
        states=("q", "p"), S=canonical(1), H=polynomials(["q", "p"], 3), F=force
    )
    grid = grid_of(Measurements.from_arrays([t], [x], states=["q", "p"]))
    point = Point(np.zeros(10), grid.y, np.ones(10), np.ones(2))
    program = PHSILoss(scheme).program(model, grid, point, {"H": lam, "F": 2 * lam})
    solution = solve(program, SolverSettings(tolerance=1e-13))
    at = x[:-1] if scheme == "euler" else (x[:-1] + x[1:]) / 2
    expected = convex_optimum(t, x, at, np.array(9 * [lam] + [2 * lam]))
    assert solution.outcome.iterations > 0
    # The barrier leaves coefficients off by about the tolerance over the curvature
    # (1e-13 over 1e-5 at the least).
    np.testing.assert_allclose(solution.values["theta"], expected, atol=1e-7)
    assert (
        lam < 0.1 or np.sum(np.abs(expected) < 1e-6) >= 4
    )  # the L1 term acts: there is a support to agree on


def test_the_residual_of_the_solution_is_the_thesis_loss() -> None:
    t, x = noisy_oscillator()
    model = PseudoHamiltonian(
        states=("q", "p"), S=canonical(1), H=polynomials(["q", "p"], 3)
    )
    grid = grid_of(Measurements.from_arrays([t], [x], states=["q", "p"]))
    solution = solve(
        PHSILoss("midpoint").program(
            model, grid, Point(np.zeros(9), grid.y, np.ones(9), np.ones(2)), {}
        )
    )
    xi = np.append(solution.values["theta"], 0.0)
    size = np.mean(np.sum((np.diff(x, axis=0) / np.diff(t)[:, None]) ** 2, axis=1))
    # The same sum in another order: rounding only.
    assert np.sum(solution.residual**2) / 2 * size == pytest.approx(
        loss_of(t, x, (x[:-1] + x[1:]) / 2, xi), rel=1e-12
    )


def test_scaling_a_variable_changes_the_iteration_but_not_the_solution() -> None:
    found = []
    for scale in (1.0, 1e3, 1e-3):
        program = Program()
        x = program.variable("x", np.array([5.0, 5.0]), scale=scale)
        program.add_residual(ca.vertcat(x[0] - 3, 2 * (x[1] + 1)))
        program.constrain("sum", x[0] + x[1] - 1)
        found.append(solve(program).values["x"])
    # Lagrange by hand: minimise ((a - 3)^2 + 4 (b + 1)^2) / 2 on a + b = 1 gives a =
    # 2.2, b = -1.2.
    np.testing.assert_allclose(
        found, [[2.2, -1.2]] * 3, rtol=1e-7
    )  # the solver's tolerance is 1e-8


def test_bounds_are_kept_and_reported_by_name() -> None:
    program = Program()
    theta = program.variable(
        "theta", np.array([1.0]), lower=0.5, label=lambda i: "stiffness"
    )
    program.add_residual(theta)
    solution = solve(program)
    assert (
        0.5 <= solution.values["theta"][0] <= 0.5 + 1e-6
    )  # the barrier's distance from a bound
    assert solution.outcome.at_bounds == ("stiffness",)


def test_an_entry_is_named_by_its_block_and_label() -> None:
    program = Program()
    x = program.variable("x", np.zeros(2))
    y = program.variable("y", np.zeros(3), label=lambda i: f"node={i}")
    program.constrain("defect", y - 1)
    assert x.numel() == 2
    assert program.name_of(3, program.variables) == "y (node=1)"
    assert program.name_of(2, program.constraints) == "defect (2)"


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_start_that_is_not_finite_is_refused(bad: float) -> None:
    with pytest.raises(
        ModelError, match="the start of x has 1 values that are not finite"
    ):
        Program().variable("x", np.array([0.0, bad]))


def test_the_gauss_newton_hessian_is_the_product_of_the_residual_jacobian() -> None:
    program = Program()
    x = program.variable("x", np.array([0.3, -0.2]), scale=np.array([2.0, 0.5]))
    program.add_residual(ca.vertcat(ca.sin(x[0]) * x[1], x[1] ** 2, x[0]))
    z = np.array([0.4, 0.7])

    def residual(at: np.ndarray) -> Any:
        a, b = at * program.scale
        return np.array([np.sin(a) * b, b**2, a])

    step = 1e-6
    jacobian = np.column_stack(
        [
            (residual(z + step * e) - residual(z - step * e)) / (2 * step)
            for e in np.eye(2)
        ]
    )
    hessian = np.array(program.hessian()(z, [], 1.0, np.zeros(0)))
    # Central differences: an error of step^2 = 1e-12 and rounding of 1e-16 / step =
    # 1e-10.
    np.testing.assert_allclose(hessian, np.triu(jacobian.T @ jacobian), atol=1e-8)


@pytest.mark.parametrize("weight", [0.0, 0.3])
def test_slopes_that_are_given_lead_where_casadis_own_lead(weight: float) -> None:
    rng = np.random.default_rng(3)
    A = rng.normal(size=(40, 3))
    b = A @ np.array([1.0, 0.0, -2.0]) + 0.1 * rng.normal(size=40)

    def made(has_slopes: bool) -> Program:
        program = Program()
        scale = np.array([2.0, 0.5, 10.0])
        x = program.variable("x", np.zeros(3), -1.5, 5.0, scale)
        curved = 0.7 * (ca.DM(A) @ x + 0.1 * x[0] ** 2 - ca.DM(b))
        first = ca.DM(A[:, :1]) + 0.2 * x[0]
        slopes = 0.7 * ca.horzcat(first, ca.DM(A[:, 1:]))
        program.add_residual(curved, slopes if has_slopes else None)
        if weight:
            program.add_l1("x", x, np.full(3, weight), np.zeros(3), scale)
        return program

    given = solve(made(has_slopes=True))
    own = solve(made(has_slopes=False))
    # The same numbers in another order: rounding only.
    np.testing.assert_allclose(given.values["x"], own.values["x"], atol=1e-10)
    assert given.outcome.iterations == own.outcome.iterations
    assert given.values["x"][2] == pytest.approx(-1.5)


def slow_to_solve() -> Program:
    """Rosenbrock's valley, which takes more than one iteration."""
    program = Program()
    x = program.variable("x", np.array([-1.2, 1.0]))
    program.add_residual(ca.vertcat(10 * (x[1] - x[0] ** 2), 1 - x[0]))
    return program


def test_a_limit_of_time_is_the_users_own_and_is_named_where_it_ends_a_solve() -> None:
    assert SolverSettings().max_seconds == np.inf
    with pytest.raises(
        SolveError,
        match=r"the time limit of 1e-09 s ended the solve .*Maximum_WallTime"
        r".*allow more time",
    ):
        solve(slow_to_solve(), SolverSettings(max_seconds=1e-9))
    outcome = solve(
        slow_to_solve(), SolverSettings(max_seconds=1e-9), raise_on_failure=False
    ).outcome
    assert outcome.status == "Maximum_WallTime_Exceeded"


def test_a_limit_of_iterations_is_not_one_of_time() -> None:
    outcome = solve(
        slow_to_solve(), SolverSettings(max_iterations=1), raise_on_failure=False
    ).outcome
    assert outcome.status == "Maximum_Iterations_Exceeded"
    assert solve(slow_to_solve()).outcome.status == "Solve_Succeeded"


def test_a_solve_that_goes_to_and_fro_over_a_kink_has_settled() -> None:
    def ended(objectives: list[float], violation: float = 1e-8) -> bool:
        stats = {
            "iterations": {"obj": objectives, "inf_pr": [violation] * len(objectives)}
        }
        return _is_settled(stats, n_residuals=1000)

    over_and_back = [3.0, 1.2] + 5 * [0.96299157, 0.96299151]
    assert ended(over_and_back)
    assert not ended(over_and_back, violation=1e-3)  # the constraints do not hold
    assert not ended([1.0 - 1e-3 * k for k in range(12)])  # still falling
    assert not ended(over_and_back[:6])  # too few to tell
    assert not ended([*over_and_back, float("nan")])


@pytest.mark.parametrize(
    ("name", "value"),
    [("max_seconds", -1), ("tolerance", "a"), ("max_iterations", 0), ("solver", "x")],
)
def test_a_setting_that_no_solver_takes_is_refused_by_name(
    name: str, value: object
) -> None:
    settings: dict[str, Any] = {name: value}
    with pytest.raises(ModelError, match=f"{name}={re.escape(repr(value))}"):
        SolverSettings(**settings)

"""Where the optimum lies, found fast: least squares with few unknowns, and an L1 term.

Sequential quadratic programming: each step minimises the quadratic model of the
residuals together with the linear cost, within bounds and (linear) constraints. Its
Hessian is that of Gauss and Newton plus a secant estimate of what this one leaves out,
which large residuals make felt (Dennis, Gay and Welsch 1981), damped where a step does
not lower the objective (Levenberg 1944, Marquardt 1963). The solver starts from the
point and the multipliers that come out, and confirms them or goes on.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from phsi_opt.optimization.gauss_newton import DenseLeastSquares, Slopes
from phsi_opt.optimization.program import Program
from phsi_opt.optimization.settings import SolverSettings

MOST_QUADRATIC_STEPS = 50
# Constraints, two for each term with L1, beyond which the active set costs more than
# IPOPT: with 108 (54 terms of the tanks) a step took 0.23 s, and four hybrid fits 42 s
# where IPOPT alone takes 12.
MOST_CONSTRAINTS = 60
OWN_TOLERANCE = 0.1  # share of the solver's, so that it has nothing left to do
# Share of the least eigenvalue of Gauss and Newton's Hessian that the secant estimate
# must leave; below it steps would follow directions of no or negative curvature.
LEAST_KEPT_CURVATURE = 0.1
FIRST_SHARE_DAMPED = 1e-3  # share of the Hessian's diagonal, after a step that failed
DAMPING_FACTOR = 10.0
MOST_SHARE_DAMPED = 1e6
# Share of the largest entry of the diagonal that damping takes for smaller ones.
LEAST_DIAGONAL = 1e-8
EQUAL_OBJECTIVES = 1e-13  # relative change of the objective that says nothing

QUIET = {
    "error_on_fail": False,
    "print_time": False,
    "print_iter": False,
    "print_header": False,
    "print_info": False,
}


@dataclass(frozen=True, eq=False)
class NearbyOptimum:
    """A point at which the solver has little left to do.

    Attributes:
        z: scaled variables, (n_variables,).
        of_bounds: multipliers of the variables' bounds, (n_variables,).
        of_constraints: multipliers of the constraints, (n_constraints,).
        steps: how many led there.
    """

    z: np.ndarray
    of_bounds: np.ndarray
    of_constraints: np.ndarray
    steps: int


def nearby_optimum(program: Program, settings: SolverSettings) -> NearbyOptimum | None:
    """The optimum of a program with dense least squares and linear constraints.

    Args:
        program: with ``dense``.
        settings: whose tolerance and limit of iterations hold here too.

    Returns:
        None where steps do not lead to one, or there are many constraints: the solver
        begins from the program's start.
    """
    dense = program.dense
    if dense is None or program.g.numel() > MOST_CONSTRAINTS:
        return None
    search = _Search(program, dense, OWN_TOLERANCE * settings.tolerance)
    for steps in range(1, min(MOST_QUADRATIC_STEPS, settings.max_iterations) + 1):
        search.advance()
        if search.has_converged:
            return NearbyOptimum(
                search.z, search.of_bounds, search.of_constraints, steps
            )
        if search.is_stuck:
            return None
    return None


@dataclass(frozen=True, eq=False)
class _Step:
    """What minimises a quadratic model, with its multipliers."""

    d: np.ndarray
    of_bounds: np.ndarray
    of_constraints: np.ndarray
    is_solved: bool


class _QuadraticModel:
    """1/2 d'Hd + g'd within the bounds and linear constraints of a program at z + d.

    Solved by the active-set method that comes with CasADi (qrqp), which gives exact
    zeros and multipliers.
    """

    def __init__(self, program: Program) -> None:
        self.program = program
        n = len(program.start)
        constant, jacobian = program.jacobian(program.start, program.set_to)
        self.A = np.array(jacobian).reshape(program.g.numel(), n)
        self.offset = np.array(constant).ravel() - self.A @ program.start
        sparsities = {
            "h": ca.Sparsity.dense(n, n),
            "a": ca.Sparsity.dense(*self.A.shape),
        }
        self._solver = ca.conic("quadratic_model", "qrqp", sparsities, QUIET)

    def step(
        self,
        hessian: np.ndarray,
        gradient: np.ndarray,
        z: np.ndarray,
        of_bounds: np.ndarray,
        of_constraints: np.ndarray,
    ) -> _Step:
        """The best d from z (n_variables,).

        The multipliers of the step before say which bounds and constraints are active:
        without them a dictionary of 54 terms with L1 took 60 to 100 changes of the
        active set a step, 1000 where it went in circles; with them 1 to 30.
        """
        program = self.program
        g = self.offset + self.A @ z
        found = self._solver(
            h=hessian,
            g=gradient,
            a=self.A,
            lbx=program.lower - z,
            ubx=program.upper - z,
            lba=program.g_lower - g,
            uba=program.g_upper - g,
            lam_x0=of_bounds,
            lam_a0=of_constraints,
        )
        d = np.array(found["x"]).ravel()
        is_solved = bool(self._solver.stats()["success"] and np.all(np.isfinite(d)))
        of_bounds = np.array(found["lam_x"]).ravel()
        of_constraints = np.array(found["lam_a"]).ravel()
        return _Step(d, of_bounds, of_constraints, is_solved)


class _Search:
    """The steps, one after the other."""

    def __init__(
        self, program: Program, dense: DenseLeastSquares, tolerance: float
    ) -> None:
        self.dense = dense
        self.tolerance = tolerance
        self.n_filled = len(dense.scale)
        self.model = _QuadraticModel(program)
        self.z = np.clip(program.start, program.lower, program.upper)
        self.objective = dense.value(self.z)
        self.left_out = np.zeros((self.n_filled, self.n_filled))
        self.damping = 0.0
        self.of_bounds = np.zeros(len(self.z))
        self.of_constraints = np.zeros(program.g.numel())
        self.has_converged = False

    @property
    def is_stuck(self) -> bool:
        """Whether no step, however short, lowers the objective."""
        return self.damping > MOST_SHARE_DAMPED or not np.isfinite(self.objective)

    def advance(self) -> None:
        """One step, or more damping where it does not lower the objective."""
        here = self.dense.at(self.z)
        step = self.model.step(
            self._hessian(here),
            self._gradient(here),
            self.z,
            self.of_bounds,
            self.of_constraints,
        )
        z = self.z + step.d
        objective = self.dense.value(z) if step.is_solved else np.inf
        limit = self.objective + EQUAL_OBJECTIVES * abs(self.objective)
        if not objective <= limit:
            self.damping = max(DAMPING_FACTOR * self.damping, FIRST_SHARE_DAMPED)
            return
        self.damping /= DAMPING_FACTOR
        if self.damping < FIRST_SHARE_DAMPED / DAMPING_FACTOR:
            self.damping = 0.0
        self.z = z
        self.objective = objective
        self.of_bounds = step.of_bounds
        self.of_constraints = step.of_constraints
        there = self.dense.at(z)
        self._learn(step.d[: self.n_filled], here, there)
        self.has_converged = self._slope_left(there) <= self.tolerance

    def _gradient(self, slopes: Slopes) -> np.ndarray:
        gradient = self.dense.cost.copy()
        gradient[: self.n_filled] += slopes.gradient
        return gradient

    def _hessian(self, slopes: Slopes) -> np.ndarray:
        """Of all variables; Gauss and Newton's alone where the rest bends down."""
        gauss_newton = slopes.hessian
        filled = gauss_newton + self.left_out
        least = np.linalg.eigvalsh(gauss_newton)[0]
        if np.linalg.eigvalsh(filled)[0] <= LEAST_KEPT_CURVATURE * least:
            filled = gauss_newton
        diagonal = np.diag(gauss_newton)
        size = np.maximum(diagonal, LEAST_DIAGONAL * np.max(diagonal))
        hessian = np.zeros((len(self.z), len(self.z)))
        hessian[: self.n_filled, : self.n_filled] = filled
        places = np.arange(self.n_filled)
        hessian[places, places] += self.damping * size
        return hessian

    def _learn(self, d: np.ndarray, before: Slopes, after: Slopes) -> None:
        """The secant update of what Gauss and Newton leave out.

        So that it maps the step d to the change of J'r at fixed residuals.
        """
        change = after.gradient - before.gradient
        curvature = float(d @ change)
        if not curvature > 0:
            return
        wanted = after.gradient - before.scale * (before.columns.T @ after.residual)
        known = float(d @ self.left_out @ d)
        if known != 0:
            self.left_out *= min(1.0, abs(float(d @ wanted)) / abs(known))
        missing = wanted - self.left_out @ d
        outer = np.outer(missing, change) / curvature
        share = float(missing @ d) / curvature**2
        self.left_out = (
            self.left_out + outer + outer.T - share * np.outer(change, change)
        )

    def _slope_left(self, slopes: Slopes) -> float:
        """Largest entry of the Lagrangian's gradient."""
        of_constraints = self.model.A.T @ self.of_constraints
        slope = self._gradient(slopes) + self.of_bounds + of_constraints
        return float(np.max(np.abs(slope)))

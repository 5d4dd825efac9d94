"""The one file that names IPOPT: it solves a `Program` and says in words what came out.

It turns symbols into NumPy arrays; nothing symbolic leaves it but the program's own
functions.
"""

import time
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.errors import SolveError
from phsi_opt.optimization.program import Program

# IPOPT's return status: (is the point usable, what it means, what to do)
MEANINGS = {
    "Solve_Succeeded": (True, "a local optimum was found", ""),
    "Solved_To_Acceptable_Level": (
        True,
        "a local optimum was found to the looser, acceptable tolerance",
        "Check the standard errors, or scale the data.",
    ),
    "Infeasible_Problem_Detected": (
        False,
        "no states satisfy the model exactly",
        "Check signs and bounds of the model, or start from other values.",
    ),
    "Search_Direction_Becomes_Too_Small": (
        False,
        "the iteration stalled before an optimum",
        "A term may not be smooth enough; widen its transition or use more steps per sample.",
    ),
    "Diverging_Iterates": (
        False,
        "the iterates grew without limit",
        "Bound the parameters; the model may be unstable.",
    ),
    "Maximum_Iterations_Exceeded": (
        False,
        "the iteration limit was reached before an optimum",
        "Raise max_iterations, or give starting values nearer to the solution.",
    ),
    "Maximum_CpuTime_Exceeded": (
        False,
        "the time limit was reached",
        "Raise max_seconds or use fewer samples.",
    ),
    "Maximum_WallTime_Exceeded": (
        False,
        "the time limit was reached",
        "Raise max_seconds or use fewer samples.",
    ),
    "Restoration_Failed": (
        False,
        "no feasible states could be found",
        "Start from other values, or use more steps per sample.",
    ),
    "Invalid_Number_Detected": (
        False,
        "the model gave NaN or infinity",
        "Look for a division by zero, a logarithm or root of a negative number, or a missing bound.",
    ),
    "Not_Enough_Degrees_Of_Freedom": (
        False,
        "there are more equations than unknowns",
        "Free a parameter.",
    ),
    "User_Requested_Stop": (
        False,
        "the solve was interrupted",
        "Run it again to finish.",
    ),
}
# Ways to solve a likelihood: by IPOPT with either Hessian, or along solutions of the
# model (`feasible_path`), which is also the status of what was solved so.
GAUSS_NEWTON, EXACT, FEASIBLE_PATH = "gauss-newton", "exact", "Feasible_Path"
WAYS = (GAUSS_NEWTON, EXACT, FEASIBLE_PATH)
# Beside a kink (a dead zone, a gap) the iterates end by going to and fro over it: over
# the last `SETTLING` of them the logarithm of the objective, times the number of
# residuals (a change of -2 log likelihood), stays within this, and the constraints
# hold. Without curvature that would also be slow progress.
SETTLING, SETTLED, HOLDING = 8, 0.05, 1e-5


@dataclass(frozen=True)
class Settings:
    """How hard to try: tolerance on the scaled optimality conditions, and limits.

    ``thorough`` False: no windows where the whole record fails, and no finer steps than
    those of the start. ``ways``: those of `WAYS` that are tried for a likelihood, one
    where another failed.
    """

    tolerance: float = 1e-8
    max_iterations: int = 500
    max_seconds: float = 600.0
    show: bool = False
    thorough: bool = True
    ways: tuple[str, ...] = WAYS


@dataclass(frozen=True)
class Outcome:
    """What the solver said, in words and numbers."""

    success: bool
    status: str
    sentence: str
    advice: str
    iterations: int
    seconds: float
    objective: float
    infeasibility: float
    at_bounds: tuple[str, ...] = ()

    @property
    def way(self) -> str:
        """How a solution like it is to be sought first: one of `WAYS`."""
        return (
            FEASIBLE_PATH
            if self.success and self.status == FEASIBLE_PATH
            else GAUSS_NEWTON
        )

    def __str__(self) -> str:
        text = f"{self.sentence} ({self.status}, {self.iterations} iterations, {self.seconds:.2f} s)"
        if self.at_bounds:
            text += f"; at a bound: {', '.join(self.at_bounds)}"
        return text + (f". {self.advice}" if self.advice else "")


@dataclass(frozen=True)
class Solution:
    """The optimal point: unscaled values per block, scaled vector, outcome."""

    values: dict[str, np.ndarray]
    z: np.ndarray
    residual: np.ndarray
    outcome: Outcome
    kkt: "KKT" = field(repr=False)


@dataclass(frozen=True)
class KKT:
    """Second-order information at a point, in scaled variables: Gauss-Newton Hessian
    and constraint Jacobian.
    """

    hessian: Any  # scipy.sparse CSC
    jacobian: Any


def solve(
    program: Program, settings: Settings | None = None, raise_on_failure: bool = True
) -> Solution:
    """Solve with IPOPT; raises `SolveError` if it ends without an optimum and
    ``raise_on_failure``.
    """
    return Solver(program, settings).solve(raise_on_failure=raise_on_failure)


class Solver:
    """IPOPT made ready for one program, which may be solved again from another start or
    with other settings.

    ``exact``: with the curvature of the constraints in the Hessian, where the program
    knows it.
    """

    def __init__(
        self, program: Program, settings: Settings | None = None, exact: bool = False
    ) -> None:
        self.program = program
        self.is_exact = exact and program.exact is not None
        hessian = (
            program.exact() if exact and program.exact is not None else program.hessian
        )
        problem = {
            "x": program.z,
            "p": program.settings,
            "f": program.objective,
            "g": program.g,
        }
        self._ipopt = ca.nlpsol(
            "program",
            "ipopt",
            problem,
            _options(program, hessian, settings or Settings()),
        )
        self._residual = ca.Function(
            "residual", [program.z, program.settings], [program.residual]
        )

    def solve(
        self,
        start: np.ndarray | None = None,
        set_to: np.ndarray | None = None,
        raise_on_failure: bool = True,
    ) -> Solution:
        """Solve from ``start`` (scaled) with the settings ``set_to``; by default those
        of the program.
        """
        program = self.program
        set_to = program.set_to if set_to is None else set_to
        began = time.perf_counter()
        result = self._ipopt(
            x0=program.start if start is None else start,
            p=set_to,
            lbx=program.lower,
            ubx=program.upper,
            lbg=program.g_lower,
            ubg=program.g_upper,
        )
        seconds = time.perf_counter() - began
        z = np.array(result["x"]).ravel()
        outcome = _outcome(
            program, self._ipopt.stats(), z, result, seconds, self.is_exact
        )
        if outcome.status == "User_Requested_Stop":
            raise KeyboardInterrupt
        if raise_on_failure and not outcome.success:
            raise SolveError(f"The solver failed: {outcome}")
        return self.solution(z, set_to, outcome)

    def solution(self, z: np.ndarray, set_to: np.ndarray, outcome: Outcome) -> Solution:
        """What is known at z (scaled) with the settings ``set_to``, together with how
        it was found.
        """
        residual = np.array(self._residual(z, set_to)).ravel()
        return Solution(
            self.program.values(z), z, residual, outcome, self.kkt(z, set_to)
        )

    def at(self, solution: Solution, set_to: np.ndarray) -> Solution:
        """The same point seen with other settings, which leave it optimal."""
        return self.solution(solution.z, set_to, solution.outcome)

    def kkt(self, z: np.ndarray, set_to: np.ndarray) -> KKT:
        """Gauss-Newton Hessian and constraint Jacobian at z."""
        program = self.program
        upper = program.hessian(z, set_to, 1.0, np.zeros(program.g.numel())).sparse()
        full = upper + upper.T
        full.setdiag(upper.diagonal())
        if not program.g.numel():
            return KKT(full.tocsc(), np.zeros((0, len(z))))
        jacobian = program.jacobian(z, set_to)[1]
        return KKT(full.tocsc(), jacobian.sparse().tocsc())


def _options(
    program: Program, hessian: ca.Function, settings: Settings
) -> dict[str, Any]:
    return {
        "hess_lag": hessian,
        "jac_g": program.jacobian,
        "print_time": False,
        "error_on_fail": False,
        "show_eval_warnings": False,
        "record_time": True,
        "ipopt": {
            "print_level": 5 if settings.show else 0,
            "sb": "yes",
            "tol": settings.tolerance,
            "acceptable_tol": 100 * settings.tolerance,
            "max_iter": settings.max_iterations,
            "max_wall_time": settings.max_seconds,
            # The program is scaled already; a second scaling would change what the
            # tolerance means.
            "nlp_scaling_method": "none",
            # Bounds are physics: they are not relaxed, and a start on a bound is moved
            # only a little inside.
            "bound_relax_factor": 0.0,
            "bound_push": 1e-4,
            "bound_frac": 1e-4,
            "mu_strategy": "adaptive",
            # Approximate minimum degree that sees dense rows (each parameter's): time
            # in proportion to the samples.
            "mumps_pivot_order": 6,
            # Pivoting for size alone fills the factors of a badly scaled record until
            # they do not fit (EMPS, 1 kHz).
            "mumps_pivtol": 1e-9,
            # Its permutation to a large diagonal, which it chooses by itself, fills
            # them too: 12 s for 0.5 s (EMPS).
            "mumps_permuting_scaling": 0,
            # Beyond this a step is given up for a restoration: larger ones diverge,
            # while the factors fill the memory.
            "max_hessian_perturbation": 1e4,
        },
    }


def _outcome(
    program: Program,
    stats: dict[str, Any],
    z: np.ndarray,
    result: dict[str, Any],
    seconds: float,
    is_exact: bool,
) -> Outcome:
    status = str(stats["return_status"])
    usable, sentence, advice = MEANINGS.get(
        status, (False, f"the solver stopped: {status}", "Try other starting values.")
    )
    g = np.array(result["g"]).ravel()
    outside = np.maximum(program.g_lower - g, g - program.g_upper)
    worst = int(np.argmax(outside)) if outside.size else 0
    infeasibility = max(float(outside[worst]), 0.0) if outside.size else 0.0
    if not usable and is_exact and _is_settled(stats, program.residual.numel()):
        usable, sentence, advice = (
            True,
            "the iterates settled at a kink of the model, where no slope vanishes",
            "",
        )
    if not usable and infeasibility > 1e-6:
        sentence += f"; the largest violation is {infeasibility:.1e} in {program.name_of(worst, program.constraints)}"
    return Outcome(
        usable,
        status,
        sentence,
        advice,
        int(stats["iter_count"]),
        seconds,
        float(result["f"]),
        infeasibility,
        at_bounds(program, z),
    )


def _is_settled(stats: dict[str, Any], n_residuals: int) -> bool:
    last = {
        name: np.array(stats.get("iterations", {}).get(name, []))[-SETTLING:]
        for name in ("obj", "inf_pr")
    }
    objective, violation = last["obj"], last["inf_pr"]
    if len(objective) < SETTLING or not np.all(np.isfinite(objective)):
        return False
    return bool(
        n_residuals * np.ptp(objective) <= SETTLED * np.max(np.abs(objective))
        and np.max(violation) < HOLDING
    )


def at_bounds(program: Program, z: np.ndarray) -> tuple[str, ...]:
    """Names of the parameters that z (scaled) has at one of their bounds."""
    if "theta" not in program.variables:
        return ()
    block = program.variables["theta"]
    close = np.minimum(z - program.lower, program.upper - z)[block.slice] < 1e-6
    return tuple(block.label(int(i)) for i in np.flatnonzero(close))

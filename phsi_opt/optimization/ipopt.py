"""The one file that names IPOPT: it solves a `Program` and says in words what came out.

Nothing symbolic leaves it but the program's own functions. Where to start, what to try
after a failure and whether the noise has to be estimated anew is decided by its
callers. A failure is data: its sentence says what happened and its advice what to try.

IPOPT is the interior-point method of Wächter and Biegler (2006), here with MUMPS for
its linear systems.
"""

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.arguments import require, require_choice, require_count, typed
from phsi_opt.interrupts import is_noted, solving
from phsi_opt.optimization.program import Program
from phsi_opt.presentation.numbers import number_of
from phsi_opt.statistics import TINY

# Who solves a likelihood: full Gauss-Newton steps where they lead to an optimum and
# IPOPT where not, or IPOPT alone.
SOLVERS = ("auto", "ipopt")


@typed
@dataclass(frozen=True)
class SolverSettings:
    """Settings of the solver: tolerance and limits.

    Args:
        tolerance: of the scaled optimality conditions, as IPOPT's ``tol``.
        max_iterations: of one solve by IPOPT.
        max_seconds: wall time of one solve, in s. Infinite by default: with a finite
            limit the result may depend on the load of the machine.
        show: whether IPOPT prints its iterations.
        thorough: False: do not try windows of the record if the whole record fails, and
            do not refine the integration steps.
        solver: "auto" uses fast Gauss-Newton steps for a likelihood if they reach an
            optimum; "ipopt" solves the same nonlinear program by IPOPT only, as a
            reference. The PHSI loss is always solved by IPOPT.

    Raises:
        ModelError: a limit that is not a positive number, or an unknown solver.
    """

    tolerance: float = 1e-8
    max_iterations: int = 500
    max_seconds: float = np.inf
    show: bool = False
    thorough: bool = True
    solver: str = "auto"

    def __post_init__(self) -> None:
        for name in ("tolerance", "max_seconds"):
            value = getattr(self, name)
            require(value > 0, f"SolverSettings: {name}", value, "a number above 0")
        require_count("SolverSettings: max_iterations", self.max_iterations)
        require_choice("SolverSettings: solver", self.solver, SOLVERS)


DIRECT_STEPS = "Direct_Steps"  # status of full Gauss-Newton steps
TIME_LIMITS = ("Maximum_CpuTime_Exceeded", "Maximum_WallTime_Exceeded")
OTHERWISE = "Start from other values, or use more steps per sample."
FOUND = "a local optimum was found"
STALLED = "the steps became too small before an optimum was reached"

# What IPOPT's return statuses mean but for its limits of time, and what to do.
USABLE = {
    "Solve_Succeeded": (FOUND, ""),
    "Solved_To_Acceptable_Level": (
        "a local optimum was found to the looser, acceptable tolerance",
        "Check the standard errors, or scale the data.",
    ),
}
FAILURES = {
    "Infeasible_Problem_Detected": (
        "no states satisfy the model exactly",
        "Check signs and bounds of the model, or start from other values.",
    ),
    "Search_Direction_Becomes_Too_Small": (
        "the iteration stalled before an optimum was reached",
        "A term may not be smooth enough; widen its transition or use more steps per "
        "sample.",
    ),
    "Diverging_Iterates": (
        "the iterates grew without limit",
        "Bound the parameters; the model may be unstable.",
    ),
    "Maximum_Iterations_Exceeded": (
        "the iteration limit was reached before an optimum was found",
        "Choose starting values closer to the solution (start in [parameters] of a "
        "study file), or allow more iterations (in Python, "
        "ph.SolverSettings(max_iterations=...)).",
    ),
    "Restoration_Failed": ("no feasible states could be found", OTHERWISE),
    "Invalid_Number_Detected": (
        "the model gave NaN or infinity",
        "Look for a division by zero, a logarithm or root of a negative number, or a "
        "missing bound.",
    ),
    "Not_Enough_Degrees_Of_Freedom": (
        "there are more equations than unknowns",
        "Free a parameter.",
    ),
    "User_Requested_Stop": ("the solve was interrupted", "Run it again to finish."),
}


def words_of_ipopt(status: str, max_seconds: float) -> tuple[str, str]:
    """What IPOPT's return status means, and what to do, for a limit of time in s."""
    if status in TIME_LIMITS:
        sentence = f"the time limit of {max_seconds:g} s was reached"
        more_time = "allow more time (ph.SolverSettings(max_seconds=...))."
        return sentence, f"Use fewer samples, or {more_time}"
    unknown = (f"the solver stopped: {status}", "Try other starting values.")
    return (USABLE | FAILURES).get(status, unknown)


def is_level(deviances: np.ndarray) -> bool:
    """Whether the last eight deviances (-2 log likelihood) go to and fro over a kink.

    Beside one (a dead zone, a gap) no step becomes short. Without the curvature of the
    constraints, or where these do not hold, it would also be slow progress.
    """
    last = deviances[-8:]
    return len(last) == 8 and float(np.ptp(last)) < 0.05


@dataclass(frozen=True)
class Outcome:
    """What the solver said, in words and numbers.

    Args:
        success: whether the point may be used as an optimum.
        status: IPOPT's return status, or that of full steps.
        sentence: what happened.
        advice: what to do about it; empty where nothing needs to be done.
        iterations: number of them.
        seconds: wall time of the solve.
        objective: its value at the point.
        infeasibility: largest violation of a scaled constraint.
        at_bounds: names of the parameters that ended at one of their bounds.
    """

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
    def solver(self) -> str:
        """Which method it was that ended there."""
        return "Gauss-Newton steps" if self.status == DIRECT_STEPS else "IPOPT"

    def __str__(self) -> str:
        how = self.solver if self.status == DIRECT_STEPS else f"IPOPT: {self.status}"
        effort = f"{number_of(self.iterations, 'iteration')}, {self.seconds:.2f} s"
        text = f"{self.sentence} ({how}, {effort})"
        if self.at_bounds:
            text += f"; at a bound: {', '.join(self.at_bounds)}"
        if self.advice:
            text += f". {self.advice}"
        return text


SETTLED_AT_KINK = (
    "the iterates converged to a point where the model is not "
    "differentiable and the gradient is not zero"
)


@dataclass(frozen=True)
class Solution:
    """The optimal point.

    Args:
        values: unscaled values per block of variables.
        z: scaled vector, (n_variables,).
        residual: (n_residuals,).
        outcome: how the solve ended.
    """

    values: dict[str, np.ndarray]
    z: np.ndarray
    residual: np.ndarray
    outcome: Outcome


class Solver:
    """IPOPT made ready for one program, to be solved from any start and settings.

    Args:
        program: what to solve.
        settings: tolerance and limits.
        exact: with the curvature of the constraints in the Hessian.
    """

    def __init__(
        self,
        program: Program,
        settings: SolverSettings | None = None,
        exact: bool = False,
    ) -> None:
        self.program = program
        self.limits = settings or SolverSettings()
        self.is_exact = exact
        self._listener = _Listener(program)
        options: dict[str, Any] = {
            "no_nlp_grad": True,
            "calc_lam_p": False,
            "hess_lag": program.hessian(exact),
            "jac_g": program.jacobian(),
            "print_time": False,
            "error_on_fail": False,
            "show_eval_warnings": False,
            "record_time": True,
            "ipopt": _ipopt_options(self.limits),
            "iteration_callback": self._listener,
        }
        self._ipopt = ca.nlpsol("program", "ipopt", program.nlp, options)
        self._residual = ca.Function(
            "residual", [program.z, program.settings], [program.residual]
        )

    def solve(
        self, start: np.ndarray | None = None, set_to: np.ndarray | None = None
    ) -> Solution:
        """Solve from a start with given values of the program's settings.

        Args:
            start: scaled variables, (n_variables,); by default the program's start.
            set_to: values of ``program.settings``; by default those of the program.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed.
        """
        program = self.program
        set_to = program.set_to if set_to is None else set_to
        given = program.arguments | {"p": set_to}
        if start is not None:
            given["x0"] = start
        began = time.perf_counter()
        with solving():
            result = self._ipopt(**given)
        seconds = time.perf_counter() - began
        outcome = self._outcome(self._ipopt.stats(), result, seconds)
        return self.solution(np.array(result["x"]).ravel(), set_to, outcome)

    def solution(self, z: np.ndarray, set_to: np.ndarray, outcome: Outcome) -> Solution:
        """What is known at scaled variables z, with the outcome that led there."""
        residual = np.array(self._residual(z, set_to)).ravel()
        return Solution(self.program.values(z), z, residual, outcome)

    def _outcome(
        self, stats: Mapping[str, Any], result: Mapping[str, ca.DM], seconds: float
    ) -> Outcome:
        program = self.program
        status = str(stats["return_status"])
        sentence, advice = words_of_ipopt(status, self.limits.max_seconds)
        success = status in USABLE
        n_residuals = program.residual.numel()
        if not success and self.is_exact and _is_settled(stats, n_residuals):
            success, sentence, advice = True, SETTLED_AT_KINK, ""
        g = np.array(result["g"]).ravel()
        g_lower, g_upper = program.g_bounds
        outside = np.maximum(g_lower - g, g - g_upper)
        violation = float(np.max(outside, initial=0.0))
        if not success and violation > 1e-6:
            where = program.name_of(int(np.argmax(outside)), program.constraints)
            sentence += f"; the largest violation is {violation:.1e} in {where}"
        return Outcome(
            success=success,
            status=status,
            sentence=sentence,
            advice=advice,
            iterations=int(stats["iter_count"]),
            seconds=seconds,
            objective=float(result["f"]),
            infeasibility=violation,
            at_bounds=self._at_bounds(np.array(result["x"]).ravel()),
        )

    def _at_bounds(self, z: np.ndarray) -> tuple[str, ...]:
        """Names of parameters at a bound in z, the scaled variables (n_variables,)."""
        if "theta" not in self.program.variables:
            return ()
        place, label = self.program.variables["theta"]
        names = list(map(label, range(place.stop - place.start)))
        return names_at_bounds(names, z[place], self.program.bounds[:, place])


class _Listener(ca.Callback):
    """What IPOPT asks after each iteration: whether to end, for Ctrl-C was pressed."""

    def __init__(self, program: Program) -> None:
        ca.Callback.__init__(self)
        n, n_constraints = program.z.numel(), program.g.numel()
        self._sizes = {"f": 1, "x": n, "lam_x": n, "g": n_constraints}
        self._sizes |= {"lam_g": n_constraints, "lam_p": program.settings.numel()}
        self.construct("listener", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arg: Sequence[ca.DM]) -> list[int]:
        return [int(is_noted())]


def _ipopt_options(settings: SolverSettings) -> dict[str, Any]:
    options: dict[str, Any] = {
        "print_level": 5 if settings.show else 0,
        "sb": "yes",
        "tol": settings.tolerance,
        "acceptable_tol": 100 * settings.tolerance,
        "max_iter": settings.max_iterations,
        # The program is scaled already; a second scaling would change what the
        # tolerance means.
        "nlp_scaling_method": "none",
        # Bounds are physics: they are not relaxed, and a start on a bound is moved only
        # a little inside.
        "bound_relax_factor": 0.0,
        "bound_push": 1e-4,
        "bound_frac": 1e-4,
        "mu_strategy": "adaptive",
        # Approximate minimum degree that sees dense rows (each parameter's): time in
        # proportion to the samples.
        "mumps_pivot_order": 6,
        # Pivoting for size alone fills the factors of a badly scaled record until they
        # do not fit (EMPS, 1 kHz).
        "mumps_pivtol": 1e-9,
        # Its permutation to a large diagonal, which it chooses by itself, fills them
        # too: 12 s for 0.5 s (EMPS).
        "mumps_permuting_scaling": 0,
        # Beyond this a step is given up for a restoration: larger ones diverge, while
        # the factors fill the memory.
        "max_hessian_perturbation": 1e4,
    }
    if settings.max_seconds < np.inf:
        options["max_wall_time"] = settings.max_seconds
    return options


def maximized(
    z: ca.MX,
    gain: ca.MX,
    g: ca.MX,
    start: np.ndarray,
    bounds: np.ndarray,
    g_bounds: np.ndarray,
) -> tuple[float, np.ndarray] | None:
    """The largest gain of the variables z, and these; None where g leaves its bounds.

    For small programs of any shape: the Hessian is IPOPT's own, of limited memory.

    Args:
        z: (n_variables,), near one in size.
        gain: what is maximised.
        g: constraints, (n_constraints,).
        start: (n_variables,).
        bounds: lower and upper, (2, n_variables).
        g_bounds: those of g, (2, n_constraints).

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed.
    """
    problem: dict[str, Any] = {"x": z, "f": -gain, "g": g}
    options: dict[str, Any] = {
        "print_time": False,
        "error_on_fail": False,
        "show_eval_warnings": False,
        "ipopt": {
            "print_level": 0,
            "sb": "yes",
            "max_iter": 40,
            "tol": 1e-4,
            "hessian_approximation": "limited-memory",
        },
    }
    solver = ca.nlpsol("gain", "ipopt", problem, options)
    lower, upper = g_bounds
    # Constraints count in their own ranges.
    range_of = np.maximum(upper - lower, TINY)
    with solving():
        found = solver(x0=start, lbx=bounds[0], ubx=bounds[1], lbg=lower, ubg=upper)
    # IPOPT gives zeros where there are no numbers at the start.
    at_end = ca.Function("at_end", [z], [gain, g])(found["x"])
    value, reached = float(at_end[0]), np.array(at_end[1]).ravel()
    outside = np.maximum(lower - reached, reached - upper) / range_of
    if not np.isfinite(value) or not np.all(outside < 1e-6):
        return None
    return value, np.array(found["x"]).ravel()


def _is_settled(stats: Mapping[str, Any], n_residuals: int) -> bool:
    """Whether the last iterates go to and fro over a kink, where constraints hold."""
    # The logarithm of the objective, times the number of residuals, changes as -2 log
    # likelihood does.
    history = stats.get("iterations", {})
    objective = np.array(history.get("obj", []))[-8:]
    violation = np.array(history.get("inf_pr", []))[-8:]
    size = np.max(np.abs(objective), initial=TINY)
    holds = np.isfinite(size) and np.max(violation, initial=0.0) < 1e-5
    return bool(holds and is_level(n_residuals * objective / size))


def names_at_bounds(
    names: Sequence[str], z: np.ndarray, bounds: Iterable[np.ndarray]
) -> tuple[str, ...]:
    """The names (n_names,) of the first scaled variables z (n,) that are at a bound.

    Or nearer than 1e-6; ``bounds`` are lower and upper ones, (n,) each.
    """
    lower, upper = bounds
    distance = np.minimum(z - lower, upper - z)[: len(names)]
    return tuple(names[i] for i in np.flatnonzero(distance < 1e-6).tolist())

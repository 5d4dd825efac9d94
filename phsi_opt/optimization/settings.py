"""How hard a solver tries: tolerance, limits, and who solves.

The limits that decide a result are numbers of iterations, which are the same on every
machine and under every load. A limit of time is the user's own, and off by default.
"""

from dataclasses import dataclass

import numpy as np

from phsi_opt.arguments import require, require_choice, require_count

# Who solves a likelihood: full Gauss-Newton steps where they lead to an optimum and
# IPOPT where not, or IPOPT alone.
AUTO = "auto"
IPOPT = "ipopt"
SOLVERS = (AUTO, IPOPT)


@dataclass(frozen=True)
class SolverSettings:
    """How hard to try: tolerance on the scaled optimality conditions, and limits.

    Args:
        tolerance: of the scaled optimality conditions, as IPOPT's ``tol``.
        max_iterations: of one solve by IPOPT.
        max_seconds: wall time of one solve, in s. Infinite by default: with a finite
            limit the result may depend on the load of the machine.
        show: whether IPOPT prints its iterations.
        thorough: False: no windows where the whole record fails, and no finer steps
            than those of the start.
        solver: "auto" takes the faster Gauss-Newton steps for a likelihood where they
            lead to an optimum; "ipopt" solves the same nonlinear program by IPOPT
            alone, as a reference. The PHSI loss is IPOPT's in any case.

    Raises:
        ModelError: a limit that is no number above zero, or an unknown solver.
    """

    tolerance: float = 1e-8
    max_iterations: int = 500
    max_seconds: float = np.inf
    show: bool = False
    thorough: bool = True
    solver: str = AUTO

    def __post_init__(self) -> None:
        for name in ("tolerance", "max_seconds"):
            value = getattr(self, name)
            fine = isinstance(value, int | float) and value > 0
            require(fine, f"SolverSettings: {name}", value, "a number above 0")
        require_count("SolverSettings: max_iterations", self.max_iterations)
        require_choice("SolverSettings: solver", self.solver, SOLVERS)

    @property
    def has_own_steps(self) -> bool:
        """Whether a likelihood may be solved without IPOPT."""
        return self.solver == AUTO

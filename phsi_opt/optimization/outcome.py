"""How a solve ended, in words and numbers, whichever method it was.

A failure is data: its sentence says what happened and its advice what to try. Whether
it is raised as an error is decided elsewhere.
"""

from dataclasses import dataclass

import numpy as np

DIRECT_STEPS = "Direct_Steps"  # status of full Gauss-Newton steps
TIME_LIMITS = ("Maximum_CpuTime_Exceeded", "Maximum_WallTime_Exceeded")
OTHERWISE = "Start from other values, or use more steps per sample."
FOUND = "a local optimum was found"
STALLED = "the steps stalled before an optimum"

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
        "the iteration stalled before an optimum",
        "A term may not be smooth enough; widen its transition or use more steps per "
        "sample.",
    ),
    "Diverging_Iterates": (
        "the iterates grew without limit",
        "Bound the parameters; the model may be unstable.",
    ),
    "Maximum_Iterations_Exceeded": (
        "the iteration limit was reached before an optimum",
        "Give starting values nearer to the solution (start in [parameters] of a study "
        "file), or allow more iterations (in Python, "
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
    """What IPOPT's return status means, and what to do.

    Args:
        status: as IPOPT names it.
        max_seconds: the user's limit of time, in s.
    """
    if status in TIME_LIMITS:
        return (
            f"the time limit of {max_seconds:g} s ended the solve",
            "Use fewer samples, or allow more time "
            "(ph.SolverSettings(max_seconds=...)).",
        )
    unknown = (f"the solver stopped: {status}", "Try other starting values.")
    return (USABLE | FAILURES).get(status, unknown)


def is_level(deviances: np.ndarray) -> bool:
    """Whether the last eight steps went to and fro over a kink of the model.

    Beside one (a dead zone, a gap) no step becomes short. Without the curvature of the
    constraints, or where these do not hold, it would also be slow progress.

    Args:
        deviances: (n_steps,) -2 log likelihood after each.
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
        effort = f"{self.iterations} iterations, {self.seconds:.2f} s"
        text = f"{self.sentence} ({self.solver}: {self.status}, {effort})"
        if self.at_bounds:
            text += f"; at a bound: {', '.join(self.at_bounds)}"
        if self.advice:
            text += f". {self.advice}"
        return text

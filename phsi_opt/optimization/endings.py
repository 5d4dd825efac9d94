"""The ways in which a solve can end: what each status means, and what to do.

IPOPT's return statuses and those of full steps. What was reached is not said here
(`Outcome`).
"""

from dataclasses import dataclass

DIRECT_STEPS = "Direct_Steps"  # of full Gauss-Newton steps that found an optimum
ITERATION_LIMITS = ("Maximum_Iterations_Exceeded",)
TIME_LIMITS = ("Maximum_CpuTime_Exceeded", "Maximum_WallTime_Exceeded")


@dataclass(frozen=True)
class Ending:
    """What a status says: is the point usable, what happened, and what to do."""

    status: str
    is_usable: bool
    sentence: str
    advice: str = ""


# IPOPT's return statuses, but for its limits of time.
IPOPT_ENDINGS = (
    Ending("Solve_Succeeded", True, "a local optimum was found"),
    Ending(
        "Solved_To_Acceptable_Level",
        True,
        "a local optimum was found to the looser, acceptable tolerance",
        "Check the standard errors, or scale the data.",
    ),
    Ending(
        "Infeasible_Problem_Detected",
        False,
        "no states satisfy the model exactly",
        "Check signs and bounds of the model, or start from other values.",
    ),
    Ending(
        "Search_Direction_Becomes_Too_Small",
        False,
        "the iteration stalled before an optimum",
        "A term may not be smooth enough; widen its transition or use more steps per "
        "sample.",
    ),
    Ending(
        "Diverging_Iterates",
        False,
        "the iterates grew without limit",
        "Bound the parameters; the model may be unstable.",
    ),
    Ending(
        "Maximum_Iterations_Exceeded",
        False,
        "the iteration limit was reached before an optimum",
        "Give starting values nearer to the solution (start in [parameters] of a study "
        "file), or allow more iterations (in Python, "
        "ph.SolverSettings(max_iterations=...)).",
    ),
    Ending(
        "Restoration_Failed",
        False,
        "no feasible states could be found",
        "Start from other values, or use more steps per sample.",
    ),
    Ending(
        "Invalid_Number_Detected",
        False,
        "the model gave NaN or infinity",
        "Look for a division by zero, a logarithm or root of a negative number, or a "
        "missing bound.",
    ),
    Ending(
        "Not_Enough_Degrees_Of_Freedom",
        False,
        "there are more equations than unknowns",
        "Free a parameter.",
    ),
    Ending(
        "User_Requested_Stop",
        False,
        "the solve was interrupted",
        "Run it again to finish.",
    ),
)

STEPS_OPTIMUM = Ending(DIRECT_STEPS, True, "a local optimum was found")
OTHERWISE = "Start from other values, or use more steps per sample."
STEPS_STALLED = Ending(
    DIRECT_STEPS, False, "the steps stalled before an optimum", OTHERWISE
)


def ending_of_ipopt(status: str, max_seconds: float) -> Ending:
    """What IPOPT's return status means.

    Args:
        status: as IPOPT names it.
        max_seconds: the user's limit of time, in s.
    """
    if status in TIME_LIMITS:
        return _ending_by_time(status, max_seconds, "the solve")
    for ending in IPOPT_ENDINGS:
        if ending.status == status:
            return ending
    sentence = f"the solver stopped: {status}"
    return Ending(status, False, sentence, "Try other starting values.")


def _ending_by_time(status: str, max_seconds: float, what: str) -> Ending:
    return Ending(
        status,
        False,
        f"the time limit of {max_seconds:g} s ended {what}",
        "Use fewer samples, or allow more time (ph.SolverSettings(max_seconds=...)).",
    )

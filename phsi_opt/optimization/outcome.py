"""How a solve ended, in words and numbers, whichever method it was.

A failure is data: its sentence says what happened and its advice what to try. Whether
it is raised as an error is decided elsewhere.
"""

from dataclasses import dataclass

from phsi_opt.optimization.endings import (
    DIRECT_STEPS,
    ITERATION_LIMITS,
    TIME_LIMITS,
)


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
        if self.status == DIRECT_STEPS:
            return "Gauss-Newton steps"
        return "IPOPT"

    @property
    def is_out_of_iterations(self) -> bool:
        """Whether a limit of iterations ended the solve."""
        return self.status in ITERATION_LIMITS

    @property
    def is_out_of_time(self) -> bool:
        """Whether the user's limit of time ended the solve."""
        return self.status in TIME_LIMITS

    def __str__(self) -> str:
        effort = f"{self.iterations} iterations, {self.seconds:.2f} s"
        text = f"{self.sentence} ({self.solver}: {self.status}, {effort})"
        if self.at_bounds:
            text += f"; at a bound: {', '.join(self.at_bounds)}"
        if self.advice:
            text += f". {self.advice}"
        return text

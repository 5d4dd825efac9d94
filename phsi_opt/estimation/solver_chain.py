"""The ways to solve a likelihood, one where another failed.

Gauss-Newton steps first: they are cheap and lead from far away. The exact Hessian where
the residuals are large or a term is sharp; at last along solutions of the model
(`feasible_path`). Which way solved a problem is remembered, and comes first on one like
it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from phsi_opt.estimation.feasible_path import FeasiblePath
from phsi_opt.estimation.problem import Progress
from phsi_opt.estimation.transcription import Transcription
from phsi_opt.optimization.endings import PATH_STATUSES
from phsi_opt.optimization.ipopt import Solution, Solver
from phsi_opt.optimization.settings import (
    EXACT,
    FEASIBLE_PATH,
    GAUSS_NEWTON,
    WAYS,
    SolverSettings,
)

# Iterations after which the exact Hessian takes over from Gauss-Newton: that converges
# in a few, or not at all.
GAUSS_NEWTON_ITERATIONS = 30
# Iterations with the exact Hessian where a solve need not be thorough.
BRIEF_ITERATIONS = 25
# Root mean square residual, over the noise assumed, of data without noise.
NOISE_FREE_RMS = 0.01
# Scaled defect up to which a stalled iterate satisfies the model: the solver's own
# tolerance.
NOISE_FREE_DEFECT = 1e-8

NEXT_WAYS = {
    GAUSS_NEWTON: WAYS,
    # Where Gauss-Newton steps crept before, they come last.
    EXACT: (EXACT, FEASIBLE_PATH, GAUSS_NEWTON),
    # From where the path ended the exact Hessian takes a few iterations, where
    # Gauss-Newton's goes to and fro (EMPS, 9 re-fits).
    FEASIBLE_PATH: (FEASIBLE_PATH, EXACT, GAUSS_NEWTON),
}
IN_WORDS = {
    GAUSS_NEWTON: "with the Gauss-Newton Hessian",
    EXACT: "with the exact Hessian",
    FEASIBLE_PATH: "along solutions of the model",
}


def ways_after(way: str) -> tuple[str, ...]:
    """The ways to try, in order, where a solution like it was found in ``way``."""
    return NEXT_WAYS[way]


class SolverChain:
    """Solves one program repeatedly in one way, until that fails; then in the next.

    A way that failed is not tried again. Solvers are made when they are needed.
    """

    def __init__(
        self,
        transcription: Transcription,
        settings: SolverSettings,
        ways: Sequence[str],
        say: Progress,
    ) -> None:
        """Make the solver of the first of the ``ways`` that the settings allow."""
        self._transcription = transcription
        self._settings = settings
        self._say = say
        self._untried = self._allowed(ways)
        self.way = next(self._untried)
        self.solver = self._solver(self.way)

    def attempt(self, z: np.ndarray, sigma: np.ndarray) -> Solution:
        """Solve from z with the noise ``sigma`` in the present way.

        Args:
            z: scaled variables, (n_variables,).
            sigma: noise of the states, (n_states,).
        """
        return self.solver.solve(z, sigma, raise_on_failure=False)

    def completed(
        self, attempt: Solution, z: np.ndarray, sigma: np.ndarray
    ) -> Solution:
        """The attempt or, where it failed, the solution of the next way that succeeds.

        Of two failures that of IPOPT is kept, because it says more.

        Args:
            attempt: what `attempt` found.
            z: scaled variables that it began with, (n_variables,).
            sigma: noise of the states, (n_states,).
        """
        solution = self._of_next_ways(attempt, z, sigma)
        self._say(f"{self._transcription}: {solution.outcome}")
        return noise_free_is_success(solution)

    def _of_next_ways(
        self, solution: Solution, z: np.ndarray, sigma: np.ndarray
    ) -> Solution:
        while not solution.outcome.success:
            way = next(self._untried, None)
            if way is None:
                break
            status = solution.outcome.status
            self._say(f"not solved ({status}); again {IN_WORDS[way]}")
            if status in PATH_STATUSES and np.isfinite(solution.outcome.objective):
                z = solution.z  # it obeys the model and is lower than where it began
            solver = self._solver(way)
            other = solver.solve(z, sigma, raise_on_failure=False)
            if other.outcome.success or way != FEASIBLE_PATH:
                self.way = way
                self.solver = solver
                solution = other
        return solution

    def _allowed(self, ways: Sequence[str]) -> Iterator[str]:
        """Each way once; the exact Hessian stands in where there is no path."""
        allowed_ways = self._settings.ways
        allowed = [way for way in ways if way in allowed_ways] or list(allowed_ways)
        has_path = self._settings.has_own_steps and self._transcription.has_path
        if not has_path:
            allowed = [EXACT if way == FEASIBLE_PATH else way for way in allowed]
        return iter(dict.fromkeys(allowed))

    def _solver(self, way: str) -> Solver | FeasiblePath:
        if way == FEASIBLE_PATH:
            return self._feasible_path()
        settings = self._ipopt_settings(way)
        return Solver(self._transcription.program, settings, exact=way == EXACT)

    def _feasible_path(self) -> FeasiblePath:
        return FeasiblePath(
            self._transcription.program,
            self._transcription.model,
            self._transcription.grid,
            self._transcription.unknown,
            self._transcription.loss,
            self._settings.max_seconds,
        )

    def _ipopt_settings(self, way: str) -> SolverSettings:
        settings = self._settings
        if way == EXACT and settings.thorough:
            return settings
        if way == EXACT:
            most = min(BRIEF_ITERATIONS, settings.max_iterations)
            return replace(settings, max_iterations=most)
        most = min(GAUSS_NEWTON_ITERATIONS, settings.max_iterations)
        return replace(settings, max_iterations=most)


def noise_free_is_success(solution: Solution) -> Solution:
    """A stall where the residuals are far below the least noise is no failure.

    The data are explained; there is nothing left that could be made smaller.
    """
    outcome = solution.outcome
    mean_square = float(np.sum(solution.residual**2)) / 2
    is_noise_free = mean_square < NOISE_FREE_RMS**2
    holds = outcome.infeasibility <= NOISE_FREE_DEFECT
    if outcome.success or not is_noise_free or not holds:
        return solution
    sentence = (
        "the data are explained beyond the accuracy of numbers: they have no noise"
    )
    explained = replace(outcome, success=True, sentence=sentence, advice="")
    return replace(solution, outcome=explained)

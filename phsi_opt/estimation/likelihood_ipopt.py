"""A likelihood's program solved by IPOPT, its noise re-estimated until it stays.

Where the program has slack variables (Huber's function, L1), where it is asked for, and
where full steps do not settle: then with the exact Hessian, as a term is sharp or the
residuals are large.
"""

from dataclasses import replace

import numpy as np

from phsi_opt.estimation.likelihood_steps import Optimum
from phsi_opt.estimation.noise_estimation import NOISE_TOLERANCE, NoiseIteration
from phsi_opt.model_error.joint_estimate import NEARLY_HELD
from phsi_opt.optimization.ipopt import Solution, Solver
from phsi_opt.optimization.program import Program
from phsi_opt.optimization.settings import SolverSettings

MOST_IPOPT_SOLVES = 6  # with a noise re-estimated
# Iterations after which the exact Hessian takes over from Gauss-Newton's: that
# converges in a few, or creeps (a pendulum over the top without its friction: 134).
GAUSS_NEWTON_ITERATIONS = 200
# Iterations with the exact Hessian where a solve need not be thorough.
BRIEF_ITERATIONS = 25
# Root mean square residual, over the noise assumed, of data without noise.
NOISE_FREE_RMS = 0.01
# Scaled defect up to which a stalled iterate satisfies the model: the solver's own
# tolerance.
NOISE_FREE_DEFECT = 1e-8


def by_ipopt(
    program: Program,
    settings: SolverSettings,
    noise: NoiseIteration,
    sigma: np.ndarray,
    by_steps: Optimum | None,
) -> Optimum:
    """The optimum and its noise, or how far IPOPT went.

    Args:
        program: of the likelihood.
        settings: tolerance and limits.
        noise: re-estimates what is not given.
        sigma: (n_states,) noise to start from.
        by_steps: where full steps ended that did not settle; None: there were none.
    """
    starts = [(False, program.start), (True, program.start)]  # whether it is exact
    if by_steps is not None:
        if by_steps.solution.outcome.infeasibility < NEARLY_HELD:
            # Steps are Gauss-Newton's: where they stalled, IPOPT's creep.
            starts = [(True, by_steps.solution.z), (False, program.start)]
        if not settings.thorough:
            starts = [start for start in starts if start[0]]
    for is_exact, z in starts:
        solver = Solver(program, _limits(settings, is_exact), exact=is_exact)
        optimum = _settled(solver, noise, z, sigma)
        if optimum.solution.outcome.success:
            break
    return optimum


def _settled(
    solver: Solver, noise: NoiseIteration, z: np.ndarray, sigma: np.ndarray
) -> Optimum:
    """Solved again and again with better noise."""
    for _ in range(MOST_IPOPT_SOLVES):
        solution = solver.solve(z, sigma)
        solution = noise_free_is_success(solution)
        if not solution.outcome.success or not noise.is_estimated.any():
            break
        updated = noise.updated(sigma, solution.residual)
        has_settled = noise.change(sigma, updated) < NOISE_TOLERANCE
        z, sigma = solution.z, updated
        if has_settled:
            settled = solver.solution(z, sigma, solution.outcome)
            return Optimum(settled, sigma)
    return Optimum(solution, sigma)


def _limits(settings: SolverSettings, is_exact: bool) -> SolverSettings:
    if is_exact and settings.thorough:
        return settings
    most = BRIEF_ITERATIONS if is_exact else GAUSS_NEWTON_ITERATIONS
    return replace(settings, max_iterations=min(most, settings.max_iterations))


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

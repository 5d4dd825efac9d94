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
from phsi_opt.optimization.ipopt import Solution, Solver, SolverSettings
from phsi_opt.optimization.program import Program


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
    for _ in range(6):  # noises, at most
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
    """Fewer iterations of a brief solve, and with Gauss-Newton's Hessian.

    With that it converges in a few, or creeps (a pendulum over the top without its
    friction: 134); then the exact one takes over.
    """
    if is_exact and settings.thorough:
        return settings
    most = 25 if is_exact else 200
    return replace(settings, max_iterations=min(most, settings.max_iterations))


def noise_free_is_success(solution: Solution) -> Solution:
    """A stall where the residuals are far below the least noise is no failure.

    The data are explained; there is nothing left that could be made smaller.
    """
    outcome = solution.outcome
    mean_square = float(np.sum(solution.residual**2)) / 2
    is_noise_free = mean_square < 0.01**2  # of the noise that is assumed
    holds = outcome.infeasibility <= 1e-8  # the solver's own tolerance
    if outcome.success or not is_noise_free or not holds:
        return solution
    sentence = (
        "the data are explained beyond the accuracy of numbers: they have no noise"
    )
    explained = replace(outcome, success=True, sentence=sentence, advice="")
    return replace(solution, outcome=explained)

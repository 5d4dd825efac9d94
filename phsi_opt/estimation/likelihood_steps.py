"""A likelihood's optimum by full steps or by IPOPT, its noise re-estimated.

Full steps are one loop (`model_error.joint_estimate`), which lowers an objective::

    1/2 |(y - h(x, theta)) / sigma|^2 + 1/2 d' Q^-1 d   over theta and x

with d the defects and Q the variance of a white force that the model lacks. For the
likelihood Q is zero, and the defects hold. From a crude start Q begins as large as the
rates of the states: these follow the data, and the parameters the regression of their
rates, nearly a linear problem whatever the start. As Q falls the states become a
solution of the model, and each optimum is the start of the next: a homotopy, whose end
is the likelihood. Only measured states have a force: one in the equations of the others
could shrink with them, as from a position alone the scale of the momentum is open.

IPOPT solves programs with slack variables (Huber's function, L1), where it is asked
for, and where full steps do not settle: then with the exact Hessian, as a term is sharp
or the residuals are large.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from phsi_opt.errors import SolveError
from phsi_opt.estimation.noise_estimation import NoiseIteration
from phsi_opt.model_error.joint_estimate import (
    EXACTLY,
    NEARLY_HELD,
    SETTLED_VIOLATION,
    STEPS_OF_A_PROBLEM,
    JointProblem,
    Target,
)
from phsi_opt.model_error.linearization import Linearizer
from phsi_opt.optimization.ipopt import (
    DIRECT_STEPS,
    FOUND,
    OTHERWISE,
    STALLED,
    Outcome,
    Solution,
    Solver,
    SolverSettings,
    names_at_bounds,
)
from phsi_opt.optimization.program import Program
from phsi_opt.transcription.likelihood_values import LikelihoodValues

# Length of a step, in standard deviations of what is unknown, that is short enough for
# the noise to be re-estimated.
FOR_THE_NOISE = Target(length=0.1)
# Sizes of the force, as a share of each state's own rate, and where its steps end.
FORCE_SIZES = (1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5)
SMALL_FORCES = FORCE_SIZES[6:]  # from a start that is nearly the optimum
NEXT_SIZE = Target(fall=1e-3)
STEPS_TO_DYNAMICS = 20  # of the states, where others ended beside a kink


@dataclass(frozen=True, eq=False)
class Optimum:
    """A solution, and the noise (n_states,) that its residuals show."""

    solution: Solution
    sigma: np.ndarray


def by_steps(
    values: LikelihoodValues,
    settings: SolverSettings,
    noise: NoiseIteration,
    sigma: np.ndarray,
) -> Optimum:
    """The optimum and its noise, or how far full steps went.

    From the point of the likelihood's values, and noise sigma (n_states,).
    """
    began = time.perf_counter()
    most = min(STEPS_OF_A_PROBLEM, settings.max_iterations)
    target = FOR_THE_NOISE if noise.is_needed else EXACTLY
    linearizer = Linearizer(values)
    z = values.point.scaled
    joint = None
    n_steps = 0
    is_found = False
    for _ in range(10):  # noises, at most
        problem = JointProblem.white(linearizer, sigma)
        try:
            joint = problem.optimum(z, most, target=target, before=joint)
        except (SolveError, np.linalg.LinAlgError):
            break
        n_steps += joint.n_steps
        is_late = time.perf_counter() - began > settings.max_seconds
        if not joint.has_converged or is_late:
            break
        residual = _mean_residual(joint.place.residual, sigma, values)
        updated = noise.updated(sigma, residual)
        change = noise.change(sigma, updated)
        sigma = updated
        has_settled = change < noise.tolerance
        is_exact = max(joint.remaining, change) < EXACTLY.length
        is_found = is_exact or (has_settled and target is EXACTLY)
        if is_found:
            break
        if has_settled:
            target = EXACTLY
    if joint is not None:
        z = joint.point.z
        if is_found and joint.violation >= SETTLED_VIOLATION:
            z = _with_dynamics(values, z)
    known = values.at(z)
    violation = float(np.max(np.abs(known.g), initial=0.0))
    solution = solution_of_steps(
        values,
        z,
        _mean_residual(known.misfit, sigma, values),
        violation=violation,
        n_steps=n_steps,
        is_found=is_found and violation < SETTLED_VIOLATION,
        began=began,
    )
    return Optimum(solution, sigma)


def _with_dynamics(values: LikelihoodValues, z: np.ndarray) -> np.ndarray:
    """The same starts and parameters, with states that obey the dynamics (Newton).

    At a kink of the model full steps jump from one side to the other, and end where
    the dynamics are violated a little.
    """
    x = values.point.of_x
    slopes = values.jacobian.part(x)
    follows = np.ones(values.grid.n_nodes, dtype=bool)
    follows[values.grid.starts] = False
    own = np.flatnonzero(np.repeat(follows, values.n_states))
    z = z.copy()
    with suppress(RuntimeError):  # the states do not follow
        for _ in range(STEPS_TO_DYNAMICS):
            known = values.at(z)
            if not np.max(np.abs(known.g)) >= SETTLED_VIOLATION:
                break
            matrix = csc_matrix(slopes.sparse(known.jacobian))[:, own]
            z[x][own] -= splu(matrix).solve(known.g)
    return z


def solution_of_steps(
    values: LikelihoodValues,
    z: np.ndarray,
    residual: np.ndarray,
    *,
    violation: float,
    n_steps: int,
    is_found: bool,
    began: float,
) -> Solution:
    """Where steps ended, in the form of IPOPT's solutions."""
    bounds = (values.lower, values.upper)
    outcome = Outcome(
        success=is_found,
        status=DIRECT_STEPS,
        sentence=FOUND if is_found else STALLED,
        advice="" if is_found else OTHERWISE,
        iterations=n_steps,
        seconds=time.perf_counter() - began,
        objective=float(residual @ residual) / 2,
        infeasibility=violation,
        at_bounds=names_at_bounds(values.unknown.names, z, bounds),
    )
    return Solution(values.point.unscaled(z), z, residual, outcome)


def continued(
    values: LikelihoodValues, sigma: np.ndarray, sizes: Sequence[float]
) -> np.ndarray | None:
    """Scaled variables that nearly solve the model; None: no steps lead there.

    From the point of the likelihood's values, with noise sigma (n_states,), along
    forces of falling sizes, as shares of the rates.
    """
    rates = _sizes_of_rates(values)
    linearizer = Linearizer(values)
    found = None
    for size in sizes:
        problem = JointProblem.white(linearizer, sigma, (size * rates) ** 2)
        try:
            z = values.point.scaled
            found = problem.optimum(z, target=NEXT_SIZE, before=found)
        except (SolveError, np.linalg.LinAlgError):
            return None
    return None if found is None else found.point.z


def _sizes_of_rates(values: LikelihoodValues) -> np.ndarray:
    """Size of each scaled defect if a measured state's own rate were missing."""
    grid, point = values.grid, values.point
    rate = np.sqrt(np.mean(grid.rates(point.x) ** 2, axis=0))
    relative = rate / point.x_scale
    moving = relative[relative > 0]
    typical = np.median(moving) if len(moving) else 1 / np.ptp(grid.t)
    # A state that stands still in the start is as fast as the others.
    rate = np.where(rate > 0, rate, typical * point.x_scale)
    rate = np.where(grid.measured_states, rate, 0.0)
    return np.asarray((rate * grid.h[:, None] / point.x_scale).ravel())


def _mean_residual(
    misfit: np.ndarray, sigma: np.ndarray, values: LikelihoodValues
) -> np.ndarray:
    """Over the noise, so that half its squares are the mean square, (n_values,)."""
    weights = np.sqrt(2 / len(misfit)) / sigma[values.grid.channel]
    residual: np.ndarray = misfit * weights
    return residual


# ---- IPOPT ---------------------------------------------------------------------------


def by_ipopt(
    program: Program,
    settings: SolverSettings,
    noise: NoiseIteration,
    sigma: np.ndarray,
    by_steps: Optimum | None,
) -> Optimum:
    """The optimum and its noise, or how far IPOPT went.

    From noise sigma (n_states,), and from where full steps ended that did not settle.
    """
    starts = [(False, program.start), (True, program.start)]  # whether it is exact
    if by_steps is not None:
        if by_steps.solution.outcome.infeasibility < NEARLY_HELD:
            # Steps are Gauss-Newton's: where they stalled, IPOPT's creep.
            starts = [(True, by_steps.solution.z), (False, program.start)]
        if not settings.thorough:
            starts = [start for start in starts if start[0]]
    for is_exact, z in starts:
        limits = settings
        if not (is_exact and settings.thorough):
            # Gauss-Newton's Hessian converges in a few iterations, or creeps (134 for a
            # pendulum over the top without its friction): then the exact one is next.
            most = min(25 if is_exact else 200, settings.max_iterations)
            limits = replace(settings, max_iterations=most)
        optimum = _settled(Solver(program, limits, exact=is_exact), noise, z, sigma)
        if optimum.solution.outcome.success:
            break
    return optimum


def _settled(
    solver: Solver, noise: NoiseIteration, z: np.ndarray, sigma: np.ndarray
) -> Optimum:
    """Solved again and again with better noise."""
    for _ in range(6):  # noises, at most
        solution = _noise_free_is_success(solver.solve(z, sigma))
        if not solution.outcome.success or not noise.is_needed:
            break
        updated = noise.updated(sigma, solution.residual)
        has_settled = noise.change(sigma, updated) < noise.tolerance
        z = solution.z
        sigma = updated
        if has_settled:
            solution = solver.solution(z, sigma, solution.outcome)
            break
    return Optimum(solution, sigma)


def _noise_free_is_success(solution: Solution) -> Solution:
    """A stall where residuals are far below the least noise is no failure."""
    outcome = solution.outcome
    mean_square = float(np.sum(solution.residual**2)) / 2
    is_noise_free = mean_square < 0.01**2  # of the noise that is assumed
    holds = outcome.infeasibility <= 1e-8  # the solver's own tolerance
    if outcome.success or not is_noise_free or not holds:
        return solution
    sentence = "the residuals are as small as rounding errors: the data have no noise"
    explained = replace(outcome, success=True, sentence=sentence, advice="")
    return replace(solution, outcome=explained)

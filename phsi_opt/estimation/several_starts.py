"""The best of the optima of a likelihood, from one starting point or several.

Random points around the first are a check on local optima, which the user asks for
(``starts``): the fit's warnings say how many of the points led to the best solution.
"""

from contextlib import closing, suppress
from dataclasses import replace
from functools import partial

import numpy as np

from phsi_opt.data.noise import LEAST_SIZE
from phsi_opt.errors import SolveError
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import (
    LikelihoodProblem,
    StartingPoint,
    likeliest,
)
from phsi_opt.estimation.likelihood_start import states_at
from phsi_opt.estimation.problem import Progress, silent
from phsi_opt.initialization.scaling import theta_scale
from phsi_opt.sweeps.sweep import Ahead
from phsi_opt.transcription.parameter_vector import Theta

# Difference of -2 log likelihood up to which two starts found the same optimum: far
# below what one parameter more explains by chance, far above the solver's tolerance.
SAME_DEVIANCE = 0.1
# Standard deviation of the logarithm of the factor on a value: one value in three is
# more than doubled or halved.
LOG_FACTOR_SPREAD = 0.7
# Standard deviation of what is added to a value of zero, in units of the parameter's
# size.
SHIFT_SPREAD = 0.3


def best_optimum(
    problem: LikelihoodProblem, first: StartingPoint
) -> LikelihoodEstimate:
    """The optimum of least deviance, with notes on how it was found.

    From the first starting point and from random ones, side by side if asked for.

    Args:
        problem: with the number of ``starts`` in its loss.
        first: the first starting point.
    """
    task = problem.task
    of_workers = replace(problem, task=replace(task, say=silent, executor=None))
    values = [None, *_random_values(problem, first)]
    cases = {f"start {number}": theta for number, theta in enumerate(values, 1)}
    solve = partial(_optimum_at, of_workers, first)
    estimates = []
    with closing(Ahead(solve, cases, task.executor, task.say)) as ahead:
        for key in cases:
            estimates.append(replace(ahead.result(key), task=task))
    best = likeliest(estimates)
    notes = first.notes
    if len(estimates) > 1:
        limit = best.deviance + SAME_DEVIANCE
        n_agreeing = sum(e.is_success and e.deviance < limit for e in estimates)
        agreement = f"{n_agreeing} of {len(estimates)} starting points"
        notes = (*notes, f"{agreement} led to the best solution")
    return replace(best, notes=notes) if notes else best


def _optimum_at(
    problem: LikelihoodProblem,
    first: StartingPoint,
    theta: np.ndarray | None,
    say: Progress,
) -> LikelihoodEstimate:
    """The optimum from the first point, or from other values theta (n_theta,)."""
    problem = replace(problem, task=replace(problem.task, say=say))
    if theta is None:
        return problem.solve_from(first)
    beside = replace(problem, noise=replace(problem.noise, sigma=first.sigma))
    states = first.states
    # Far from the data there may be no states; then those of the first point.
    with suppress(SolveError):
        states = states_at(beside, first.model, theta)
    moved = replace(first, theta=theta, states=states, is_optimum=False)
    return problem.solve_from(moved)


def _random_values(
    problem: LikelihoodProblem, first: StartingPoint
) -> list[np.ndarray]:
    """Values (n_theta,) of the points beside the first, ``starts`` of the loss in all.

    Those of the first times a log-normal factor; values of zero are moved by a share of
    the parameter's size: the change that moves some equation by the size of its rate.
    """
    n_further = problem.loss.starts - 1
    if not n_further:
        return []
    unknown = Theta.of(first.model, problem.task.runs)
    x = np.concatenate(first.states)
    x_spread = np.maximum(np.std(x, axis=0), LEAST_SIZE)
    means = unknown.means(first.theta)
    sizes = theta_scale(first.model, problem.task.grid, means, x, x_spread)
    shift = SHIFT_SPREAD * unknown.spread(sizes)
    rng = np.random.default_rng(0)  # the same points every time
    found = []
    for _ in range(n_further):
        for_factor, for_shift = rng.normal(size=(2, len(first.theta)))
        scaled = first.theta * np.exp(LOG_FACTOR_SPREAD * for_factor)
        moved = np.where(first.theta != 0, scaled, shift * for_shift)
        found.append(np.clip(moved, unknown.lower, unknown.upper))
    return found

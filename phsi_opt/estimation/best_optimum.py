"""The best of the optima of a likelihood, as far as they are looked for.

From the first starting point, and from as many random ones as were asked for.
"""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial

import numpy as np

from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem
from phsi_opt.estimation.likelihood_solve import LikelihoodSolver, likeliest
from phsi_opt.estimation.multi_start import random_values, with_values
from phsi_opt.estimation.problem import Progress, silent
from phsi_opt.estimation.starting_point import StartingPoint
from phsi_opt.sweeps.ahead import Ahead

# Difference of -2 log likelihood up to which two starts found the same optimum: far
# below what one parameter more explains by chance, far above the solver's tolerance.
SAME_DEVIANCE = 0.1


def best_optimum(solver: LikelihoodSolver, first: StartingPoint) -> LikelihoodEstimate:
    """The optimum of least deviance, with notes on how it was found.

    Args:
        solver: of the likelihood.
        first: the first starting point.
    """
    estimates = _optima(solver.problem, first)
    notes = first.notes + _agreement_note(estimates)
    best = likeliest(estimates)
    return replace(best, notes=notes) if notes else best


def _optima(
    problem: LikelihoodProblem, first: StartingPoint
) -> list[LikelihoodEstimate]:
    """What the first point and the random ones lead to, side by side if asked for."""
    task = problem.task
    of_workers = replace(problem, task=replace(task, say=silent, executor=None))
    values = [None, *random_values(first, problem)]
    cases = {f"start {number}": theta for number, theta in enumerate(values, 1)}
    solve = partial(_optimum_at, of_workers, first)
    estimates = []
    with closing(Ahead(solve, cases, task.executor, task.say)) as ahead:
        for key in cases:
            estimates.append(replace(ahead.result(key), task=task))
    return estimates


def _optimum_at(
    problem: LikelihoodProblem,
    first: StartingPoint,
    theta: np.ndarray | None,
    say: Progress,
) -> LikelihoodEstimate:
    """The optimum from the first point, or from other values theta (n_theta,)."""
    problem = replace(problem, task=replace(problem.task, say=say))
    point = first if theta is None else with_values(first, theta, problem)
    return LikelihoodSolver(problem).solve_from(point)


def _agreement_note(estimates: Sequence[LikelihoodEstimate]) -> tuple[str, ...]:
    """A sentence on how many of several starts agree."""
    if len(estimates) == 1:
        return ()
    limit = likeliest(estimates).deviance + SAME_DEVIANCE
    n_agreeing = sum(e.is_success and e.deviance < limit for e in estimates)
    return (
        f"{n_agreeing} of {len(estimates)} starting points led to the best solution",
    )

"""The best of the optima of a likelihood, as far as they are looked for.

From the first starting point, and from as many random ones as were asked for. Where the
best of these is far off, through windows that grow; where it is implausible even so,
from the second starting point. A record of many periods has an optimum for every number
of periods that the model may be wrong by, and flat ones where it dies out; in a window
of a period or two there is one alone. A plausible optimum costs nothing of this.
"""

from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial

import numpy as np

from phsi_opt.errors import SolveError
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem
from phsi_opt.estimation.likelihood_solve import LikelihoodSolver
from phsi_opt.estimation.multi_start import random_values, with_values
from phsi_opt.estimation.problem import Progress, silent
from phsi_opt.estimation.residual_scatter import is_far_off, is_plausible
from phsi_opt.estimation.starting_point import StartingPoint
from phsi_opt.sweeps.ahead import Ahead

# Difference of -2 log likelihood up to which two starts found the same optimum: far
# below what one parameter more explains by chance, far above the solver's tolerance.
SAME_DEVIANCE = 0.1
BY_WINDOWS = (
    "the record solved at once led to a worse optimum; this one was found through "
    "windows that grow, as with window=..."
)


def best_optimum(
    solver: LikelihoodSolver, first: StartingPoint, *, with_windows: bool
) -> LikelihoodEstimate:
    """The optimum of least deviance, with notes on how it was found.

    Args:
        solver: of the likelihood.
        first: the first starting point.
        with_windows: whether windows are tried where these points lead far off.
    """
    estimates = _optima(solver.problem, first)
    notes = first.notes + _agreement_note(estimates)
    best = _best(estimates)
    if with_windows and is_far_off(best):
        solver.task.say("the residuals are large: the record again, through windows")
        through = solver.solve_through_windows(first)
        if _is_better(through, best):
            best = through
            notes = (*notes, BY_WINDOWS)
    if first.alternative is not None and not is_plausible(best):
        solver.task.say(
            "the residuals are far above what neighbouring samples scatter: "
            "another start"
        )
        with suppress(SolveError):  # it is only a second chance
            other = solver.solve_from(first.alternative())
            if _is_better(other, best):
                best = other
                notes = first.notes
    return replace(best, notes=notes)


def _optima(
    problem: LikelihoodProblem, first: StartingPoint
) -> list[LikelihoodEstimate]:
    """What the first point and the random ones lead to, side by side if asked for."""
    task = problem.task
    of_workers = replace(problem, task=replace(task, say=silent, executor=None))
    start = replace(first, alternative=None)
    values = [None, *random_values(first, problem)]
    cases = {f"start {number}": theta for number, theta in enumerate(values, 1)}
    solve = partial(_optimum_at, of_workers, start)
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


def _is_better(other: LikelihoodEstimate, best: LikelihoodEstimate) -> bool:
    """Whether the other is an optimum, and of less deviance if the best is one too."""
    is_less = other.deviance < best.deviance - SAME_DEVIANCE
    return other.is_success and (is_less or not best.is_success)


def _best(estimates: Sequence[LikelihoodEstimate]) -> LikelihoodEstimate:
    """The smallest deviance among the optima."""
    return min(estimates, key=lambda e: (not e.is_success, e.deviance))


def _agreement_note(estimates: Sequence[LikelihoodEstimate]) -> tuple[str, ...]:
    """A sentence on how many of several starts agree."""
    if len(estimates) == 1:
        return ()
    limit = _best(estimates).deviance + SAME_DEVIANCE
    n_agreeing = sum(e.is_success and e.deviance < limit for e in estimates)
    return (
        f"{n_agreeing} of {len(estimates)} starting points led to the best solution",
    )

"""How `MaximumLikelihood` is solved.

0. A simple start and full steps from there: where that leaves no more than the scatter
   of neighbouring samples, 1 to 3 are not needed.
1. Start: parameters by the PHSI loss; states from the data, or, where some are missing,
   from the missing-force program.
2. Windows, where the whole record cannot be solved or leads far off (or where they are
   asked for): pieces with free starting states.
3. The whole record, with the noise re-estimated until it stays. Each solve by
   Gauss-Newton steps, where that fails with the exact Hessian, at last along solutions
   of the model.
4. More intervals between samples, where the integration error is visible in the
   estimates.
5. Pruning, where it is asked for.
"""

from dataclasses import replace

import numpy as np

from phsi_opt.estimation.best_optimum import best_optimum
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem
from phsi_opt.estimation.likelihood_solve import LikelihoodSolver
from phsi_opt.estimation.likelihood_start import (
    first_part,
    from_data,
    from_first_part,
    from_fit,
    needs_first_part,
    simple_start,
)
from phsi_opt.estimation.problem import Task
from phsi_opt.estimation.residual_scatter import is_at_scatter, scatter_warnings
from phsi_opt.estimation.resolution_notes import resolution_notes
from phsi_opt.estimation.starting_point import StartingPoint
from phsi_opt.estimation.step_refinement import finer_steps
from phsi_opt.estimation.support_selection import pruned
from phsi_opt.model.model import Model
from phsi_opt.transcription.grid import steps_per_gap
from phsi_opt.transcription.losses import MaximumLikelihood

MOST_STEP_REFINEMENTS = 5


def by_likelihood(
    task: Task, loss: MaximumLikelihood, start: Fit | None
) -> LikelihoodEstimate:
    """The maximum of the likelihood from the best of the starting points.

    Refined where needed, and pruned.

    Raises:
        DataError: as `LikelihoodProblem.of`.
    """
    problem = LikelihoodProblem.of(task, loss)
    solver = LikelihoodSolver(problem)
    estimate = _simple_optimum(solver) if start is None else None
    if estimate is None:
        estimate = _careful_optimum(solver, start)
    if loss.steps is None and task.settings.thorough:
        estimate = _with_fine_steps(solver, estimate)
    if estimate.nearby is not None:
        estimate.release()
    estimate = _with_few_terms(solver, estimate)
    warnings = scatter_warnings(estimate, problem.noise.is_known)
    warnings += resolution_notes(estimate, problem.noise)
    if not warnings:
        return estimate  # with all that has been worked out about it
    return replace(estimate, notes=estimate.notes + warnings)


def _simple_optimum(solver: LikelihoodSolver) -> LikelihoodEstimate | None:
    """The optimum next to a simple start, where nothing is left to be explained.

    None where the steps from there lead nowhere, where the residuals are above the
    scatter of neighbouring samples, where windows or other starts were asked for, and
    where the loss has slack variables.
    """
    loss = solver.loss
    has_slacks = loss.huber is not None or any(solver.task.l1.values())
    if loss.window is not None or loss.starts > 1 or has_slacks:
        return None
    start = simple_start(solver.problem)
    if start is None:
        return None
    estimate = solver.solve_directly(start)
    if estimate is None or not is_at_scatter(estimate):
        return None
    return replace(estimate, notes=start.notes) if start.notes else estimate


def _careful_optimum(solver: LikelihoodSolver, start: Fit | None) -> LikelihoodEstimate:
    """The best optimum from starting values that were solved for, or from a fit."""
    first = _starting_point(solver.problem, start)
    # A fit to start from has been through this before.
    may_go_through_windows = (
        start is None and solver.loss.window is None and solver.task.settings.thorough
    )
    return best_optimum(solver, first, with_windows=may_go_through_windows)


def _starting_point(problem: LikelihoodProblem, start: Fit | None) -> StartingPoint:
    """At a fit, at the solution of a part of a long record, or found from scratch."""
    if start is not None:
        return from_fit(problem, start)
    if needs_first_part(problem):
        of_part = replace(problem.loss, starts=1, window=None)
        first = by_likelihood(first_part(problem.task), of_part, None)
        return from_first_part(problem, first)
    return from_data(problem)


def _with_fine_steps(
    solver: LikelihoodSolver, estimate: LikelihoodEstimate
) -> LikelihoodEstimate:
    """Solved again with finer steps until the integration error is not visible.

    Where these lead nowhere the last optimum stays, with a note.
    """
    for _ in range(MOST_STEP_REFINEMENTS):
        steps = finer_steps(estimate) if estimate.is_success else None
        if steps is None:
            break
        most = max(int(np.max(of_trajectory)) for of_trajectory in steps)
        solver.task.say(
            "integration error is visible in the estimates: "
            f"{most} steps per sample at most"
        )
        there = replace(StartingPoint.at(estimate, steps), is_optimum=True)
        estimate.release()
        finer = solver.solve(there)
        if not finer.is_success:
            return replace(estimate, notes=(*estimate.notes, _coarse(most)))
        estimate = replace(finer, notes=estimate.notes)
    return estimate


def _coarse(most: int) -> str:
    return (
        "the steps of integration are too long for these estimates, which shift with "
        f"them; with up to {most} between two samples it could not be solved. A rate "
        "of the model is far above those that the record shows: bound its parameters, "
        "or find what the model lacks (diagnose)"
    )


def _with_few_terms(
    solver: LikelihoodSolver, estimate: LikelihoodEstimate
) -> LikelihoodEstimate:
    """Pruned, with the steps of the estimate."""
    steps = steps_per_gap(estimate.grid)

    def resolve(
        known: LikelihoodEstimate,
        model: Model,
        theta: np.ndarray,
        l1: dict[str, float],
    ) -> LikelihoodEstimate:
        start = StartingPoint.at(known, steps)
        start = replace(start, model=model, theta=theta)
        return solver.solve(start, l1=l1)

    return pruned(estimate, resolve)

"""How `MaximumLikelihood` is solved.

1. Start: states from the data and the model's kinematics, parameters as they are given.
2. Full steps from there: where they leave no more than the scatter of neighbouring
   samples, 3 is not needed.
3. A missing force that shrinks leads from the crude start near a solution of the model
   (`likelihood_steps`); from there again full steps, with the noise re-estimated until
   it stays; where these do not settle, IPOPT.
4. More intervals between samples, where the integration error is visible in the
   estimates.
5. Pruning, where it is asked for.
"""

from dataclasses import replace

import numpy as np

from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem, StartingPoint
from phsi_opt.estimation.likelihood_start import crude_start, from_fit
from phsi_opt.estimation.problem import Task
from phsi_opt.estimation.residual_scatter import resolution_notes, scatter_warnings
from phsi_opt.estimation.several_starts import best_optimum
from phsi_opt.estimation.step_refinement import finer_steps
from phsi_opt.estimation.support_selection import pruned
from phsi_opt.model.model import Model
from phsi_opt.transcription.grid import steps_per_gap
from phsi_opt.transcription.losses import MaximumLikelihood


def by_likelihood(
    task: Task, loss: MaximumLikelihood, start: Fit | None
) -> LikelihoodEstimate:
    """The maximum of the likelihood from the best of the starting points.

    Refined where needed, and pruned.

    Raises:
        DataError: as `LikelihoodProblem.of`.
    """
    problem = LikelihoodProblem.of(task, loss)
    first = crude_start(problem) if start is None else from_fit(problem, start)
    estimate = best_optimum(problem, first)
    if loss.steps is None and task.settings.thorough:
        estimate = _with_fine_steps(problem, estimate)
    estimate = _with_few_terms(problem, estimate)
    warnings = scatter_warnings(estimate, problem.noise.is_known)
    warnings += resolution_notes(estimate, problem.noise.is_known, problem.noise.least)
    if not warnings:
        return estimate  # with all that has been worked out about it
    return replace(estimate, notes=estimate.notes + warnings)


def _with_fine_steps(
    problem: LikelihoodProblem, estimate: LikelihoodEstimate
) -> LikelihoodEstimate:
    """Solved again with finer steps until the integration error is not visible.

    Where these lead nowhere the last optimum stays, with a note.
    """
    for _ in range(5):
        steps = finer_steps(estimate) if estimate.is_success else None
        if steps is None:
            break
        most = max(int(np.max(of_trajectory)) for of_trajectory in steps)
        problem.task.say(
            "integration error is visible in the estimates: "
            f"{most} steps per sample at most"
        )
        there = replace(StartingPoint.at(estimate, steps), is_optimum=True)
        estimate.release()
        finer = problem.solve(there)
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
    problem: LikelihoodProblem, estimate: LikelihoodEstimate
) -> LikelihoodEstimate:
    """Pruned, with the steps of the estimate."""
    steps = steps_per_gap(estimate.grid)

    def resolve(
        model: Model,
        theta: np.ndarray,
        l1: dict[str, float],
        known: LikelihoodEstimate,
    ) -> LikelihoodEstimate:
        start = StartingPoint.at(known, steps)
        start = replace(start, model=model, theta=theta)
        return problem.solve(start, l1=l1)

    return pruned(estimate, resolve)

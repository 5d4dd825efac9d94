"""The likelihood of a record for a model that is known but for a few values.

For what is asked of a fit afterwards: the states that explain a record best, the
profile of one parameter. The noise is known and the start is near, so a brief solve is
enough; no windows, no finer steps, no pruning.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem, NoiseLevels
from phsi_opt.estimation.likelihood_solve import LikelihoodSolver
from phsi_opt.estimation.problem import Task
from phsi_opt.estimation.starting_point import StartingPoint
from phsi_opt.model.model import Model
from phsi_opt.optimization.ipopt import HOLDING
from phsi_opt.optimization.settings import FEASIBLE_PATH, GAUSS_NEWTON, SolverSettings
from phsi_opt.transcription.alignment import AlignedData
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta

BRIEF_SOLVE = SolverSettings(max_iterations=60, thorough=False)
BRIEF_ALONG_PATH = replace(BRIEF_SOLVE, ways=(FEASIBLE_PATH,))


@dataclass(frozen=True, eq=False)
class RecordLikelihood:
    """The likelihood of a record with its states, and what is free in a model, unknown.

    Attributes:
        aligned: the record.
        sigma: (n_states,) the known noise.
        loss: the likelihood.
    """

    aligned: AlignedData
    sigma: np.ndarray
    loss: MaximumLikelihood

    def maximum(
        self,
        model: Model,
        states: Sequence[np.ndarray],
        steps: Sequence[np.ndarray],
        way: str = GAUSS_NEWTON,
    ) -> LikelihoodEstimate | None:
        """The optimum; None where none is found.

        Args:
            model: with the values to start from; those that are free are estimated.
            states: (n_samples, n_states) per trajectory, at the samples, to start from.
            steps: intervals in every gap between samples, (n_samples - 1,) per
                trajectory.
            way: how the model's own fit was found, one of `WAYS`.
        """
        estimate = self._solved(BRIEF_SOLVE, model, states, steps, way)
        return estimate if estimate.is_success else None

    def start_of_run(
        self,
        model: Model,
        states: Sequence[np.ndarray],
        steps: Sequence[np.ndarray],
        way: str,
    ) -> LikelihoodEstimate | None:
        """The optimum, or what is good enough to start a free run of the model from.

        For a model that was fitted along its solutions, that is any point reached along
        them. Arguments as in `maximum`.
        """
        if way == FEASIBLE_PATH:
            estimate = self._solved(BRIEF_ALONG_PATH, model, states, steps, way)
            if estimate.solution.outcome.infeasibility < HOLDING:
                return estimate
        return self.maximum(model, states, steps, way)

    def _solved(
        self,
        settings: SolverSettings,
        model: Model,
        states: Sequence[np.ndarray],
        steps: Sequence[np.ndarray],
        way: str,
    ) -> LikelihoodEstimate:
        task = Task(model, self.aligned, l1={}, pruning=None, settings=settings)
        start = StartingPoint(
            model=model,
            theta=Theta.of(model, task.runs).spread(model.theta),
            states=tuple(states),
            sigma=self.sigma,
            steps=tuple(steps),
            way=way,
        )
        noise = NoiseLevels.known(self.sigma)
        problem = LikelihoodProblem(task, self.loss, noise)
        return LikelihoodSolver(problem).solve_from(start)

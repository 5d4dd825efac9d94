"""The likelihood of a record for a model that is known but for a few values.

For what is asked of a fit afterwards: the states that explain a record best, the
profile of one parameter. The noise is known and the start is near, so a brief solve is
enough; no windows, no finer steps, no pruning.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import (
    LikelihoodProblem,
    NoiseLevels,
    StartingPoint,
)
from phsi_opt.estimation.problem import Task
from phsi_opt.model.model import Model
from phsi_opt.optimization.settings import SolverSettings
from phsi_opt.transcription.alignment import AlignedData
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta

BRIEF_SOLVE = SolverSettings(max_iterations=60, thorough=False)


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
    ) -> LikelihoodEstimate | None:
        """The optimum; None where none is found.

        Args:
            model: with the values to start from; those that are free are estimated.
            states: (n_samples, n_states) per trajectory, at the samples, to start from.
            steps: intervals in every gap between samples, (n_samples - 1,) per
                trajectory.
        """
        task = Task(model, self.aligned, l1={}, pruning=None, settings=BRIEF_SOLVE)
        start = StartingPoint(
            model=model,
            theta=Theta.of(model, task.runs).spread(model.theta),
            states=tuple(states),
            sigma=self.sigma,
            steps=tuple(steps),
        )
        noise = NoiseLevels.known(self.sigma)
        estimate = LikelihoodProblem(task, self.loss, noise).solve_from(start)
        return estimate if estimate.is_success else None

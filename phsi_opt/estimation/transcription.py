"""A likelihood laid out: model, grid and point, and what solvers make of them.

Full steps take its numbers, IPOPT its program. A program takes longer to put together
than full steps to end, so it is made when it is asked for.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.optimization.program import Program
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.point import Point


@dataclass(frozen=True, eq=False)
class Transcription:
    """A likelihood laid out for the solvers.

    Attributes:
        loss: the likelihood.
        model: whose defects vanish.
        grid: nodes and intervals.
        unknown: names and places of the free parameters.
        point: to start from, with the scale of each unknown.
        l1: weight by slot.
        sigma: (n_states,) noise to start from.
    """

    loss: MaximumLikelihood
    model: Model
    grid: Grid
    unknown: Theta
    point: Point
    l1: Mapping[str, float]
    sigma: np.ndarray

    def __getstate__(self) -> dict[str, Any]:  # symbols cannot be pickled
        return {part.name: getattr(self, part.name) for part in fields(self)}

    @cached_property
    def program(self) -> Program:
        """The nonlinear program, put together when a solver asks for it."""
        return self.loss.program(
            self.model, self.grid, self.point, self.l1, self.sigma, self.unknown
        )

    @property
    def has_slacks(self) -> bool:
        """Whether the program has variables beside parameters and states."""
        has_l1 = bool(np.any(self.unknown.weights(self.l1) > 0))
        return self.loss.huber is not None or has_l1

    @cached_property
    def values(self) -> LikelihoodValues:
        """The likelihood in numbers, without slack variables."""
        return LikelihoodValues(
            self.model, self.grid, self.loss.integrator, self.point, self.unknown
        )

    def __str__(self) -> str:
        return (
            f"maximum likelihood, {len(self.unknown)} parameters, "
            f"{self.point.x.size} states"
        )

"""From a crude start to a solution of the model, along a missing force that shrinks.

::

    minimise  1/N sum ((y - h(x))/sigma)^2 + 1/N sum (d / q)^2   over theta and x

with d the defects of the measured states and q their size; those of the others are
zero, so that they follow the measured ones as an observer does. (A force in their
equations could shrink with them: from a position alone the scale of the momentum is
open.) Where q is as large as the rates of the states, these follow the data and the
parameters the regression of their rates: nearly a linear problem, whatever the start.
As q falls the states become a solution of the model, and each optimum is the start of
the next: a homotopy, whose end is the likelihood. Each step is one banded
factorisation. It is halved where it does not lower the objective, then damped in the
parameters (Levenberg 1944, Marquardt 1963).
"""

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phsi_opt.errors import SolveError
from phsi_opt.interrupts import solving
from phsi_opt.optimization.bounded_step import Room
from phsi_opt.transcription.likelihood_values import (
    LikelihoodValues,
    PointValues,
    WeighedValues,
)
from phsi_opt.transcription.optimality_system import NewtonStep

# Sizes of the force, as a share of each state's own rate.
FORCE_SIZES = (1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5)
MOST_STEPS_OF_A_SIZE = 30
PRICE = 2.0  # of a unit of defect, over the largest multiplier: an exact penalty
MOST_HALVINGS = 6  # of a step that does not lower the objective
LEAST_FALL = 1e-3  # relative fall of the objective at which the next size is taken
RETRY_DAMPING = 1e-3  # share of the parameters' curvature, after a step that failed
DAMPING_GROWTH = 10.0
LARGEST_DAMPING = 1e8


@dataclass(frozen=True, eq=False)
class _Place:
    """A point, its values, and the objective with the force."""

    z: np.ndarray
    values: PointValues
    weighed: WeighedValues
    objective: float


@dataclass(frozen=True, eq=False)
class Continuation:
    """Steps of a likelihood beside a missing force.

    Attributes:
        likelihood: its values; variables are theta and the states alone.
    """

    likelihood: LikelihoodValues

    def end(self, z: np.ndarray, sigma: np.ndarray) -> np.ndarray | None:
        """Scaled variables that nearly solve the model; None: no number leads there.

        Args:
            z: scaled variables to start from.
            sigma: (n_states,) noise.
        """
        for size in FORCE_SIZES:
            settled = self._settled(z, sigma, (size * self._rates) ** 2)
            if settled is None:
                return None
            z = settled
        return z

    @cached_property
    def _rates(self) -> np.ndarray:
        """Size of each scaled defect if a measured state's own rate were missing."""
        likelihood = self.likelihood
        grid, point = likelihood.grid, likelihood.point
        rate = np.sqrt(np.mean(grid.rates(point.x) ** 2, axis=0))
        relative = rate / point.x_scale
        moving = relative[relative > 0]
        typical = np.median(moving) if len(moving) else 1 / np.ptp(grid.t)
        # A state that stands still in the start is as fast as the others.
        rate = np.where(rate > 0, rate, typical * point.x_scale)
        rate = np.where(grid.measured.any(axis=0), rate, 0.0)
        return np.asarray((rate * grid.h[:, None] / point.x_scale).ravel())

    def _settled(
        self, z: np.ndarray, sigma: np.ndarray, variance: np.ndarray
    ) -> np.ndarray | None:
        """The optimum beside a force of one variance (n_constraints,)."""
        place = self._at(z, sigma, variance)
        damping = 0.0
        for _ in range(MOST_STEPS_OF_A_SIZE):
            step = self._step(place, variance, damping)
            if step is None:
                return None
            there = self._lower(place, step, sigma, variance)
            if there is None:
                damping = max(DAMPING_GROWTH * damping, RETRY_DAMPING)
                if damping > LARGEST_DAMPING:
                    break
                continue
            is_settled = (
                place.objective - there.objective < LEAST_FALL * place.objective
            )
            place = there
            if is_settled:
                break
            damping = damping / DAMPING_GROWTH if damping > RETRY_DAMPING else 0.0
        return place.z

    def _lower(
        self,
        place: _Place,
        step: NewtonStep,
        sigma: np.ndarray,
        variance: np.ndarray,
    ) -> _Place | None:
        """The first place along a step, halved again and again, that is lower.

        Defects of the equations without a force count at a price above their
        multipliers (an exact penalty).
        """
        without = variance == 0
        price = PRICE * float(np.max(np.abs(step.multipliers[without]), initial=0.0))

        def cost(at: _Place) -> float:
            return at.objective + price * float(np.sum(np.abs(at.values.g[without])))

        change = step.z
        for _ in range(MOST_HALVINGS):
            there = self._at(self._moved(place.z, change), sigma, variance)
            if cost(there) <= cost(place):
                return there
            change = change / 2
        return None

    def _at(self, z: np.ndarray, sigma: np.ndarray, variance: np.ndarray) -> _Place:
        with solving(), np.errstate(all="ignore"):
            values = self.likelihood.at(z)
            weighed = self.likelihood.weighed(values, sigma)
            g = values.g[variance > 0]
            of_force = float(np.sum(g**2 / variance[variance > 0]))
        of_force /= weighed.residual.size
        return _Place(z, values, weighed, weighed.objective + of_force)

    def _step(
        self, place: _Place, variance: np.ndarray, damping: float
    ) -> NewtonStep | None:
        """The step beside a force; None where there is none."""
        own = slice(self.likelihood.system.n_theta)
        likelihood = self.likelihood
        room = Room.at(place.z[own], likelihood.lower[own], likelihood.upper[own])
        softness = variance * place.weighed.residual.size / 2
        with suppress(SolveError, np.linalg.LinAlgError, ValueError):
            factored = self.likelihood.system.softened(
                place.weighed.hessian, place.values.jacobian, softness
            )
            return factored.step(
                place.weighed.gradient, place.values.g, room, damping=damping
            )
        return None

    def _moved(self, z: np.ndarray, step: np.ndarray) -> np.ndarray:
        """After the step, within the bounds."""
        return np.clip(z + step, self.likelihood.lower, self.likelihood.upper)

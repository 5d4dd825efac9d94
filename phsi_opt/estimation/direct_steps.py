"""Full Gauss-Newton steps of a likelihood, its noise re-estimated on the way.

From a good start they find the optimum in a few iterations, each of which costs one
evaluation of the slopes and one banded factorisation: no barrier, no line search, and
no solve of its own for every estimate of the noise. Nothing is forced. Where steps do
not contract, or end at a bound, there is no result, and IPOPT begins where it would
have begun.
"""

import time
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phsi_opt.errors import SolveError
from phsi_opt.estimation.noise_estimation import NoiseIteration
from phsi_opt.interrupts import solving
from phsi_opt.optimization.endings import STEPS_OPTIMUM
from phsi_opt.optimization.ipopt import KKT, Solution, names_at_bounds
from phsi_opt.optimization.outcome import Outcome
from phsi_opt.optimization.settings import SolverSettings
from phsi_opt.transcription.likelihood_values import (
    LikelihoodValues,
    PointValues,
    WeighedValues,
)
from phsi_opt.transcription.optimality_system import NewtonStep, OptimalitySystem

MOST_DIRECT_STEPS = 12
# Scaled defect up to which the residuals say something about the noise.
NEARLY_HOLDING = 1e-2
# Share of the error that a step leaves, at most; the first steps find their way.
CONTRACTION = 0.7
FREE_STEPS = 3
# Error of a step, and share of it that the next one leaves, up to which that may take
# its curvature and slopes: it then costs a third.
AGAIN = 0.03
# Share of the way to a bound that a step goes at most: bounds are not crossed, and an
# optimum at one is not found here.
TO_BOUND = 0.99


@dataclass(frozen=True, eq=False)
class Optimum:
    """A solution, and the noise that its residuals show.

    Attributes:
        solution: of the program with that noise.
        sigma: (n_states,).
    """

    solution: Solution
    sigma: np.ndarray


@dataclass(frozen=True, eq=False)
class _Place:
    """A point, and what the likelihood is there.

    Attributes:
        z: scaled variables.
        sigma: noise for which the rest holds.
        values: what does not depend on the noise.
        weighed: what does.
    """

    z: np.ndarray
    sigma: np.ndarray
    values: PointValues
    weighed: WeighedValues

    @property
    def violation(self) -> float:
        """The largest scaled defect."""
        return float(np.max(np.abs(self.values.g), initial=0.0))

    @property
    def is_finite(self) -> bool:
        """Whether the model has values and slopes here."""
        of_slopes = np.sum(self.values.jacobian) + np.sum(self.weighed.gradient)
        whole = self.violation + self.weighed.objective + of_slopes
        return bool(np.isfinite(whole))


@dataclass(frozen=True, eq=False)
class DirectSteps:
    """Steps of a likelihood whose variables are theta and the states alone.

    Attributes:
        likelihood: its values.
        settings: tolerance of the scaled optimality conditions, and limits.
    """

    likelihood: LikelihoodValues
    settings: SolverSettings

    @cached_property
    def _system(self) -> OptimalitySystem:
        likelihood = self.likelihood
        return OptimalitySystem(
            likelihood.grid,
            likelihood.n_states,
            likelihood.hessian,
            likelihood.jacobian,
        )

    def optimum(
        self, z: np.ndarray, sigma: np.ndarray, noise: NoiseIteration
    ) -> Optimum | None:
        """The optimum and the noise that its residuals show; None: not found.

        Args:
            z: scaled variables to start from.
            sigma: (n_states,) noise to start from.
            noise: re-estimates what is not given.
        """
        began = time.perf_counter()
        place = self._at(z, sigma)
        errors: list[float] = []
        step: NewtonStep | None = None
        is_same = False  # the likelihood, since the last step
        most = min(MOST_DIRECT_STEPS, self.settings.max_iterations)
        for n_steps in range(1, most + 1):
            step = self._step_again(place, step, errors) if is_same else None
            step = step or self._step(place)
            is_late = time.perf_counter() - began > self.settings.max_seconds
            if step is None or is_late:
                return None
            errors.append(place.violation + self._length(place, step))
            if not _contracts(errors):
                return None
            place = self._at(self._moved(place.z, step.z), place.sigma)
            is_same = False
            if not place.violation < NEARLY_HOLDING:
                continue
            updated = noise.updated(place.sigma, place.weighed.residual)
            has_settled = noise.has_settled(place.sigma, updated)
            if has_settled and self._is_optimal(place, step):
                return self._optimum_at(place, updated, n_steps, began)
            is_same = has_settled
            if not has_settled:
                place = self._with_noise(place, updated)
        return None

    def _step_again(
        self, place: _Place, last: NewtonStep | None, errors: list[float]
    ) -> NewtonStep | None:
        """A step by the curvature of the one before; None where it contracts less."""
        if last is None or errors[-1] > AGAIN:
            return None
        gradient = self._lagrangian_gradient(place, last)
        step = self._system.step_again(gradient, place.values.g, last.multipliers)
        error = place.violation + self._length(place, step)
        return step if error < AGAIN * errors[-1] else None

    def _step(self, place: _Place) -> NewtonStep | None:
        """The full step; None where there is none."""
        if not place.is_finite:
            return None
        with suppress(SolveError, np.linalg.LinAlgError):
            return self._system.step(
                place.weighed.hessian,
                place.values.jacobian,
                place.weighed.gradient,
                place.values.g,
            )
        return None

    def _length(self, place: _Place, step: NewtonStep) -> float:
        """Of a step, in units of the objective's root."""
        curvature = self._system.curvature(place.weighed.hessian, step.z)
        return float(np.sqrt(max(curvature, 0.0)))

    def _is_optimal(self, place: _Place, step: NewtonStep) -> bool:
        """Whether the conditions hold behind a step, with its multipliers."""
        gradient = self._lagrangian_gradient(place, step)
        error = max(float(np.max(np.abs(gradient))), place.violation)
        return error < self.settings.tolerance

    def _lagrangian_gradient(self, place: _Place, step: NewtonStep) -> np.ndarray:
        """At a place, with the multipliers of the step that led there."""
        return self._system.lagrangian_gradient(
            place.weighed.gradient, place.values.jacobian, step.multipliers
        )

    def _moved(self, z: np.ndarray, step: np.ndarray) -> np.ndarray:
        """After the step, or the part of it that stays within the bounds."""
        likelihood = self.likelihood
        room = np.where(step > 0, likelihood.upper - z, z - likelihood.lower)
        crosses = np.abs(step) > TO_BOUND * room
        if not crosses.any():
            return z + step
        shares = TO_BOUND * room[crosses] / np.abs(step[crosses])
        return z + max(float(np.min(shares)), 0.0) * step

    def _at(self, z: np.ndarray, sigma: np.ndarray) -> _Place:
        with solving(), np.errstate(all="ignore"):
            values = self.likelihood.at(z)
            weighed = self.likelihood.weighed(values, sigma)
        return _Place(z, sigma, values, weighed)

    def _with_noise(self, place: _Place, sigma: np.ndarray) -> _Place:
        """The same point with other noise."""
        weighed = self.likelihood.weighed(place.values, sigma)
        return _Place(place.z, sigma, place.values, weighed)

    def _optimum_at(
        self, place: _Place, sigma: np.ndarray, n_steps: int, began: float
    ) -> Optimum:
        """At a place, with the noise that its residuals show."""
        likelihood = self.likelihood
        place = self._with_noise(place, sigma)
        bounds = (likelihood.lower, likelihood.upper)
        outcome = Outcome(
            success=STEPS_OPTIMUM.is_usable,
            status=STEPS_OPTIMUM.status,
            sentence=STEPS_OPTIMUM.sentence,
            advice=STEPS_OPTIMUM.advice,
            iterations=n_steps,
            seconds=time.perf_counter() - began,
            objective=place.weighed.objective,
            infeasibility=place.violation,
            at_bounds=names_at_bounds(likelihood.unknown.names, place.z, bounds),
        )
        hessian = likelihood.hessian.symmetric(place.weighed.hessian)
        jacobian = likelihood.jacobian.filled(place.values.jacobian)
        values = likelihood.point.unscaled(place.z)
        kkt = KKT(hessian, jacobian)
        solution = Solution(values, place.z, place.weighed.residual, outcome, kkt)
        return Optimum(solution, sigma)


def _contracts(errors: list[float]) -> bool:
    """Whether the last step left less of the error than the one before."""
    if not np.isfinite(errors[-1]):
        return False
    if len(errors) <= FREE_STEPS:
        return True
    return errors[-1] < CONTRACTION * errors[-2]

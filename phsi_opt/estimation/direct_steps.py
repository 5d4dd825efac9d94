"""Full Gauss-Newton steps of a likelihood, its noise re-estimated on the way.

From a good start they find the optimum in a few iterations, each of which costs one
evaluation of the slopes and one banded factorisation: no barrier, no line search, and
no solve of its own for every estimate of the noise. A parameter that a step presses
against its bound is held there, and the others move with it. Steps that leave a share
of the error each are mixed. Nothing is forced. Where steps do not contract, and where
beside a parameter at its bound the data are silent about another one, there is no
result, and IPOPT begins where it would have begun.
"""

import time
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from phsi_opt.errors import SolveError
from phsi_opt.estimation.noise_estimation import NoiseIteration
from phsi_opt.interrupts import solving
from phsi_opt.later import Later
from phsi_opt.optimization.bounded_step import SILENT, Room
from phsi_opt.optimization.endings import STEPS_OPTIMUM
from phsi_opt.optimization.ipopt import KKT, Solution, names_at_bounds
from phsi_opt.optimization.mixed_steps import MixedSteps
from phsi_opt.optimization.outcome import Outcome
from phsi_opt.optimization.settings import FEASIBLE_PATH, SolverSettings
from phsi_opt.transcription.elimination import ReducedSystem
from phsi_opt.transcription.likelihood_values import (
    LikelihoodValues,
    PointValues,
    WeighedValues,
)
from phsi_opt.transcription.optimality_system import (
    Factored,
    NewtonStep,
    OptimalitySystem,
)

MOST_DIRECT_STEPS = 20
# Scaled defect up to which the residuals say something about the noise, and steps what
# they converge to.
NEARLY_HOLDING = 1e-2
# Curvature that defects of size 1 may bring about, as a share of the largest one.
CURVED_BY_DEFECTS = 1e-3
# Share of the error that two steps leave, at most; the first steps find their way.
CONTRACTION = 0.7
FREE_STEPS = 5
# Error of a step, and share of it that the next one leaves, up to which that may take
# its factors: it then costs a third, or next to nothing where factors are dear.
AGAIN = 0.03
AGAIN_IF_DEAR = 0.2
# Share of the way to a bound that a step goes at most where states have one, or where
# the model has no values at it.
TO_BOUND = 0.99
BESIDE_BOUND = 1e-12  # distance from a bound that is none


@dataclass(frozen=True, eq=False)
class Optimum:
    """A solution, and the noise that its residuals show.

    Attributes:
        solution: of the program with that noise.
        sigma: (n_states,).
        nearby: the program linearised at the last place on the way that was factored,
            its states eliminated; None: not known.
    """

    solution: Solution
    sigma: np.ndarray
    nearby: ReducedSystem | None = None


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

    @cached_property
    def violation(self) -> float:
        """The largest scaled defect."""
        return float(np.max(np.abs(self.values.g), initial=0.0))

    @property
    def silent_share(self) -> float:
        """Share of the largest curvature below which a direction is silent.

        Defects that do not hold curve directions about which the data say nothing.
        """
        return max(SILENT, CURVED_BY_DEFECTS * self.violation)

    @property
    def nearly_holds(self) -> bool:
        """Whether the residuals and the steps tell more than what the defects do."""
        return self.violation < NEARLY_HOLDING

    @cached_property
    def is_finite(self) -> bool:
        """Whether the model has values and slopes here."""
        with np.errstate(all="ignore"):
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
    def _bounds(self) -> list[tuple[np.ndarray, np.ndarray, int]]:
        """Variables with a lower bound, it and 1; the same of upper ones, and -1."""
        sides = []
        for bound, inwards in ((self.likelihood.lower, 1), (self.likelihood.upper, -1)):
            places = np.flatnonzero(np.isfinite(bound))
            sides.append((places, bound[places], inwards))
        return sides

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
        mixed = MixedSteps()
        stepper = _Stepper(self.likelihood.system)
        step: NewtonStep | None = None
        is_same = False  # the likelihood, since the last step
        errors: list[float] = []
        most = min(MOST_DIRECT_STEPS, self.settings.max_iterations)
        for n_steps in range(1, most + 1):
            error = errors[-1] if errors else np.inf
            step = stepper.step(place, self._room(place.z), step, error, is_same)
            is_late = time.perf_counter() - began > self.settings.max_seconds
            if step is None or is_late:
                return None
            errors.append(_error(self.likelihood.system, place, step))
            if not _contracts(errors):
                return None
            if stepper.is_again or not place.nearly_holds:
                mixed.forget()
            else:
                step = self._mixed(mixed, place, step)
            place = self._after(place, step)
            is_same = False
            if not place.nearly_holds:
                continue
            updated = noise.updated(place.sigma, place.weighed.residual)
            has_settled = noise.has_settled(place.sigma, updated)
            if has_settled and self._is_optimal(place, step):
                is_slow = mixed.share > CONTRACTION
                # Beside a sharp corner there are many optima, which creeping ends at.
                if is_slow and FEASIBLE_PATH in self.settings.ways:
                    return None
                found = self._optimum_at(place, updated, n_steps, began, is_slow)
                # What is silent beside a bound may lead inside where it is another one.
                is_held = bool(found.solution.outcome.at_bounds)
                if is_held and step.is_silent:
                    return None
                return replace(found, nearby=self._reduced(stepper))
            is_same = has_settled
            if not has_settled:
                mixed.forget()
                place = self._with_noise(place, updated)
        return None

    def _reduced(self, stepper: "_Stepper") -> ReducedSystem | None:
        """The program at the last place that was factored."""
        if stepper.factored is None:
            return None
        return stepper.factored.reduced(self.likelihood.grid, self.likelihood.n_states)

    def _after(self, place: _Place, step: NewtonStep) -> _Place:
        """Where the step leads; beside a bound at which the model has no values."""
        there = self._at(self._moved(place.z, step.z), place.sigma)
        if there.is_finite:
            return there
        return self._at(self._moved(place.z, TO_BOUND * step.z), place.sigma)

    def _room(self, z: np.ndarray) -> Room:
        """How far the parameters may move from z, (n_variables,)."""
        own = slice(self.likelihood.system.n_theta)
        likelihood = self.likelihood
        return Room.at(z[own], likelihood.lower[own], likelihood.upper[own])

    def _mixed(self, mixed: MixedSteps, place: _Place, step: NewtonStep) -> NewtonStep:
        """The step, mixed with those before it; not one that states cut short."""
        n = len(place.z)
        if self._share(place.z, step.z) < 1:
            mixed.forget()
            return step

        def times(z: np.ndarray) -> np.ndarray:
            return self.likelihood.system.times(place.weighed.hessian, z)

        end = np.concatenate([place.z + step.z, step.multipliers])
        end = mixed.end(step.z, end, times)
        return NewtonStep(end[:n] - place.z, end[n:], step.is_silent)

    def _is_optimal(self, place: _Place, step: NewtonStep) -> bool:
        """Whether the conditions hold behind a step, with its multipliers.

        What presses a parameter against its bound is the bound's multiplier.
        """
        gradient = self.likelihood.system.lagrangian_gradient(
            place.weighed.gradient, place.values.jacobian, step.multipliers
        )
        own = gradient[: self.likelihood.system.n_theta]
        own[self._room(place.z).is_pressed(own)] = 0.0
        error = max(float(np.max(np.abs(gradient))), place.violation)
        return error < self.settings.tolerance

    def _share(self, z: np.ndarray, step: np.ndarray) -> float:
        """The part of a step that keeps states within their bounds."""
        likelihood = self.likelihood
        if likelihood.point.x_bounds is None:
            return 1.0
        room = np.where(step > 0, likelihood.upper - z, z - likelihood.lower)
        of_states = slice(self.likelihood.system.n_theta, None)
        room, size = room[of_states], np.abs(step[of_states])
        crosses = size > TO_BOUND * room
        shares = TO_BOUND * room[crosses] / size[crosses]
        return max(float(np.min(shares, initial=1.0)), 0.0)

    def _moved(self, z: np.ndarray, step: np.ndarray) -> np.ndarray:
        """After the step, or that part of it; what reaches a bound is put on it."""
        moved = z + self._share(z, step) * step
        for places, bound, inwards in self._bounds:
            there = moved[places]
            close = BESIDE_BOUND * (1 + np.abs(bound))
            is_there = inwards * (there - bound) <= close
            moved[places] = np.where(is_there, bound, there)
        return moved

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
        self,
        place: _Place,
        sigma: np.ndarray,
        n_steps: int,
        began: float,
        is_slow: bool,
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
            is_exact=is_slow,
        )
        values = likelihood.point.unscaled(place.z)
        kkt = Later(partial(self._kkt, place))
        solution = Solution(values, place.z, place.weighed.residual, outcome, kkt)
        return Optimum(solution, sigma)

    def _kkt(self, place: _Place) -> KKT:
        likelihood = self.likelihood
        return KKT(
            likelihood.hessian.symmetric(place.weighed.hessian),
            likelihood.jacobian.filled(place.values.jacobian),
        )


class _Stepper:
    """Steps from place to place; factors serve again as long as they lead on fast.

    Args:
        system: of the program.

    Attributes:
        is_again: whether the last step is by factors of an earlier place.
        factored: the system at the last place where it was; None before.
    """

    def __init__(self, system: OptimalitySystem) -> None:
        self._system = system
        self.factored: Factored | None = None
        self.is_again = False
        self._silent_share = SILENT  # of the place where the system was factored

    def step(
        self,
        place: _Place,
        room: Room,
        last: NewtonStep | None,
        error: float,
        is_same: bool,
    ) -> NewtonStep | None:
        """The step, with all multipliers; None where there is none.

        Args:
            place: from which it goes.
            room: how far the parameters may move.
            last: the step that led there; None at the start.
            error: of the place before.
            is_same: whether the noise is that of the place before.
        """
        self.is_again = False
        if not place.is_finite:
            return None
        factored = self.factored
        if factored is not None and last is not None and (is_same or factored.is_dear):
            again = self._again(factored, place, room, last, error)
            if again is not None:
                self.is_again = True
                return again
        factored = self.factored = None  # many states leave no room for those before
        self._silent_share = place.silent_share
        with suppress(SolveError, np.linalg.LinAlgError):
            self.factored = self._system.factored(
                place.weighed.hessian, place.values.jacobian
            )
            return self.factored.step(
                place.weighed.gradient, place.values.g, room, self._silent_share
            )
        return None

    def _again(
        self,
        factored: Factored,
        place: _Place,
        room: Room,
        last: NewtonStep,
        error: float,
    ) -> NewtonStep | None:
        """By factors of an earlier place, to the same end; None where they lead on
        less fast.
        """
        most = AGAIN_IF_DEAR if factored.is_dear else AGAIN
        if error > most:
            return None
        gradient = self._system.lagrangian_gradient(
            place.weighed.gradient, place.values.jacobian, last.multipliers
        )
        step = factored.step(gradient, place.values.g, room, self._silent_share)
        if not _error(self._system, place, step) < most * error:
            return None
        return replace(step, multipliers=last.multipliers + step.multipliers)


def _error(system: OptimalitySystem, place: _Place, step: NewtonStep) -> float:
    """Of a place from which a step leads on, in units of the objective's root."""
    curvature = step.z @ system.times(place.weighed.hessian, step.z)
    return place.violation + float(np.sqrt(max(curvature, 0.0)))


def _contracts(errors: list[float]) -> bool:
    """Whether the last two steps left less of the error than there was before them."""
    if not np.isfinite(errors[-1]):
        return False
    if len(errors) <= FREE_STEPS:
        return True
    return errors[-1] < CONTRACTION * errors[-3]

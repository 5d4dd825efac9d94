"""Parameters, states and disturbances together, where they are most likely.

::

    minimise   1/2 |(y - h(x, theta) - v) / sigma|^2 + 1/2 |w, v, c|^2_prior
    over       theta, x, forces w, errors v of sensors, coefficients c of functions
    subject to d(x, theta) = B w + Phi c

The sizes of noise and disturbances are given (`Disturbances`). Each step linearises the
record and goes to the optimum of what is then linear, by one banded factorisation
(Gauss and Newton). It has to lower the objective, in which what the dynamics are
violated by has a price above their multipliers (an exact penalty; Han, J. Optimization
Theory and Applications 22, 1977). Else it is corrected for the curvature that was met
(Maratos; Nocedal and Wright, Numerical Optimization, 2006, chapter 18), halved, and at
last damped.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from phsi_opt.interrupts import solving
from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.linearization import Linearization, linearized
from phsi_opt.model_error.marginal_likelihood import (
    MarginalLikelihood,
    Smoothed,
    noise_weights,
)
from phsi_opt.transcription.likelihood_values import LikelihoodValues, PointValues

# Share of the parameters' information that is added to it where no part of a step leads
# down (Levenberg 1944, Marquardt 1963).
LEAST_STEP_DAMPING = 1e-2
STEP_DAMPING_GROWTH = 10.0
MOST_STEP_DAMPING = 1e6
ARMIJO = 0.1  # share of what a step promises to lower that it has to
# Steps whose objectives are level (log likelihoods) beside a kink of the model, where
# no step is short, and the violation up to which the dynamics then hold.
LAST_STEPS = 8
LEVEL_OBJECTIVE = 0.025
NEARLY_HELD = 1e-2
PRICE = 2.0  # of a unit of violation, over the largest multiplier
MOST_SHORTENINGS = 8
# Length of a step in standard deviations of what is unknown, and largest violation of
# the scaled dynamics, at which the steps end.
SETTLED_LENGTH = 1e-4
# Length up to which a step is taken whole: what it gains is beyond the accuracy of
# numbers.
SHORT_STEP = 1e-2
SETTLED_VIOLATION = 1e-7


@dataclass(frozen=True, eq=False)
class JointPoint:
    """A point: parameters, states and disturbances.

    Attributes:
        z: (n_variables,) scaled parameters and states.
        processes: (n_inner,) values of all processes, forces first.
        coefficients: (n_coefficients,) of the functions of states.
    """

    z: np.ndarray
    processes: np.ndarray
    coefficients: np.ndarray

    def towards(self, other: "JointPoint", share: float) -> "JointPoint":
        """The point at a share of the way to another one."""
        return JointPoint(
            self.z + share * (other.z - self.z),
            self.processes + share * (other.processes - self.processes),
            self.coefficients + share * (other.coefficients - self.coefficients),
        )


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """Where the steps ended.

    Attributes:
        point: there.
        linear: the record linearised there.
        residual: (n_values,) measured less shown, errors of sensors included.
        violation: the largest of the scaled dynamics.
        n_steps: how many there were.
        has_converged: whether the last step was short.
        length: of the last step, in standard deviations of what is unknown.
    """

    point: JointPoint
    linear: Linearization
    residual: np.ndarray
    violation: float
    n_steps: int
    has_converged: bool
    length: float


@dataclass(frozen=True, eq=False)
class JointProblem:
    """A record whose disturbances have given sizes.

    Attributes:
        values: the likelihood of parameters and states.
        disturbances: with their sizes and times.
        moving: (n_moving,) places of the parameters that are free to move.
    """

    values: LikelihoodValues
    disturbances: Disturbances
    moving: np.ndarray

    def optimum(
        self, z: np.ndarray, most_steps: int, beside: JointPoint | None = None
    ) -> JointEstimate:
        """The most likely point, as far as the steps lead there.

        Args:
            z: (n_variables,) scaled parameters and states to start from.
            most_steps: at most.
            beside: disturbances to start from; None: there are none.

        Raises:
            SolveError: the states do not follow from the data.
        """
        place = _Place.of(self, z, beside)
        n_steps = 0
        has_converged = False
        damping = 0.0
        length = np.inf
        objectives: list[float] = []
        while not has_converged and n_steps < most_steps:
            n_steps += 1
            aim = place.aim(damping)
            length = aim.length
            there = self._lower(place, aim)
            if there is None:
                damping = max(STEP_DAMPING_GROWTH * damping, LEAST_STEP_DAMPING)
                if damping > MOST_STEP_DAMPING or not len(self.moving):
                    break
                continue
            is_whole = damping == 0
            damping = (
                damping / STEP_DAMPING_GROWTH if damping > LEAST_STEP_DAMPING else 0.0
            )
            place = there
            is_short = is_whole and aim.length < SETTLED_LENGTH
            has_converged = is_short and place.violation < SETTLED_VIOLATION
            objectives.append(place.cost(0.0))
            if _is_level(objectives) and place.violation < NEARLY_HELD:
                has_converged = True
        return JointEstimate(
            point=place.point,
            linear=place.linear,
            residual=place.residual,
            violation=place.violation,
            n_steps=n_steps,
            has_converged=has_converged,
            length=length,
        )

    def _lower(self, place: "_Place", aim: "_Aim") -> "_Place | None":
        """The first place on the way to the aim, halved again and again, that is lower.

        None where there is none.
        """
        price = PRICE * aim.largest_multiplier
        cost = place.cost(price)
        promise = ARMIJO * (cost - place.cost(0.0) + aim.length**2 / 2)
        if aim.length < SHORT_STEP:
            promise = -np.inf
        share = 1.0
        for _ in range(MOST_SHORTENINGS):
            there = self._moved(place, place.point.towards(aim.point, share))
            if there.cost(price) < cost - share * promise:
                return there.renewed()
            again = there.corrected() if share == 1 else None
            if again is not None:
                there = self._moved(there, again)
                if there.cost(price) < cost - promise:
                    return there.renewed()
            share /= 2
        return None

    def _moved(self, place: "_Place", point: JointPoint) -> "_Place":
        """At a point, or beside it within the bounds."""
        point = replace(point, z=self._within(point.z))
        return replace(place, point=point, known=self._at(point.z))

    def _at(self, z: np.ndarray) -> PointValues:
        with solving(), np.errstate(all="ignore"):
            return self.values.at(z)

    def _within(self, z: np.ndarray) -> np.ndarray:
        return np.clip(z, self.values.lower, self.values.upper)


@dataclass(frozen=True, eq=False)
class _Aim:
    """The optimum of a linearised record.

    Attributes:
        point: there.
        length: of the way there, in standard deviations.
        largest_multiplier: of the dynamics.
    """

    point: JointPoint
    length: float
    largest_multiplier: float


@dataclass(frozen=True, eq=False)
class _Place:
    """A point beside the record linearised near by.

    Attributes:
        problem: that is solved.
        point: parameters, states and disturbances.
        known: defects and what is shown at the point.
        likelihood: of the record linearised there.
    """

    problem: JointProblem
    point: JointPoint
    known: PointValues
    likelihood: MarginalLikelihood

    @classmethod
    def of(
        cls, problem: JointProblem, z: np.ndarray, beside: JointPoint | None
    ) -> "_Place":
        """Of a start."""
        known = problem._at(z)
        likelihood = _likelihood_at(problem, z, known)
        if beside is None:
            n_x = likelihood.problem.nodes.size
            processes = np.zeros(likelihood.n_unknowns - n_x)
            beside = JointPoint(z, processes, np.zeros(likelihood.n_coefficients))
        return cls(problem, replace(beside, z=z), known, likelihood)

    def renewed(self) -> "_Place":
        """The same place, the record linearised here, functions of states as before."""
        along = self.linear.states_of_functions
        likelihood = _likelihood_at(self.problem, self.point.z, self.known, along)
        return replace(self, likelihood=likelihood)

    @property
    def linear(self) -> Linearization:
        """The record linearised near by."""
        return self.likelihood.problem

    @cached_property
    def _inner(self) -> np.ndarray:
        """The values of the processes among all unknowns, (n_unknowns,)."""
        still = np.zeros(self.linear.nodes.size)
        return np.concatenate([still, self.point.processes])

    @cached_property
    def residual(self) -> np.ndarray:
        """Measured less shown, errors of sensors included, (n_values,)."""
        residual: np.ndarray = self.known.misfit - self.likelihood.shown @ self._inner
        return residual

    @cached_property
    def _excess(self) -> np.ndarray:
        """Defects less what the disturbances do to the dynamics, scaled."""
        likelihood = self.likelihood
        by_forces = likelihood.dynamics_of_processes(self._inner[:, None])[:, 0]
        by_functions = likelihood.dynamics_of_functions(self.point.coefficients)
        excess: np.ndarray = self.known.g + by_functions - by_forces
        return excess

    @property
    def violation(self) -> float:
        """The largest violation of the dynamics."""
        return float(np.max(np.abs(self._excess), initial=0.0))

    def cost(self, price: float) -> float:
        """The objective, and the violation of the dynamics at its price.

        Infinite where values or slopes are no numbers.
        """
        known = self.known
        if not np.isfinite(np.sum(known.jacobian) + np.sum(known.slopes)):
            return np.inf
        point = self.point
        squares = self._squares(self.residual, point.processes, point.coefficients)
        cost = squares / 2 + price * float(np.sum(np.abs(self._excess)))
        return cost if np.isfinite(cost) else np.inf

    def _squares(
        self, shown: np.ndarray, processes: np.ndarray, coefficients: np.ndarray
    ) -> float:
        """Of values over their noise, and of disturbances in units of their priors."""
        likelihood = self.likelihood
        disturbances = self.problem.disturbances
        weighted = noise_weights(self.linear, disturbances.sigma) * shown
        sizes = likelihood.coefficient_sizes(disturbances)
        total = np.sum(weighted**2) + np.sum((coefficients / sizes) ** 2)
        whiteners = likelihood.whiteners(disturbances)
        every = disturbances.processes
        first = 0
        for process, whitener in zip(every, whiteners, strict=True):
            own = processes[first : first + len(whitener.diagonal)]
            total += np.sum((whitener.whitened(own) / process.size) ** 2)
            first += len(own)
        return float(total)

    def aim(self, damping: float) -> _Aim:
        """The optimum of the record linearised here, or with damping before it.

        Raises:
            SolveError: the states do not follow from the data.
        """
        found = self.likelihood.smoothed(self.problem.disturbances, damping)
        point = self._stepped(found)
        return _Aim(point, self._length(found, point), found.largest_multiplier)

    def corrected(self) -> JointPoint | None:
        """The optimum by the slopes of the place before: what curvature made is undone.

        None where a value is no number.
        """
        if not np.isfinite(self.violation):
            return None
        known = self.known
        other = self.likelihood.at_values(known.misfit, known.g)
        return self._stepped(other.smoothed(self.problem.disturbances))

    def _stepped(self, found: Smoothed) -> JointPoint:
        step = np.concatenate([found.theta, found.x.ravel()])
        return JointPoint(
            z=self.point.z + step,
            processes=_joined(found.processes),
            coefficients=_joined(found.coefficients),
        )

    def _length(self, found: Smoothed, aim: JointPoint) -> float:
        """Of a step, in standard deviations of what it changes."""
        processes = aim.processes - self.point.processes
        coefficients = aim.coefficients - self.point.coefficients
        likelihood = self.likelihood
        moved = likelihood.shown @ np.concatenate([found.x.ravel(), processes])
        moved = moved + self.linear.shown_in_theta @ found.theta
        return float(np.sqrt(self._squares(moved, processes, coefficients)))


def _is_level(objectives: list[float]) -> bool:
    """Whether the last steps went to and fro over a kink of the model."""
    last = objectives[-LAST_STEPS:]
    return len(last) == LAST_STEPS and float(np.ptp(last)) < LEVEL_OBJECTIVE


def _likelihood_at(
    problem: JointProblem,
    z: np.ndarray,
    known: PointValues,
    along: np.ndarray | None = None,
) -> MarginalLikelihood:
    linear = linearized(problem.values, z, known)
    linear = replace(linear, along=along, linear_share=0.0)
    structure = problem.disturbances.structure
    return MarginalLikelihood(linear, structure, problem.moving)


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    return np.concatenate(parts) if parts else np.zeros(0)

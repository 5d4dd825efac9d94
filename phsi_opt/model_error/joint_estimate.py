"""Parameters, states and disturbances together, where they are most likely.

::

    minimise   1/2 |(y - h(x, theta) - v) / sigma|^2 + 1/2 |w, v, c, theta|^2_prior
               - tilt' theta
    over       theta, x, forces w, errors v of sensors, coefficients c of functions
    subject to d(x, theta) = B w + Phi c

The sizes of noise and disturbances are given (`Disturbances`). Without a tilt all are
most likely together; with the slope of -1/2 log|det K| in theta, the volume of what is
integrated out, the parameters are most likely by themselves. Each step linearises the
record and goes to the optimum of what is then linear, by one banded factorisation
(Gauss and Newton). It has to lead where the objective or the violation of the dynamics
is lower than at every place before (a filter; Fletcher and Leyffer, Mathematical
Programming 91, 2002). Else it is corrected for the curvature that was met (Maratos;
Nocedal and Wright, Numerical Optimization, 2006, chapter 18), halved, and at last
damped. Once steps shrink slowly, as where forces are large, the curvature of the
dynamics takes part: then they are Newton's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from phsi_opt.interrupts import solving
from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.linearization import Curvature, Linearization, Linearizer
from phsi_opt.model_error.marginal_likelihood import (
    MarginalLikelihood,
    OptimalitySystem,
    Smoothed,
)
from phsi_opt.optimization.banded import FEWEST_STATES
from phsi_opt.optimization.bounded_step import REGULAR, Room
from phsi_opt.optimization.ipopt import is_level
from phsi_opt.transcription.likelihood_values import LikelihoodValues, PointValues

# Steps of a problem that others follow, with other noise or another size of the force.
STEPS_OF_A_PROBLEM = 30
# Share of a step's length that the next one has, from which curvature takes part.
SLOW = 0.3
SETTLED_VIOLATION = 1e-7  # of the scaled dynamics, at which steps end
# Violation up to which a search that did not settle is of use: beside a kink of the
# model, or for a start.
NEARLY_HELD = 1e-2


@dataclass(frozen=True, eq=False)
class JointPoint:
    """A point: parameters, states and disturbances."""

    z: np.ndarray  # (n_variables,) scaled parameters and states
    processes: np.ndarray  # (n_inner,) values of all processes, forces first
    coefficients: np.ndarray  # (n_coefficients,) of the functions of states

    def towards(self, other: "JointPoint", share: float) -> "JointPoint":
        """The point at a share of the way to another one."""
        return JointPoint(
            self.z + share * (other.z - self.z),
            self.processes + share * (other.processes - self.processes),
            self.coefficients + share * (other.coefficients - self.coefficients),
        )


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """Where the steps ended."""

    place: "_Place"  # there
    n_steps: int  # how many there were
    has_converged: bool  # whether the next step would be short
    # Of the last step that was not damped, in standard deviations of what is unknown.
    length: float
    contraction: float  # length of the last whole step over that of the one before

    @property
    def remaining(self) -> float:
        """Length of the step that would be next."""
        return self.length * self.contraction

    @property
    def point(self) -> JointPoint:
        """Parameters, states and disturbances."""
        return self.place.point

    @property
    def likelihood(self) -> MarginalLikelihood:
        """Of the record linearised there."""
        return self.place.likelihood

    @property
    def violation(self) -> float:
        """The largest of the scaled dynamics that hold."""
        return self.place.violation

    def move_for(self, slope: np.ndarray) -> float:
        """How far parameters go for a tilt (n_theta,), in standard deviations."""
        problem = self.place.problem
        change = (slope - problem.slope)[self.likelihood.moving]
        covariance = self.likelihood.at(problem.disturbances).covariance
        return float(np.sqrt(max(change @ covariance @ change, 0.0)))


@dataclass(frozen=True, eq=False)
class Target:
    """Where steps end."""

    # Of the next step, in standard deviations of what is unknown, up to which it need
    # not be taken. Lengths fall by one factor, or faster.
    length: float = 1e-4
    # Share of the objective that a step lowers it by, up to which they need not be
    # taken.
    fall: float = 0.0


EXACTLY = Target()


@dataclass(frozen=True, eq=False)
class JointProblem:
    """A record whose disturbances have given sizes."""

    linearizer: Linearizer  # of the likelihood of parameters and states
    disturbances: Disturbances  # with their sizes and times
    moving: np.ndarray  # (n_moving,) places of the parameters that are free to move
    # (n_constraints,) variance of what the scaled dynamics are violated by; zero where
    # they hold; None: they all hold.
    softness: np.ndarray | None = None
    # (n_theta,) slope in the parameters of what the log likelihood has beside the
    # objective; None: zero.
    tilt: np.ndarray | None = None

    @classmethod
    def white(
        cls,
        linearizer: Linearizer,
        sigma: np.ndarray,
        softness: np.ndarray | None = None,
    ) -> "JointProblem":
        """All parameters, and white noise sigma (n_states,) of the sensors."""
        values = linearizer.values
        n_runs = values.grid.n_trajectories
        noise = Disturbances(np.tile(sigma, (n_runs, 1)))
        return cls(linearizer, noise, np.arange(len(values.unknown)), softness)

    @property
    def values(self) -> LikelihoodValues:
        return self.linearizer.values

    @cached_property
    def variance(self) -> np.ndarray:
        """`softness`, (n_constraints,)."""
        n_constraints = self.values.jacobian.shape[0]
        return np.zeros(n_constraints) if self.softness is None else self.softness

    @cached_property
    def slope(self) -> np.ndarray:
        """`tilt`, (n_theta,)."""
        return np.zeros(len(self.values.unknown)) if self.tilt is None else self.tilt

    @cached_property
    def _may_curve(self) -> bool:
        """Whether the curvature of the dynamics may take part."""
        # Not where samples measure all of many states: these are solved for by their
        # own curvature, which is diagonal (`optimization.banded`). The band of the
        # whole would take four times the memory, and tens of gigabytes for 400 states.
        grid = self.values.grid
        is_many = self.values.n_states >= FEWEST_STATES
        is_chained = is_many and bool(np.all(grid.measured[grid.sample]))
        return len(self.moving) > 0 and not is_chained

    @cached_property
    def _but_delays(self) -> np.ndarray:
        """The parameters that move, without delays of inputs."""
        unknown = self.values.unknown
        model = unknown.model
        delays = [
            model.free.index(name) for _, name in model.delays if name in model.free
        ]
        return self.moving[~np.isin(unknown.owner[self.moving], delays)]

    def linearized(
        self,
        z: np.ndarray,
        known: PointValues,
        along: np.ndarray | None = None,
        curvature: Curvature | None = None,
    ) -> Linearization:
        """The record linearised at a point, beside the tilt.

        Args:
            z: (n_variables,) scaled parameters and states.
            known: what the values are there.
            along: (n_nodes, n_states) for functions of states; None: those of z.
            curvature: of the dynamics that takes part.
        """
        return replace(
            self.linearizer.at(z, known),
            along=along,
            linear_share=0.0,
            curvature=curvature,
            softness=self.softness,
            tilt=self.tilt,
        )

    def tilted(self, found: JointEstimate) -> "JointProblem":
        """With the tilt that is right where steps ended.

        States and forces that are integrated out leave the logarithm of their volume,
        -1/2 log|det K|, which depends on the parameters. Without it these are pulled to
        where forces can do the most: the most likely forces together with parameters
        are not those of the most likely parameters (Neyman and Scott, Econometrica 16,
        1948). A tilt that was there and moves its parameter by less than a twentieth of
        a standard error stays.

        Raises:
            SolveError: the states do not follow from the data.
        """
        z = found.point.z
        likelihood = found.likelihood.with_moving(self.moving[:0])
        volume = self._log_volume(likelihood)
        system = found.likelihood.with_moving(self.moving).at(self.disturbances)
        known = np.diag(system.border.information)
        tilt = self.slope.copy()
        moves = np.abs(tilt[self.moving]) * np.sqrt(np.diag(system.covariance))
        for place, information, move in zip(self.moving, known, moves, strict=False):
            if self.tilt is not None and move < 0.05:
                continue
            # In standard deviations of the parameter, or its own scale.
            step = 1e-3 / np.sqrt(information + 1)
            if z[place] + step > self.values.upper[place]:
                step = -step
            moved = z.copy()
            moved[place] += step
            linear = self.linearized(
                moved, self._at(moved), likelihood.problem.states_of_functions
            )
            there = self._log_volume(likelihood.relinearized(linear))
            # What the record says little of goes no further than by its own scale.
            slope = (there - volume) / step
            tilt[place] = np.clip(slope, -information, information)
        return replace(self, tilt=tilt)

    def _log_volume(self, likelihood: MarginalLikelihood) -> float:
        """What the log likelihood of given parameters has besides the squares."""
        # It is the logarithm of the volume that disturbances have under these
        # parameters. Starting states are unknown numbers like the parameters, and not
        # integrated out: a flat prior of theirs would prefer parameters with less
        # information about them (Cox and Reid, Journal of the Royal Statistical Society
        # B 49, 1987).
        n = self.values.n_states
        starts = self.values.grid.starts[:, None] * n + np.arange(n)
        border = likelihood.at(self.disturbances, held=starts.ravel()).border
        return float(border.log_constant - np.linalg.slogdet(border.precision)[1] / 2)

    @np.errstate(all="ignore")
    def optimum(
        self,
        z: np.ndarray,
        most_steps: int = STEPS_OF_A_PROBLEM,
        beside: JointPoint | None = None,
        target: Target = EXACTLY,
        before: JointEstimate | None = None,
    ) -> JointEstimate:
        """The most likely point, as far as the steps lead there.

        Args:
            z: (n_variables,) scaled parameters and states to start from.
            most_steps: at most.
            beside: disturbances to start from; None: there are none.
            target: where they end.
            before: where steps ended with disturbances of other sizes, to start from in
                place of z; of the same record, structure and kind of softness.

        Raises:
            SolveError: the states do not follow from the data.
        """
        if before is None:
            place, contraction = _Place.of(self, z, beside), 1.0
        else:
            linear = before.likelihood.problem
            linear = replace(linear, softness=self.softness, tilt=self.tilt)
            likelihood = before.likelihood.relinearized(linear, self.moving)
            place = replace(before.place, problem=self, likelihood=likelihood)
            contraction = before.contraction
        n_steps = 0
        moving = self.moving
        passed: list[tuple[float, float]] = []
        has_converged = is_curved = False
        curved = None  # the place before its step, with the curvature of the dynamics
        # Share of the parameters' information that is added to it where no part of a
        # step leads down (Levenberg 1944, Marquardt 1963).
        least_damping = 1e-2
        damping = 0.0
        length = np.inf
        objectives: list[float] = []
        while not has_converged and n_steps < most_steps:
            n_steps += 1
            passed.append((place.objective, place.missed))
            there = None
            origin = place
            if is_curved:
                origin = curved = place.curved(curved)
                aim = origin.aim(0.0)
                # Which may lead uphill.
                there = self._lower(place, aim, passed, 3)
            is_whole = there is not None or damping == 0
            if there is None:
                origin = place
                aim = place.aim(damping)
                there = self._lower(place, aim, passed)
            if is_whole:
                shorter = aim.length / length if n_steps > 1 else contraction
                contraction, length = min(shorter, 1.0), aim.length
            is_slow = not is_whole or contraction > SLOW
            if self._may_curve and is_slow:
                is_curved = True
            if there is None:
                damping = max(10 * damping, least_damping)
                if damping > 1e6 or not len(self.moving):
                    break
                place = replace(place, multipliers=aim.multipliers)
                contraction = 1.0
                continue
            damping = damping / 10 if damping > least_damping else 0.0
            objectives.append(there.objective)
            fall = target.fall * objectives[-1]
            is_short = is_whole and length * contraction < target.length
            has_converged = is_short and there.violation < SETTLED_VIOLATION
            has_converged = has_converged and origin.moves_all(aim)
            if place.objective - objectives[-1] < fall and length**2 / 2 < fall:
                has_converged = True
            # No step is short beside a kink.
            if is_level(2 * np.array(objectives)) and there.violation < NEARLY_HELD:
                has_converged = True
            place = there
            # Held inputs make kinks in the likelihood of a delay, over which steps go
            # to and fro: it stays once they are half a standard deviation long.
            if is_slow and length < 0.5 and len(self._but_delays) < len(moving):
                moving = self._but_delays
                likelihood = place.likelihood.with_moving(moving)
                own = replace(self, moving=moving)
                place = replace(place, problem=own, likelihood=likelihood)
        return JointEstimate(place, n_steps, has_converged, length, contraction)

    def _lower(
        self,
        place: "_Place",
        aim: "_Aim",
        passed: Sequence[tuple[float, float]],
        most_tried: int = 4,
    ) -> "_Place | None":
        """The first lower place on the way to the aim, or None.

        The way is tried in parts, each half of the one before. Where no more than a
        small part leads down, as beside a kink, a damped step goes further.
        """
        for n_halvings in range(most_tried):
            share = 0.5**n_halvings
            there = self._moved(place, place.point.towards(aim.point, share))
            if self._is_lower(there, place, aim, passed, share):
                return replace(there.renewed(), multipliers=aim.multipliers)
            again = there.corrected(place.system)
            if again is not None:
                there = self._moved(there, again)
                if self._is_lower(there, place, aim, passed, 1.0):
                    return replace(there.renewed(), multipliers=aim.multipliers)
        return None

    def _is_lower(
        self,
        there: "_Place",
        place: "_Place",
        aim: "_Aim",
        passed: Sequence[tuple[float, float]],
        share: float,
    ) -> bool:
        """Whether a place at a share of the way is lower than those before."""
        # Where parameters stay, by an exact penalty (Han 1977): beside sharp corners
        # steps that any fall of one of both lets pass crept to forces that are not
        # there.
        if not np.isfinite(there.objective):
            return False
        if aim.length < 1e-2:  # what it gains is beyond the accuracy of numbers
            return True
        if len(self.moving):
            return there.is_below(passed)
        price = 2 * float(np.max(np.abs(aim.multipliers), initial=0.0))
        fall = place.objective - there.objective
        fall += price * (place.missed - there.missed)
        return fall > 0.05 * share * (aim.length**2 + price * place.missed)

    def _moved(self, place: "_Place", point: JointPoint) -> "_Place":
        """At a point, or beside it within the bounds."""
        z = np.clip(point.z, self.values.lower, self.values.upper)
        return replace(place, point=replace(point, z=z), known=self._at(z))

    def room(self, z: np.ndarray) -> Room:
        """How far the parameters may move, (n_moving,)."""
        own = self.moving
        return Room.at(z[own], self.values.lower[own], self.values.upper[own])

    def _at(self, z: np.ndarray) -> PointValues:
        with solving():
            return self.values.at(z)


@dataclass(frozen=True, eq=False)
class _Aim:
    """The optimum of a linearised record."""

    point: JointPoint
    length: float  # of the way there, in standard deviations
    multipliers: np.ndarray  # of the dynamics, (n_constraints,)


@dataclass(frozen=True, eq=False)
class _Place:
    """A point beside the record linearised near by."""

    problem: JointProblem
    point: JointPoint
    known: PointValues
    likelihood: MarginalLikelihood  # of the record linearised there
    multipliers: np.ndarray | None = None  # (n_constraints,), of the last step

    @classmethod
    def of(
        cls,
        problem: JointProblem,
        z: np.ndarray,
        beside: JointPoint | None,
    ) -> "_Place":
        """Of a start; arguments as those of `JointProblem.optimum`."""
        known = problem._at(z)
        linear = problem.linearized(z, known)
        likelihood = MarginalLikelihood(linear, problem.disturbances, problem.moving)
        if beside is None:
            processes = np.zeros(likelihood.effects.shape[1])
            beside = JointPoint(z, processes, np.zeros(len(likelihood.owner)))
        return cls(problem, replace(beside, z=z), known, likelihood)

    def renewed(self) -> "_Place":
        """The same place, the record linearised here, functions of states as before."""
        return replace(self, likelihood=self.likelihood.relinearized(self._linear()))

    def curved(self, before: "_Place | None") -> "_Place":
        """The same place, where the curvature of the dynamics takes part, as before."""
        # The optimum of what is then quadratic is Newton's step. Where forces are large
        # the steps of Gauss and Newton, who leave it out, shrink slowly or grow.
        assert self.multipliers is not None
        problem = self.problem
        curvature = problem.linearizer.curvature(self.point.z, self.multipliers)
        linear = self._linear(curvature)
        if before is None:
            new = MarginalLikelihood(linear, problem.disturbances, problem.moving)
        else:
            new = before.likelihood.relinearized(linear, problem.moving)
        return replace(self, likelihood=new)

    def _linear(self, curvature: Curvature | None = None) -> Linearization:
        along = self.linear.states_of_functions
        return self.problem.linearized(self.point.z, self.known, along, curvature)

    @property
    def linear(self) -> Linearization:
        return self.likelihood.problem

    @cached_property
    def _remaining(self) -> np.ndarray:
        """Of the data, and minus the defects below them, less all disturbances."""
        data = np.concatenate([self.known.misfit, -self.known.g])
        remaining: np.ndarray = data - self.likelihood.effects @ self.point.processes
        of_functions = self.likelihood.border_in_dynamics[:, len(self.problem.moving) :]
        remaining[self.linear.n_values :] -= of_functions @ self.point.coefficients
        return remaining

    @property
    def residual(self) -> np.ndarray:
        """Measured less shown, errors of sensors included, (n_values,)."""
        return self._remaining[: self.linear.n_values]

    @property
    def _excess(self) -> np.ndarray:
        """Defects less what the disturbances do to the dynamics, scaled."""
        return -self._remaining[self.linear.n_values :]

    @property
    def _holds(self) -> np.ndarray:
        """Which of the dynamics hold, (n_constraints,)."""
        return self.problem.variance == 0

    @property
    def violation(self) -> float:
        return float(np.max(np.abs(self._excess[self._holds]), initial=0.0))

    @cached_property
    def missed(self) -> float:
        """Sum of all violations of the dynamics that hold."""
        return float(np.sum(np.abs(self._excess[self._holds])))

    def is_below(self, passed: Sequence[tuple[float, float]]) -> bool:
        """Whether objective or violations are clearly lower than at places before.

        By the share of a violation that Fletcher and Leyffer ask for.
        """
        for objective, missed in passed:
            fall = 1e-5 * missed
            if self.objective >= objective - fall and self.missed >= missed - fall:
                return False
        return True

    @cached_property
    def objective(self) -> float:
        known = self.known
        if not np.isfinite(np.sum(known.jacobian) + np.sum(known.slopes)):
            return np.inf
        point = self.point
        squares = self._squares(
            self.residual, point.processes, point.coefficients, self._excess
        )
        slope = self.problem.slope
        theta = point.z[: len(slope)]
        mean, information = self.problem.values.prior
        squares += float(information @ (theta - mean) ** 2)
        return squares / 2 - float(slope @ theta)

    def _squares(
        self,
        shown: np.ndarray,
        processes: np.ndarray,
        coefficients: np.ndarray,
        excess: np.ndarray,
    ) -> float:
        """Of values over their noise, and of disturbances in units of their priors."""
        disturbances = self.problem.disturbances
        weighted = shown / self.linear.of_values(disturbances.sigma)
        sizes = disturbances.function_sizes[self.likelihood.owner]
        innovations = self.likelihood.innovations(processes, disturbances)
        total = np.sum(weighted**2) + np.sum((coefficients / sizes) ** 2)
        total += np.sum(innovations**2)
        gives = ~self._holds
        total += np.sum(excess[gives] ** 2 / self.problem.variance[gives])
        return float(total)

    def aim(self, damping: float) -> _Aim:
        """The optimum of the record linearised here, or with damping before it."""
        found = self._within_bounds(self.system, damping)
        point = self._moved_by(found)
        return _Aim(
            point=point,
            length=self._length(found, point),
            multipliers=found.multipliers,
        )

    def moves_all(self, aim: _Aim) -> bool:
        """Whether an undamped step has all directions of which the data tell.

        Where the dynamics are violated `_within_bounds` leaves some of them out.
        """
        if self.violation < SETTLED_VIOLATION:
            return True
        found = self.system.smoothed(room=self.problem.room(self.point.z))
        n = len(self.problem.slope)
        return np.array_equal(aim.point.z[:n], self._moved_by(found).z[:n])

    @cached_property
    def system(self) -> OptimalitySystem:
        """Of the record linearised here, no state held."""
        return self.likelihood.at(self.problem.disturbances, REGULAR)

    def _within_bounds(self, system: OptimalitySystem, damping: float) -> Smoothed:
        """The optimum within the bounds; states at one that lead out of it are held."""
        # Steps leave out the curvature of the dynamics, multipliers times violations at
        # most. What the data tell of a direction has to be ten times as much.
        problem = self.problem
        values = problem.values
        left_out = 0.0
        if problem.softness is None:
            left_out = float(np.abs(system.multipliers) @ np.abs(self._excess))
        z = self.point.z
        x = values.point.of_x
        room = problem.room(z)
        is_low = z[x] <= values.lower[x]
        is_high = z[x] >= values.upper[x]
        is_held = np.zeros(len(is_low), dtype=bool)
        while True:
            found = system.smoothed(damping, room, 10 * left_out)
            step = found.x.ravel()
            leads_out = (is_low & (step < 0)) | (is_high & (step > 0))
            if not np.any(leads_out & ~is_held):
                return found
            is_held |= leads_out
            held = np.flatnonzero(is_held)
            system = system.likelihood.at(problem.disturbances, REGULAR, held)

    def corrected(self, system: OptimalitySystem) -> JointPoint | None:
        """The optimum by the slopes of the place before; None: a value is no number."""
        if not np.isfinite(self.violation):
            return None
        again = system.at_values(self.known.misfit, self.known.g)
        other = replace(self, likelihood=again.likelihood)
        return self._moved_by(other._within_bounds(again, 0.0))

    def _moved_by(self, found: Smoothed) -> JointPoint:
        step = np.concatenate([found.theta, found.x.ravel()])
        return JointPoint(
            z=self.point.z + step,
            processes=found.processes,
            coefficients=found.coefficients,
        )

    def _length(self, found: Smoothed, aim: JointPoint) -> float:
        """Of a step, in standard deviations of what it changes."""
        processes = aim.processes - self.point.processes
        coefficients = aim.coefficients - self.point.coefficients
        moved = self.likelihood.shown @ np.concatenate([found.x.ravel(), processes])
        moved = moved + self.linear.shown_in_theta @ found.theta
        excess = self.problem.variance * found.multipliers - self._excess
        return float(np.sqrt(self._squares(moved, processes, coefficients, excess)))

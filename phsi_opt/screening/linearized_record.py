"""A record linearised once: what any change leaves in the residuals.

The likelihood of the whole record is linearised at the states of the missing-force
estimate, with the dynamics hard::

    minimise 1/2 |r - C z - Y c|^2   over z = (theta, x) and c
    subject to d + J z + D c = 0

d are the defects of the fitted model at these states, D and Y what some coefficients c
do to the defects and to what the sensors show. One factorisation serves all of them:
what is left of D and Y in the weighted residuals, with states and base parameters
following, is their trace. Linearising at the base model's own trajectory instead would
compare phases that have run apart.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
from scipy.sparse import csc_matrix

from phsi_opt.errors import SolveError
from phsi_opt.estimation.record import Record
from phsi_opt.model.model import Model
from phsi_opt.optimization.bounded_least_squares import bounded_least_squares
from phsi_opt.statistics import TINY
from phsi_opt.transcription.elimination import (
    RIDGE,
    ReducedSystem,
    Step,
    regularized_inverse,
)
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.likelihood_values import (
    LikelihoodValues,
    PointValues,
    WeighedValues,
)
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.point import Point
from phsi_opt.transcription.sensors import outputs

DEFECT_SCHEME = "srk4"  # the integrator of the defects that are linearised
# Newton steps to states that obey the model, at most: a free run's steps are finer than
# those of the record's grid.
MOST_NEWTON_STEPS = 4
# Defects of states that obey the model, as shares of those at the missing force's
# states: small enough to stop, and small enough to be of use when the steps end.
OBEYING = 1e-4
NEARLY_OBEYING = 1e-2
# Rows of every trace that are kept for pairs of effects, so that the memory of a long
# record stays bounded; products of that many rows are known to about 1/sqrt(20 000).
MOST_KEPT_ROWS = 20_000


@dataclass(frozen=True, eq=False)
class BoundedStep:
    """A step, and what is left after it.

    Attributes:
        step: of parameters and states.
        residual: after it, (n_values,), in units of the noise.
    """

    step: Step
    residual: np.ndarray = field(repr=False)

    @property
    def misfit(self) -> float:
        """Squared residuals that are left, in units of the noise variance."""
        return float(self.residual @ self.residual)


@dataclass(frozen=True, eq=False)
class LinearizedRecord:
    """The likelihood of a record, linearised (see the module's text).

    Attributes:
        record: the fit along the measurements.
        likelihood: of the fitted model, corners of dry friction rounded as in the
            estimate, or of a larger one; parameters and states in their own units.
        states: where it was linearised, (n_nodes, n_states).
        parameters: values of the free parameters, (n_free, n_trajectories).
        theta: their values, (n_theta,).
        sigma: (n_states,) noise.
        defects: at these states, (n_intervals * n_states,).
        shown_slopes: C, of what is shown, over the noise, sparse, (n_values, n_z).
        reduced: the system with its states eliminated; its constraints are defects
            times the length of their interval.
        scale: (n_theta,) size of each parameter, one that changes rates and residuals
            by about one.
        covariance: of theta.
        step: of theta and of the states, to those that obey the model.
        residual: after that step, (n_values,), in units of the noise.
        is_held: (n_theta,) whether a parameter is known and does not move.
    """

    record: Record
    likelihood: LikelihoodValues = field(repr=False)
    states: np.ndarray
    parameters: np.ndarray
    theta: np.ndarray
    sigma: np.ndarray
    defects: np.ndarray = field(repr=False)
    shown_slopes: csc_matrix = field(repr=False)
    reduced: ReducedSystem = field(repr=False)
    scale: np.ndarray
    covariance: np.ndarray = field(repr=False)
    step: Step = field(repr=False)
    residual: np.ndarray = field(repr=False)
    is_held: np.ndarray = field(repr=False)

    @classmethod
    def of(cls, record: Record) -> "LinearizedRecord":
        """Linearise a record at the states of its missing force."""
        estimate = record.estimate
        model = record.model.with_values(estimate.rounded)
        likelihood = likelihood_of(record, model, estimate.grid)
        return cls.at(record, likelihood, estimate.x, record.theta)

    @classmethod
    def at(
        cls,
        record: Record,
        likelihood: LikelihoodValues,
        states: np.ndarray,
        parameters: np.ndarray,
        held: Collection[str] = (),
    ) -> "LinearizedRecord":
        """Linearise the likelihood of a model along a record of a smaller one.

        Args:
            record: of the fit that is diagnosed.
            likelihood: of its model, or of a larger one whose further states are its
                last (`likelihood_of`).
            states: where, (n_nodes, n_states).
            parameters: of the model's free parameters, (n_free, n_trajectories).
            held: names of the model's parameters that are known and do not move.
        """
        unknown = likelihood.unknown
        theta = np.zeros(len(unknown))
        theta[unknown.table] = parameters
        sigma = record.estimate.sigma
        sigma = np.r_[sigma, np.ones(likelihood.n_states - len(sigma))]
        there = likelihood.at(np.concatenate([theta, states.ravel()]))
        squares = likelihood.standardized(there, sigma)
        reduced = likelihood.reduced(there, squares)
        shown_slopes = likelihood.shown.filled(squares.slopes)
        scale = _parameter_sizes(likelihood, there, squares)
        is_held = np.array([entry.name in held for entry in unknown.entries], bool)
        covariance = _covariance(reduced.information, scale, is_held)
        pull = -squares.gradient
        n = len(theta)
        step = reduced.solve(pull[n:], -there.g, covariance, pull[:n])
        return cls(
            record=record,
            likelihood=likelihood,
            states=states,
            parameters=parameters,
            theta=theta,
            sigma=sigma,
            defects=there.g / _lengths(likelihood),
            shown_slopes=shown_slopes,
            reduced=reduced,
            scale=scale,
            covariance=covariance,
            step=step,
            residual=squares.residual - shown_slopes @ step.joined,
            is_held=is_held,
        )

    @property
    def model(self) -> Model:
        """Whose likelihood it is."""
        return self.likelihood.model

    @property
    def grid(self) -> Grid:
        """Nodes and intervals."""
        return self.likelihood.grid

    @property
    def unknown(self) -> Theta:
        """The layout of the vector of parameters."""
        return self.likelihood.unknown

    @property
    def n_theta(self) -> int:
        """Number of parameters, those of every trajectory counted."""
        return len(self.unknown)

    @property
    def n_values(self) -> int:
        """Number of measured values."""
        return len(self.residual)

    @cached_property
    def misfit(self) -> float:
        """Squared residuals that the model leaves, in units of the noise variance."""
        return float(self.residual @ self.residual)

    @cached_property
    def within_bounds(self) -> "BoundedStep":
        """The step to states that obey the model, its parameters within their bounds.

        With s the step without bounds and I the information of the scaled parameters,
        it minimises ``(z - s)' I (z - s)`` over z within them.

        Raises:
            SolveError: the step is not finite.
        """
        if not np.all(np.isfinite(self.residual)):
            raise SolveError("a step along the linearised record is not finite")
        lower, upper = self._step_bounds
        free = self.step.theta
        if np.all(free >= lower) and np.all(free <= upper):
            return BoundedStep(self.step, self.residual)
        moves = ~self.is_held
        scale = self.scale[moves]
        information = self.reduced.information[np.ix_(moves, moves)]
        information = information * np.outer(scale, scale)
        values, vectors = np.linalg.eigh(information + RIDGE * np.eye(len(information)))
        root = np.sqrt(np.maximum(values, RIDGE))[:, None] * vectors.T
        lower, upper = lower[moves] / scale, upper[moves] / scale
        upper = np.maximum(upper, lower + TINY)
        bounded = free.copy()
        bounded[moves] = scale * bounded_least_squares(
            root, root @ (free[moves] / scale), lower, upper
        )
        moved = bounded - free
        by_theta = (self.reduced.following @ moved).ravel()
        change = self.shown_slopes @ Step(moved, by_theta).joined
        step = Step(bounded, self.step.x + by_theta)
        return BoundedStep(step, self.residual - change)

    @cached_property
    def states_within_bounds(self) -> np.ndarray:
        """States after the step within bounds, (n_nodes, n_states)."""
        moved = np.asarray(self.within_bounds.step.x)
        return self.states + moved.reshape(self.states.shape)

    @cached_property
    def parameters_within_bounds(self) -> np.ndarray:
        """Parameters after that step, (n_free, n_trajectories)."""
        step = self.within_bounds.step.theta
        lower, upper = self._step_bounds
        moved = self.theta + step
        # Exactly: a coefficient of 1e-17 in place of zero gives inner values slopes.
        moved = np.where(step <= lower, self.unknown.lower, moved)
        moved = np.where(step >= upper, self.unknown.upper, moved)
        theta = np.clip(moved, self.unknown.lower, self.unknown.upper)
        return theta[self.unknown.table].reshape(self.parameters.shape)

    @property
    def _step_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper, of a step of the parameters."""
        return self.unknown.lower - self.theta, self.unknown.upper - self.theta

    @cached_property
    def obeying_states(self) -> np.ndarray:
        """States that the base model can take, to first order, (n_nodes, n_states)."""
        return self.states + np.asarray(self.step.x).reshape(self.states.shape)

    @cached_property
    def shown(self) -> np.ndarray:
        """What the sensors show of the obeying states, (n_nodes, n_states)."""
        if not self.model.sensor:
            return self.obeying_states
        by_trajectory = np.asarray(self.unknown.by_trajectory(self.theta))
        states = self.obeying_states.T
        return np.array(outputs(self.model, self.grid, states, by_trajectory)).T

    @cached_property
    def kept_rows(self) -> np.ndarray:
        """Rows of measured values that are kept of a trace, all or a fixed draw."""
        if self.n_values <= MOST_KEPT_ROWS:
            return np.arange(self.n_values)
        rng = np.random.default_rng(0)
        return np.sort(rng.choice(self.n_values, MOST_KEPT_ROWS, replace=False))

    def traces(self, of_defects: np.ndarray, of_outputs: np.ndarray) -> np.ndarray:
        """What is left of changes in the residuals when all that may move has followed.

        Args:
            of_defects: D, (n_intervals * n_states, k).
            of_outputs: Y, (n_nodes * n_states, k), not yet weighted.

        Returns:
            (n_values, k), in units of the noise.
        """
        direct = self._over_noise(of_outputs)
        followed = self._followed(of_defects, direct)
        return direct + self.shown_slopes @ followed.joined

    def _over_noise(self, of_outputs: np.ndarray) -> np.ndarray:
        """Of changes at all nodes those of measured values, (n_values, k)."""
        is_measured = self.grid.measured.ravel()
        return of_outputs[is_measured] / self.sigma[self.grid.channel][:, None]

    def _followed(self, of_defects: np.ndarray, direct: np.ndarray) -> Step:
        """How parameters and states follow changes of defects and residuals."""
        n = self.n_theta
        pull = -self.shown_slopes.T @ direct
        offset = -_lengths(self.likelihood)[:, None] * of_defects
        return self.reduced.solve(pull[n:], offset, self.covariance, pull[:n])

    def _theta_beside(
        self, of_defects: np.ndarray, of_outputs: np.ndarray, coefficients: np.ndarray
    ) -> np.ndarray:
        """How the parameters follow an effect with given coefficients, (n_theta,)."""
        c = coefficients[:, None]
        followed = self._followed(of_defects @ c, self._over_noise(of_outputs @ c))
        return followed.theta[:, 0]

    def adjoint(self) -> np.ndarray:
        """Multipliers of the defects, (n_intervals * n_states,).

        Minus the product of the residual with the trace of each defect.
        """
        n = self.n_theta
        pull = self.shown_slopes.T @ self.residual
        found = self.reduced.multipliers(pull[n:], self.covariance, pull[:n])
        return _lengths(self.likelihood) * found

    def parameters_with(
        self,
        of_defects: np.ndarray,
        of_outputs: np.ndarray,
        coefficients: np.ndarray,
    ) -> dict[str, float]:
        """Values of the base's parameters beside an effect with given coefficients.

        They move at most half way to their bounds: the linearisation is not trusted
        further.
        """
        by_effect = self._theta_beside(of_defects, of_outputs, coefficients)
        moved = self.theta + self.step.theta + by_effect
        half_way_down = (self.unknown.lower + self.theta) / 2
        half_way_up = (self.unknown.upper + self.theta) / 2
        moved = np.clip(moved, half_way_down, half_way_up)
        return dict(zip(self.unknown.names, moved.tolist(), strict=True))

    def relative_change(
        self,
        of_defects: np.ndarray,
        of_outputs: np.ndarray,
        coefficients: np.ndarray,
    ) -> float:
        """By how much of its own size a base parameter moves beside an effect, at most.

        The arguments are those of `parameters_with`; parameters at zero do not count.
        """
        by_effect = self._theta_beside(of_defects, of_outputs, coefficients)
        sizes = np.abs(self.theta)
        counts = sizes > 0
        relative = np.abs(by_effect)[counts] / sizes[counts]
        return float(np.max(relative, initial=0.0))

    def parameters_of(self, model: Model, values: dict[str, float]) -> np.ndarray:
        """Parameters of a larger model, (n_free, n_trajectories).

        Those of the base as they are; others from ``values``, else at their start.
        """
        known = dict(zip(self.model.free, self.parameters, strict=True))
        n_trajectories = self.parameters.shape[1]
        default = model.values
        rows = []
        for name in model.free:
            value = values.get(name, default[name])
            rows.append(known.get(name, np.full(n_trajectories, value)))
        return np.array(rows).reshape(-1, n_trajectories)

    def by_trajectory(self, values: np.ndarray, size: np.ndarray) -> list[np.ndarray]:
        """Values (n_values,) over ``size`` per state, (n_samples, n_states) each.

        Zero where nothing was measured.
        """
        table = np.zeros(self.grid.y.shape)
        table[self.grid.measured] = values
        return list(self.grid.split(table / size))

    def along(self, run: Sequence[np.ndarray]) -> "LinearizedRecord | None":
        """The same along states that obey the base model.

        Args:
            run: its free run, one (n_samples, n_states) per trajectory.

        Returns:
            None where there are no such states within a few Newton steps.
        """
        at = partial(LinearizedRecord.at, self.record, self.likelihood)
        linearized = at(np.concatenate(run), self.parameters)
        reference = np.linalg.norm(self.defects)
        for _ in range(MOST_NEWTON_STEPS):
            if np.linalg.norm(linearized.defects) < OBEYING * reference:
                return linearized
            held = np.zeros_like(linearized.covariance)
            offset = -_lengths(self.likelihood) * linearized.defects
            back = linearized.reduced.respond(offset, held).x
            states = linearized.states + back.reshape(linearized.states.shape)
            linearized = at(states, self.parameters)
        left = np.linalg.norm(linearized.defects)
        return linearized if left < NEARLY_OBEYING * reference else None


def likelihood_of(record: Record, model: Model, grid: Grid) -> LikelihoodValues:
    """Of a model along a record, for many points of it, in the data's own units.

    Args:
        record: of the fit that is diagnosed.
        model: its model, or a larger one whose further states are its last.
        grid: in the order of the model.
    """
    unknown = Theta.of(model, record.trajectories)
    n_theta = len(unknown)
    x = np.zeros((grid.n_nodes, model.n_states))
    point = Point(np.zeros(n_theta), x, np.ones(n_theta), np.ones(model.n_states))
    return LikelihoodValues(model, grid, DEFECT_SCHEME, point, unknown)


def _lengths(likelihood: LikelihoodValues) -> np.ndarray:
    """In time, of the interval of every defect, (n_intervals * n_states,)."""
    return np.repeat(likelihood.grid.h, likelihood.n_states)


def _covariance(
    information: np.ndarray, scale: np.ndarray, is_held: np.ndarray
) -> np.ndarray:
    """Inverse of the information of parameters of these sizes, (n_theta, n_theta)."""
    sizes = np.outer(scale, scale)
    held = np.flatnonzero(is_held).tolist()
    return sizes * regularized_inverse(information * sizes, held)


def _parameter_sizes(
    likelihood: LikelihoodValues, there: PointValues, squares: WeighedValues
) -> np.ndarray:
    """Size of each parameter, one that changes rates and residuals by about one.

    A power of two: what is scaled to a bound comes back to exactly that bound.
    """
    rates = there.jacobian / _lengths(likelihood)[likelihood.jacobian.rows]
    n = len(likelihood.point.scale)
    square = np.bincount(likelihood.jacobian.columns, rates**2, minlength=n)
    square += np.bincount(likelihood.shown.columns, squares.slopes**2, minlength=n)
    of_theta = square[likelihood.point.of_theta]
    return np.exp2(-np.round(np.log2(np.where(of_theta > 0, of_theta, 1.0)) / 2))

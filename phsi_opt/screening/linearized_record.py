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
from functools import cached_property

import numpy as np

from phsi_opt.errors import SolveError
from phsi_opt.estimation.record import Record
from phsi_opt.model.model import Model
from phsi_opt.optimization.bounded_least_squares import bounded_least_squares
from phsi_opt.statistics import TINY
from phsi_opt.transcription.elimination import RIDGE, Step, regularized_inverse
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.record_linearization import (
    LinearPoint,
    RecordLinearization,
)
from phsi_opt.transcription.sensors import SensorOutputs

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
        step: of scaled parameters and states.
        residual: (n_nodes * n_states,) weighted residuals after it.
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
        model: the fitted model, corners of dry friction rounded as in the estimate, or
            a larger one.
        grid: nodes and intervals.
        states: where it was linearised, (n_nodes, n_states).
        parameters: values of the free parameters, (n_free, n_trajectories).
        unknown: the layout of the vector of parameters.
        theta: their values, (n_theta,).
        point: defects, outputs and the system with its states eliminated, there.
        covariance: of scaled theta.
        step: of scaled theta and of the states, to those that obey the model.
        residual: weighted residuals after that step, (n_nodes * n_states,).
        is_held: (n_theta,) whether a parameter is known and does not move.
    """

    record: Record
    model: Model
    grid: Grid
    states: np.ndarray
    parameters: np.ndarray
    unknown: Theta
    theta: np.ndarray
    point: LinearPoint = field(repr=False)
    covariance: np.ndarray = field(repr=False)
    step: Step = field(repr=False)
    residual: np.ndarray = field(repr=False)
    is_held: np.ndarray = field(repr=False)

    @classmethod
    def of(cls, record: Record, states: np.ndarray | None = None) -> "LinearizedRecord":
        """Linearise a record.

        Args:
            record: the fit along the measurements.
            states: where, (n_nodes, n_states); default: those of the missing force.
        """
        estimate = record.estimate
        model = record.model.with_values(estimate.rounded)
        x = estimate.x if states is None else states
        return cls.at(record, model, x, record.theta)

    @classmethod
    def at(
        cls,
        record: Record,
        model: Model,
        states: np.ndarray,
        parameters: np.ndarray,
        grid: Grid | None = None,
        held: Collection[str] = (),
        linearization: RecordLinearization | None = None,
    ) -> "LinearizedRecord":
        """Linearise the likelihood of a model along a record of a smaller one.

        Args:
            record: of the fit that is diagnosed.
            model: its model, or a larger one whose further states are its last.
            states: where, (n_nodes, n_states).
            parameters: of the model's free parameters, (n_free, n_trajectories).
            grid: in the order of the model; default: that of the record.
            held: names of the model's parameters that are known and do not move.
            linearization: of the model, where it was made before.
        """
        grid = grid or record.estimate.grid
        if linearization is None:
            linearization = linearization_of(record, model, grid)
        unknown = Theta.of(model, record.trajectories)
        n_theta = len(unknown)
        theta = np.zeros(n_theta)
        theta[unknown.table] = parameters
        point = linearization.at(states, theta)
        is_held = np.array([entry.name in held for entry in unknown.entries], bool)
        covariance = regularized_inverse(
            point.reduced.information, np.flatnonzero(is_held).tolist()
        )
        gradient = point.outputs.gradient(point.outputs.residual)
        step = point.reduced.solve(
            gradient.x, -point.defects, covariance, gradient.theta
        )
        residual = point.outputs.residual - point.outputs.change(step)
        return cls(
            record=record,
            model=model,
            grid=grid,
            states=states,
            parameters=parameters,
            unknown=unknown,
            theta=theta,
            point=point,
            covariance=covariance,
            step=step,
            residual=residual,
            is_held=is_held,
        )

    @property
    def scale(self) -> np.ndarray:
        """Size of each parameter, (n_theta,)."""
        return self.point.scale

    @property
    def defects(self) -> np.ndarray:
        """At these states, (n_intervals * n_states,)."""
        return self.point.defects

    @property
    def weight(self) -> np.ndarray:
        """One over each value's noise, (n_nodes * n_states,), 0 where unmeasured."""
        return self.point.outputs.weight

    @property
    def n_theta(self) -> int:
        """Number of parameters, those of every trajectory counted."""
        return len(self.unknown)

    @property
    def n_values(self) -> int:
        """Number of measured values."""
        return int(self.grid.measured.sum())

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
        lower, upper = self._scaled_bounds
        free = self.step.theta
        if np.all(free >= lower) and np.all(free <= upper):
            return BoundedStep(self.step, self.residual)
        reduced = self.point.reduced
        moves = ~self.is_held
        information = reduced.information[np.ix_(moves, moves)]
        values, vectors = np.linalg.eigh(information + RIDGE * np.eye(len(information)))
        root = np.sqrt(np.maximum(values, RIDGE))[:, None] * vectors.T
        upper = np.maximum(upper, lower + TINY)
        bounded = free.copy()
        bounded[moves] = bounded_least_squares(
            root, root @ free[moves], lower[moves], upper[moves]
        )
        moved = bounded - free
        by_theta = (reduced.following @ moved).ravel()
        change = self.point.outputs.change(Step(moved, by_theta))
        residual = self.residual - change
        return BoundedStep(Step(bounded, self.step.x + by_theta), residual)

    @cached_property
    def states_within_bounds(self) -> np.ndarray:
        """States after the step within bounds, (n_nodes, n_states)."""
        moved = np.asarray(self.within_bounds.step.x)
        return self.states + moved.reshape(self.states.shape)

    @cached_property
    def parameters_within_bounds(self) -> np.ndarray:
        """Parameters after that step, (n_free, n_trajectories)."""
        step = self.within_bounds.step.theta
        lower, upper = self._scaled_bounds
        moved = self.theta + self.scale * step
        # Exactly: a coefficient of 1e-17 in place of zero gives inner values slopes.
        moved = np.where(step <= lower, self.unknown.lower, moved)
        moved = np.where(step >= upper, self.unknown.upper, moved)
        theta = np.clip(moved, self.unknown.lower, self.unknown.upper)
        return theta[self.unknown.table].reshape(self.parameters.shape)

    @property
    def _scaled_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper, of a step of the scaled parameters."""
        lower = (self.unknown.lower - self.theta) / self.scale
        upper = (self.unknown.upper - self.theta) / self.scale
        return lower, upper

    @cached_property
    def obeying_states(self) -> np.ndarray:
        """States that the base model can take, to first order, (n_nodes, n_states)."""
        return self.states + np.asarray(self.step.x).reshape(self.states.shape)

    @cached_property
    def shown(self) -> np.ndarray:
        """What the sensors show of the obeying states, (n_nodes, n_states)."""
        by_trajectory = np.asarray(self.unknown.by_trajectory(self.theta))
        sensed = SensorOutputs.at(
            self.model, self.grid, self.obeying_states, by_trajectory
        )
        return sensed.values

    @cached_property
    def kept_rows(self) -> np.ndarray:
        """Rows of measured values that are kept of a trace, all or a fixed draw."""
        rows = np.flatnonzero(self.weight)
        if len(rows) > MOST_KEPT_ROWS:
            rng = np.random.default_rng(0)
            rows = rng.choice(rows, MOST_KEPT_ROWS, replace=False)
        return np.sort(rows)

    def traces(self, of_defects: np.ndarray, of_outputs: np.ndarray) -> np.ndarray:
        """What is left of changes in the residuals when all that may move has followed.

        Args:
            of_defects: D, (n_intervals * n_states, k).
            of_outputs: Y, (n_nodes * n_states, k), not yet weighted.

        Returns:
            (n_nodes * n_states, k), in units of the noise.
        """
        followed = self._followed(of_defects, of_outputs)
        direct = self.weight[:, None] * of_outputs
        return np.asarray(direct + self.point.outputs.change(followed))

    def _followed(self, of_defects: np.ndarray, of_outputs: np.ndarray) -> Step:
        """How scaled parameters and states follow the changes D and Y."""
        gradient = self.point.outputs.gradient(-self.weight[:, None] * of_outputs)
        return self.point.reduced.solve(
            gradient.x, -of_defects, self.covariance, gradient.theta
        )

    def adjoint(self) -> np.ndarray:
        """Multipliers of the defects, (n_intervals * n_states,).

        Minus the product of the residual with the trace of each defect.
        """
        gradient = self.point.outputs.gradient(self.residual)
        return self.point.reduced.multipliers(
            gradient.x, self.covariance, gradient.theta
        )

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
        by_effect = self._followed(of_defects, of_outputs).theta @ coefficients
        moved = self.theta + self.scale * (self.step.theta + by_effect)
        entries = self.unknown.entries
        lower = np.array([entry.parameter.lower for entry in entries])
        upper = np.array([entry.parameter.upper for entry in entries])
        half_way_down = (lower + self.theta) / 2
        half_way_up = (upper + self.theta) / 2
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
        by_effect = self._followed(of_defects, of_outputs).theta @ coefficients
        sizes = np.abs(self.theta)
        counts = sizes > 0
        relative = np.abs(self.scale * by_effect)[counts] / sizes[counts]
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
        """Weighted values over ``size`` per state, (n_samples, n_states) each."""
        table = values.reshape(self.grid.y.shape) / size
        return np.split(table, self.grid.first[1:])

    def channel_sizes(self, residual: np.ndarray) -> np.ndarray:
        """Root mean square of a weighted residual in each state, (n_states,)."""
        measured = self.grid.measured
        squares = np.sum(residual.reshape(self.grid.y.shape) ** 2, axis=0)
        return np.sqrt(squares / np.maximum(measured.sum(axis=0), 1))

    def along(self, run: Sequence[np.ndarray]) -> "LinearizedRecord | None":
        """The same along states that obey the base model.

        Args:
            run: its free run, one (n_samples, n_states) per trajectory.

        Returns:
            None where there are no such states within a few Newton steps.
        """
        linearized = LinearizedRecord.of(self.record, np.concatenate(run))
        reference = np.linalg.norm(self.defects)
        for _ in range(MOST_NEWTON_STEPS):
            if np.linalg.norm(linearized.defects) < OBEYING * reference:
                return linearized
            held = np.zeros_like(linearized.covariance)
            back = linearized.point.reduced.respond(-linearized.defects, held).x
            states = linearized.states + back.reshape(linearized.states.shape)
            linearized = LinearizedRecord.of(self.record, states)
        left = np.linalg.norm(linearized.defects)
        return linearized if left < NEARLY_OBEYING * reference else None


def linearization_of(record: Record, model: Model, grid: Grid) -> RecordLinearization:
    """Of the likelihood of a model along a record, for many points of it.

    Arguments as those of `LinearizedRecord.at`.
    """
    sigma = record.estimate.sigma
    n_further = model.n_states - len(sigma)
    return RecordLinearization(
        Theta.of(model, record.trajectories),
        grid,
        DEFECT_SCHEME,
        np.r_[sigma, np.ones(n_further)],
    )

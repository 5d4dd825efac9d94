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

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.sparse import csc_matrix, diags, hstack

from phsi_opt.errors import SolveError
from phsi_opt.estimation.record import Record
from phsi_opt.model.model import Model
from phsi_opt.optimization.bounded_least_squares import bounded_least_squares
from phsi_opt.statistics import TINY
from phsi_opt.transcription.defect_derivatives import DefectLinearization
from phsi_opt.transcription.elimination import (
    RIDGE,
    ReducedSystem,
    Step,
    regularized_inverse,
)
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.sensors import SensorOutputs, output_slopes_in_theta

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
        theta: their values, (n_theta,), and ``scale``: the size of each.
        defects: at these states, (n_intervals * n_states,).
        weight: one over the noise of every value, (n_nodes * n_states,); 0: unmeasured.
        from_unknowns: slope of the weighted residuals in scaled theta and states.
        reduced: the system with its states eliminated; ``covariance``: of scaled theta.
        step: of scaled theta and of the states, to those that obey the model.
        residual: weighted residuals after that step, (n_nodes * n_states,).
    """

    record: Record
    model: Model
    grid: Grid
    states: np.ndarray
    parameters: np.ndarray
    unknown: Theta
    theta: np.ndarray
    scale: np.ndarray
    defects: np.ndarray = field(repr=False)
    weight: np.ndarray = field(repr=False)
    from_unknowns: csc_matrix = field(repr=False)
    reduced: ReducedSystem = field(repr=False)
    covariance: np.ndarray = field(repr=False)
    step: Step = field(repr=False)
    residual: np.ndarray = field(repr=False)

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
        is_held: bool = False,
        linearization: DefectLinearization | None = None,
    ) -> "LinearizedRecord":
        """Linearise the likelihood of a model along a record of a smaller one.

        Args:
            record: of the fit that is diagnosed.
            model: its model, or a larger one whose further states are its last.
            states: where, (n_nodes, n_states).
            parameters: of the model's free parameters, (n_free, n_trajectories).
            grid: in the order of the model; default: that of the record.
            is_held: whether parameters are known, and only states follow.
            linearization: of the model's defects, where it was made before.
        """
        estimate = record.estimate
        grid = grid or estimate.grid
        x = states
        n_further = model.n_states - len(estimate.sigma)
        sigma = np.r_[estimate.sigma, np.ones(n_further)]
        unknown = Theta.of(model, record.trajectories)
        n_theta = len(unknown)
        theta = np.zeros(n_theta)
        theta[unknown.table] = parameters
        point = _Point(model, grid, unknown, x, theta)
        linear_defects = _linear_defects(
            point, linearization or DefectLinearization(model, DEFECT_SCHEME)
        )
        linear_outputs = _linear_outputs(point, sigma)
        scale = _column_scale(
            csc_matrix(linear_defects.in_theta), linear_outputs.in_theta
        )
        scaled_slopes = linear_defects.in_theta @ diags(scale)
        through_sensors = linear_outputs.in_theta @ diags(scale)
        from_unknowns = csc_matrix(hstack([through_sensors, linear_outputs.in_states]))

        hessian = csc_matrix(from_unknowns.T @ from_unknowns)
        jacobian = hstack([scaled_slopes, linear_defects.in_states])
        reduced = ReducedSystem(
            grid,
            model.n_states,
            hessian,
            jacobian,
            slice(0, n_theta),
            slice(n_theta, n_theta + x.size),
        )
        held = range(n_theta) if is_held else ()
        covariance = regularized_inverse(reduced.information, held)
        gradient = from_unknowns.T @ linear_outputs.residual
        step = reduced.solve(
            gradient[n_theta:], -linear_defects.values, covariance, gradient[:n_theta]
        )
        residual = linear_outputs.residual - from_unknowns @ step.joined
        return cls(
            record=record,
            model=model,
            grid=grid,
            states=x,
            parameters=parameters,
            unknown=unknown,
            theta=theta,
            scale=scale,
            defects=linear_defects.values,
            weight=linear_outputs.weight,
            from_unknowns=from_unknowns,
            reduced=reduced,
            covariance=covariance,
            step=step,
            residual=residual,
        )

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
        lower = (self.unknown.lower - self.theta) / self.scale
        upper = (self.unknown.upper - self.theta) / self.scale
        free = self.step.theta
        if np.all(free >= lower) and np.all(free <= upper):
            return BoundedStep(self.step, self.residual)
        information = self.reduced.information + RIDGE * np.eye(len(free))
        values, vectors = np.linalg.eigh(information)
        root = np.sqrt(np.maximum(values, RIDGE))[:, None] * vectors.T
        upper = np.maximum(upper, lower + TINY)
        bounded = bounded_least_squares(root, root @ free, lower, upper)
        moved = bounded - free
        by_theta = (self.reduced.following @ moved).ravel()
        residual = self.residual - self.from_unknowns @ np.r_[moved, by_theta]
        return BoundedStep(Step(bounded, self.step.x + by_theta), residual)

    @cached_property
    def states_within_bounds(self) -> np.ndarray:
        """States after the step within bounds, (n_nodes, n_states)."""
        moved = np.asarray(self.within_bounds.step.x)
        return self.states + moved.reshape(self.states.shape)

    @cached_property
    def parameters_within_bounds(self) -> np.ndarray:
        """Parameters after that step, (n_free, n_trajectories)."""
        moved = self.theta + self.scale * self.within_bounds.step.theta
        theta = np.clip(moved, self.unknown.lower, self.unknown.upper)
        return theta[self.unknown.table].reshape(self.parameters.shape)

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
        followed = self._followed(of_defects, of_outputs).joined
        direct = self.weight[:, None] * of_outputs
        return np.asarray(direct + self.from_unknowns @ followed)

    def _followed(self, of_defects: np.ndarray, of_outputs: np.ndarray) -> Step:
        """How scaled parameters and states follow the changes D and Y."""
        gradient = -(self.from_unknowns.T @ (self.weight[:, None] * of_outputs))
        n = self.n_theta
        return self.reduced.solve(
            gradient[n:], -of_defects, self.covariance, gradient[:n]
        )

    def adjoint(self) -> np.ndarray:
        """Multipliers of the defects, (n_intervals * n_states,).

        Minus the product of the residual with the trace of each defect.
        """
        gradient = self.from_unknowns.T @ self.residual
        n = self.n_theta
        return self.reduced.multipliers(gradient[n:], self.covariance, gradient[:n])

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
            back = linearized.reduced.respond(-linearized.defects, held).x
            states = linearized.states + back.reshape(linearized.states.shape)
            linearized = LinearizedRecord.of(self.record, states)
        left = np.linalg.norm(linearized.defects)
        return linearized if left < NEARLY_OBEYING * reference else None


@dataclass(frozen=True, eq=False)
class _Point:
    """Where a record is linearised.

    Attributes:
        model: the fitted model.
        grid: nodes and intervals.
        unknown: the layout of the vector of parameters.
        x: states, (n_nodes, n_states).
        theta: parameters, (n_theta,).
    """

    model: Model
    grid: Grid
    unknown: Theta
    x: np.ndarray
    theta: np.ndarray


@dataclass(frozen=True, eq=False)
class _LinearDefects:
    """Defects, (n_intervals * n_states,), with their slopes."""

    values: np.ndarray
    in_states: csc_matrix
    in_theta: csc_matrix


@dataclass(frozen=True, eq=False)
class _LinearOutputs:
    """What the sensors show, in units of the noise.

    Attributes:
        residual: measured less shown, (n_nodes * n_states,); 0: unmeasured.
        weight: one over the noise, (n_nodes * n_states,); 0: unmeasured.
        in_states: slopes of what is shown.
        in_theta: the same in the parameters, states held.
    """

    residual: np.ndarray
    weight: np.ndarray
    in_states: csc_matrix
    in_theta: csc_matrix


def _linear_defects(
    point: _Point, linearization: DefectLinearization
) -> _LinearDefects:
    unknown = point.unknown
    by_trajectory = point.theta[unknown.table]
    values, in_states, of_all = linearization.at(point.grid, point.x, by_trajectory)
    # A parameter that trajectories share gets the slopes of all of them.
    owners = unknown.table.T.ravel()
    chosen = (np.ones(len(owners)), (np.arange(len(owners)), owners))
    together = csc_matrix(chosen, shape=(len(owners), len(unknown)))
    return _LinearDefects(values, in_states, csc_matrix(of_all @ together))


def _linear_outputs(point: _Point, sigma: np.ndarray) -> _LinearOutputs:
    """With the noise, (n_states,)."""
    grid = point.grid
    x = point.x
    theta = point.theta
    by_trajectory = np.asarray(point.unknown.by_trajectory(theta))
    sensed = SensorOutputs.at(point.model, grid, x, by_trajectory)
    measured = grid.measured
    weight = np.where(measured, 1 / sigma, 0.0).ravel()
    weighted = diags(weight)
    direct = output_slopes_in_theta(point.unknown, grid, x, theta)
    direct = direct.reshape(x.size, len(theta))
    unexplained = np.where(measured, (grid.y - sensed.values) / sigma, 0.0)
    return _LinearOutputs(
        residual=unexplained.ravel(),
        weight=weight,
        in_states=weighted @ sensed.jacobian,
        in_theta=weighted @ csc_matrix(direct),
    )


def _column_scale(of_defects: csc_matrix, of_outputs: csc_matrix) -> np.ndarray:
    """One over the norm of each column of the two matrices above each other."""
    squares = of_defects.power(2).sum(axis=0) + of_outputs.power(2).sum(axis=0)
    norms = np.sqrt(np.asarray(squares).ravel())
    return 1 / np.where(norms > 0, norms, 1.0)

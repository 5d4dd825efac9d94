"""A record linearised once: what any change leaves in the residuals.

The record is linearised at some states, with the forces that act there::

    minimise 1/2 |W (r - C x - C_theta theta - Y c)|^2 + 1/2 |w, v|^2_prior
    subject to g + J x + J_theta theta + D c = B w

r are the residuals and g the defects there, w forces and v lasting errors of sensors
with priors of given sizes, D and Y what some coefficients c do to the defects and to
what the sensors show. One factorisation serves all of them: what is left of D and Y in
the weighted residuals and in the whitened forces, with states, parameters and forces
following, is their trace. Without forces the dynamics are hard.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from phsi_opt.estimation.record import Record
from phsi_opt.initialization.relative_guesses import values_at
from phsi_opt.initialization.scaling import point_at
from phsi_opt.model.model import Model
from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.linearization import Linearizer
from phsi_opt.model_error.marginal_likelihood import (
    MarginalLikelihood,
    OptimalitySystem,
)
from phsi_opt.screening.weighing import EvidenceRecord
from phsi_opt.statistics import TINY
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import SCHEME
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.sensors import outputs


@dataclass(frozen=True, eq=False)
class Change:
    """What k coefficients of one do."""

    of_defects: np.ndarray  # D, (n_intervals * n_states, k), in units of rates
    of_outputs: np.ndarray  # Y, (n_nodes * n_states, k), in the units of the states


@dataclass(frozen=True, eq=False)
class LinearizedRecord:
    """A record, linearised (see the module's text)."""

    model: Model  # whose dynamics they are
    unknown: Theta  # its parameters in the trajectories
    theta: np.ndarray  # (n_theta,) where it was linearised
    states: np.ndarray  # (n_nodes, n_states) where it was linearised
    likelihood: MarginalLikelihood  # of the record there
    disturbances: Disturbances  # noise and forces, with their sizes
    # By which larger models are weighed; None: dynamics are hard, and have no volume.
    record: EvidenceRecord | None = None

    @classmethod
    def without_force(cls, record: Record) -> "LinearizedRecord":
        """With hard dynamics, at the states of a record's missing force."""
        estimate = record.estimate
        model = record.model.with_values(estimate.rounded)
        unknown = Theta.of(model, record.runs)
        theta = unknown.stacked(record.theta)
        # The missing force may be that of a model without the memory of this one.
        grid = record.aligned.for_model(model).grid
        states = with_memory(model, grid, estimate.x, record.theta)
        point = point_at(model, grid, unknown, theta, states)
        values = LikelihoodValues(model, grid, SCHEME, point, unknown)
        n_more = model.n_states - len(estimate.sigma)
        noise = np.r_[estimate.sigma, np.ones(n_more)]
        disturbances = Disturbances(np.tile(noise, (len(record.runs), 1)))
        linear = Linearizer(values).at(point.scaled)
        likelihood = MarginalLikelihood(linear, disturbances, np.arange(len(theta)))
        return cls(model, unknown, theta, states, likelihood, disturbances)

    @classmethod
    def beside_force(cls, record: EvidenceRecord) -> "LinearizedRecord":
        """Where the base of a record and the forces beside it are most likely."""
        base = record.base
        return cls(
            model=base.model,
            unknown=Theta.of(base.model, record.weighing.runs),
            theta=base.theta,
            states=base.states,
            likelihood=record.likelihood(base),
            disturbances=base.disturbances,
            record=record,
        )

    @cached_property
    def part(self) -> "LinearizedRecord":
        """Evenly spread pieces of a long record, on which many values are tried."""
        spread = self.likelihood.problem.evenly_spread()
        if spread is None:
            return self
        problem, runs = spread
        noise = self.disturbances.sigma[runs]
        disturbances = replace(self.disturbances, sigma=noise)
        return replace(
            self,
            unknown=replace(self.unknown, table=self.unknown.table[:, runs]),
            states=problem.nodes,
            likelihood=MarginalLikelihood(
                problem, disturbances, self.likelihood.moving
            ),
            disturbances=disturbances,
        )

    @property
    def grid(self) -> Grid:
        """Nodes and intervals."""
        return self.likelihood.problem.grid

    @property
    def parameters(self) -> np.ndarray:
        """Values of the free parameters, (n_free, n_trajectories)."""
        return np.asarray(self.theta[self.unknown.table])

    def range_of(self, quantity: str) -> tuple[float, float]:
        """Its least and its largest value along the record, to a hundredth of it."""
        values = values_at(self.model, self.grid, self.states, quantity)
        spread = max(float(np.ptp(values)), TINY)
        digits = int(np.ceil(2 - np.log10(spread)))
        return round(float(values.min()), digits), round(float(values.max()), digits)

    @cached_property
    def defects(self) -> np.ndarray:
        """At the states, in units of rates, (n_intervals * n_states,)."""
        return np.asarray(self.likelihood.problem.offset / self._per_rate)

    @cached_property
    def shown(self) -> np.ndarray:
        """What the sensors show of the states, (n_nodes, n_states)."""
        if not self.model.sensor:
            return self.states
        by_run = self.unknown.by_trajectory(self.theta)
        return outputs(self.model, self.grid, self.states, by_run)

    @cached_property
    def _per_rate(self) -> np.ndarray:
        """Scaled defects per unit of a rate, (n_intervals * n_states,)."""
        problem = self.likelihood.problem
        return np.asarray((self.grid.h[:, None] / problem.x_scale).ravel())

    @cached_property
    def _system(self) -> OptimalitySystem:
        return self.likelihood.at(self.disturbances)

    @cached_property
    def residual(self) -> np.ndarray:
        """What remains at the optimum, (n_values + n_process_values,).

        Residuals in units of the noise, then forces and errors of sensors, whitened,
        with the opposite sign.
        """
        system = self._system
        in_noise = np.sqrt(system.weights) * system.residual
        return np.concatenate([in_noise, -self._whitened(system.optimum)])

    def _whitened(self, answer: np.ndarray) -> np.ndarray:
        """Processes among unknowns as standard normals, (n_process_values, ...)."""
        likelihood = self.likelihood
        processes = answer[likelihood.problem.nodes.size : likelihood.n_unknowns]
        return likelihood.innovations(processes, self.disturbances)

    def traces(self, of_defects: np.ndarray, of_outputs: np.ndarray) -> np.ndarray:
        """What changes leave in `residual` when all that may move has followed.

        Args:
            of_defects: D, (n_intervals * n_states, k), in units of rates.
            of_outputs: Y, (n_nodes * n_states, k), in those of the states.

        Returns:
            (n_values + n_process_values, k); a residual less a trace remains.
        """
        direct, answer, of_border = self._answered(of_defects, of_outputs)
        shown = direct + self._system.shown(answer, of_border)
        in_noise = np.sqrt(self._system.weights)[:, None] * shown
        return np.concatenate([in_noise, self._whitened(answer)])

    def _answered(
        self, of_defects: np.ndarray, of_outputs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Changes of measured values, and how unknowns and parameters follow them."""
        direct = np.asarray(of_outputs[self.grid.measured.ravel()])
        dynamics = -self._per_rate[:, None] * of_defects
        return direct, *self._system.solve(-direct, dynamics)

    def adjoint(self) -> np.ndarray:
        """Multipliers of the defects, (n_intervals * n_states,).

        Minus the product of the residual with the trace of each defect.
        """
        multipliers = self._system.optimum[self.likelihood.n_unknowns :]
        return np.asarray(self._per_rate * multipliers)

    def volume_slopes(
        self, model: Model, values: dict[str, float], names: list[str], change: Change
    ) -> np.ndarray:
        """Slopes of -1/2 log|det K| in an effect's coefficients, (n_names,).

        Args:
            model: the base with the effect, at its parameters' ``values``.
            names: of the coefficients.
            change: what they do; the base's parameters follow.

        Raises:
            SolveError: the states do not follow from the data.
        """
        assert self.record is not None
        k = len(names)
        _, _, of_base = self._answered(
            change.of_defects[:, :k], change.of_outputs[:, :k]
        )
        scale = self.likelihood.problem.theta_scale
        own = self.record.volume_slopes(model, values, names)
        return own + (self._volume_slopes * scale) @ of_base

    @cached_property
    def _volume_slopes(self) -> np.ndarray:
        """Those in the base's parameters, (n_theta,)."""
        assert self.record is not None
        return self.record.volume_slopes(self.model, {}, self.unknown.names)

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
        c = coefficients[:, None]
        _, _, by_effect = self._answered(of_defects @ c, of_outputs @ c)
        scale = self.likelihood.problem.theta_scale
        moved = self.theta + scale * (self._system.theta + by_effect[:, 0])
        half_way_down = (self.unknown.lower + self.theta) / 2
        half_way_up = (self.unknown.upper + self.theta) / 2
        moved = np.clip(moved, half_way_down, half_way_up)
        return dict(zip(self.unknown.names, moved.tolist(), strict=True))

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

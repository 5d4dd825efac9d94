"""What the turns of `hybrid` compute: the stages, the last layer, the changes.

The defects are linear in the output weights of the network, and nearly linear in the
coefficients of the dictionary.
"""

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.learning.force_signals import with_force, with_signals, without_signals
from phsi_opt.learning.hybrid_network import (
    NeuralForce,
    TrainedForce,
    variable_columns,
)
from phsi_opt.learning.hybrid_training import TrainingSet
from phsi_opt.learning.ridge import N_FOLDS, cross_validated
from phsi_opt.model.model import Model
from phsi_opt.transcription.defects import defect_jacobian, defects
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.losses import complete_intervals
from phsi_opt.transcription.stages import StageRule, stage_rule

# Least size of coefficients and of a force: keeps relative changes finite where all
# are zero.
LEAST_SIZE = 1e-12


@dataclass(frozen=True, eq=False)
class HybridProblem:
    """What stays the same in all turns.

    Attributes:
        model: the dictionary's, without the force.
        grid: the intervals, without the force.
        settings: of the force.
        rows: numbers of the equations in which it acts.
        columns: numbers of its variables, as those of `TrainedForce`.
        scheme: name of the integrator.
    """

    model: Model
    grid: Grid
    settings: NeuralForce
    rows: tuple[int, ...]
    columns: tuple[int, ...]
    scheme: str

    @staticmethod
    def of(
        model: Model, data: Measurements, force: NeuralForce, scheme: str = "srk4"
    ) -> "HybridProblem":
        """The problem of a model and data in its order.

        Raises:
            ModelError: if the force names what the model has not, or there is no such
                integrator.
        """
        stage_rule(scheme)
        what = "equation of NeuralForce"
        rows = tuple(model.index(name, what) for name in force.equations)
        variables = model.states if force.variables is None else force.variables
        columns = variable_columns(model, variables)
        grid = complete_intervals(model, grid_of(data))
        return HybridProblem(model, grid, force, rows, columns, scheme)

    @property
    def rule(self) -> StageRule:
        """Where the integrator averages the right-hand side."""
        return stage_rule(self.scheme)

    @property
    def equations(self) -> list[str]:
        """States in whose equations the force acts."""
        return [self.model.states[row] for row in self.rows]

    def forced(self, model: Model) -> Model:
        """A model with the network's force as an input."""
        return with_signals(model, self.equations, self.scheme)

    def unforced(self, model: Model) -> Model:
        """The inverse of `forced`, with the values found."""
        return without_signals(model, self.equations)

    def with_force(self, force: np.ndarray) -> Grid:
        """The grid with the force (n_intervals, n_stages, n_equations) as inputs."""
        return with_force(self.grid, force, self.scheme)

    def no_force(self) -> np.ndarray:
        """A force of zero at the stages, (n_intervals, n_stages, n_equations)."""
        n_stages = len(self.rule.shares)
        return np.zeros((self.grid.n_intervals, n_stages, len(self.rows)))

    def at_stages(self, trained: TrainedForce, stages: np.ndarray) -> np.ndarray:
        """The force (n_intervals, n_stages, n_equations) at the stages."""
        return np.stack([trained.at(rows) for rows in _by_stage(stages)], axis=1)

    def training_set(self, model: Model, force: np.ndarray) -> TrainingSet:
        """The stages of the integrator, and what the force must add there on average.

        Args:
            model: the dictionary's, with its values.
            force: as it was when they were found, (n_intervals, n_stages, n_equations).
        """
        forced = self.forced(model)
        grid = self.with_force(force)
        rule = self.rule
        x0 = grid.y[grid.begin].T
        x1 = grid.y[grid.begin + 1].T
        h = grid.h[None, :]
        rhs = _over_intervals(forced, grid)
        left = (x1 - x0) / h
        stages = []
        for x, share, weight in zip(
            rule.states(rhs, x0, x1, h), rule.shares, rule.weights, strict=True
        ):
            left = left - weight * rhs(x, share)
            stages.append(self._rows_of(x.T, share))
        weights = np.array(rule.weights)
        target = left.T[:, list(self.rows)] + _mean(force, weights)
        return TrainingSet(np.stack(stages, axis=1), weights, target, self.folds())

    def _rows_of(self, x: np.ndarray, share: float) -> np.ndarray:
        """States, inputs and time (n_intervals, n_names) at a share of the steps."""
        grid = self.grid
        u = grid.u0 + share * (grid.u1 - grid.u0)
        t = grid.t[grid.begin] + share * grid.h
        return np.hstack([x, u, t[:, None]])

    def with_best_output(
        self, trained: TrainedForce, model: Model, data: TrainingSet
    ) -> TrainedForce:
        """Output weights by ridge regression over all defects.

        Every coefficient of H and R may take a step with them.

        Args:
            trained: the force.
            model: the dictionary's, with its values.
            data: what the force was trained on.
        """
        forced = self.forced(model)
        grid = self.with_force(self.at_stages(trained, data.stages))
        theta = forced.theta
        n_theta = len(theta)
        n_intervals = grid.n_intervals
        slopes = np.array(defect_jacobian(forced, grid, self.scheme)(grid.y.T, theta))
        d = np.array(defects(forced, grid, self.scheme, grid.y.T, theta)).T
        d[:, list(self.rows)] = data.target  # without the force
        features = _mean_features(trained, data)
        n_features = features.shape[1]
        n_columns = n_theta + len(self.rows) * n_features
        columns = np.zeros((n_intervals, d.shape[1], n_columns))
        columns[:, :, :n_theta] = slopes.reshape(n_intervals, -1, n_theta)
        for k, row in enumerate(self.rows):
            first = n_theta + k * n_features
            columns[:, row, first : first + n_features] = -features
        ridged = np.arange(n_columns) >= n_theta
        step = cross_validated(columns, d, data.folds, ridged)
        output = step[n_theta:].reshape(len(self.rows), n_features)
        last = (output[:, :-1], output[:, -1])
        return replace(trained, layers=(*trained.layers[:-1], last))

    def folds(self) -> np.ndarray:
        """Number of the fold of every interval, (n_intervals,).

        Whole trajectories, or blocks where there are fewer than `N_FOLDS` of them.
        """
        trajectory = self.grid.trajectory[self.grid.begin]
        n_trajectories = int(trajectory[-1]) + 1
        if n_trajectories >= N_FOLDS:
            return trajectory % N_FOLDS
        return np.arange(len(trajectory)) * N_FOLDS // len(trajectory)

    def changes(
        self,
        before: Model,
        after: Model,
        old_force: np.ndarray,
        new_force: np.ndarray,
    ) -> dict[str, float]:
        """A row of the table of convergence; see `Hybrid.convergence`.

        Args:
            before: the dictionary's model at the begin of the turn.
            after: at its end.
            old_force: (n_intervals, n_stages, n_equations) at the begin of the turn.
            new_force: at its end.
        """
        forced = self.forced(after)
        grid = self.with_force(new_force)
        d = np.array(defects(forced, grid, self.scheme, grid.y.T, forced.theta))
        size = max(_root_mean_square(new_force), LEAST_SIZE)
        return {
            "loss": float(np.mean(np.sum(d**2, axis=0))),
            "coefficient_change": _coefficient_change(before, after),
            "force_change": _root_mean_square(new_force - old_force) / size,
            "n_terms": len(after.free),
        }


def _by_stage(stages: np.ndarray) -> list[np.ndarray]:
    """The rows (n_intervals, n_names) of each stage."""
    return [stages[:, k] for k in range(stages.shape[1])]


def _mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Mean over the stages of values (n_intervals, n_stages, ...)."""
    return np.tensordot(values, weights, axes=(1, 0))


def _mean_features(trained: TrainedForce, data: TrainingSet) -> np.ndarray:
    """Mean of the last hidden layer over the stages, and ones for the bias."""
    at_stages = [trained.features(rows) for rows in _by_stage(data.stages)]
    features = _mean(np.stack(at_stages, axis=1), data.weights)
    return np.hstack([features, np.ones((len(features), 1))])


def _over_intervals(model: Model, grid: Grid) -> Any:
    """The right-hand side g(x, c) of all intervals at the share c of their steps."""
    rhs = model.rhs().map(grid.n_intervals)
    theta = ca.repmat(ca.DM(model.theta), 1, grid.n_intervals)
    t0 = grid.t[grid.begin][None, :]
    h = grid.h[None, :]

    def g(x: np.ndarray, c: float) -> np.ndarray:
        u = (grid.u0 + c * (grid.u1 - grid.u0)).T
        return np.array(rhs(x, u, t0 + c * h, theta))

    return g


def _coefficient_change(before: Model, after: Model) -> float:
    """Largest change of a coefficient, relative to the largest of its slot."""
    change = 0.0
    for slot in ("H", "R", "F"):
        old = []
        new = []
        for name, entry in before.entries.items():
            if entry.slot == slot:
                old.append(before.values[name])
                new.append(after.values.get(name, 0.0))
        moved = np.max(np.abs(np.array(new) - np.array(old)), initial=0.0)
        size = max(np.max(np.abs(np.array(new)), initial=0.0), LEAST_SIZE)
        change = max(change, float(moved / size))
    return change


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))

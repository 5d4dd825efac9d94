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
from phsi_opt.learning.hybrid_network import NeuralForce, TrainedForce
from phsi_opt.learning.hybrid_training import TrainingSet
from phsi_opt.learning.ridge import N_FOLDS, cross_validated
from phsi_opt.model.model import Model
from phsi_opt.transcription.defects import defect_jacobian, defects
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.integrators import (
    FIRST_NODE,
    SECOND_NODE,
    srk4_stages,
)
from phsi_opt.transcription.losses import complete_intervals

SCHEME = "srk4"
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
        columns: numbers of the states that it depends on.
    """

    model: Model
    grid: Grid
    settings: NeuralForce
    rows: tuple[int, ...]
    columns: tuple[int, ...]

    @staticmethod
    def of(model: Model, data: Measurements, force: NeuralForce) -> "HybridProblem":
        """The problem of a model and data in its order.

        Raises:
            ModelError: if the force names what is not a state.
        """
        what = "equation of NeuralForce"
        rows = tuple(model.index(name, what) for name in force.equations)
        variables = model.states if force.variables is None else force.variables
        what = "variable of NeuralForce"
        columns = tuple(model.index(name, what) for name in variables)
        grid = complete_intervals(model, grid_of(data))
        return HybridProblem(model, grid, force, rows, columns)

    @property
    def equations(self) -> list[str]:
        """States in whose equations the force acts."""
        return [self.model.states[row] for row in self.rows]

    def forced(self, model: Model) -> Model:
        """A model with the network's force as an input."""
        return with_signals(model, self.equations)

    def unforced(self, model: Model) -> Model:
        """The inverse of `forced`, with the values found."""
        return without_signals(model, self.equations)

    def no_force(self) -> np.ndarray:
        """A force of zero at the stages, (n_intervals, 2, n_equations)."""
        return np.zeros((self.grid.n_intervals, 2, len(self.rows)))

    def at_stages(self, trained: TrainedForce, stages: np.ndarray) -> np.ndarray:
        """The force (n_intervals, 2, n_equations) at the states of the stages."""
        return np.stack([trained(stages[:, k]) for k in (0, 1)], axis=1)

    def training_set(self, model: Model, force: np.ndarray) -> TrainingSet:
        """The outer stages of SRK4, and what the force must add there on average.

        Args:
            model: the dictionary's, with its values.
            force: as it was when they were found, (n_intervals, 2, n_equations).
        """
        forced = self.forced(model)
        grid = with_force(self.grid, force)
        x0 = grid.y[grid.begin].T
        x1 = grid.y[grid.begin + 1].T
        h = grid.h[None, :]
        rhs = _over_intervals(forced, grid)
        stages = srk4_stages(rhs, x0, x1, h)
        first = rhs(stages.first, FIRST_NODE)
        second = rhs(stages.second, SECOND_NODE)
        explained = (first + second) / 2
        left = ((x1 - x0) / h - explained).T[:, list(self.rows)]
        states = np.stack([stages.first.T, stages.second.T], axis=1)
        return TrainingSet(states, left + force.mean(axis=1), self.folds())

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
        grid = with_force(self.grid, self.at_stages(trained, data.stages))
        theta = forced.theta
        n_theta = len(theta)
        n_intervals = grid.n_intervals
        slopes = np.array(defect_jacobian(forced, grid, SCHEME)(grid.y.T, theta))
        d = np.array(defects(forced, grid, SCHEME, grid.y.T, theta)).T
        d[:, list(self.rows)] = data.target  # without the force
        features = self._mean_features(trained, data.stages)
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

    def _mean_features(self, trained: TrainedForce, stages: np.ndarray) -> np.ndarray:
        """Mean of the last hidden layer over the stages, and ones for the bias."""
        features = np.mean([trained.features(stages[:, k]) for k in (0, 1)], axis=0)
        return np.hstack([features, np.ones((len(features), 1))])

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
            old_force: (n_intervals, 2, n_equations) at the begin of the turn.
            new_force: at its end.
        """
        forced = self.forced(after)
        grid = with_force(self.grid, new_force)
        d = np.array(defects(forced, grid, SCHEME, grid.y.T, forced.theta))
        size = max(_root_mean_square(new_force), LEAST_SIZE)
        return {
            "loss": float(np.mean(np.sum(d**2, axis=0))),
            "coefficient_change": _coefficient_change(before, after),
            "force_change": _root_mean_square(new_force - old_force) / size,
            "n_terms": len(after.free),
        }


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

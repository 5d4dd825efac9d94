"""What the turns of `hybrid` compute: the stages, the last layer, the changes.

The defects are linear in the output weights of the network, and nearly linear in the
coefficients of the dictionary.
"""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from phsi_opt.data.measurements import Measurements
from phsi_opt.data.noise import LEAST_SIZE
from phsi_opt.force_analysis.cross_validation import N_FOLDS
from phsi_opt.force_analysis.force_record import Points
from phsi_opt.learning.force_signals import with_force, with_signals
from phsi_opt.learning.hybrid_network import TrainedForce
from phsi_opt.learning.hybrid_training import TrainingSet
from phsi_opt.learning.ridge import cross_validated
from phsi_opt.model.model import Model
from phsi_opt.statistics import rms
from phsi_opt.transcription.defects import KnownDefects
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.integrators import Integrator, integrator
from phsi_opt.transcription.losses import complete_intervals


@dataclass(frozen=True, eq=False)
class HybridProblem:
    """What stays the same in all turns.

    Attributes:
        grid: the intervals, without the force.
        equations: in which the force acts; ``rows``: their numbers.
        scheme: name of the integrator; ``rule``: where it averages.
    """

    grid: Grid
    equations: tuple[str, ...]
    rows: list[int]
    scheme: str
    rule: Integrator

    @classmethod
    def of(
        cls, model: Model, data: Measurements, force: TrainedForce, scheme: str
    ) -> "HybridProblem":
        """The problem of a model and data in its order.

        Raises:
            ModelError: there is no such integrator.
        """
        grid = complete_intervals(model, grid_of(data))
        return cls(grid, force.equations, force.rows, scheme, integrator(scheme))

    def forced(self, model: Model) -> Model:
        """A model with the network's force as an input."""
        return with_signals(model, self.equations, self.scheme)

    def with_force(self, force: np.ndarray) -> Grid:
        """The grid with the force (n_intervals, n_stages, n_equations) as inputs."""
        return with_force(self.grid, force, self.scheme)

    def training_set(self, model: Model, force: np.ndarray) -> TrainingSet:
        """The stages of the integrator, and what the force must add there on average.

        Beside the dictionary's values, which were found with the force
        (n_intervals, n_stages, n_equations).
        """
        forced = self.forced(model)
        rhs = forced.rhs()
        grid = self.with_force(force)
        theta = np.repeat(forced.theta[:, None], grid.n_intervals, axis=1)

        def rates(x: np.ndarray, share: float) -> np.ndarray:
            points = Points(x.T, *_inputs_and_times(grid, share), theta)
            return points.values(rhs).T

        x0 = grid.y[grid.begin].T
        x1 = grid.y[grid.begin + 1].T
        found = self.rule.states(rates, x0, x1, grid.h[None, :])
        stages = []
        for x, share in zip(found, self.rule.shares, strict=True):
            u, t = _inputs_and_times(self.grid, share)
            stages.append(np.column_stack([x.T, u, t]))
        data = TrainingSet(
            np.stack(stages, axis=1),
            np.array(self.rule.weights) / sum(self.rule.weights),
            KnownDefects(forced, grid, self.scheme).at(forced.theta).d[:, self.rows],
            self.folds(),
        )
        return replace(data, target=data.target + data.mean(force))

    def with_best_output(
        self, trained: TrainedForce, model: Model, data: TrainingSet
    ) -> TrainedForce:
        """Output weights by ridge regression over all defects.

        Every coefficient of H and R may take a step with them.
        """
        forced = self.forced(model)
        grid = self.with_force(trained.at(data.stages))
        theta = forced.theta
        n_theta = len(theta)
        n = grid.n_intervals
        known = KnownDefects(forced, grid, self.scheme).at(theta)
        d, slopes = known.d.copy(), known.slopes
        d[:, self.rows] = data.target  # without the force
        units = data.mean(trained.network.features(trained.values_in(data.stages)))
        features = np.hstack([units, np.ones((n, 1))])
        n_features = features.shape[1]
        columns = np.zeros((n, d.shape[1], n_theta + len(self.rows) * n_features))
        columns[:, :, :n_theta] = slopes.reshape(n, -1, n_theta)
        for k, row in enumerate(self.rows):
            first = n_theta + k * n_features
            columns[:, row, first : first + n_features] = -features
        ridged = np.arange(columns.shape[2]) >= n_theta
        step = cross_validated(columns, d, data.folds, ridged)
        output = step[n_theta:].reshape(len(self.rows), n_features)
        hidden = trained.network.layers[:-1]
        layers = (*hidden, (output[:, :-1], output[:, -1]))
        return replace(trained, network=replace(trained.network, layers=layers))

    def folds(self) -> np.ndarray:
        """Number of the fold of every interval, (n_intervals,).

        Whole trajectories, or blocks where there are fewer than `N_FOLDS` of them.
        """
        trajectory = self.grid.runs
        if trajectory[-1] + 1 >= N_FOLDS:
            return trajectory % N_FOLDS
        return np.arange(len(trajectory)) * N_FOLDS // len(trajectory)

    def changes(
        self,
        before: Model,
        old_force: np.ndarray,
        after: Model,
        new_force: np.ndarray,
    ) -> dict[str, float]:
        """A row of the table of convergence; see `Hybrid.convergence`.

        The dictionary's model and the force (n_intervals, n_stages, n_equations) before
        and after.
        """
        forced = self.forced(after)
        grid = self.with_force(new_force)
        d = KnownDefects(forced, grid, self.scheme).at(forced.theta).d
        size = max(rms(new_force), LEAST_SIZE)
        return {
            "loss": float(np.mean(np.sum(d**2, axis=1))),
            "coefficient_change": _coefficient_change(before, after),
            "force_change": rms(new_force - old_force) / size,
            "n_terms": len(after.free),
        }


def _inputs_and_times(grid: Grid, share: float) -> tuple[np.ndarray, np.ndarray]:
    """At a share of the steps, (n_intervals, n_inputs) and (n_intervals,)."""
    u = grid.u0 + share * (grid.u1 - grid.u0)
    return u, grid.t[grid.begin] + share * grid.h


def _coefficient_change(before: Model, after: Model) -> float:
    """Largest change of a coefficient, relative to the largest of its slot."""
    old = pd.Series(before.values)
    new = pd.Series(after.values).reindex(old.index, fill_value=0.0)
    slots = [entry.slot for entry in before.entries.values()]
    sizes = new.abs().groupby(slots).transform("max").clip(lower=LEAST_SIZE)
    changes = (new - old).abs() / sizes
    return float(np.max(changes.to_numpy(), initial=0.0))

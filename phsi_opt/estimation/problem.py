"""What `identify` works on: the task as the user gave it, and the state of the work,
from which the fit is made.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation import uncertainty
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.pruning import Pruning
from phsi_opt.model.model import Model
from phsi_opt.optimization.ipopt import Solution
from phsi_opt.optimization.program import Program
from phsi_opt.optimization.settings import GAUSS_NEWTON, SolverSettings
from phsi_opt.transcription.elimination import ReducedSystem
from phsi_opt.transcription.grid import Grid, steps_per_gap
from phsi_opt.transcription.losses import (
    MaximumLikelihood,
    PHSILoss,
    complete_intervals,
    mean_square_rate,
)
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.point import Point

# standard deviations that a slack must take over before its residual counts as cut
BEYOND = 1e-3
Loss = PHSILoss | MaximumLikelihood
Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Task:
    """Model, measurements and settings of one call of `identify`."""

    model: Model
    data: Measurements
    l1: dict[str, float]
    pruning: Pruning | None
    settings: SolverSettings
    say: Progress
    layout: Callable[[Grid], Grid] = lambda grid: grid

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the trajectories."""
        return tuple(run.name for run in self.data.trajectories)


@dataclass(frozen=True, eq=False)
class State:
    """Where the work stands: the model (with what is left of it), the program and its
    solution.
    """

    task: Task
    loss: Loss
    model: Model
    grid: Grid
    unknown: Theta
    point: Point
    program: Program
    solution: Solution
    l1: dict[str, float]
    sigma: np.ndarray
    removed: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    way: str = GAUSS_NEWTON  # how it was solved

    @property
    def theta(self) -> np.ndarray:
        """The estimates in the order of `Theta`."""
        return self.solution.values["theta"]

    @property
    def values(self) -> dict[str, float]:
        """One value per parameter of the model; its mean where every trajectory has its
        own.
        """
        return dict(
            zip(self.model.free, self.unknown.means(self.theta).tolist(), strict=True)
        )

    @property
    def sizes(self) -> dict[str, float]:
        """The largest absolute value of each parameter of the model."""
        largest = (
            np.abs(self.theta[self.unknown.table]).max(axis=1)
            if len(self.theta)
            else np.zeros(0)
        )
        return dict(zip(self.model.free, largest.tolist(), strict=True))

    @property
    def residual(self) -> np.ndarray:
        """Weighted residuals as the program has them."""
        return self.solution.residual

    @property
    def n_values(self) -> int:
        """Number of residuals."""
        if isinstance(self.loss, PHSILoss):
            return (
                complete_intervals(self.model, self.grid).n_intervals
                * self.model.n_states
            )
        return int(self.grid.measured.sum())

    @property
    def nodes(self) -> np.ndarray:
        """States at the nodes, (n_nodes, n_states)."""
        return self.solution.values["x"].reshape(self.grid.y.shape)

    @property
    def states(self) -> tuple[np.ndarray, ...]:
        """States at the samples, per trajectory."""
        both = zip(
            self.grid.split(self.nodes), self.grid.split(self.grid.sample), strict=True
        )
        return tuple(x[sample] for x, sample in both)

    @cached_property
    def reduced(self) -> ReducedSystem:
        """The likelihood at the solution, states eliminated."""
        return uncertainty.reduced(
            self.program, self.solution, self.grid, self.n_values
        )

    @property
    def misfit(self) -> float:
        """The loss without its L1 terms."""
        value = float(np.sum(self.solution.residual**2) / 2)
        if isinstance(self.loss, PHSILoss):
            return value * mean_square_rate(complete_intervals(self.model, self.grid))
        outliers = [
            v for name, v in self.solution.values.items() if name.startswith("outlier_")
        ]
        return value + 2 * (self.loss.huber or 0.0) / self.n_values * float(
            sum(np.sum(v) for v in outliers)
        )

    @property
    def deviance(self) -> float:
        """-2 log likelihood, with the noise at its estimate."""
        counts = self.grid.measured.sum(axis=0)
        return self.misfit * self.n_values + float(
            np.sum(counts * np.log(2 * np.pi * self.sigma**2))
        )

    @cached_property
    def uncertainty(self) -> uncertainty.Uncertainty:
        """Covariance of the estimates, where it is known."""
        names, solution = self.unknown.names, self.solution
        if not solution.outcome.success:
            return uncertainty.unknown(
                len(names), "no standard errors: the solver did not reach an optimum"
            )
        if any(self.l1.values()):
            return uncertainty.unknown(
                len(names),
                "no standard errors: the L1 term shrinks the coefficients (prune with debias)",
            )
        if isinstance(self.loss, MaximumLikelihood):
            found = uncertainty.of_likelihood(
                names, self.theta, self.program, solution, self.reduced
            )
            return found.widened(self._huber_factor())
        used, scale = complete_intervals(self.model, self.grid), self.point.theta_scale
        return uncertainty.of_defects(
            self.model,
            used,
            self.loss.integrator,
            self.theta,
            scale,
            solution.outcome.at_bounds,
        )

    def _huber_factor(self) -> float:
        """Variance of Huber's estimator over what the squares alone would have, from
        the residuals themselves.
        """
        assert isinstance(self.loss, MaximumLikelihood)
        if self.loss.huber is None:
            return 1.0
        size, inside = self.huber_moments
        return size / inside**2

    @property
    def huber_moments(self) -> tuple[float, float]:
        """Mean square of the residuals cut at Huber's limit, and the share that is not
        cut.
        """
        kept = self.solution.residual * np.sqrt(self.n_values / 2)
        beyond = sum(
            v for name, v in self.solution.values.items() if name.startswith("outlier_")
        )
        return float(np.mean(kept**2)), max(
            float(np.mean(np.asarray(beyond) < BEYOND)), 0.1
        )

    def fit(self) -> Fit:
        """The result record."""
        likelihood = isinstance(self.loss, MaximumLikelihood)
        names = zip(self.model.states, self.sigma, self.grid.measured.T, strict=True)
        own = (
            {}
            if self.unknown.is_shared
            else {r: self.unknown.values_of(self.theta, r) for r in self.unknown.runs}
        )
        return Fit(
            model=self.model.with_values(self.values),
            names=self.unknown.names,
            by_trajectory=own,
            loss=type(self.loss).__name__,
            loss_value=self.misfit,
            covariance=self.uncertainty.covariance,
            noise={name: float(s) for name, s, seen in names if seen.any()}
            if likelihood
            else {},
            outcome=self.solution.outcome,
            n_values=self.n_values,
            bic=self.deviance + len(self.unknown) * float(np.log(self.n_values))
            if likelihood
            else np.nan,
            hold=self.task.data.hold,
            units=dict(self.task.data.units),
            removed=self.removed,
            warnings=self.notes
            + self._selection()
            + self._bounds()
            + self.uncertainty.warnings,
            provenance=_provenance(self),
            states=self.states if likelihood else (),
            steps=tuple(steps_per_gap(self.grid)) if likelihood else (),
            huber=self.loss.huber if isinstance(self.loss, MaximumLikelihood) else None,
        )

    def _selection(self) -> tuple[str, ...]:
        if not self.removed:
            return ()
        return (
            f"standard errors take the kept terms as given; the choice among them and the {len(self.removed)} removed "
            "ones is not in them",
        )

    def _bounds(self) -> tuple[str, ...]:
        def sentence(name: str) -> str:
            i = self.unknown.names.index(name)
            p, value = self.unknown.entries[i].parameter, self.theta[i]
            side, bound = (
                ("lower", p.lower)
                if value - p.lower <= p.upper - value
                else ("upper", p.upper)
            )
            return f"{name} ended at its {side} bound {bound:g}: it has no standard error, and the others take it as known"

        return tuple(sentence(name) for name in self.solution.outcome.at_bounds)


def _provenance(state: State) -> dict[str, Any]:
    try:
        release = version("phsi_opt")
    except PackageNotFoundError:
        release = "unknown"
    return {
        "phsi_opt": release,
        "loss": repr(state.loss),
        "l1": dict(state.task.l1),
        "pruning": repr(state.task.pruning),
        "data_sha256": state.task.data.digest,
        "n_trajectories": state.task.data.n_trajectories,
        "n_samples": state.task.data.n_samples,
    }

"""An estimate: the solved program of a loss, from which the `Fit` is made.

It still holds the measurements and their layout, so it is not saved; `Estimate.fit`
takes from it what a user reads. What differs between the losses (residuals, standard
errors) is said by the subclasses, each beside the solution of its loss.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from phsi_opt.data.checks import checked_hold
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.fit_record import FitUncertainty
from phsi_opt.estimation.problem import Loss, Task
from phsi_opt.estimation.uncertainty import Uncertainty, unknown
from phsi_opt.later import Later
from phsi_opt.model.model import Model
from phsi_opt.optimization.ipopt import Solution
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.parameter_vector import Point, Theta


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate(ABC):
    """The model (with what pruning left of it), its program and the solution.

    Attributes:
        task: what was asked for.
        loss: what was minimised.
        model: with the terms that are left; its values are those before the solve.
        grid: nodes and intervals of the program.
        unknown: names and places of the free parameters.
        point: where the solver started, with the scale of each unknown.
        solution: of its program.
        l1: the weights that this program has; empty after debiasing.
        removed: names of the coefficients that pruning removed.
        notes: sentences for the warnings of the fit.
    """

    task: Task
    loss: Loss
    model: Model
    grid: Grid
    unknown: Theta
    point: Point
    solution: Solution
    l1: dict[str, float]
    removed: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    @abstractmethod
    def n_values(self) -> int:
        """Number of residuals."""

    @property
    @abstractmethod
    def misfit(self) -> float:
        """The loss without its L1 terms."""

    @abstractmethod
    def uncertainty_at_optimum(self) -> Uncertainty:
        """Covariance of theta at an optimum without an L1 term."""

    @property
    def is_success(self) -> bool:
        """Whether the solver reached an optimum."""
        return self.solution.outcome.success

    @property
    def theta(self) -> np.ndarray:
        """The estimates in the order of `Theta`, (n_theta,)."""
        return self.solution.values["theta"]

    @property
    def values(self) -> dict[str, float]:
        """One value per parameter of the model.

        The mean over the trajectories where each has its own.
        """
        means = self.unknown.means(self.theta).tolist()
        return dict(zip(self.model.free, means, strict=True))

    @property
    def sizes(self) -> dict[str, float]:
        """The largest absolute value of each parameter of the model."""
        if not len(self.theta):
            return {}
        by_parameter = np.abs(self.theta[self.unknown.table])
        largest = by_parameter.max(axis=1).tolist()
        return dict(zip(self.model.free, largest, strict=True))

    @property
    def has_l1(self) -> bool:
        """Whether an L1 term shrinks the coefficients."""
        return any(self.l1.values())

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Covariance of the estimates, where it is known."""
        n_theta = len(self.unknown.names)
        if not self.is_success:
            return unknown(
                n_theta, "no standard errors: the solver did not reach an optimum"
            )
        if self.has_l1:
            return unknown(
                n_theta,
                "no standard errors: the L1 term shrinks the coefficients "
                "(prune with debias)",
            )
        return self.uncertainty_at_optimum()

    @property
    def shared_covariance(self) -> np.ndarray:
        """Covariance in the order of ``model.free``, (n_free, n_free).

        NaN for parameters that every trajectory has of its own.
        """
        covariance = self.uncertainty.covariance
        is_shared = np.bincount(self.unknown.owner) == 1
        first = self.unknown.table[:, 0]
        of_first = covariance[np.ix_(first, first)]
        return np.where(np.outer(is_shared, is_shared), of_first, np.nan)

    def noise_by_name(self, sigma: np.ndarray) -> dict[str, float]:
        """Noise of the states that were measured, of that of all, (n_states,)."""
        measured = np.flatnonzero(self.grid.measured_states).tolist()
        return {self.model.states[k]: float(sigma[k]) for k in measured}

    def fit(self) -> Fit:
        """The result record."""
        return Fit(
            model=self.model.with_values(self.values),
            names=self.unknown.names,
            by_trajectory=self._values_by_trajectory(),
            loss=type(self.loss).__name__,
            loss_value=self.misfit,
            uncertainty=Later(self.fit_uncertainty),
            noise={},
            outcome=self.solution.outcome,
            n_values=self.n_values,
            hold=checked_hold(self.task.data.hold, self.model.inputs),
            units=dict(self.task.data.units),
            removed=self.removed,
            provenance=self._provenance(),
        )

    def fit_uncertainty(self) -> FitUncertainty:
        """How well the estimates are known, with all that was worked out about it."""
        warnings = [*self.task.aligned.notes, *self.notes]
        if self.removed:
            warnings.append(
                "standard errors take the kept terms as given; the choice among them "
                f"and the {len(self.removed)} removed ones is not in them"
            )
        warnings += map(self._bound_warning, self.solution.outcome.at_bounds)
        warnings += self.uncertainty.warnings
        return FitUncertainty(
            covariance=self.uncertainty.covariance, warnings=tuple(warnings)
        )

    def _values_by_trajectory(self) -> dict[str, dict[str, float]]:
        """Empty where all trajectories share all parameters."""
        if self.unknown.is_shared:
            return {}
        values = {}
        for run in self.unknown.runs:
            values[run] = self.unknown.values_of(self.theta, run)
        return values

    def _bound_warning(self, name: str) -> str:
        place = self.unknown.names.index(name)
        parameter = self.unknown.entries[place].parameter
        value = self.theta[place]
        bound = parameter.nearest_bound(value)
        side = "lower" if bound == parameter.lower else "upper"
        return (
            f"{name} ended at its {side} bound {bound:g}, to which the data press it: "
            "the model may lack something, or the bound is not right; it has no "
            "standard error, and the others take it as known"
        )

    def _provenance(self) -> dict[str, Any]:
        data = self.task.data
        return {
            "phsi_opt": _release(),
            "loss": repr(self.loss),
            "l1": dict(self.task.l1),
            "pruning": repr(self.task.pruning),
            "data_sha256": data.digest,
            "n_trajectories": data.n_trajectories,
            "n_samples": data.n_samples,
        }


@cache
def _release() -> str:
    try:
        return version("phsi_opt")
    except PackageNotFoundError:
        return "unknown"

"""An estimate by maximum likelihood: deviance, standard errors, part of the fit.

How it is found is the business of `likelihood_problem`.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from phsi_opt.data.noise import scatter_by_run
from phsi_opt.estimation import uncertainty
from phsi_opt.estimation.estimate import Estimate
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.fit_record import FitUncertainty
from phsi_opt.estimation.model_error_table import model_error_rows
from phsi_opt.estimation.noise_estimation import LEAST_COUNTED
from phsi_opt.estimation.uncertainty import Uncertainty
from phsi_opt.model.model import Model
from phsi_opt.model_error.disturbance_search import DisturbanceSearch
from phsi_opt.model_error.linearization import (
    Linearization,
    between_samples,
    linearized,
)
from phsi_opt.model_error.marginal_likelihood import ReducedSystem
from phsi_opt.model_error.standard_errors import (
    PlainEstimate,
    Source,
    StandardErrors,
    standard_errors,
)
from phsi_opt.optimization.bounded_step import regularized_inverse
from phsi_opt.transcription.defects import KnownDefects
from phsi_opt.transcription.grid import steps_per_gap
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.losses import MaximumLikelihood


@dataclass(frozen=True, eq=False, kw_only=True)
class LikelihoodEstimate(Estimate):
    """The maximum of the likelihood: parameters, states and noise.

    Attributes:
        likelihood: values and slopes of what was solved.
        sigma: (n_states,) standard deviation of the noise per state.
        is_known: (n_states,) whether it was declared.
    """

    loss: MaximumLikelihood
    likelihood: LikelihoodValues
    sigma: np.ndarray
    is_known: np.ndarray

    @property
    def n_values(self) -> int:
        """Number of measured values."""
        return len(self.grid.channel)

    @property
    def nodes(self) -> np.ndarray:
        """States at the nodes, (n_nodes, n_states)."""
        return self.solution.values["x"].reshape(self.grid.y.shape)

    @property
    def states(self) -> tuple[np.ndarray, ...]:
        """States at the samples, (n_samples, n_states) per trajectory."""
        return self.task.grid.split(self.nodes[self.grid.sample])

    @property
    def standardized(self) -> np.ndarray:
        """Residuals (y - x)/sigma of the measured values in the order of the nodes.

        Cut at Huber's limit where the loss has one.
        """
        return self.solution.residual * np.sqrt(self.n_values / 2)

    @property
    def _counted_residual(self) -> np.ndarray:
        """The same in the units of the states."""
        return self.standardized * self.sigma[self.grid.channel]

    @property
    def misfit(self) -> float:
        """Mean of ((y - x)/sigma)^2, or of Huber's function of the residuals."""
        squares = float(np.sum(self.solution.residual**2) / 2)
        slope = 2 * (self.loss.huber or 0.0) / self.n_values
        beyond = float(sum(np.sum(slack) for slack in self._huber_slacks()))
        return squares + slope * beyond

    @property
    def chi_square(self) -> float:
        """Sum of ((y - x)/sigma)^2, or of Huber's function of the residuals."""
        return self.misfit * self.n_values

    @property
    def deviance(self) -> float:
        """-2 log likelihood, with the noise at its estimate.

        ::

            sum ((y - x)/sigma)^2 + sum log(2 pi sigma^2)
        """
        counts = self.grid.measured.sum(axis=0)
        log_variance = np.log(2 * np.pi * self.sigma**2)
        return self.chi_square + float(np.sum(counts * log_variance))

    @property
    def bic(self) -> float:
        """Bayesian information criterion, deviance + n_theta log(n_values)."""
        return self.deviance + len(self.unknown) * float(np.log(self.n_values))

    @cached_property
    def reduced(self) -> ReducedSystem:
        """The likelihood at the solution, states eliminated."""
        linear = replace(self.linearized(), residual=self._counted_residual)
        return ReducedSystem(linear, self.sigma)

    def deviance_change(self, model: Model) -> float:
        """How the deviance would change if fixed numbers were those of ``model``.

        To first order and without a fit: at an optimum what is estimated adds nothing
        of that order, and each defect counts by its multiplier (envelope theorem).
        """
        theta = self.unknown.by_trajectory(self.theta)
        found = []
        for one in (model, self.model):
            known = KnownDefects(one, self.grid, self.loss.integrator, self.nodes, [])
            found.append(known.at(theta).d)
        moved = (found[0] - found[1]) * self.grid.h[:, None] / self.point.x_scale
        return 2 * float(self.reduced.multipliers @ moved.ravel())

    @property
    def z(self) -> np.ndarray:
        """Scaled parameters and states of the solution, (n_variables,)."""
        return self.solution.z[: len(self.likelihood.scale)]

    def linearized(self) -> Linearization:
        """Slopes of dynamics and sensors at the solution."""
        return linearized(self.likelihood, self.z, self.likelihood.at(self.z))

    def release(self) -> None:
        """Make room: factors of many states are large; they come again if asked for."""
        self.__dict__.pop("reduced", None)

    def uncertainty_at_optimum(self) -> Uncertainty:
        """Inverse of the information about theta when the states follow it.

        Times the ratio that Huber's function costs, where the loss has it.
        """
        scaled = regularized_inverse(self.reduced.information, self.held)
        of_squares = uncertainty.of_covariance(
            self.unknown.names,
            self.theta,
            self.point.theta_scale,
            scaled,
            self.solution.outcome.at_bounds,
        )
        # Variance of Huber's estimator over what the squares alone would say:
        # E[psi^2] / E[psi']^2 of an M-estimator, from the residuals (Huber 1964).
        ratio = self.score_variance / self.share_within
        return replace(of_squares, covariance=of_squares.covariance * ratio)

    @property
    def share_within(self) -> float:
        """Share of the residuals that Huber's function does not cut."""
        if self.loss.huber is None:
            return 1.0
        # The solver leaves smaller slacks at residuals within the limit.
        is_within = np.sum(self._huber_slacks(), axis=0) < 1e-3
        return max(float(np.mean(is_within)), LEAST_COUNTED)

    @property
    def score_variance(self) -> float:
        """Variance of the scores over the information of the residuals within.

        With Huber's function it is the rise of the loss over that of squares, per
        standard error.
        """
        if self.loss.huber is None:
            return 1.0
        return float(np.mean(self.standardized**2)) / self.share_within

    def _huber_slacks(self) -> list[np.ndarray]:
        """What the slacks take over of the residuals beyond Huber's limit."""
        values = self.solution.values
        return [values[name] for name in values if name.startswith("outlier_")]

    @property
    def held(self) -> list[int]:
        """Places of parameters that ended at a bound."""
        at_bounds = self.solution.outcome.at_bounds
        return [i for i, name in enumerate(self.unknown.names) if name in at_bounds]

    @property
    def plain(self) -> PlainEstimate:
        """The estimate as one that counts residuals as white noise."""
        linear = replace(self.linearized(), residual=self._counted_residual)
        problem = between_samples(linear)
        following = self.reduced.following[self.grid.sample]
        following = following.reshape(problem.nodes.size, problem.n_theta)
        return PlainEstimate(
            search=self.search(problem),
            covariance=regularized_inverse(self.reduced.information, self.held),
            in_theta=problem.shown_in_states @ following + problem.shown_in_theta,
            is_shared=self.unknown.is_shared,
            within=self.share_within,
            score_variance=self.score_variance,
        )

    def search(self, problem: Linearization) -> DisturbanceSearch:
        """The search for what acts beside the model, from the noise of the solution.

        Parameters at a bound stay there, and so do as many as the data cannot tell from
        others: a likelihood that is flat along a direction has no finite marginal.

        Args:
            problem: the likelihood, linearised.
        """
        shape = (problem.n_trajectories, len(self.sigma))
        measured = problem.grid.measured_states
        scatter = scatter_by_run(self.task.data)
        stays = [*self.held, *self.uncertainty.silent.pinned]
        return DisturbanceSearch(
            problem=problem,
            moving=np.setdiff1d(np.arange(len(self.theta)), stays),
            plain=np.broadcast_to(self.sigma, shape).copy(),
            scatter=np.where(self.is_known, self.sigma, scatter),
            channels=tuple(np.flatnonzero(measured & ~self.is_known).tolist()),
            is_brief=not self.task.settings.thorough,
        )

    @cached_property
    def standard_errors(self) -> StandardErrors | None:
        """The standard errors that survive model error; None where there are none."""
        if not self.is_success or self.has_l1 or not len(self.theta):
            return None
        return standard_errors(self.plain)

    def fit(self) -> Fit:
        """The result record, with noise, states and information criterion."""
        return replace(
            super().fit(),
            noise=self.noise_by_name(self.sigma),
            bic=self.bic,
            states=self.states,
            steps=tuple(steps_per_gap(self.grid)),
            huber=self.loss.huber,
        )

    def fit_uncertainty(self) -> FitUncertainty:
        """The standard errors that survive model error, with those of noise alone."""
        plain = super().fit_uncertainty()
        found = self.standard_errors
        if found is None:
            return plain
        covariances = {Source.NOISE: plain.covariance}
        for source, spread in found.spreads.items():
            if source != Source.NOISE:
                covariances[source] = self._unscaled(spread.covariance)
        return replace(
            plain,
            covariance=covariances[found.source],
            source=found.source,
            covariances=covariances,
            freedom=found.spread.freedom,
            model_error_rows=model_error_rows(
                self.task, self.grid, self.nodes, found.disturbances
            ),
            log_evidence=found.log_evidence,
        )

    def _unscaled(self, covariance: np.ndarray) -> np.ndarray:
        """In the parameters' units, NaN where noise alone gives none."""
        scale = self.point.theta_scale
        plain = self.uncertainty.covariance
        known = covariance * np.outer(scale, scale)
        return np.where(np.isfinite(plain), known, np.nan)

"""An estimate by maximum likelihood: deviance, standard errors, part of the fit.

How it is found is the business of `likelihood_solve`.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from phsi_opt.estimation import uncertainty
from phsi_opt.estimation.estimate import Estimate
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.fit_uncertainty import FitUncertainty
from phsi_opt.estimation.linearized_estimate import SolvedLikelihood
from phsi_opt.estimation.model_error_table import model_error_rows
from phsi_opt.estimation.transcription import Transcription
from phsi_opt.estimation.uncertainty import Uncertainty
from phsi_opt.model_error.linearization import linearized
from phsi_opt.model_error.marginal_likelihood import reduced
from phsi_opt.model_error.standard_errors import (
    PlainEstimate,
    Source,
    StandardErrors,
    standard_errors,
)
from phsi_opt.transcription.elimination import ReducedSystem
from phsi_opt.transcription.grid import steps_per_gap
from phsi_opt.transcription.losses import MaximumLikelihood

# Standard deviations that a slack takes over at a residual beyond Huber's limit, at
# least; the solver leaves smaller ones at residuals within it.
CUT_BY_HUBER = 1e-3
# Share of the residuals within Huber's limit, at least: with fewer the variance would
# be divided by what is nearly zero.
LEAST_SHARE_WITHIN = 0.1


@dataclass(frozen=True)
class HuberMoments:
    """Moments of the residuals cut at Huber's limit.

    Attributes:
        mean_square: of the cut residuals, in units of the noise's variance.
        share_within: of the residuals, those that are not cut.
    """

    mean_square: float
    share_within: float

    @property
    def variance_ratio(self) -> float:
        """Variance of Huber's estimator over what the squares alone would say.

        E[psi^2] / E[psi']^2 of an M-estimator, from the residuals themselves (Huber
        1964).
        """
        return self.mean_square / self.share_within**2

    @property
    def rise_ratio(self) -> float:
        """Rise of Huber's loss over that of squares, per standard error."""
        return self.mean_square / self.share_within


@dataclass(frozen=True, eq=False, kw_only=True)
class LikelihoodEstimate(Estimate):
    """The maximum of the likelihood: parameters, states and noise.

    Attributes:
        transcription: what was solved.
        sigma: (n_states,) standard deviation of the noise per state.
        is_known: (n_states,) whether it was declared.
    """

    loss: MaximumLikelihood
    transcription: Transcription
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
        nodes = self.grid.split(self.nodes)
        is_sample = self.grid.split(self.grid.sample)
        pairs = zip(nodes, is_sample, strict=True)
        return tuple(x[sample] for x, sample in pairs)

    @property
    def standardized(self) -> np.ndarray:
        """Residuals (y - x)/sigma of the measured values in the order of the nodes.

        Cut at Huber's limit where the loss has one.
        """
        return self.solution.residual * np.sqrt(self.n_values / 2)

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
        values = self.transcription.values
        z = self.solution.z[: values.point.scaled.size]
        return reduced(linearized(values, z, values.at(z)), self.sigma)

    def release(self) -> None:
        """Make room: factors of many states are large; they come again if asked for."""
        self.__dict__.pop("reduced", None)

    def uncertainty_at_optimum(self) -> Uncertainty:
        """Inverse of the information about theta when the states follow it.

        Times the ratio that Huber's function costs, where the loss has it.
        """
        of_squares = uncertainty.of_likelihood(
            self.unknown.names,
            self.theta,
            self.point.theta_scale,
            self.solution,
            self.reduced,
        )
        if self.loss.huber is None:
            return of_squares
        return of_squares.widened(self.huber_moments.variance_ratio)

    @property
    def huber_moments(self) -> HuberMoments:
        """Moments of the residuals at the solution, for a loss with ``huber``."""
        beyond = sum(self._huber_slacks())
        is_within = np.asarray(beyond) < CUT_BY_HUBER
        return HuberMoments(
            mean_square=float(np.mean(self.standardized**2)),
            share_within=max(float(np.mean(is_within)), LEAST_SHARE_WITHIN),
        )

    def _huber_slacks(self) -> list[np.ndarray]:
        """What the slacks take over of the residuals beyond Huber's limit."""
        values = self.solution.values
        return [values[name] for name in values if name.startswith("outlier_")]

    @cached_property
    def solved(self) -> SolvedLikelihood:
        """The parts of the solved likelihood, to be linearised."""
        return SolvedLikelihood(
            task=self.task,
            transcription=self.transcription,
            theta=self.theta,
            nodes=self.nodes,
            solution=self.solution,
            sigma=self.sigma,
            is_known=self.is_known,
            silent=self.uncertainty.silent,
        )

    @property
    def plain(self) -> PlainEstimate:
        """The estimate as one that counts residuals as white noise."""
        residual = self.standardized * self.sigma[self.grid.channel]
        within = 1.0
        score_variance = 1.0
        if self.loss.huber is not None:
            within = self.huber_moments.share_within
            score_variance = self.huber_moments.rise_ratio
        return self.solved.plain(self.reduced, residual, within, score_variance)

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
            noise=self._noise_by_name(),
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
            model_error_rows=model_error_rows(self.solved, found.disturbances),
            log_evidence=found.log_evidence,
        )

    def _unscaled(self, covariance: np.ndarray) -> np.ndarray:
        """In the parameters' units, NaN where noise alone gives none."""
        scale = self.point.theta_scale
        plain = self.uncertainty.covariance
        known = covariance * np.outer(scale, scale)
        return np.where(np.isfinite(plain), known, np.nan)

    def _noise_by_name(self) -> dict[str, float]:
        """Noise of the states that were measured."""
        noise = {}
        for k, name in enumerate(self.model.states):
            if self.grid.measured[:, k].any():
                noise[name] = float(self.sigma[k])
        return noise

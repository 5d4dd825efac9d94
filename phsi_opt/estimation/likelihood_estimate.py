"""The estimates by maximum likelihood, with and without a random force.

`LikelihoodEstimate` is the maximum of the likelihood; how it is found is the business
of `likelihood_problem`. `DisturbedEstimate` (``model_error=True``) begins there: the
record is linearised, what acts besides the model is found by evidence
(`model_error.disturbance_search`), and parameters, states and forces are found together
(`model_error.joint_estimate`). There the record is linearised again and the sizes are
moved to the optimum of their marginal likelihood, until they stay.

The straight part of a function of a state is that of a spring or a damper: no record
tells which of the two it was. The estimates give all of it to the model; their standard
errors count a part of it (`state_functions.LINEAR_SHARE`).
"""

import time
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from phsi_opt.data.noise import scatter_by_run
from phsi_opt.estimation.estimate import Estimate
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.likelihood_steps import solution_of_steps
from phsi_opt.estimation.noise_estimation import LEAST_COUNTED, NoiseLevels
from phsi_opt.estimation.uncertainty import Uncertainty, of_covariance
from phsi_opt.later import Remade
from phsi_opt.model.model import Model
from phsi_opt.model_error.ascent import SETTLED_EVIDENCE
from phsi_opt.model_error.disturbance_search import DisturbanceSearch
from phsi_opt.model_error.disturbances import LINEAR_SHARE, Disturbances
from phsi_opt.model_error.joint_estimate import JointEstimate, JointProblem
from phsi_opt.model_error.linearization import Linearization, Linearizer
from phsi_opt.model_error.marginal_likelihood import (
    MarginalLikelihood,
    OptimalitySystem,
    white_system,
)
from phsi_opt.model_error.standard_errors import (
    Clusters,
    Source,
    StandardErrors,
    are_independent,
    standard_errors,
    under_disturbances,
)
from phsi_opt.optimization.bounded_step import regularized_inverse
from phsi_opt.optimization.program import Program
from phsi_opt.transcription.defects import parameter_slopes
from phsi_opt.transcription.grid import steps_per_gap
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.sensors import outputs


@dataclass(frozen=True, eq=False, kw_only=True)
class LikelihoodEstimate(Estimate):
    """The maximum of the likelihood: parameters, states and noise."""

    loss: MaximumLikelihood
    likelihood: LikelihoodValues  # values and slopes of what was solved
    sigma: np.ndarray  # (n_states,) standard deviation of the noise per state
    levels: NoiseLevels  # what was known of it before

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
    def _counted(self) -> Linearization:
        """At the solution, with these residuals in the units of the states."""
        residual = self.standardized * self.sigma[self.grid.channel]
        return replace(self.linearized(), residual=residual)

    @property
    def misfit(self) -> float:
        """Mean of ((y - x)/sigma)^2, or of Huber's function of the residuals."""
        squares = float(np.sum(self.solution.residual**2) / 2)
        slope = 2 * (self.loss.huber or 0.0) / self.n_values
        beyond = float(sum(map(np.sum, self._huber_slacks())))
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

        and the squares of how far parameters are from the means of their priors, in
        standard deviations.
        """
        counts = self.grid.measured.sum(axis=0)
        log_variance = np.log(2 * np.pi * self.sigma**2)
        mean, information = self.unknown.priors
        of_priors = float(information @ (self.theta - mean) ** 2)
        return self.chi_square + float(np.sum(counts * log_variance)) + of_priors

    @cached_property
    def reduced(self) -> OptimalitySystem:
        """The likelihood at the solution, states eliminated."""
        return white_system(self._counted, self.sigma)

    def deviance_change(self, model: Model) -> float:
        """How the deviance would change if fixed numbers were those of ``model``.

        To first order and without a fit: at an optimum what is estimated adds nothing
        of that order, and each defect counts by its multiplier (envelope theorem).
        """
        theta = self.unknown.by_trajectory(self.theta)
        found = []
        for one in (model, self.model):
            scheme = self.loss.integrator
            known = parameter_slopes(one, self.grid, scheme, theta, self.nodes, only=[])
            found.append(known.d)
        moved = (found[0] - found[1]) * self.grid.h[:, None] / self.point.x_scale
        return 2 * float(self.reduced.multipliers @ moved.ravel())

    @property
    def z(self) -> np.ndarray:
        """Scaled parameters and states of the solution, (n_variables,)."""
        return self.solution.z[: len(self.likelihood.scale)]

    def linearized(self) -> Linearization:
        """Slopes of dynamics and sensors at the solution."""
        return Linearizer(self.likelihood).at(self.z)

    def release(self) -> None:
        """Make room: factors of many states are large; they come again if asked for."""
        self.__dict__.pop("reduced", None)

    def uncertainty_at_optimum(self) -> Uncertainty:
        """Inverse of the information about theta when the states follow it.

        Times the ratio that Huber's function costs, where the loss has it.
        """
        scaled = regularized_inverse(self.reduced.information, self.held)
        of_squares = of_covariance(
            self.unknown.names,
            self.theta,
            self.point.theta_scale,
            scaled,
            self.solution.outcome.at_bounds,
            predicted=self._predicted,
        )
        # Variance of Huber's estimator over what the squares alone would say:
        # E[psi^2] / E[psi']^2 of an M-estimator, from the residuals (Huber 1964).
        ratio = self.score_variance / self.share_within
        return replace(of_squares, covariance=of_squares.covariance * ratio)

    def _predicted(self, theta: np.ndarray) -> np.ndarray:
        """Defects and outputs of other parameters at the states, all in a row."""
        known = self.unknown.by_trajectory(theta)
        model, grid, x = self.model, self.grid, self.nodes
        d = parameter_slopes(model, grid, self.loss.integrator, known, x, []).d
        return np.r_[d.ravel(), outputs(model, grid, x, known).ravel()]

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

    @cached_property
    def moving(self) -> np.ndarray:
        """Places of the others, without as many as the data cannot tell from others."""
        stays = [*self.held, *self.uncertainty_at_optimum().silent.pinned]
        return np.setdiff1d(np.arange(len(self.theta)), stays)

    @property
    def plain_search(self) -> DisturbanceSearch:
        """The search on the record linearised here, an interval between samples."""
        return self.search(self._counted.between_samples())

    def search(self, problem: Linearization) -> DisturbanceSearch:
        """The search for what acts besides the model, from the noise of the solution.

        Parameters at a bound stay there, and so do as many as the data cannot tell
        from others: a likelihood that is flat along a direction has no finite marginal.
        """
        shape = (problem.grid.n_trajectories, len(self.sigma))
        scatter = scatter_by_run(self.task.data)
        return DisturbanceSearch(
            problem=problem,
            moving=self.moving,
            plain=np.broadcast_to(self.sigma, shape).copy(),
            scatter=np.where(self.levels.is_known, self.sigma, scatter),
            channels=self.levels.channels(problem.grid),
            is_brief=not self.task.settings.thorough,
        )

    @cached_property
    def standard_errors(self) -> StandardErrors | None:
        """Those that count model error; None where there are no standard errors."""
        if not self.is_success or self.has_l1 or not len(self.theta):
            return None
        return standard_errors(
            search=self.plain_search,
            covariance=regularized_inverse(self.reduced.information, self.held),
            is_shared=self.unknown.is_shared,
            within=self.share_within,
            score_variance=self.score_variance,
        )

    def fit(self) -> Fit:
        return replace(
            super().fit(),
            noise=self.noise_by_name(self.sigma),
            bic=self.bic,
            states=self.states,
            steps=tuple(steps_per_gap(self.grid)),
            huber=self.loss.huber,
            remade_program=self._remade_program,
        )

    @property
    def _remade_program(self) -> Remade[Program]:
        # Of the likelihood what it is made of, without the places of all its entries.
        _, made_of = self.likelihood.__reduce__()
        loss, l1, sigma = self.loss, self.l1, self.sigma
        return Remade(lambda: loss.program(LikelihoodValues(*made_of), l1, sigma))


@dataclass(frozen=True, eq=False, kw_only=True)
class DisturbedEstimate(Estimate):
    """The most likely parameters, states and forces together."""

    loss: MaximumLikelihood
    # The maximum of the likelihood without a force, where it began.
    plain: LikelihoodEstimate
    disturbances: Disturbances  # what acts beside the model
    # For disturbances, on the record linearised at the solution.
    search: DisturbanceSearch
    joint: JointEstimate  # parameters, states and forces

    @property
    def misfit(self) -> float:
        """Mean of the squared residuals over their noise, the force let in."""
        return float(np.sum(self.solution.residual[: self.n_values] ** 2) / 2)

    @cached_property
    def _likelihood(self) -> MarginalLikelihood:
        return self.search.likelihood(self.disturbances)

    @property
    def nodes(self) -> np.ndarray:
        return self.search.problem.nodes

    @cached_property
    def standard_errors(self) -> StandardErrors | None:
        """By what the record shows, or by the scatter between trajectories.

        The former may be more than the prior allows, such as functions of states; the
        latter counts where trajectories are enough.
        """
        if not self.is_success:
            return None
        system = self._likelihood.at(self.disturbances)
        problem = self.search.problem
        problem = replace(problem, linear_share=LINEAR_SHARE, tilt=None)
        counted = replace(self.search, problem=problem)
        found = under_disturbances(counted, system.response, counted.found())
        spreads = {Source.DISTURBANCES: found}
        if self.unknown.is_shared and are_independent(problem):
            borders = system.borders_by_trajectory()
            clusters = Clusters.of(borders, system.border.estimate)
            if clusters.is_enough:
                of_clusters = clusters.spread(self.search.moving, len(self.unknown))
                spreads[Source.TRAJECTORIES] = of_clusters
        source = list(spreads)[-1]
        evidence = system.log_model_evidence
        return StandardErrors(source, spreads, self.disturbances, evidence)

    @property
    def covariance_by_noise(self) -> np.ndarray:
        return self.plain.covariance_by_noise

    def uncertainty_at_optimum(self) -> Uncertainty:
        """Covariance of theta, and where nothing is known of it."""
        assert self.standard_errors is not None
        return of_covariance(
            self.unknown.names,
            self.theta,
            self.point.theta_scale,
            self.standard_errors.spread.covariance,
            self.solution.outcome.at_bounds,
            self.plain.uncertainty.silent,
        )

    @property
    def deviance(self) -> float:
        """-2 log marginal likelihood, the disturbances integrated out."""
        return -2 * self._likelihood.at(self.disturbances).log_likelihood

    def fit(self) -> Fit:
        """The result record, with noise and model error.

        It holds no states: a free run begins at states that obey the model.
        """
        fit = super().fit()
        if not self.is_success:
            return fit
        # White noise, the mean over trajectories.
        mean_noise = np.sqrt(np.mean(self.disturbances.sigma**2, axis=0))
        return replace(
            fit,
            noise=self.noise_by_name(mean_noise),
            bic=self.bic,
            steps=tuple(steps_per_gap(self.grid)),
            has_model_error=True,
        )


def with_model_error(plain: LikelihoodEstimate) -> DisturbedEstimate:
    """The estimate with a random force, begun at the plain one.

    Raises:
        SolveError: the states do not follow from the data.
    """
    began = time.perf_counter()
    task = plain.task
    task.say("estimating the model error")
    disturbances = plain.plain_search.found().disturbances
    search = plain.search(replace(plain.linearized(), linear_share=0.0))
    values = plain.likelihood
    linearizer = Linearizer(values)
    z = plain.z
    evidence = -np.inf
    move = np.inf
    joint = None
    for _ in range(5):  # solves, each after better sizes
        found = search.best_of([disturbances])
        disturbances = found.disturbances
        is_settled = found.log_evidence < evidence + SETTLED_EVIDENCE
        # Functions of states, and the directions that forces may not take, are those of
        # the states before: after one solve with such directions the stiffness of an
        # oscillator was off by 4 to 7 standard errors, after two by a thousandth.
        if is_settled and move < 0.1:
            break
        task.say("estimating parameters, states and forces together")
        problem = JointProblem(linearizer, disturbances, search.moving)
        before = problem.optimum(z, 0) if joint is None else joint
        joint = problem.tilted(before).optimum(z, most_steps=100)
        z = joint.point.z
        weights = 1 / joint.place.linear.of_values(disturbances.sigma)
        solution = solution_of_steps(
            values,
            z,
            joint.place.residual * weights * np.sqrt(2 / len(weights)),
            violation=joint.violation,
            n_steps=joint.n_steps,
            is_found=joint.has_converged,
            began=began,
        )
        as_plain: dict[str, Any] = {
            one.name: getattr(plain, one.name) for one in fields(Estimate)
        }
        estimate = DisturbedEstimate(
            **{**as_plain, "solution": solution, "l1": {}},
            plain=plain,
            disturbances=disturbances,
            search=search,
            joint=joint,
        )
        if not solution.outcome.success:
            return estimate
        search = plain.search(replace(joint.place.linear, along=None))
        estimate = replace(estimate, search=search)
        marginal = estimate._likelihood.at(disturbances)
        evidence = marginal.log_evidence
        std_errors = np.sqrt(np.diag(marginal.covariance))
        move = float(np.max(np.abs(marginal.theta) / std_errors, initial=0.0))
    return estimate

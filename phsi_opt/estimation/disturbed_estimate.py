"""An estimate whose equations hold up to a random force: `model_error=True`.

From the plain maximum of the likelihood: the record is linearised there, what acts
beside the model is found by evidence (`phsi_opt.model_error.disturbance_search`), and
parameters, states and forces are found together (`model_error.joint_estimate`).
There the record is linearised again and the sizes are moved to the optimum of their
marginal likelihood, until they stay.

The straight part of a function of a state is that of a spring or a damper: no record
tells which of the two it was. The estimates give all of it to the model; their standard
errors count a part of it (`disturbances.LINEAR_SHARE`).
"""

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from phsi_opt.errors import SolveError
from phsi_opt.estimation.estimate import Estimate
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.fit_record import FitUncertainty
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_steps import solution_of_steps
from phsi_opt.estimation.model_error_table import model_error_rows
from phsi_opt.estimation.uncertainty import Uncertainty, of_covariance
from phsi_opt.model.model import Model
from phsi_opt.model_error.ascent import SETTLED_EVIDENCE
from phsi_opt.model_error.disturbance_search import DisturbanceSearch
from phsi_opt.model_error.disturbances import LINEAR_SHARE, Disturbances
from phsi_opt.model_error.joint_estimate import JointEstimate, JointProblem
from phsi_opt.model_error.linearization import Linearizer
from phsi_opt.model_error.marginal_likelihood import MarginalLikelihood, noise_weights
from phsi_opt.model_error.standard_errors import (
    Clusters,
    Source,
    Spread,
    under_disturbances,
)
from phsi_opt.transcription.grid import steps_per_gap
from phsi_opt.transcription.losses import MaximumLikelihood

MOST_SOLVES = 5  # each followed by better sizes


@dataclass(frozen=True, eq=False, kw_only=True)
class DisturbedEstimate(Estimate):
    """The most likely parameters, states and forces together.

    Attributes:
        plain: the maximum of the likelihood without a force, where it began.
        disturbances: what acts beside the model.
        search: for disturbances, on the record linearised at the solution.
        joint: parameters, states and forces.
    """

    loss: MaximumLikelihood
    plain: LikelihoodEstimate
    disturbances: Disturbances
    search: DisturbanceSearch
    joint: JointEstimate

    @property
    def n_values(self) -> int:
        """Number of measured values."""
        return self.search.problem.n_values

    def deviance_change(self, model: Model) -> float:
        """That of the plain estimate."""
        return self.plain.deviance_change(model)

    @property
    def misfit(self) -> float:
        """Mean of the squared residuals over their noise, the force let in."""
        return float(np.sum(self.solution.residual[: self.n_values] ** 2) / 2)

    @cached_property
    def _likelihood(self) -> MarginalLikelihood:
        return self.search.likelihood(self.disturbances)

    @cached_property
    def spreads(self) -> dict[Source, Spread]:
        """Covariances of the scaled parameters, the one that is given last.

        Under all that the record shows, which may be more than the prior allows, such
        as functions of states; and from the scatter between trajectories where they are
        enough.
        """
        response = self._likelihood.response(self.disturbances)
        problem = self.search.problem
        problem = replace(problem, linear_share=LINEAR_SHARE, tilt=None)
        counted = replace(self.search, problem=problem)
        found = under_disturbances(counted, response, counted.found())
        spreads = {Source.DISTURBANCES: found}
        clusters = self._clusters()
        if clusters is not None:
            moving = self.search.moving
            of_clusters = clusters.spread(moving, len(self.unknown))
            spreads[Source.TRAJECTORIES] = of_clusters
        return spreads

    def _clusters(self) -> Clusters | None:
        """The trajectories, where they are enough and share the parameters."""
        if not self.unknown.is_shared:
            return None
        disturbances = self.disturbances
        borders = self._likelihood.borders_by_run(disturbances)
        step = self._likelihood.at(disturbances).border
        clusters = Clusters.of_borders(borders, disturbances.function_sizes, step)
        return clusters if clusters.is_enough else None

    @property
    def source(self) -> Source:
        """Where the standard errors come from."""
        return list(self.spreads)[-1]

    @property
    def spread(self) -> Spread:
        """The covariance that is given."""
        return self.spreads[self.source]

    def uncertainty_at_optimum(self) -> Uncertainty:
        """Covariance of theta, and where nothing is known of it."""
        return self._uncertainty(self.source)

    def _uncertainty(self, source: Source) -> Uncertainty:
        return of_covariance(
            self.unknown.names,
            self.theta,
            self.point.theta_scale,
            self.spreads[source].covariance,
            self.solution.outcome.at_bounds,
            self.plain.uncertainty.silent,
        )

    @property
    def deviance(self) -> float:
        """-2 log marginal likelihood, the disturbances integrated out."""
        return -2 * self._likelihood.log_likelihood(self.disturbances)

    def fit(self) -> Fit:
        """The result record, with noise and model error.

        It holds no states: a free run begins at states that obey the model.
        """
        fit = super().fit()
        if not self.is_success:
            return fit
        # White noise, the mean over trajectories.
        mean_noise = np.sqrt(np.mean(self.disturbances.sigma**2, axis=0))
        bic = self.deviance + len(self.unknown) * float(np.log(self.n_values))
        return replace(
            fit,
            noise=self.noise_by_name(mean_noise),
            bic=bic,
            steps=tuple(steps_per_gap(self.grid)),
            has_model_error=True,
        )

    def fit_uncertainty(self) -> FitUncertainty:
        """The standard errors, with those of noise alone, and what acts beside."""
        found = super().fit_uncertainty()
        if not self.is_success:
            return found
        covariances = {Source.NOISE: self.plain.uncertainty.covariance}
        for source in self.spreads:
            covariances[source] = self._uncertainty(source).covariance
        return replace(
            found,
            source=self.source,
            covariances=covariances,
            freedom=self.spread.freedom,
            model_error_rows=model_error_rows(
                self.task, self.grid, self.search.problem.nodes, self.disturbances
            ),
            log_evidence=self._likelihood.log_model_evidence(self.disturbances),
        )


def with_model_error(plain: LikelihoodEstimate) -> DisturbedEstimate:
    """The estimate with a random force, begun at the plain one.

    Raises:
        SolveError: the plain estimate is none, or the states do not follow from data.
    """
    if not plain.is_success:
        raise SolveError(f"The solver failed: {plain.solution.outcome}")
    began = time.perf_counter()
    task = plain.task
    task.say("what acts beside the model")
    disturbances = plain.plain.search.found().disturbances
    search = plain.search(replace(plain.linearized(), linear_share=0.0))
    values = plain.likelihood
    linearizer = Linearizer(values)
    z = plain.z
    evidence = -np.inf
    move = np.inf
    joint = None
    for _ in range(MOST_SOLVES):
        found = search.best_of([disturbances])
        disturbances = found.disturbances
        is_settled = found.log_evidence < evidence + SETTLED_EVIDENCE
        # Functions of states, and the directions that forces may not take, are those of
        # the states before: after one solve with such directions the stiffness of an
        # oscillator was off by 4 to 7 standard errors, after two by a thousandth.
        if is_settled and move < 0.1:
            break
        task.say("parameters, states and forces together")
        problem = JointProblem(linearizer, disturbances, search.moving)
        before = problem.optimum(z, 0) if joint is None else joint
        joint = problem.tilted(before).optimum(z, most_steps=100)
        z = joint.point.z
        weights = noise_weights(joint.place.linear, disturbances.sigma)
        solution = solution_of_steps(
            values,
            z,
            joint.place.residual * weights * np.sqrt(2 / len(weights)),
            violation=joint.violation,
            n_steps=joint.n_steps,
            is_found=joint.has_converged,
            began=began,
        )
        estimate = DisturbedEstimate(
            task=task,
            loss=plain.loss,
            model=plain.model,
            grid=plain.grid,
            unknown=plain.unknown,
            point=values.point,
            solution=solution,
            l1={},
            removed=plain.removed,
            notes=plain.notes,
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

"""An estimate whose equations hold up to a random force: `model_error=True`.

From the plain maximum of the likelihood: the record is linearised there, a prior of the
force is chosen (`phsi_opt.model_error.priors`), and parameters, states and force are
found together by one nonlinear program. There the record is linearised again and the
sizes are moved to the optimum of their marginal likelihood, until they stay.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from phsi_opt.errors import SolveError
from phsi_opt.estimation.estimate import Estimate
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.linearized_estimate import SolvedLikelihood
from phsi_opt.estimation.model_error_table import PriorRow, model_error_rows, prior_rows
from phsi_opt.estimation.uncertainty import Uncertainty, of_covariance
from phsi_opt.model_error.disturbance_search import DisturbanceSearch
from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.marginal_likelihood import MarginalLikelihood
from phsi_opt.model_error.priors import Prior, compared_priors
from phsi_opt.model_error.program import disturbed_program
from phsi_opt.model_error.standard_errors import Source, Spread, under_disturbances
from phsi_opt.optimization.ipopt import Solver
from phsi_opt.transcription.grid import steps_per_gap
from phsi_opt.transcription.losses import MaximumLikelihood

MOST_SOLVES = 3  # each followed by better sizes of the disturbances
# Change of the logarithm of the evidence by better sizes up to which they stay.
SETTLED_EVIDENCE = 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class DisturbedEstimate(Estimate):
    """The most likely parameters, states and forces together.

    Attributes:
        plain: the maximum of the likelihood without a force, where it began.
        disturbances: what acts beside the model.
        priors: what was compared.
        search: for disturbances, on the record linearised at the solution.
    """

    loss: MaximumLikelihood
    plain: LikelihoodEstimate
    disturbances: Disturbances
    priors: tuple[Prior, ...]
    search: DisturbanceSearch

    @property
    def n_values(self) -> int:
        """Number of measured values."""
        return self.search.problem.n_values

    @property
    def misfit(self) -> float:
        """Mean of the squared residuals over their noise, the force let in."""
        squares = float(np.sum(self.solution.residual[: self.n_values] ** 2))
        return squares / self.n_values

    @cached_property
    def _likelihood(self) -> MarginalLikelihood:
        structure = self.disturbances.structure
        return MarginalLikelihood(self.search.problem, structure, self.search.moving)

    @cached_property
    def spread(self) -> Spread:
        """Covariance of the scaled parameters under all that the record shows.

        That may be more than the prior allows, such as functions of states.
        """
        response = self._likelihood.response(self.disturbances)
        return under_disturbances(self.search, response, self.search.found())

    def uncertainty_at_optimum(self) -> Uncertainty:
        """Covariance of theta, and where nothing is known of it."""
        theta = self.program.variables["theta"].slice
        return of_covariance(
            self.unknown.names,
            self.theta,
            self.program.scale[theta],
            self.spread.covariance,
            self.solution.outcome.at_bounds,
        )

    @property
    def deviance(self) -> float:
        """-2 log marginal likelihood, the disturbances integrated out."""
        return -2 * self._likelihood.log_likelihood(self.disturbances)

    def fit(self) -> Fit:
        """The result record, with noise and model error.

        It holds no states: a free run begins at states that obey the model.
        """
        bic = self.deviance + len(self.unknown) * float(np.log(self.n_values))
        fit = super().fit()
        covariances = {Source.DISTURBANCES: fit.covariance}
        if self.is_success:
            covariances[Source.NOISE] = self.plain.uncertainty.covariance
        return replace(
            fit,
            noise=self._noise_by_name(),
            bic=bic,
            steps=tuple(steps_per_gap(self.grid)),
            std_error_source=Source.DISTURBANCES,
            covariances=covariances,
            freedom=self.spread.freedom if self.is_success else None,
            model_error_rows=model_error_rows(_solved(self), self.disturbances),
            prior_rows=self._prior_rows(),
        )

    def _prior_rows(self) -> tuple[PriorRow, ...]:
        return prior_rows(self.priors)

    def _noise_by_name(self) -> dict[str, float]:
        """White noise of the states that were measured, the mean over trajectories."""
        mean = np.sqrt(np.mean(self.disturbances.sigma**2, axis=0))
        noise = {}
        for k, name in enumerate(self.model.states):
            if self.grid.measured[:, k].any():
                noise[name] = float(mean[k])
        return noise


def _solved(estimate: DisturbedEstimate) -> SolvedLikelihood:
    return replace(
        estimate.plain.solved,
        theta=estimate.theta,
        nodes=estimate.solution.values["x"].reshape(estimate.grid.y.shape),
        program=estimate.program,
        solution=estimate.solution,
    )


def with_model_error(plain: LikelihoodEstimate) -> DisturbedEstimate:
    """The estimate with a random force, begun at the plain one.

    Raises:
        SolveError: the plain estimate is none, or the states do not follow from data.
    """
    if not plain.is_success:
        raise SolveError(f"The solver failed: {plain.solution.outcome}")
    task = plain.task
    task.say("priors of the model error")
    first = plain.plain.search
    shorter = first.pieces() or first
    priors = compared_priors(shorter, plain.loss.horizon)
    chosen = next(prior for prior in priors if prior.is_chosen)
    disturbances = first.on_whole_record(chosen.evidence.disturbances)
    is_fixed = chosen.has_fixed_times
    search = first
    point = replace(plain.point, theta=plain.theta, x=plain.nodes)
    evidence = -np.inf
    for _ in range(MOST_SOLVES):
        found = search.best_of([disturbances], is_fixed)
        disturbances = found.disturbances
        is_settled = found.log_evidence < evidence + SETTLED_EVIDENCE
        if is_settled:
            break
        task.say(f"states and force together, prior: {chosen.name}")
        program = disturbed_program(
            plain.model,
            point,
            plain.unknown,
            plain.loss.integrator,
            search.problem,
            disturbances,
        )
        solution = Solver(program, task.settings).solve(raise_on_failure=False)
        estimate = DisturbedEstimate(
            task=task,
            loss=plain.loss,
            model=plain.model,
            grid=plain.grid,
            unknown=plain.unknown,
            point=point,
            program=program,
            solution=solution,
            l1={},
            removed=plain.removed,
            notes=plain.notes,
            plain=plain,
            disturbances=disturbances,
            priors=tuple(priors),
            search=search,
        )
        if not solution.outcome.success:
            return estimate
        solved = _solved(estimate)
        search = solved.search(solved.linearized())
        estimate = replace(estimate, search=search)
        evidence = search.evidence(disturbances).log_evidence
        point = replace(point, theta=estimate.theta, x=solved.nodes)
    return estimate

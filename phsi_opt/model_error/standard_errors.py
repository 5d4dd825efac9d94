"""Which standard errors a fit gives: the policy, and the sentences about it.

- Noise alone: no disturbance shows in the record, and trajectories agree as far as the
  noise lets them.
- Trajectories: there are many of them, and their scatter gives the covariance.
- Disturbances: what acts beside the model is estimated from the record, and the
  covariance of the estimates follows from it.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from phsi_opt.criteria import CHANCE_LEVEL
from phsi_opt.errors import SolveError
from phsi_opt.model_error.clusters import Clusters
from phsi_opt.model_error.disturbance_search import DisturbanceSearch, Evidence
from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.freedom import LOG_STEP, Spread, degrees_of_freedom
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.marginal_likelihood import (
    Response,
    whitener_of_force,
    whitener_of_sensor,
)


class Source(StrEnum):
    """Where standard errors come from."""

    NOISE = "white noise"
    TRAJECTORIES = "scatter between trajectories"
    DISTURBANCES = "model error"


@dataclass(frozen=True, eq=False)
class PlainEstimate:
    """An estimate that counts residuals as white noise, ready to be judged.

    Attributes:
        search: for what acts beside the model, on its linearised likelihood.
        covariance: (n_theta, n_theta) of the scaled parameters, from noise alone.
        in_theta: (n_values, n_theta) slope of what is shown in the scaled parameters
            when the states follow them.
        is_shared: whether all trajectories share all parameters.
        within: share of the residuals that are not cut by Huber's loss.
        score_variance: variance of the scores over the information that the residuals
            within carry; one where none is cut.
    """

    search: DisturbanceSearch
    covariance: np.ndarray
    in_theta: np.ndarray
    is_shared: bool
    within: float = 1.0
    score_variance: float = 1.0

    @property
    def response(self) -> Response:
        """How it answers errors.

        Raises:
            SolveError: the states do not follow from the data.
        """
        white = Disturbances(self.sigma)
        return self.search.likelihood(white).response(white).over(self.within)

    @property
    def problem(self) -> Linearization:
        """The likelihood, linearised."""
        return self.search.problem

    @property
    def moving(self) -> np.ndarray:
        """Places of the parameters that are free to move, (n_moving,)."""
        return self.search.moving

    @property
    def sigma(self) -> np.ndarray:
        """Noise of the plain likelihood, (n_trajectories, n_states)."""
        return self.search.plain


@dataclass(frozen=True, eq=False)
class StandardErrors:
    """The standard errors of an estimate.

    Attributes:
        source: of those that are given.
        spreads: all that were worked out, by source.
        disturbances: what was found beside the model.
        log_evidence: of the model beside it; NaN where numbers do not hold it.
    """

    source: Source
    spreads: Mapping[Source, Spread]
    disturbances: Disturbances
    log_evidence: float

    @property
    def spread(self) -> Spread:
        """The one that is given."""
        return self.spreads[self.source]


def standard_errors(plain: PlainEstimate) -> StandardErrors:
    """The standard errors of a plain estimate."""
    of_noise = Spread(plain.covariance, plain.problem.noise_freedom)
    spreads = {Source.NOISE: of_noise}
    found = Disturbances(plain.sigma)
    # Beyond what numbers hold are slopes of 1e300, noise of 1e-14.
    with suppress(SolveError, np.linalg.LinAlgError):
        if plain.search.is_promising:
            best = plain.search.found()
            if best.coordinates is not None:
                spread = under_disturbances(plain.search, plain.response, best)
                spreads[Source.DISTURBANCES] = spread
                found = best.disturbances
    clusters = _clusters(plain)
    if clusters is not None:
        of_clusters = clusters.spread(plain.moving, len(plain.covariance))
        spreads[Source.TRAJECTORIES] = of_clusters
    differ = clusters is not None and clusters.agreement() < CHANCE_LEVEL
    is_disturbed = Source.DISTURBANCES in spreads
    source = Source.NOISE
    if clusters is not None and (differ or is_disturbed):
        source = Source.TRAJECTORIES
    elif is_disturbed:
        source = Source.DISTURBANCES
    log_evidence = np.nan
    with suppress(SolveError, np.linalg.LinAlgError):
        log_evidence = plain.search.likelihood(found).log_model_evidence(found)
    return StandardErrors(source, spreads, found, log_evidence)


def _clusters(plain: PlainEstimate) -> Clusters | None:
    """The trajectories, where they are enough and share the parameters."""
    if not plain.is_shared:
        return None
    in_theta = plain.in_theta[:, plain.moving]
    clusters = Clusters.of(
        plain.problem, in_theta, plain.sigma, plain.within, plain.score_variance
    )
    return clusters if clusters.is_enough else None


def under_disturbances(
    search: DisturbanceSearch, response: Response, best: Evidence
) -> Spread:
    """Covariance of an estimate under the disturbances that were found.

    Args:
        search: by which they were found.
        response: of the estimate.
        best: what was found.
    """
    problem = search.problem
    coordinates = best.coordinates
    freedom = problem.noise_freedom
    if coordinates is None or best.information is None:
        covariance = covariance_under(problem, response, best.disturbances)
        return Spread(covariance, freedom)

    def covariance_at(vector: np.ndarray) -> np.ndarray:
        return covariance_under(problem, response, coordinates.at(vector))

    def log_variances(vector: np.ndarray) -> np.ndarray:
        variances = np.diag(covariance_at(vector))[search.moving]
        return np.log(np.maximum(variances, np.finfo(float).tiny))

    is_free = coordinates.is_free(LOG_STEP)
    found = degrees_of_freedom(best.information, log_variances, is_free)
    freedom[search.moving] = np.minimum(found, freedom[search.moving])
    return Spread(covariance_at(np.zeros(len(is_free))), freedom)


def covariance_under(
    problem: Linearization, response: Response, disturbances: Disturbances
) -> np.ndarray:
    """Covariance of the scaled plain estimate, (n_theta, n_theta).

    Estimates that count every residual as independent noise are still good ones when it
    is not; their covariance is another one. To first order an estimate moves with every
    error in what was shown and with every force in the dynamics; the covariance of
    these, under the disturbances that the record itself tells, gives that of the
    estimate (White, Econometrica 50, 1982, with the covariance of the scores from a
    model of them).

    Args:
        problem: the linearised record.
        response: of the estimate to errors.
        disturbances: with their sizes.
    """
    run = problem.grid.trajectory[problem.node]
    sigma = disturbances.sigma[run, problem.channel]
    of_noise = response.to_values * sigma
    covariance = of_noise @ of_noise.T
    for force in disturbances.forces:
        weights = _weights_of_force(problem, response, force.place)
        factor = whitener_of_force(problem, force).factor_of(weights)
        covariance = covariance + force.size**2 * (factor.T @ factor)
    for sensor in disturbances.sensors:
        weights = response.to_values[:, problem.values_of(sensor.place)].T
        factor = whitener_of_sensor(problem, sensor).factor_of(weights)
        covariance = covariance + sensor.size**2 * (factor.T @ factor)
    for function in disturbances.functions:
        weights = _weights_of_force(problem, response, function.equation)
        values = problem.function_values[function.state]
        answer = function.size * (values.T @ weights)
        covariance = covariance + answer.T @ answer
    return covariance


def _weights_of_force(
    problem: Linearization, response: Response, equation: int
) -> np.ndarray:
    """Answer to a force of one in each interval, (n_intervals, n_theta)."""
    weights: np.ndarray = problem.dynamics_of_force(equation).T @ response.to_dynamics.T
    return weights

"""A covariance, and how well it is itself known: its degrees of freedom.

The sizes of disturbances are estimated, and so is every variance that follows from
them. Satterthwaite's rule gives the chi-square distribution that scatters alike
(Biometrics Bulletin 2, 1946; for sizes found by restricted likelihood, Kenward and
Roger, Biometrics 53, 1997)::

    freedom = 2 variance^2 / Var(variance)

How surely the sizes are known is told by the average information (Gilmour, Thompson and
Cullis, Biometrics 51, 1995), which the search for them has anyway.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

import numpy as np

from phsi_opt.criteria import CHANCE_LEVEL
from phsi_opt.errors import SolveError
from phsi_opt.model_error.disturbance_search import DisturbanceSearch, Evidence
from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.marginal_likelihood import Border
from phsi_opt.optimization.bounded_step import RIDGE
from phsi_opt.statistics import chi_square_tail

LOG_STEP = 0.1  # of logarithms of sizes and times, for slopes
FEWEST = 3.0  # degrees of freedom; with fewer a variance means nothing
MOST = 1e9  # degrees of freedom of a variance that is as good as known


@dataclass(frozen=True, eq=False)
class Spread:
    """A covariance of the scaled parameters, and how well it is known.

    Attributes:
        covariance: (n_theta, n_theta).
        freedom: (n_theta,) degrees of freedom of the variances.
    """

    covariance: np.ndarray
    freedom: np.ndarray


def degrees_of_freedom(
    information: np.ndarray,
    log_variances: Callable[[np.ndarray], np.ndarray],
    is_free: np.ndarray,
) -> np.ndarray:
    """Degrees of freedom of variances that follow from estimated logarithms.

    Args:
        information: of estimated logarithms, (n_coordinates, n_coordinates).
        log_variances: logarithms of the variances, (n,), of a vector (n_coordinates,)
            that is zero at the estimate.
        is_free: (n_coordinates,) whether a coordinate was estimated, and is not given
            by a bound.

    Returns:
        (n,), from `FEWEST` to `MOST`.
    """
    if not is_free.any():
        at_zero = log_variances(np.zeros(len(is_free)))
        return np.full(len(at_zero), MOST)
    units = LOG_STEP * np.eye(len(is_free))[is_free]
    values, vectors = np.linalg.eigh(information[np.ix_(is_free, is_free)])
    # A size that the record tells no better is known to a factor of four.
    spread = 1 / np.maximum(values, 0.5)
    covariance = (vectors * spread) @ vectors.T
    changes = [log_variances(unit) - log_variances(-unit) for unit in units]
    slopes = np.array(changes) / (2 * LOG_STEP)
    variance = np.einsum("in,ij,jn->n", slopes, covariance, slopes)
    return np.maximum(2 / np.maximum(variance, 2 / MOST), FEWEST)


# Trajectories of equal weight from which their scatter gives the standard errors: with
# ten a standard error is itself known to a quarter.
FEWEST_TRAJECTORIES = 10.0


@dataclass(frozen=True, eq=False)
class Clusters:
    """What every trajectory says of the parameters, at an estimate.

    Behind the parameters may stand other unknowns that all trajectories share, such as
    the coefficients of functions of states.

    Attributes:
        scores: (n_trajectories, n) slopes of the log likelihood.
        information: (n_trajectories, n, n).
        prior: (n, n) information that is not the trajectories'.
        n_theta: number of parameters, the first of the n unknowns.
        score_variance: of scores over the information, where noise is all there is; one
            unless residuals were cut.
    """

    scores: np.ndarray
    information: np.ndarray
    prior: np.ndarray
    n_theta: int
    score_variance: float = 1.0

    @classmethod
    def of(
        cls,
        problem: Linearization,
        in_theta: np.ndarray,
        sigma: np.ndarray,
        within: float = 1.0,
        score_variance: float = 1.0,
    ) -> "Clusters":
        """Of a plain likelihood.

        Args:
            problem: the linearised record.
            in_theta: (n_values, n_theta) slope of what is shown in the scaled
                parameters when the states follow them.
            sigma: (n_trajectories, n_states) noise of the plain likelihood.
            within: share of the residuals that are not cut: the others do not move an
                estimate.
            score_variance: of scores over that information.
        """
        weight = 1 / problem.of_values(sigma)
        slopes = in_theta * weight[:, None]
        residual = problem.residual * weight
        run = problem.grid.trajectory[problem.node]
        n_theta = in_theta.shape[1]
        scores = np.zeros((problem.n_trajectories, n_theta))
        information = np.zeros((problem.n_trajectories, n_theta, n_theta))
        # Values stand trajectory after trajectory.
        limits = np.searchsorted(run, np.arange(problem.n_trajectories + 1))
        for number, (begin, end) in enumerate(pairwise(limits.tolist())):
            of_run = slopes[begin:end]
            scores[number] = of_run.T @ residual[begin:end]
            information[number] = within * (of_run.T @ of_run)
        prior = RIDGE * np.eye(n_theta)
        return cls(scores, information, prior, n_theta, score_variance)

    @classmethod
    def of_borders(cls, borders: Sequence[Border], step: np.ndarray) -> "Clusters":
        """Of a likelihood with disturbances.

        Args:
            borders: of every trajectory.
            step: (n_border,) to the optimum of all trajectories together.
        """
        scores = [border.gradient - border.information @ step for border in borders]
        information = [border.information for border in borders]
        first = borders[0]
        prior = first.precision - first.information
        return cls(np.array(scores), np.array(information), prior, first.n_theta)

    @property
    def n_clusters(self) -> int:
        """Number of trajectories."""
        return len(self.scores)

    @property
    def _everything(self) -> np.ndarray:
        everything: np.ndarray = self.information.sum(axis=0) + self.prior
        return everything

    def jackknife(self) -> np.ndarray:
        """Covariance of the scaled estimate, (n_theta, n_theta).

        ::

            (n - 1)/n sum over trajectories of d d',   d = (I - I_g)^-1 s_g
        """
        everything = self._everything
        moves = []
        for score, own in zip(self.scores, self.information, strict=True):
            moves.append(np.linalg.lstsq(everything - own, score)[0])
        shifts = np.array(moves)[:, : self.n_theta]
        n = self.n_clusters
        covariance: np.ndarray = (n - 1) / n * (shifts.T @ shifts)
        return covariance

    def effective_numbers(self) -> np.ndarray:
        """Number of equal trajectories that they are worth, per parameter, (n_theta,).

        ::

            n / (1 + variance of a trajectory's share / squared mean share)

        0 for a parameter of which no trajectory tells anything.
        """
        bread = np.linalg.pinv(self._everything)[: self.n_theta]
        shares = np.einsum("jp,gpq,jq->gj", bread, self.information, bread)
        squared_mean = np.mean(shares, axis=0) ** 2
        nothing_told = np.full_like(squared_mean, np.inf)
        spread = np.divide(
            np.var(shares, axis=0),
            squared_mean,
            out=nothing_told,
            where=squared_mean > 0,
        )
        numbers: np.ndarray = self.n_clusters / (1 + spread)
        return numbers

    @property
    def is_enough(self) -> bool:
        """Whether their scatter says how uncertain the parameters are."""
        if self.n_clusters < FEWEST_TRAJECTORIES or not self.n_theta:
            return False
        return bool(self.effective_numbers().min() >= FEWEST_TRAJECTORIES)

    def spread(self, moving: np.ndarray, n_theta: int) -> Spread:
        """Covariance and degrees of freedom among all parameters.

        Args:
            moving: (n_moving,) places of the parameters of the clusters.
            n_theta: number of all parameters; those that do not move have no variance.
        """
        covariance = np.zeros((n_theta, n_theta))
        covariance[np.ix_(moving, moving)] = self.jackknife()
        freedom = np.ones(n_theta)
        freedom[moving] = np.maximum(self.effective_numbers() - 1, 1.0)
        return Spread(covariance, freedom)

    def agreement(self) -> float:
        """p-value of the hypothesis that trajectories differ by noise alone.

        The sum over trajectories of s' I_g^+ s, over the variance of the scores, is
        chi-square distributed with as many degrees of freedom as the trajectories'
        informations have directions, less those of the estimate (Cochran, Biometrics
        10, 1954).
        """
        own = self.information
        inverses = np.linalg.pinv(own, rcond=RIDGE, hermitian=True)
        squares = np.einsum("gp,gpq,gq->g", self.scores, inverses, self.scores)
        statistic = float(np.sum(squares)) / self.score_variance
        ranks = np.linalg.matrix_rank(own, rtol=RIDGE, hermitian=True)
        freedom = int(np.sum(ranks)) - self.scores.shape[1]
        return chi_square_tail(statistic, freedom) if freedom > 0 else 1.0


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
    def response(self) -> np.ndarray:
        """How it answers errors.

        Raises:
            SolveError: the states do not follow from the data.
        """
        white = Disturbances(self.sigma)
        return self.search.likelihood(white).at(white).response / self.within

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


def noise_freedom(problem: Linearization) -> np.ndarray:
    """Degrees of freedom where noise is the only disturbance, (n_theta,)."""
    n_theta = problem.n_theta
    return np.full(n_theta, max(float(problem.n_values - n_theta), 1.0))


def standard_errors(plain: PlainEstimate) -> StandardErrors:
    """The standard errors of a plain estimate."""
    of_noise = Spread(plain.covariance, noise_freedom(plain.problem))
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
        log_evidence = plain.search.likelihood(found).at(found).log_model_evidence
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
    search: DisturbanceSearch, response: np.ndarray, best: Evidence
) -> Spread:
    """Covariance of an estimate under the disturbances that were found.

    Args:
        search: by which they were found.
        response: of the estimate.
        best: what was found.
    """
    problem = search.problem
    coordinates = best.coordinates
    freedom = noise_freedom(problem)
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
    problem: Linearization, response: np.ndarray, disturbances: Disturbances
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
    of_noise = response[:, : problem.n_values] * problem.of_values(disturbances.sigma)
    covariance = of_noise @ of_noise.T
    sites = [problem.site_of_force(force.place) for force in disturbances.forces]
    sites += [problem.site_of_sensor(sensor.place) for sensor in disturbances.sensors]
    for process, site in zip(disturbances.processes, sites, strict=True):
        weights = site.effects.T @ response.T
        factor = site.whitener(process.time).factor_of(weights)
        covariance = covariance + process.size**2 * (factor.T @ factor)
    for function in disturbances.functions:
        weights = problem.site_of_force(function.equation).effects.T @ response.T
        values = problem.function_values[function.state]
        answer = function.size * (values.T @ weights)
        covariance = covariance + answer.T @ answer
    return covariance

"""Which standard errors a fit gives, and how well they are known themselves.

- White noise: no disturbance shows in the record, and trajectories agree as far as the
  noise lets them.
- Trajectories: there are many of them, and their scatter gives the covariance.
- Disturbances: they are estimated from the record, and the covariance of the estimates
  follows from them.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from phsi_opt.criteria import CHANCE_LEVEL, SURE_LEVEL
from phsi_opt.errors import SolveError
from phsi_opt.model_error.ascent import Evidence
from phsi_opt.model_error.disturbance_search import DisturbanceSearch
from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.marginal_likelihood import Border
from phsi_opt.optimization.bounded_step import REGULAR, RIDGE
from phsi_opt.statistics import TINY, autocorrelation_time, chi_square_tail

LOG_STEP = 0.1  # of logarithms of sizes and times, for slopes


class Source(StrEnum):
    """Where standard errors come from."""

    NOISE = "white noise"
    TRAJECTORIES = "scatter between trajectories"
    DISTURBANCES = "model error"


@dataclass(frozen=True, eq=False)
class Spread:
    """A covariance of the scaled parameters, and how well it is known."""

    covariance: np.ndarray  # (n_theta, n_theta)
    freedom: np.ndarray  # (n_theta,) degrees of freedom of the variances


# --- Scatter between trajectories


@dataclass(frozen=True, eq=False)
class Clusters:
    """The likelihood of every trajectory at an estimate.

    Where there are many trajectories, each of them an experiment of its own, their
    scores show how much the estimates scatter, whatever the errors within a trajectory
    are. The covariance is that of the jackknife that leaves out one trajectory at a
    time (CR3 of Bell and McCaffrey, Survey Methodology 28, 2002); trajectories with
    more information than others count as fewer (Carter, Schnepel and Steigerwald,
    Review of Economics and Statistics 99, 2017).
    """

    # (n_trajectories, n) slopes of the log likelihood in the parameters, and in the
    # coefficients of functions of states.
    scores: np.ndarray
    information: np.ndarray  # (n_trajectories, n, n)
    prior: np.ndarray  # (n, n) information that is not the trajectories'
    of_theta: np.ndarray  # (n_theta,) of it that of the parameters' own priors
    n_theta: int  # number of parameters, the first of the n unknowns
    # Of scores over the information, where noise is the only disturbance; one unless
    # residuals were cut.
    score_variance: float = 1.0

    @classmethod
    def of(cls, borders: Sequence[Border], step: np.ndarray) -> "Clusters":
        """Of the borders of all trajectories, after a step (n_border,)."""
        return cls(
            scores=np.array([one.gradient - one.information @ step for one in borders]),
            information=np.array([one.information for one in borders]),
            prior=np.diag(borders[0].prior),
            of_theta=borders[0].of_theta,
            n_theta=borders[0].n_theta,
        )

    @classmethod
    def of_white(
        cls, search: DisturbanceSearch, within: float, score_variance: float
    ) -> "Clusters":
        """Of an estimate by white noise; arguments as those of `standard_errors`.

        Raises:
            SolveError: the states do not follow from the data.
        """
        white = Disturbances(search.plain)
        borders = search.likelihood(white).at(white, REGULAR).borders_by_trajectory()
        found = cls.of(borders, np.zeros(len(search.moving)))
        information = within * found.information
        return replace(found, information=information, score_variance=score_variance)

    @property
    def _everything(self) -> np.ndarray:
        everything: np.ndarray = self.information.sum(axis=0) + self.prior
        return everything

    def jackknife(self) -> np.ndarray:
        """Covariance of the scaled estimate, (n_theta, n_theta).

        ::

            (n - 1)/n sum over trajectories of d d',   d = (I - I_g)^-1 s_g

        and what the errors of the priors' means add.
        """
        everything = self._everything
        moves = []
        for score, own in zip(self.scores, self.information, strict=True):
            moves.append(np.linalg.lstsq(everything - own, score)[0])
        shifts = np.array(moves)[:, : self.n_theta]
        n = len(self.scores)
        covariance: np.ndarray = (n - 1) / n * (shifts.T @ shifts)
        answer = np.linalg.pinv(everything)[: self.n_theta, : self.n_theta]
        return covariance + (answer * self.of_theta) @ answer.T

    def effective_numbers(self) -> np.ndarray:
        """Number of equal trajectories that they are worth, per parameter, (n_theta,).

        ::

            n / (1 + variance of a trajectory's share / squared mean share)

        0 for a parameter without information.
        """
        bread = np.linalg.pinv(self._everything)[: self.n_theta]
        shares = np.einsum("jp,gpq,jq->gj", bread, self.information, bread)
        squared_mean = np.mean(shares, axis=0) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = np.var(shares, axis=0) / squared_mean
        spread = np.where(squared_mean > 0, spread, np.inf)
        numbers: np.ndarray = len(self.scores) / (1 + spread)
        return numbers

    @property
    def is_enough(self) -> bool:
        """Whether their scatter shows how uncertain the parameters are.

        With ten of equal weight a standard error is itself known to a quarter.
        """
        if len(self.scores) < 10 or not self.n_theta:
            return False
        return bool(self.effective_numbers().min() >= 10)

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


def are_independent(problem: Linearization) -> bool:
    """Whether the residuals of trajectories are not alike at equal places.

    The sum of n independent residuals has n times the mean square of one. Where all
    share an error, as repetitions of an experiment share that of the model, it has
    more, and their scatter does not show this error. Residuals that last count as few
    (`autocorrelation_time`).
    """
    runs = problem.grid.run_of_value
    sizes = problem.grid.rms_by_channel(problem.residual)[problem.grid.channel]
    split = np.split(
        problem.residual / np.maximum(sizes, TINY), np.flatnonzero(np.diff(runs)) + 1
    )
    length = min(map(len, split))
    together = np.array([one[:length] for one in split])
    squares = np.sum(together.sum(axis=0) ** 2) / max(np.mean(together**2), TINY)
    freedom = length / autocorrelation_time(list(together))
    return (
        chi_square_tail(squares / length / len(split) * freedom, freedom) > SURE_LEVEL
    )


# --- Of an estimate that counts residuals as white noise


@dataclass(frozen=True, eq=False)
class StandardErrors:
    """The standard errors of an estimate."""

    source: Source  # of those that are given
    spreads: Mapping[Source, Spread]  # all that were worked out, by source
    disturbances: Disturbances  # that were found
    log_evidence: float  # of the model with them; NaN where numbers do not hold it

    @property
    def spread(self) -> Spread:
        return self.spreads[self.source]


def standard_errors(
    search: DisturbanceSearch,
    covariance: np.ndarray,
    is_shared: bool,
    within: float = 1.0,
    score_variance: float = 1.0,
) -> StandardErrors:
    """The standard errors of an estimate that counts residuals as white noise.

    Args:
        search: for disturbances, on its linearised likelihood.
        covariance: (n_theta, n_theta) of the scaled parameters, from noise alone.
        is_shared: whether all trajectories share all parameters.
        within: share of the residuals that are not cut by Huber's loss.
        score_variance: of the scores over the information that the residuals within
            carry; one where none is cut.
    """
    spreads = {Source.NOISE: Spread(covariance, _noise_freedom(search.problem))}
    white = Disturbances(search.plain)
    found = white
    source = Source.NOISE
    log_evidence = np.nan
    # Beyond what numbers hold are slopes of 1e300, noise of 1e-14.
    beyond_numbers = (SolveError, np.linalg.LinAlgError)
    with suppress(*beyond_numbers):
        if search.is_promising:
            best = search.found()
            if best.coordinates is not None:
                response = search.likelihood(white).at(white).response / within
                spread = under_disturbances(search, response, best)
                spreads[Source.DISTURBANCES] = spread
                found = best.disturbances
                source = Source.DISTURBANCES
    with suppress(*beyond_numbers):
        if is_shared and are_independent(search.problem):
            clusters = Clusters.of_white(search, within, score_variance)
            if clusters.is_enough:
                spread = clusters.spread(search.moving, len(covariance))
                spreads[Source.TRAJECTORIES] = spread
                if source == Source.DISTURBANCES or clusters.agreement() < CHANCE_LEVEL:
                    source = Source.TRAJECTORIES
    with suppress(*beyond_numbers):
        log_evidence = search.likelihood(found).at(found).log_model_evidence
    return StandardErrors(source, spreads, found, log_evidence)


def _noise_freedom(problem: Linearization) -> np.ndarray:
    """Degrees of freedom where noise is the only disturbance, (n_theta,)."""
    n_theta = problem.n_theta
    return np.full(n_theta, max(float(problem.n_values - n_theta), 1.0))


# --- Under disturbances


def under_disturbances(
    search: DisturbanceSearch, response: np.ndarray, best: Evidence
) -> Spread:
    """Covariance of an estimate under the disturbances that were found.

    Args:
        search: by which they were found.
        response: of the estimate, as `OptimalitySystem.response`.
        best: what was found.
    """
    problem = search.problem
    coordinates = best.coordinates
    freedom = _noise_freedom(problem)
    covariance = covariance_under(problem, response, best.disturbances)
    if coordinates is None or best.information is None:
        return Spread(covariance, freedom)

    def log_variances(vector: np.ndarray) -> np.ndarray:
        there = covariance_under(problem, response, coordinates.at(vector))
        variances = np.diag(there)[search.moving]
        return np.log(np.maximum(variances, np.finfo(float).tiny))

    is_free = coordinates.is_free(LOG_STEP)
    found = degrees_of_freedom(best.information, log_variances, is_free)
    freedom[search.moving] = np.minimum(found, freedom[search.moving])
    return Spread(covariance, freedom)


def covariance_under(
    problem: Linearization, response: np.ndarray, disturbances: Disturbances
) -> np.ndarray:
    """Covariance of the scaled plain estimate, (n_theta, n_theta).

    Estimates that count every residual as independent noise are still good ones when it
    is not; their covariance is another one. To first order an estimate moves with every
    error in what was shown and with every force in the dynamics; the covariance of
    these, under the disturbances that are estimated from the record, gives that of the
    estimate (White, Econometrica 50, 1982, with the covariance of the scores from a
    model of them).

    Args:
        problem: the linearised record.
        response: of the estimate, as `OptimalitySystem.response`.
        disturbances: with their sizes.
    """
    of_noise = response[:, : problem.n_values] * problem.of_values(disturbances.sigma)
    n_data = problem.n_values + len(problem.offset)
    of_priors = response[:, n_data:]
    covariance = of_noise @ of_noise.T + of_priors @ of_priors.T
    response = response[:, :n_data]
    sites = problem.sites(disturbances)
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


def degrees_of_freedom(
    information: np.ndarray,
    log_variances: Callable[[np.ndarray], np.ndarray],
    is_free: np.ndarray,
    fewest: float = 3.0,
    most: float = 1e9,
) -> np.ndarray:
    """Degrees of freedom of variances that follow from estimated sizes and times.

    Those of the chi-square distribution that scatters alike (Satterthwaite, Biometrics
    Bulletin 2, 1946; for sizes found by restricted likelihood, Kenward and Roger,
    Biometrics 53, 1997)::

        freedom = 2 variance^2 / Var(variance)

    Args:
        information: average information of the estimated logarithms, (n_coordinates,
            n_coordinates).
        log_variances: logarithms of the variances, (n,), of a vector (n_coordinates,)
            that is zero at the estimate.
        is_free: (n_coordinates,) whether a coordinate was estimated, and is not given
            by a bound.
        fewest: degrees of freedom; with fewer a variance means nothing.
        most: those of a variance that is as good as known.

    Returns:
        (n,).
    """
    if not is_free.any():
        at_zero = log_variances(np.zeros(len(is_free)))
        return np.full(len(at_zero), most)
    units = LOG_STEP * np.eye(len(is_free))[is_free]
    values, vectors = np.linalg.eigh(information[np.ix_(is_free, is_free)])
    # A size with less information is known to a factor of four.
    spread = 1 / np.maximum(values, 0.5)
    covariance = (vectors * spread) @ vectors.T
    changes = [log_variances(unit) - log_variances(-unit) for unit in units]
    slopes = np.array(changes) / (2 * LOG_STEP)
    variance = np.einsum("in,ij,jn->n", slopes, covariance, slopes)
    return np.maximum(2 / np.maximum(variance, 2 / most), fewest)

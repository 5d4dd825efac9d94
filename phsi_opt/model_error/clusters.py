"""Covariance of estimates from the scatter between trajectories.

Where there are many trajectories, each of them an experiment of its own, their scores
say how much the estimates scatter, whatever the errors within a trajectory are. The
covariance is that of the jackknife that leaves out one trajectory at a time (CR3 of
Bell and McCaffrey, Survey Methodology 28, 2002); trajectories that say more than others
count as fewer (Carter, Schnepel and Steigerwald, Review of Economics and Statistics 99,
2017).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from phsi_opt.model_error.freedom import Spread
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.marginal_likelihood import Border, noise_weights
from phsi_opt.statistics import chi_square_tail
from phsi_opt.transcription.elimination import RIDGE

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
        weight = noise_weights(problem, sigma)
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
    def of_borders(
        cls, borders: Sequence[Border], sizes: np.ndarray, step: np.ndarray
    ) -> "Clusters":
        """Of a likelihood with disturbances.

        Args:
            borders: of every trajectory.
            sizes: (n_functions,) of the functions of states.
            step: (n_border,) to the optimum of all trajectories together.
        """
        scores = [border.gradient - border.information @ step for border in borders]
        information = [border.information for border in borders]
        first = borders[0]
        prior = first.with_priors(sizes) - first.information
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

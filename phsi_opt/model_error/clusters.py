"""Covariance of plain estimates from the scatter between trajectories.

Where there are many trajectories, each of them an experiment of its own, their scores
say how much the estimates scatter, whatever the errors within a trajectory are. The
covariance is that of the jackknife that leaves out one trajectory at a time (CR3 of Bell
and McCaffrey, Survey Methodology 28, 2002); trajectories that say more than others count
as fewer (Carter, Schnepel and Steigerwald, Review of Economics and Statistics 99, 2017).
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.marginal_likelihood import noise_weights
from phsi_opt.transcription.elimination import RIDGE


@dataclass(frozen=True, eq=False)
class Clusters:
    """What every trajectory says of the parameters, at the plain estimate.

    Attributes:
        scores: (n_trajectories, n_theta) slopes of the log likelihood.
        information: (n_trajectories, n_theta, n_theta).
    """

    scores: np.ndarray
    information: np.ndarray

    @classmethod
    def of(
        cls, problem: Linearization, in_theta: np.ndarray, sigma: np.ndarray
    ) -> "Clusters":
        """Of a linearised record.

        Args:
            problem: the linearised record.
            in_theta: (n_values, n_theta) slope of what is shown in the scaled
                parameters when the states follow them.
            sigma: (n_trajectories, n_states) noise of the plain likelihood.
        """
        weight = noise_weights(problem, sigma)
        slopes = in_theta * weight[:, None]
        residual = problem.residual * weight
        run = problem.grid.trajectory[problem.node]
        n_theta = in_theta.shape[1]
        scores = np.zeros((problem.n_trajectories, n_theta))
        information = np.zeros((problem.n_trajectories, n_theta, n_theta))
        for number in range(problem.n_trajectories):
            is_in = run == number
            of_run = slopes[is_in]
            scores[number] = of_run.T @ residual[is_in]
            information[number] = of_run.T @ of_run
        return cls(scores, information)

    @property
    def n_clusters(self) -> int:
        """Number of trajectories."""
        return len(self.scores)

    def jackknife(self) -> np.ndarray:
        """Covariance of the scaled estimate, (n_theta, n_theta).

        ::

            (n - 1)/n sum over trajectories of d d',   d = (I - I_g)^-1 s_g
        """
        everything = self.information.sum(axis=0)
        ridge = RIDGE * np.eye(len(everything))
        moves = []
        for score, own in zip(self.scores, self.information, strict=True):
            moves.append(np.linalg.solve(everything - own + ridge, score))
        shifts = np.array(moves)
        n = self.n_clusters
        covariance: np.ndarray = (n - 1) / n * (shifts.T @ shifts)
        return covariance

    def effective_numbers(self) -> np.ndarray:
        """Number of equal trajectories that they are worth, per parameter, (n_theta,).

        ::

            n / (1 + variance of a trajectory's share / squared mean share)
        """
        everything = self.information.sum(axis=0)
        bread = np.linalg.inv(everything + RIDGE * np.eye(len(everything)))
        shares = np.einsum("jp,gpq,qj->gj", bread, self.information, bread)
        spread = np.var(shares, axis=0) / np.mean(shares, axis=0) ** 2
        numbers: np.ndarray = self.n_clusters / (1 + spread)
        return numbers

    def agreement(self) -> float:
        """p-value of the hypothesis that trajectories differ by noise alone.

        The sum over trajectories of s' I_g^+ s is chi-square distributed with as many
        degrees of freedom as the trajectories' informations have directions, less those
        of the estimate (Cochran, Biometrics 10, 1954).
        """
        statistic = 0.0
        freedom = 0
        for score, own in zip(self.scores, self.information, strict=True):
            inverse = np.linalg.pinv(own, rcond=RIDGE, hermitian=True)
            statistic += float(score @ inverse @ score)
            freedom += int(np.linalg.matrix_rank(own, tol=RIDGE, hermitian=True))
        freedom -= self.scores.shape[1]
        return float(chi2.sf(statistic, freedom)) if freedom > 0 else 1.0

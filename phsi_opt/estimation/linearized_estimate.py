"""The solution of a likelihood, linearised: what standard errors are worked out from.

In the scale of the program; the record of slopes is that of ``phsi_opt.model_error``.
"""

from dataclasses import dataclass, replace

import numpy as np

from phsi_opt.data.noise import scatter_by_run
from phsi_opt.estimation.identifiability import SilentDirections
from phsi_opt.estimation.problem import Task
from phsi_opt.estimation.transcription import Transcription
from phsi_opt.model_error.disturbance_search import DisturbanceSearch
from phsi_opt.model_error.gaps import between_samples
from phsi_opt.model_error.linearization import Linearization, linearized
from phsi_opt.model_error.standard_errors import PlainEstimate
from phsi_opt.optimization.ipopt import Solution
from phsi_opt.transcription.elimination import ReducedSystem, regularized_inverse


@dataclass(frozen=True, eq=False)
class SolvedLikelihood:
    """The parts of a solved likelihood that are looked at together.

    Attributes:
        task: what was asked for.
        transcription: what was solved, or what forces were added to.
        theta: (n_theta,) estimates of the parameters.
        nodes: (n_nodes, n_states) states.
        solution: of the program.
        sigma: (n_states,) noise.
        is_known: (n_states,) whether it was declared.
        silent: directions of the parameters about which the data say nothing.
    """

    task: Task
    transcription: Transcription
    theta: np.ndarray
    nodes: np.ndarray
    solution: Solution
    sigma: np.ndarray
    is_known: np.ndarray
    silent: SilentDirections

    @property
    def held(self) -> list[int]:
        """Places of parameters that ended at a bound."""
        at_bounds = self.solution.outcome.at_bounds
        names = self.transcription.unknown.names
        return [i for i, name in enumerate(names) if name in at_bounds]

    def linearized(self) -> Linearization:
        """Slopes of dynamics and sensors at the solution."""
        values = self.transcription.values
        z = np.concatenate([self.theta, self.nodes.ravel()]) / values.point.scale
        return linearized(values, z, values.at(z))

    def plain(
        self,
        reduced: ReducedSystem,
        residual: np.ndarray,
        within: float,
        score_variance: float,
    ) -> PlainEstimate:
        """The estimate as one that counts residuals as white noise.

        Args:
            reduced: the likelihood with its states eliminated.
            residual: (n_values,) measured minus shown, cut where the loss cuts it.
            within: share of the residuals that are not cut.
            score_variance: of the scores over the information of those within.
        """
        problem = between_samples(replace(self.linearized(), residual=residual))
        covariance = regularized_inverse(reduced.information, self.held)
        n_theta = len(covariance)
        following = reduced.following[self.transcription.grid.sample]
        following = following.reshape(problem.nodes.size, n_theta)
        in_theta = problem.shown_in_states @ following + problem.shown_in_theta
        return PlainEstimate(
            search=self.search(problem),
            covariance=covariance,
            in_theta=in_theta,
            is_shared=self.transcription.unknown.is_shared,
            within=within,
            score_variance=score_variance,
        )

    def search(self, problem: Linearization) -> DisturbanceSearch:
        """The search for what acts beside the model, from the noise of the solution.

        Parameters at a bound stay there, and so do as many as the data cannot tell from
        others: a likelihood that is flat along a direction has no finite marginal.
        """
        shape = (problem.n_trajectories, len(self.sigma))
        measured = problem.grid.measured.any(axis=0)
        channels = np.flatnonzero(measured & ~self.is_known).tolist()
        scatter = scatter_by_run(self.task.data)
        scatter = np.where(self.is_known, self.sigma, scatter)
        stays = {*self.held, *self.silent.pinned}
        moving = [i for i in range(len(self.theta)) if i not in stays]
        return DisturbanceSearch(
            problem=problem,
            moving=np.array(moving, dtype=int),
            plain=np.broadcast_to(self.sigma, shape).copy(),
            scatter=scatter,
            channels=tuple(channels),
            is_brief=not self.task.settings.thorough,
        )

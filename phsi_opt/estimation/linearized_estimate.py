"""The solution of a likelihood, linearised: what standard errors are worked out from.

In the scale of the program; the record of slopes is that of ``phsi_opt.model_error``.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix, diags

from phsi_opt.data.noise_by_run import scatter_by_run
from phsi_opt.estimation.identifiability import SilentDirections
from phsi_opt.estimation.problem import Task
from phsi_opt.model.model import Model
from phsi_opt.model.structure import forced_rows
from phsi_opt.model_error.disturbance_search import DisturbanceSearch
from phsi_opt.model_error.gaps import between_samples
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.standard_errors import PlainEstimate
from phsi_opt.optimization.ipopt import Solution
from phsi_opt.transcription.elimination import ReducedSystem, regularized_inverse
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.point import Point
from phsi_opt.transcription.sensors import SensorOutputs, output_slopes_in_theta


@dataclass(frozen=True, eq=False)
class SolvedLikelihood:
    """The parts of a solved likelihood that are looked at together.

    Attributes:
        task: what was asked for.
        model: with the terms that are left.
        grid: nodes and intervals.
        unknown: names and places of the parameters.
        theta: (n_theta,) their estimates.
        nodes: (n_nodes, n_states) states.
        point: with the scale of each unknown.
        solution: of the program, whose variables begin with theta and the states.
        sigma: (n_states,) noise.
        is_known: (n_states,) whether it was declared.
        silent: directions of the parameters about which the data say nothing.
    """

    task: Task
    model: Model
    grid: Grid
    unknown: Theta
    theta: np.ndarray
    nodes: np.ndarray
    point: Point
    solution: Solution
    sigma: np.ndarray
    is_known: np.ndarray
    silent: SilentDirections

    @property
    def held(self) -> list[int]:
        """Places of parameters that ended at a bound."""
        at_bounds = self.solution.outcome.at_bounds
        return [i for i, name in enumerate(self.unknown.names) if name in at_bounds]

    def linearized(self) -> Linearization:
        """Slopes of dynamics and sensors at the solution."""
        grid = self.grid
        point = self.point
        n_defects = grid.n_intervals * self.model.n_states
        jacobian = self.solution.kkt.of_first(n_defects)
        offset = np.zeros(n_defects)
        if jacobian.shape[1] > point.of_x.stop:
            # What the disturbances do to the dynamics, in which they are linear.
            disturbances = slice(point.of_x.stop, None)
            offset -= jacobian[:, disturbances] @ self.solution.z[disturbances]
        of_runs = np.asarray(self.unknown.by_trajectory(self.theta))
        sensors = SensorOutputs.at(self.model, grid, self.nodes, of_runs)
        slopes = csr_matrix(sensors.jacobian)
        in_theta = output_slopes_in_theta(self.unknown, grid, self.nodes, self.theta)
        measured = np.flatnonzero(grid.measured.ravel())
        n_states = self.model.n_states
        x_scale = np.tile(self.point.x_scale, grid.n_nodes)
        slopes.data *= x_scale[slopes.indices]
        theta_scale = point.theta_scale
        in_theta = in_theta.reshape(self.nodes.size, len(theta_scale))
        shown_in_theta = in_theta * theta_scale
        memory = self.model.memory
        observed = [k for k, name in enumerate(self.model.states) if name not in memory]
        return Linearization(
            grid=grid,
            nodes=self.nodes,
            dynamics_in_states=jacobian[:, point.of_x],
            dynamics_in_theta=jacobian[:, point.of_theta].toarray(),
            force_effects=self._force_effects(),
            offset=offset,
            shown_in_states=slopes[measured],
            shown_in_theta=shown_in_theta[measured],
            residual=(grid.y - sensors.values).ravel()[measured],
            node=measured // n_states,
            channel=measured % n_states,
            x_scale=self.point.x_scale,
            theta_scale=theta_scale,
            forced=forced_rows(self.model),
            observed=tuple(observed),
        )

    def _force_effects(self) -> csc_matrix:
        """A force enters its own equation, times the length of the interval."""
        lengths = self.grid.h[:, None] / self.point.x_scale
        return csc_matrix(diags(lengths.ravel()))

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
        following = reduced.following[self.grid.sample]
        following = following.reshape(problem.nodes.size, n_theta)
        in_theta = problem.shown_in_states @ following + problem.shown_in_theta
        return PlainEstimate(
            search=self.search(problem),
            covariance=covariance,
            in_theta=in_theta,
            is_shared=self.unknown.is_shared,
            within=within,
            score_variance=score_variance,
        )

    def search(self, problem: Linearization) -> DisturbanceSearch:
        """The search for what acts beside the model, from the noise of the solution.

        Parameters at a bound stay there, and so do as many as the data cannot tell from
        others: a likelihood that is flat along a direction has no finite marginal.
        """
        shape = (problem.n_trajectories, len(self.sigma))
        measured = self.grid.measured.any(axis=0)
        channels = np.flatnonzero(measured & ~self.is_known).tolist()
        scatter = scatter_by_run(self.task.data)
        scatter = np.where(self.is_known, self.sigma, scatter)
        n_theta = len(self.unknown)
        stays = {*self.held, *self.silent.pinned}
        moving = [i for i in range(n_theta) if i not in stays]
        return DisturbanceSearch(
            problem=problem,
            moving=np.array(moving, dtype=int),
            plain=np.broadcast_to(self.sigma, shape).copy(),
            scatter=scatter,
            channels=tuple(channels),
            is_brief=not self.task.settings.thorough,
        )

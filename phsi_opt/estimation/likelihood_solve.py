"""The likelihood of a task, maximised from a starting point.

Full steps (`likelihood_steps`); where the start is not near, along a missing force that
shrinks; where the steps do not settle, and where the program has slack variables, IPOPT
(`likelihood_ipopt`). Where to start is the business of `likelihood_start`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_ipopt import by_ipopt
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem
from phsi_opt.estimation.likelihood_steps import Optimum, by_steps, continued
from phsi_opt.estimation.noise_estimation import NoiseIteration
from phsi_opt.estimation.problem import Task
from phsi_opt.estimation.residual_scatter import is_at_scatter
from phsi_opt.estimation.starting_point import StartingPoint
from phsi_opt.estimation.transcription import Transcription
from phsi_opt.initialization.scaling import point_at
from phsi_opt.transcription.augmented_states import memory_start_bounds
from phsi_opt.transcription.grid import interpolate_at_nodes
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta

FIRST_STEPS = 12  # from a crude start: few are enough where it is near
# The memory that a trajectory begins with is free; that of a short delay fades within a
# few samples. With coarse steps there it could take values far off for the sake of the
# first residuals, and a simulation from them would go astray.
FADING_GAPS = 4  # gaps between samples from the start
FADING_STEPS = 16  # intervals in each of them, at least


@dataclass(frozen=True, eq=False)
class LikelihoodSolver:
    """Maximises the likelihood of a problem.

    Noise that is not known is re-estimated until it stays.
    """

    problem: LikelihoodProblem

    @property
    def task(self) -> Task:
        """What was asked for."""
        return self.problem.task

    @property
    def loss(self) -> MaximumLikelihood:
        """The likelihood."""
        return self.problem.loss

    def solve_from(self, start: StartingPoint) -> LikelihoodEstimate:
        """The optimum of the whole record, however far off the start is.

        Where steps from the start lead to an optimum that leaves more than the scatter
        of the samples, the likelier of this and of the one along the missing force.
        """
        start = replace(start, steps=self._steps(start))
        if self.task.settings.thorough and not start.is_optimum:
            found = []
            if self.task.settings.has_own_steps:
                near = self.solve(start, most_steps=FIRST_STEPS)
                if near.is_success and is_at_scatter(near):
                    return near
                found.append(near)
            there = self.continued(start)
            found.append(self.solve(start if there is None else there))
            return likeliest(found)
        near = self.solve(start)
        there = None if near.is_success else self.continued(start)
        return near if there is None else self.solve(there)

    def continued(self, start: StartingPoint) -> StartingPoint | None:
        """A start that nearly solves the model, along a missing force that shrinks.

        None where it leads nowhere. Outliers count in full on the way, and L1 for
        nothing.
        """
        transcription = self._transcribed(start, {})
        z = continued(transcription.values, start.sigma)
        if z is None:
            return None
        unscaled = transcription.point.unscaled(z)
        x = unscaled["x"].reshape(-1, start.model.n_states)
        grid = transcription.grid
        at_samples = x[grid.sample]
        ends = np.cumsum([run.n_samples for run in self.task.data.trajectories])
        return replace(
            start,
            theta=unscaled["theta"],
            states=tuple(np.split(at_samples, ends[:-1])),
            is_optimum=True,
        )

    def _steps(self, start: StartingPoint) -> tuple[np.ndarray, ...]:
        """Intervals in every gap between samples, fine where a memory fades."""
        steps = start.steps
        if not steps:
            n_steps = self.loss.steps or 1
            runs = self.task.data.trajectories
            steps = tuple(np.full(run.n_samples - 1, n_steps) for run in runs)
        if not start.model.memory:
            return steps
        return tuple(_fine_at_start(of_run) for of_run in steps)

    def solve(
        self,
        start: StartingPoint,
        *,
        l1: dict[str, float] | None = None,
        most_steps: int | None = None,
    ) -> LikelihoodEstimate:
        """Solve from a starting point that has its steps.

        Args:
            start: with ``steps``.
            l1: weights; None: those of the task.
            most_steps: full steps to try, and no IPOPT after them; None: as many as it
                takes, then IPOPT.
        """
        l1 = self.task.l1 if l1 is None else l1
        transcription = self._transcribed(start, l1)
        noise = self._noise_iteration(transcription, l1)
        z, sigma = transcription.point.scaled, start.sigma
        settings = self.task.settings
        optimum = None
        if settings.has_own_steps and not transcription.has_slacks:
            if most_steps is not None:
                most = min(most_steps, settings.max_iterations)
                settings = replace(settings, max_iterations=most)
            optimum = by_steps(transcription.values, settings, noise, z, sigma)
            if optimum.solution.outcome.success or most_steps is not None:
                self.task.say(f"{transcription}: {optimum.solution.outcome}")
                return self._estimate(transcription, optimum, l1)
        optimum = by_ipopt(transcription, settings, noise, sigma, optimum)
        self.task.say(f"{transcription}: {optimum.solution.outcome}")
        return self._estimate(transcription, optimum, l1)

    def _noise_iteration(
        self, transcription: Transcription, l1: dict[str, float]
    ) -> NoiseIteration:
        return NoiseIteration(
            grid=transcription.grid,
            is_estimated=~self.problem.noise.is_known,
            n_theta=len(transcription.unknown),
            huber=self.loss.huber,
            has_l1=any(l1.values()),
            least=self.problem.noise.least,
        )

    def _estimate(
        self,
        transcription: Transcription,
        optimum: Optimum,
        l1: dict[str, float],
    ) -> LikelihoodEstimate:
        return LikelihoodEstimate(
            task=self.task,
            loss=self.loss,
            model=transcription.model,
            grid=transcription.grid,
            unknown=transcription.unknown,
            point=transcription.point,
            transcription=transcription,
            solution=optimum.solution,
            l1=l1,
            sigma=optimum.sigma,
            is_known=self.problem.noise.is_known,
        )

    def _transcribed(self, start: StartingPoint, l1: dict[str, float]) -> Transcription:
        model = start.model
        grid = self.task.aligned.grid_with(start.steps)
        unknown = Theta.of(model, self.task.runs)
        nodes = _at_nodes(start.states, start.steps)
        point = point_at(model, grid, unknown, start.theta, nodes, start.held)
        parameters = np.asarray(unknown.by_trajectory(start.theta))
        bounds = memory_start_bounds(model, grid, nodes, parameters)
        point = replace(point, x_bounds=bounds)
        return Transcription(self.loss, model, grid, unknown, point, l1, start.sigma)


def likeliest(estimates: Sequence[LikelihoodEstimate]) -> LikelihoodEstimate:
    """The optimum of the smallest deviance; one that is none comes last."""
    return min(estimates, key=lambda e: (not e.is_success, e.deviance))


def _at_nodes(states: Sequence[np.ndarray], steps: Sequence[np.ndarray]) -> np.ndarray:
    """States at the samples, interpolated to the nodes, (n_nodes, n_states)."""
    pairs = zip(states, steps, strict=True)
    return np.concatenate([interpolate_at_nodes(x, of_run) for x, of_run in pairs])


def _fine_at_start(steps: np.ndarray) -> np.ndarray:
    """The steps of a trajectory, many where what it began with as memory fades."""
    is_fading = np.arange(len(steps)) < FADING_GAPS
    return np.where(is_fading, np.maximum(steps, FADING_STEPS), steps)

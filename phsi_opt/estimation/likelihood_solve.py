"""The likelihood of a task, maximised from a starting point.

Three nested policies, each with a file of its own: a missing force that shrinks where
the start is not near (`continuation`), the noise re-estimated until it stays
(`noise_estimation`), the next way to solve where one fails (`solver_chain`). Where to
start is the business of `likelihood_start`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from phsi_opt.estimation.continuation import Continuation
from phsi_opt.estimation.direct_steps import DirectSteps, Optimum
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem
from phsi_opt.estimation.noise_estimation import NoiseIteration
from phsi_opt.estimation.problem import Task
from phsi_opt.estimation.residual_scatter import is_at_scatter
from phsi_opt.estimation.solver_chain import SolverChain, ways_after
from phsi_opt.estimation.starting_point import StartingPoint
from phsi_opt.estimation.transcription import Transcription
from phsi_opt.initialization.scaling import point_at
from phsi_opt.optimization.settings import FEASIBLE_PATH, GAUSS_NEWTON
from phsi_opt.transcription.augmented_states import memory_start_bounds
from phsi_opt.transcription.grid import interpolate_at_nodes
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta

MOST_NOISE_UPDATES = 6  # solves with a noise re-estimated, at most
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
        """The optimum of the whole record, however far off the start is."""
        start = replace(start, steps=self._steps(start))
        if self.task.settings.thorough and not start.is_optimum:
            near = self.solve_directly(start)
            if near is not None and is_at_scatter(near):
                return near
            there = self.continued(start)
            return self.solve(start if there is None else there)
        near = self.solve(start)
        there = None if near.is_success else self.continued(start)
        return near if there is None else self.solve(there)

    def continued(self, start: StartingPoint) -> StartingPoint | None:
        """A start that nearly solves the model, along a missing force that shrinks.

        None where it leads nowhere. Outliers count in full on the way, and L1 for
        nothing.
        """
        transcription = self._transcribed(start, {})
        values = transcription.values
        z = Continuation(values).end(transcription.point.scaled, start.sigma)
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
        ways: tuple[str, ...] | None = None,
    ) -> LikelihoodEstimate:
        """Solve from a starting point that has its steps.

        Args:
            start: with ``steps``.
            l1: weights; None: those of the task.
            ways: to solve it, the next where one fails; None: those that fit the start.
        """
        l1 = self.task.l1 if l1 is None else l1
        ways = ways_after(start.way) if ways is None else ways
        transcription = self._transcribed(start, l1)
        noise = self._noise_iteration(transcription, l1)
        direct = self._direct_steps(transcription)
        if direct is not None and self._may_be_near(start, ways[0]):
            z = transcription.point.scaled
            optimum = direct.optimum(z, start.sigma, noise)
            if optimum is not None:
                way = optimum.solution.outcome.way
                return self._estimate(transcription, optimum, l1, way)
        z = transcription.program.start
        chain = SolverChain(transcription, self.task.settings, ways, self.task.say)
        optimum = _maximum(chain, direct, noise, z, start.sigma)
        return self._estimate(transcription, optimum, l1, chain.way)

    def _may_be_near(self, start: StartingPoint, way: str) -> bool:
        """Whether full steps may lead from a start to its optimum.

        From another solution of the model; and in a brief solve, which begins where a
        second look ended, but not where a path beside a sharp corner is to be followed.
        """
        if self.task.settings.thorough:
            return start.is_optimum and way != FEASIBLE_PATH
        return way != FEASIBLE_PATH

    def solve_directly(self, start: StartingPoint) -> LikelihoodEstimate | None:
        """The optimum that full steps lead to; None where they lead nowhere."""
        start = replace(start, steps=self._steps(start))
        transcription = self._transcribed(start, self.task.l1)
        direct = self._direct_steps(transcription)
        if direct is None:
            return None
        noise = self._noise_iteration(transcription, self.task.l1)
        z = transcription.point.scaled
        optimum = direct.optimum(z, start.sigma, noise)
        if optimum is None:
            return None
        self.task.say(f"{transcription}: {optimum.solution.outcome}")
        way = optimum.solution.outcome.way
        return self._estimate(transcription, optimum, self.task.l1, way)

    def _direct_steps(self, transcription: Transcription) -> DirectSteps | None:
        """Full steps; None with slack variables, or where they may not be tried."""
        settings = self.task.settings
        may_step = settings.has_own_steps and GAUSS_NEWTON in settings.ways
        if not may_step or transcription.has_slacks:
            return None
        return DirectSteps(transcription.values, settings)

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
        way: str,
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
            way=way,
            nearby=optimum.nearby,
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


def _maximum(
    chain: SolverChain,
    direct: DirectSteps | None,
    noise: NoiseIteration,
    z: np.ndarray,
    sigma: np.ndarray,
) -> Optimum:
    """Solve, and where the noise is not given, again until its estimate stays.

    Args:
        chain: solvers of the program.
        direct: full steps of it, tried from one solution to the next.
        noise: re-estimates what is not given.
        z: to start from (scaled).
        sigma: (n_states,) noise to start from.
    """
    if not noise.is_estimated.any():
        attempt = chain.attempt(z, sigma)
        return Optimum(chain.completed(attempt, z, sigma), sigma)
    previous = None
    for _ in range(MOST_NOISE_UPDATES):
        solution = chain.attempt(z, sigma)
        is_path = chain.way == FEASIBLE_PATH
        if previous is not None and is_path and not solution.outcome.success:
            # The kink where it settled is still in the way; the noise alone is another,
            # and with it what a step promises.
            return Optimum(chain.solver.at(previous, sigma), sigma)
        solution = chain.completed(solution, z, sigma)
        if not solution.outcome.success:
            break
        updated = noise.updated(sigma, solution.residual)
        has_settled = noise.has_settled(sigma, updated)
        z = solution.z
        sigma = updated
        previous = solution
        if has_settled:
            return Optimum(chain.solver.at(solution, sigma), sigma)
        if direct is not None and chain.way != FEASIBLE_PATH:
            optimum = direct.optimum(z, sigma, noise)
            if optimum is not None:
                return optimum
            direct = None
    return Optimum(solution, sigma)


def _at_nodes(states: Sequence[np.ndarray], steps: Sequence[np.ndarray]) -> np.ndarray:
    """States at the samples, interpolated to the nodes, (n_nodes, n_states)."""
    pairs = zip(states, steps, strict=True)
    return np.concatenate([interpolate_at_nodes(x, of_run) for x, of_run in pairs])


def _fine_at_start(steps: np.ndarray) -> np.ndarray:
    """The steps of a trajectory, many where what it began with as memory fades."""
    is_fading = np.arange(len(steps)) < FADING_GAPS
    return np.where(is_fading, np.maximum(steps, FADING_STEPS), steps)

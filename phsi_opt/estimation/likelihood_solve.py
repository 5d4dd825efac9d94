"""TODO."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm

from phsi_opt.data.measurements import Measurements
from phsi_opt.data.noise import least_noise
from phsi_opt.estimation.feasible_path import FeasiblePath
from phsi_opt.estimation.problem import State, Task
from phsi_opt.initialization.scaling import point_at
from phsi_opt.model.model import Model
from phsi_opt.optimization.ipopt import HOLDING, Solution, Solver
from phsi_opt.optimization.program import Program
from phsi_opt.optimization.settings import (
    EXACT,
    FEASIBLE_PATH,
    GAUSS_NEWTON,
    WAYS,
    SolverSettings,
)
from phsi_opt.transcription.augmented_states import memory_start_bounds
from phsi_opt.transcription.grid import Grid, grid_of, interpolate_at_nodes
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta

# The memory that a trajectory begins with is free; that of a short delay fades within a
# few samples. With coarse steps there it could take values far off for the sake of the
# first residuals, and a simulation from them would go astray.
FADING, AT_START = 4, 16
NOISE_ROUNDS = 6
# iterations after which the exact Hessian takes over: it converges in a few, or not at
# all
FIRST = 30
WORDS = {
    GAUSS_NEWTON: "with the Gauss-Newton Hessian",
    EXACT: "with the exact Hessian",
    FEASIBLE_PATH: "along solutions of the model",
}
BRIEF = 25  # iterations with the exact Hessian where a solve need not be thorough
SAME = 0.005  # change of the logarithm of the noise at which its estimate stays
CLEAN = 0.01  # root mean square residual, over the noise assumed, of data without noise
WINDOWS = 32  # first windows: this share of the longest record
GROWTH = 4  # factor by which windows grow
SHORTEST = 8  # samples in a window, at least


def after(way: str) -> tuple[str, ...]:
    """The ways to try where a solution like it was found in that way."""
    return {
        GAUSS_NEWTON: WAYS,
        EXACT: (EXACT, FEASIBLE_PATH),
        FEASIBLE_PATH: (FEASIBLE_PATH, *WAYS[:2]),
    }[way]


@dataclass(frozen=True, eq=False)
class Beginning:
    """Where the solver begins: model with guesses resolved, theta, states at the
    samples, noise, notes.
    """

    model: Model
    theta: np.ndarray
    x: tuple[np.ndarray, ...]
    sigma: np.ndarray
    notes: tuple[str, ...] = ()
    steps: tuple[
        np.ndarray, ...
    ] = ()  # intervals in every gap between samples; empty: one, or what the loss says
    way: str = GAUSS_NEWTON  # how a solution like it was found
    # of this very model, with other steps or measurements: windows would not lead
    # further
    is_optimum: bool = False
    other: "Callable[[], Beginning] | None" = (
        None  # a second one, for the case that this one leads nowhere
    )


def on_record(
    model: Model,
    data: Measurements,
    sigma: np.ndarray,
    x: Sequence[np.ndarray],
    loss: MaximumLikelihood,
    steps: Sequence[np.ndarray],
    way: str = GAUSS_NEWTON,
    is_start: bool = False,
) -> State | None:
    """The likelihood of a record with its states, and what is still free in ``model``,
    unknown; None: no success.

    ``sigma``: the known noise per state; ``x``: states at the samples to start from;
    ``steps``: in their gaps; ``way``: how the model's own fit was found; ``is_start``:
    what was reached along solutions of the model is enough.
    """
    task = Task(
        model,
        data,
        {},
        None,
        SolverSettings(max_iterations=60, thorough=False),
        lambda line: None,
    )
    theta = Theta.of(model, task.runs).spread(model.theta)
    begin = Beginning(model, theta, tuple(x), sigma, (), tuple(steps), way)
    known = np.zeros(model.n_states, dtype=bool)
    if is_start and way == FEASIBLE_PATH:
        along = replace(task, settings=replace(task.settings, ways=(FEASIBLE_PATH,)))
        state = LikelihoodSolve(along, loss, known).staged(begin)
        if state.solution.outcome.infeasibility < HOLDING:
            return state
    state = LikelihoodSolve(task, loss, known).staged(begin)
    return state if state.solution.outcome.success else None


@dataclass(frozen=True, eq=False)
class LikelihoodSolve:
    """Solves the likelihood of a task on a grid; where the noise is not given, until
    its estimate stays.
    """

    task: Task
    loss: MaximumLikelihood
    estimated: np.ndarray  # of which states the noise is unknown

    def staged(self, begin: Beginning) -> State:
        """The whole record, through windows where it needs them."""
        task, loss = self.task, self.loss
        steps = list(begin.steps) or [
            np.full(run.n_samples - 1, loss.steps or 1)
            for run in task.data.trajectories
        ]
        steps = [_fading(n) for n in steps] if begin.model.memory else steps

        def solve(
            b: Beginning, ways: tuple[str, ...], window: float | None = None
        ) -> State:
            return self(b.model, steps, b.theta, b.x, b.sigma, task.l1, ways, window)

        longest = max(float(run.t[-1] - run.t[0]) for run in task.data.trajectories)
        ways = after(begin.way)
        if loss.window is None:
            through_windows = task.settings.thorough and not begin.is_optimum
            # Far from the optimum it is the windows that lead there; along solutions
            # there may be others on the way.
            is_last_resort = through_windows and ways[0] != FEASIBLE_PATH
            state = solve(
                begin,
                tuple(w for w in ways if not is_last_resort or w != FEASIBLE_PATH),
            )
            if state.solution.outcome.success or not through_windows:
                return state
            task.say("the whole record could not be solved; going through windows")
        window = loss.window or longest / WINDOWS
        while window < longest:
            state = solve(begin, ways, window)
            if state.solution.outcome.success:
                begin, ways = (
                    replace(
                        begin, theta=state.theta, x=state.states, sigma=state.sigma
                    ),
                    after(state.way),
                )
            window *= GROWTH
        return solve(begin, ways)

    def __call__(
        self,
        model: Model,
        steps: list[np.ndarray],
        theta: np.ndarray,
        x: tuple[np.ndarray, ...],
        sigma: np.ndarray,
        l1: dict[str, float],
        ways: tuple[str, ...] = WAYS,
        window: float | None = None,
    ) -> State:
        """Solve from ``theta`` and the states ``x`` at the samples; the next of the
        ``ways`` where one fails.
        """
        task, loss = self.task, self.loss
        grid = grid_of(task.data, steps)
        unknown = Theta.of(model, task.runs)
        nodes = np.concatenate(
            [interpolate_at_nodes(run, n) for run, n in zip(x, steps, strict=True)]
        )
        point = point_at(model, grid, unknown, theta, nodes)
        point = replace(
            point,
            x_bounds=memory_start_bounds(
                model, grid, nodes, np.asarray(unknown.by_trajectory(theta))
            ),
        )
        if window is not None:
            grid = cut(grid, window)
        program = loss.program(model, grid, point, l1, sigma, unknown)
        left, z = self.solvers(program, model, grid, unknown, ways), program.start
        way, solver = next(left)
        settled = None
        for _ in range(NOISE_ROUNDS if self.estimated.any() else 1):
            solution = solver.solve(z, sigma, raise_on_failure=False)
            if (
                settled is not None
                and way == FEASIBLE_PATH
                and not solution.outcome.success
            ):
                # The kink where it settled is still in the way; the noise alone is
                # another, and with it what a step promises.
                solution = solver.at(settled, sigma)
                break
            while (
                not solution.outcome.success
                and (further := next(left, None)) is not None
            ):
                task.say(
                    f"not solved ({solution.outcome.status}); again {WORDS[further[0]]}"
                )
                other = further[1].solve(z, sigma, raise_on_failure=False)
                if (
                    other.outcome.success or further[0] != FEASIBLE_PATH
                ):  # of two failures IPOPT's says more
                    (way, solver), solution = further, other
            where = "" if window is None else f" in windows of {window:.3g}"
            task.say(
                f"maximum likelihood, {len(theta)} parameters, {nodes.size} states{where}: {solution.outcome}"
            )
            solution = _clean(solution)
            if not solution.outcome.success or not self.estimated.any():
                break
            residual = solution.residual * np.sqrt(int(grid.measured.sum()) / 2)
            new = np.where(
                self.estimated,
                estimated_noise(grid, residual, sigma, len(theta), loss.huber),
                sigma,
            )
            change = np.log(new / sigma)[grid.measured.any(axis=0)]
            z, sigma, settled = solution.z, new, solution
            # One factor for all channels leaves the estimates where they are.
            alike = (
                self.estimated.all()
                and loss.huber is None
                and not any(l1.values())
                and np.ptp(change) < SAME
            )
            if alike or np.max(np.abs(change)) < SAME:
                solution = solver.at(solution, sigma)
                break
        return State(
            task,
            loss,
            model,
            grid,
            unknown,
            point,
            program,
            solution,
            l1,
            sigma,
            way=way,
        )

    def solvers(
        self,
        program: Program,
        model: Model,
        grid: Grid,
        unknown: Theta,
        ways: tuple[str, ...],
    ) -> Iterator[tuple[str, Solver | FeasiblePath]]:
        """What solves the program in each of the ways that the settings allow, made
        when it is asked for.

        With windows or slack variables nothing can be solved along the model; the exact
        Hessian stands in.
        """
        settings = self.task.settings
        quick = replace(settings, max_iterations=min(FIRST, settings.max_iterations))
        full = settings if settings.thorough else replace(quick, max_iterations=BRIEF)
        has_path = grid.n_nodes - grid.n_intervals == len(grid.first) and set(
            program.variables
        ) == {"theta", "x"}
        allowed = [way for way in ways if way in settings.ways] or list(settings.ways)
        for way in dict.fromkeys(
            EXACT if way == FEASIBLE_PATH and not has_path else way for way in allowed
        ):
            if way == FEASIBLE_PATH:
                yield (
                    way,
                    FeasiblePath(
                        program, model, grid, unknown, self.loss, settings.max_seconds
                    ),
                )
            else:
                yield (
                    way,
                    Solver(
                        program, full if way == EXACT else quick, exact=way == EXACT
                    ),
                )


def _clean(solution: Solution) -> Solution:
    """A stall where the data are explained far below the least noise that is assumed is
    the end, not a failure.
    """
    outcome = solution.outcome
    tiny = float(np.sum(solution.residual**2)) / 2 < CLEAN**2
    if outcome.success or not tiny or outcome.infeasibility > 1e-8:
        return solution
    sentence = (
        "the data are explained beyond the accuracy of numbers: they have no noise"
    )
    return replace(
        solution, outcome=replace(outcome, success=True, sentence=sentence, advice="")
    )


def cut(grid: Grid, window: float) -> Grid:
    """The grid without the intervals in which a window of a trajectory ends, so that
    every window starts freely.

    No window has fewer than `SHORTEST` samples; a gap with steps in it is cut behind
    its first sample.
    """
    samples, gone = np.flatnonzero(grid.sample), []
    for run in range(int(grid.trajectory[-1]) + 1):
        own = samples[grid.trajectory[samples] == run]
        number = np.floor((grid.t[own] - grid.t[own[0]]) / window + 1e-9).astype(int)
        last = 0
        for i in np.flatnonzero(np.diff(number)) + 1:
            if i - last >= SHORTEST and len(own) - i >= SHORTEST:
                gone.append(own[i - 1])
                last = int(i)
    return grid.intervals(np.flatnonzero(~np.isin(grid.begin, gone)))


def estimated_noise(
    grid: Grid,
    residual: np.ndarray,
    sigma: np.ndarray,
    n_theta: int,
    huber: float | None,
) -> np.ndarray:
    """Root mean square residual per channel, with the degrees of freedom that the fit
    used taken off.

    ``residual`` holds (y - x)/sigma of every measured value in the order of the nodes,
    cut at ``huber`` where that is given; then the mean square that normal noise would
    leave within the limit is divided out (Huber's proposal 2).
    """
    seen = grid.measured
    n_pieces = grid.n_nodes - grid.n_intervals
    share = max(1 - (n_theta + n_pieces * grid.y.shape[1]) / seen.sum(), 0.1)
    if huber is not None:
        outside = 2 * norm.sf(huber)
        share *= (1 - outside) - 2 * huber * norm.pdf(huber) + huber**2 * outside
    channel, least = np.nonzero(seen)[1], least_noise(grid.y)
    result = sigma.copy()
    for k in np.flatnonzero(seen.any(axis=0)):
        rms = sigma[k] * np.sqrt(np.mean(residual[channel == k] ** 2))
        result[k] = max(rms / np.sqrt(share), least[k])
    return result


def _fading(steps: np.ndarray) -> np.ndarray:
    """The steps of a trajectory, many at its start, where what nobody knows of an
    effect's memory fades.
    """
    return np.where(np.arange(len(steps)) < FADING, np.maximum(steps, AT_START), steps)

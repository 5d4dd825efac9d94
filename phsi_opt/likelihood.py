"""How `MaximumLikelihood` is solved.

1. Start: parameters by the PHSI loss; states from the data, or, where some are missing, from the missing-force program.
2. Windows, where the whole record cannot be solved (or where they are asked for): pieces with free starting states.
3. The whole record, with the noise re-estimated until it stays.
   Each solve by Gauss-Newton steps, where that fails with the exact Hessian, at last along solutions of the model.
4. More intervals between samples, where the integration error is visible in the estimates.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.stats import norm

from phsi_opt import start as starting
from phsi_opt.errors import DataError, SolveError
from phsi_opt.feasible_path import FeasiblePath
from phsi_opt.fit import Fit
from phsi_opt.grid import Grid, between, grid_of, local_errors, steps_of
from phsi_opt.guesses import corners, resolved
from phsi_opt.losses import MaximumLikelihood, PHSILoss
from phsi_opt.measurements import Measurements
from phsi_opt.memory import beginnings, remembered
from phsi_opt.missing import softened
from phsi_opt.model import Model
from phsi_opt.nlp import Program
from phsi_opt.noise import difference_noise
from phsi_opt.one_step import Pruner, chosen, solve_defects
from phsi_opt.solver import EXACT, FEASIBLE_PATH, GAUSS_NEWTON, HOLDING, WAYS, Settings, Solution, Solver
from phsi_opt.theta import Theta
from phsi_opt.uncertainty import inverse
from phsi_opt.work import State, Task

MOST_STEPS = 64  # intervals between two samples
# The memory that a trajectory begins with is free; that of a short delay fades within a few samples. With coarse steps
# there it could take values far off for the sake of the first residuals, and a simulation from them would go astray.
FADING, AT_START = 4, 16
REFINEMENTS = 5
NOISE_ROUNDS = 6
SUSPICIOUS = 2.0  # residuals over the scatter of neighbouring samples, beyond which a second start is tried
FIRST = 30  # iterations after which the exact Hessian takes over: it converges in a few, or not at all
WORDS = {
    GAUSS_NEWTON: "with the Gauss-Newton Hessian",
    EXACT: "with the exact Hessian",
    FEASIBLE_PATH: "along solutions of the model",
}
BRIEF = 25  # iterations with the exact Hessian where a solve need not be thorough
SAME = 0.005  # change of the logarithm of the noise at which its estimate stays
CLEAN = 0.01  # root mean square residual, over the noise assumed, of data without noise
VISIBLE = 0.1  # integration error that is refined: share of a standard error, or of the noise
WINDOWS = 32  # first windows: this share of the longest record
GROWTH = 4  # factor by which windows grow
LONG = 20_000  # nodes from which on a record with gaps is begun through its first part
SHORTEST = 8  # samples in a window, at least


def after(way: str) -> tuple[str, ...]:
    """The ways to try where a solution like it was found in that way."""
    return {GAUSS_NEWTON: WAYS, EXACT: (EXACT, FEASIBLE_PATH), FEASIBLE_PATH: (FEASIBLE_PATH, *WAYS[:2])}[way]


@dataclass(frozen=True, eq=False)
class Beginning:
    """Where the solver begins: model with guesses resolved, theta, states at the samples, noise, notes."""

    model: Model
    theta: np.ndarray
    x: tuple[np.ndarray, ...]
    sigma: np.ndarray
    notes: tuple[str, ...] = ()
    steps: tuple[np.ndarray, ...] = ()  # intervals in every gap between samples; empty: one, or what the loss says
    way: str = GAUSS_NEWTON  # how a solution like it was found
    is_optimum: bool = False  # of this very model, with other steps or measurements: windows would not lead further
    other: "Callable[[], Beginning] | None" = None  # a second one, for the case that this one leads nowhere


def by_likelihood(task: Task, loss: MaximumLikelihood, start: Fit | None, prune: Pruner) -> State:
    """The maximum of the likelihood from the best of the starting points, refined where needed, and pruned."""
    _check(task)
    given = given_noise(loss, task)
    known = np.isfinite(given)
    begin = _beginning(task, loss, starting.initial_noise(task.data, given), known, start)
    solve = _Solve(task, loss, ~known)
    states = [solve.staged(moved) for moved in _moved_starts(begin, task, loss, known)]
    if begin.other is not None and not _is_plausible(_best(states, begin)):
        task.say("the residuals are far above what neighbouring samples scatter: another start")
        with suppress(SolveError):  # it is only a second chance
            states.append(solve.staged(begin.other()))
    state = _best(states, begin)
    for _ in range(REFINEMENTS if loss.steps is None and task.settings.thorough else 0):
        finer = finer_steps(state) if state.solution.outcome.success else None
        if finer is None:
            break
        task.say(f"integration error is visible in the estimates: {max(map(np.max, finer))} steps per sample at most")
        state = replace(
            solve(state.model, finer, state.theta, state.states, state.sigma, task.l1, after(state.way)),
            notes=state.notes,
        )
    steps = steps_of(state.grid)
    state = prune(state, lambda s, m, theta, l1: solve(m, steps, theta, s.states, s.sigma, l1, after(s.way)))
    return replace(state, notes=state.notes + _noise_note(state, known))


def _check(task: Task) -> None:
    for name in task.model.sensor:
        if name not in task.data.measured:
            raise DataError(
                f"the model has a sensor of {name!r}, but {name!r} was never measured; leave one of them out."
            )
    n_values = sum(int(np.isfinite(run.x).sum()) for run in task.data.trajectories)
    n_theta = len(Theta.of(task.model, task.runs))
    n_unknown = n_theta + task.data.n_trajectories * task.model.n_states
    if n_values <= n_unknown:
        raise DataError(
            f"{n_values} measured values are too few for {n_unknown} unknowns ({n_theta} parameters and "
            f"the starting states of {task.data.n_trajectories} trajectories); measure more, or fix parameters."
        )


def given_noise(loss: MaximumLikelihood, task: Task) -> np.ndarray:
    """Noise per state as the loss or the measurements declare it; NaN where it is to be estimated."""
    data = task.data
    noise = loss.noise if loss.noise is not None else data.noise or {}
    for name in data.measured:
        missing = loss.noise is not None and name not in noise
        if missing or (name in noise and not (np.isfinite(noise[name]) and noise[name] > 0)):
            raise DataError(
                f"noise of the measured state {name!r} is {noise.get(name)!r}; expected a number above zero."
            )
    return np.array([noise.get(name, np.nan) for name in data.states])


# ---- where to begin --------------------------------------------------------------------------------------------------


def _beginning(
    task: Task, loss: MaximumLikelihood, sigma: np.ndarray, known: np.ndarray, start: Fit | None
) -> Beginning:
    grid = grid_of(task.data)
    if start is not None:
        old = np.array([start.noise.get(name, 1.0) for name in task.model.states])
        return _from_fit(task, loss, np.where(known, sigma, old), known, start)
    if not grid.measured.all() and grid.n_nodes > LONG:
        return _through_a_part(task, loss, sigma, known, grid)
    task.say("starting values")
    core, grid = task.model.dynamics(), starting.unsensed(task.model, grid)
    notes: tuple[str, ...] = ()
    complete_data = bool(grid.measured.all())
    x = grid.y
    if not complete_data:
        guessed = resolved(core, grid, np.nan_to_num(grid.y))
        estimate = starting.smoothed(guessed, grid, sigma, loss.integrator, known, rounds=2)
        x, sigma = estimate.x, estimate.sigma
    core = resolved(core, grid, x)
    given = {name for name, e in task.model.entries.items() if e.parameter.value is not None and not e.prunable}
    if core.free:
        first = _from_states(replace(task, model=core, pruning=None, say=lambda line: None), loss, grid, x)
        notes = first.notes
        values = first.values
        if not complete_data:
            # States smoothed with the parameters given would only confirm them.
            values = {name: core.values[name] if name in given else value for name, value in values.items()}
        core = core.with_values(values)
    other: Callable[[], Beginning] | None = None
    if core.free and not complete_data:
        confirmed, prior = core.with_values(first.values), estimate.prior

        def other() -> Beginning:
            again = starting.smoothed(confirmed, grid, sigma, loss.integrator, known, rounds=1, prior=prior)
            return _ready(task, confirmed, grid, again.x, again.sigma, notes)

        shared = Theta.of(core, task.runs)
        theta = np.array([core.values[name] for name in core.free])
        point = softened(core, grid, shared, starting.point_at(core, grid, shared, theta, x), sigma, loss.integrator)
        core, x = core.with_values(dict(zip(core.free, point.theta.tolist(), strict=True))), point.x
    return replace(_ready(task, core, grid, x, sigma, notes), other=other)


def _through_a_part(task: Task, loss: MaximumLikelihood, sigma: np.ndarray, known: np.ndarray, grid: Grid) -> Beginning:
    """The beginning of a long record at the solution of the first part of each of its trajectories.

    Along a long record, states that are not measured cannot be found while the parameters are still far off.
    """
    share = LONG / 2 / grid.n_nodes
    runs = []
    for run in task.data.trajectories:
        n = min(max(int(share * run.n_samples), 2 * SHORTEST), run.n_samples)
        runs.append(replace(run, t=run.t[:n], x=run.x[:n], u=run.u[:n]))
    task.say(f"starting values from the first {sum(run.n_samples for run in runs)} samples")
    part = replace(task, data=replace(task.data, trajectories=tuple(runs)), pruning=None)
    first = by_likelihood(part, replace(loss, starts=1, window=None), None, lambda state, _: state)
    unknown = Theta.of(first.model, task.runs)
    sigma = np.where(known, sigma, first.sigma)
    states = _at_theta(first.model, grid, unknown, first.theta, sigma, loss, known)
    return Beginning(first.model, first.theta, states, sigma, first.notes)


def _from_fit(task: Task, loss: MaximumLikelihood, sigma: np.ndarray, known: np.ndarray, start: Fit) -> Beginning:
    """The beginning at a fit's values, and at its states where they are those of these measurements."""
    grid, unknown = grid_of(task.data), Theta.of(task.model, task.runs)
    lengths = [run.n_samples for run in task.data.trajectories]
    own = [len(x) for x in start.states] == lengths
    kept = [start.model.states.index(name) for name in task.model.states if name in start.model.states]
    x = np.concatenate(start.states)[:, kept] if own else np.nan_to_num(grid.y)
    model = resolved(task.model, grid, x)
    default = unknown.spread(np.array([model.values[name] for name in model.free]))
    theta = unknown.from_values(start.estimates, default)
    if own:  # the memory of an effect that the fit did not have follows from its states
        states = grid.split(remembered(model, grid, x, np.asarray(unknown.by_trajectory(theta))))
    else:
        states = _at_theta(model, grid, unknown, theta, sigma, loss, known)
    steps = start.steps if loss.steps is None and [len(n) + 1 for n in start.steps] == lengths else ()
    related = own and start.outcome.success and set(corners(start.model)) <= set(task.model.entries)
    way = start.outcome.way if related else GAUSS_NEWTON
    return Beginning(model, theta, states, sigma, (), steps, way, related and set(start.names) == set(unknown.names))


def _at_theta(
    model: Model, grid: Grid, unknown: Theta, theta: np.ndarray, sigma: np.ndarray, loss: MaximumLikelihood,
    known: np.ndarray,
) -> tuple[np.ndarray, ...]:  # fmt: skip
    """States at the samples for given parameters: the data where they are complete, else with a missing force."""
    if grid.measured.all() and not model.sensor:
        return grid.split(grid.y)
    values = unknown.by_trajectory(theta)
    return grid.split(starting.smoothed(model, grid, sigma, loss.integrator, known, values, rounds=1).x)


def _ready(task: Task, core: Model, grid: Grid, x: np.ndarray, sigma: np.ndarray, notes: tuple[str, ...]) -> Beginning:
    """The beginning with the values of the dynamics ``core`` and the states x."""
    model = task.model.with_values({name: value for name, value in core.values.items() if name in task.model.entries})
    model = resolved(model, grid, x)
    theta = Theta.of(model, task.runs).spread(np.array([model.values[name] for name in model.free]))
    return Beginning(model, theta, grid.split(x), sigma, notes)


def _from_states(task: Task, loss: MaximumLikelihood, grid: Grid, x: np.ndarray) -> State:
    known = starting.with_states(grid, x)
    thetas = starting.starting_values(task.model, known, task.l1)
    states = [solve_defects(task, PHSILoss(loss.integrator), task.model, known, theta, task.l1) for theta in thetas]
    return chosen(states, lambda s: (not s.solution.outcome.success, s.solution.outcome.objective))


def _moved_starts(begin: Beginning, task: Task, loss: MaximumLikelihood, known: np.ndarray) -> list[Beginning]:
    """The beginning and n - 1 others: values times a random factor, those at zero moved by their size; fixed seed."""
    if loss.starts == 1:
        return [begin]
    unknown, grid = Theta.of(begin.model, task.runs), grid_of(task.data)
    model_theta = unknown.means(begin.theta)
    x = np.concatenate(begin.x)
    size = unknown.spread(starting.theta_scale(begin.model, grid, model_theta, x, _spread(x)))
    lower, upper = np.array([(e.parameter.lower, e.parameter.upper) for e in unknown.entries]).T
    rng = np.random.default_rng(0)
    starts = [begin]
    for _ in range(loss.starts - 1):
        draw = rng.normal(size=(2, len(begin.theta)))
        moved = np.where(begin.theta != 0, begin.theta * np.exp(0.7 * draw[0]), 0.3 * size * draw[1])
        moved = np.clip(moved, lower, upper)
        states = begin.x
        with suppress(SolveError):  # far from the data there may be no states; then those of the first start
            states = _at_theta(begin.model, grid, unknown, moved, begin.sigma, loss, known)
        starts.append(replace(begin, theta=moved, x=states, way=GAUSS_NEWTON, is_optimum=False))
    return starts


def _spread(x: np.ndarray) -> np.ndarray:
    return np.maximum(np.std(x, axis=0), 1e-12)


def _best(states: list[State], begin: Beginning) -> State:
    best = min(states, key=lambda s: (not s.solution.outcome.success, s.deviance))
    notes = begin.notes
    if len(states) > 1:
        agree = sum(s.solution.outcome.success and s.deviance < best.deviance + 0.1 for s in states)
        notes = (*notes, f"{agree} of {len(states)} starting points led to the best solution")
    return replace(best, notes=notes)


def on_record(
    model: Model, data: Measurements, sigma: np.ndarray, x: Sequence[np.ndarray], loss: MaximumLikelihood,
    steps: Sequence[np.ndarray], way: str = GAUSS_NEWTON, is_start: bool = False,
) -> State | None:  # fmt: skip
    """The likelihood of a record with its states, and what is still free in ``model``, unknown; None: no success.

    ``sigma``: the known noise per state; ``x``: states at the samples to start from; ``steps``: in their gaps;
    ``way``: how the model's own fit was found; ``is_start``: what was reached along solutions of the model is enough.
    """
    task = Task(model, data, {}, None, Settings(max_iterations=60, thorough=False), lambda line: None)
    theta = Theta.of(model, task.runs).spread(np.array([model.values[name] for name in model.free]))
    begin = Beginning(model, theta, tuple(x), sigma, (), tuple(steps), way)
    known = np.zeros(model.n_states, dtype=bool)
    if is_start and way == FEASIBLE_PATH:
        along = replace(task, settings=replace(task.settings, ways=(FEASIBLE_PATH,)))
        state = _Solve(along, loss, known).staged(begin)
        if state.solution.outcome.infeasibility < HOLDING:
            return state
    state = _Solve(task, loss, known).staged(begin)
    return state if state.solution.outcome.success else None


# ---- one problem -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Solve:
    """Solves the likelihood of a task on a grid; where the noise is not given, until its estimate stays."""

    task: Task
    loss: MaximumLikelihood
    estimated: np.ndarray  # of which states the noise is unknown

    def staged(self, begin: Beginning) -> State:
        """The whole record, through windows where it needs them."""
        task, loss = self.task, self.loss
        steps = list(begin.steps) or [np.full(run.n_samples - 1, loss.steps or 1) for run in task.data.trajectories]
        steps = [_fading(n) for n in steps] if begin.model.memory else steps

        def solve(b: Beginning, ways: tuple[str, ...], window: float | None = None) -> State:
            return self(b.model, steps, b.theta, b.x, b.sigma, task.l1, ways, window)

        longest = max(float(run.t[-1] - run.t[0]) for run in task.data.trajectories)
        ways = after(begin.way)
        if loss.window is None:
            through_windows = task.settings.thorough and not begin.is_optimum
            # Far from the optimum it is the windows that lead there; along solutions there may be others on the way.
            is_last_resort = through_windows and ways[0] != FEASIBLE_PATH
            state = solve(begin, tuple(w for w in ways if not is_last_resort or w != FEASIBLE_PATH))
            if state.solution.outcome.success or not through_windows:
                return state
            task.say("the whole record could not be solved; going through windows")
        window = loss.window or longest / WINDOWS
        while window < longest:
            state = solve(begin, ways, window)
            if state.solution.outcome.success:
                begin, ways = replace(begin, theta=state.theta, x=state.states, sigma=state.sigma), after(state.way)
            window *= GROWTH
        return solve(begin, ways)

    def __call__(
        self, model: Model, steps: list[np.ndarray], theta: np.ndarray, x: tuple[np.ndarray, ...], sigma: np.ndarray,
        l1: dict[str, float], ways: tuple[str, ...] = WAYS, window: float | None = None,
    ) -> State:  # fmt: skip
        """Solve from ``theta`` and the states ``x`` at the samples; the next of the ``ways`` where one fails."""
        task, loss = self.task, self.loss
        grid = grid_of(task.data, steps)
        unknown = Theta.of(model, task.runs)
        nodes = np.concatenate([between(run, n) for run, n in zip(x, steps, strict=True)])
        point = starting.point_at(model, grid, unknown, theta, nodes)
        point = replace(point, between=beginnings(model, grid, nodes, np.asarray(unknown.by_trajectory(theta))))
        if window is not None:
            grid = cut(grid, window)
        program = loss.program(model, grid, point, l1, sigma, unknown)
        left, z = self.solvers(program, model, grid, unknown, ways), program.start
        way, solver = next(left)
        settled = None
        for _ in range(NOISE_ROUNDS if self.estimated.any() else 1):
            solution = solver.solve(z, sigma, raise_on_failure=False)
            if settled is not None and way == FEASIBLE_PATH and not solution.outcome.success:
                # The kink where it settled is still in the way; the noise alone is another, and with it what a step
                # promises.
                solution = solver.at(settled, sigma)
                break
            while not solution.outcome.success and (further := next(left, None)) is not None:
                task.say(f"not solved ({solution.outcome.status}); again {WORDS[further[0]]}")
                other = further[1].solve(z, sigma, raise_on_failure=False)
                if other.outcome.success or further[0] != FEASIBLE_PATH:  # of two failures IPOPT's says more
                    (way, solver), solution = further, other
            where = "" if window is None else f" in windows of {window:.3g}"
            task.say(f"maximum likelihood, {len(theta)} parameters, {nodes.size} states{where}: {solution.outcome}")
            solution = _clean(solution)
            if not solution.outcome.success or not self.estimated.any():
                break
            residual = solution.residual * np.sqrt(int(grid.measured.sum()) / 2)
            new = np.where(self.estimated, estimated_noise(grid, residual, sigma, len(theta), loss.huber), sigma)
            change = np.log(new / sigma)[grid.measured.any(axis=0)]
            z, sigma, settled = solution.z, new, solution
            # One factor for all channels leaves the estimates where they are.
            alike = self.estimated.all() and loss.huber is None and not any(l1.values()) and np.ptp(change) < SAME
            if alike or np.max(np.abs(change)) < SAME:
                solution = solver.at(solution, sigma)
                break
        return State(task, loss, model, grid, unknown, point, program, solution, l1, sigma, way=way)

    def solvers(
        self, program: Program, model: Model, grid: Grid, unknown: Theta, ways: tuple[str, ...]
    ) -> Iterator[tuple[str, Solver | FeasiblePath]]:
        """What solves the program in each of the ways that the settings allow, made when it is asked for.

        With windows or slack variables nothing can be solved along the model; the exact Hessian stands in.
        """
        settings = self.task.settings
        quick = replace(settings, max_iterations=min(FIRST, settings.max_iterations))
        full = settings if settings.thorough else replace(quick, max_iterations=BRIEF)
        has_path = grid.n_nodes - grid.n_intervals == len(grid.first) and set(program.variables) == {"theta", "x"}
        allowed = [way for way in ways if way in settings.ways] or list(settings.ways)
        for way in dict.fromkeys(EXACT if way == FEASIBLE_PATH and not has_path else way for way in allowed):
            if way == FEASIBLE_PATH:
                yield way, FeasiblePath(program, model, grid, unknown, self.loss, settings.max_seconds)
            else:
                yield way, Solver(program, full if way == EXACT else quick, exact=way == EXACT)


def _clean(solution: Solution) -> Solution:
    """A stall where the data are explained far below the least noise that is assumed is the end, not a failure."""
    outcome = solution.outcome
    tiny = float(np.sum(solution.residual**2)) / 2 < CLEAN**2
    if outcome.success or not tiny or outcome.infeasibility > 1e-8:
        return solution
    sentence = "the data are explained beyond the accuracy of numbers: they have no noise"
    return replace(solution, outcome=replace(outcome, success=True, sentence=sentence, advice=""))


def cut(grid: Grid, window: float) -> Grid:
    """The grid without the intervals in which a window of a trajectory ends, so that every window starts freely.

    No window has fewer than `SHORTEST` samples; a gap with steps in it is cut behind its first sample.
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
    grid: Grid, residual: np.ndarray, sigma: np.ndarray, n_theta: int, huber: float | None
) -> np.ndarray:
    """Root mean square residual per channel, with the degrees of freedom that the fit used taken off.

    ``residual`` holds (y - x)/sigma of every measured value in the order of the nodes, cut at ``huber`` where that is
    given; then the mean square that normal noise would leave within the limit is divided out (Huber's proposal 2).
    """
    seen = grid.measured
    n_pieces = grid.n_nodes - grid.n_intervals
    share = max(1 - (n_theta + n_pieces * grid.y.shape[1]) / seen.sum(), 0.1)
    if huber is not None:
        outside = 2 * norm.sf(huber)
        share *= (1 - outside) - 2 * huber * norm.pdf(huber) + huber**2 * outside
    channel, least = np.nonzero(seen)[1], starting.least_noise(grid.y)
    result = sigma.copy()
    for k in np.flatnonzero(seen.any(axis=0)):
        rms = sigma[k] * np.sqrt(np.mean(residual[channel == k] ** 2))
        result[k] = max(rms / np.sqrt(share), least[k])
    return result


def _is_plausible(state: State) -> bool:
    return state.solution.outcome.success and _scatter(state)[0] < SUSPICIOUS


def _scatter(state: State) -> tuple[float, str]:
    """The largest residual of a channel beside what its neighbouring samples scatter, and the channel."""
    between_samples, y = difference_noise(state.task.data), state.grid.y
    seen = np.asarray(state.grid.measured.any(axis=0))
    # Data without noise say nothing about it.
    floor = np.array([10 * starting.CLEANEST * np.nanstd(y[:, k]) if seen[k] else 0.0 for k in range(y.shape[1])])
    residual = state.residual * np.sqrt(state.n_values / 2)
    channel = np.nonzero(state.grid.measured)[1]
    rms = np.array(
        [np.sqrt(np.mean(residual[channel == k] ** 2)) if seen[k] else 0.0 for k in range(len(between_samples))]
    )
    ratio = np.where(seen, state.sigma * rms / np.maximum(np.nan_to_num(between_samples), floor + 1e-300), 0.0)
    worst = int(np.argmax(ratio))
    return float(ratio[worst]), state.model.states[worst]


def _noise_note(state: State, known: np.ndarray) -> tuple[str, ...]:
    """A sentence where the residuals are far beyond what neighbouring samples scatter."""
    if known.any() or not state.solution.outcome.success:
        return ()
    ratio, channel = _scatter(state)
    if ratio < SUSPICIOUS:
        return ()
    return (
        f"the residuals of {channel} are {ratio:.1f} times what neighbouring samples scatter: the model "
        "lacks something (diagnose), outliers pull (try huber=1.345), or there are several optima (try starts=5)",
    )


# ---- steps between the samples ---------------------------------------------------------------------------------------


def _fading(steps: np.ndarray) -> np.ndarray:
    """The steps of a trajectory, many at its start, where what nobody knows of an effect's memory fades."""
    return np.where(np.arange(len(steps)) < FADING, np.maximum(steps, AT_START), steps)


def finer_steps(state: State) -> list[np.ndarray] | None:
    """More steps where the integration error moves the estimates, or residuals, by more than `VISIBLE`; else None.

    The error of each step, against a finer integration, offsets the constraints; the linearised likelihood says what
    that does to the estimates. The number of steps grows with the fourth root of an interval's error (order four).
    """
    grid, unknown = state.grid, state.unknown
    error = local_errors(state.model, grid, state.nodes, np.asarray(unknown.by_trajectory(state.theta)))
    lost = ~np.isfinite(error).all(axis=1)
    scaled = np.where(lost[:, None], 0.0, error / state.point.x_scale)
    held = [i for i, name in enumerate(unknown.names) if name in state.solution.outcome.at_bounds]
    covariance = inverse(state.reduced.information, held)
    theta, x = state.reduced.respond(scaled.ravel(), covariance)
    # In standard errors of the direction in which it is largest: many small shifts of one sign add up.
    moved = np.sqrt(max(float(theta @ state.reduced.information @ theta), 0.0))
    shown = (x.reshape(grid.y.shape) * state.point.x_scale / state.sigma)[grid.measured]
    visible = max(moved, float(np.sqrt(np.mean(shown**2))))
    if visible < VISIBLE and not lost.any():
        return None
    size = np.linalg.norm(scaled, axis=1)
    typical = np.sum(size**2) / max(np.sum(size), 1e-300)
    wanted = np.ceil((1.2 * visible / VISIBLE * size / max(typical, 1e-300)) ** 0.25)
    wanted = np.where(lost, 4, np.clip(wanted, 1, 16)).astype(int)
    old = steps_of(grid)
    gap = np.repeat(np.arange(sum(map(len, old))), np.concatenate(old))
    factor = np.ones(sum(map(len, old)), dtype=int)
    np.maximum.at(factor, gap, wanted)
    edges = np.cumsum([0, *map(len, old)]).tolist()
    new = [np.minimum(n * factor[a:b], MOST_STEPS) for n, (a, b) in zip(old, pairwise(edges), strict=True)]
    return None if all(np.array_equal(n, m) for n, m in zip(old, new, strict=True)) else new

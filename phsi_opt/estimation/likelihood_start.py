"""Where the maximisation of a likelihood starts.

At a fit; at the solution of the first part of a long record; or at values found from
scratch: states from the data or, where some are missing, by smoothing with a missing
force, then parameters by the PHSI loss. Further points beside the first are those of
`multi_start`.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem
from phsi_opt.estimation.missing_force import softened
from phsi_opt.estimation.multiple_shooting import SHORTEST_WINDOW
from phsi_opt.estimation.phsi_solve import PHSIEstimate, PHSISolver, best_of_starts
from phsi_opt.estimation.problem import Task, silent
from phsi_opt.estimation.starting_point import StartingPoint
from phsi_opt.initialization.convex_start import starting_values
from phsi_opt.initialization.kinematic_states import kinematic_states
from phsi_opt.initialization.relative_guesses import corner_widths, resolve_guesses
from phsi_opt.initialization.scaling import invert_sensors, point_at, with_states
from phsi_opt.model.model import Model
from phsi_opt.optimization.settings import GAUSS_NEWTON
from phsi_opt.transcription.alignment import AlignedData
from phsi_opt.transcription.augmented_states import (
    memory_of_sensors,
    padded,
    with_memory,
)
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.losses import PHSILoss
from phsi_opt.transcription.parameter_vector import Theta

# Nodes from which on a record with gaps starts through its first part.
LONG_RECORD = 20_000


def from_data(problem: LikelihoodProblem) -> StartingPoint:
    """The starting point found from scratch."""
    problem.task.say("starting values")
    of_sensors = memory_of_sensors(problem.task.model)
    if not of_sensors:
        return _of_motion(problem)
    # No state that is measured tells such a memory: it follows from the motion.
    start = _of_motion(_without_memory(problem, of_sensors))
    return _with_memory_of_sensors(problem, start)


def _of_motion(problem: LikelihoodProblem) -> StartingPoint:
    task = problem.task
    grid = invert_sensors(task.model, task.grid)
    if grid.measured.all():
        return _from_complete_data(problem, grid)
    return _from_data_with_gaps(problem, grid)


def _without_memory(
    problem: LikelihoodProblem, names: Sequence[str]
) -> LikelihoodProblem:
    """The problem of the motion alone, its sensors without what remembers."""
    task = replace(
        problem.task,
        model=problem.task.model.without_memory(names),
        aligned=problem.task.aligned.without_states(names),
    )
    return LikelihoodProblem.of(task, problem.loss)


def _with_memory_of_sensors(
    problem: LikelihoodProblem, start: StartingPoint
) -> StartingPoint:
    """A start of the motion, with the memory that follows from it."""
    task = problem.task
    grid = task.grid
    x = np.concatenate(start.states)
    model = task.model.with_values(start.model.values)
    model = resolve_guesses(model, grid, padded(model, x))
    unknown = Theta.of(model, task.runs)
    named = dict(zip(Theta.of(start.model, task.runs).names, start.theta, strict=True))
    theta = unknown.from_values(named, unknown.spread(model.theta))
    parameters = np.asarray(unknown.by_trajectory(theta))
    n_memory = model.n_states - x.shape[1]
    another = start.alternative
    return replace(
        start,
        model=model,
        theta=theta,
        states=grid.split(with_memory(model, grid, x, parameters)),
        sigma=np.append(start.sigma, problem.noise.sigma[-n_memory:]),
        alternative=None
        if another is None
        else lambda: _with_memory_of_sensors(problem, another()),
    )


def simple_start(problem: LikelihoodProblem) -> StartingPoint | None:
    """States from the data and the model's kinematics, at the values that are given.

    Nothing is solved for it but, where a value is not given, the PHSI loss.

    Returns:
        None where the data show too little for it.
    """
    task = problem.task
    dynamics = task.model.dynamics()
    guessed = resolve_guesses(dynamics, task.grid, np.nan_to_num(task.grid.y))
    x = kinematic_states(guessed, task.grid)
    if x is None:
        return None
    dynamics = resolve_guesses(dynamics, task.grid, x)
    values = [dynamics.entries[name].parameter.value for name in dynamics.free]
    if None not in values:
        return _at_values(problem, dynamics, task.grid, x)
    found = _by_phsi_loss(problem, dynamics, task.grid, x)
    solved = dynamics.with_values(found.values)
    start = _at_values(problem, solved, task.grid, x)
    return _at_estimate(found, start)


def _from_complete_data(problem: LikelihoodProblem, grid: Grid) -> StartingPoint:
    """The states are the data, the parameters those of the PHSI loss."""
    x = grid.y
    dynamics = resolve_guesses(problem.task.model.dynamics(), grid, x)
    if not dynamics.free:
        return _at_values(problem, dynamics, grid, x)
    first = _by_phsi_loss(problem, dynamics, grid, x)
    solved = dynamics.with_values(first.values)
    start = _at_values(problem, solved, grid, x)
    return _at_estimate(first, start)


def _from_data_with_gaps(problem: LikelihoodProblem, grid: Grid) -> StartingPoint:
    """States by smoothing, parameters by the PHSI loss, then both together.

    The alternative keeps the parameters of the PHSI loss, and the states smoothed with
    them.
    """
    core = problem.task.model.dynamics()
    guessed = resolve_guesses(core, grid, np.nan_to_num(grid.y))
    smoothing = problem.smooth_states(guessed, grid, rounds=2)
    x = smoothing.x
    noise = replace(problem.noise, sigma=smoothing.sigma)
    problem = replace(problem, noise=noise)
    dynamics = resolve_guesses(core, grid, x)
    if not dynamics.free:
        return _at_values(problem, dynamics, grid, x)
    first = _by_phsi_loss(problem, dynamics, grid, x)
    confirmed = dynamics.with_values(first.values)
    # States smoothed with the parameters given would only confirm them.
    unconfirmed = confirmed.with_values(_given_values(problem.task.model, dynamics))

    def alternative() -> StartingPoint:
        again = problem.smooth_states(confirmed, grid, rounds=1, prior=smoothing.prior)
        start = _at_values(problem, confirmed, grid, again.x)
        return _at_estimate(first, replace(start, sigma=again.sigma))

    start = _softened_start(problem, unconfirmed, grid, x)
    return replace(start, notes=first.notes, alternative=alternative)


def _softened_start(
    problem: LikelihoodProblem, dynamics: Model, grid: Grid, x: np.ndarray
) -> StartingPoint:
    """Parameters and states together, with a missing force that shrinks."""
    sigma = problem.noise.sigma
    shared = Theta.of(dynamics, problem.task.runs)
    smooth = point_at(dynamics, grid, shared, dynamics.theta, x)
    point = softened(dynamics, grid, shared, smooth, sigma, problem.loss.integrator)
    values = dict(zip(dynamics.free, point.theta.tolist(), strict=True))
    return _at_values(problem, dynamics.with_values(values), grid, point.x)


def _given_values(model: Model, dynamics: Model) -> dict[str, float]:
    """Values of the free parameters of ``dynamics`` for which a user gave one."""
    entries = model.entries
    given = {}
    for name in dynamics.free:
        entry = entries.get(name)
        if entry is None or entry.prunable:
            continue
        if entry.parameter.value is not None:
            given[name] = dynamics.values[name]
    return given


def _by_phsi_loss(
    problem: LikelihoodProblem, dynamics: Model, grid: Grid, x: np.ndarray
) -> PHSIEstimate:
    """Parameters of the dynamics where the states at the nodes are x, never pruned."""
    task = replace(problem.task, model=dynamics, pruning=None, say=silent)
    known = with_states(grid, x)
    solver = PHSISolver(task, PHSILoss(problem.loss.integrator), known)
    estimates = []
    for theta in starting_values(dynamics, known, task.l1):
        estimates.append(solver.solve(dynamics, theta, task.l1))
    return best_of_starts(estimates, _by_objective)


def _at_estimate(found: PHSIEstimate, start: StartingPoint) -> StartingPoint:
    """A start at an estimate's values with its notes, and what it left at bounds."""
    return replace(start, notes=found.notes, held=found.solution.outcome.at_bounds)


def _by_objective(estimate: PHSIEstimate) -> tuple[bool, float]:
    """Success first, then the smaller objective."""
    return not estimate.is_success, estimate.solution.outcome.objective


def _at_values(
    problem: LikelihoodProblem, dynamics: Model, grid: Grid, x: np.ndarray
) -> StartingPoint:
    """At the values of the dynamics, the sensors' as they are, and the states x."""
    task = problem.task
    entries = task.model.entries
    values = {name: v for name, v in dynamics.values.items() if name in entries}
    model = resolve_guesses(task.model.with_values(values), grid, x)
    theta = Theta.of(model, task.runs).spread(model.theta)
    return StartingPoint(model, theta, grid.split(x), problem.noise.sigma)


def needs_first_part(problem: LikelihoodProblem) -> bool:
    """Whether the record is too long to start on the whole of it.

    Along a long record, states that are not measured cannot be found while the
    parameters are still far off.
    """
    grid = problem.task.grid
    return not grid.measured.all() and grid.n_nodes > LONG_RECORD


def first_part(task: Task) -> Task:
    """The task on the first part of each trajectory, without pruning."""
    share = LONG_RECORD / 2 / task.grid.n_nodes
    runs = []
    for run in task.data.trajectories:
        wanted = max(int(share * run.n_samples), 2 * SHORTEST_WINDOW)
        n = min(wanted, run.n_samples)
        runs.append(replace(run, t=run.t[:n], x=run.x[:n], u=run.u[:n]))
    n_samples = sum(run.n_samples for run in runs)
    task.say(f"starting values from the first {n_samples} samples")
    data = replace(task.data, trajectories=tuple(runs))
    return replace(task, aligned=AlignedData(data, grid_of(data)), pruning=None)


def from_first_part(
    problem: LikelihoodProblem, first: LikelihoodEstimate
) -> StartingPoint:
    """At the parameters of `first_part`, with states for the whole record."""
    problem = problem.with_noise_of(first.sigma)
    states = states_at(problem, first.model, first.theta)
    sigma = problem.noise.sigma
    held = first.solution.outcome.at_bounds
    return StartingPoint(
        first.model, first.theta, states, sigma, first.notes, held=held
    )


def from_fit(problem: LikelihoodProblem, start: Fit) -> StartingPoint:
    """At a fit's values, and at its states where it has those of these data."""
    task = problem.task
    fitted_noise = [start.noise.get(name, 1.0) for name in task.model.states]
    problem = problem.with_noise_of(np.array(fitted_noise))
    grid = task.grid
    lengths = [run.n_samples for run in task.data.trajectories]
    has_states = [len(x) for x in start.states] == lengths
    x = _common_states(start, task.model) if has_states else np.nan_to_num(grid.y)
    model = resolve_guesses(task.model, grid, x)
    unknown = Theta.of(task.model, task.runs)
    theta = unknown.from_values(start.estimates, unknown.spread(model.theta))
    if has_states:
        # The memory of an effect that the fit did not have follows from its states.
        parameters = np.asarray(unknown.by_trajectory(theta))
        states = grid.split(with_memory(model, grid, x, parameters))
    else:
        states = states_at(problem, model, theta)
    has_steps = [len(n) + 1 for n in start.steps] == lengths
    keeps_steps = has_steps and problem.loss.steps is None
    is_related = has_states and _solves_a_model_like(start, task.model)
    has_same_names = set(start.names) == set(unknown.names)
    return StartingPoint(
        model=model,
        theta=theta,
        states=states,
        sigma=problem.noise.sigma,
        steps=start.steps if keeps_steps else (),
        way=start.outcome.way if is_related else GAUSS_NEWTON,
        held=start.outcome.at_bounds,
        is_optimum=is_related and has_same_names,
    )


def _common_states(start: Fit, model: Model) -> np.ndarray:
    """States of a fit that the model has too, at the samples of all trajectories."""
    fitted = start.model.states
    common = [fitted.index(name) for name in model.states if name in fitted]
    return np.concatenate(start.states)[:, common]


def _solves_a_model_like(start: Fit, model: Model) -> bool:
    """Whether what solved the fit will solve the model, which has the same corners."""
    has_corners = set(corner_widths(start.model)) <= set(model.entries)
    return start.outcome.success and has_corners


def states_at(
    problem: LikelihoodProblem, model: Model, theta: np.ndarray
) -> tuple[np.ndarray, ...]:
    """States at the samples for given parameters, (n_samples, n_states) per trajectory.

    The data where they are complete, else smoothed with a missing force.

    Raises:
        SolveError: if the smoothing fails.
    """
    grid = problem.task.grid
    if grid.measured.all() and not model.sensor:
        return grid.split(grid.y)
    values = Theta.of(model, problem.task.runs).by_trajectory(theta)
    smoothing = problem.smooth_states(model, grid, values, rounds=1)
    return grid.split(smoothing.x)

"""Where the maximisation of a likelihood starts.

At a fit, or at a crude start: states from the data and the model's own kinematics,
parameters as they are given. It need not be near: a missing force that shrinks leads
from there (`likelihood_steps`). Further points are those of `several_starts`.
"""

from dataclasses import replace

import numpy as np

from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem, StartingPoint
from phsi_opt.estimation.missing_force import smoothed
from phsi_opt.estimation.phsi_solve import PHSIEstimate, PHSISolver, best_of_starts
from phsi_opt.estimation.problem import silent
from phsi_opt.initialization.convex_start import starting_values
from phsi_opt.initialization.kinematic_states import kinematic_states
from phsi_opt.initialization.relative_guesses import corner_widths, resolve_guesses
from phsi_opt.model.model import Model
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.losses import PHSILoss
from phsi_opt.transcription.parameter_vector import Theta


def crude_start(problem: LikelihoodProblem) -> StartingPoint:
    """States from the data and the model's kinematics, at the values that are given.

    Nothing is solved for it but, where values are not given and the states follow from
    the data, the PHSI loss. A state that follows from nothing begins at zero.
    """
    task = problem.task
    dynamics = task.model.dynamics()
    guessed = resolve_guesses(dynamics, task.grid, np.nan_to_num(task.grid.y))
    x, is_complete = kinematic_states(guessed, task.grid)
    dynamics = resolve_guesses(dynamics, task.grid, x)
    values = [dynamics.entries[name].parameter.value for name in dynamics.free]
    is_told = is_complete and not dynamics.memory
    if None not in values or not is_told:
        return _at_values(problem, dynamics, task.grid, x)
    found = _by_phsi_loss(problem, dynamics, task.grid, x)
    solved = dynamics.with_values(found.values)
    start = _at_values(problem, solved, task.grid, x)
    held = found.solution.outcome.at_bounds
    return replace(start, notes=found.notes, held=held)


def _by_phsi_loss(
    problem: LikelihoodProblem, dynamics: Model, grid: Grid, x: np.ndarray
) -> PHSIEstimate:
    """Parameters of the dynamics where the states at the nodes are x, never pruned."""
    task = replace(problem.task, model=dynamics, pruning=None, say=silent)
    known = replace(grid, y=x)  # as if the states had been measured at every node
    solver = PHSISolver(task, PHSILoss(problem.loss.integrator), known)
    estimates = []
    for theta in starting_values(dynamics, known, task.l1):
        estimates.append(solver.solve(dynamics, theta, task.l1))
    # Success first, then the smaller objective.
    return best_of_starts(
        estimates, lambda e: (not e.is_success, e.solution.outcome.objective)
    )


def _at_values(
    problem: LikelihoodProblem, dynamics: Model, grid: Grid, x: np.ndarray
) -> StartingPoint:
    """At the values of the dynamics, the sensors' as they are, and the states x."""
    task = problem.task
    entries = task.model.entries
    values = {name: v for name, v in dynamics.values.items() if name in entries}
    model = resolve_guesses(task.model.with_values(values), grid, x)
    unknown = Theta.of(model, task.runs)
    theta = unknown.spread(model.theta)
    n_memory = len(model.memory)
    if n_memory and model.states[-n_memory:] == model.memory:
        parameters = np.asarray(unknown.by_trajectory(theta))
        x = with_memory(model, grid, x[:, :-n_memory], parameters)
    return StartingPoint(model, theta, grid.split(x), problem.noise.sigma)


def from_fit(problem: LikelihoodProblem, start: Fit) -> StartingPoint:
    """At a fit's values, and at its states where it has those of these data."""
    task = problem.task
    fitted_noise = [start.noise.get(name, 1.0) for name in task.model.states]
    problem = problem.with_noise_of(np.array(fitted_noise))
    grid = task.grid
    lengths = [run.n_samples for run in task.data.trajectories]
    has_states = [len(x) for x in start.states] == lengths
    x = np.nan_to_num(grid.y)
    if has_states:
        # Those that the model has too.
        fitted = start.model.states
        common = [fitted.index(name) for name in task.model.states if name in fitted]
        x = np.concatenate(start.states)[:, common]
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
    # What solved the fit will solve a model of the same corners.
    has_corners = set(corner_widths(start.model)) <= set(task.model.entries)
    is_related = has_states and start.outcome.success and has_corners
    has_same_names = set(start.names) == set(unknown.names)
    return StartingPoint(
        model=model,
        theta=theta,
        states=states,
        sigma=problem.noise.sigma,
        steps=start.steps if keeps_steps else (),
        held=start.outcome.at_bounds,
        is_optimum=is_related and has_same_names,
    )


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
    noise = problem.noise
    found = smoothed(
        model,
        grid,
        noise.sigma,
        values,
        rounds=1,
        known_noise=noise.is_known,
        integrator=problem.loss.integrator,
        least_noise=noise.least,
    )
    return grid.split(found.x)

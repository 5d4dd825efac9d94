"""TODO."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from phsi_opt.errors import DataError, SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.likelihood_solve import SHORTEST, Beginning
from phsi_opt.estimation.missing_force import smoothed, softened
from phsi_opt.estimation.phsi import chosen, solve_defects
from phsi_opt.estimation.problem import State, Task
from phsi_opt.initialization.convex_start import starting_values
from phsi_opt.initialization.relative_guesses import corner_widths, resolve_guesses
from phsi_opt.initialization.scaling import (
    invert_sensors,
    point_at,
    theta_scale,
    with_states,
)
from phsi_opt.model.model import Model
from phsi_opt.optimization.settings import GAUSS_NEWTON
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.losses import MaximumLikelihood, PHSILoss
from phsi_opt.transcription.parameter_vector import Theta

PartSolver = Callable[[Task, MaximumLikelihood], State]

LONG = 20_000  # nodes from which on a record with gaps is begun through its first part


def given_noise(loss: MaximumLikelihood, task: Task) -> np.ndarray:
    """Noise per state as the loss or the measurements declare it; NaN where it is to be
    estimated.
    """
    data = task.data
    noise = loss.noise if loss.noise is not None else data.noise or {}
    for name in data.measured:
        missing = loss.noise is not None and name not in noise
        if missing or (
            name in noise and not (np.isfinite(noise[name]) and noise[name] > 0)
        ):
            raise DataError(
                f"noise of the measured state {name!r} is {noise.get(name)!r}; expected a number above zero."
            )
    return np.array([noise.get(name, np.nan) for name in data.states])


def beginning(
    task: Task,
    loss: MaximumLikelihood,
    sigma: np.ndarray,
    known: np.ndarray,
    start: Fit | None,
    solve_part: PartSolver,
) -> Beginning:
    """Where the solver begins: at a fit, at the solution of a part of a long record, or
    at values found from scratch.

    ``solve_part`` solves a task whole, without a fit to start from and without pruning.
    """
    grid = grid_of(task.data)
    if start is not None:
        old = np.array([start.noise.get(name, 1.0) for name in task.model.states])
        return _from_fit(task, loss, np.where(known, sigma, old), known, start)
    if not grid.measured.all() and grid.n_nodes > LONG:
        return _through_a_part(task, loss, sigma, known, grid, solve_part)
    task.say("starting values")
    core, grid = task.model.dynamics(), invert_sensors(task.model, grid)
    notes: tuple[str, ...] = ()
    complete_data = bool(grid.measured.all())
    x = grid.y
    if not complete_data:
        guessed = resolve_guesses(core, grid, np.nan_to_num(grid.y))
        estimate = smoothed(guessed, grid, sigma, loss.integrator, known, rounds=2)
        x, sigma = estimate.x, estimate.sigma
    core = resolve_guesses(core, grid, x)
    given = {
        name
        for name, e in task.model.entries.items()
        if e.parameter.value is not None and not e.prunable
    }
    if core.free:
        first = _from_states(
            replace(task, model=core, pruning=None, say=lambda line: None),
            loss,
            grid,
            x,
        )
        notes = first.notes
        values = first.values
        if not complete_data:
            # States smoothed with the parameters given would only confirm them.
            values = {
                name: core.values[name] if name in given else value
                for name, value in values.items()
            }
        core = core.with_values(values)
    other: Callable[[], Beginning] | None = None
    if core.free and not complete_data:
        confirmed, prior = core.with_values(first.values), estimate.prior

        def other() -> Beginning:
            again = smoothed(
                confirmed, grid, sigma, loss.integrator, known, rounds=1, prior=prior
            )
            return _ready(task, confirmed, grid, again.x, again.sigma, notes)

        shared = Theta.of(core, task.runs)
        theta = core.theta
        point = softened(
            core,
            grid,
            shared,
            point_at(core, grid, shared, theta, x),
            sigma,
            loss.integrator,
        )
        core, x = (
            core.with_values(dict(zip(core.free, point.theta.tolist(), strict=True))),
            point.x,
        )
    return replace(_ready(task, core, grid, x, sigma, notes), other=other)


def _through_a_part(
    task: Task,
    loss: MaximumLikelihood,
    sigma: np.ndarray,
    known: np.ndarray,
    grid: Grid,
    solve_part: PartSolver,
) -> Beginning:
    """The beginning of a long record at the solution of the first part of each of its
    trajectories.

    Along a long record, states that are not measured cannot be found while the
    parameters are still far off.
    """
    share = LONG / 2 / grid.n_nodes
    runs = []
    for run in task.data.trajectories:
        n = min(max(int(share * run.n_samples), 2 * SHORTEST), run.n_samples)
        runs.append(replace(run, t=run.t[:n], x=run.x[:n], u=run.u[:n]))
    task.say(
        f"starting values from the first {sum(run.n_samples for run in runs)} samples"
    )
    part = replace(
        task, data=replace(task.data, trajectories=tuple(runs)), pruning=None
    )
    first = solve_part(part, replace(loss, starts=1, window=None))
    unknown = Theta.of(first.model, task.runs)
    sigma = np.where(known, sigma, first.sigma)
    states = _at_theta(first.model, grid, unknown, first.theta, sigma, loss, known)
    return Beginning(first.model, first.theta, states, sigma, first.notes)


def _from_fit(
    task: Task,
    loss: MaximumLikelihood,
    sigma: np.ndarray,
    known: np.ndarray,
    start: Fit,
) -> Beginning:
    """The beginning at a fit's values, and at its states where they are those of these
    measurements.
    """
    grid, unknown = grid_of(task.data), Theta.of(task.model, task.runs)
    lengths = [run.n_samples for run in task.data.trajectories]
    own = [len(x) for x in start.states] == lengths
    kept = [
        start.model.states.index(name)
        for name in task.model.states
        if name in start.model.states
    ]
    x = np.concatenate(start.states)[:, kept] if own else np.nan_to_num(grid.y)
    model = resolve_guesses(task.model, grid, x)
    default = unknown.spread(model.theta)
    theta = unknown.from_values(start.estimates, default)
    if own:  # the memory of an effect that the fit did not have follows from its states
        states = grid.split(
            with_memory(model, grid, x, np.asarray(unknown.by_trajectory(theta)))
        )
    else:
        states = _at_theta(model, grid, unknown, theta, sigma, loss, known)
    steps = (
        start.steps
        if loss.steps is None and [len(n) + 1 for n in start.steps] == lengths
        else ()
    )
    related = (
        own
        and start.outcome.success
        and set(corner_widths(start.model)) <= set(task.model.entries)
    )
    way = start.outcome.way if related else GAUSS_NEWTON
    return Beginning(
        model,
        theta,
        states,
        sigma,
        (),
        steps,
        way,
        related and set(start.names) == set(unknown.names),
    )


def _at_theta(
    model: Model,
    grid: Grid,
    unknown: Theta,
    theta: np.ndarray,
    sigma: np.ndarray,
    loss: MaximumLikelihood,
    known: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """States at the samples for given parameters: the data where they are complete,
    else with a missing force.
    """
    if grid.measured.all() and not model.sensor:
        return grid.split(grid.y)
    values = unknown.by_trajectory(theta)
    return grid.split(
        smoothed(model, grid, sigma, loss.integrator, known, values, rounds=1).x
    )


def _ready(
    task: Task,
    core: Model,
    grid: Grid,
    x: np.ndarray,
    sigma: np.ndarray,
    notes: tuple[str, ...],
) -> Beginning:
    """The beginning with the values of the dynamics ``core`` and the states x."""
    model = task.model.with_values(
        {
            name: value
            for name, value in core.values.items()
            if name in task.model.entries
        }
    )
    model = resolve_guesses(model, grid, x)
    theta = Theta.of(model, task.runs).spread(model.theta)
    return Beginning(model, theta, grid.split(x), sigma, notes)


def _from_states(
    task: Task, loss: MaximumLikelihood, grid: Grid, x: np.ndarray
) -> State:
    known = with_states(grid, x)
    thetas = starting_values(task.model, known, task.l1)
    states = [
        solve_defects(
            task, PHSILoss(loss.integrator), task.model, known, theta, task.l1
        )
        for theta in thetas
    ]
    return chosen(
        states, lambda s: (not s.solution.outcome.success, s.solution.outcome.objective)
    )


def moved_starts(
    begin: Beginning, task: Task, loss: MaximumLikelihood, known: np.ndarray
) -> list[Beginning]:
    """The beginning and n - 1 others: values times a random factor, those at zero moved
    by their size; fixed seed.
    """
    if loss.starts == 1:
        return [begin]
    unknown, grid = Theta.of(begin.model, task.runs), grid_of(task.data)
    model_theta = unknown.means(begin.theta)
    x = np.concatenate(begin.x)
    size = unknown.spread(theta_scale(begin.model, grid, model_theta, x, _spread(x)))
    lower, upper = np.array(
        [(e.parameter.lower, e.parameter.upper) for e in unknown.entries]
    ).T
    rng = np.random.default_rng(0)
    starts = [begin]
    for _ in range(loss.starts - 1):
        draw = rng.normal(size=(2, len(begin.theta)))
        moved = np.where(
            begin.theta != 0, begin.theta * np.exp(0.7 * draw[0]), 0.3 * size * draw[1]
        )
        moved = np.clip(moved, lower, upper)
        states = begin.x
        with suppress(
            SolveError
        ):  # far from the data there may be no states; then those of the first start
            states = _at_theta(
                begin.model, grid, unknown, moved, begin.sigma, loss, known
            )
        starts.append(
            replace(begin, theta=moved, x=states, way=GAUSS_NEWTON, is_optimum=False)
        )
    return starts


def _spread(x: np.ndarray) -> np.ndarray:
    return np.maximum(np.std(x, axis=0), 1e-12)

"""How `MaximumLikelihood` is solved: where it starts, and what follows the optimum.

1. Start: at a fit, or at a crude start: states from the data and the model's own
   kinematics, parameters as they are given. It need not be near. A fit without states
   of these data gives its values to the crude start.
2. Full steps from there: where they leave no more than the scatter of neighbouring
   samples, 3 is not needed.
3. A missing force that shrinks leads from the crude start near a solution of the model
   (`likelihood_steps`); from there again full steps, with the noise re-estimated until
   it stays; where these do not settle, IPOPT.
4. The same from random points around the start, where the user asks for them as a check
   on local optima (``starts``).
5. Sharper corners of dry friction whose widths were guessed (`corners`).
6. More intervals between samples, where the integration error is visible in the
   estimates.
7. Pruning, where it is asked for.
"""

from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from functools import partial

import numpy as np

from phsi_opt.data.noise import LEAST_SIZE
from phsi_opt.estimation.corners import sharpened
from phsi_opt.estimation.estimate import pruned
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import (
    LikelihoodProblem,
    StartingPoint,
    likeliest,
)
from phsi_opt.estimation.optimum_checks import (
    finer_steps,
    is_small_beside_motion,
    residual_warnings,
    worst_share,
)
from phsi_opt.estimation.phsi_solve import PHSISolver, best_of_starts
from phsi_opt.initialization.relative_guesses import (
    corner_widths,
    open_delays,
    resolve_guesses,
)
from phsi_opt.initialization.scaling import kinematic_states, theta_scale
from phsi_opt.initialization.starting_values import starting_values
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Parameter
from phsi_opt.model_error.joint_estimate import STEPS_OF_A_PROBLEM
from phsi_opt.sweeps.sweep import Progress, ahead, silent
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.grid import steps_per_gap
from phsi_opt.transcription.losses import PHSILoss
from phsi_opt.transcription.parameter_vector import Theta


def by_likelihood(problem: LikelihoodProblem, start: Fit | None) -> LikelihoodEstimate:
    """The maximum of the likelihood from the best of the starting points.

    Refined where needed, and pruned.
    """
    late = set(open_delays(problem.task.model))
    if start is None or late - start.estimates.keys():
        first = crude_start(problem)
    else:
        first = from_fit(problem, start)
    estimate = sharpened(problem, best_optimum(problem, first))
    if problem.loss.steps is None and problem.task.settings.thorough:
        estimate = _with_fine_steps(problem, estimate)
    steps = steps_per_gap(estimate.grid)

    def resolve(
        model: Model,
        theta: np.ndarray,
        l1: dict[str, float],
        known: LikelihoodEstimate,
    ) -> LikelihoodEstimate:
        there = replace(StartingPoint.at(known, steps), model=model, theta=theta)
        return problem.solve(there, l1=l1)

    estimate = pruned(estimate, resolve)
    signs = wrong_signs(problem, estimate) if start is None else {}
    warnings = residual_warnings(estimate, signs)
    if not warnings:
        return estimate  # with all that has been worked out about it
    return replace(estimate, notes=estimate.notes + warnings)


def wrong_signs(
    problem: LikelihoodProblem, estimate: LikelihoodEstimate
) -> dict[str, float]:
    """Parameters whose terms have the wrong sign, with the values that would fit.

    Where residuals are a large share of the motion, the terms of H and F whose bound is
    zero are fitted without it. Those count that end beyond, if the residuals fall to a
    half.
    """
    if is_small_beside_motion(estimate):
        return {}
    task = problem.task
    bounded: dict[str, Parameter] = {}
    for name in task.model.free:
        entry = task.model.entries[name]
        bounds = (entry.parameter.lower, entry.parameter.upper)
        if entry.slot in ("H", "F") and 0.0 in bounds:
            bounded[name] = entry.parameter
    if not bounded:
        return {}
    free = task.model.with_parameters(
        lambda _, one: replace(one, lower=-np.inf, upper=np.inf), bounded
    )
    other = replace(problem, task=replace(task, model=free, say=silent))
    found = other.solve_from(crude_start(other))
    if not found.is_success or 2 * worst_share(found) > worst_share(estimate):
        return {}
    return {
        name: found.values[name]
        for name, one in bounded.items()
        if not one.lower <= found.values[name] <= one.upper
    }


def _with_fine_steps(
    problem: LikelihoodProblem, estimate: LikelihoodEstimate
) -> LikelihoodEstimate:
    """Solved again with finer steps until the integration error is not visible."""
    # Where these lead nowhere the last optimum stays, with a note.
    for _ in range(5):
        steps = finer_steps(estimate) if estimate.is_success else None
        if steps is None:
            break
        most = int(np.max(np.concatenate(steps)))
        problem.task.say(
            f"the integration error affects the estimates: now up to {most} steps per "
            "sample"
        )
        there = replace(StartingPoint.at(estimate, steps), is_optimum=True)
        estimate.release()
        # From an optimum full steps lead there, or hardly anything does.
        finer = problem.solve(there, most_steps=STEPS_OF_A_PROBLEM)
        if not finer.is_success:
            note = (
                "the integration steps are too long: the estimates depend on them, "
                f"and with up to {most} steps per sample the solver failed. Probably "
                "a rate of the model is much faster than the data: give its "
                "parameters bounds, or diagnose the model"
            )
            return replace(estimate, notes=(*estimate.notes, note))
        estimate = replace(finer, notes=estimate.notes)
    return estimate


# ---- where it starts -----------------------------------------------------------------


def crude_start(problem: LikelihoodProblem) -> StartingPoint:
    """States from the data and the model's kinematics, at the values that are given.

    Nothing is solved for it but, where values are not given and the states follow from
    the data, the PHSI loss. A state that follows from nothing begins at zero.
    """
    task = problem.task
    grid = task.grid
    dynamics = task.model.dynamics()
    guessed = resolve_guesses(dynamics, grid, np.nan_to_num(grid.y))
    x, is_complete = kinematic_states(guessed, grid)
    dynamics = resolve_guesses(dynamics, grid, x)
    notes: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    given = [dynamics.entries[name].parameter.value for name in dynamics.free]
    if None in given and is_complete and not dynamics.memory:
        # As if the states had been measured at every node; never pruned.
        of_dynamics = replace(task, model=dynamics, pruning=None, say=silent)
        known = replace(grid, y=x)
        solver = PHSISolver(of_dynamics, PHSILoss(problem.loss.integrator), known)
        estimates = []
        for theta in starting_values(dynamics, known, task.l1):
            estimates.append(solver.solve(dynamics, theta, task.l1))
        # Success first, then the smaller objective.
        found = best_of_starts(
            estimates, lambda e: (not e.is_success, e.solution.outcome.objective)
        )
        dynamics = dynamics.with_values(found.values)
        notes = found.notes
        held = found.solution.outcome.at_bounds
    # The values of the sensors stay as they are.
    entries = task.model.entries
    values = {name: v for name, v in dynamics.values.items() if name in entries}
    model = resolve_guesses(task.model.with_values(values), grid, x)
    unknown = Theta.of(model, task.runs)
    theta = unknown.spread(model.theta)
    n_memory = len(model.memory)
    if n_memory and model.states[-n_memory:] == model.memory:
        parameters = unknown.by_trajectory(theta)
        x = with_memory(model, grid, x[:, :-n_memory], parameters)
    sigma = problem.noise.sigma
    return StartingPoint(model, theta, grid.split(x), sigma, notes, held=held)


def from_fit(problem: LikelihoodProblem, start: Fit) -> StartingPoint:
    """At a fit's values, and at its states where it has those of these data."""
    task = problem.task
    noise = problem.noise
    fitted_noise = [start.noise.get(name, 1.0) for name in task.model.states]
    at_least = np.maximum(fitted_noise, noise.least)
    sigma = np.where(noise.is_known, noise.sigma, at_least)
    grid = task.grid
    lengths = [run.n_samples for run in task.data.trajectories]
    has_states = list(map(len, start.states)) == lengths
    if has_states:
        # Those that the model has too.
        fitted = start.model.states
        common = [fitted.index(name) for name in task.model.states if name in fitted]
        x = np.concatenate(start.states)[:, common]
    else:
        x = np.concatenate(states_at(problem, start.values))
    model = resolve_guesses(task.model, grid, x)
    unknown = Theta.of(task.model, task.runs)
    theta = unknown.from_values(start.estimates, unknown.spread(model.theta))
    # The memory of an effect that the fit did not have follows from its states.
    x = with_memory(model, grid, x, unknown.by_trajectory(theta))
    has_steps = [len(n) + 1 for n in start.steps] == lengths
    keeps_steps = has_steps and problem.loss.steps is None
    # What solved the fit will solve a model of the same corners.
    has_corners = set(corner_widths(start.model)) <= set(task.model.entries)
    is_related = has_states and start.outcome.success and has_corners
    return StartingPoint(
        model=model,
        theta=theta,
        states=grid.split(x),
        sigma=sigma,
        steps=start.steps if keeps_steps else (),
        held=start.outcome.at_bounds,
        is_optimum=is_related and set(start.names) == set(unknown.names),
    )


def states_at(
    problem: LikelihoodProblem, values: Mapping[str, float]
) -> tuple[np.ndarray, ...]:
    """Those of the crude start, at values by name of the parameters that are free."""
    model = problem.task.model
    known = {name: values[name] for name in model.free if name in values}
    task = replace(problem.task, model=model.with_values(known))
    return crude_start(replace(problem, task=task)).states


# ---- several starts ------------------------------------------------------------------


def best_optimum(
    problem: LikelihoodProblem, first: StartingPoint
) -> LikelihoodEstimate:
    """The optimum of least deviance, with notes on how it was found.

    From the first starting point and from random ones, in parallel if asked for.
    """
    task = problem.task
    of_workers = replace(problem, task=replace(task, say=silent, executor=None))
    values = [None, *_random_values(problem, first)]
    cases = {f"start {number}": theta for number, theta in enumerate(values, 1)}
    solve = partial(_optimum_at, of_workers, first)
    with closing(ahead(solve, cases, task.executor, task.say)) as results:
        estimates = [replace(result(), task=task) for result in results]
    best = likeliest(estimates)
    notes = first.notes
    if len(estimates) > 1:
        # Far below what one parameter more explains by chance, far above the solver's
        # tolerance.
        limit = best.deviance + 0.1
        n_agreeing = sum(e.is_success and e.deviance < limit for e in estimates)
        agreement = f"{n_agreeing} of {len(estimates)} starting points"
        notes = (*notes, f"{agreement} led to the best solution")
    return replace(best, notes=notes) if notes else best


def _optimum_at(
    problem: LikelihoodProblem,
    first: StartingPoint,
    theta: np.ndarray | None,
    say: Progress,
) -> LikelihoodEstimate:
    """The optimum from the first point, or from other values theta (n_theta,)."""
    problem = replace(problem, task=replace(problem.task, say=say))
    if theta is None:
        return problem.solve_from(first)
    means = Theta.of(first.model, problem.task.runs).means(theta).tolist()
    states = states_at(problem, dict(zip(first.model.free, means, strict=True)))
    moved = replace(first, theta=theta, states=states, is_optimum=False)
    return problem.solve_from(moved)


def _random_values(
    problem: LikelihoodProblem, first: StartingPoint
) -> list[np.ndarray]:
    """Values (n_theta,) of the points besides the first, ``starts`` of the loss."""
    # Those of the first times a log-normal factor, by which one in three is more than
    # doubled or halved; values of zero are moved by a share of the parameter's size:
    # the change that moves some equation by the size of its rate.
    n_further = problem.loss.starts - 1
    if not n_further:
        return []
    unknown = Theta.of(first.model, problem.task.runs)
    x = np.concatenate(first.states)
    x_spread = np.maximum(np.std(x, axis=0), LEAST_SIZE)
    means = unknown.means(first.theta)
    sizes = theta_scale(first.model, problem.task.grid, means, x, x_spread)
    shift = 0.3 * unknown.spread(sizes)
    rng = np.random.default_rng(0)  # the same points every time
    found = []
    for _ in range(n_further):
        for_factor, for_shift = rng.normal(size=(2, len(first.theta)))
        scaled = first.theta * np.exp(0.7 * for_factor)
        moved = np.where(first.theta != 0, scaled, shift * for_shift)
        found.append(np.clip(moved, unknown.lower, unknown.upper))
    return found

"""A fitted model along a record: the states that explain the record best, and how certain a free run of it is.

The dynamics hold exactly (zero defects) and the shared parameters stay as they are; starting states, and parameters of
a trajectory that the fit has not seen, follow from the record by maximum likelihood.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from phsi_opt.fit import Fit
from phsi_opt.grid import Grid, grid_of, output_slopes, output_slopes_of, outputs
from phsi_opt.likelihood import finer_steps, on_record
from phsi_opt.linear import Reduced
from phsi_opt.losses import MaximumLikelihood
from phsi_opt.measurements import Measurements
from phsi_opt.model import Model
from phsi_opt.solver import Solver
from phsi_opt.start import point_at
from phsi_opt.theta import Theta
from phsi_opt.work import State

LONGEST = 200_000  # values in a record up to which bands are worked out
REFINEMENTS, FINER = 2, 4  # how often steps along a record are made finer where their error shows, and how much
MOST_REFINED = 50_000  # states beyond which they are not


def parameters_of(fit: Fit, data: Measurements) -> dict[str, dict[str, float]]:
    """Values of the free parameters per trajectory; the means of the fit for one that it has not seen."""
    free = {name: fit.values[name] for name in fit.model.free}
    return {run.name: {**free, **fit.by_trajectory.get(run.name, {})} for run in data.trajectories}


def matrix_of(model: Model, values: Mapping[str, Mapping[str, float]]) -> np.ndarray:
    """Parameters as columns, (n_free, n_trajectories)."""
    return np.array([[of_run[name] for of_run in values.values()] for name in model.free]).reshape(-1, len(values))


def explained(
    fit: Fit, data: Measurements, sigma: np.ndarray, x: Sequence[np.ndarray]
) -> tuple[tuple[np.ndarray, ...], dict[str, dict[str, float]]] | None:
    """States of the model that explain the record best, from the start ``x``, and parameters per trajectory.

    None where no such states are found.
    """
    values = parameters_of(fit, data)
    if not any(e.parameter.per_trajectory for e in fit.model.entries.values()):
        state = _solved(fit, fit.model.frozen(), data, sigma, x, steps_on(fit, data))
        return None if state is None else (state.states, values)
    states: list[np.ndarray] = []
    for i, run in enumerate(data.trajectories):  # each with its own parameters
        own = fit.model.with_values(values[run.name])
        local = () if run.name in fit.by_trajectory else _per_trajectory(fit.model)
        model = own.with_fixed({name: value for name, value in own.values.items() if name not in local})
        steps = steps_on(fit, data)[i : i + 1]
        state = _solved(fit, model, data[i], sigma, [x[i]], steps)
        if state is None:
            return None
        values[run.name].update(state.unknown.values_of(state.theta, run.name))
        states += state.states
    return tuple(states), values


def _solved(
    fit: Fit, model: Model, data: Measurements, sigma: np.ndarray, x: Sequence[np.ndarray], steps: Sequence[np.ndarray]
) -> State | None:
    """`on_record` with steps so fine that an accurate run from the first state would not leave the others."""
    state = on_record(model, data, sigma, x, options(fit), steps, fit.outcome.way, is_start=True)
    for _ in range(REFINEMENTS):
        if state is None or FINER * state.nodes.size > MOST_REFINED:
            break
        size = np.sqrt(max(state.solution.outcome.objective, 1.0))  # beside large residuals an error does not show
        if finer_steps(replace(state, sigma=size * state.sigma)) is None:
            break
        steps = [FINER * n for n in steps]
        again = on_record(model, data, sigma, state.states, options(fit), steps, state.way, is_start=True)
        if again is None:
            break
        state = again
    return state


def options(fit: Fit) -> MaximumLikelihood:
    """The loss of the fit, for a record along which its parameters are known."""
    return MaximumLikelihood(huber=fit.huber)


def steps_on(fit: Fit, data: Measurements) -> tuple[np.ndarray, ...]:
    """Intervals in every gap between samples: those of the fit on its own record, else its median everywhere."""
    if [len(n) + 1 for n in fit.steps] == [run.n_samples for run in data.trajectories]:
        return fit.steps
    median = int(np.median(np.concatenate(fit.steps))) if fit.steps else 1
    return tuple(np.full(run.n_samples - 1, median) for run in data.trajectories)


def _per_trajectory(model: Model) -> tuple[str, ...]:
    return tuple(name for name, entry in model.entries.items() if entry.parameter.per_trajectory)


def bands(
    fit: Fit, data: Measurements, sigma: np.ndarray, simulated: Sequence[np.ndarray],
    values: Mapping[str, Mapping[str, float]],
) -> tuple[np.ndarray, ...] | None:  # fmt: skip
    """Standard deviation of what a free run shows, (n_samples, n_states) per trajectory; None where it is not known.

    Both the uncertainty of the parameters, with starting states that follow the record, and that of the starting
    states count, to first order along the run. The noise of a single measurement is not in it.
    """
    known = np.isfinite(np.diag(fit.covariance))
    runs = tuple(run.name for run in data.trajectories)
    unknown = Theta.of(fit.model, runs)
    if not known.any() or sum(x.size for x in simulated) > LONGEST:
        return None
    grid, nodes = grid_of(data), np.concatenate(simulated)
    if not np.all(np.isfinite(nodes)) or not grid.measured.any():
        return None
    theta = np.zeros(len(unknown))
    theta[unknown.table] = matrix_of(fit.model, values)
    point = point_at(fit.model, grid, unknown, theta, nodes)
    program = MaximumLikelihood().program(fit.model, grid, point, {}, sigma, unknown)
    kkt = Solver(program).kkt(program.start, sigma)
    block, x = program.variables["theta"], program.variables["x"]
    information = kkt.hessian * (int(grid.measured.sum()) / 2)
    reduced = Reduced(grid, fit.model.n_states, information, kkt.jacobian, block.slice, x.slice)
    covariance = _covariance(fit, unknown, point.theta_scale, reduced.information)
    starts = grid.first[:, None] * fit.model.n_states + np.arange(fit.model.n_states)
    following, left = reduced.following, reduced.start_covariances(starts, grid.trajectory)
    following, left = following * point.x_scale[:, None], left * np.outer(point.x_scale, point.x_scale)
    if fit.model.sensor:
        by_x = output_slopes(fit.model, grid, nodes, unknown.by_trajectory(theta))[0]
        following = by_x @ following + output_slopes_of(unknown, grid, nodes, theta) * point.theta_scale
        left = by_x @ left @ by_x.transpose(0, 2, 1)
    variance = np.einsum("aij,jk,aik->ai", following, covariance, following) + np.einsum("aii->ai", left)
    deviation = np.sqrt(np.maximum(variance, 0.0))
    return grid.split(deviation)


def _covariance(fit: Fit, unknown: Theta, scale: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Covariance of the scaled parameters: that of the fit; what a trajectory has of its own follows its record."""
    known = np.isfinite(np.diag(fit.covariance))
    fitted = np.where(np.outer(known, known), fit.covariance, 0.0)
    old = [i for i, name in enumerate(unknown.names) if name in fit.names]
    new = [i for i, name in enumerate(unknown.names) if name not in fit.names]
    at = [fit.names.index(unknown.names[i]) for i in old]
    covariance = np.zeros((len(unknown), len(unknown)))
    covariance[np.ix_(old, old)] = fitted[np.ix_(at, at)] / np.outer(scale[old], scale[old])
    if new:
        own = np.linalg.pinv(information[np.ix_(new, new)], hermitian=True)
        follow = -own @ information[np.ix_(new, old)]
        covariance[np.ix_(new, old)] = follow @ covariance[np.ix_(old, old)]
        covariance[np.ix_(old, new)] = covariance[np.ix_(new, old)].T
        covariance[np.ix_(new, new)] = own + follow @ covariance[np.ix_(old, old)] @ follow.T
    return covariance


def shown(model: Model, data: Measurements, states: Sequence[np.ndarray], values: np.ndarray) -> tuple[np.ndarray, ...]:
    """What the sensors show of the states at the samples, per trajectory; ``values`` as from `matrix_of`."""
    if not model.sensor:
        return tuple(states)
    grid: Grid = grid_of(data)
    return grid.split(np.array(outputs(model, grid, np.concatenate(states).T, values)).T)

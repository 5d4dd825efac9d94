"""A fitted model along a record: the states that explain the record best, and how
certain a free run of it is.

The dynamics hold exactly (zero defects) and the shared parameters stay as they are;
starting states, and parameters of a trajectory that the fit has not seen, follow from
the record by maximum likelihood.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.record_likelihood import RecordLikelihood
from phsi_opt.estimation.step_refinement import finer_steps
from phsi_opt.estimation.trajectory_parameters import parameters_of
from phsi_opt.model.model import Model
from phsi_opt.transcription.losses import MaximumLikelihood

REFINEMENTS, FINER = (
    2,
    4,
)  # how often steps along a record are made finer where their error shows, and how much
MOST_REFINED = 50_000  # states beyond which they are not


def explained(
    fit: Fit, data: Measurements, sigma: np.ndarray, x: Sequence[np.ndarray]
) -> tuple[tuple[np.ndarray, ...], dict[str, dict[str, float]]] | None:
    """States of the model that explain the record best, from the start ``x``, and
    parameters per trajectory.

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
        model = own.with_fixed(
            {name: value for name, value in own.values.items() if name not in local}
        )
        steps = steps_on(fit, data)[i : i + 1]
        state = _solved(fit, model, data[i], sigma, [x[i]], steps)
        if state is None:
            return None
        values[run.name].update(state.unknown.values_of(state.theta, run.name))
        states += state.states
    return tuple(states), values


def _solved(
    fit: Fit,
    model: Model,
    data: Measurements,
    sigma: np.ndarray,
    x: Sequence[np.ndarray],
    steps: Sequence[np.ndarray],
) -> LikelihoodEstimate | None:
    """The start of a run, with fine steps.

    So fine that an accurate run from the first state would not leave the others.
    """
    record = RecordLikelihood(data, sigma, options(fit))
    state = record.start_of_run(model, x, steps, fit.outcome.way)
    for _ in range(REFINEMENTS):
        if state is None or FINER * state.nodes.size > MOST_REFINED:
            break
        size = np.sqrt(
            max(state.solution.outcome.objective, 1.0)
        )  # beside large residuals an error does not show
        if finer_steps(replace(state, sigma=size * state.sigma)) is None:
            break
        steps = [FINER * n for n in steps]
        again = record.start_of_run(model, state.states, steps, state.way)
        if again is None:
            break
        state = again
    return state


def options(fit: Fit) -> MaximumLikelihood:
    """The loss of the fit, for a record along which its parameters are known."""
    return MaximumLikelihood(huber=fit.huber)


def steps_on(fit: Fit, data: Measurements) -> tuple[np.ndarray, ...]:
    """Intervals in every gap between samples: those of the fit on its own record, else
    its median everywhere.
    """
    if [len(n) + 1 for n in fit.steps] == [run.n_samples for run in data.trajectories]:
        return fit.steps
    median = int(np.median(np.concatenate(fit.steps))) if fit.steps else 1
    return tuple(np.full(run.n_samples - 1, median) for run in data.trajectories)


def _per_trajectory(model: Model) -> tuple[str, ...]:
    return tuple(
        name for name, entry in model.entries.items() if entry.parameter.per_trajectory
    )

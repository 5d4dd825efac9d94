"""The states with which a fitted model explains a record best.

The dynamics hold exactly (zero defects) and the shared parameters stay as they are;
starting states follow from the record by maximum likelihood, and with them what every
trajectory has of its own, where the fit was not made from that record. A free run
begins at the first of these states.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import (
    LikelihoodProblem,
    NoiseLevels,
    StartingPoint,
)
from phsi_opt.estimation.problem import Task
from phsi_opt.estimation.record import Record
from phsi_opt.estimation.step_refinement import finer_steps
from phsi_opt.model.model import Model
from phsi_opt.optimization.ipopt import SolverSettings
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.grid import AlignedData
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta

# The noise is known and the start is near, so a brief solve is enough.
BRIEF_SOLVE = SolverSettings(max_iterations=60, thorough=False)
STEP_REFINEMENTS = 2  # how often the steps along a record are made finer, at most
FINER = 4  # factor on the steps where their error shows beside the residuals
MOST_REFINED_STATES = 50_000  # values beyond which steps are not made finer


@dataclass(frozen=True, eq=False)
class SmoothedStates:
    """States at the samples, and the parameters that belong to them.

    Attributes:
        states: one (n_samples, n_states) per trajectory.
        parameters: values of the free parameters by trajectory and name.
    """

    states: Sequence[np.ndarray]
    parameters: Mapping[str, Mapping[str, float]]


def smoothed_states(record: Record) -> SmoothedStates:
    """The states of a model along a record, from which free runs begin.

    On the measurements of the fit they are those of the fit. Elsewhere they are found
    by maximum likelihood; where no states obey the model along the whole record, those
    of the missing force are the best to begin from.
    """
    if record.is_of_training:
        return SmoothedStates(record.fit.states, record.parameters)
    nodes = np.concatenate(record.start)
    guess = record.grid.split(
        with_memory(record.model, record.grid, nodes, record.theta)
    )
    found = _most_likely_states(record, _noise_to_weigh_with(record), guess)
    return found or SmoothedStates(guess, record.parameters)


def _noise_to_weigh_with(record: Record) -> np.ndarray:
    """Outliers that the fit set aside must not make up the noise."""
    sigma = record.sigma
    if record.fit.huber is None:
        return sigma
    by_state = zip(record.model.states, sigma, strict=True)
    return np.array([record.fit.noise.get(name, s) for name, s in by_state])


def _most_likely_states(
    record: Record, sigma: np.ndarray, guess: Sequence[np.ndarray]
) -> SmoothedStates | None:
    """States by maximum likelihood, parameters per trajectory; None: not found."""
    fit = record.fit
    aligned = record.aligned
    data = record.data
    steps = steps_on(fit, data)
    own_names = record.estimated_here(fit.model)
    if not own_names and not fit.by_trajectory:
        state = _accurate(fit, fit.model.frozen(), aligned, sigma, guess, steps)
        if state is None:
            return None
        return SmoothedStates(state.states, record.parameters)
    states: list[np.ndarray] = []
    parameters: dict[str, Mapping[str, float]] = {}
    for number, run in enumerate(data.trajectories):
        known = record.parameters[run.name]
        # Free is only what the trajectory has of its own, if unknown.
        others = {name: v for name, v in known.items() if name not in own_names}
        model = fit.model.with_values(known).with_fixed(others)
        state = _accurate(
            fit,
            model,
            AlignedData.of(model, data[number]),
            sigma,
            [guess[number]],
            steps[number : number + 1],
        )
        if state is None:
            return None
        own = state.unknown.values_of(state.theta, run.name)
        parameters[run.name] = {**known, **own}
        states += state.states
    return SmoothedStates(tuple(states), parameters)


def _accurate(
    fit: Fit,
    model: Model,
    aligned: AlignedData,
    sigma: np.ndarray,
    guess: Sequence[np.ndarray],
    steps: Sequence[np.ndarray],
) -> LikelihoodEstimate | None:
    """The most likely states, with steps so fine that an accurate run agrees with them.

    An accurate run from the first state would otherwise leave the others.
    """
    likely = partial(maximum_along, aligned, sigma, likelihood_of(fit), model)
    state = likely(guess, steps)
    for _ in range(STEP_REFINEMENTS):
        if state is None or FINER * state.nodes.size > MOST_REFINED_STATES:
            break
        # Beside large residuals an integration error does not show.
        size = np.sqrt(max(state.solution.outcome.objective, 1.0))
        if finer_steps(replace(state, sigma=size * state.sigma)) is None:
            break
        steps = [FINER * n for n in steps]
        refined = likely(state.states, steps)
        if refined is None:
            break
        state = refined
    return state


def maximum_along(
    aligned: AlignedData,
    sigma: np.ndarray,
    loss: MaximumLikelihood,
    model: Model,
    states: Sequence[np.ndarray],
    steps: Sequence[np.ndarray],
) -> LikelihoodEstimate | None:
    """The likelihood's maximum along a record whose noise is known; None: not found.

    For what is asked of a fit afterwards: no windows, no finer steps, no pruning.

    Args:
        aligned: the record.
        sigma: (n_states,) its noise.
        loss: the likelihood.
        model: with the values to start from; those that are free are estimated.
        states: (n_samples, n_states) per trajectory, at the samples, to start from.
        steps: intervals in every gap between samples, (n_samples - 1,) per trajectory.
    """
    task = Task(model, aligned, l1={}, pruning=None, settings=BRIEF_SOLVE)
    start = StartingPoint(
        model=model,
        theta=Theta.of(model, task.runs).spread(model.theta),
        states=tuple(states),
        sigma=sigma,
        steps=tuple(steps),
    )
    problem = LikelihoodProblem(task, loss, NoiseLevels.known(sigma))
    estimate = problem.solve_from(start)
    return estimate if estimate.is_success else None


def likelihood_of(fit: Fit) -> MaximumLikelihood:
    """The loss of the fit, for a record along which its parameters are known."""
    return MaximumLikelihood(huber=fit.huber)


def steps_on(fit: Fit, data: Measurements) -> tuple[np.ndarray, ...]:
    """Intervals in every gap between samples, one (n_samples - 1,) per trajectory.

    Those of the fit on its own record, else its median everywhere.
    """
    lengths = [run.n_samples for run in data.trajectories]
    if [len(steps) + 1 for steps in fit.steps] == lengths:
        return fit.steps
    median = int(np.median(np.concatenate(fit.steps))) if fit.steps else 1
    return tuple(np.full(n_samples - 1, median) for n_samples in lengths)

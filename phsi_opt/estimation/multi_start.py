"""Several starting points for one likelihood: the first, and random ones around it.

A check on local optima, which the user asks for (``starts``): the fit's warnings say
how many of the points led to the best solution.
"""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from phsi_opt.errors import SolveError
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem
from phsi_opt.estimation.likelihood_start import states_at
from phsi_opt.estimation.problem import Task
from phsi_opt.estimation.starting_point import StartingPoint
from phsi_opt.initialization.scaling import theta_scale
from phsi_opt.transcription.parameter_vector import Theta

SEED = 0  # the same points every time
# Standard deviation of the logarithm of the factor on a value: one value in three is
# more than doubled or halved.
LOG_FACTOR_SPREAD = 0.7
# Standard deviation of what is added to a value of zero, in units of the parameter's
# size.
SHIFT_SPREAD = 0.3
LEAST_STATE_SPREAD = 1e-12  # stands for that of a state that does not move


def random_values(first: StartingPoint, problem: LikelihoodProblem) -> list[np.ndarray]:
    """Values (n_theta,) of the points beside the first, ``starts`` of the loss in all.

    Those of the first times a log-normal factor; values of zero are moved by a share of
    the parameter's size.
    """
    n_further = problem.loss.starts - 1
    if not n_further:
        return []
    size = _parameter_sizes(first, problem.task)
    unknown = Theta.of(first.model, problem.task.runs)
    lower = [entry.parameter.lower for entry in unknown.entries]
    upper = [entry.parameter.upper for entry in unknown.entries]
    rng = np.random.default_rng(SEED)
    found = []
    for _ in range(n_further):
        found.append(np.clip(_moved(first.theta, size, rng), lower, upper))
    return found


def _parameter_sizes(first: StartingPoint, task: Task) -> np.ndarray:
    """(n_theta,) changes that move some equation by the size of its rate."""
    unknown = Theta.of(first.model, task.runs)
    grid = task.grid
    x = np.concatenate(first.states)
    x_spread = np.maximum(np.std(x, axis=0), LEAST_STATE_SPREAD)
    means = unknown.means(first.theta)
    size = theta_scale(first.model, grid, means, x, x_spread)
    return unknown.spread(size)


def _moved(theta: np.ndarray, size: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    for_factor, for_shift = rng.normal(size=(2, len(theta)))
    scaled = theta * np.exp(LOG_FACTOR_SPREAD * for_factor)
    shifted = SHIFT_SPREAD * size * for_shift
    return np.where(theta != 0, scaled, shifted)


def with_values(
    first: StartingPoint, theta: np.ndarray, problem: LikelihoodProblem
) -> StartingPoint:
    """The point at other values theta (n_theta,), with the states that go with them."""
    noise = replace(problem.noise, sigma=first.sigma)
    problem = replace(problem, noise=noise)
    states = first.states
    # Far from the data there may be no states; then those of the first point.
    with suppress(SolveError):
        states = states_at(problem, first.model, theta)
    return replace(first, theta=theta, states=states, is_optimum=False)

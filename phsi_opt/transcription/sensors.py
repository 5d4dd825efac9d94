"""The output of the sensors for given states, and its slopes.

A model without sensors shows its states as they are. With sensors (an offset, a gain, a
clipping) the data are compared with their output. Noise is not part of a sensor.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import with_slopes
from phsi_opt.transcription.defects import at_nodes, with_matrices
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.parameter_vector import Theta


class OutputSlopes(NamedTuple):
    """Slopes of the output of the sensors at every node."""

    in_states: np.ndarray  # (n_nodes, n_states, n_states)
    in_parameters: np.ndarray  # (n_nodes, n_states, n_free)


def outputs(model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """The output of the sensors at the nodes, (n_nodes, n_states) as the states x.

    Parameters theta are (n_free,), or (n_free, n_trajectories).
    """
    return at_nodes(model.output(), grid.driven(model, theta), x, theta)[0].T


def outputs_at_samples(
    model: Model, grid: Grid, states: Sequence[np.ndarray], theta: np.ndarray
) -> tuple[np.ndarray, ...]:
    """The output of the sensors per trajectory, (n_samples, n_states) as the states.

    The grid has one interval between samples; theta is (n_free, n_trajectories).
    """
    if not model.sensor:
        return tuple(states)
    return grid.split(outputs(model, grid, np.concatenate(states), theta))


def output_slopes(
    model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> OutputSlopes:
    """Slopes of `outputs` at every node, for states (n_nodes, n_states)."""
    slopes = model.built(
        "output slopes", lambda: with_slopes(model.output(), "x", "theta")
    )
    found = at_nodes(slopes, grid.driven(model, theta), x, theta)
    return OutputSlopes(*with_matrices(found)[1:])


def output_slopes_in_theta(
    unknown: Theta, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """Slope of `outputs` in each entry of theta, (n_nodes, n_states, n_theta).

    A parameter of one trajectory has no slope at the nodes of the others.
    """
    model = unknown.model
    slopes = np.zeros((grid.n_nodes, model.n_states, len(unknown)))
    if model.sensor:
        of_runs = unknown.by_trajectory(theta)
        in_parameters = output_slopes(model, grid, x, of_runs).in_parameters
        places = unknown.table[:, grid.trajectory].T[:, None, :]
        everywhere = np.broadcast_to(places, in_parameters.shape)
        np.put_along_axis(slopes, everywhere, in_parameters, axis=2)
    return slopes

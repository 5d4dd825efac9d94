"""TODO."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from scipy.sparse import bsr_matrix, identity

from phsi_opt.data.measurements import Measurements
from phsi_opt.model.model import Model
from phsi_opt.transcription.defects import map_intervals
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.parameter_vector import Theta


@dataclass(frozen=True, eq=False)
class SensorOutputs:
    """What the sensors show of the states, (n_nodes, n_states), and its Jacobian."""

    values: np.ndarray
    jacobian: Any

    @classmethod
    def at(
        cls, model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray
    ) -> "SensorOutputs":
        """The sensors of ``model`` at the states x."""
        if not model.sensor:
            return cls(x, identity(x.size, format="csc"))
        return cls(
            np.array(outputs(model, grid, ca.DM(x.T), ca.DM(theta))).T,
            output_jacobian(model, grid, x, theta),
        )


@dataclass(frozen=True, eq=False)
class OutputSlopes:
    """Slopes of what the sensors show at every node.

    Attributes:
        in_states: (n_nodes, n_states, n_states).
        in_parameters: (n_nodes, n_states, n_free).
    """

    in_states: np.ndarray
    in_parameters: np.ndarray


def outputs_at_samples(
    model: Model, data: Measurements, states: Sequence[np.ndarray], values: np.ndarray
) -> tuple[np.ndarray, ...]:
    """What the sensors show of the states at the samples, per trajectory; ``values`` as
    from `parameter_matrix`.
    """
    if not model.sensor:
        return tuple(states)
    grid: Grid = grid_of(data)
    return grid.split(
        np.array(outputs(model, grid, np.concatenate(states).T, values)).T
    )


def outputs(model: Model, grid: Grid, x: Any, theta: Any) -> Any:
    """What the sensors show at the nodes, (n_states, n_nodes)."""
    columns = [x, grid.u.T, grid.t[None, :]]
    return map_intervals(
        model.output(), replace(grid, begin=np.arange(grid.n_nodes)), columns, theta
    )


def output_slopes(model: Model, grid: Grid, x: np.ndarray, theta: Any) -> OutputSlopes:
    """Slopes of `outputs` at every node: in the states, (n_nodes, n_states, n_states),
    and in the parameters.
    """
    one, n = model.output(), model.n_states
    arguments = [ca.SX.sym(one.name_in(i), one.size1_in(i)) for i in range(one.n_in())]
    shown = one(*arguments)
    slopes = [ca.vec(ca.densify(ca.jacobian(shown, arguments[i]).T)) for i in (0, 3)]
    nodes = replace(grid, begin=np.arange(grid.n_nodes))
    columns = [ca.DM(x.T), grid.u.T, grid.t[None, :]]
    made = map_intervals(
        ca.Function("slopes", arguments, slopes), nodes, columns, theta
    )
    by_x, by_theta = (np.array(part).T.reshape(grid.n_nodes, n, -1) for part in made)
    return OutputSlopes(by_x, by_theta)


def output_slopes_in_theta(
    unknown: Theta, grid: Grid, x: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """Slope of `outputs` at every node in each entry of theta, (n_nodes, n_states,
    n_theta).
    """
    model = unknown.model
    slopes = np.zeros((grid.n_nodes, model.n_states, len(unknown)))
    if model.sensor:
        own = output_slopes(model, grid, x, unknown.by_trajectory(theta)).in_parameters
        places = unknown.table[:, grid.trajectory].T[:, None, :]
        np.put_along_axis(slopes, np.broadcast_to(places, own.shape), own, axis=2)
    return slopes


def output_jacobian(model: Model, grid: Grid, x: np.ndarray, theta: np.ndarray) -> Any:
    """Slope of `outputs` in the states: sparse, (n_nodes * n_states) square, a block
    per node.
    """
    blocks = output_slopes(model, grid, x, theta).in_states
    return bsr_matrix(
        (blocks, np.arange(grid.n_nodes), np.arange(grid.n_nodes + 1))
    ).tocsc()

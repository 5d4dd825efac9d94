"""Blocks that the programs of the losses are made of: variables, residuals, slacks.

Each function adds one named block to an `Assembly`. Which blocks a program has, and
what its objective means, is the business of the losses.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from phsi_opt.model.model import Model
from phsi_opt.optimization.program_builder import Assembly
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.point import Point
from phsi_opt.transcription.sensors import outputs

# Slacks of outliers begin here, in standard deviations: inside their bound at zero.
OUTLIER_START = 0.1


@dataclass(frozen=True, eq=False)
class ThetaVariable:
    """The parameters as variables of a program.

    Attributes:
        unknown: names and places of the parameters.
        point: where they begin, and their sizes.
        values: (n_theta,) symbols of their values.
    """

    unknown: Theta
    point: Point
    values: ca.MX

    @classmethod
    def added_to(cls, build: Assembly, unknown: Theta, point: Point) -> "ThetaVariable":
        """Add the block "theta", with the bounds of the parameters."""
        values = build.variable(
            "theta",
            point.theta,
            unknown.lower,
            unknown.upper,
            point.theta_scale,
            lambda i: unknown.names[i],
        )
        return cls(unknown, point, values)

    @property
    def by_trajectory(self) -> Any:
        """The model's parameters, (n_free,) or (n_free, n_trajectories)."""
        return self.unknown.by_trajectory(self.values)

    def add_l1(self, build: Assembly, l1: Mapping[str, float], factor: float) -> None:
        """Add ``factor * sum_j lambda_j |xi_j|`` over the coefficients of terms.

        ``l1`` holds a weight lambda per slot; a slot that it does not name has none.
        """
        weights = self.unknown.weights(l1)
        places = np.flatnonzero(weights > 0).tolist()
        if not places:
            return
        build.l1(
            "theta",
            self.values[places],
            factor * weights[places],
            self.point.theta[places],
            self.point.theta_scale[places],
        )


def state_variable(build: Assembly, grid: Grid, point: Point) -> ca.MX:
    """Add the block "x", the states at the nodes; (n_states, n_nodes) symbols."""
    n_states = point.x.shape[1]
    lower: float | np.ndarray = -np.inf
    upper: float | np.ndarray = np.inf
    if point.x_bounds is not None:
        lower = point.x_bounds.lower.ravel()
        upper = point.x_bounds.upper.ravel()
    scale = np.tile(point.x_scale, grid.n_nodes)
    label = grid.node_label(n_states)
    x = build.variable("x", point.x.ravel(), lower, upper, scale, label)
    return ca.reshape(x, n_states, -1)


def measurement_residual(
    model: Model, grid: Grid, x: ca.MX, theta: Any, sigma: ca.MX
) -> ca.MX:
    """(y - what the sensors show)/sigma at every measured value, as a column.

    Args:
        model: the model with its sensors.
        grid: nodes and measurements.
        x: (n_states, n_nodes) symbols of the states.
        theta: (n_free,) parameters, or (n_free, n_trajectories).
        sigma: (n_states,) noise of each channel.
    """
    shown = outputs(model, grid, x, theta) if model.sensor else x
    # Row by row (n_nodes, n_states) is CasADi's order column by column.
    measured = np.flatnonzero(grid.measured.ravel()).tolist()
    channel = grid.channel.tolist()
    y = ca.DM(grid.y.ravel()[measured])
    return (y - ca.vec(shown)[measured]) / ca.vec(sigma[channel])


def outlier_slack(build: Assembly, n_measured: int, limit: float) -> ca.MX:
    """Add slacks that take over what of a residual is beyond the limit.

    At a linear cost, so that both together are Huber's function. Returns what they
    take, (n_measured,).

    Source: P. J. Huber, Robust estimation of a location parameter, 1964.
    """
    start = np.full(n_measured, OUTLIER_START)
    above = build.variable("outlier_above", start, lower=0.0)
    below = build.variable("outlier_below", start, lower=0.0)
    build.cost(2 * limit / n_measured * (ca.sum1(above) + ca.sum1(below)))
    return above - below

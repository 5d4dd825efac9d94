"""An estimate's likelihood linearised at its solution: slopes of dynamics and sensors.

::

    shown residual   r - C x - C_theta theta
    dynamics         J x + J_theta theta = B w

for changes x of the states, theta of the parameters, and forces w that the model does
not know. States and parameters are in the scale of the program that was solved, forces
in the unit of a rate of their state.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csc_matrix

from phsi_opt.model_error.state_functions import smooth_functions
from phsi_opt.transcription.grid import Grid


@dataclass(frozen=True, eq=False)
class Linearization:
    """A likelihood linearised at a solution.

    Attributes:
        grid: nodes and intervals.
        nodes: (n_nodes, n_states) states of the solution.
        dynamics_in_states: J, sparse, (n_intervals * n_states, n_nodes * n_states).
        dynamics_in_theta: J_theta, (n_intervals * n_states, n_theta).
        shown_in_states: C, sparse, (n_values, n_nodes * n_states).
        shown_in_theta: C_theta, (n_values, n_theta).
        residual: r, measured minus shown, (n_values,).
        node: (n_values,) node of every measured value.
        channel: (n_values,) its state.
        x_scale: (n_states,) scale of the states.
        theta_scale: (n_theta,) scale of the parameters.
        forced: equations that can lack a force.
        observed: numbers of states that functions may depend on: not the memories.
    """

    grid: Grid
    nodes: np.ndarray
    dynamics_in_states: Any
    dynamics_in_theta: np.ndarray
    shown_in_states: Any
    shown_in_theta: np.ndarray
    residual: np.ndarray
    node: np.ndarray
    channel: np.ndarray
    x_scale: np.ndarray
    theta_scale: np.ndarray
    forced: tuple[int, ...]
    observed: tuple[int, ...]

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.x_scale)

    @property
    def n_theta(self) -> int:
        """Number of parameters."""
        return len(self.theta_scale)

    @property
    def n_values(self) -> int:
        """Number of measured values."""
        return len(self.residual)

    @property
    def n_trajectories(self) -> int:
        """Number of trajectories."""
        return int(self.grid.trajectory[-1]) + 1

    @cached_property
    def middles(self) -> np.ndarray:
        """Times of the middles of the intervals, (n_intervals,)."""
        grid = self.grid
        middles: np.ndarray = grid.t[grid.begin] + grid.h / 2
        return middles

    @cached_property
    def runs(self) -> np.ndarray:
        """Number of the trajectory of each interval, (n_intervals,)."""
        return self.grid.trajectory[self.grid.begin]

    def places_of_force(self, equation: int) -> np.ndarray:
        """Where the dynamics of an equation stand among all, (n_intervals,)."""
        numbers = np.arange(self.grid.n_intervals)
        places: np.ndarray = numbers * self.n_states + equation
        return places

    def effect_of_force(self, equation: int) -> np.ndarray:
        """B: what a force of one does to the scaled dynamics, (n_intervals,)."""
        effect: np.ndarray = self.grid.h / self.x_scale[equation]
        return effect

    def values_of(self, channel: int) -> np.ndarray:
        """Places of the measured values of one state."""
        return np.flatnonzero(self.channel == channel)

    @cached_property
    def function_values(self) -> dict[int, np.ndarray]:
        """Values of the smooth functions of every state, (n_intervals, n_functions)."""
        begin = self.grid.begin
        middles = (self.nodes[begin] + self.nodes[begin + 1]) / 2
        return {state: smooth_functions(middles[:, state]) for state in self.observed}

    def dynamics_of_function(self, equation: int, state: int) -> np.ndarray:
        """What functions of a state do to the dynamics, as J_theta does."""
        values = self.function_values[state]
        columns = np.zeros((self.dynamics_in_states.shape[0], values.shape[1]))
        effect = self.effect_of_force(equation)
        columns[self.places_of_force(equation)] = -values * effect[:, None]
        return columns


def as_sparse(matrix: Any) -> csc_matrix:
    """A matrix in SciPy's column format."""
    return csc_matrix(matrix)

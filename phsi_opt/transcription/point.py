"""Where a solver begins: parameters, states and the size of each.

The sizes scale the variables and constraints of a program, so that the solver sees
numbers near one whatever the units are. How they are found from the data is the
business of ``phsi_opt.initialization``.
"""

from dataclasses import dataclass, field

import numpy as np

UNBOUNDED = np.array([-np.inf, np.inf])[:, None, None]


@dataclass(frozen=True, eq=False)
class Point:
    """A point to start from, with the size of each quantity.

    Attributes:
        theta: (n_theta,) parameters, in the order of `Theta`.
        x: (n_nodes, n_states) states at the nodes.
        theta_scale: (n_theta,) size of each parameter.
        x_scale: (n_states,) size of each state.
        x_bounds: lower and upper bounds of ``x``, (2, n_nodes, n_states).
    """

    theta: np.ndarray
    x: np.ndarray
    theta_scale: np.ndarray
    x_scale: np.ndarray
    x_bounds: np.ndarray = field(default_factory=lambda: UNBOUNDED)

    @property
    def scale(self) -> np.ndarray:
        """Sizes of parameters and states in z, the variables of a program, (n,)."""
        return np.concatenate([self.theta_scale, np.tile(self.x_scale, len(self.x))])

    @property
    def scaled(self) -> np.ndarray:
        """Parameters and states over their sizes, (n,), where z begins."""
        return np.concatenate([self.theta, self.x.ravel()]) / self.scale

    def unscaled(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Values of parameters and states, by block, from z (n,)."""
        values = z * self.scale
        return {"theta": values[self.of_theta], "x": values[self.of_x]}

    @property
    def of_theta(self) -> slice:
        """Where the parameters stand in z, which begins with them."""
        return slice(0, self.theta.size)

    @property
    def of_x(self) -> slice:
        """Where the states stand in z."""
        return slice(self.theta.size, self.theta.size + self.x.size)

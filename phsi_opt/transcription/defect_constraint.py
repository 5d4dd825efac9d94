"""The defects as constraints of a program, with their derivatives.

A constraint is the defect times the interval's length over the state's size: an error
of the state in units of its size, comparable between equations and between lengths.
Jacobian and curvature are put together from small blocks per interval, which costs a
small part of an automatic differentiation of the whole.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy.sparse import csc_matrix

from phsi_opt.model.model import Model
from phsi_opt.transcription.defect_derivatives import (
    interval_curvatures,
    interval_slopes,
)
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.point import Point


@dataclass(frozen=True, eq=False)
class _Unknowns:
    """Values of the unknowns: parameters (by trajectory) and states."""

    theta: Any
    x: Any


@dataclass(frozen=True, eq=False)
class DefectConstraint:
    """Scaled defects of all intervals, as a function of a program's variables z.

    The scaled variables z begin with theta (where it is unknown) and the states.

    Attributes:
        model: the model.
        grid: nodes and intervals.
        scheme: name of the integrator.
        point: values and sizes of the unknowns.
        unknown: the parameters in z; None: they stay at ``point.theta``.
    """

    model: Model
    grid: Grid
    scheme: str
    point: Point
    unknown: Theta | None

    @property
    def n_theta(self) -> int:
        """Number of parameters in z."""
        return 0 if self.unknown is None else len(self.unknown)

    @property
    def factor(self) -> np.ndarray:
        """Length over the state's size of each defect, (n_states, n_intervals)."""
        return self.grid.h[None, :] / self.point.x_scale[:, None]

    def scaled(self, d: ca.MX) -> ca.MX:
        """The constraints from defects (n_states, n_intervals)."""
        return d * ca.DM(self.factor)

    def jacobian(self, z: ca.MX) -> ca.MX:
        """Sparse Jacobian of the constraints in z."""
        n_states = self.model.n_states
        at = self._unknowns(z)
        slopes = interval_slopes(
            self.model, self.grid, self.scheme, at.x, at.theta, self.n_theta > 0
        )
        equation, local_unknown = slopes.places.T
        first_row = n_states * np.arange(self.grid.n_intervals)[:, None]
        row = first_row + equation
        column = self._places()[:, local_unknown]
        length_per_size = self.grid.h[:, None] / self.point.x_scale[equation]
        factor = length_per_size * self._scale[column]
        order = np.lexsort((row.ravel(), column.ravel()))  # as CasADi stores them
        pattern = ca.Sparsity.triplet(
            n_states * self.grid.n_intervals,
            z.numel(),
            row.ravel()[order].tolist(),
            column.ravel()[order].tolist(),
        )
        values = ca.vec(slopes.values)[order.tolist()]
        return ca.MX(pattern, values * ca.DM(factor.ravel()[order]))

    def curvature(self, z: ca.MX, multipliers: ca.MX) -> ca.MX:
        """What the constraints add to the Hessian of the Lagrangian, upper triangle.

        Second derivatives per interval, summed where intervals share an unknown. The
        multipliers of the defects are the first ones.
        """
        n_z = z.numel()
        n_states = self.model.n_states
        n_intervals = self.grid.n_intervals
        at = self._unknowns(z)
        of_defects = multipliers[: n_states * n_intervals]
        weighted = self.scaled(ca.reshape(of_defects, n_states, n_intervals))
        found = interval_curvatures(
            self.model, self.grid, self.scheme, at.x, at.theta, weighted
        )
        places = self._places()
        one = places[:, found.places[:, 0]].ravel()
        other = places[:, found.places[:, 1]].ravel()
        row = np.minimum(one, other)
        column = np.maximum(one, other)
        # Each entry of the Hessian once, in CasADi's order, and the entries per
        # interval that it sums up.
        entry, where = np.unique(column * n_z + row, return_inverse=True)
        factor = self._scale[row] * self._scale[column]
        summands = np.arange(len(row))
        shape = (len(entry), len(row))
        gather = csc_matrix((factor, (where, summands)), shape=shape)
        pattern = ca.Sparsity.triplet(
            n_z, n_z, (entry % n_z).tolist(), (entry // n_z).tolist()
        )
        return ca.MX(pattern, ca.mtimes(ca.DM(gather), ca.vec(found.values)))

    @property
    def _scale(self) -> np.ndarray:
        """Sizes of the unknowns in z that the defects depend on."""
        of_theta = self.point.theta_scale if self.n_theta else np.zeros(0)
        return np.r_[of_theta, np.tile(self.point.x_scale, self.grid.n_nodes)]

    def _unknowns(self, z: ca.MX) -> _Unknowns:
        scale = self._scale
        values = z[: len(scale)] * ca.DM(scale)
        x = ca.reshape(values[self.n_theta :], self.model.n_states, -1)
        if self.unknown is None:
            return _Unknowns(ca.DM(self.point.theta), x)
        theta = self.unknown.by_trajectory(values[: self.n_theta])
        return _Unknowns(theta, x)

    def _places(self) -> np.ndarray:
        """Places in z of x0, x1 and the parameters of every interval.

        (n_intervals, 2 n_states + n_free), without parameters where they are known.
        """
        n_states = self.model.n_states
        first_state = self.n_theta + n_states * self.grid.begin[:, None]
        states = first_state + np.arange(2 * n_states)
        if self.unknown is None:
            return states
        trajectory = self.grid.trajectory[self.grid.begin]
        return np.hstack([states, self.unknown.table.T[trajectory]])

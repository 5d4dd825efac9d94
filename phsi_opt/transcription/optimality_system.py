"""The optimality conditions of a likelihood, filled with numbers again and again.

The pattern of Hessian and Jacobian is that of the program and stays; where each entry
stands in the band, or in the border of the parameters, is worked out once. What is done
with a step is the business of the callers.
"""

from dataclasses import dataclass

import numpy as np

from phsi_opt.optimization.banded import Banded, BandLayout
from phsi_opt.statistics import TINY
from phsi_opt.transcription.elimination import REGULAR, time_order
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.pattern import Pattern

# Share of the largest curvature of (scaled) parameters below which a direction is as
# good as rounding: it is the difference of numbers as large as the largest.
SILENT = 1e-10


@dataclass(frozen=True, eq=False)
class NewtonStep:
    """A step of the variables, and the multipliers behind it.

    Attributes:
        z: (n_variables,) change of the scaled variables.
        multipliers: (n_constraints,).
    """

    z: np.ndarray
    multipliers: np.ndarray


@dataclass(frozen=True, eq=False)
class _Eliminated:
    """A system whose states and multipliers are solved for.

    Attributes:
        factors: of states and multipliers, parameters held.
        coupling: (n_x + n_constraints, n_theta) how the parameters act on both.
        per_theta: in the same shape, how both answer.
        curvature: (n_told,) that is left for the parameters, along directions.
        directions: (n_theta, n_told), those that the data tell.
    """

    factors: Banded
    coupling: np.ndarray
    per_theta: np.ndarray
    curvature: np.ndarray
    directions: np.ndarray


class OptimalitySystem:
    """Steps of ``min objective subject to g = 0`` in z = (theta, x).

    Args:
        grid: nodes and intervals.
        n_states: number of states at a node.
        hessian: pattern of its upper triangle.
        jacobian: pattern of the slopes of g.
    """

    _last: _Eliminated  # of the last full step

    def __init__(
        self, grid: Grid, n_states: int, hessian: Pattern, jacobian: Pattern
    ) -> None:
        self._n_x = grid.n_nodes * n_states
        self.n_theta = hessian.shape[0] - self._n_x
        self._hessian = hessian
        self._jacobian = jacobian
        is_state = hessian.rows >= self.n_theta
        of_x = jacobian.columns >= self.n_theta
        self._in_x = np.flatnonzero(is_state)
        self._of_x = np.flatnonzero(of_x)
        self._of_theta = np.flatnonzero(~of_x)
        self._own = np.flatnonzero(hessian.columns < self.n_theta)
        self._mixed = np.flatnonzero(~is_state & (hessian.columns >= self.n_theta))
        order = time_order(grid, ("node", n_states), ("interval", n_states))
        rows, columns = self._band_places()
        self._layout = BandLayout(rows, columns, order, is_symmetric=True)

    def _band_places(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of what `_band_entries` lists."""
        row = self._hessian.rows[self._in_x] - self.n_theta
        column = self._hessian.columns[self._in_x] - self.n_theta
        self._above = self._in_x[row < column]
        self._diagonal = self._in_x[row == column]
        is_above = row < column
        defect = self._jacobian.rows[self._of_x] + self._n_x
        state = self._jacobian.columns[self._of_x] - self.n_theta
        every_state = np.arange(self._n_x)
        rows = [row, column[is_above], every_state, defect, state]
        columns = [column, row[is_above], every_state, state, defect]
        return np.concatenate(rows), np.concatenate(columns)

    def _band_entries(self, hessian: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
        slopes = jacobian[self._of_x]
        largest = np.max(hessian[self._diagonal], initial=TINY)
        shift = np.full(self._n_x, REGULAR * largest)
        of_states = [hessian[self._in_x], hessian[self._above], shift]
        return np.concatenate([*of_states, slopes, slopes])

    def step(
        self,
        hessian: np.ndarray,
        jacobian: np.ndarray,
        gradient: np.ndarray,
        g: np.ndarray,
    ) -> NewtonStep:
        """The full step from a point, from entries in the order of the patterns.

        Args:
            hessian: entries of its upper triangle, (n_entries,).
            jacobian: entries of the slopes of g, (n_entries,).
            gradient: of the objective, (n_variables,).
            g: (n_constraints,) values of the constraints.

        Raises:
            SolveError: the states do not follow from the parameters and the data.
            np.linalg.LinAlgError: an entry is no number.
        """
        n_theta = self.n_theta
        factors = Banded.of(self._layout, self._band_entries(hessian, jacobian))
        right = self._right(hessian, jacobian)
        right[: self._n_x, n_theta] = -gradient[n_theta:]
        right[self._n_x :, n_theta] = -g
        coupling = right[:, :n_theta]
        solved = factors.solve(right)
        per_theta = solved[:, :n_theta]
        left = self._theta_block(hessian) - coupling.T @ per_theta
        self._last = _Eliminated(factors, coupling, per_theta, *_told(left))
        return self._joined(solved[:, n_theta], gradient)

    def step_again(
        self, gradient: np.ndarray, g: np.ndarray, multipliers: np.ndarray
    ) -> NewtonStep:
        """A step from another point by curvature and slopes of the last `step`.

        It costs one solve, and is worth it where these have hardly changed.

        Args:
            gradient: of the Lagrangian there, (n_variables,).
            g: (n_constraints,) values of the constraints there.
            multipliers: (n_constraints,) of that Lagrangian.
        """
        right = np.concatenate([-gradient[self.n_theta :], -g])
        step = self._joined(self._last.factors.solve(right), gradient)
        return NewtonStep(step.z, multipliers + step.multipliers)

    def _joined(self, alone: np.ndarray, gradient: np.ndarray) -> NewtonStep:
        """The step of all unknowns, from that of the others while parameters stay."""
        last = self._last
        right = -gradient[: self.n_theta] - last.coupling.T @ alone
        theta = last.directions @ ((last.directions.T @ right) / last.curvature)
        others = alone - last.per_theta @ theta
        z = np.concatenate([theta, others[: self._n_x]])
        return NewtonStep(z, others[self._n_x :])

    def _theta_block(self, hessian: np.ndarray) -> np.ndarray:
        """Hessian of the parameters, dense."""
        block = np.zeros((self.n_theta, self.n_theta))
        if len(self._own):
            rows = self._hessian.rows[self._own]
            columns = self._hessian.columns[self._own]
            np.add.at(block, (rows, columns), hessian[self._own])
        return np.triu(block) + np.triu(block, 1).T

    def _right(self, hessian: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
        """What couples the parameters with the others, and an empty column, dense.

        Column after column in memory, as it is solved for.
        """
        n = self._n_x + self._jacobian.shape[0]
        right = np.zeros((n, self.n_theta + 1), order="F")
        if len(self._mixed):
            states = self._hessian.columns[self._mixed] - self.n_theta
            parameters = self._hessian.rows[self._mixed]
            np.add.at(right, (states, parameters), hessian[self._mixed])
        defects = self._n_x + self._jacobian.rows[self._of_theta]
        parameters = self._jacobian.columns[self._of_theta]
        right[defects, parameters] = jacobian[self._of_theta]
        return right

    def curvature(self, hessian: np.ndarray, z: np.ndarray) -> float:
        """z'Hz of a step z (n_variables,), from entries of the upper triangle."""
        at = self._hessian
        products = hessian * z[at.rows] * z[at.columns]
        twice = at.rows != at.columns
        return float(np.sum(products) + np.sum(products[twice]))

    def lagrangian_gradient(
        self, gradient: np.ndarray, jacobian: np.ndarray, multipliers: np.ndarray
    ) -> np.ndarray:
        """Gradient of the objective and the weighted constraints, (n_variables,).

        Args:
            gradient: of the objective, (n_variables,).
            jacobian: entries of the slopes of g, (n_entries,).
            multipliers: (n_constraints,).
        """
        at = self._jacobian
        weights = jacobian * multipliers[at.rows]
        of_constraints = np.bincount(at.columns, weights, minlength=len(gradient))
        return gradient + of_constraints


def _told(curvature: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Curvature of the parameters along directions that the data tell, and these.

    In the others a step would be as large as rounding makes it.

    Returns:
        (n_told,), and (n_theta, n_told).
    """
    if not len(curvature):
        return np.zeros(0), np.zeros((0, 0))
    values, vectors = np.linalg.eigh((curvature + curvature.T) / 2)
    is_told = values > SILENT * values[-1]
    return values[is_told], vectors[:, is_told]

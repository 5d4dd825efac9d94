"""The optimality conditions of a likelihood, filled with numbers again and again.

The pattern of Hessian and Jacobian is that of the program and stays; where each entry
stands in the band, or in the border of the parameters, is worked out once. What is done
with a step is the business of the callers.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from phsi_opt.optimization.along_time import TimeLayout
from phsi_opt.optimization.banded import Banded
from phsi_opt.optimization.chained import Chained
from phsi_opt.statistics import TINY
from phsi_opt.transcription.elimination import REGULAR, chain_of, time_order
from phsi_opt.transcription.grid import Grid

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


class OptimalitySystem:
    """Steps of ``min objective subject to g = 0`` in z = (theta, x).

    Args:
        grid: nodes and intervals.
        n_states: number of states at a node.
        hessian: pattern of its upper triangle.
        jacobian: pattern of the slopes of g.
    """

    def __init__(
        self, grid: Grid, n_states: int, hessian: ca.Sparsity, jacobian: ca.Sparsity
    ) -> None:
        self._n_x = grid.n_nodes * n_states
        self.n_theta = hessian.size1() - self._n_x
        self._hessian = _Places.of(hessian)
        self._jacobian = _Places.of(jacobian)
        self._in_x = self._hessian.rows >= self.n_theta
        self._of_x = self._jacobian.columns >= self.n_theta
        order = time_order(grid, ("node", n_states), ("interval", n_states))
        rows, columns = self._entry_places()
        self._layout = TimeLayout(rows, columns, order, chain_of(grid, n_states))

    def _entry_places(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of what `_entries` lists."""
        row = self._hessian.rows[self._in_x] - self.n_theta
        column = self._hessian.columns[self._in_x] - self.n_theta
        is_above = row < column
        defect = self._jacobian.rows[self._of_x] + self._n_x
        state = self._jacobian.columns[self._of_x] - self.n_theta
        every_state = np.arange(self._n_x)
        rows = [row, column[is_above], every_state, defect, state]
        columns = [column, row[is_above], every_state, state, defect]
        self._is_above = is_above
        self._is_diagonal = row == column
        return np.concatenate(rows), np.concatenate(columns)

    def _entries(self, hessian: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
        of_states = hessian[self._in_x]
        slopes = jacobian[self._of_x]
        largest = np.max(of_states[self._is_diagonal], initial=TINY)
        shift = np.full(self._n_x, REGULAR * largest)
        above = of_states[self._is_above]
        return np.concatenate([of_states, above, shift, slopes, slopes])

    def factored(self, hessian: np.ndarray, jacobian: np.ndarray) -> "Factored":
        """The system, from entries in the order of the patterns.

        Args:
            hessian: entries of its upper triangle, (n_entries,).
            jacobian: entries of the slopes of g, (n_entries,).

        Raises:
            SolveError: the states do not follow from the parameters and the data.
            np.linalg.LinAlgError: an entry is no number.
        """
        factors = self._layout.factors(self._entries(hessian, jacobian))
        of_theta, coupling = self._border(hessian, jacobian)
        return Factored(factors, of_theta, coupling)

    def _border(
        self, hessian: np.ndarray, jacobian: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Hessian of the parameters, and what couples them with the others, dense."""
        n_theta = self.n_theta
        at = self._hessian
        of_theta = np.zeros((n_theta, n_theta))
        is_own = at.columns < n_theta
        of_theta[at.rows[is_own], at.columns[is_own]] = hessian[is_own]
        of_theta = np.triu(of_theta) + np.triu(of_theta, 1).T
        coupling = np.zeros((self._n_x + self._jacobian.n_rows, n_theta))
        is_mixed = ~is_own & ~self._in_x
        states = at.columns[is_mixed] - n_theta
        coupling[states, at.rows[is_mixed]] = hessian[is_mixed]
        defects = self._n_x + self._jacobian.rows[~self._of_x]
        parameters = self._jacobian.columns[~self._of_x]
        coupling[defects, parameters] = jacobian[~self._of_x]
        return of_theta, coupling

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


class Factored:
    """The system of one point, ready for right-hand sides.

    Args:
        factors: of the states and multipliers.
        of_theta: (n_theta, n_theta) Hessian of the parameters.
        coupling: (n_others, n_theta) of the parameters with all others.
    """

    def __init__(
        self, factors: Banded | Chained, of_theta: np.ndarray, coupling: np.ndarray
    ) -> None:
        self._factors = factors
        self._of_theta = of_theta
        self._coupling = coupling
        self._per_theta: np.ndarray | None = None

    @property
    def is_dear(self) -> bool:
        """Whether it cost many times what a step with it costs."""
        return isinstance(self._factors, Chained)

    def step(self, gradient: np.ndarray, g: np.ndarray) -> NewtonStep:
        """The full step.

        Args:
            gradient: (n_variables,) of the objective; or of the Lagrangian, and
                multipliers are changes likewise.
            g: (n_constraints,) values of the constraints.
        """
        coupling = self._coupling
        n_theta = coupling.shape[1]
        n_x = len(gradient) - n_theta
        right = np.concatenate([-gradient[n_theta:], -g])
        if self._per_theta is None:
            solved = self._factors.solve(np.column_stack([coupling, right]))
            self._per_theta = solved[:, :n_theta]
            alone = solved[:, n_theta]
        else:
            alone = self._factors.solve(right)
        left = self._of_theta - coupling.T @ self._per_theta
        theta = _solved(left, -gradient[:n_theta] - coupling.T @ alone)
        others = alone - self._per_theta @ theta
        z = np.concatenate([theta, others[:n_x]])
        return NewtonStep(z, others[n_x:])


def _solved(curvature: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Step of the parameters; none in directions on which the data are silent.

    There it would be as large as rounding makes it.
    """
    if not len(right):
        return right
    values, vectors = np.linalg.eigh((curvature + curvature.T) / 2)
    is_told = values > SILENT * values[-1]
    told = vectors[:, is_told]
    return told @ ((told.T @ right) / values[is_told])


@dataclass(frozen=True, eq=False)
class _Places:
    """Rows and columns of the entries of a pattern, in CasADi's order."""

    rows: np.ndarray
    columns: np.ndarray
    n_rows: int

    @classmethod
    def of(cls, pattern: ca.Sparsity) -> "_Places":
        rows, columns = pattern.get_triplet()
        return cls(np.array(rows, int), np.array(columns, int), pattern.size1())

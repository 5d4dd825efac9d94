"""The optimality conditions of a likelihood, filled with numbers again and again.

The pattern of Hessian and Jacobian is that of the program and stays; where each entry
stands in the band, or in the border of the parameters, is worked out once. What is done
with a step is the business of the callers.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import triu

from phsi_opt.optimization.along_time import TimeLayout
from phsi_opt.optimization.banded import Banded, BandLayout
from phsi_opt.optimization.bounded_step import SILENT, Room, bounded_step
from phsi_opt.optimization.chained import Chained
from phsi_opt.statistics import TINY
from phsi_opt.transcription.elimination import (
    REGULAR,
    ReducedSystem,
    chain_of,
    time_order,
)
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.pattern import Pattern


@dataclass(frozen=True, eq=False)
class NewtonStep:
    """A step of the variables, and the multipliers behind it.

    Attributes:
        z: (n_variables,) change of the scaled variables.
        multipliers: (n_constraints,).
        is_silent: whether the data say nothing about a direction of the parameters.
    """

    z: np.ndarray
    multipliers: np.ndarray
    is_silent: bool


class OptimalitySystem:
    """Steps of ``min objective subject to g = 0`` in z = (theta, x).

    Args:
        grid: nodes and intervals.
        n_states: number of states at a node.
        hessian: pattern of its upper triangle.
        jacobian: pattern of the slopes of g.
    """

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
        self._order = order
        self._places = self._entry_places()
        self._layout = TimeLayout(*self._places, order, chain_of(grid, n_states))

    @cached_property
    def _soft_layout(self) -> BandLayout:
        """The same with a diagonal of the multipliers."""
        every_multiplier = self._n_x + np.arange(self._jacobian.shape[0])
        rows, columns = self._places
        rows = np.concatenate([rows, every_multiplier])
        columns = np.concatenate([columns, every_multiplier])
        return BandLayout(rows, columns, self._order, is_symmetric=True)

    def _entry_places(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of what `_entries` lists."""
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

    def _entries(self, hessian: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
        slopes = jacobian[self._of_x]
        largest = np.max(hessian[self._diagonal], initial=TINY)
        shift = np.full(self._n_x, REGULAR * largest)
        of_states = [hessian[self._in_x], hessian[self._above], shift]
        return np.concatenate([*of_states, slopes, slopes])

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
        of_theta = self._theta_block(hessian)
        return Factored(factors, of_theta, self._right(hessian, jacobian))

    def softened(
        self, hessian: np.ndarray, jacobian: np.ndarray, softness: np.ndarray
    ) -> "Factored":
        """The system of ``min objective + 1/2 sum(g^2 / softness)``.

        Args:
            hessian: entries of its upper triangle, (n_entries,).
            jacobian: entries of the slopes of g, (n_entries,).
            softness: (n_constraints,), above zero.

        Raises:
            SolveError: the states do not follow from the parameters and the data.
            np.linalg.LinAlgError: an entry is no number.
        """
        entries = np.concatenate([self._entries(hessian, jacobian), -softness])
        factors = Banded.of(self._soft_layout, entries)
        of_theta = self._theta_block(hessian)
        return Factored(factors, of_theta, self._right(hessian, jacobian))

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

    def times(self, hessian: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Hz of a step z (n_variables,), from entries of the upper triangle."""
        at = self._hessian
        n = len(z)
        below = hessian * (at.rows != at.columns) * z[at.rows]
        product = np.bincount(at.rows, hessian * z[at.columns], minlength=n)
        return product + np.bincount(at.columns, below, minlength=n)

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
        right: (n_others, n_theta + 1) what couples the parameters with all others, and
            a column for what they pull by themselves.
    """

    def __init__(
        self, factors: Banded | Chained, of_theta: np.ndarray, right: np.ndarray
    ) -> None:
        self._factors = factors
        self._of_theta = of_theta
        self._right = right
        self._per_theta: np.ndarray | None = None

    @property
    def is_dear(self) -> bool:
        """Whether it cost many times what a step with it costs."""
        return isinstance(self._factors, Chained)

    @property
    def coupling(self) -> np.ndarray:
        """What couples the parameters with all others, (n_others, n_theta)."""
        return self._right[:, :-1]

    def reduced(self, grid: Grid, n_states: int) -> ReducedSystem:
        """The same with the states eliminated, for other questions than the step."""
        return ReducedSystem(
            grid,
            n_states,
            self._factors,
            self.coupling,
            self._of_theta,
            self._per_theta,
        )

    def step(
        self,
        gradient: np.ndarray,
        g: np.ndarray,
        room: Room,
        silent_share: float = SILENT,
        damping: float = 0.0,
    ) -> NewtonStep:
        """The full step.

        Args:
            gradient: (n_variables,) of the objective; or of the Lagrangian, and
                multipliers are changes likewise.
            g: (n_constraints,) values of the constraints.
            room: how far the parameters may move.
            silent_share: of the largest curvature of the parameters, up to which they
                do not move.
            damping: share of each parameter's curvature that is added to it.
        """
        right = self._right
        coupling = self.coupling
        n_theta = coupling.shape[1]
        n_x = len(gradient) - n_theta
        right[:n_x, n_theta] = -gradient[n_theta:]
        right[n_x:, n_theta] = -g
        if self._per_theta is None:
            solved = self._factors.solve(right)
            self._per_theta = solved[:, :n_theta]
            alone = solved[:, n_theta]
        else:
            alone = self._factors.solve(right[:, n_theta])
        left = self._of_theta - coupling.T @ self._per_theta
        left = left + damping * np.diag(np.abs(np.diag(left)))
        pull = -gradient[:n_theta] - coupling.T @ alone
        best = bounded_step(left, pull, room, silent_share)
        others = alone - self._per_theta @ best.d
        z = np.concatenate([best.d, others[:n_x]])
        return NewtonStep(z, others[n_x:], best.is_silent)


def eliminated(
    grid: Grid, n_states: int, hessian: Any, jacobian: Any, n_theta: int
) -> ReducedSystem:
    """A system given as sparse matrices, its states eliminated.

    Args:
        grid: nodes and intervals.
        n_states: number of states at a node.
        hessian: symmetric, square in z = (theta, x, others); the others stay.
        jacobian: of the constraints, (n_intervals * n_states, n_z).
        n_theta: number of parameters.

    Raises:
        SolveError: the states do not follow from the parameters and the data.
    """
    n = n_theta + grid.n_nodes * n_states
    upper = triu(hessian.tocsc()[:n, :n], format="coo")
    slopes = jacobian.tocsc()[:, :n].tocoo()
    of_hessian = Pattern(upper.row, upper.col, upper.shape)
    of_jacobian = Pattern(slopes.row, slopes.col, slopes.shape)
    system = OptimalitySystem(grid, n_states, of_hessian, of_jacobian)
    return system.factored(upper.data, slopes.data).reduced(grid, n_states)

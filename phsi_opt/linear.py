"""Linear algebra along the time: unknowns that touch only their neighbours in time make a banded matrix.

The optimality system of every likelihood here is such a matrix, bordered by the few columns of the parameters. Its
factors cost time and memory in proportion to the number of samples.
"""

from typing import Any

import numpy as np
from scipy.linalg.lapack import dgbtrf, dgbtrs
from scipy.sparse import bmat, csc_matrix, diags, vstack

from phsi_opt.errors import SolveError
from phsi_opt.grid import Grid

REGULAR = 1e-13  # share of the largest curvature that is added where a state has none


class Banded:
    """LU factors (LAPACK, partial pivoting) of a square sparse matrix, banded once its unknowns stand in ``order``."""

    def __init__(self, matrix: Any, order: np.ndarray) -> None:
        self.order, self.n = order, len(order)
        rank = np.empty(self.n, dtype=np.int64)
        rank[order] = np.arange(self.n)
        entries = matrix.tocoo()
        rows, columns = rank[entries.row], rank[entries.col]
        self.kl = int(np.max(rows - columns, initial=0))
        self.ku = int(np.max(columns - rows, initial=0))
        band = np.zeros((2 * self.kl + self.ku + 1, self.n), order="F")
        np.add.at(band, (self.kl + self.ku + rows - columns, columns), entries.data)
        self.factors, self.pivots, info = dgbtrf(band, self.kl, self.ku, overwrite_ab=True)
        if info > 0:
            raise SolveError(
                "the optimality system is singular: a state may neither be measured nor act on one that is; measure "
                "it, or take it out of the model."
            )

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solution for one right-hand side (n,) or several (n, k)."""
        columns = right.reshape(self.n, -1)
        found, _ = dgbtrs(self.factors, self.kl, self.ku, columns[self.order], self.pivots, overwrite_b=True)
        result = np.empty_like(found)
        result[self.order] = found
        return result.reshape(right.shape)

    @property
    def log_abs_det(self) -> float:
        """Logarithm of the absolute value of the determinant."""
        return float(np.sum(np.log(np.abs(self.factors[self.kl + self.ku]))))


def along_time(grid: Grid, *per_block: tuple[str, int]) -> np.ndarray:
    """Order of unknowns that stand in blocks of ``("node" or "interval", values per row)``, sorted by their time."""
    places = []
    for kind, width in per_block:
        place = 2 * np.arange(grid.n_nodes) if kind == "node" else 2 * grid.begin + 1
        places.append(np.repeat(place, width))
    return np.argsort(np.concatenate(places), kind="stable")


class Reduced:
    """min 1/2 z'Hz - g'z over z = (theta, x), subject to Jz = e, with the states eliminated.

    Attributes:
        information: (n_theta, n_theta), the curvature that is left for theta when the states follow it.
    """

    def __init__(self, grid: Grid, n_states: int, H: Any, J: Any, theta: slice, x: slice) -> None:
        H, J = csc_matrix(H), csc_matrix(J)
        curvature = H[x, x]
        floor = REGULAR * max(float(np.max(curvature.diagonal(), initial=0.0)), 1e-300)
        states = bmat([[curvature + diags(np.full(x.stop - x.start, floor)), J[:, x].T], [J[:, x], None]], format="coo")
        self._band = Banded(states, along_time(grid, ("node", n_states), ("interval", n_states)))
        self._n_states = n_states
        self._n_x, self._border = x.stop - x.start, vstack([H[x, theta], J[:, theta]]).toarray()
        self._followed = self._band.solve(self._border) if self._border.shape[1] else self._border
        information = H[theta, theta].toarray() - self._border.T @ self._followed
        self.information = (information + information.T) / 2

    def respond(self, e: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Change of theta and x when the constraints are offset by ``e``; ``covariance`` inverts the information."""
        return self.solve(np.zeros((self._n_x, *e.shape[1:])), e, covariance)

    def solve(
        self, g: np.ndarray, e: np.ndarray, covariance: np.ndarray, g_theta: np.ndarray | float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Theta and x for gradients g in x and g_theta, and the offset e; each one column or several side by side."""
        alone = self._band.solve(np.concatenate([g, e]))
        theta = covariance @ (g_theta - self._border.T @ alone)
        return theta, (alone - self._followed @ theta)[: self._n_x]

    def multipliers(self, g: np.ndarray, covariance: np.ndarray, g_theta: np.ndarray | float = 0.0) -> np.ndarray:
        """What the objective gains per unit of an offset of each constraint, for gradients g in x and g_theta."""
        alone = self._band.solve(np.concatenate([g, np.zeros(self._band.n - self._n_x)]))
        theta = covariance @ (g_theta - self._border.T @ alone)
        return (alone - self._followed @ theta)[self._n_x :]

    @property
    def following(self) -> np.ndarray:
        """How the states of a record follow a change of theta, (n_nodes, n_states, n_theta)."""
        return -self._followed[: self._n_x].reshape(-1, self._n_states, self._followed.shape[1])

    def start_covariances(self, starts: np.ndarray, trajectory: np.ndarray) -> np.ndarray:
        """Covariance of each node's states when theta is known: that of the starting states, carried along.

        ``starts`` (n_trajectories, n_states): places of the starting states in x; ``trajectory``: that of each node.
        """
        n_runs, n = starts.shape
        right = np.zeros((self._band.n, n))
        right[starts.ravel(), np.tile(np.arange(n), n_runs)] = 1.0  # no trajectory touches another one
        columns = self._band.solve(right)[: self._n_x].reshape(-1, n, n)
        at_start = np.linalg.pinv(columns.reshape(-1, n)[starts.ravel()].reshape(n_runs, n, n), hermitian=True)
        return columns @ at_start[trajectory] @ columns.transpose(0, 2, 1)

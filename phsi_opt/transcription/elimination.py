"""TODO."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import bmat, csc_matrix, diags, vstack

from phsi_opt.optimization.banded import Banded
from phsi_opt.statistics import TINY
from phsi_opt.transcription.grid import Grid

# information, per scaled parameter, that makes the matrix regular where the data say
# nothing
RIDGE = 1e-10


def regularized_inverse(
    information: np.ndarray, held: Sequence[int] = ()
) -> np.ndarray:
    """Covariance of scaled parameters; a ridge holds directions without information,
    and ``held`` do not move.
    """
    ridge = np.full(len(information), RIDGE)
    ridge[list(held)] = 1e12
    values, vectors = np.linalg.eigh(information)
    positive = (
        vectors * np.maximum(values, 0.0)
    ) @ vectors.T  # a direction without information may round below zero
    held_fast = positive + np.diag(ridge)
    try:
        return np.linalg.inv(held_fast)
    except (
        np.linalg.LinAlgError
    ):  # information that spans more digits than numbers have
        return np.linalg.pinv(held_fast, rcond=1e-15, hermitian=True)


REGULAR = 1e-13  # share of the largest curvature that is added where a state has none


def time_order(grid: Grid, *per_block: tuple[str, int]) -> np.ndarray:
    """Order of unknowns that stand in blocks of ``("node" or "interval", values per
    row)``, sorted by their time.
    """
    places = []
    for kind, width in per_block:
        place = 2 * np.arange(grid.n_nodes) if kind == "node" else 2 * grid.begin + 1
        places.append(np.repeat(place, width))
    return np.argsort(np.concatenate(places), kind="stable")


@dataclass(frozen=True, eq=False)
class Step:
    """A change of the unknowns, one column or several side by side.

    Attributes:
        theta: (n_theta, ...) change of the scaled parameters.
        x: (n_nodes * n_states, ...) change of the scaled states.
    """

    theta: np.ndarray
    x: np.ndarray

    @property
    def joined(self) -> np.ndarray:
        """Parameters, then states: (n_theta + n_nodes * n_states, ...)."""
        return np.concatenate([self.theta, self.x])


class ReducedSystem:
    """min 1/2 z'Hz - g'z over z = (theta, x), subject to Jz = e, with the states
    eliminated.

    Attributes:
        information: (n_theta, n_theta), the curvature that is left for theta when the
            states follow it.
    """

    def __init__(
        self, grid: Grid, n_states: int, H: Any, J: Any, theta: slice, x: slice
    ) -> None:
        H, J = csc_matrix(H), csc_matrix(J)
        curvature = H[x, x]
        floor = REGULAR * max(float(np.max(curvature.diagonal(), initial=0.0)), TINY)
        states = bmat(
            [
                [curvature + diags(np.full(x.stop - x.start, floor)), J[:, x].T],
                [J[:, x], None],
            ],
            format="coo",
        )
        self._band = Banded(
            states, time_order(grid, ("node", n_states), ("interval", n_states))
        )
        self._n_states = n_states
        self._n_x, self._border = (
            x.stop - x.start,
            vstack([H[x, theta], J[:, theta]]).toarray(),
        )
        self._followed = (
            self._band.solve(self._border) if self._border.shape[1] else self._border
        )
        information = H[theta, theta].toarray() - self._border.T @ self._followed
        self.information = (information + information.T) / 2

    def respond(self, e: np.ndarray, covariance: np.ndarray) -> Step:
        """Change of theta and x when the constraints are offset by ``e``;
        ``covariance`` inverts the information.
        """
        return self.solve(np.zeros((self._n_x, *e.shape[1:])), e, covariance)

    def solve(
        self,
        g: np.ndarray,
        e: np.ndarray,
        covariance: np.ndarray,
        g_theta: np.ndarray | float = 0.0,
    ) -> Step:
        """Theta and x for gradients g in x and g_theta, and the offset e; each one
        column or several side by side.
        """
        alone = self._band.solve(np.concatenate([g, e]))
        theta = covariance @ (g_theta - self._border.T @ alone)
        return Step(theta, (alone - self._followed @ theta)[: self._n_x])

    def multipliers(
        self, g: np.ndarray, covariance: np.ndarray, g_theta: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """What the objective gains per unit of an offset of each constraint, for
        gradients g in x and g_theta.
        """
        alone = self._band.solve(
            np.concatenate([g, np.zeros(self._band.n - self._n_x)])
        )
        theta = covariance @ (g_theta - self._border.T @ alone)
        return (alone - self._followed @ theta)[self._n_x :]

    @property
    def following(self) -> np.ndarray:
        """How the states of a record follow a change of theta, (n_nodes, n_states,
        n_theta).
        """
        return -self._followed[: self._n_x].reshape(
            -1, self._n_states, self._followed.shape[1]
        )

    def start_covariances(
        self, starts: np.ndarray, trajectory: np.ndarray
    ) -> np.ndarray:
        """Covariance of each node's states when theta is known: that of the starting
        states, carried along.

        ``starts`` (n_trajectories, n_states): places of the starting states in x;
        ``trajectory``: that of each node.
        """
        n_runs, n = starts.shape
        right = np.zeros((self._band.n, n))
        right[starts.ravel(), np.tile(np.arange(n), n_runs)] = (
            1.0  # no trajectory touches another one
        )
        columns = self._band.solve(right)[: self._n_x].reshape(-1, n, n)
        at_start = np.linalg.pinv(
            columns.reshape(-1, n)[starts.ravel()].reshape(n_runs, n, n), hermitian=True
        )
        return columns @ at_start[trajectory] @ columns.transpose(0, 2, 1)

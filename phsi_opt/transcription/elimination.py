"""Elimination of the states: what a linearised problem says about the parameters.

The states of a record follow the parameters through the constraints, one trajectory
after the other. In the order of time the matrix of states and constraints is banded, so
its factors cost a time linear in the length of the record, and what is left is a small
dense problem in the parameters: the information.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phsi_opt.errors import SolveError
from phsi_opt.optimization.banded import Banded
from phsi_opt.optimization.chained import Chained
from phsi_opt.transcription.grid import Grid

# Information, per scaled parameter, that makes the matrix regular where the data say
# nothing.
RIDGE = 1e-10
# The same as a share of the largest information: beside less the others drown in its
# inverse's rounding.
ROUNDED_RIDGE = 1e-15
HELD = 1e12  # information, per scaled parameter, by which a parameter does not move
REGULAR = 1e-13  # share of the largest curvature that is added where a state has none


def regularized_inverse(
    information: np.ndarray, held: Sequence[int] = ()
) -> np.ndarray:
    """Covariance of scaled parameters: (information + ridge)^-1.

    Args:
        information: (n_theta, n_theta), symmetric. A direction without information may
            round below zero and counts as zero; the ridge holds it.
        held: places of parameters that do not move, such as those at a bound.

    Raises:
        SolveError: the information is not finite.
    """
    if not np.all(np.isfinite(information)):
        raise SolveError(
            "the model's slopes along its states are beyond all numbers, so that no "
            "parameter has a standard error; give parameters bounds, or start them "
            "nearer to the truth."
        )
    values, vectors = np.linalg.eigh(information)
    least = max(RIDGE, ROUNDED_RIDGE * float(np.max(values, initial=0.0)))
    ridge = np.full(len(information), least)
    ridge[list(held)] = HELD
    positive = (vectors * np.maximum(values, 0.0)) @ vectors.T
    regular = positive + np.diag(ridge)
    try:
        return np.linalg.inv(regular)
    except np.linalg.LinAlgError:  # it spans more digits than numbers have
        return np.linalg.pinv(regular, rcond=1e-15, hermitian=True)


@dataclass(frozen=True, eq=False)
class Step:
    """A change of the unknowns.

    Attributes:
        theta: (n_theta,) change of the scaled parameters.
        x: (n_nodes * n_states,) change of the scaled states.
    """

    theta: np.ndarray
    x: np.ndarray


class ReducedSystem:
    """The linearised problem with its states eliminated.

    ::

        min over z = (theta, x) of  1/2 z'Hz   subject to  Jz = e

    Args:
        grid: nodes and intervals.
        n_states: number of states at a node.
        factors: of states and multipliers, parameters held.
        coupling: (n_x + n_constraints, n_theta) how theta acts on both.
        curvature: (n_theta, n_theta) of theta alone.
        per_theta: (n_x + n_constraints, n_theta) what the factors make of the coupling.

    Attributes:
        information: (n_theta, n_theta), the curvature that is left for theta when the
            states follow it.
    """

    def __init__(
        self,
        grid: Grid,
        n_states: int,
        factors: Banded | Chained,
        coupling: np.ndarray,
        curvature: np.ndarray,
        per_theta: np.ndarray,
    ) -> None:
        self._n_states = n_states
        self._n_x = grid.n_nodes * n_states
        self._factors = factors
        self._coupling = coupling
        self._per_theta = per_theta
        information = curvature - coupling.T @ self._per_theta
        self.information = (information + information.T) / 2

    def respond(self, e: np.ndarray, covariance: np.ndarray) -> Step:
        """Change of theta and x when the constraints are offset by ``e``.

        Args:
            e: (n_constraints,).
            covariance: (n_theta, n_theta) inverse of the information.
        """
        alone = self._factors.solve(np.concatenate([np.zeros(self._n_x), e]))
        theta = covariance @ (-self._coupling.T @ alone)
        states = alone - self._per_theta @ theta
        return Step(theta, states[: self._n_x])

    @property
    def following(self) -> np.ndarray:
        """How the states follow a change of theta, (n_nodes, n_states, n_theta)."""
        n_theta = self._per_theta.shape[1]
        n_nodes = self._n_x // self._n_states
        states = self._per_theta[: self._n_x]
        return -states.reshape(n_nodes, self._n_states, n_theta)

    def start_covariances(
        self, starts: np.ndarray, trajectory: np.ndarray
    ) -> np.ndarray:
        """Covariance of each node's states when theta is known.

        It is that of the starting states, carried along the trajectory.

        Args:
            starts: (n_trajectories, n_states) places of the starting states in x.
            trajectory: (n_nodes,) number of the trajectory of each node.

        Returns:
            (n_nodes, n_states, n_states).
        """
        n_runs, n = starts.shape
        unit = np.zeros((self._factors.n, n))
        # One column serves all trajectories: none touches another one.
        unit[starts.ravel(), np.tile(np.arange(n), n_runs)] = 1.0
        columns = self._factors.solve(unit)[: self._n_x]
        at_start = columns[starts.ravel()].reshape(n_runs, n, n)
        per_node = columns.reshape(-1, n, n)
        inverses = np.linalg.pinv(at_start, hermitian=True)
        return per_node @ inverses[trajectory] @ per_node.transpose(0, 2, 1)

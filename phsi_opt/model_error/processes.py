"""Processes that wander: first-order (Ornstein-Uhlenbeck) ones, sampled at some times.

They stand for what a model does not know of the forces on a machine, and for errors of
its sensors that outlast a sample. What they act on is said in `disturbances`.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg.lapack import dtbtrs

from phsi_opt.statistics import TINY


@dataclass(frozen=True)
class Process:
    """A process with a standard deviation and a correlation time.

    After a time dt it keeps the share exp(-dt/time) of its value; the rest is new and
    independent (Uhlenbeck and Ornstein, Physical Review 36, 1930).

    Attributes:
        place: number of its equation, or of the state whose sensor errs.
        size: standard deviation, in the unit of that equation or sensor.
        time: correlation time, in the unit of the record's times; 0: white, a value of
            its own at every time.
    """

    place: int
    size: float
    time: float


@dataclass(frozen=True, eq=False)
class Whitener:
    """From the values of a process to independent standard normals.

    A matrix with two diagonals: the value at a time less what was kept of the one
    before, over the standard deviation of what is new.

    Attributes:
        diagonal: (n,).
        below: (n - 1,), what multiplies the value before.
    """

    diagonal: np.ndarray
    below: np.ndarray

    @classmethod
    def of(cls, t: np.ndarray, trajectory: np.ndarray, time: float) -> "Whitener":
        """Of a process of size one.

        Args:
            t: (n,) times at which it is looked at, trajectory after trajectory.
            trajectory: (n,) numbers of the trajectories; each starts anew.
            time: correlation time; 0: white.
        """
        is_first = np.diff(trajectory, prepend=-1) != 0
        elapsed = np.where(is_first, 0.0, np.diff(t, prepend=t[0]))
        log_kept = -elapsed / time if time > 0 else np.full(len(t), -np.inf)
        log_kept = np.where(is_first, -np.inf, log_kept)
        new = np.sqrt(np.maximum(-np.expm1(2 * log_kept), TINY))
        kept = np.exp(log_kept)
        return cls(1 / new, -kept[1:] / new[1:])

    @property
    def log_det(self) -> float:
        """Logarithm of the determinant."""
        return float(np.sum(np.log(self.diagonal)))

    @property
    def precision_diagonal(self) -> np.ndarray:
        """Diagonal of the inverse covariance of the values, (n,)."""
        diagonal = self.diagonal**2
        diagonal[:-1] += self.below**2
        return diagonal

    @property
    def precision_below(self) -> np.ndarray:
        """The diagonal beside it, (n - 1,)."""
        below: np.ndarray = self.below * self.diagonal[1:]
        return below

    def whitened(self, values: np.ndarray) -> np.ndarray:
        """Standard normals of values (n, ...)."""
        result = (self.diagonal * values.T).T
        result[1:] += (self.below * values[:-1].T).T
        return result

    def transposed(self, normals: np.ndarray) -> np.ndarray:
        """The transposed matrix times (n, ...)."""
        result = (self.diagonal * normals.T).T
        result[:-1] += (self.below * normals[1:].T).T
        return result

    def factor_of(self, weights: np.ndarray) -> np.ndarray:
        """F with F'F the covariance of weighted sums of the values, (n, k).

        Args:
            weights: (n, k), a column per sum.
        """
        return self._solved(weights, transposed=True)

    def coloured(self, normals: np.ndarray) -> np.ndarray:
        """Values of the process from standard normals (n, ...)."""
        return self._solved(normals, transposed=False)

    def _solved(self, right: np.ndarray, transposed: bool) -> np.ndarray:
        """The inverse of the matrix, or of its transpose, times (n, ...)."""
        if not right.size:  # LAPACK writes beyond what has no column
            return np.zeros(right.shape)
        lower = np.zeros((2, len(self.diagonal)), order="F")
        lower[0] = self.diagonal
        lower[1, :-1] = self.below
        columns = right.reshape(len(self.diagonal), -1)
        found, _ = dtbtrs(lower, columns, uplo="L", trans="T" if transposed else "N")
        return np.asarray(found).reshape(right.shape)


@lru_cache(4)  # a search asks for the same ones at every step
def random_signs(lengths: tuple[int, ...], n: int) -> tuple[np.ndarray, ...]:
    """Signs, (n_values, n) for each of the lengths n_values, read-only.

    For a random sign vector s, the mean of s'As is the trace of A (Hutchinson,
    Communications in Statistics 19, 1990). The same signs everywhere make an estimate
    the same every time, and smooth in what the matrix depends on.
    """
    rng = np.random.default_rng(0)
    drawn = []
    for length in lengths:
        signs = np.asfortranarray(rng.choice([-1.0, 1.0], (length, n)))
        signs.flags.writeable = False
        drawn.append(signs)
    return tuple(drawn)

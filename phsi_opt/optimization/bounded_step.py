"""Dense linear algebra of the few parameters: steps within bounds, and covariance.

The best step by a primal active set: the full step of the free parameters, cut where it
meets a bound, which then holds its parameter; a parameter that is held and whose
multiplier has the wrong sign is released.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from phsi_opt.errors import SolveError

# Share of the largest curvature of (scaled) parameters below which a direction is as
# good as rounding: it is the difference of numbers as large as the largest.
SILENT = 1e-12
# Information, per scaled parameter, that makes the matrix regular where the data say
# nothing.
RIDGE = 1e-10
REGULAR = 1e-13  # share of the largest curvature that is added where a state has none


@dataclass(frozen=True, eq=False)
class Room:
    """How far a step may move the parameters."""

    below: np.ndarray  # (n,) least changes, none above zero
    above: np.ndarray  # (n,) largest changes, none below zero

    @classmethod
    def at(cls, z: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> "Room":
        """Between the bounds of z, (n,) each."""
        return cls(np.minimum(lower - z, 0.0), np.maximum(upper - z, 0.0))

    def holds(self, step: np.ndarray) -> bool:
        """Whether the parameters can take a whole step (n,)."""
        return bool(np.all((self.below <= step) & (step <= self.above)))

    def share(self, step: np.ndarray) -> np.ndarray:
        """Of a step (n,), that which each of the parameters can take, at most 1."""
        room = np.where(step > 0, self.above, self.below)
        is_beyond = np.abs(step) > np.abs(room)
        return np.divide(room, step, out=np.ones(len(step)), where=is_beyond)


ANY_ROOM = Room(np.array(-np.inf), np.array(np.inf))


def bounded_step(
    curvature: np.ndarray, pull: np.ndarray, room: Room, silent: float = 0.0
) -> np.ndarray:
    """The d (n,) within the room that minimises ``d'Cd/2 - p'd``.

    None is taken in directions on which the data are silent: there it would be as large
    as rounding makes it.

    Args:
        curvature: C, (n, n), none negative but by rounding.
        pull: p, (n,).
        room: for d.
        silent: curvature up to which a direction is silent, beside that of rounding; no
            more than a thousandth of the largest.
    """
    n = len(pull)
    if not n:
        return pull
    curvature = (curvature + curvature.T) / 2
    eigen = np.linalg.eigh(curvature)
    largest = eigen.eigenvalues[-1]
    silent = np.clip(silent, SILENT * largest, 1e-3 * largest)
    whole = _full_step(*eigen, pull, silent)
    if room.holds(whole):
        return whole
    d = np.zeros(n)
    is_free = np.ones(n, dtype=bool)
    loose = SILENT * np.max(np.abs(pull))
    for _ in range(10 * n):  # each change of the active set is made once or twice
        slope = pull - curvature @ d
        step = np.zeros(n)
        eigen = np.linalg.eigh(curvature[np.ix_(is_free, is_free)])
        step[is_free] = _full_step(*eigen, slope[is_free], silent)
        shares = Room.at(d, room.below, room.above).share(step)
        first = int(np.argmin(shares))
        if shares[first] < 1:
            d = d + shares[first] * step
            d[first] = room.above[first] if step[first] > 0 else room.below[first]
            is_free[first] = False
            continue
        d = d + step
        slope = pull - curvature @ d
        inwards = np.where(d == room.below, slope, -slope)
        inwards[is_free | (room.below == room.above)] = 0.0
        loosest = int(np.argmax(inwards))
        if inwards[loosest] <= loose:
            break
        is_free[loosest] = True
    return d


def _full_step(
    values: np.ndarray, vectors: np.ndarray, slope: np.ndarray, silent: float
) -> np.ndarray:
    """The step in directions whose curvature is more than that of silent ones."""
    is_seen = values > silent
    seen = vectors[:, is_seen]
    step: np.ndarray = seen @ ((seen.T @ slope) / values[is_seen])
    return step


def bounded_least_squares(
    A: np.ndarray, b: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """The x (n,) between ``lower`` and ``upper`` that minimises ``|A x - b|^2``.

    By an active set (Stark and Parker, Comput. Stat. 10, 1995), which always ends:
    where the columns of A differ by many orders of magnitude, the line search of
    SciPy's other method goes on for ever.
    """
    solution: np.ndarray = np.linalg.lstsq(A, b, rcond=-1)[0]  # as SciPy begins
    if np.all((lower <= solution) & (solution <= upper)):
        return solution  # without the import, which takes longer than a small fit
    solution = scipy.optimize.lsq_linear(A, b, (lower, upper), method="bvls").x
    return solution


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
            "the derivatives of the model with respect to its states overflow, so no "
            "standard errors can be computed; give the parameters bounds, or "
            "starting values closer to the solution."
        )
    values, vectors = np.linalg.eigh(information)
    # Beside a smaller share of the largest information the others drown in its
    # inverse's rounding.
    least = max(RIDGE, 1e-15 * float(np.max(values, initial=0.0)))
    ridge = np.full(len(information), least)
    ridge[list(held)] = 1e12  # by which a parameter does not move
    regular = (vectors * np.maximum(values, 0.0)) @ vectors.T + np.diag(ridge)
    try:
        return np.linalg.inv(regular)
    except np.linalg.LinAlgError:  # it spans more digits than numbers have
        return np.linalg.pinv(regular, rcond=1e-15, hermitian=True)

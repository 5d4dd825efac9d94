"""Directions of the parameters on which the data are silent, and sentences about them.

A direction of the scaled parameters is silent where only the ridge of the covariance
holds it, where rounding errors alone tell it, or where several parameters may be
multiplied by one factor without a trace. Its parameters get no standard error, and a
sentence says what could be fixed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr

from phsi_opt.errors import SolveError
from phsi_opt.optimization.bounded_step import RIDGE

# Share of a direction's largest member from which a parameter belongs to it.
MEMBER_SHARE = 0.1
# Standard deviation of a common factor from which it is called open.
OPEN_FACTOR = 2


@dataclass(frozen=True, eq=False)
class SilentDirections:
    """What the data do not say.

    Attributes:
        sentences: One per set of parameters.
        parameters: Places of the parameters in these directions, increasing.
        pinned: Places of as few of them as must be held at their values, so that the
            data tell all others.
    """

    sentences: tuple[str, ...] = ()
    parameters: tuple[int, ...] = ()
    pinned: tuple[int, ...] = ()


NOTHING_SILENT = SilentDirections()


def silent_directions(
    names: Sequence[str],
    theta: np.ndarray,
    covariance: np.ndarray,
    held: Sequence[int] = (),
) -> SilentDirections:
    """Find the directions on which the data are silent.

    Args:
        names: Of the parameters.
        theta: (n_theta,) scaled parameters.
        covariance: (n_theta, n_theta) of the scaled parameters, with the ridge.
        held: Places of parameters that do not move, such as those at a bound.

    Raises:
        SolveError: the covariance is not finite.
    """
    moving = [i for i in range(len(covariance)) if i not in held]
    if not moving:
        return NOTHING_SILENT
    if not np.all(np.isfinite(covariance)):
        raise SolveError(
            "the covariance of the estimates is beyond all numbers: the model's slopes "
            "along its states are too steep; give parameters bounds, or start them "
            "nearer to the truth."
        )
    size = np.abs(theta[moving])
    sentences = []
    silent: set[int] = set()
    pinned = []
    for one in _open_directions(covariance[np.ix_(moving, moving)], size):
        spread = np.sqrt(one.variance) * np.abs(one.direction)
        places = _members(one.direction, spread, size)
        members = [moving[i] for i in places]
        silent.update(members)
        of_members = [names[i] for i in members]
        sentences.append(_sentence(of_members, one.direction[places], theta[members]))
        if one.own is not None:
            pinned.append(moving[one.own])
    return SilentDirections(
        sentences=tuple(dict.fromkeys(sentences)),
        parameters=tuple(sorted(silent)),
        pinned=tuple(sorted(pinned)),
    )


@dataclass(frozen=True, eq=False)
class _Open:
    """A direction that the data leave open.

    Attributes:
        variance: of a step along it.
        direction: (n_moving,) of length one.
        own: place of a parameter that changes along it and along no other unknown one;
            None: the data know the direction, but for a factor.
    """

    variance: float
    direction: np.ndarray
    own: int | None = None


def _open_directions(covariance: np.ndarray, size: np.ndarray) -> list[_Open]:
    """Those about which the data are silent.

    Args:
        covariance: (n_moving, n_moving) of the scaled parameters.
        size: (n_moving,) their absolute values.
    """
    eigenvalues, directions = np.linalg.eigh(covariance)
    best_known = float(np.min(eigenvalues, where=eigenvalues > 0, initial=np.inf))
    # Rounded below zero: nothing but the ridge holds the direction.
    variances = np.where(eigenvalues > 0, eigenvalues, 1 / RIDGE)
    is_unknown = np.array([_is_unknown(one, best_known) for one in variances])
    found = []
    for k in np.flatnonzero(~is_unknown):
        if _is_scaling(np.sqrt(variances[k]) * np.abs(directions[:, k]), size):
            found.append(_Open(float(variances[k]), directions[:, k]))
    if np.any(is_unknown):
        variance = float(np.max(variances[is_unknown]))
        found += _separated(directions[:, is_unknown], variance)
    return found


def _separated(directions: np.ndarray, variance: float) -> list[_Open]:
    """Directions that span the same space (n, n_directions), with few members each.

    Eigenvectors of one eigenvalue are mixed at will. Each of these has a parameter to
    itself, in which the others have no part.
    """
    _, _, order = qr(directions.T, mode="economic", pivoting=True)
    own = order[: directions.shape[1]]
    separated = directions @ np.linalg.inv(directions[own])
    is_rounding = np.abs(separated) < 1e-6 * np.max(np.abs(separated))
    separated[is_rounding] = 0.0
    separated = separated / np.linalg.norm(separated, axis=0)
    pairs = zip(separated.T, own.tolist(), strict=True)
    return [_Open(variance, direction, place) for direction, place in pairs]


def _is_unknown(variance: float, best_known: float) -> bool:
    """Whether only the ridge holds a direction, or only rounding errors tell it.

    From a hundredth of the ridge's own variance nothing else holds it. Below 1e-11 of
    the largest information all is rounding; a variance up to 100 is not suspicious.
    """
    return variance > min(0.01 / RIDGE, max(100.0, best_known / 1e-11))


def _members(direction: np.ndarray, spread: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Places of its largest members, and of those it moves by more than their size."""
    change = np.abs(direction)
    is_member = change > MEMBER_SHARE * np.max(change)
    is_member |= (spread > size) & (size > 0)
    return np.flatnonzero(is_member)


def _is_scaling(spread: np.ndarray, size: np.ndarray) -> bool:
    """Whether a direction multiplies several parameters by one factor that is open.

    It changes no others, and the data leave the factor open.
    """
    is_member = spread > MEMBER_SHARE * np.max(spread)
    is_member |= spread > OPEN_FACTOR * size
    member_size = size[is_member]
    relative = spread[is_member] / np.where(member_size > 0, member_size, np.nan)
    has_several = is_member.sum() > 1
    is_open = np.min(relative) > OPEN_FACTOR
    is_one_factor = np.ptp(relative) < 0.005 * np.max(relative)
    return bool(has_several and is_open and is_one_factor)


def _sentence(names: list[str], change: np.ndarray, theta: np.ndarray) -> str:
    """What may change together without a trace, and what to do about it."""
    if len(names) == 1:
        return (
            f"the data say nothing about {names[0]}: "
            "fix it to a known value or remove it"
        )
    apart = f"the data cannot tell {', '.join(names)} apart: "
    if np.all(theta != 0):
        relative = change / theta
        size = np.abs(relative)
        if np.ptp(size) < 0.02 * np.max(size):  # one factor, in words
            return apart + _common_factor(names, relative)
    return f"{apart}fix one of them to a known value"


def _common_factor(names: list[str], relative: np.ndarray) -> str:
    """By which factor parameters may be multiplied, or divided, together."""
    with_first = relative * relative[0] > 0
    if len(names) == 2:
        sign = "/" if with_first[1] else "*"
        known = f"{names[0]}{sign}{names[1]}"
        return f"only {known} is identifiable; fix one of them to a known value"
    if np.all(with_first):
        return (
            "a common factor of all leaves no trace; fix one of them to a known value"
        )
    up = [name for name, is_up in zip(names, with_first, strict=True) if is_up]
    down = [name for name in names if name not in up]
    return (
        f"{', '.join(up)} may be multiplied by a common factor, "
        f"and {', '.join(down)} divided by it, without a trace; fix one of them"
    )

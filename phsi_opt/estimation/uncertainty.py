"""Covariances of the estimates: what the data say about each parameter.

By `MaximumLikelihood` the covariance is the inverse of the information; by `PHSILoss`,
whose residuals are not independent, it is a sandwich, and the shift by the scheme's own
error counts as one standard deviation. A parameter at a bound, and one of which the
data say nothing, gets NaN: no number is given that is not trusted.

The data say nothing of a direction of the scaled parameters where only the ridge of the
covariance holds it, where rounding errors alone tell it, or where several parameters
may be multiplied by one factor without a trace. A sentence says what could be fixed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from phsi_opt.errors import SolveError
from phsi_opt.model.model import Model
from phsi_opt.optimization.bounded_step import RIDGE
from phsi_opt.transcription.defects import (
    defect_slopes,
    integration_errors,
    parameter_slopes,
)
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.parameter_vector import Theta

# Share of a direction's largest member from which a parameter belongs to it.
MEMBER_SHARE = 0.1

# A function of parameters (n_theta,): what they predict, one number per value.
Predictions = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class SilentDirections:
    """What the data do not say."""

    sentences: tuple[str, ...] = ()  # One per set of parameters
    # Places of the parameters in these directions, increasing.
    parameters: tuple[int, ...] = ()
    # Places of as few of them as must be held at their values, so that the data tell
    # all others.
    pinned: tuple[int, ...] = ()


NOTHING_SILENT = SilentDirections()


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What is known about the estimates."""

    covariance: np.ndarray  # (n_theta, n_theta); NaN where it is not known
    # A sentence per direction that cannot be identified, or why nothing is known.
    warnings: tuple[str, ...] = ()
    # The directions that cannot be identified.
    silent: SilentDirections = NOTHING_SILENT


def unknown(n_theta: int, reason: str) -> Uncertainty:
    """No standard error is given, and why."""
    return Uncertainty(np.full((n_theta, n_theta), np.nan), (reason,))


def of_covariance(
    names: Sequence[str],
    theta: np.ndarray,
    scale: np.ndarray,
    scaled: np.ndarray,
    at_bounds: tuple[str, ...],
    known: SilentDirections = NOTHING_SILENT,
    told: np.ndarray | None = None,
    predicted: Predictions | None = None,
) -> Uncertainty:
    """A covariance of scaled parameters, without those of which nothing is known.

    ``predicted`` tells what parameters, not scaled, predict.
    """
    held = [i for i, name in enumerate(names) if name in at_bounds]
    held += known.parameters
    told = scaled if told is None else told
    of_scaled = None if predicted is None else lambda one: predicted(one * scale)
    found = silent_directions(names, theta / scale, told, held, of_scaled)
    silent = SilentDirections(
        sentences=(*known.sentences, *found.sentences),
        parameters=tuple(sorted({*known.parameters, *found.parameters})),
        pinned=tuple(sorted({*known.pinned, *found.pinned})),
    )
    covariance = scaled * np.outer(scale, scale)
    not_known = [*held, *silent.parameters]
    covariance[not_known, :] = np.nan
    covariance[:, not_known] = np.nan
    return Uncertainty(covariance, silent.sentences, silent)


def of_defects(
    model: Model,
    grid: Grid,
    scheme: str,
    theta: np.ndarray,
    scale: np.ndarray,
    at_bounds: tuple[str, ...],
    d: np.ndarray | None = None,
) -> Uncertainty:
    """Sandwich covariance of the PHSI loss.

    Neighbouring defects share a noisy sample, so they are not independent. To first
    order in the noise e of the samples the gradient of the loss is::

        sum_n G_n e_n

    where G_n gathers what the two defects at the sample n make of its noise; so the
    covariance of the gradient is sum_n G_n Sigma G_n'. Sigma, a variance per state,
    comes from the sizes of the defects. What exact solutions leave in the defects, the
    error of the scheme, shifts the estimate; the shift counts as a standard deviation.
    The bias that noisy states cause is not in it.

    Estimates theta and their ``scale`` are (n_free,); ``d`` are the defects
    (n_intervals, n_states) there, where they are not the model's alone.
    """
    n_theta = len(theta)
    y = np.nan_to_num(grid.y)
    n = model.n_states
    known = defect_slopes(model, grid, scheme, y, theta)
    own_d, at_begin, at_end, in_theta = known
    jacobian = in_theta * scale

    gathered = np.zeros((grid.n_nodes, n, n_theta))
    np.add.at(gathered, grid.begin, np.einsum("ikj,ikp->ijp", at_begin, jacobian))
    np.add.at(gathered, grid.begin + 1, np.einsum("ikj,ikp->ijp", at_end, jacobian))

    noise_to_square = np.mean(at_begin**2, axis=0) + np.mean(at_end**2, axis=0)
    squares = np.mean((own_d if d is None else d) ** 2, axis=0)
    variance, _ = scipy.optimize.nnls(noise_to_square, squares)

    weighted = gathered * np.sqrt(variance)[None, :, None]
    weighted = weighted.reshape(-1, n_theta)
    of_gradient = weighted.T @ weighted
    by_defect = jacobian.reshape(-1, n_theta)
    # A prior counts as a measurement whose variance is that of the defects.
    mean_square = np.mean((own_d if d is None else d) ** 2)
    of_priors = mean_square * scale**2 * Theta.of(model, ("",)).priors[1]
    of_gradient += mean_square * np.diag(of_priors)
    information = by_defect.T @ by_defect + np.diag(of_priors)
    mean_information = np.trace(information) / max(n_theta, 1)
    ridge = RIDGE * mean_information * np.eye(n_theta)
    # A pseudo-inverse, for data from which nothing follows: states that are all zero.
    bread = np.linalg.pinv(information + ridge, hermitian=True)
    error = integration_errors(model, grid, scheme, y, theta)
    shift = bread @ (by_defect.T @ error.ravel())
    return of_covariance(
        model.free,
        theta,
        scale,
        bread @ of_gradient @ bread + np.outer(shift, shift),
        at_bounds,
        told=bread * mean_information,
        predicted=lambda one: parameter_slopes(model, grid, scheme, one, y, []).d,
    )


# ---- directions of which the data say nothing --------------------------------------


def silent_directions(
    names: Sequence[str],
    theta: np.ndarray,
    covariance: np.ndarray,
    held: Sequence[int] = (),
    predicted: Predictions | None = None,
) -> SilentDirections:
    """Find the directions on which the data are silent.

    Of scaled parameters theta (n_theta,), by their covariance (n_theta, n_theta) with
    the ridge. Those that are ``held``, such as at a bound, do not move. What parameters
    predict tells a sum of equal parts from a product.

    Raises:
        SolveError: the covariance is not finite.
    """
    moving = np.setdiff1d(np.arange(len(covariance)), held)
    if not len(moving):
        return NOTHING_SILENT
    if not np.all(np.isfinite(covariance)):
        raise SolveError(
            "the covariance of the estimates overflows, because derivatives of the "
            "model are too large; give the parameters bounds, or starting values "
            "closer to the solution."
        )
    size = np.abs(theta[moving])
    sentences = []
    silent: set[int] = set()
    pinned = []
    for variance, direction, own in _open_directions(
        covariance[np.ix_(moving, moving)], size
    ):
        spread = np.sqrt(variance) * np.abs(direction)
        places = _members(direction, spread, size)
        members = moving[places].tolist()
        silent.update(members)
        change = np.zeros(len(theta))
        change[members] = direction[places]
        sentences.append(_sentence(names, members, change, theta, predicted))
        if own is not None:
            pinned.append(int(moving[own]))
    return SilentDirections(
        sentences=tuple(dict.fromkeys(sentences)),
        parameters=tuple(sorted(silent)),
        pinned=tuple(sorted(pinned)),
    )


# Variance of a step along a direction that the data leave open; the direction, of
# length one; the place of a parameter that changes along it and along no other unknown
# one, or None where the data know the direction, but for a factor.
_Open = tuple[float, np.ndarray, int | None]


def _open_directions(covariance: np.ndarray, size: np.ndarray) -> list[_Open]:
    """Those about which the data are silent."""
    # Only the ridge holds a direction from a hundredth of the ridge's own variance.
    # Below 1e-11 of the largest information all is rounding; a variance up to 100 is
    # not suspicious. Of parameters whose absolute values are ``size``.
    eigenvalues, directions = np.linalg.eigh(covariance)
    best_known = float(np.min(eigenvalues, where=eigenvalues > 0, initial=np.inf))
    # Rounded below zero: nothing but the ridge holds the direction.
    variances = np.where(eigenvalues > 0, eigenvalues, 1 / RIDGE)
    limit = min(0.01 / RIDGE, max(100.0, best_known / 1e-11))
    is_unknown = variances > limit
    found: list[_Open] = []
    for k in np.flatnonzero(~is_unknown):
        if _is_scaling(np.sqrt(variances[k]) * np.abs(directions[:, k]), size):
            found.append((float(variances[k]), directions[:, k], None))
    if not np.any(is_unknown):
        return found
    # Directions that span the same space, with few members each: eigenvectors of one
    # eigenvalue are mixed at will. Each of these has a parameter to itself.
    unknown = directions[:, is_unknown]
    _, _, order = scipy.linalg.qr(unknown.T, mode="economic", pivoting=True)
    own = order[: unknown.shape[1]]
    separated = unknown @ np.linalg.inv(unknown[own])
    is_rounding = np.abs(separated) < 1e-6 * np.max(np.abs(separated))
    separated[is_rounding] = 0.0
    separated = separated / np.linalg.norm(separated, axis=0)
    variance = float(np.max(variances[is_unknown]))
    for direction, place in zip(separated.T, own.tolist(), strict=True):
        found.append((variance, direction, place))
    return found


def _members(direction: np.ndarray, spread: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Places of its largest members, and of those it moves by more than their size."""
    change = np.abs(direction)
    is_member = change > MEMBER_SHARE * np.max(change)
    is_member |= (spread > size) & (size > 0)
    return np.flatnonzero(is_member)


def _is_scaling(spread: np.ndarray, size: np.ndarray) -> bool:
    """Whether a direction multiplies several parameters alone by an open factor.

    That is a factor whose standard deviation is more than two.
    """
    is_member = spread > MEMBER_SHARE * np.max(spread)
    is_member |= spread > 2 * size
    member_size = size[is_member]
    relative = spread[is_member] / np.where(member_size > 0, member_size, np.nan)
    has_several = is_member.sum() > 1
    is_open = np.min(relative) > 2
    is_one_factor = np.ptp(relative) < 0.005 * np.max(relative)
    return bool(has_several and is_open and is_one_factor)


def _sentence(
    every: Sequence[str],
    members: list[int],
    change: np.ndarray,
    theta: np.ndarray,
    predicted: Predictions | None,
) -> str:
    """What may change together without a trace, and what to do about it."""
    names = list(map(every.__getitem__, members))
    if len(names) == 1:
        return (
            f"the data contain no information about {names[0]}: fix it to a known "
            "value or remove it"
        )
    apart = f"the data cannot distinguish {', '.join(names)}: "
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = change[members] / theta[members]
        size = np.abs(relative)
        is_one_factor = np.ptp(size) < 0.02 * np.max(size)
    # One factor, in words, unless it is a sum whose parts happen to be of one size.
    if is_one_factor and not _is_sum(predicted, theta, members[0], change):
        return apart + _common_factor(names, relative)
    return f"{apart}fix one of them to a known value"


def _is_sum(
    predicted: Predictions | None, theta: np.ndarray, first: int, change: np.ndarray
) -> bool:
    """Whether a direction leaves no trace where its first parameter is another, too.

    That of a sum is the same everywhere, that of a product or a ratio is not.
    """
    if predicted is None:
        return False
    step = change * theta[first] / change[first] / 2
    second = theta.copy()
    second[first] *= 1.5
    alone = second.copy()
    alone[first] += step[first]
    before = predicted(second)
    along = predicted(second + step) - before
    of_first = predicted(alone) - before
    is_silent = np.linalg.norm(along) < 1e-3 * np.linalg.norm(of_first)
    return bool(is_silent)


def _common_factor(names: list[str], relative: np.ndarray) -> str:
    """By which factor parameters may be multiplied, or divided, together."""
    with_first = relative * relative[0] > 0
    if len(names) == 2:
        sign = "/" if with_first[1] else "*"
        known = f"{names[0]}{sign}{names[1]}"
        return f"only {known} is identifiable; fix one of them to a known value"
    if np.all(with_first):
        return (
            "a common factor of all does not change the predictions; fix one of them "
            "to a known value"
        )
    up = [name for name, is_up in zip(names, with_first, strict=True) if is_up]
    down = [name for name in names if name not in up]
    return (
        f"multiplying {', '.join(up)} by a common factor and dividing "
        f"{', '.join(down)} by it does not change the predictions; fix one of them"
    )

"""More intervals between samples where the integration error moves the estimates.

The error of each interval, against a finer integration, offsets its constraint; the
linearised likelihood says what that does to parameters and states. Nothing is solved
here.
"""

from collections.abc import Sequence

import numpy as np

from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.optimization.bounded_step import regularized_inverse
from phsi_opt.statistics import TINY
from phsi_opt.transcription.defects import local_errors
from phsi_opt.transcription.grid import steps_per_gap

MOST_INTERVALS = 64  # between two samples
# Integration error that is refined: share of a standard error, or of the noise.
VISIBLE_ERROR = 0.1
ORDER = 4  # the error of an interval's integration, per length, falls with h^ORDER


def finer_steps(estimate: LikelihoodEstimate) -> list[np.ndarray] | None:
    """More steps where the integration error moves the estimates, or residuals.

    By more than `VISIBLE_ERROR`. The number of steps grows with the fourth root of an
    interval's error (order four).

    Returns:
        Intervals in every gap between samples, (n_samples - 1,) per trajectory; None
        where those of the estimate are enough, or as many as there may be.
    """
    parameters = np.asarray(estimate.unknown.by_trajectory(estimate.theta))
    error = local_errors(estimate.model, estimate.grid, estimate.nodes, parameters)
    error = error / estimate.point.x_scale
    is_lost = ~np.isfinite(error).all(axis=1)
    known_error = np.where(is_lost[:, None], 0.0, error)
    visible = _visible_share(estimate, known_error)
    if visible < VISIBLE_ERROR and not is_lost.any():
        return None
    # Factors on the intervals that bring the visible share down, a fifth more than is
    # wanted; at most 16 at once, and 4 where the finer integration left the numbers.
    size = np.linalg.norm(known_error, axis=1)
    typical = np.sum(size**2) / max(np.sum(size), TINY)
    fall = 1.2 * visible / VISIBLE_ERROR * size / max(typical, TINY)
    factor = np.clip(np.ceil(fall ** (1 / ORDER)), 1, 16)
    factor = np.where(is_lost, 4, factor).astype(int)
    old = steps_per_gap(estimate.grid)
    new = _refined(old, factor)
    pairs = zip(old, new, strict=True)
    if all(np.array_equal(before, after) for before, after in pairs):
        return None
    return new


def _visible_share(estimate: LikelihoodEstimate, error: np.ndarray) -> float:
    """What the errors do to the estimates: the larger of two shares.

    Of a standard error, in the direction of theta in which it is largest (many small
    shifts of one sign add up); and of the noise, root mean square over the measured
    values.
    """
    reduced = estimate.reduced
    information = reduced.information
    covariance = regularized_inverse(information, estimate.held)
    theta_shift, x_shift = reduced.respond(error.ravel(), covariance)
    squared_shift = float(theta_shift @ information @ theta_shift)
    in_std_errors = np.sqrt(max(squared_shift, 0.0))
    x_shift = x_shift * estimate.point.x_scale
    in_noise = (x_shift / estimate.sigma)[estimate.grid.measured]
    return max(in_std_errors, float(np.sqrt(np.mean(in_noise**2))))


def _refined(steps: Sequence[np.ndarray], factor: np.ndarray) -> list[np.ndarray]:
    """Steps times the largest factor of a gap's intervals."""
    of_gaps = np.concatenate(steps)
    gap = np.repeat(np.arange(len(of_gaps)), of_gaps)
    largest = np.ones(len(of_gaps), dtype=int)
    np.maximum.at(largest, gap, factor)
    new = np.minimum(of_gaps * largest, MOST_INTERVALS)
    ends = np.cumsum([len(of_trajectory) for of_trajectory in steps])
    return np.split(new, ends[:-1])

"""What is checked at an optimum: its residuals against the data, its integration error.

Residuals that are far larger than the scatter of neighbouring samples say that the
optimum is a wrong one, or that the model lacks something. The scatter needs no model:
each sample against the cubic through its neighbours (`data.noise.difference_noise`).

Quantisation is like noise, uniform and new in every sample, where a signal crosses
several steps (Widrow 1956). Where it stays within one, the errors follow the motion.

The integration error of each interval, against a finer integration, offsets its
constraint; the linearised likelihood says what that does to parameters and states.
Nothing is solved here.
"""

from collections.abc import Mapping

import numpy as np

from phsi_opt.data.channel_noise import DEVIATION_PER_STEP
from phsi_opt.data.noise import (
    LEAST_NOISE_SHARE,
    channel_spread,
    difference_noise,
    unresolved_channels,
)
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.optimization.bounded_step import REGULAR
from phsi_opt.presentation.units import scale_of, spaced
from phsi_opt.statistics import TINY
from phsi_opt.transcription.defects import local_errors
from phsi_opt.transcription.grid import steps_per_gap

# What to do about outliers.
HUBER = "spikes count less with a Huber loss, MaximumLikelihood(huber=1.345)"


# ---- residuals -----------------------------------------------------------------------


def _worst_ratio(estimate: LikelihoodEstimate) -> tuple[float, str]:
    """Largest rms residual over the scatter of neighbouring samples, and its state."""
    is_measured = estimate.grid.measured_states
    between_samples = np.nan_to_num(difference_noise(estimate.task.data))
    spread = np.where(is_measured, channel_spread(estimate.task.data), 0.0)
    # What data without noise scatter says nothing about it.
    floor = 10 * LEAST_NOISE_SHARE * spread
    scatter = np.maximum(between_samples, floor + TINY)
    ratio = np.where(is_measured, _rms_residual(estimate) / scatter, 0.0)
    worst = int(np.argmax(ratio))
    return float(ratio[worst]), estimate.model.states[worst]


def _rms_residual(estimate: LikelihoodEstimate) -> np.ndarray:
    """Of every state, (n_states,)."""
    rms: np.ndarray = estimate.grid.rms_by_channel(estimate.standardized)
    return estimate.sigma * rms


def worst_share(estimate: LikelihoodEstimate) -> float:
    """Largest rms residual of a measured state over its standard deviation."""
    is_measured = estimate.grid.measured_states
    spread = channel_spread(estimate.task.data)[is_measured]
    return float(np.max(_rms_residual(estimate)[is_measured] / (spread + TINY)))


def is_small_beside_motion(estimate: LikelihoodEstimate) -> bool:
    """Whether residuals are a small share of the motion.

    A motion out of step leaves its own size: 0.53 to 1 of it in ten wrong optima of
    swinging machines. Forces of 1 to 5 % that a model lacked left up to 0.26 in 74
    right ones.
    """
    return worst_share(estimate) <= 0.3


def is_at_scatter(estimate: LikelihoodEstimate) -> bool:
    """Whether it is an optimum whose residuals are what neighbouring samples scatter.

    The scatter of a few hundred samples is known to about a tenth. Residuals are a
    small share of the motion, too.
    """
    is_fine = estimate.is_success and is_small_beside_motion(estimate)
    return is_fine and _worst_ratio(estimate)[0] < 1.25


def _sign_words(estimate: LikelihoodEstimate, signs: Mapping[str, float]) -> str:
    told = []
    for name, value in signs.items():
        scale = scale_of(estimate.model.entries[name].parameter.unit)
        told.append(f"{name} = {scale.shown(value):.3g}{spaced(scale.unit)}")
    terms = f"term{'s' * (len(signs) > 1)} with {' and '.join(signs)}"
    return f"check the sign of the {terms}: {', '.join(told)} would fit"


def residual_warnings(
    estimate: LikelihoodEstimate, signs: Mapping[str, float]
) -> tuple[str, ...]:
    """Where residuals are far beyond the scatter, or quantisation sets the noise.

    Nothing is said of channels whose noise was declared, which judges them already,
    unless terms have the wrong signs: then, which values would fit.
    """
    data = estimate.task.data
    noise = estimate.levels
    warnings = []
    if estimate.is_success and not noise.is_known.any():
        ratio, channel = _worst_ratio(estimate)
        if ratio >= 2:
            spoilt = list(data.look.spoilt_words)
            cause = "there are outliers" if not spoilt else "the data may be the cause"
            if not spoilt or "outlier" in str(spoilt):
                spoilt.append(HUBER)
            causes = (
                _sign_words(estimate, signs)
                if signs
                else (
                    f"physics is missing (diagnose the model), {cause} "
                    f"({'; '.join(spoilt)}), or the optimum is a poor one (choose "
                    "other starting values)"
                )
            )
            warnings.append(
                f"the residuals of {channel} are {ratio:.1f} times the scatter of "
                f"neighbouring samples: {causes}"
            )
    unresolved = unresolved_channels(data)
    for k in np.flatnonzero(~noise.is_known & (noise.least > 0)).tolist():
        least = noise.least[k]
        name = estimate.model.states[k]
        scale = scale_of(data.units.get(name, ""))
        told = least / scale.size
        step = f"{told / DEVIATION_PER_STEP:.3g} {scale.unit}".rstrip()
        if estimate.sigma[k] <= (1 + 1e-9) * least:
            at_least = f"{told:.2g} {scale.unit}".rstrip()
            warnings.append(
                f"the values of {name} are quantised in steps of {step}: the noise is "
                f"taken as at least {at_least}"
            )
        if name in unresolved:
            warnings.append(
                f"the standard deviation of {name} is less than its quantisation step "
                f"of {step}: rounding errors depend on the motion, so standard errors "
                "are too small and a diagnosis names no effect"
            )
    return tuple(warnings)


# ---- integration error ---------------------------------------------------------------


def finer_steps(
    estimate: LikelihoodEstimate, visible_error: float = 0.1, most: int = 64
) -> list[np.ndarray] | None:
    """More steps where the integration error moves the estimates, or residuals.

    By more than a visible share of a standard error, or of the noise. None where those
    of the estimate are enough, or as many as there may be, ``most`` between two
    samples. Their number grows with the fourth root of the error, which falls with the
    fourth power of an interval's length.
    """
    parameters = estimate.unknown.by_trajectory(estimate.theta)
    error = local_errors(estimate.model, estimate.grid, estimate.nodes, parameters)
    error = error / estimate.point.x_scale
    is_lost = ~np.isfinite(error).all(axis=1)
    known_error = np.where(is_lost[:, None], 0.0, error)
    visible = _visible_share(estimate, known_error)
    if visible < visible_error and not is_lost.any():
        return None
    # Factors on the intervals that bring the visible share down, a fifth more than is
    # wanted; at most 16 at once, and 4 where the finer integration left the numbers.
    size = np.linalg.norm(known_error, axis=1)
    typical = np.sum(size**2) / max(np.sum(size), TINY)
    fall = 1.2 * visible / visible_error * size / max(typical, TINY)
    factor = np.clip(np.ceil(fall ** (1 / 4)), 1, 16)
    factor = np.where(is_lost, 4, factor).astype(int)
    steps = steps_per_gap(estimate.grid)
    old = np.concatenate(steps)
    # Of the intervals between two samples the largest factor counts.
    grid = estimate.grid
    sample = np.cumsum(grid.sample)[grid.begin] - 1
    largest = np.ones_like(old)
    np.maximum.at(largest, sample - grid.runs, factor)
    new = np.minimum(old * largest, most)
    if np.array_equal(old, new):
        return None
    return np.split(new, np.cumsum(list(map(len, steps)))[:-1])


def _visible_share(estimate: LikelihoodEstimate, error: np.ndarray) -> float:
    """What the errors do to the estimates: the larger of two shares."""
    # Of a standard error, in the direction of theta in which it is largest (many small
    # shifts of one sign add up); and of the noise, root mean square over the measured
    # values.
    system = estimate.reduced
    likelihood = system.likelihood
    if len(estimate.moving) < len(likelihood.moving):
        likelihood = likelihood.with_moving(estimate.moving)
        system = likelihood.at(system.disturbances, REGULAR)
    no_errors = np.zeros((system.problem.n_values, 1))
    shift, theta_shift = system.solve(no_errors, error.reshape(-1, 1))
    squared_shift = float(np.sum(theta_shift * (system.information @ theta_shift)))
    in_std_errors = np.sqrt(max(squared_shift, 0.0))
    x_shift = shift[: estimate.nodes.size].reshape(estimate.nodes.shape)
    x_shift = x_shift * estimate.point.x_scale
    in_noise = (x_shift / estimate.sigma)[estimate.grid.measured]
    return max(in_std_errors, float(np.sqrt(np.mean(in_noise**2))))

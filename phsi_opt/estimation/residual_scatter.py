"""What the residuals of a fit say beside the data: their scatter, their resolution.

Where they are far larger, the optimum is a wrong one or the model lacks something. The
scatter needs no model: each sample beside the cubic through its neighbours
(`phsi_opt.data.noise.difference_noise`).

Quantisation is like noise, uniform and new in every sample, where a signal crosses
several steps (Widrow 1956). Where it stays within one, the errors follow the motion.
"""

import numpy as np

from phsi_opt.data.noise import LEAST_NOISE_SHARE, channel_spread, difference_noise
from phsi_opt.data.resolution import DEVIATION_PER_STEP, unresolved_channels
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.statistics import TINY

# Residuals over the scatter of neighbouring samples up to which they are no more than
# it: that of a few hundred samples is known to about a tenth.
AT_SCATTER = 1.25
# Share of a channel's standard deviation that residuals reach, at least, in an optimum
# that is far off. A motion out of step leaves its own size: 0.53 to 1 in ten wrong
# optima of swinging machines. Forces of 1 to 5 % that a model lacked left up to 0.26 in
# 74 right ones.
FAR_OFF_SHARE = 0.3


def _worst_ratio(estimate: LikelihoodEstimate) -> tuple[float, str]:
    """Largest root mean square residual over what neighbouring samples scatter.

    With the name of its channel.
    """
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


def is_at_scatter(estimate: LikelihoodEstimate) -> bool:
    """Whether it is an optimum that leaves what neighbouring samples scatter, no more.

    And a small share of the motion, so that it cannot be out of step with it.
    """
    if not estimate.is_success:
        return False
    is_measured = estimate.grid.measured_states
    limit = FAR_OFF_SHARE * channel_spread(estimate.task.data)
    is_small = np.all((_rms_residual(estimate) <= limit)[is_measured])
    return bool(is_small) and _worst_ratio(estimate)[0] < AT_SCATTER


def scatter_warnings(
    estimate: LikelihoodEstimate, is_known: np.ndarray
) -> tuple[str, ...]:
    """A sentence where the residuals are far beyond what neighbouring samples scatter.

    Empty where noise was declared (``is_known``, (n_states,)), which judges them
    already.
    """
    if is_known.any() or not estimate.is_success:
        return ()
    ratio, channel = _worst_ratio(estimate)
    if ratio < 2:
        return ()
    return (
        f"the residuals of {channel} are {ratio:.1f} times what "
        "neighbouring samples scatter: the model lacks something (diagnose), outliers "
        "pull (let them count less: huber = 1.345 in [loss] of a study file; in "
        "Python, ph.MaximumLikelihood(huber=1.345)), or there are several optima "
        "(start the parameters elsewhere)",
    )


def resolution_notes(
    estimate: LikelihoodEstimate, is_known: np.ndarray, least: np.ndarray
) -> tuple[str, ...]:
    """Sentences on channels whose quantisation sets the noise, or hides the motion.

    Args:
        estimate: with its noise.
        is_known: (n_states,) whether it was declared; then nothing is said.
        least: (n_states,) noise of quantisation.
    """
    data = estimate.task.data
    unresolved = unresolved_channels(data)
    notes = []
    for k in np.flatnonzero(~is_known & (least > 0)).tolist():
        name = estimate.model.states[k]
        unit = data.units.get(name, "")
        step = f"{least[k] / DEVIATION_PER_STEP:.3g} {unit}".rstrip()
        if estimate.sigma[k] <= (1 + 1e-9) * least[k]:
            at_least = f"{least[k]:.2g} {unit}".rstrip()
            notes.append(
                f"the values of {name} are quantised in steps of {step}: at least "
                f"{at_least} counts as noise"
            )
        if name in unresolved:
            notes.append(
                f"{name} moves by less than one of its steps of {step} (standard "
                "deviation): the errors of its values follow the motion, so standard "
                "errors are too small and a diagnosis names nothing"
            )
    return tuple(notes)

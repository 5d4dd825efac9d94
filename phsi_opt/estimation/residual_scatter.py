"""Whether the residuals of a fit are as small as neighbouring samples scatter.

Where they are far larger, the optimum is a wrong one or the model lacks something. The
scatter needs no model: each sample beside the cubic through its neighbours
(`phsi_opt.data.noise.difference_noise`).
"""

from dataclasses import dataclass

import numpy as np

from phsi_opt.data.noise import LEAST_NOISE_SHARE, channel_spread, difference_noise
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.statistics import TINY

# Residuals over the scatter of neighbouring samples beyond which a solution is doubted.
SUSPICIOUS_RATIO = 2.0
# And up to which residuals are no more than the scatter: that of a few hundred samples
# is known to about a tenth.
AT_SCATTER = 1.25
# Share of a channel's standard deviation that residuals reach, at least, in an optimum
# that is far off. A motion out of step leaves its own size: 0.53 to 1 in ten wrong
# optima of swinging machines. Forces of 1 to 5 % that a model lacked left up to 0.26 in
# 74 right ones.
FAR_OFF_SHARE = 0.3
# Scatter that data without noise are taken to have, in units of the least noise that is
# assumed: what they scatter says nothing about it.
NOISE_FREE_SCATTER = 10


@dataclass(frozen=True)
class ResidualScatter:
    """The channel whose residuals are largest beside what its samples scatter.

    Attributes:
        channel: name of the state.
        ratio: root mean square residual over the scatter of neighbouring samples.
    """

    channel: str
    ratio: float

    @classmethod
    def of(cls, estimate: LikelihoodEstimate) -> "ResidualScatter":
        """The ratio of the worst channel at the estimate."""
        is_measured = np.asarray(estimate.grid.measured.any(axis=0))
        between_samples = np.nan_to_num(difference_noise(estimate.task.data))
        spread = np.where(is_measured, channel_spread(estimate.task.data), 0.0)
        floor = NOISE_FREE_SCATTER * LEAST_NOISE_SHARE * spread
        scatter = np.maximum(between_samples, floor + TINY)
        residual = estimate.sigma * estimate.grid.rms_by_channel(estimate.standardized)
        ratio = np.where(is_measured, residual / scatter, 0.0)
        worst = int(np.argmax(ratio))
        return cls(estimate.model.states[worst], float(ratio[worst]))

    @property
    def explains_residuals(self) -> bool:
        """Whether the residuals are not far above the scatter."""
        return self.ratio < SUSPICIOUS_RATIO


def is_at_scatter(estimate: LikelihoodEstimate) -> bool:
    """Whether it is an optimum that leaves what neighbouring samples scatter, no more.

    And a small share of the motion, so that it cannot be out of step with it.
    """
    if not estimate.is_success or not _is_small_beside_motion(estimate):
        return False
    return ResidualScatter.of(estimate).ratio < AT_SCATTER


def _is_small_beside_motion(estimate: LikelihoodEstimate) -> bool:
    """Whether the residuals of every channel are a small share of its spread."""
    is_measured = np.asarray(estimate.grid.measured.any(axis=0))
    residual = estimate.sigma * estimate.grid.rms_by_channel(estimate.standardized)
    limit = FAR_OFF_SHARE * channel_spread(estimate.task.data)
    return bool(np.all((residual <= limit)[is_measured]))


def scatter_warnings(
    estimate: LikelihoodEstimate, is_known: np.ndarray
) -> tuple[str, ...]:
    """A sentence where the residuals are far beyond what neighbouring samples scatter.

    Empty where noise was declared (``is_known``, (n_states,)), which judges them
    already.
    """
    if is_known.any() or not estimate.is_success:
        return ()
    worst = ResidualScatter.of(estimate)
    if worst.explains_residuals:
        return ()
    return (
        f"the residuals of {worst.channel} are {worst.ratio:.1f} times what "
        "neighbouring samples scatter: the model lacks something (diagnose), outliers "
        "pull (let them count less: huber = 1.345 in [loss] of a study file; in "
        "Python, ph.MaximumLikelihood(huber=1.345)), or there are several optima "
        "(start the parameters elsewhere)",
    )

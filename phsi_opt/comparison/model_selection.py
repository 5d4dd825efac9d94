"""Whether a model fails, and whether a larger one leaves noise alone."""

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import (
    EXPLAINED_IF_NAMED,
    FAILING_ERROR,
    SURE_LEVEL,
    WHITE_ERROR,
)
from phsi_opt.estimation.fit import Fit
from phsi_opt.statistics import TINY


def is_like_noise(comparison: Comparison) -> bool:
    """Whether the residuals look like noise: as small as the noise floor, and white.

    Noise that the fit found to last from sample to sample need not be white.
    """
    if not is_small_as_noise(comparison):
        return False
    return is_white_noise(comparison) or comparison.record.has_correlated_noise


def is_white_noise(comparison: Comparison) -> bool:
    """Whether the residuals are as small as the noise floor, and white.

    The whiteness of several channels is tested together (Bonferroni).
    """
    p_values = comparison.table["whiteness"].to_numpy()
    is_white = np.nanmin(p_values) * len(p_values) > SURE_LEVEL
    return bool(is_white and is_small_as_noise(comparison))


def leaves_noise(base: Comparison, trained: Comparison) -> bool:
    """Whether what a larger model leaves looks like noise.

    Noise that lasts must have been seen beside the smaller model too: what an effect
    leaves that imitates another one looks like it.

    Args:
        base: the smaller model on the training record.
        trained: the larger one.
    """
    if not is_small_as_noise(trained):
        return False
    return is_white_noise(trained) or (
        trained.record.has_correlated_noise and base.record.shows_correlated_noise
    )


def is_small_as_noise(comparison: Comparison) -> bool:
    """Whether noise hides, by its size, what the free run is off by besides."""
    return comparison.rmse < WHITE_ERROR * comparison.noise_floor


def is_failing(comparison: Comparison) -> bool:
    """Whether the free run is further off than the noise alone would leave it."""
    return comparison.rmse > FAILING_ERROR * comparison.noise_floor


def is_explained(base: Comparison, trained: Comparison, judged: Comparison) -> bool:
    """Whether a larger model explains what was missing.

    What it leaves on the training record looks like noise, or is as small as the noise
    there and on the record that judges.

    Args:
        base: the smaller model on the record that judges.
        trained: the larger model on the training record.
        judged: the larger model on the record that judges.
    """
    if leaves_noise(base, trained):
        return True
    is_small = (
        judged.rmse < FAILING_ERROR * judged.noise_floor
        and trained.rmse < FAILING_ERROR * trained.noise_floor
    )
    return is_small and explained_share(base, judged) > EXPLAINED_IF_NAMED


def explained_share(old: Comparison, new: Comparison) -> float:
    """Share of the squared error above the noise floor that a larger model removes."""
    above_floor = max(old.rmse**2 - old.noise_floor**2, TINY)
    return (old.rmse**2 - new.rmse**2) / above_floor


def deviance(fit: Fit) -> float:
    """-2 log likelihood of a maximum-likelihood fit."""
    return fit.bic - len(fit.names) * float(np.log(fit.n_values))

"""Evidence for a larger model, from residuals that may be correlated in time.

On measured machines residuals are errors of the model as much as noise, and neighbours
are alike. A likelihood that counts every sample as independent would then find every
effect significant. Gains are counted for the independent residuals that they are worth.
"""

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import (
    EXPLAINED_IF_NAMED,
    EXPLAINED_IF_PROPOSED,
    FAILING_ERROR,
    FEWEST_BLOCKS,
    FEWEST_INDEPENDENT,
    HELD_OUT_FALL_Z,
    MOST_BLOCKS,
    WHITE_ERROR,
    WHITENESS_LEVEL,
)
from phsi_opt.estimation.fit import Fit
from phsi_opt.model_error.standard_errors import Source
from phsi_opt.statistics import (
    TINY,
    autocorrelation_time,
    effective_sample_share,
    likelihood_ratio_p_value,
)


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
    is_white = np.nanmin(p_values) * len(p_values) > WHITENESS_LEVEL
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


def delta_bic(old: Fit, new: Fit, share: float) -> float:
    """Change of the Bayesian information criterion from one fit to another.

    The change is share * (D_new - D_old) + (k_new - k_old) log(share * n), with the
    deviances D and numbers k of parameters (Schwarz, Annals of Statistics 6, 1978), of
    residuals that are worth ``share`` of n independent ones.
    """
    n_independent = max(share * new.n_values, FEWEST_INDEPENDENT)
    gain = share * (deviance(new) - deviance(old))
    n_more = len(new.names) - len(old.names)
    return float(gain + n_more * np.log(n_independent))


def p_value_of_larger_model(old: Fit, new: Fit, share: float) -> float:
    """p-value of the hypothesis that the parameters which ``new`` has more are zero.

    See `likelihood_ratio_p_value`; ``share`` of the residuals are independent.
    """
    fall = (deviance(old) - deviance(new)) * share
    return likelihood_ratio_p_value(fall, len(new.names) - len(old.names))


def free_run_deviance(comparison: Comparison) -> float:
    """-2 log likelihood of a free run's residuals, up to a constant.

    The noise of every channel is what its residuals say.
    """
    table = comparison.table
    channels = table[table["rmse"] > 0]
    return float(2 * np.sum(channels["n_samples"] * np.log(channels["rmse"])))


def share_of_change(old: Comparison, new: Comparison) -> float:
    """Share of the residuals that is independent, for the change to a larger model.

    That of the two free runs, and no more than that of the parameters which the larger
    model has more (`Fit.independent_share`) where trajectories give it. A re-fit asks
    its record too briefly for what acts beside the model to decide names: on the
    cascaded tanks the effect that lowers the error of the test by two fifths would go.
    """
    of_runs = _share_of_runs(old, new)
    if new.fit.std_error_source != Source.TRAJECTORIES:
        return of_runs
    added = [name for name in new.fit.names if name not in old.fit.names]
    of_parameters = new.fit.independent_share(added) if added else np.nan
    return float(np.fmin(of_runs, of_parameters))


def _share_of_runs(old: Comparison, new: Comparison) -> float:
    """`effective_sample_share` of two free runs.

    States that only one of the models has are left out.
    """
    n_states = min(old.residuals[0].shape[1], new.residuals[0].shape[1])
    before = [run[:, :n_states] for run in old.residuals]
    after = [run[:, :n_states] for run in new.residuals]
    size = _channel_sizes(np.concatenate(after))
    changes = []
    for smaller, larger in zip(before, after, strict=True):
        changes.append(np.nan_to_num((smaller - larger) / size))
    residuals = [np.nan_to_num(run / size) for run in after]
    return effective_sample_share(changes, residuals)


def _channel_sizes(residuals: np.ndarray) -> np.ndarray:
    """Root mean square of each column; infinite for one without values."""
    sizes = np.full(residuals.shape[1], np.inf)
    for number, channel in enumerate(residuals.T):
        if np.isfinite(channel).any():
            sizes[number] = np.sqrt(np.nanmean(channel**2))
    return np.maximum(sizes, TINY)


def independent_samples(comparison: Comparison) -> float:
    """Number of independent values that the residuals are worth."""
    columns = []
    for run in comparison.residuals:
        for channel in (run * comparison.weights).T:
            columns.append(channel[np.isfinite(channel)])
    n_measured = 0
    for trajectory in comparison.data.trajectories:
        n_measured += int(np.isfinite(trajectory.x).sum())
    return max(n_measured / autocorrelation_time(columns), FEWEST_INDEPENDENT)


def falls_significantly(old: Comparison, new: Comparison) -> bool:
    """Whether the error of ``new`` on the same data is significantly below ``old``'s.

    Logarithms of mean squares are compared in blocks of time: an error that dies away
    with the motion counts in every block alike.
    """
    n_independent = min(independent_samples(old), independent_samples(new))
    n_blocks = int(np.clip(n_independent / 2, FEWEST_BLOCKS, MOST_BLOCKS))
    before = _block_means(old.squares, n_blocks)
    after = _block_means(new.squares, n_blocks)
    fall = np.log(before / after)
    std_error = fall.std(ddof=1) / np.sqrt(n_blocks)
    is_significant = fall.mean() > HELD_OUT_FALL_Z * std_error
    return bool(is_significant and new.rmse < old.rmse)


def falls_or_explains_most(old: Comparison, new: Comparison) -> bool:
    """Whether the error falls significantly, or most of it is gone.

    A record of few independent samples can show no more.
    """
    if falls_significantly(old, new):
        return True
    return is_failing(old) and explained_share(old, new) > EXPLAINED_IF_PROPOSED


def _block_means(squares: np.ndarray, n_blocks: int) -> np.ndarray:
    blocks = np.array_split(squares, n_blocks)
    return np.array([max(float(block.mean()), TINY) for block in blocks])

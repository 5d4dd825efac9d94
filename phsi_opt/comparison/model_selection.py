"""Evidence for a larger model: likelihoods and free-run errors, from residuals that may
be correlated.
"""

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.estimation.fit import Fit
from phsi_opt.statistics import TINY, autocorrelation_time, effective_sample_share

ABOVE_FLOOR = (
    1.1  # free-run error over the noise floor from which a model counts as failing
)
# the same, of white residuals: beside a strong missing force the floor itself is
# estimated too low
LIKE_NOISE = 1.25
# share of the squared error above the floor that is explained, where the rest is not
# white
NEARLY_ALL = 0.97
WHITE = 1e-3  # p-value below which residuals are not white
# share of the squared error above the floor from which effects that leave more than
# noise are proposed
MOST = 0.5
FALL = 1.65  # standard errors by which the held-out error must fall (one-sided 5 %)


def is_adequate(comparison: Comparison) -> bool:
    """Whether the residuals look like noise: as large as the noise floor, and white."""
    whiteness = comparison.table["whiteness"].to_numpy()
    is_white = np.nanmin(whiteness) * len(whiteness) > WHITE
    return bool(is_white and comparison.rmse < LIKE_NOISE * comparison.noise_floor)


def explains(old: Comparison, trained: Comparison, judged: Comparison) -> bool:
    """Whether a larger model explains what was missing: what it leaves is like noise,
    or as small as the noise.
    """
    small = (
        judged.rmse < ABOVE_FLOOR * judged.noise_floor
        and trained.rmse < ABOVE_FLOOR * trained.noise_floor
    )
    return is_adequate(trained) or (small and explained_share(old, judged) > NEARLY_ALL)


def delta_bic(old: Fit, new: Fit, share: float) -> float:
    """Change of BIC from one fit to another, for residuals worth ``share`` of as many
    independent ones.
    """
    n = max(share * new.n_values, 3.0)
    return float(
        share * (deviance(new) - deviance(old))
        + (len(new.names) - len(old.names)) * np.log(n)
    )


def deviance(fit: Fit) -> float:
    """-2 log likelihood of a maximum-likelihood fit."""
    return fit.bic - len(fit.names) * float(np.log(fit.n_values))


def left_over(comparison: Comparison) -> float:
    """-2 log likelihood of the residuals of a free run, up to a constant; the noise of
    every channel as they say.
    """
    seen = comparison.table[comparison.table["rmse"] > 0]
    return float(2 * np.sum(seen["n_samples"] * np.log(seen["rmse"])))


def explained_share(old: Comparison, new: Comparison) -> float:
    """Share of the squared error above the noise floor that is gone."""
    above = max(old.rmse**2 - old.noise_floor**2, TINY)
    return (old.rmse**2 - new.rmse**2) / above


def share_of(old: Comparison, new: Comparison) -> float:
    """`effective_sample_share` for the change from one model to a larger one, on the same
    data.
    """
    n = min(
        run.shape[1] for run in (old.residuals[0], new.residuals[0])
    )  # without the memory of the new effects
    before, after = ([run[:, :n] for run in one.residuals] for one in (old, new))
    left = np.concatenate(after)
    size = np.array(
        [np.sqrt(np.nanmean(r**2)) if np.isfinite(r).any() else np.inf for r in left.T]
    )
    size = np.maximum(size, TINY)
    changes = [
        np.nan_to_num((a - b) / size) for a, b in zip(before, after, strict=True)
    ]
    return effective_sample_share(changes, [np.nan_to_num(r / size) for r in after])


def independent_samples(comparison: Comparison) -> float:
    """Number of independent values that the residuals are worth."""
    columns = [
        c[np.isfinite(c)]
        for run in comparison.residuals
        for c in (run * comparison.weights).T
    ]
    measured = sum(
        int(np.isfinite(run.x).sum()) for run in comparison.data.trajectories
    )
    return max(measured / autocorrelation_time(columns), 3.0)


def falls(old: Comparison, new: Comparison) -> bool:
    """Whether the error of ``new`` on the same data is significantly below that of
    ``old``.

    Logarithms of mean squares are compared in blocks of time: an error that dies away
    with the motion counts in every block alike.
    """
    n_blocks = int(
        np.clip(min(independent_samples(old), independent_samples(new)) / 2, 4, 40)
    )
    before, after = (_block_means(one.squares, n_blocks) for one in (old, new))
    fall = np.log(before / after)
    spread = fall.std(ddof=1) / np.sqrt(n_blocks)
    return bool(fall.mean() > FALL * spread and new.rmse < old.rmse)


def falls_or_most(old: Comparison, new: Comparison) -> bool:
    """The same, or most of the error is gone: a record of few independent samples can
    show no more.
    """
    is_above = old.rmse > ABOVE_FLOOR * old.noise_floor
    return falls(old, new) or (is_above and explained_share(old, new) > MOST)


def _block_means(squares: np.ndarray, n_blocks: int) -> np.ndarray:
    return np.array(
        [max(float(block.mean()), TINY) for block in np.array_split(squares, n_blocks)]
    )

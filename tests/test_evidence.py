"""Evidence for a larger model: the fall of an error is judged against its floor."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from phsi_opt import criteria
from phsi_opt.comparison import model_selection as evidence
from phsi_opt.comparison.model_selection import falls_or_explains_most
from phsi_opt.statistics import autocorrelation_time


class _Errors:
    """As much of a comparison as the test of a fall looks at."""

    def __init__(self, residuals: np.ndarray, floor: float) -> None:
        self.residuals, self.weights, self.noise_floor = (
            (residuals[:, None],),
            np.ones(1),
            floor,
        )
        self.data = SimpleNamespace(
            trajectories=(SimpleNamespace(x=residuals[:, None]),)
        )
        self.squares, self.rmse = residuals**2, float(np.sqrt(np.mean(residuals**2)))


def test_most_of_an_error_at_the_noise_floor_is_nothing() -> None:
    rng = np.random.default_rng(1)
    accepted = 0
    for _ in range(200):
        old = rng.normal(size=200)
        new = old + 0.03 * rng.normal(size=200)
        floor = 0.999 * float(np.sqrt(np.mean(old**2)))
        accepted += falls_or_explains_most(_Errors(old, floor), _Errors(new, floor))  # type: ignore[arg-type]
    assert accepted < 20  # 5 % are asked for
    large, half = 3 * rng.normal(size=12), rng.normal(size=12)
    assert falls_or_explains_most(_Errors(large, 0.1), _Errors(half, 0.1))  # type: ignore[arg-type]


def fit(deviance: float, n_names: int, n_values: int = 400) -> Any:
    """As much of a fit as evidence looks at."""
    bic = deviance + n_names * np.log(n_values)
    return SimpleNamespace(names=("a",) * n_names, n_values=n_values, bic=bic)


def test_bic_asks_the_logarithm_of_the_independent_samples_per_parameter() -> None:
    old, new = fit(-100.0, 2), fit(-130.0, 5)
    assert evidence.deviance(old) == pytest.approx(-100.0)
    assert evidence.delta_bic(old, new, 1.0) == pytest.approx(-30 + 3 * np.log(400))
    assert evidence.delta_bic(old, new, 0.25) == pytest.approx(-7.5 + 3 * np.log(100))
    fewest = criteria.FEWEST_INDEPENDENT
    few = 30 * 1e-6
    assert evidence.delta_bic(old, new, 1e-6) == pytest.approx(
        3 * np.log(fewest) - few, rel=1e-9
    )


def test_a_larger_models_p_value_is_wilks_for_the_parameters_it_has_more() -> None:
    old, new = fit(-100.0, 2), fit(-109.0, 5)
    for share in (1.0, 0.5):
        found = evidence.p_value_of_larger_model(old, new, share)
        assert found == pytest.approx(stats.chi2.sf(9.0 * share, 3), rel=1e-9)


def judged(rmse: float, floor: float, whiteness: tuple[float, ...] = (0.5,)) -> Any:
    return SimpleNamespace(
        rmse=rmse,
        noise_floor=floor,
        table=pd.DataFrame({"whiteness": whiteness}),
        record=SimpleNamespace(has_correlated_noise=False),
    )


def test_the_share_explained_is_of_the_square_above_the_floor() -> None:
    assert evidence.explained_share(judged(5, 3), judged(4, 3)) == pytest.approx(9 / 16)
    assert evidence.explained_share(judged(5, 3), judged(3, 3)) == pytest.approx(1.0)
    assert evidence.explained_share(judged(3, 3), judged(4, 3)) < -1e6


def test_a_run_fails_beyond_a_share_of_its_floor() -> None:
    limit = criteria.FAILING_ERROR * 2.0
    assert not evidence.is_failing(judged(limit, 2.0))
    assert evidence.is_failing(judged(limit * 1.001, 2.0))


def test_noise_is_small_and_white_in_all_channels_together() -> None:
    small = criteria.WHITE_ERROR * 2.0 * 0.999
    level = criteria.WHITENESS_LEVEL
    assert evidence.is_like_noise(judged(small, 2.0))
    assert not evidence.is_like_noise(judged(small * 1.002, 2.0))
    assert evidence.is_like_noise(judged(small, 2.0, (level / 2 * 1.01, 0.5)))
    assert not evidence.is_like_noise(judged(small, 2.0, (level / 2 * 0.99, 0.5)))
    lasting = judged(small, 2.0, (1e-9, np.nan))
    assert not evidence.is_like_noise(lasting)
    lasting.record.has_correlated_noise = True
    assert evidence.is_like_noise(lasting)


def test_what_is_left_is_like_noise_or_small_and_most_of_it_explained() -> None:
    white, coloured = judged(1.0, 1.0), judged(1.0, 1.0, (1e-9,))
    base = judged(3.0, 1.0)
    limit = criteria.FAILING_ERROR
    assert evidence.is_explained(base, white, judged(2.9, 1.0))
    assert evidence.is_explained(base, coloured, judged(1.0, 1.0))
    assert not evidence.is_explained(base, coloured, judged(1.01 * limit, 1.0))
    off = judged(1.01 * limit, 1.0, (1e-9,))
    assert not evidence.is_explained(base, off, judged(1.0, 1.0))
    near = judged(0.999 * limit, 1.0)
    assert not evidence.is_explained(near, coloured, judged(0.998 * limit, 1.0))


def test_residuals_are_worth_their_number_over_their_correlation_time() -> None:
    rng = np.random.default_rng(3)
    runs = []
    for n in (80, 50):
        slow = np.cumsum(rng.normal(size=(n, 2)), axis=0)
        slow[::7, 1] = np.nan
        runs.append(slow)
    weights = np.array([1.0, 25.0])
    comparison: Any = SimpleNamespace(
        residuals=runs,
        weights=weights,
        data=SimpleNamespace(trajectories=[SimpleNamespace(x=run) for run in runs]),
    )
    columns = []
    for run in runs:
        columns += [run[:, 0], 25 * run[np.isfinite(run[:, 1]), 1]]
    n_measured = sum(len(column) for column in columns)
    expected = n_measured / autocorrelation_time(columns)
    assert expected > criteria.FEWEST_INDEPENDENT
    assert evidence.independent_samples(comparison) == pytest.approx(expected)
    comparison.residuals = comparison.residuals[:1]
    comparison.residuals[0][5:] = np.nan
    comparison.data.trajectories = comparison.data.trajectories[:1]
    fewest = criteria.FEWEST_INDEPENDENT
    assert evidence.independent_samples(comparison) == fewest


def errors(squares: np.ndarray) -> Any:
    """A comparison of residuals with these squares, signs at random."""
    signs = np.random.default_rng(9).choice([-1.0, 1.0], size=len(squares))
    return _Errors(signs * np.sqrt(squares), 0.1)


def test_a_fall_is_that_of_logarithms_in_blocks_and_its_limit_is_in_their_errors() -> (
    None
):
    n = 40 * criteria.MOST_BLOCKS
    old = np.ones(n)
    blocks = np.array_split(np.arange(n), criteria.MOST_BLOCKS)
    fall = 0.1 * np.random.default_rng(0).normal(size=len(blocks))
    fall -= fall.mean()
    limit = criteria.HELD_OUT_FALL_Z * fall.std(ddof=1) / np.sqrt(len(blocks))
    for factor in (0.98, 1.02):
        new = np.ones(n)
        for block, one in zip(blocks, fall + factor * limit, strict=True):
            new[block] = np.exp(-one)
        assert new.mean() < old.mean()
        assert evidence.falls_significantly(errors(old), errors(new)) == (factor > 1)
    assert not evidence.falls_significantly(errors(old), errors(old))
    assert evidence.falls_significantly(errors(old), errors(0.9 * old))
    assert not evidence.falls_significantly(errors(0.9 * old), errors(old))

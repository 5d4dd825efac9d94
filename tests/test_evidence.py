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
from phsi_opt.model_error.standard_errors import Source
from phsi_opt.statistics import autocorrelation_time, effective_sample_share


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
        record=SimpleNamespace(
            has_correlated_noise=False, shows_correlated_noise=False
        ),
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
    # What an effect leaves lasts as noise only where noise did so before.
    before = judged(9.0, 1.0)
    assert not evidence.is_white_noise(lasting)
    assert not evidence.is_explained(before, lasting, judged(5.0, 1.0))
    before.record.shows_correlated_noise = True
    assert evidence.is_explained(before, lasting, judged(5.0, 1.0))
    assert evidence.is_white_noise(judged(small, 2.0))
    assert not evidence.is_white_noise(judged(small * 1.002, 2.0))


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


def test_most_of_a_failing_error_is_enough_where_a_record_is_brief(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(evidence, "falls_significantly", lambda old, new: False)
    most = criteria.EXPLAINED_IF_PROPOSED
    for share, expected in ((1.01 * most, True), (0.99 * most, False)):
        left = float(np.sqrt(25 - share * 16))
        found = falls_or_explains_most(judged(5.0, 3.0), judged(left, 3.0))
        assert found == expected


def test_a_fall_is_looked_at_in_one_block_per_two_independent_values(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    used: list[int] = []
    means = evidence._block_means

    def noted(squares: np.ndarray, n_blocks: int) -> np.ndarray:
        used.append(n_blocks)
        return means(squares, n_blocks)

    monkeypatch.setattr(evidence, "_block_means", noted)
    values = iter([26.0, 1e9, 1e9, 1e9, 0.0, 1e9])
    monkeypatch.setattr(evidence, "independent_samples", lambda _: next(values))
    squares = np.random.default_rng(0).uniform(1.0, 2.0, 400)
    for _ in range(3):
        evidence.falls_significantly(errors(squares), errors(squares))
    most, fewest = criteria.MOST_BLOCKS, criteria.FEWEST_BLOCKS
    assert fewest < 13 < most
    assert used == [13, 13, most, most, fewest, fewest]


def test_the_deviance_of_a_free_run_sums_the_channels_that_are_off() -> None:
    table = pd.DataFrame({"rmse": [0.5, 0.0, 3.0], "n_samples": [40, 50, 7]})
    found = evidence.free_run_deviance(SimpleNamespace(table=table))  # type: ignore[arg-type]
    assert found == pytest.approx(2 * (40 * np.log(0.5) + 7 * np.log(3.0)))


def two_runs(seed: int, n_states: int, scale: float) -> list[np.ndarray]:
    """Residuals that last from sample to sample, of two runs."""
    rng = np.random.default_rng(seed)
    return [scale * np.cumsum(rng.normal(size=(n, n_states)), axis=0) for n in (90, 60)]


def test_the_share_of_a_change_is_that_of_the_runs_in_the_channels_both_have() -> None:
    before, after = two_runs(0, 2, 1.0), two_runs(1, 3, 0.5)
    after[0][::5, 1] = np.nan
    for run in after:
        run[:, 1] *= 300.0
    sizes = np.sqrt(np.nanmean(np.concatenate(after)[:, :2] ** 2, axis=0))
    changes, left = [], []
    for old_run, new_run in zip(before, after, strict=True):
        changes.append(np.nan_to_num((old_run - new_run[:, :2]) / sizes))
        left.append(np.nan_to_num(new_run[:, :2] / sizes))
    expected = effective_sample_share(changes, left)
    assert 0.0 < expected < 1.0
    old: Any = SimpleNamespace(residuals=before, fit=SimpleNamespace(names=("k",)))
    fit = SimpleNamespace(names=("k", "a"), std_error_source=Source.NOISE)
    new: Any = SimpleNamespace(residuals=after, fit=fit)
    assert evidence.share_of_change(old, new) == pytest.approx(expected)
    # The other way round the larger model loses a channel.
    assert evidence._share_of_runs(new, old) == evidence._share_of_runs(
        SimpleNamespace(residuals=[run[:, :2] for run in after]),  # type: ignore[arg-type]
        old,
    )
    never = [run.copy() for run in after]
    for run in never:
        run[:, 1] = np.nan
    alone = [run[:, :1] for run in after]
    assert (
        evidence._share_of_runs(
            SimpleNamespace(residuals=before),  # type: ignore[arg-type]
            SimpleNamespace(residuals=never),  # type: ignore[arg-type]
        )
        == pytest.approx(
            evidence._share_of_runs(
                SimpleNamespace(residuals=[run[:, :1] for run in before]),  # type: ignore[arg-type]
                SimpleNamespace(residuals=alone),  # type: ignore[arg-type]
            )
        )
    )


def test_the_share_of_a_change_is_at_most_that_of_what_the_larger_model_has_more() -> (
    None
):
    before, after = two_runs(0, 2, 1.0), two_runs(1, 2, 0.5)
    asked: list[list[str]] = []

    def share(names: list[str]) -> float:
        asked.append(names)
        return of_parameters

    old: Any = SimpleNamespace(residuals=before, fit=SimpleNamespace(names=("k",)))
    fit = SimpleNamespace(
        names=("k", "a", "b"),
        std_error_source=Source.TRAJECTORIES,
        independent_share=share,
    )
    new: Any = SimpleNamespace(residuals=after, fit=fit)
    of_runs = evidence._share_of_runs(old, new)
    for factor in (0.5, 2.0, np.nan):
        of_parameters = factor * of_runs
        expected = of_runs * np.fmin(factor, 1.0)
        assert evidence.share_of_change(old, new) == pytest.approx(expected)
    assert asked == [["a", "b"]] * 3
    fit.names = ("k",)
    assert evidence.share_of_change(old, new) == pytest.approx(of_runs)
    assert len(asked) == 3

"""Residuals correlated in time, and the tails of distributions."""

from collections.abc import Iterator

import numpy as np
import pytest
from scipy import signal, stats
from scipy.signal import lfilter
from statsmodels.stats.diagnostic import acorr_ljungbox

from phsi_opt import statistics
from phsi_opt.statistics import (
    autocorrelation_time,
    ljung_box,
    local_maxima,
)

N = 1000
KEPT = 0.9  # share of the last residual that the next one keeps


def residuals(n_draws: int) -> Iterator[np.ndarray]:
    rng = np.random.default_rng(0)
    for noise in rng.normal(size=(n_draws, N)):
        yield lfilter([1.0], [1.0, -KEPT], noise)


def test_a_sum_spreads_with_the_correlation_of_what_is_summed() -> None:
    white = np.random.default_rng(0).normal(size=N)
    # one lag more or less: 2/sqrt(N), a few times
    assert autocorrelation_time([white]) == pytest.approx(1.0, abs=0.2)
    times = [autocorrelation_time([r]) for r in residuals(40)]
    assert np.median(times) == pytest.approx((1 + KEPT) / (1 - KEPT), rel=0.2)


def test_trajectories_are_independent_of_each_other() -> None:
    white = np.random.default_rng(0).normal(size=N)
    alone = autocorrelation_time([white])
    assert autocorrelation_time([white, np.zeros(5)]) == alone


def test_a_value_is_never_worth_more_than_an_independent_one() -> None:
    alternating = (-1.0) ** np.arange(N)
    assert autocorrelation_time([alternating]) == 1.0
    assert autocorrelation_time([]) == autocorrelation_time([np.zeros(3)]) == 1.0


def test_a_plateau_counts_as_a_peak_as_a_whole_or_by_its_last_value() -> None:
    values = np.array([2.0, 1.0, 3.0, 3.0, 0.0, 1.0])
    np.testing.assert_array_equal(
        local_maxima(values), [True, False, True, True, False, True]
    )
    np.testing.assert_array_equal(
        local_maxima(values, last_of_plateau=True),
        [True, False, False, True, False, True],
    )


def test_the_ends_of_a_sequence_have_one_neighbour_only() -> None:
    assert local_maxima(np.array([-5.0])).tolist() == [True]
    assert local_maxima(np.array([-1.0, -2.0])).tolist() == [True, False]
    assert not len(local_maxima(np.zeros(0)))


def test_p_values_of_white_noise_are_uniform() -> None:
    rng = np.random.default_rng(0)
    of_noise = [ljung_box([rng.normal(size=200)]) for _ in range(400)]
    # 400 draws know a share of 5 % to 1.1 %; three and a half of those.
    assert np.mean(np.array(of_noise) < 0.05) == pytest.approx(0.05, abs=0.04)


def test_residuals_that_keep_a_share_of_their_neighbours_are_not_white() -> None:
    slow = next(residuals(1))
    assert ljung_box([slow]) < 1e-6
    assert np.isnan(ljung_box([np.ones(3)]))


def test_tails_and_limits_are_those_of_scipy() -> None:
    # The same routines stand behind both, so that all bits are equal.
    for value in (0.0, 0.3, 4.2, 60.0):
        assert statistics.normal_tail(value) == stats.norm.sf(value)
        assert statistics.normal_density(value) == stats.norm.pdf(value)
        for freedom in (1, 7, 300):
            expected = stats.chi2.sf(value, freedom)
            assert statistics.chi_square_tail(value, freedom) == expected
    freedom_of_each = np.array([1.0, 2.5, 1e6, np.inf])
    for level in (0.4, 0.025, 1e-6):
        assert statistics.normal_limit(level) == stats.norm.isf(level)
        assert statistics.chi_square_limit(level, 3) == stats.chi2.isf(level, 3)
        assert statistics.f_limit(level, 1, 12.5) == stats.f.isf(level, 1, 12.5)
        np.testing.assert_array_equal(
            statistics.student_limit(level, freedom_of_each),
            stats.t.isf(level, freedom_of_each),
        )


def test_productsself_convolved_are_the_convolution_of_scipy() -> None:
    values = np.random.default_rng(6).normal(size=157)
    np.testing.assert_array_equal(
        statistics.self_convolved(values), signal.fftconvolve(values, values[::-1])
    )
    assert len(statistics.self_convolved(np.zeros(0))) == 0


def direct_time(series: list[np.ndarray]) -> float:
    """The time by its definition, sums written out."""
    covariances = []
    for lag in range(max(map(len, series)) + 1):
        pairs = [s[lag:] @ s[: len(s) - lag] for s in series if len(s) > lag]
        covariances.append(float(sum(pairs)))
    tau = -1.0
    for first in range(0, len(covariances) - 1, 2):
        pair = (covariances[first] + covariances[first + 1]) / covariances[0]
        if pair <= 0:
            break
        tau += 2 * pair
    return max(tau, 1.0)


@pytest.mark.parametrize("lengths", [(40, 25), (31,), (7, 6, 5), (2,)])
def test_the_time_is_that_of_its_definition(lengths: tuple[int, ...]) -> None:
    times = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        series = []
        for n in lengths:
            series.append(lfilter([1.0], [1.0, -0.8], rng.normal(size=n)))
        found = autocorrelation_time(series)
        assert found == pytest.approx(direct_time(series), rel=1e-9)
        times.append(found)
    assert max(times) > 1.0


def test_a_series_that_is_correlated_to_its_end_has_all_of_its_pairs() -> None:
    lasting = np.ones(7)
    pairs = sum((7 - lag) / 7 for lag in range(7))  # the eighth, at lag 7, is zero
    assert autocorrelation_time([lasting]) == pytest.approx(2 * pairs - 1)
    small = 1e-3 * lasting
    assert autocorrelation_time([small]) == pytest.approx(2 * pairs - 1)
    assert autocorrelation_time([np.zeros(5)]) == 1.0
    assert autocorrelation_time([]) == 1.0


@pytest.mark.parametrize("n", [5, 12, 49, 50, 54, 55, 60, 200])
def test_ljung_and_boxs_test_is_that_of_statsmodels(n: int) -> None:
    residual = lfilter([1.0], [1.0, -0.3], np.random.default_rng(n).normal(size=n))
    residual -= residual.mean()  # statsmodels takes the mean away
    known = acorr_ljungbox(residual, lags=[min(10, n // 5)])
    assert ljung_box([residual]) == pytest.approx(known["lb_pvalue"].iloc[0], rel=1e-9)


def test_ljung_and_boxs_statistics_of_several_series_are_added() -> None:
    rng = np.random.default_rng(4)
    series = [
        values - values.mean() for values in (rng.normal(size=40), rng.normal(size=23))
    ]
    q = sum(
        acorr_ljungbox(one, lags=[len(one) // 5])["lb_stat"].iloc[0] for one in series
    )
    expected = stats.chi2.sf(q, 8 + 4)
    assert ljung_box(series) == pytest.approx(expected, rel=1e-9)
    still = [np.zeros(40), *series]  # adds its lags, and no correlation
    assert ljung_box(still) == pytest.approx(stats.chi2.sf(q, 8 + 8 + 4), rel=1e-9)
    tiny = [1e-3 * one for one in series]
    assert ljung_box(tiny) == pytest.approx(expected, rel=1e-9)
    assert np.isnan(ljung_box([np.ones(4)]))


def test_the_profiled_deviance_is_that_of_normal_residuals_with_their_own_noise() -> (
    None
):
    rng = np.random.default_rng(2)
    channels = [2.0 * rng.normal(size=50), 0.1 * rng.normal(size=30)]
    squares = np.array([float(r @ r) for r in channels] + [0.0])
    n_values = np.array([50, 30, 0])
    found = statistics.profiled_deviance(squares, n_values)
    densities = [
        stats.norm.logpdf(r, 0, np.sqrt(np.mean(r**2))).sum() for r in channels
    ]
    constant = (50 + 30) * (1 + np.log(2 * np.pi))
    assert found == pytest.approx(-2 * sum(densities) - constant, rel=1e-12)
    exact = statistics.profiled_deviance(np.zeros(1), np.array([10]))
    assert np.isfinite(exact) and exact < -1000

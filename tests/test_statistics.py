"""Residuals correlated in time: what chance explains depends on the trace."""

from collections.abc import Iterator

import numpy as np
import pytest
from scipy import signal, stats
from scipy.signal import lfilter
from scipy.stats import chi2

from phsi_opt import statistics
from phsi_opt.statistics import (
    autocorrelation_time,
    effective_sample_share,
    false_discovery_adjusted,
    likelihood_ratio_p_value,
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


@pytest.mark.parametrize(
    ("period", "least", "most"), [(1000.0, 0.03, 0.12), (6.0, 0.5, 1.0)]
)
def test_a_slow_error_of_the_model_imitates_slow_traces_and_not_fast_ones(
    period: float, least: float, most: float
) -> None:
    trace = np.sin(2 * np.pi * np.arange(N) / period)
    shares = []
    p_values = []
    for r in residuals(200):
        left = r - trace * (trace @ r) / (trace @ trace)
        size = left.std()
        change = (r - left)[:, None] / size
        share = effective_sample_share([change], [left[:, None] / size])
        likelihood_ratio = N * np.log((r @ r) / (left @ left))
        shares.append(share)
        p_values.append(chi2.sf(likelihood_ratio * share, 1))
    assert least < np.median(shares) <= most
    # Nothing is hidden: one draw in twenty is below 5 %, give or take three standard
    # errors of 200 draws, and the error of a variance that is itself estimated.
    assert np.mean(np.array(p_values) < 0.05) < 0.13


def test_nothing_explained_needs_no_share() -> None:
    assert effective_sample_share([np.zeros((4, 1))], [np.ones((4, 1))]) == 1.0


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


def test_p_values_of_true_hypotheses_are_uniform() -> None:
    rng = np.random.default_rng(0)
    of_noise = [ljung_box([rng.normal(size=200)]) for _ in range(400)]
    falls = rng.chisquare(2, size=400)
    of_falls = [likelihood_ratio_p_value(fall, 2) for fall in falls]
    for p_values in (of_noise, of_falls):
        # 400 draws know a share of 5 % to 1.1 %; three and a half of those.
        assert np.mean(np.array(p_values) < 0.05) == pytest.approx(0.05, abs=0.04)
    assert likelihood_ratio_p_value(-1.0, 1) == 1.0


def test_residuals_that_keep_a_share_of_their_neighbours_are_not_white() -> None:
    slow = next(residuals(1))
    assert ljung_box([slow]) < 1e-6
    assert np.isnan(ljung_box([np.ones(3)]))


def test_adjusted_p_values_keep_their_order_and_count_all() -> None:
    adjusted = false_discovery_adjusted([0.01, np.nan, 0.04, 0.02])
    np.testing.assert_allclose(adjusted, [0.04, 1.0, 0.16 / 3, 0.04])


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


def test_ranks_and_false_discoveries_are_those_of_scipy() -> None:
    rng = np.random.default_rng(5)
    values = np.round(rng.normal(size=200), 1)  # with ties
    np.testing.assert_array_equal(statistics.mean_ranks(values), stats.rankdata(values))
    p_values = np.round(rng.random(40) ** 3, 3)
    np.testing.assert_array_equal(
        statistics.false_discovery_adjusted(list(p_values)),
        stats.false_discovery_control(p_values),
    )


def test_productsself_convolved_are_the_convolution_of_scipy() -> None:
    values = np.random.default_rng(6).normal(size=157)
    np.testing.assert_array_equal(
        statistics.self_convolved(values), signal.fftconvolve(values, values[::-1])
    )
    assert len(statistics.self_convolved(np.zeros(0))) == 0

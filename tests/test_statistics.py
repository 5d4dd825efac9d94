"""Residuals correlated in time, tails of distributions, and what counts as noise."""

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter
from statsmodels.stats.diagnostic import acorr_ljungbox

from phsi_opt import statistics
from phsi_opt.statistics import autocorrelation_time, ljung_box, local_maxima

N = 1000
KEPT = 0.9  # share of the last residual that the next one keeps


def lasting(noise: np.ndarray, kept: float = KEPT) -> np.ndarray:
    return np.asarray(lfilter([1.0], [1.0, -kept], noise))


def test_a_value_is_never_worth_more_than_an_independent_one() -> None:
    # Too few values tell no correlation.
    assert np.isnan(ljung_box([np.ones(4)]))
    for series in ([(-1.0) ** np.arange(N)], [], [np.zeros(3)]):
        assert autocorrelation_time(series) == 1.0


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
        series = [lasting(rng.normal(size=n), 0.8) for n in lengths]
        found = autocorrelation_time(series)
        assert found == pytest.approx(direct_time(series), rel=1e-9)
        times.append(found)
    assert max(times) > 1.0


@pytest.mark.parametrize(("values", "whole", "last"), [
    ([2.0, 1.0, 3.0, 3.0, 0.0, 1.0], [1, 0, 1, 1, 0, 1], [1, 0, 0, 1, 0, 1]),
    ([-5.0], [1], [1]),
    ([-1.0, -2.0], [1, 0], [1, 0]),
    ([], [], []),
])  # fmt: skip
def test_a_plateau_counts_as_a_peak_as_a_whole_or_by_its_last_value(
    values: list[float], whole: list[int], last: list[int]
) -> None:
    assert local_maxima(np.array(values)).tolist() == whole
    assert local_maxima(np.array(values), last_of_plateau=True).tolist() == last


def test_tails_and_limits_are_those_of_scipy() -> None:
    # The same routines stand behind both, so that all bits are equal.
    for value in (0.0, 0.3, 4.2, 60.0):
        for freedom in (1, 7, 300):
            expected = stats.chi2.sf(value, freedom)
            assert statistics.chi_square_tail(value, freedom) == expected
    for level in (0.4, 0.025, 1e-6):
        assert statistics.chi_square_limit(level, 3) == stats.chi2.isf(level, 3)


@pytest.mark.parametrize("n", [5, 12, 49, 50, 54, 55, 60, 200])
def test_ljung_and_boxs_test_is_that_of_statsmodels(n: int) -> None:
    residual = lasting(np.random.default_rng(n).normal(size=n), 0.3)
    residual -= residual.mean()  # statsmodels takes the mean away
    known = acorr_ljungbox(residual, lags=[min(10, n // 5)])
    assert ljung_box([residual]) == pytest.approx(known["lb_pvalue"].iloc[0], rel=1e-9)


def test_ljung_and_boxs_statistics_of_several_series_are_added() -> None:
    rng = np.random.default_rng(4)
    noise = [rng.normal(size=n) for n in (40, 23)]
    series = [values - values.mean() for values in noise]
    q = 0.0
    for one in series:
        q += acorr_ljungbox(one, lags=[len(one) // 5])["lb_stat"].iloc[0]
    expected = stats.chi2.sf(q, 8 + 4)
    assert ljung_box(series) == pytest.approx(expected, rel=1e-9)
    assert ljung_box([1e-3 * one for one in series]) == pytest.approx(expected)
    still = [np.zeros(40), *series]  # adds its lags, and no correlation
    assert ljung_box(still) == pytest.approx(stats.chi2.sf(q, 8 + 8 + 4), rel=1e-9)

"""Evidence from correlated residuals: what a candidate explains by chance depends on
its trace, too.
"""

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from phsi_opt.comparison.model_selection import falls_or_most
from phsi_opt.statistics import independent_share, spread_together

N = 1000
KEPT = 0.9  # share of the last residual that the next one keeps


def residuals(n_draws: int) -> Iterator[np.ndarray]:
    rng = np.random.default_rng(0)
    for noise in rng.normal(size=(n_draws, N)):
        yield lfilter([1.0], [1.0, -KEPT], noise)


def test_a_sum_spreads_with_the_correlation_of_what_is_summed() -> None:
    white = np.random.default_rng(0).normal(size=N)
    assert spread_together([white]) == pytest.approx(
        1.0, abs=0.2
    )  # one lag more or less: 2/sqrt(N), a few times
    spreads = [spread_together([r]) for r in residuals(40)]
    assert np.median(spreads) == pytest.approx((1 + KEPT) / (1 - KEPT), rel=0.2)
    assert spread_together([white, np.zeros(5)]) == spread_together(
        [white]
    )  # trajectories are independent
    assert (
        spread_together([(-1.0) ** np.arange(N)]) == 1.0
    )  # never less than independent ones
    assert spread_together([]) == spread_together([np.zeros(3)]) == 1.0


@pytest.mark.parametrize(
    ("period", "least", "most"), [(1000.0, 0.03, 0.12), (6.0, 0.5, 1.0)]
)
def test_a_slow_error_of_the_model_imitates_slow_traces_and_not_fast_ones(
    period: float, least: float, most: float
) -> None:
    trace = np.sin(2 * np.pi * np.arange(N) / period)
    shares, p = [], []
    for r in residuals(200):
        left = r - trace * (trace @ r) / (trace @ trace)
        size = left.std()
        shares.append(
            independent_share([(r - left)[:, None] / size], [left[:, None] / size])
        )
        p.append(chi2.sf(N * np.log((r @ r) / (left @ left)) * shares[-1], 1))
    assert least < np.median(shares) <= most
    # Nothing is hidden: one draw in twenty is below 5 %, give or take three standard
    # errors of 200 draws, and the error of a variance that is itself estimated.
    assert np.mean(np.array(p) < 0.05) < 0.13


def test_nothing_explained_needs_no_share() -> None:
    assert independent_share([np.zeros((4, 1))], [np.ones((4, 1))]) == 1.0


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
        accepted += falls_or_most(_Errors(old, floor), _Errors(new, floor))  # type: ignore[arg-type]
    assert accepted < 20  # 5 % are asked for
    large, half = 3 * rng.normal(size=12), rng.normal(size=12)
    assert falls_or_most(_Errors(large, 0.1), _Errors(half, 0.1))  # type: ignore[arg-type]

"""The noise that residuals show, against its definition and draws."""

from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.estimation.noise_estimation import NoiseIteration
from phsi_opt.transcription.grid import Grid, grid_of

N_SAMPLES = 20_000
N_THETA = 3
SIGMA = np.array([0.1, 2.0])


@pytest.fixture(scope="module")
def grid() -> Grid:
    x = np.random.default_rng(0).normal(size=(N_SAMPLES, 2))
    x[::4, 1] = np.nan
    t = np.arange(N_SAMPLES, dtype=float)
    return grid_of(ph.Measurements.from_arrays(t, x, states=["q", "p"]))


def updated(grid: Grid, residual: np.ndarray, **known: Any) -> np.ndarray:
    of_program = residual * np.sqrt(2 / grid.measured.sum())
    return iteration(grid, **known).updated(SIGMA, of_program)


def iteration(
    grid: Grid,
    *is_estimated: bool,
    has_l1: bool = False,
    huber: float | None = None,
) -> NoiseIteration:
    estimated = np.array(is_estimated or (True, True))
    return NoiseIteration(grid, estimated, N_THETA, huber, has_l1)


def residuals(grid: Grid, *factors: float) -> np.ndarray:
    """Normal residuals of the measured values, of standard deviation per channel."""
    normal = np.random.default_rng(1).normal(size=len(grid.channel))
    return np.array(factors)[grid.channel] * normal


def test_the_noise_is_the_rms_residual_over_the_degrees_of_freedom(grid: Grid) -> None:
    residual = residuals(grid, 1.0, 1.0)
    n_values = grid.measured.sum()
    freedom = n_values - N_THETA - 2  # two starting states of one trajectory
    squares = [np.mean(residual[grid.channel == k] ** 2) for k in range(2)]
    expected = SIGMA * np.sqrt(np.array(squares) * n_values / freedom)
    np.testing.assert_allclose(updated(grid, residual), expected, rtol=1e-12)


def test_residuals_cut_at_hubers_limit_show_the_noise_of_the_uncut_ones(
    grid: Grid,
) -> None:
    residual = np.clip(residuals(grid, 1.0, 1.0), -1.345, 1.345)
    # 15 000 values tell a standard deviation to 0.6 %; uncorrected it is 16 % too low.
    found = updated(grid, residual, huber=1.345)
    np.testing.assert_allclose(found, SIGMA, rtol=0.02)


def test_a_common_factor_of_all_noise_leaves_the_estimates_but_not_under_l1(
    grid: Grid,
) -> None:
    doubled, one_doubled = 2 * SIGMA, SIGMA * np.array([1.0, 2.0])
    assert iteration(grid).change(SIGMA, doubled) == pytest.approx(0, abs=1e-12)
    assert iteration(grid, has_l1=True).change(SIGMA, doubled) == np.log(2)
    assert iteration(grid, huber=1.345).change(SIGMA, doubled) == np.log(2)
    assert iteration(grid, False, True).change(SIGMA, doubled) == np.log(2)
    assert iteration(grid).change(SIGMA, one_doubled) == pytest.approx(np.log(2))
    assert iteration(grid, has_l1=True).change(SIGMA, 1.001 * SIGMA) < 0.0011

"""The noise that residuals show, against its definition and draws."""

from dataclasses import replace

import numpy as np
import pytest

from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.noise_estimation import NoiseIteration
from phsi_opt.transcription.grid import Grid, grid_of

N_SAMPLES = 20_000
N_THETA = 3
SIGMA = np.array([0.1, 2.0])


@pytest.fixture
def grid() -> Grid:
    t = np.arange(N_SAMPLES, dtype=float)
    x = np.random.default_rng(0).normal(size=(N_SAMPLES, 2))
    x[::4, 1] = np.nan
    return grid_of(Measurements.from_arrays(t, x, states=["q", "p"]))


def residuals(grid: Grid, factors: np.ndarray) -> np.ndarray:
    """Normal residuals of the measured values, of standard deviation per channel."""
    channel = np.nonzero(grid.measured)[1]
    normal = np.random.default_rng(1).normal(size=len(channel))
    return factors[channel] * normal


def test_the_noise_is_the_rms_residual_over_the_degrees_of_freedom(grid: Grid) -> None:
    residual = residuals(grid, np.ones(2))
    n_values = grid.measured.sum()
    noise = iteration(grid).updated(SIGMA, residual * np.sqrt(2 / n_values))
    freedom = n_values - N_THETA - 2  # two starting states of one trajectory
    channel = np.nonzero(grid.measured)[1]
    for k in range(2):
        mean_square = np.mean(residual[channel == k] ** 2)
        expected = SIGMA[k] * np.sqrt(mean_square * n_values / freedom)
        assert noise[k] == pytest.approx(expected, rel=1e-12)


def test_residuals_cut_at_hubers_limit_show_the_noise_of_the_uncut_ones(
    grid: Grid,
) -> None:
    residual = np.clip(residuals(grid, np.ones(2)), -1.345, 1.345)
    cut = replace(iteration(grid), huber=1.345)
    noise = cut.updated(SIGMA, residual * np.sqrt(2 / grid.measured.sum()))
    # 15 000 values tell a standard deviation to 0.6 %; uncorrected it is 16 % too low.
    np.testing.assert_allclose(noise, SIGMA, rtol=0.02)


def iteration(
    grid: Grid, is_estimated: tuple[bool, bool] = (True, True), has_l1: bool = False
) -> NoiseIteration:
    return NoiseIteration(grid, np.array(is_estimated), N_THETA, None, has_l1)


def test_known_noise_is_not_updated(grid: Grid) -> None:
    n_values = grid.measured.sum()
    of_program = residuals(grid, np.array([2.0, 3.0])) * np.sqrt(2 / n_values)
    updated = iteration(grid, (False, True)).updated(SIGMA, of_program)
    assert updated[0] == SIGMA[0]
    assert updated[1] == pytest.approx(3 * SIGMA[1], rel=0.02)


def test_a_common_factor_of_all_noise_leaves_the_estimates_but_not_under_l1(
    grid: Grid,
) -> None:
    doubled = 2 * SIGMA
    one = np.array([1.0, 2.0])
    assert iteration(grid).change(SIGMA, doubled) == pytest.approx(0, abs=1e-12)
    assert iteration(grid, has_l1=True).change(SIGMA, doubled) == np.log(2)
    assert iteration(grid, (False, True)).change(SIGMA, doubled) == np.log(2)
    assert iteration(grid).change(SIGMA, SIGMA * one) == pytest.approx(np.log(2))
    assert iteration(grid, has_l1=True).change(SIGMA, 1.001 * SIGMA) < 0.0011

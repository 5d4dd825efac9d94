"""Windows of a grid: where it is cut, and where not."""

import numpy as np
import pytest

from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.multiple_shooting import SHORTEST_WINDOW, cut_into_windows
from phsi_opt.transcription.grid import Grid, grid_of, steps_per_gap

N_SAMPLES = 101


@pytest.fixture
def grid() -> Grid:
    t = np.linspace(0.0, 5.0, N_SAMPLES)
    x = np.column_stack([np.cos(t), np.sin(t)])
    return grid_of(Measurements.from_arrays(t, x, states=["q", "p"]), 2)


def test_windows_cut_a_grid_at_samples_and_leave_no_short_piece(grid: Grid) -> None:
    pieces = cut_into_windows(grid, 1.0)
    gone = np.setdiff1d(grid.begin, pieces.begin)
    assert grid.sample[gone].all()
    # Windows of 1.0 in a record of 5.0; the sample at 5.0 alone is no window.
    np.testing.assert_allclose(grid.t[gone], [0.95, 1.95, 2.95, 3.95])
    assert [int(n.max()) for n in steps_per_gap(grid)] == [2]


def test_short_windows_have_the_least_number_of_samples(grid: Grid) -> None:
    pieces = cut_into_windows(grid, 0.1)
    n_cuts = grid.n_intervals - pieces.n_intervals
    assert 0 < n_cuts < N_SAMPLES // SHORTEST_WINDOW


def test_a_window_longer_than_the_record_cuts_nothing(grid: Grid) -> None:
    assert cut_into_windows(grid, 6.0).n_intervals == grid.n_intervals

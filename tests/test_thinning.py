"""A part of each record in time, and fewer samples of it."""

from typing import Any

import numpy as np
import pytest

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError

T = np.arange(12.0) / 4  # quarters: all sums and means below are exact


def measurements(**options: Any) -> Measurements:
    x = np.column_stack([T**2, np.where(T == 0.25, np.nan, -T)])
    u = np.repeat([1.0, 5.0, 2.0], 4)
    settings: dict[str, Any] = {
        "states": ["q", "p"],
        "inputs": ["u"],
        "noise": {"q": 0.4},
        "hold": "zero",
    }
    return Measurements.from_arrays([T, T + 1], [x, x], [u, u], **(settings | options))


def test_a_part_in_time_keeps_the_clock_and_both_ends() -> None:
    part = measurements().between(1.0, 2.0)
    for run in part:
        np.testing.assert_array_equal(run.t, [1, 1.25, 1.5, 1.75, 2])
    np.testing.assert_array_equal(part.trajectories[0].x[:, 0], np.square(run.t))
    np.testing.assert_array_equal(part.trajectories[1].x[:, 0], np.square(run.t - 1))
    assert part.noise == {"q": 0.4}
    whole = measurements()
    assert whole.between(None, None).digest == whole.digest


@pytest.mark.parametrize(
    ("begin", "end", "message"),
    [
        (3.0, 9.0, "trajectory 'run 1' has 0 samples between 3 and 9.*from 0 to 2.75"),
        (
            0.0,
            1.0,
            "trajectory 'run 2' has 1 samples between 0 and 1; expected at least",
        ),
        (0.1, 0.2, "trajectory 'run 1' has 0 samples"),
        (2.0, 1.0, "first time must be less than the last"),
        ("0", 1.0, "'0' is no time"),
        (np.nan, 1.0, "nan is no time"),
        (True, 2.0, "True is no time"),
    ],
)
def test_a_part_that_cannot_be_had_is_refused(
    begin: Any, end: Any, message: str
) -> None:
    with pytest.raises(DataError, match=f"(?s){message}"):
        measurements().between(begin, end)


def test_the_mean_of_groups_stands_at_their_mean_time() -> None:
    thin = measurements(hold="linear").thinned(2)
    run = thin.trajectories[0]
    np.testing.assert_array_equal(run.t, (T[::2] + T[1::2]) / 2)
    np.testing.assert_array_equal(run.x[:, 0], (T[::2] ** 2 + T[1::2] ** 2) / 2)
    assert np.isnan(run.x[:, 1]).tolist() == [True] + [False] * 5
    np.testing.assert_array_equal(run.u[:, 0], [1, 1, 5, 5, 2, 2])
    assert thin.noise is not None
    assert thin.noise["q"] == 0.4 / np.sqrt(2)


def test_the_mean_removes_what_picking_would_turn_into_something_slow() -> None:
    t = np.arange(100) / 100
    fast = np.where(np.arange(100) % 2, -1.0, 1.0)
    data = Measurements.from_arrays(t, fast, states=["q"])
    np.testing.assert_array_equal(data.thinned(10).trajectories[0].x, 0)
    picked = data.thinned(10, by="picking").trajectories[0]
    np.testing.assert_array_equal(picked.x, 1)
    np.testing.assert_array_equal(picked.t, t[::10])


def test_a_held_input_is_averaged_from_each_new_sample_to_the_next() -> None:
    run = measurements().thinned(4).trajectories[0]
    # new samples at 3/8, 11/8, 19/8; the input steps at 1 and 2 and ends at 11/4
    np.testing.assert_array_equal(run.t, [0.375, 1.375, 2.375])
    expected = [0.625 * 1 + 0.375 * 5, 0.625 * 5 + 0.375 * 2, 2.0]
    np.testing.assert_allclose(run.u[:, 0], expected, rtol=1e-15)  # sums of floats


def test_what_a_force_passes_on_stays_with_the_mean_of_a_held_input() -> None:
    """The momentum between new samples is the force times the time, whatever n."""
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.5, 1.5, 60))
    u = rng.normal(size=60)
    data = Measurements.from_arrays(
        t, np.zeros(60), u, states=["p"], inputs=["u"], hold="zero"
    )
    thin = data.thinned(7).trajectories[0]
    fine = np.linspace(thin.t[0], thin.t[-1], 200_001)
    held = u[np.searchsorted(t, fine, side="right") - 1]
    momentum = np.mean(held) * (thin.t[-1] - thin.t[0])
    passed = np.sum(thin.u[:-1, 0] * np.diff(thin.t))
    # A step between two of the 200 001 points is off by at most their distance.
    assert passed == pytest.approx(momentum, abs=5e-3)


def test_one_sample_a_group_changes_nothing() -> None:
    whole = measurements()
    assert whole.thinned(1).digest == whole.digest
    assert whole.thinned(1, by="picking").digest == whole.digest


def test_samples_that_fill_no_group_are_left_out_of_means_alone() -> None:
    data = measurements()
    assert [run.n_samples for run in data.thinned(5)] == [2, 2]
    assert [run.n_samples for run in data.thinned(5, by="picking")] == [3, 3]


@pytest.mark.parametrize(
    ("n", "by", "message"),
    [
        (0, "mean", r"thinned\(0\): expected how many"),
        (2.5, "mean", r"thinned\(2.5\)"),
        (True, "mean", r"thinned\(True\)"),
        (2, "means", "by='means' is unknown; .*Did you mean 'mean'"),
        (
            7,
            "mean",
            r"'run 1' has 12 samples, too few for thinned\(7\): 1 would be left",
        ),
        (12, "picking", r"too few for thinned\(12\): 1 would be left"),
    ],
)
def test_thinning_that_cannot_be_done_is_refused(n: Any, by: Any, message: str) -> None:
    with pytest.raises(DataError, match=message):
        measurements().thinned(n, by)

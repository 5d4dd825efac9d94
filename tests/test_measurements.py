"""What Measurements promises: it reads what was recorded, refuses what cannot be used,
and changes nothing.
"""

import hashlib
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph

# All comparisons are exact: reading, joining and splitting copy numbers and never
# compute with them.


def record(n_runs: int = 3, seed: int = 0) -> ph.Measurements:
    """Irregularly sampled runs of different lengths with gaps, two states and one
    input.
    """
    rng = np.random.default_rng(seed)
    ts = [np.cumsum(rng.uniform(0.01, 0.2, size=10 + 3 * k)) for k in range(n_runs)]
    xs = [rng.normal(size=(len(t), 2)) for t in ts]
    for x in xs:
        x[rng.integers(len(x), size=2), 1] = np.nan
    us = [rng.normal(size=(len(t), 1)) for t in ts]
    units = {"q": "m", "u": "N", "t": "s"}
    return ph.Measurements.from_arrays(
        ts,
        xs,
        us,
        states=["q", "p"],
        inputs=["u"],
        units=units,
        noise={"q": 0.1},
        hold="zero",
    )


def assert_same(a: ph.Measurements, b: ph.Measurements) -> None:
    for what in ("states", "inputs", "hold", "noise", "units"):
        assert getattr(a, what) == getattr(b, what)
    assert [run.name for run in a] == [run.name for run in b]
    for what in "txu":
        np.testing.assert_array_equal(a.stacked(what), b.stacked(what))


# ---- there and back ----


@pytest.mark.parametrize("separator", [",", ";", "\t", None])
def test_a_table_gives_back_exactly_the_numbers_that_were_written(
    tmp_path: Path, separator: str | None
) -> None:
    data = record()
    table = data.to_dataframe()
    assert list(table.columns) == ["trajectory", "t", "q", "p", "u"]
    options: dict[str, Any] = {
        **{"time": "t", "states": ["q", "p"], "inputs": ["u"]},
        **{"trajectory": "trajectory", "hold": "zero"},
        **{"units": dict(data.units), "noise": data.noise},
    }
    if separator is None:
        assert_same(ph.Measurements.from_dataframe(table, **options), data)
    else:
        table.to_csv(tmp_path / "bench.csv", index=False, sep=separator)
        assert_same(ph.Measurements.from_csv(tmp_path / "bench.csv", **options), data)


# ---- arrays and pairs ----


def test_arrays_of_the_user_are_neither_changed_nor_shared() -> None:
    t, x, u = np.arange(3.0), np.ones((3, 1)), np.zeros((3, 1))
    units, noise = {"q": "m"}, {"q": 0.1}
    data = ph.Measurements.from_arrays(t, x, u, states=["q"], units=units, noise=noise)
    t[0], x[0], u[0], units["q"], noise["q"] = -1, -1, -1, "km", 7.0
    run = data.trajectories[0]
    assert (run.t[0], run.x[0, 0], run.u[0, 0]) == (0, 1, 0)
    assert (dict(data.units), data.noise) == ({"t": "", "q": "m", "u1": ""}, {"q": 0.1})


def test_the_record_is_read_only() -> None:
    data = record()
    for run in data:
        for array in (run.t, run.x, run.u):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 0
    with pytest.raises(TypeError):
        data.units["q"] = "km"  # type: ignore[index]
    with pytest.raises(TypeError):
        data.noise["q"] = 1.0  # type: ignore[index]
    with pytest.raises(AttributeError):
        data.hold = "linear"  # type: ignore[misc]


def test_masked_entries_are_missing_samples() -> None:
    x = np.ma.masked_array([1.0, -999.0, 3.0], mask=[False, True, False])
    data = ph.Measurements.from_arrays([0, 1, 2], x, states=["q"])
    np.testing.assert_array_equal(data.trajectories[0].x, [[1], [np.nan], [3]])


@pytest.mark.parametrize(("changes", "message"), [
    ({"t": [0, 2, 1]}, r"trajectory 'run 1': t\[2\]=1.0 does not exceed t\[1\]=2.0; .*Give each run as arrays of its own"),
    ({"t": [0, np.nan, 1]}, r"trajectory 'run 1': t\[1\] is nan"),
    ({"t": np.zeros((3, 1))}, r"trajectory 'run 1': t has the shape \(3, 1\); expected \(n_samples,\)"),
    ({"t": [0, 1]}, "x has 3 rows and t has 2; expected one row per time"),
    ({"x": np.zeros((3, 1, 1))}, r"x has the shape \(3, 1, 1\); expected \(n_samples, n_channels\)"),
    ({"x": np.zeros((3, 2))}, "trajectory 'run 1' has 2 state columns; expected 1"),
    ({"x": [[1], [2, 3], [4]]}, "x is not a regular array"),
    ({"x": np.array([1, 2, 1j])}, "x has the type complex128; expected real numbers"),
    ({"x": np.array([1, None, 2])}, "x has the type object; expected real numbers, and NaN for"),
    ({"x": [1, np.inf, 2]}, r"trajectory 'run 1': state 'q' at sample 1 \(t=1.0\) is inf; expected a finite value"),
    ({"x": [1, 2, -2e100]}, r"state 'q' at sample 2 \(t=2.0\) is -2e\+100; expected at most 1e\+100 in size"),
    ({"x": [np.nan] * 3}, r"trajectory 'run 1' has no measured value in any of the states \['q'\]"),
    ({"u": [1, np.nan, 2]}, r"input 'u1' at sample 1 \(t=1.0\) is nan; times and inputs must be known"),
    ({"u": [1, 2, 3], "inputs": ["a", "b"]}, "has 1 input column; expected 2"),
    ({"t": [0], "x": [1]}, "trajectory 'run 1' has 1 sample; expected at least 2"),
    ({"states": "q"}, "states='q' is not possible; expected Sequence"),
    ({"states": []}, "names no state"),
    ({"states": ["1q"]}, "states: '1q' cannot be used in a formula"),
    ({"states": ["t"]}, "states: the name 't' is reserved"),
    ({"states": ["dH_dq"]}, "the name 'dH_dq' is reserved"),
    ({"u": [1, 2, 3], "inputs": ["dH_d"]}, "inputs: the name 'dH_d' is reserved"),
    ({"u": [1, 2, 3], "inputs": ["q"]}, "the name 'q' is used 2 times"),
    ({"hold": "zeros"}, r"hold='zeros' is unknown; expected one of linear, zero, cubic\. Did you mean 'zero'\?"),
    ({"noise": {"q": 0}}, "noise: 'q' has the standard deviation 0; expected a positive number"),
    ({"noise": {"q": "1"}}, r"noise={'q': '1'} is not possible; expected Mapping\[str, float\]"),
    ({"noise": {"Q": 1.0}}, r"noise names the unknown 'Q'; expected one of q\. Did you mean 'q'\?"),
    ({"noise": 0.1}, "noise=0.1 is not possible; expected Mapping"),
    ({"units": {"w": "m"}}, r"units names the unknown 'w'; expected one of t, q\."),
    ({"units": {"q": None}}, r"units={'q': None} is not possible; expected Mapping\[str, str\]"),
    ({"units": ""}, "units='' is not possible; expected Mapping"),
    ({"names": ["a", "b"]}, "the lengths differ: .*'names': 2.*one entry per trajectory"),
    ({"names": [""]}, "trajectory name '' is not a text"),
    ({"names": ["a\nb"]}, "is not a text of one line"),
    ({"t": [[0, 1], [0, 1]], "x": [[1, 2]]}, "the lengths differ: {'t': 2, 'x': 1"),
    ({"t": [[0, 1], [0, 1]], "x": [[1, 2], [1, 2]], "names": ["a", "a"]}, "trajectory name 'a' is used 2 times"),
])  # fmt: skip
def test_arrays_that_cannot_be_used_are_refused(changes, message) -> None:
    good: dict[str, Any] = {"t": [0, 1, 2], "x": [1, 2, 3], "states": ["q"]}
    with pytest.raises(ph.DataError, match=message):
        ph.Measurements.from_arrays(**(good | changes))


# ---- looking, choosing, splitting ----


def test_a_trajectory_is_chosen_by_name_number_or_slice() -> None:
    data = record(3)
    for key, names in (
        (-1, ["run 3"]),
        ("run 2", ["run 2"]),
        (slice(0, 3, 2), ["run 1", "run 3"]),
    ):
        assert [run.name for run in data[key]] == names
    assert (data[0].units, data[0].hold) == (data.units, "zero")
    numbers = [data.trajectory_number(run.name) for run in data]
    assert numbers == [0, 1, 2]
    assert data.trajectory_number(2) == 2
    assert data.trajectory_number(-1) == 2
    assert type(data.trajectory_number(np.int64(1))) is int  # type: ignore[arg-type]


@pytest.mark.parametrize(("key", "message"), [
    ("run 9", r"there is no trajectory 'run 9'; expected one of 'run 1', 'run 2'\. Did you mean 'run"),
    (2, r"no trajectory 2; there are 2, counted from 0: run 1, run 2"),
    (slice(5, 9), r"data\[5:9\] selects trajectories; there are 2"),
    (slice(None, None, 10), r"data\[::10\] selects.*data.thinned\(n\)"),
    (slice(0.0, 2.5), r"data\[0.0:2.5\] selects.*between"),
    (1.5, r"trajectory 1.5 is unknown; expected a name \(run 1, run 2\)"),
])  # fmt: skip
def test_a_trajectory_that_does_not_exist_is_refused(key: Any, message: str) -> None:
    with pytest.raises(ph.DataError, match=message):
        record(2)[key]


def test_the_digest_knows_names_and_numbers_and_nothing_else() -> None:
    data = record()
    expected = hashlib.sha256()
    for run in data:
        expected.update(run.name.encode() + run.t.tobytes())
        expected.update(run.x.tobytes() + run.u.tobytes())
    assert data.digest == expected.hexdigest()
    assert data.digest is data.digest  # computed once
    assert replace(data, noise=None).digest == data.digest
    assert pickle.loads(pickle.dumps(data)).digest == data.digest
    assert record(seed=1).digest != data.digest
    assert data[:2].digest != data.digest


@pytest.mark.parametrize(
    ("fraction", "n_runs", "n_train"),
    [(0.7, 10, 7), (0.7, 3, 2), (0.01, 3, 1), (0.99, 3, 2), (0.5, 2, 1)],
)
def test_several_trajectories_are_split_by_trajectory_in_order(
    fraction: float, n_runs: int, n_train: int
) -> None:
    data = record(n_runs)
    train, test = data.split(fraction)
    assert train.trajectories == data.trajectories[:n_train]
    assert test.trajectories == data.trajectories[n_train:]
    assert (test.units, test.noise, test.hold) == (data.units, data.noise, data.hold)


@pytest.mark.parametrize(("fraction", "n_train"), [(0.7, 7), (0.001, 2), (0.999, 8)])
def test_one_trajectory_is_split_in_time_without_sharing_a_sample(
    fraction: float, n_train: int
) -> None:
    data = record(1)
    train, test = data.split(fraction)
    assert train.n_samples == n_train
    for label in "txu":
        both = np.concatenate(
            [getattr(part.trajectories[0], label) for part in (train, test)]
        )
        np.testing.assert_array_equal(both, getattr(data.trajectories[0], label))
    assert train.trajectories[0].name == test.trajectories[0].name == "run 1"
    assert not test.trajectories[0].x.flags.writeable


@pytest.mark.parametrize("fraction", [0, 1, 70, np.nan, "0.7", None])
def test_a_share_outside_zero_and_one_is_refused(fraction: Any) -> None:
    with pytest.raises(ph.DataError, match="expected a number between 0 and 1"):
        record().split(fraction)
    short = ph.Measurements.from_arrays([0, 1, 2], [1, 2, 3], states=["q"])
    said = "trajectory 'run 1' has 3 samples; a split in time needs at least 4"
    with pytest.raises(ph.DataError, match=said):
        short.split()


# ---- parts in time, and fewer samples ----

T = np.arange(12.0) / 4  # quarters: all sums and means below are exact


def measurements(**options: Any) -> ph.Measurements:
    x = np.column_stack([T**2, np.where(T == 0.25, np.nan, -T)])
    u = np.repeat([1.0, 5.0, 2.0], 4)
    settings: dict[str, Any] = {
        "states": ["q", "p"],
        "inputs": ["u"],
        "noise": {"q": 0.4},
        "hold": "zero",
    }
    return ph.Measurements.from_arrays(
        [T, T + 1], [x, x], [u, u], **(settings | options)
    )


def test_a_part_in_time_keeps_the_clock_and_both_ends() -> None:
    part = measurements().between(1.0, 2.0)
    for run in part:
        np.testing.assert_array_equal(run.t, [1, 1.25, 1.5, 1.75, 2])
    np.testing.assert_array_equal(part.trajectories[0].x[:, 0], np.square(run.t))
    np.testing.assert_array_equal(part.trajectories[1].x[:, 0], np.square(run.t - 1))
    assert part.noise == {"q": 0.4}
    whole = measurements()
    assert whole.between(None, None).digest == whole.digest


@pytest.mark.parametrize(("begin", "end", "message"), [
    (3.0, 9.0, "trajectory 'run 1' has 0 samples between 3 and 9.*from 0 to 2.75"),
    (0.0, 1.0, "trajectory 'run 2' has 1 samples between 0 and 1; expected at least"),
    (0.1, 0.2, "trajectory 'run 1' has 0 samples"),
    (2.0, 1.0, r"between\(2.0, 1.0\): the first time must be less than the last"),
    ("0", 1.0, "'0' is not a time"),
    (np.nan, 1.0, "nan is not a time"),
    (True, 2.0, "True is not a time"),
])  # fmt: skip
def test_a_part_that_cannot_be_had_is_refused(begin, end, message) -> None:
    with pytest.raises(ph.DataError, match=f"(?s){message}"):
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


def test_a_held_input_keeps_its_course_between_new_samples() -> None:
    x = np.arange(12.0)
    u = np.array([1.0, 1, 1, 1, 1, 1, 5, 5, 5, 2, 3, 4])
    data = ph.Measurements.from_arrays(x, x, u, states=["q"], hold="zero")
    picked = data.thinned(4, by="picking").trajectories[0]
    # one change is kept where it is
    np.testing.assert_array_equal(picked.t, [0, 4, 6, 8])
    np.testing.assert_array_equal(picked.x[:, 0], [0, 4, np.nan, 8])
    np.testing.assert_array_equal(picked.u[:, 0], [1, 1, 5, 5])
    # moving means of 4: 1 1 1 2 3 4 4.25 3.75 3.5, at 1.5, 2.5, ...
    means = data.thinned(4).trajectories[0]
    np.testing.assert_array_equal(means.t, [1.5, 4.5, 5.5, 6.5, 9.5])
    np.testing.assert_array_equal(means.x[:, 0], [1.5, np.nan, 5.5, np.nan, 9.5])
    np.testing.assert_array_equal(means.u[:, 0], [1, 2, 3, 4, 3.5])


def test_no_mean_is_over_a_gap_of_the_clock() -> None:
    t = np.delete(np.arange(30.0), np.arange(13, 18))
    u = np.where(t < 12, 1.0, 2.0)
    data = ph.Measurements.from_arrays(t, t, u, states=["q"], hold="zero")
    (run,) = data.thinned(4)
    np.testing.assert_array_equal(run.t, [1.5, 5.5, 9.5, 19.5, 23.5, 27.5])
    np.testing.assert_array_equal(run.x[:, 0], run.t)
    np.testing.assert_array_equal(run.u[:, 0], [1, 1, 1, 2, 2, 2])


def test_samples_that_fill_no_group_are_left_out_of_means_alone() -> None:
    data = measurements()
    assert data.thinned(1).digest == data.thinned(1, by="picking").digest == data.digest
    data = measurements(hold="linear")
    assert [run.n_samples for run in data.thinned(5)] == [2, 2]
    assert [run.n_samples for run in data.thinned(5, by="picking")] == [3, 3]


@pytest.mark.parametrize(("n", "by", "message"), [
    (0, "mean", r"thinned\(0\): expected the number"),
    (2.5, "mean", r"thinned\(2.5\)"),
    (True, "mean", r"thinned\(True\)"),
    (2, "means", "by='means' is unknown; .*Did you mean 'mean'"),
    (7, "mean", r"'run 1' has 12 samples, too few for thinned\(7\): 1 would remain"),
    (12, "picking", r"too few for thinned\(12\): 1 would remain"),
])  # fmt: skip
def test_thinning_that_cannot_be_done_is_refused(n: Any, by: Any, message: str) -> None:
    with pytest.raises(ph.DataError, match=message):
        measurements().thinned(n, by)


def test_arrays_without_names_of_states_are_refused_by_the_package() -> None:
    with pytest.raises(ph.DataError, match="names no state"):
        ph.Measurements.from_arrays([0.0, 1.0], [1.0, 2.0])

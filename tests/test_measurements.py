"""What Measurements promises: it reads what was recorded, refuses what cannot be used,
and changes nothing.
"""

import copy
import hashlib
import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from phsi_opt.data.measurements import Measurements
from phsi_opt.data.trajectory import Trajectory
from phsi_opt.errors import DataError, PhsiOptError, did_you_mean

# All comparisons are exact: reading, joining and splitting copy numbers and never
# compute with them.


def record(n_runs: int = 3, seed: int = 0) -> Measurements:
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
    return Measurements.from_arrays(
        ts,
        xs,
        us,
        states=["q", "p"],
        inputs=["u"],
        units=units,
        noise={"q": 0.1},
        hold="zero",
    )


def frame(**columns: Any) -> pd.DataFrame:
    return pd.DataFrame(
        {"t": [0.0, 0.1, 0.3], "q": [1.0, 2.0, 3.0], "u": [0.0, 1.0, 0.0]} | columns
    )


def read(text: str, **options: Any) -> Measurements:
    return Measurements.from_csv(
        io.StringIO(text), **({"time": "t", "states": ["q"]} | options)
    )


def assert_same(a: Measurements, b: Measurements) -> None:
    assert (a.states, a.inputs, a.hold, a.noise, dict(a.units)) == (
        b.states,
        b.inputs,
        b.hold,
        b.noise,
        dict(b.units),
    )
    assert [run.name for run in a] == [run.name for run in b]
    for run, other in zip(a, b, strict=True):
        for label in "txu":
            np.testing.assert_array_equal(getattr(run, label), getattr(other, label))


# ---- reading files ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_a_csv_file_gives_back_exactly_the_numbers_that_were_written(
    tmp_path: Path, separator: str
) -> None:
    data = record()
    path = tmp_path / "bench.csv"
    data.to_dataframe().to_csv(path, index=False, sep=separator)
    options: dict[str, Any] = {
        "hold": "zero",
        "units": {"q": "m", "u": "N", "t": "s"},
        "noise": {"q": 0.1},
    }
    again = Measurements.from_csv(
        path,
        time="t",
        states=["q", "p"],
        inputs=["u"],
        trajectory="trajectory",
        **options,
    )
    assert_same(again, data)


def test_columns_may_have_other_names_and_states_may_be_unmeasured() -> None:
    text = "time/s,force (N),x_m\n0,5,1\n0.1,6,2\n"
    data = read(
        text, time="time/s", states={"q": "x_m", "p": None}, inputs={"u": "force (N)"}
    )
    np.testing.assert_array_equal(data.trajectories[0].x, [[1, np.nan], [2, np.nan]])
    np.testing.assert_array_equal(data.trajectories[0].u, [[5], [6]])
    assert data.measured == ("q",)
    assert data.states == ("q", "p")


@pytest.mark.parametrize("cell", ["", "  ", "nan", "NaN", "NA", "n/a"])
def test_empty_cells_are_missing_samples(cell: str) -> None:
    np.testing.assert_array_equal(
        read(f"t,q\n0,1\n1,{cell}\n2,3\n").trajectories[0].x, [[1], [np.nan], [3]]
    )


@pytest.mark.parametrize(
    "text",
    [
        "t,q\n0,1\n1,2\n",
        "\ufefft,q\n0,1\n1,2\n",
        "t,q,\n0,1\n1,2\n",
        "t,q,\n0,1,\n1,2,\n",
        "t, q\n0, 1\n1, 2\n",
        '"t","q"\n"0","1"\n"1","2"\n',
        "t,q\r\n0,1\r\n1,2\r\n",
        "\nt,q\n\n0,1\n,\n1,2\n\n",
        "t;q;a, b, c\n0;1;x, y\n1;2;x, y\n",
        "t\tq\n0\t1e0\n1\t+2.\n",
    ],
)
def test_harmless_variations_of_a_file_read_the_same(text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode("utf-8"))
    for source in (path, str(path), io.StringIO(text)):
        data = Measurements.from_csv(source, time="t", states=["q"])
        np.testing.assert_array_equal(data.trajectories[0].t, [0, 1])
        np.testing.assert_array_equal(data.trajectories[0].x, [[1], [2]])


def test_an_open_file_is_read_and_left_open(tmp_path: Path) -> None:
    path = tmp_path / "swing.csv"
    path.write_text("t,q\n0,1\n1,2\n", encoding="utf-8")
    with path.open(encoding="utf-8") as file:
        data = Measurements.from_csv(file, time="t", states=["q"])
        assert not file.closed
    assert [run.name for run in data] == ["swing"]
    assert [run.name for run in read("t,q\n0,1\n1,2\n")] == ["run 1"]


def test_several_files_are_several_trajectories_in_the_order_given(
    tmp_path: Path,
) -> None:
    paths = [tmp_path / name for name in ("b.csv", "a.csv")]
    for i, path in enumerate(paths):
        path.write_text(
            f"t,q,run\n0,{i},x\n1,{i},x\n0,7,y\n1,7,y\n2,7,y\n", encoding="utf-8"
        )
    by_value = Measurements.from_csv(paths, time="t", states=["q"], trajectory="run")
    assert [run.name for run in by_value] == ["b/x", "b/y", "a/x", "a/y"]
    assert [run.n_samples for run in by_value] == [2, 3, 2, 3]
    for path in paths:
        path.write_text("t,q\n0,1\n1,2\n", encoding="utf-8")
    by_file = Measurements.from_csv(iter(paths), time="t", states=["q"])
    assert [run.name for run in by_file] == ["b", "a"]


def test_files_of_the_same_name_in_different_folders_keep_apart(tmp_path: Path) -> None:
    paths = [tmp_path / folder / "run.csv" for folder in ("monday", "tuesday")]
    for path in paths:
        path.parent.mkdir()
        path.write_text("t,q\n0,1\n1,2\n", encoding="utf-8")
    data = Measurements.from_csv(paths, time="t", states=["q"])
    assert [run.name for run in data] == [str(path) for path in paths]


def test_rows_of_one_run_need_not_be_contiguous_but_keep_their_order() -> None:
    data = read("run,t,q\nb,0,1\na,0,10\nb,1,2\na,2,20\nb,5,3\n", trajectory="run")
    assert [run.name for run in data] == ["b", "a"]
    np.testing.assert_array_equal(data.trajectories[0].x[:, 0], [1, 2, 3])
    np.testing.assert_array_equal(data.trajectories[1].t, [0, 2])


def test_names_of_runs_in_a_file_stay_text() -> None:
    assert [
        run.name
        for run in read(
            "run,t,q\n007,0,1\n007,1,2\n1.0,0,1\n1.0,1,2\n", trajectory="run"
        )
    ] == [
        "007",
        "1.0",
    ]


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("", {}, "open file is empty; expected a header line"),
        ("\n,,\n", {}, "open file is empty"),
        ("t,q\n", {}, "open file has no samples; expected at least 2 rows"),
        ("t,q\n0,1\n", {}, "trajectory 'run 1' has 1 sample; expected at least 2"),
        (
            "t,position\n0,1\n",
            {"states": {"q": "positon"}},
            r"no column 'positon'.*Did you mean 'position'\?",
        ),
        ("T,q\n0,1\n1,2\n", {}, r"no column 't'.*\['T', 'q'\].*Did you mean 'T'\?"),
        ("t,q\n0,1\n1,2\n", {"trajectory": "run"}, "no column 'run'"),
        ("t,q,q\n0,1,2\n1,2,3\n", {}, "2 columns called 'q'; expected one"),
        (
            "t,q\n0,1\n1,abc\n",
            {},
            "open file, column 'q', line 3: 'abc' is not a real number",
        ),
        ("\nt,q\n\n0,1\n1,abc\n", {}, "column 'q', line 5: 'abc'"),
        (
            "t,q\n0,1\n1,1e400\n",
            {},
            "column 'q', line 3: the value is inf; expected a finite value",
        ),
        ("t,q\n0,1\n1,-inf\n", {}, "column 'q', line 3: the value is -inf"),
        (
            "t,q\n0,1\n1,-1e101\n",
            {},
            r"column 'q', line 3: the value is -1e\+101; expected at most 1e\+100 in size",
        ),
        (
            "t,q\n0,1\n,2\n",
            {},
            "column 't', line 3: the value is nan; times and inputs must be known",
        ),
        (
            "t,q,u\n0,1,1\n1,2,NA\n",
            {"inputs": ["u"]},
            "column 'u', line 3: the value is nan; times and inputs",
        ),
        (
            "t;q\n0,1;1,5\n",
            {},
            "column 't', line 2: '0,1' is not a real number. Decimal commas.*decimal=','",
        ),
        ("t,q\n0,1,1,5\n", {}, "line 2 has 4 cells; expected 2.*decimal commas"),
        ("t,q\n0,1\n1\n", {}, "line 3 has 1 cells; expected 2, as in the header"),
        (
            "run,t,q\na,0,1\n,1,2\n",
            {"trajectory": "run"},
            "column 'run', line 3: the trajectory's name is missing",
        ),
        (
            "t,q\n0,1\n0,2\n",
            {},
            r"trajectory 'run 1': t\[1\]=0.0 is not after t\[0\]=0.0; times must increase strictly",
        ),
        ("t,q\n0,\n1,NA\n", {}, "trajectory 'run 1' has no measured value"),
        (
            "t,q\n0,1\n1,2\n",
            {"states": {"q": None}},
            "trajectory 'run 1' has no measured value",
        ),
        (
            "t,q\n0,1\n1,2\n",
            {"states": {"q": "q", "p": "q"}},
            "the column 'q' is asked for twice",
        ),
        ("t,q\n0,1\n1,2\n", {"states": {}}, "names no state"),
        ("t,q\n0,1\n1,2\n", {"states": "q"}, "states='q' is not a list of names"),
        (
            "t,q\n0,1\n1,2\n",
            {"inputs": {"u": None}},
            "input without a column; inputs must be measured",
        ),
        (
            "t,q\n0,1\n1,2\n",
            {"inputs": {"q": "t"}},
            "the column 't' is asked for twice",
        ),
        (
            "t,q,u\n0,1,1\n1,2,1\n",
            {"inputs": {"q": "u"}},
            "the name 'q' is used 2 times",
        ),
        ("t,q\n0," + "9" * 200_000 + "\n", {}, "line 2: field larger than field limit"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_by_place(
    text: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(DataError, match=f"(?s){message}"):
        read(text, **options)


def test_messages_about_a_file_name_the_file(tmp_path: Path) -> None:
    good, bad = tmp_path / "good.csv", tmp_path / "bad.csv"
    good.write_text("t,q\n0,1\n1,2\n", encoding="utf-8")
    bad.write_text("t,q\n0,1\n1,x\n", encoding="utf-8")
    with pytest.raises(DataError, match=r"file '.*bad\.csv', column 'q', line 3: 'x'"):
        Measurements.from_csv([good, bad], time="t", states=["q"])


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    latin = tmp_path / "latin.csv"
    latin.write_bytes("t,q\n0,1\n# Größe\n".encode("latin-1"))
    with pytest.raises(DataError, match=r"latin\.csv' is not UTF-8 text"):
        Measurements.from_csv(latin, time="t", states=["q"])
    with pytest.raises(DataError, match=r"missing\.csv' cannot be read"):
        Measurements.from_csv(tmp_path / "missing.csv", time="t", states=["q"])
    with pytest.raises(DataError, match="cannot be read"):
        Measurements.from_csv(tmp_path, time="t", states=["q"])
    with pytest.raises(DataError, match="gives bytes; expected text"):
        Measurements.from_csv(io.BytesIO(b"t,q\n0,1\n1,2\n"), time="t", states=["q"])  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (3, "source is a int; expected a path"),
        (b"bench.csv", "source is a bytes"),
        ({"a": "b.csv"}, "source is a dict"),
        ([], "source is an empty list"),
        ([3], "source holds a int"),
    ],
)
def test_a_source_of_the_wrong_type_is_refused(source: Any, message: str) -> None:
    with pytest.raises(DataError, match=message):
        Measurements.from_csv(source, time="t", states=["q"])


def test_the_same_file_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t,q\n0,1\n1,2\n", encoding="utf-8")
    with pytest.raises(
        DataError, match=r"the trajectory name '.*a\.csv' is used 2 times"
    ):
        Measurements.from_csv([path, path], time="t", states=["q"])


# ---- data frames -----------------------------------------------------------------------------------------------------


def test_a_data_frame_gives_back_exactly_the_record_it_came_from() -> None:
    data = record()
    table = data.to_dataframe()
    assert list(table.columns) == ["trajectory", "t", "q", "p", "u"]
    assert len(table) == data.n_samples
    units, noise = dict(data.units), data.noise
    again = Measurements.from_dataframe(
        table,
        time="t",
        states=["q", "p"],
        inputs=["u"],
        trajectory="trajectory",
        hold="zero",
        units=units,
        noise=noise,
    )
    assert_same(again, data)


def test_a_data_frame_is_not_changed() -> None:
    table = frame(run=["a", "a", "a"], note=["x", None, "y"])
    before = table.copy(deep=True)
    data = Measurements.from_dataframe(
        table, time="t", states=["q"], inputs=["u"], trajectory="run"
    )
    pd.testing.assert_frame_equal(table, before)
    table.loc[0, "q"] = 99.0
    assert data.trajectories[0].x[0, 0] == 1.0


@pytest.mark.parametrize(
    "column",
    [
        pd.Series([1, 2, 3]),
        pd.Series([1, None, 3], dtype="Int64"),
        pd.Series([1.0, None, 3.0], dtype="Float64"),
        pd.Series([1.0, None, 3.0], dtype=object),
        pd.Series(["1", "", "3"]),
        pd.Series([1.0, pd.NA, 3.0], dtype=object),
        pd.Series([True, False, True]),
        pd.Series([1, 2, 3], dtype="float32"),
    ],
)
def test_every_numeric_kind_of_column_is_read(column: pd.Series) -> None:
    data = Measurements.from_dataframe(frame(q=column), time="t", states=["q"])
    assert data.trajectories[0].x.dtype == np.float64
    assert data.trajectories[0].x[0, 0] == 1.0


@pytest.mark.parametrize(
    "labels",
    [[2, 1, 2], [2.5, 1.5, 2.5], ["b", "a", "b"], pd.Categorical(["b", "a", "b"])],
)
def test_runs_may_be_named_by_anything(labels: Any) -> None:
    table = pd.DataFrame({"t": [0.0, 0.0, 1.0], "q": 1.0, "run": labels})
    table = pd.concat([table, table.iloc[[1]].assign(t=1.0)])
    data = Measurements.from_dataframe(table, time="t", states=["q"], trajectory="run")
    assert [run.name for run in data] == [str(labels[0]), str(labels[1])]


@pytest.mark.parametrize(
    ("table", "options", "message"),
    [
        (
            frame(q=[1.0, np.inf, 2.0]),
            {},
            "data frame, column 'q', row 'b': the value is inf",
        ),
        (
            frame(q=["1", "x", "2"]),
            {},
            "data frame, column 'q', row 'b': 'x' is not a real number",
        ),
        (
            frame(q=[1.0, 2j, 2.0]),
            {},
            "column 'q', row 'a': .* is not a real number. Convert the column",
        ),
        (
            frame(t=pd.date_range("2024-01-01", periods=3)),
            {},
            "column 't', row 'a': Timestamp.*seconds since the start",
        ),
        (frame(t=[0.0, np.nan, 1.0]), {}, "column 't', row 'b': the value is nan"),
        (
            frame(u=[0.0, np.nan, 1.0]),
            {"inputs": ["u"]},
            "column 'u', row 'b': the value is nan",
        ),
        (
            frame(run=["a", None, "a"]),
            {"trajectory": "run"},
            "column 'run', row 'b': the trajectory's name is missing",
        ),
        (
            frame(run=[1.0, np.nan, 1.0]),
            {"trajectory": "run"},
            "column 'run', row 'b': the trajectory's name is missing",
        ),
        (frame().iloc[:0], {}, "data frame has no samples"),
        (frame().rename(columns={"u": "q"}), {}, "2 columns called 'q'"),
        (frame(), {"states": ["w"]}, "no column 'w'"),
    ],
)
def test_a_data_frame_that_cannot_be_used_is_refused_by_row(
    table: pd.DataFrame, options: dict[str, Any], message: str
) -> None:
    table = table.set_axis(["a", "b", "c"][: len(table)], axis=0)
    with pytest.raises(DataError, match=message):
        Measurements.from_dataframe(table, **({"time": "t", "states": ["q"]} | options))


def test_what_is_no_data_frame_is_refused() -> None:
    with pytest.raises(
        DataError, match=r"frame is a dict; expected a pandas\.DataFrame"
    ):
        Measurements.from_dataframe({"t": [0, 1]}, time="t", states=["q"])  # type: ignore[arg-type]


# ---- arrays and pairs ------------------------------------------------------------------------------------------------


def test_one_trajectory_or_several_come_from_arrays() -> None:
    one = Measurements.from_arrays([0, 1, 2], [1, 2, 3], [4, 5, 6], states=["q"])
    assert (one.n_trajectories, one.n_states, one.n_inputs, one.inputs) == (
        1,
        1,
        1,
        ("u1",),
    )
    two = Measurements.from_arrays(
        [[0, 1], [0, 1, 2]], [np.ones((2, 2)), np.ones((3, 2))], states=["q", "p"]
    )
    assert [run.name for run in two] == ["run 1", "run 2"]
    assert (two.n_samples, two.n_inputs) == (5, 0)
    named = Measurements.from_arrays([[0, 1]], [[1, 2]], states=["q"], names=["swing"])
    assert named.trajectories[0].name == "swing"


def test_arrays_of_the_user_are_neither_changed_nor_shared() -> None:
    t, x, u = np.arange(3.0), np.ones((3, 1)), np.zeros((3, 1))
    data = Measurements.from_arrays(t, x, u, states=["q"])
    assert t.flags.writeable and x.flags.writeable and u.flags.writeable
    t[0], x[0], u[0] = -1, -1, -1
    run = data.trajectories[0]
    assert (run.t[0], run.x[0, 0], run.u[0, 0]) == (0, 1, 0)


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


def test_mappings_of_the_user_are_neither_changed_nor_shared() -> None:
    units, noise = {"q": "m"}, {"q": 0.1}
    data = Measurements.from_arrays(
        [0, 1], [1, 2], states=["q"], units=units, noise=noise
    )
    units["q"], noise["q"] = "km", 7.0
    assert dict(data.units) == {"t": "", "q": "m"}
    assert data.noise == {"q": 0.1}


@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda data: pickle.loads(pickle.dumps(data))]
)
def test_a_copy_in_another_process_is_the_same_and_read_only(duplicate: Any) -> None:
    data = record()
    again = duplicate(data)
    assert_same(again, data)
    assert not again.trajectories[0].x.flags.writeable


def test_masked_entries_are_missing_samples() -> None:
    x = np.ma.masked_array([1.0, -999.0, 3.0], mask=[False, True, False])
    data = Measurements.from_arrays([0, 1, 2], x, states=["q"])
    np.testing.assert_array_equal(data.trajectories[0].x, [[1], [np.nan], [3]])


def test_an_entirely_empty_channel_of_one_trajectory_is_fine() -> None:
    empty = np.array([[np.nan, 1.0], [np.nan, 2.0]])
    data = Measurements.from_arrays(
        [[0, 1], [0, 1]], [empty, empty[:, ::-1]], states=["q", "p"]
    )
    assert data.measured == ("q", "p")
    assert data[0].measured == ("p",)


def pairs(x: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, ...]:
    return x[:-1], x[1:], t[:-1], t[1:]


def test_consecutive_pairs_that_share_their_sample_join() -> None:
    rng = np.random.default_rng(1)
    t, x = np.cumsum(rng.uniform(0.1, 1, 9)), rng.normal(size=(9, 2))
    x[4, 1] = np.nan  # a sample that was not measured is shared too
    keep = np.array([0, 1, 2, 4, 5, 6, 7])  # pair 3 is lost: two trajectories
    data = Measurements.from_pairs(*(array[keep] for array in pairs(x, t)))
    assert data.states == ("x1", "x2")
    assert [run.name for run in data] == ["run 1", "run 2"]
    np.testing.assert_array_equal(data.trajectories[0].x, x[:4])
    np.testing.assert_array_equal(data.trajectories[1].x, x[4:])
    np.testing.assert_array_equal(data.trajectories[1].t, t[4:])


def test_noisy_pairs_that_meet_in_time_only_stay_apart() -> None:
    data = Measurements.from_pairs([1.0, 2.0], [2.1, 3.0], [0, 1], [1, 2], states=["q"])
    assert [run.n_samples for run in data] == [2, 2]


def test_a_jump_of_the_input_separates_linear_pairs_and_not_held_ones() -> None:
    x0, x1, t0, t1, u = [1.0, 2.0], [2.0, 3.0], [0, 1], [1, 2], [5.0, 6.0]
    linear = Measurements.from_pairs(x0, x1, t0, t1, u_start=u, u_end=u)
    assert [run.n_samples for run in linear] == [2, 2]
    for u_end in (u, None):
        held = Measurements.from_pairs(
            x0, x1, t0, t1, u_start=u, u_end=u_end, hold="zero", inputs=["force"]
        )
        assert held.inputs == ("force",)
        np.testing.assert_array_equal(held.trajectories[0].u, [[5], [6], [6]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"x_end": [[1.0]]},
            r"x_start has the shape \(2, 1\) and x_end \(1, 1\); expected the same shape",
        ),
        (
            {"t_start": [0], "t_end": [1]},
            "lengths differ: .*'x_start': 2, 't_start': 1.*one row per pair",
        ),
        ({"t_end": [1, 1]}, r"pair 1: t_end\[1\]=1.0 is not after t_start\[1\]=1.0"),
        ({"t_start": [0, np.nan]}, r"t_start\[1\] is nan"),
        ({"u_start": [1, 2]}, "only one of u_start and u_end is given.*hold='zero'"),
        ({"u_end": [1, 2], "hold": "zero"}, "only one of u_start and u_end"),
        (
            {"states": ["a", "b"]},
            r"has 1 state column; expected 2, one for each of \['a', 'b'\]",
        ),
        ({"x_start": ["a", "b"]}, "x_start has the type"),
        (
            {"x_start": [], "x_end": [], "t_start": [], "t_end": []},
            "there are no pairs",
        ),
    ],
)
def test_pairs_that_cannot_be_used_are_refused(
    changes: dict[str, Any], message: str
) -> None:
    good: dict[str, Any] = {
        "x_start": [1.0, 2.0],
        "x_end": [2.0, 3.0],
        "t_start": [0, 1],
        "t_end": [1, 2],
    }
    with pytest.raises(DataError, match=message):
        Measurements.from_pairs(**(good | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"t": [0, 2, 1]},
            r"trajectory 'run 1': t\[2\]=1.0 is not after t\[1\]=2.0; .*Sort the samples or drop",
        ),
        ({"t": [0, 1, 1]}, r"t\[2\]=1.0 is not after t\[1\]=1.0"),
        ({"t": [0, np.nan, 1]}, r"trajectory 'run 1': t\[1\] is nan"),
        ({"t": [0, 1, np.inf]}, r"t\[2\] is inf"),
        ({"t": [[0], [1], [2]]}, r"trajectory 'run 1': x has the shape \(\)"),
        (
            {"t": np.zeros((3, 1))},
            r"trajectory 'run 1': t has the shape \(3, 1\); expected \(n_samples,\)",
        ),
        ({"t": [0, 1]}, "x has 3 rows and t has 2; expected one row per time"),
        ({"u": [1, 2]}, "u has 2 rows and t has 3"),
        (
            {"x": np.zeros((3, 1, 1))},
            r"x has the shape \(3, 1, 1\); expected \(n_samples, n_channels\)",
        ),
        ({"x": np.zeros((3, 2))}, "trajectory 'run 1' has 2 state columns; expected 1"),
        ({"x": [[1], [2, 3], [4]]}, "x is not a regular array"),
        (
            {"x": np.array([1, 2, 1j])},
            "x has the type complex128; expected real numbers",
        ),
        (
            {"x": np.array([1, None, 2])},
            "x has the type object; expected real numbers, NaN where nothing",
        ),
        ({"x": ["1", "2", "3"]}, "x has the type <U1"),
        (
            {"x": [1, np.inf, 2]},
            r"trajectory 'run 1': state 'q' at sample 1 \(t=1.0\) is inf; expected a finite value",
        ),
        (
            {"x": [1, 2, -2e100]},
            r"state 'q' at sample 2 \(t=2.0\) is -2e\+100; expected at most 1e\+100 in size",
        ),
        (
            {"x": [np.nan] * 3},
            r"trajectory 'run 1' has no measured value in any of the states \['q'\]",
        ),
        (
            {"u": [1, np.nan, 2]},
            r"input 'u1' at sample 1 \(t=1.0\) is nan; times and inputs must be known",
        ),
        ({"u": [1, 2, 3], "inputs": ["a", "b"]}, "has 1 input column; expected 2"),
        ({"inputs": ["a"]}, "has 0 input columns; expected 1"),
        ({"t": [0], "x": [1]}, "trajectory 'run 1' has 1 sample; expected at least 2"),
        ({"t": [], "x": []}, "trajectory 'run 1' has 0 samples; expected at least 2"),
        ({"states": "q"}, "states='q' is not a list of names"),
        ({"states": []}, "names no state"),
        ({"states": ["1q"]}, "states: '1q' cannot be used in a formula"),
        ({"states": ["lambda"]}, "states: 'lambda' cannot be used"),
        ({"states": [1]}, "states: 1 cannot be used"),
        ({"states": ["t"]}, "states: the name 't' is reserved"),
        ({"states": ["trajectory"]}, "the name 'trajectory' is reserved"),
        ({"states": ["dH_dq"]}, "the name 'dH_dq' is reserved"),
        ({"u": [1, 2, 3], "inputs": ["dH_d"]}, "inputs: the name 'dH_d' is reserved"),
        ({"u": [1, 2, 3], "inputs": ["q"]}, "the name 'q' is used 2 times"),
        (
            {"hold": "zeros"},
            r"hold='zeros' is unknown; expected 'linear' or 'zero'. Did you mean 'zero'\?",
        ),
        ({"hold": None}, "hold=None is unknown"),
        (
            {"noise": {"q": 0}},
            "noise: 'q' has the standard deviation 0; expected a positive number",
        ),
        ({"noise": {"q": -1.0}}, "standard deviation -1.0; expected a positive number"),
        ({"noise": {"q": np.nan}}, "standard deviation nan"),
        ({"noise": {"q": np.inf}}, "standard deviation inf"),
        ({"noise": {"q": "1"}}, "standard deviation '1'"),
        (
            {"noise": {"Q": 1.0}},
            r"noise names the unknown 'Q'; expected names of \['q'\]. Did you mean 'q'\?",
        ),
        ({"noise": 0.1}, "noise=0.1 is not a mapping"),
        (
            {"units": {"w": "m"}},
            r"units names the unknown 'w'; expected names of \['t', 'q'\]",
        ),
        ({"units": {"q": None}}, "units: 'q' has the unit None; expected text"),
        ({"units": ""}, "units='' is not a mapping"),
        ({"units": "m"}, "units='m' is not a mapping"),
        (
            {"names": ["a", "b"]},
            "the lengths differ: .*'names': 2.*one entry per trajectory",
        ),
        ({"names": [""]}, "trajectory name '' is not a text"),
        ({"names": [1]}, "trajectory name 1 is not a text"),
        ({"t": [[0, 1], [0, 1]], "x": None}, "the lengths differ: {'t': 2, 'x': None"),
        ({"t": [[0, 1], [0, 1]], "x": [[1, 2]]}, "the lengths differ: {'t': 2, 'x': 1"),
        (
            {"t": [[0, 1], [0, 1]], "x": [[1, 2], [1, 2]], "names": ["a", "a"]},
            "trajectory name 'a' is used 2 times",
        ),
    ],
)
def test_arrays_that_cannot_be_used_are_refused(
    changes: dict[str, Any], message: str
) -> None:
    good: dict[str, Any] = {"t": [0, 1, 2], "x": [1, 2, 3], "states": ["q"]}
    with pytest.raises(DataError, match=message):
        Measurements.from_arrays(**(good | changes))


@pytest.mark.parametrize(
    ("trajectories", "message"),
    [
        ((), "expected a list or tuple of at least one"),
        (3, "trajectories=3"),
        ([3], r"trajectories\[0\] is a int"),
    ],
)
def test_what_are_no_trajectories_is_refused(trajectories: Any, message: str) -> None:
    with pytest.raises(DataError, match=message):
        Measurements(trajectories, ("q",))


# ---- looking, choosing, splitting ------------------------------------------------------------------------------------


def test_sizes_count_all_trajectories() -> None:
    data = record(3)
    assert (
        len(data),
        data.n_trajectories,
        data.n_samples,
        data.n_states,
        data.n_inputs,
    ) == (3, 3, 10 + 13 + 16, 2, 1)
    assert [run.n_samples for run in data] == [10, 13, 16]


def test_trajectories_are_chosen_by_position_slice_or_name() -> None:
    data = record(3)
    assert [run.name for run in data[-1]] == ["run 3"]
    assert [run.name for run in data[np.int64(1)]] == ["run 2"]  # type: ignore[index]
    assert [run.name for run in data["run 2"]] == ["run 2"]
    assert [run.name for run in data[::2]] == ["run 1", "run 3"]
    assert (data[0].units, data[0].hold, data[0].noise) == (
        data.units,
        "zero",
        {"q": 0.1},
    )


def test_a_trajectory_has_one_number_by_name_and_by_number() -> None:
    data = record(3)
    numbers = [data.trajectory_number(run.name) for run in data]
    assert numbers == [0, 1, 2]
    assert data.trajectory_number(2) == 2
    assert data.trajectory_number(-1) == 2
    assert type(data.trajectory_number(np.int64(1))) is int  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("key", "message"),
    [
        (
            "run 9",
            r"there is no trajectory 'run 9'; expected one of \['run 1', 'run 2'\]. Did you mean 'run",
        ),
        (2, r"no trajectory 2; there are 2, counted from 0: \['run 1', 'run 2'\]"),
        (-3, "there is no trajectory -3"),
        (slice(5, 9), "at least one Trajectory"),
        (1.5, r"trajectory 1.5 is unknown; expected a name of \['run 1', 'run 2'\]"),
    ],
)
def test_a_trajectory_that_does_not_exist_is_refused(key: Any, message: str) -> None:
    with pytest.raises(DataError, match=message):
        record(2)[key]


@pytest.mark.parametrize(
    ("trajectory", "message"),
    [
        ("Run 2", r"no trajectory 'Run 2'; .*'run 2'\]. Did you mean 'run 2'\?"),
        ("swing", r"no trajectory 'swing'; expected one of \['run 1', 'run 2'\]\.$"),
        (2, r"no trajectory 2; there are 2, counted from 0: \['run 1', 'run 2'\]"),
        (-3, "no trajectory -3; there are 2"),
        (None, "trajectory None is unknown; .* or a number, counted from 0"),
        (slice(1), "trajectory slice.* is unknown"),
    ],
)
def test_a_trajectory_without_a_number_is_refused(
    trajectory: Any, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        record(2).trajectory_number(trajectory)


def test_the_digest_knows_names_and_numbers_and_nothing_else() -> None:
    data = record()
    expected = hashlib.sha256()
    for run in data:
        expected.update(run.name.encode() + run.t.tobytes())
        expected.update(run.x.tobytes() + run.u.tobytes())
    assert data.digest == expected.hexdigest()
    assert data.digest is data.digest  # computed once
    assert data.with_noise(None).digest == data.digest
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


@pytest.mark.parametrize("fraction", [0, 1, -0.5, 70, np.nan, "0.7", None])
def test_a_share_outside_zero_and_one_is_refused(fraction: Any) -> None:
    with pytest.raises(DataError, match="is not between 0 and 1"):
        record().split(fraction)


def test_a_record_too_short_to_split_is_refused() -> None:
    data = Measurements.from_arrays([0, 1, 2], [1, 2, 3], states=["q"])
    with pytest.raises(
        DataError,
        match="trajectory 'run 1' has 3 samples; a split in time needs at least 4",
    ):
        data.split()


def test_noise_can_be_given_later() -> None:
    data = record()
    other = data.with_noise({"p": 2})
    assert (data.noise, other.noise, data.with_noise(None).noise) == (
        {"q": 0.1},
        {"p": 2.0},
        None,
    )
    assert other.trajectories is data.trajectories
    with pytest.raises(DataError, match="noise names the unknown 'u'"):
        data.with_noise({"u": 1.0})


def test_the_summary_shows_sizes_units_gaps_and_ranges() -> None:
    x = np.array([[1.0, np.nan, np.nan], [-2.5, 3.0, np.nan]])
    data = Measurements.from_arrays(
        [0, 2.5],
        x,
        [0, 1],
        states=["q", "p", "r"],
        inputs=["u"],
        units={"q": "m", "t": "s"},
        noise={"q": 0.1},
    )
    assert repr(data).splitlines() == [
        "Measurements: 1 trajectory, 2 samples, t = 0 to 2.5 [s]",
        "  state q [m]: 2 of 2 samples measured, -2.5 to 1, noise 0.1",
        "  state p: 1 of 2 samples measured, 3 to 3",
        "  state r: not measured",
        "  input u: 2 of 2 samples measured, 0 to 1",
    ]
    assert str(data) == repr(data)
    assert repr(data.trajectories[0]) == "Trajectory('run 1', 2 samples, t = 0 to 2.5)"


def test_a_trajectory_checks_itself() -> None:
    with pytest.raises(DataError, match=r"t\[1\]=0\.0 is not after"):
        Trajectory("a", np.zeros(2), np.zeros((2, 1)), np.zeros((2, 0)))


def test_data_errors_are_value_errors_and_errors_of_this_package() -> None:
    assert issubclass(DataError, ValueError) and issubclass(DataError, PhsiOptError)


def test_suggestions_ignore_case_and_say_nothing_when_nothing_is_close() -> None:
    assert (
        did_you_mean("Positon", ["velocity", "POSITION"]) == " Did you mean 'POSITION'?"
    )
    assert did_you_mean("xyz", ["velocity"]) == ""
    assert did_you_mean(3, []) == ""

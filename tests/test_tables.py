"""Reading tables: what is harmless reads the same, what is wrong is named by place."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError

# All comparisons are exact: reading copies numbers and never computes with them.


def frame(**columns: Any) -> pd.DataFrame:
    return pd.DataFrame(
        {"t": [0.0, 0.1, 0.3], "q": [1.0, 2.0, 3.0], "u": [0.0, 1.0, 0.0]} | columns
    )


def read(text: str, **options: Any) -> Measurements:
    return Measurements.from_csv(
        io.StringIO(text), **({"time": "t", "states": ["q"]} | options)
    )


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


def test_an_open_file_without_a_name_keeps_apart_from_a_file_of_its_name(
    tmp_path: Path,
) -> None:
    text = "t,q\n0,1\n1,2\n"
    path = tmp_path / "run 1.csv"
    path.write_text(text, encoding="utf-8")
    data = Measurements.from_csv([io.StringIO(text), path], time="t", states=["q"])
    assert [run.name for run in data] == ["run 1", str(path)]


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
        ("T,q\n0,1\n1,2\n", {}, r"no column 't'.*one of T, q\..*Did you mean 'T'\?"),
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
            r"column 'q', line 3: the value is -1e\+101; "
            r"expected at most 1e\+100 in size",
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
            't,q\n0,"1,500"\n1,"2,500"\n',
            {},
            "column 'q', line 2: '1,500' is not a real number. "
            'A comma could stand before decimals or thousands.*decimal = ","',
        ),
        (
            "t;q\n0,5;1.234,5\n1,5;2\n",
            {},
            "column 'q', line 2: '1.234,5' is not a real number. Correct the cell",
        ),
        (
            "t;q\n0,1;1.5\n0,2;1,5\n",
            {},
            "column 't', line 2: '0,1' is not a real number. A comma could stand",
        ),
        (
            "t;q\n0,1;1.5\n0,2;1,5\n",
            {"decimal": ","},
            "column 'q', line 2: '1.5' is not a real number. "
            "The table has decimal commas: write all decimals in one way",
        ),
        ("t,q\n0,1,1,5\n", {}, "line 2 has 4 cells; expected 2.*decimal commas"),
        ("t,q\n0,1\n1\n", {}, "line 3 has 1 cell; expected 2, as in the header"),
        (
            "run,t,q\na,0,1\n,1,2\n",
            {"trajectory": "run"},
            "column 'run', line 3: the trajectory's name is missing",
        ),
        (
            "t,q\n0,1\n0,2\n",
            {},
            "column 't', line 3: 0.0 is not after 0.0 of line 2; "
            "times must increase strictly",
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
    with (
        latin.open(encoding="utf-8") as opened,
        pytest.raises(
            DataError, match=r"latin\.csv' cannot be read: 'utf-8' .* Give its"
        ),
    ):
        Measurements.from_csv(opened, time="t", states=["q"])
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"t,q\n0,1\x00\xff\n")
    with pytest.raises(DataError, match="it holds binary data and no text"):
        Measurements.from_csv(binary, time="t", states=["q"])
    with pytest.raises(DataError, match=r"missing\.csv' cannot be read"):
        Measurements.from_csv(tmp_path / "missing.csv", time="t", states=["q"])
    with pytest.raises(DataError, match="cannot be read"):
        Measurements.from_csv(tmp_path, time="t", states=["q"])
    of_bytes: Any = io.BytesIO(b"t,q\n0,1\n1,2\n")
    data = Measurements.from_csv(of_bytes, time="t", states=["q"])
    assert data.n_samples == 2, "an open file may give text or bytes"
    with pytest.raises(DataError, match="gives str; expected bytes"):
        Measurements.from_excel(io.StringIO("t,q"), time="t", states=["q"])


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_a_text_is_read_in_the_encodings_of_spreadsheets(
    tmp_path: Path, encoding: str
) -> None:
    path = tmp_path / "data.csv"
    path.write_bytes("t,Größe\r\n0,1.5\r\n1,2\r\n".encode(encoding))
    data = Measurements.from_csv(path, time="t", states={"q": "Größe"})
    assert data.trajectories[0].x[:, 0].tolist() == [1.5, 2.0]


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
    with pytest.raises(DataError, match=r"the file '.*a\.csv' is listed 2 times"):
        Measurements.from_csv([path, path], time="t", states=["q"])


# ---- data frames ----


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
            frame(q=pd.date_range("2024-01-01", periods=3)),
            {},
            "column 'q', row 'a': Timestamp.*seconds since the start",
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


@pytest.mark.parametrize("cell", ["1_000", "1_0.5"])
def test_digits_with_a_sign_between_them_are_no_number(cell: str) -> None:
    with pytest.raises(DataError, match=f"line 3: '{cell}' is not a real number"):
        read(f"t,q\n0,1\n1,{cell}\n")


@pytest.mark.parametrize("cell", [np.complex64(2j), 10**400, 1 + 0j])
def test_a_cell_that_no_float_holds_is_refused(cell: Any) -> None:
    table = frame(q=pd.Series([1.0, cell, 2.0], dtype=object))
    with pytest.raises(DataError, match=r"row 1: .* is not a real number"):
        Measurements.from_dataframe(table, time="t", states=["q"])

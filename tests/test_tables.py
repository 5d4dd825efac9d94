"""Reading tables: what is harmless reads the same, what is wrong is named by place.

Text of all kinds, data frames, Excel and MATLAB files.
"""

import datetime as dt
import io
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pandas as pd
import pytest
from scipy.io import savemat

import phsi_opt as ph

# Numbers are compared exactly: reading copies them. Times from dates are differences of
# moments that are exact to the microsecond, divided once: they are exact here too.


def frame(**columns: Any) -> pd.DataFrame:
    return pd.DataFrame(
        {"t": [0.0, 0.1, 0.3], "q": [1.0, 2.0, 3.0], "u": [0.0, 1.0, 0.0]} | columns
    )


def read(text: str, **options: Any) -> ph.Measurements:
    return ph.Measurements.from_csv(
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


@pytest.mark.parametrize("text", [
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
])  # fmt: skip
def test_harmless_variations_of_a_file_read_the_same(text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode("utf-8"))
    for source in (path, str(path), io.StringIO(text)):
        data = ph.Measurements.from_csv(source, time="t", states=["q"])
        np.testing.assert_array_equal(data.trajectories[0].t, [0, 1])
        np.testing.assert_array_equal(data.trajectories[0].x, [[1], [2]])


def test_several_files_are_several_trajectories_in_the_order_given(tmp_path) -> None:
    paths = [tmp_path / name for name in ("b.csv", "a.csv")]
    for i, path in enumerate(paths):
        path.write_text(
            f"t,q,run\n0,{i},x\n1,{i},x\n0,7,y\n1,7,y\n2,7,y\n", encoding="utf-8"
        )
    by_value = ph.Measurements.from_csv(paths, time="t", states=["q"], trajectory="run")
    assert [run.name for run in by_value] == ["b/x", "b/y", "a/x", "a/y"]
    assert [run.n_samples for run in by_value] == [2, 3, 2, 3]
    for path in paths:
        path.write_text("t,q\n0,1\n1,2\n", encoding="utf-8")
    by_file = ph.Measurements.from_csv(iter(paths), time="t", states=["q"])
    assert [run.name for run in by_file] == ["b", "a"]


def test_rows_of_one_run_need_not_be_contiguous_but_keep_their_order() -> None:
    data = read(
        "run,t,q\n007,0,1\n1.0,0,10\n007,1,2\n1.0,2,20\n007,5,3\n", trajectory="run"
    )
    assert [run.name for run in data] == ["007", "1.0"]
    np.testing.assert_array_equal(data.trajectories[0].x[:, 0], [1, 2, 3])
    np.testing.assert_array_equal(data.trajectories[1].t, [0, 2])


@pytest.mark.parametrize(("text", "options", "message"), [
    ("", {}, "open file is empty; expected a header line"),
    ("t,q\n", {}, "open file has no samples; expected at least 2 rows"),
    ("t,q\n0,1\n", {}, "trajectory 'run 1' has 1 sample; expected at least 2"),
    ("t,position\n0,1\n", {"states": {"q": "positon"}}, r"no column 'positon'.*Did you mean 'position'\?"),
    ("T,q\n0,1\n1,2\n", {}, r"no column 't'.*one of T, q\..*Did you mean 'T'\?"),
    ("t,q,q\n0,1,2\n1,2,3\n", {}, "2 columns called 'q'; expected one"),
    ("\nt,q\n\n0,1\n1,abc\n", {}, "column 'q', line 5: 'abc'"),
    ("t,q\n0,1\n1,1e400\n", {}, "column 'q', line 3: the value is inf; expected a finite value"),
    ("t,q\n0,1\n1,-1e101\n", {}, r"column 'q', line 3: the value is -1e\+101; expected at most 1e\+100 in size"),
    ("t,q\n0,1\n,2\n", {}, "column 't', line 3: the value is nan; times and inputs must be known"),
    ("t,q,u\n0,1,1\n1,2,NA\n", {"inputs": ["u"]}, "column 'u', line 3: the value is nan; times and inputs"),
    (
        't,q\n0,"1,500"\n1,"2,500"\n',
        {},
        "column 'q', line 2: '1,500' is not a real number. "
        'The comma may be a decimal or a thousands separator.*decimal = ","',
    ),
    ("t;q\n0,5;1.23,5\n1,5;2\n", {}, "column 'q', line 2: '1.23,5' is not a real number. Correct the cell"),
    ("t;q\n0,1;1.5\n0,2;1,5\n", {}, "column 't', line 2: '0,1' is not a real number. The comma may be"),
    (
        "t;q\n0,1;1.5\n0,2;1,5\n",
        {"decimal": ","},
        "column 'q', line 2: '1.5' is not a real number. "
        "The table has decimal commas: write all numbers with",
    ),
    ("t,q\n0,1,1,5\n", {}, "line 2 has 4 cells; expected 2.*decimal commas"),
    ("t,q\n0,1\n1\n", {}, "line 3 has 1 cell; expected 2, as in the header"),
    ("run,t,q\na,0,1\n,1,2\n", {"trajectory": "run"}, "column 'run', line 3: the trajectory's name is missing"),
    ("t,q\n0,1\n0,2\n", {}, "column 't', line 3: 0.0 repeats the time of line 2; times must increase"),
    ("t,q\n0,\n1,NA\n", {}, "trajectory 'run 1' has no measured value"),
    ("t,q\n0,1\n1,2\n", {"states": {"q": "q", "p": "q"}}, "the column 'q' is used twice"),
    ("t,q\n0,1\n1,2\n", {"inputs": {"u": None}}, "without a column; inputs must be measured"),
    ("t,q,u\n0,1,1\n1,2,1\n", {"inputs": {"q": "u"}}, "the name 'q' is used 2 times"),
    ("t,q\n0," + "9" * 200_000 + "\n", {}, "line 2: field larger than field limit"),
])  # fmt: skip
def test_a_file_that_cannot_be_used_is_refused_by_place(text, options, message) -> None:
    with pytest.raises(ph.DataError, match=f"(?s){message}"):
        read(text, **options)


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    latin = tmp_path / "latin.csv"
    latin.write_bytes("t,q\n0,1\n# Größe\n".encode("latin-1"))
    with (
        latin.open(encoding="utf-8") as opened,
        pytest.raises(
            ph.DataError, match=r"latin\.csv' cannot be read: 'utf-8' .* Give its"
        ),
    ):
        ph.Measurements.from_csv(opened, time="t", states=["q"])
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"t,q\n0,1\x00\xff\n")
    with pytest.raises(ph.DataError, match=r"binary\.csv' .*contains binary data"):
        ph.Measurements.from_csv(binary, time="t", states=["q"])
    with pytest.raises(ph.DataError, match=r"missing\.csv' cannot be read"):
        ph.Measurements.from_csv(tmp_path / "missing.csv", time="t", states=["q"])
    with pytest.raises(ph.DataError, match="cannot be read"):
        ph.Measurements.from_csv(tmp_path, time="t", states=["q"])
    of_bytes: Any = io.BytesIO(b"t,q\n0,1\n1,2\n")
    data = ph.Measurements.from_csv(of_bytes, time="t", states=["q"])
    assert data.n_samples == 2, "an open file may give text or bytes"
    with pytest.raises(ph.DataError, match="gives str; expected bytes"):
        ph.Measurements.from_excel(io.StringIO("t,q"), time="t", states=["q"])


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_a_text_is_read_in_the_encodings_of_spreadsheets(tmp_path, encoding) -> None:
    path = tmp_path / "data.csv"
    path.write_bytes("t,Größe\r\n0,1.5\r\n1,2\r\n".encode(encoding))
    data = ph.Measurements.from_csv(path, time="t", states={"q": "Größe"})
    assert data.trajectories[0].x[:, 0].tolist() == [1.5, 2.0]


# ---- data frames ----


def test_a_data_frame_is_not_changed() -> None:
    table = frame(run=["a", "a", "a"], note=["x", None, "y"])
    before = table.copy(deep=True)
    data = ph.Measurements.from_dataframe(
        table, time="t", states=["q"], inputs=["u"], trajectory="run"
    )
    pd.testing.assert_frame_equal(table, before)
    table.loc[0, "q"] = 99.0
    assert data.trajectories[0].x[0, 0] == 1.0


@pytest.mark.parametrize(("table", "options", "message"), [
    (frame(q=[1.0, np.inf, 2.0]), {}, "data frame, column 'q', row 'b': the value is inf"),
    (frame(q=["1", "x", "2"]), {}, "data frame, column 'q', row 'b': 'x' is not a real number"),
    (frame(q=[1.0, 2j, 2.0]), {}, "column 'q', row 'a': .* is not a real number. Convert the column"),
    (frame(q=pd.date_range("2024-01-01", periods=3)), {}, "column 'q', row 'a': Timestamp.*seconds since the start"),
    (frame(t=[0.0, np.nan, 1.0]), {}, "column 't', row 'b': the value is nan"),
    (frame(t=[pd.Timestamp(2024, 1, 1), pd.NaT, pd.Timestamp(2024, 1, 2)]), {}, "column 't', row 'b': the time is missing"),
    (frame(u=[0.0, np.nan, 1.0]), {"inputs": ["u"]}, "column 'u', row 'b': the value is nan"),
    (frame(run=["a", None, "a"]), {"trajectory": "run"}, "column 'run', row 'b': the trajectory's name is missing"),
    (frame().iloc[:0], {}, "data frame has no samples"),
    ([[0.0, 1.0]], {}, r"frame is a list; expected a pandas.DataFrame \(files: from_csv\)"),
    (frame().rename(columns={"u": "q"}), {}, "2 columns called 'q'"),
])  # fmt: skip
def test_a_data_frame_that_cannot_be_used_is_refused_by_row(
    table: Any, options: dict[str, Any], message: str
) -> None:
    if isinstance(table, pd.DataFrame):
        table = table.set_axis(["a", "b", "c"][: len(table)], axis=0)
    with pytest.raises(ph.DataError, match=message):
        ph.Measurements.from_dataframe(
            table, **({"time": "t", "states": ["q"]} | options)
        )


# ---- text of all kinds ----


def read_text(text: str, **options: Any) -> ph.Measurements:
    return ph.Measurements.from_csv(io.StringIO(text), **options)


@pytest.mark.parametrize("text", [
    "0,1.5,-2\n0.5,1e1,3\n",
    "0;1.5;-2\n0.5;10;3\n",
    "0;1,5;-2\n0,5;1,0e1;3\n",
    "0\t1,5\t-2\n0,5\t10\t3\n",
    "  0   1.5  -2\n  0.5 10   3  \n",
    "0 1,5 -2\n0,5 10 3\n",
    "0 \t1.5\t -2\r\n\r\n0.5 10 3\r\n",
    "0;1,5;-2;\n0,5;10;3;\n",
    '"0","1.5","-2"\n"0.5","10","3"\n',
    '"0,0","1,5","-2"\n"0,5","10","3"\n',
])  # fmt: skip
def test_a_table_without_a_header_reads_the_same_however_it_is_written(text) -> None:
    options: dict[str, Any] = {"decimal": ","} if '"0,0"' in text else {}
    for names in ((0, 1, 2), ("0", "1", "2")):
        data = read_text(
            text,
            time=names[0],
            states={"q": names[1]},
            inputs={"u": names[2]},
            **options,
        )
        np.testing.assert_array_equal(data.trajectories[0].t, [0, 0.5])
        np.testing.assert_array_equal(data.trajectories[0].x, [[1.5], [10]])
        np.testing.assert_array_equal(data.trajectories[0].u, [[-2], [3]])
    named = read_text(
        text, columns=["t", "q", "u"], time="t", states=["q"], inputs=["u"], **options
    )
    assert named.digest == data.digest


def test_rows_may_be_counted_where_no_column_has_the_times() -> None:
    data = read_text(
        "run,q\na,1\nb,2\na,3\nb,4\n", step=0.5, states=["q"], trajectory="run"
    )
    for run in data:
        np.testing.assert_array_equal(run.t, [0, 0.5])


@pytest.mark.parametrize(("text", "options", "message"), [
    ("0,1\n1,2\n", {"states": {"q": 2}}, "no column 2; it has 2 columns, counted"),
    ("0,1\n1,2\n", {"states": ["q"]}, r"no column 'q'; expected one of 0, '1'\."),
    ("0,1\n1,x\n", {}, "column 1, line 2: 'x' is not a real number"),
    ("t,q\n1,2\n", {"columns": ["t", "q"]}, "line 1 contains names.*Omit columns"),
    ("0,1\n1,2\n", {"skip": 9}, "open file: skip=9, and there is no such row"),
    ("0,1\n1,2\n", {"columns": ["t"]}, "has 2 columns; columns=.* names 1"),
    ("0,1\n", {"columns": "tq"}, "columns='tq' is not possible; expected Sequence"),
    ("0,1\n", {"columns": ["t", 1]}, r"columns=\['t', 1\] is not possible"),
    ("0,1\n", {"separator": ",,"}, "the separator ',,' is not a single character"),
    ("0,1\n", {"decimal": ";"}, "the decimal separator ';' is unknown"),
    ("0,1\n", {"decimal": ",", "separator": ","}, "two different characters"),
    ("0,1\n1,2\n", {"time": None}, "time=None and step=None; expected exactly " "one of"),
    ("0,1\n1,2\n", {"step": 0.1}, "time=0 and step=0.1; expected exactly one of " "them"),
    ("0,1\n1,2\n", {"time": None, "step": -1}, "step=-1 is not a time between rows"),
    ("0,1\n1,2\n", {"start": "2021-01-01"}, "needs dates, but the column 0"),
    ("0,1\n1,2\n", {"time": None, "step": 1, "start": "2021-01-01"}, "start and date_format apply to"),
    ("a,b\nt,q\n0,1,2\n", {}, "line 3 has 3 cells.*lines of text above the table"),
])  # fmt: skip
def test_a_table_that_cannot_be_used_is_refused_by_place(
    text: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ph.DataError, match=f"(?s){message}"):
        read_text(text, **({"time": 0, "states": {"q": 1}} | options))


# ---- dates ----


@pytest.mark.parametrize(("first", "second", "options"), [
    ("2021-11-22 09:00:00", "2021-11-22 09:15:00.25", {}),
    ("2021-11-22T09:00:00", "2021-11-22T09:15:00.250", {}),
    ("2021-11-22T09:00Z", "2021-11-22T10:15:00.25+01:00", {}),
    ("09:00:00", "09:15:00,25", {}),
    ("22.11.2021 09:00:00.0", "22.11.2021 09:15:00.25", {"date_format": "%d.%m.%Y %H:%M:%S.%f"}),
])  # fmt: skip
def test_dates_are_seconds_since_the_first_sample(first, second, options) -> None:
    data = read_text(f"t;q\n{first};1\n{second};2\n", time="t", states=["q"], **options)
    np.testing.assert_array_equal(data.trajectories[0].t, [0, 900.25])
    assert data.units["t"] == "s"


@pytest.mark.parametrize(("first", "second", "form", "apart"), [
    ("20210131", "20210201", "%Y%m%d", 86400),
    ("20210131.0", "20210201.0", "%Y%m%d", 86400),  # as pandas writes it
    ("2021013123", "2021020100", "%Y%m%d%H", 3600),
    ("202101312359", "202102010000", "%Y%m%d%H%M", 60),
    ("20210131235959", "20210201000000", "%Y%m%d%H%M%S", 1),
    ("20210131235959.25", "20210201000000", "%Y%m%d%H%M%S.%f", 0.75),
])  # fmt: skip
def test_numbers_that_look_like_dates_are_refused_until_told_what_they_are(
    first: str, second: str, form: str, apart: float
) -> None:
    text = f"day,q\n{first},1\n{second},2\n"
    frame = pd.read_csv(io.StringIO(text))
    options: dict[str, Any] = {"time": "day", "states": ["q"]}
    number = float(first)
    said = f"column 'day', .*{first} looks like 2021-01-31 .* expected.*{form}"
    for units in (None, {"t": "s"}):
        with pytest.raises(ph.DataError, match=said):
            read_text(text, units=units, **options)
    with pytest.raises(ph.DataError, match=r"column 'day'.*looks like 2021-01-31"):
        ph.Measurements.from_dataframe(frame, **options)
    for kind, t in ((form, [0, apart]), ("", [number, float(second)])):
        table = read_text(text, date_format=kind, **options)
        np.testing.assert_array_equal(table.trajectories[0].t, t)
        table = ph.Measurements.from_dataframe(frame, date_format=kind, **options)
        np.testing.assert_array_equal(table.trajectories[0].t, t)


def test_each_run_has_its_own_clock_unless_a_start_is_given() -> None:
    text = "run,t,q\na,2021-01-01,1\na,2021-01-02,2\nb,2021-01-03,3\nb,2021-01-04,4\n"
    options: dict[str, Any] = {"time": "t", "states": ["q"], "trajectory": "run"}
    day = 86400.0
    for run in read_text(text, **options):
        np.testing.assert_array_equal(run.t, [0, day])
    common = read_text(text, start="2021-01-01 12:00", **options)
    np.testing.assert_array_equal(common["b"].trajectories[0].t, [1.5 * day, 2.5 * day])
    moment = dt.datetime(2021, 1, 1, 12)
    assert read_text(text, start=moment, **options).digest == common.digest


@pytest.mark.parametrize(("first", "second", "options", "message"), [
    (
        "2021-11-22 09:00",
        "2021-11-22 09:00",
        {},
        "column 't', line 3: 2021-11-22 09:00:00 repeats the time of "
        "line 2; times must increase.*autumn",
    ),
    (
        "2021-11-22 09:00Z",
        "2021-11-22 09:15",
        {},
        "line 3: '2021-11-22 09:15' is a date without time zone, and the first "
        "cell of the column is a date with time zone",
    ),
    ("2021-11-22 09:00 CET", "2021-11-22 09:15 CET", {}, "line 2: '2021-11-22 09:00 CET' is neither .*names of time zones are not"),
    ("2021-11-22 09:00", "", {}, "line 3: the time is missing"),
    ("22.11.2021", "23.11.2021", {}, "line 2: '22.11.2021' is neither .*date_form"),
    ("22.11.2021", "2021-11-22", {"date_format": "%d.%m.%Y"}, "line 3: '2021-11-22' does not match date_format='%d.%m.%Y'"),
    ("2021-11-22", "x", {}, "line 3: 'x' is neither a number nor a date"),
    ("0", "2021-11-22", {}, "line 3: '2021-11-22' is not a real number"),
    ("2021-11-22", "2021-11-23", {"start": "2021-11-22Z"}, "start='2021-11-22Z' is not a date without time zone"),
    ("2021-11-22", "2021-11-23", {"units": {"t": "h"}}, "the unit 'h', and dates"),
    ("09:00:00", "2021-11-22", {}, "is a date without time zone, and the first cell of the column is a time of day;"),
    ("09:00:00", "10:00:00", {"start": "2021-11-22"}, "is not a time of day like the times; expected a form such as '9:00:00'"),
])  # fmt: skip
def test_dates_that_cannot_be_used_are_refused_by_row(
    first: str, second: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ph.DataError, match=f"(?s){message}"):
        read_text(f"t;q\n{first};1\n{second};2\n", time="t", states=["q"], **options)


def test_dates_of_a_data_frame_are_times_too() -> None:
    times = pd.date_range("2021-11-22", periods=3, freq="15min", tz="Europe/Berlin")
    frame = pd.DataFrame({"t": times, "q": [1.0, 2.0, 3.0]})
    data = ph.Measurements.from_dataframe(frame, time="t", states=["q"])
    np.testing.assert_array_equal(data.trajectories[0].t, [0, 900, 1800])
    of_day: Any = [dt.time(9), dt.timedelta(hours=9, minutes=15), "09:30:00"]
    data = ph.Measurements.from_dataframe(
        frame.assign(t=of_day), time="t", states=["q"], start=dt.time(8)
    )
    np.testing.assert_array_equal(data.trajectories[0].t, [3600, 4500, 5400])


# ---- Excel ----


def workbook(path: Path, sheets: dict[str, list[list[Any]]]) -> Path:
    book = openpyxl.Workbook()
    book.remove(book.active)
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(row)
    book.save(path)
    return path


def test_an_excel_sheet_reads_like_the_text_table(tmp_path: Path) -> None:
    rows: list[list[Any]] = [
        ["t", "q", None, "note"],
        [0, 1.5, None, "x"],
        [],
        [0.5, None, None, None],
        [1, 3],
    ]
    path = workbook(tmp_path / "bench.xlsx", {"notes": [], "Tabelle1": rows})
    data = ph.Measurements.from_excel(path, time="t", states=["q"])
    assert [run.name for run in data] == ["bench"]
    np.testing.assert_array_equal(data.trajectories[0].t, [0, 0.5, 1])
    np.testing.assert_array_equal(data.trajectories[0].x[:, 0], [1.5, np.nan, 3])
    with path.open("rb") as file:
        again = ph.Measurements.from_excel(file, time=0, states={"q": 1})
    np.testing.assert_array_equal(again.trajectories[0].x, data.trajectories[0].x)


def test_excel_dates_texts_and_sheets_without_a_header(tmp_path: Path) -> None:
    begin = dt.datetime(2021, 11, 22, 9)
    rows = [[begin, "1,5"], [begin + dt.timedelta(minutes=15), "2,5"]]
    path = workbook(tmp_path / "a.xlsx", {"one": rows, "two": rows})
    data = ph.Measurements.from_excel(path, sheet="two", time=0, states={"q": 1})
    np.testing.assert_array_equal(data.trajectories[0].t, [0, 900])
    np.testing.assert_array_equal(data.trajectories[0].x, [[1.5], [2.5]])


@pytest.mark.parametrize(("sheets", "options", "message"), [
    ({"a": [["t", "q"], [0, 1], [1, "#DIV/0!"]]}, {}, "column 'q', row 3: '#DIV/0!' is not a real number"),
    ({"a": [["t", "q"], [0, 1], [0, 2]]}, {}, "column 't', row 3: 0.0 repeats the time of"),
    ({"a": [["t", "q"], [0, "1,500"], [1, 2]]}, {}, "row 2: '1,500' .* set decimal = \",\""),
    ({"a": [["t", "q"], [0, 1], [None, 2]]}, {}, "column 't', row 3: the value is n"),
    ({"a": [[1, 2]], "b": [[1, 2]]}, {}, r"several sheets with content: \['a', 'b'\]"),
    ({"a": [[1, 2]]}, {"sheet": "A"}, "no sheet 'A'; .* Did you mean 'a'"),
    ({"a": []}, {}, "is empty; expected a header row"),
    ({"a": []}, {"sheet": "a"}, "has an empty sheet 'a'"),
])  # fmt: skip
def test_a_workbook_that_cannot_be_used_is_refused_by_place(
    sheets: dict[str, list[list[Any]]],
    options: dict[str, Any],
    message: str,
    tmp_path: Path,
) -> None:
    path = workbook(tmp_path / "bench.xlsx", sheets)
    with pytest.raises(ph.DataError, match=f"(?s)file '.*bench.xlsx'.*{message}"):
        ph.Measurements.from_excel(path, **({"time": "t", "states": ["q"]} | options))


# ---- MATLAB ----


def mat(content: dict[str, Any]) -> io.BytesIO:
    file = io.BytesIO()
    savemat(file, content)
    file.seek(0)
    return file


T = np.arange(4.0)
X = np.column_stack([T**2, -T])
SIGNALS = np.array([("angle", T**2), ("torque", -T)], [("Name", "O"), ("Data", "O")])
# As dSPACE records it: the times and a list of signals, each in a struct.
RECORDING = {"rec": {"X": {"Name": "time", "Data": T}, "Y": SIGNALS}}


@pytest.mark.parametrize(("content", "options"), [
    ({"t": T, "q": T**2, "u": -T}, {"time": "t", "states": ["q"], "inputs": ["u"]}),
    ({"t": T[:, np.newaxis], "X": X, "gain": 3.0}, {"time": "t", "states": {"q": "X(:,1)"}, "inputs": {"u": "X(:, 2)"}}),
    ({"t": T, "X": X.T}, {"time": "t", "states": {"q": "X(1,:)"}, "inputs": {"u": "X(2,:)"}}),
    ({"log": {"t": T, "X": X, "name": "x"}}, {"time": "log.t", "states": {"q": "X(:,1)"}, "inputs": {"u": "log.X(:,2)"}}),
    ({"log": {"run": {"t": T, "X": X}}}, {"time": "log.run.t", "states": {"q": "run.X(:,1)"}, "inputs": {"u": "X(:,2)"}}),
    (RECORDING, {"time": "rec.X.Data", "states": {"q": "rec.Y(1).Data"}, "inputs": {"u": "Y(2).Data"}}),
    ({"X": X.astype(np.int16)}, {"step": 1, "states": {"q": "X(:,1)"}, "inputs": {"u": "X(:,2)"}}),
])  # fmt: skip
def test_vectors_matrices_and_structs_of_matlab_are_columns(content, options) -> None:
    data = ph.Measurements.from_mat(mat(content), **options)
    np.testing.assert_array_equal(data.trajectories[0].t, T)
    np.testing.assert_array_equal(data.trajectories[0].x[:, 0], T**2)
    np.testing.assert_array_equal(data.trajectories[0].u[:, 0], -T)


@pytest.mark.parametrize(("content", "message"), [
    (
        {
            "time": T,
            "X": X,
            "gain": 3.0,
            "name": "x",
            "c": np.array([X, "a"], object),
        },
        r"no column 't'. The file contains: 'time' \(4 numbers\), 'X' \(4 x 2 numbers: "
        r"X\(:,1\), \.\.\.\), 'gain' \(the number 3\), 'name' \(the text 'x'\), 'c' \(c",
    ),
    ({"t": T, "q": X}, r"no column 'q'.*'q' \(4 x 2 numbers: q\(:,1\)"),
    ({"t": T, "q": T[:3]}, r"differ in length: {'t': 4, 'q': 3}.*The file contains"),
    ({"t": T, "q": "text"}, r"no column 'q'.*'q' \(the text 'text'\)"),
    ({"t": T, "a": {"q": T}, "b": {"q": T}}, r"several structs; .*\['a.q', 'b.q'\]"),
    ({"t": T, "a": {"q": np.zeros(1001, [("x", "f8")])}}, r"'a.q' \(a list of 1001 structs"),
    ({"t": T[::-1].copy(), "q": T}, "column 't', row 2: time goes back from 3.0 in"),
    ({"t": T, "q": np.where(T == 1, np.inf, T)}, "column 'q', row 2: the value is inf"),
    ({"t": T, "q": T * 1j}, "column 'q', row 1: .* is not a real number"),
    ({"t": T, "q": np.zeros((0, 0))}, r"'q' \(empty\)"),
])  # fmt: skip
def test_a_matlab_file_that_cannot_be_used_is_refused_with_what_it_holds(
    content: dict[str, Any], message: str
) -> None:
    with pytest.raises(ph.DataError, match=f"(?s)open file.*{message}"):
        ph.Measurements.from_mat(mat(content), time="t", states=["q"])


def test_signals_in_structs_are_listed_with_their_names() -> None:
    with pytest.raises(
        ph.DataError,
        match=r"'rec.Y\(2\).Name' \(the text 'torque'\), 'rec.Y\(2\).Data' \(4 numbers\)",
    ):
        ph.Measurements.from_mat(mat(RECORDING), time="t", states=["q"])
    many = {f"x{i}": T for i in range(60)}
    with pytest.raises(ph.DataError, match=r"'x49' \(4 numbers\) and 10 more\."):
        ph.Measurements.from_mat(mat(many), time="t", states=["q"])


def test_a_column_that_is_called_by_a_number_of_numpy_is_refused_by_name() -> None:
    frame = pd.DataFrame({"t": [0.0, 1.0, 2.0], "q": [1.0, 2.0, 3.0]})
    with pytest.raises(ph.DataError, match=r"has no column .*1\.0.*; expected one"):
        ph.Measurements.from_dataframe(frame, time=np.float64(1), states=["q"])

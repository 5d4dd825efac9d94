"""Files as loggers write them: where the table stands, its units, its clock."""

import datetime as dt
import io
import struct
import sys
import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pytest

import phsi_opt as ph
from phsi_opt.data.file_opening import READERS
from phsi_opt.study_file.sections import DataSection
from phsi_opt.study_file.survey import TableSurvey, first_text, survey

T = [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]
Q = [20.5, 1.25, -3.5, 4.0, 1234.5, -7.75]
U = [1.5, 1.25, 2.0, 2.5, 1.0, 0.5]


def body(form: str, rows: Any = None) -> str:
    """The samples, each by a format of t, q, u and its number n."""
    samples = zip(T, Q, U, strict=True) if rows is None else rows
    return "".join(
        form.format(t=t, q=q, u=u, n=n) + "\n" for n, (t, q, u) in enumerate(samples)
    )


def german(text: str) -> str:
    return text.replace(".", ",")


def looked_at(text: str, tmp_path: Path, encoding: str = "utf-8") -> TableSurvey:
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode(encoding))
    return survey(path)


def read(text: str, **options: Any) -> ph.Measurements:
    return ph.Measurements.from_csv(io.StringIO(text), **options)


# By logger: the text, the columns of t, q and u, and their units.
FILES: dict[str, tuple[str, tuple[str, str, str], tuple[str, str, str]]] = {
    "settings and a comment column that no line has": (
        "LabVIEW Measurement\t\nSeparator\tTab\nDate\t2024/03/05\n***End_of_Header***\n\n"
        "Channels\t2\t\nSamples\t6\t6\t\nDate\t2024/03/05\t2024/03/05\t\nY_Unit_Label\tmm\tN\t\n"
        "X_Dimension\tTime\tTime\t\nX0\t0.0E+0\t0.0E+0\t\nDelta_X\t0.5\t0.5\t\n***End_of_Header***\n"
        "X_Value\tPosition\tForce\tComment\n" + body("{t}\t{q}\t{u}"),
        ("X_Value", "Position", "Force"), ("", "", ""),
    ),
    "units in brackets and an empty line": (
        "Time,Channel A,Channel B\n(s),(V),(mV)\n\n" + body("{t},{q},{u}"),
        ("Time", "Channel A", "Channel B"), ("s", "V", "mV"),
    ),
    "units of some columns": (
        'Vendor,"GRAPHTEC","GL820"\nTotal points,6\nNumber,Clock,CH1,CH2,Alarm\n'
        'NO.,"s","mm","N","A1234"\n' + body('{n},"{t}","{q:+}","{u:+}","LLLL"'),
        ("Clock", "CH1", "CH2"), ("s", "mm", "N"),
    ),
    "units above the names": ("s,mm,N\nt,V,A\n" + body("{t},{q},{u}"), ("t", "V", "A"), ("s", "mm", "N")),
    "commas, points for thousands, trailing separators": (
        'Trace;Trace_1;\nSample;Time [ms];"Drive.Position" [mm];"Drive.Torque" [Nm];\n'
        + german(body("{n};{t};{q};{u};")).replace("1234,5", "1.234,5"),
        ("Time [ms]", "Drive.Position [mm]", "Drive.Torque [Nm]"), ("ms", "mm", "Nm"),
    ),
    "commas for thousands": (
        "Time (s),Flow (l/min),Level\n" + body('{t},"{q:,}",{u}'),
        ("Time (s)", "Flow (l/min)", "Level"), ("s", "l/min", ""),
    ),
    "comments above, a footer": (
        "# bench 3, run 12\n# gain, 2.5\nt,q,u\n" + body("{t},{q},{u}") + "End of data\n",
        ("t", "q", "u"), ("", "", ""),
    ),
    "names in a comment": ("# t q u\n# s mm N\n" + body("{t} {q} {u}"), ("t", "q", "u"), ("s", "mm", "N")),
    "statistics below": (
        "t,q,u\n" + body("{t},{q},{u}") + "\nchannel,mean,std\nq,0.5,1.5\nu,1.2,2\n", ("t", "q", "u"), ("", "", "")
    ),
    "settings without a blank line": (
        '"Model","DL850"\n"Name","CH1","CH2"\n"Size","6","6"\n"Rate","2","2"\nt,q,u\n' + body("{t},{q},{u}"),
        ("t", "q", "u"), ("", "", ""),
    ),
    "serial numbers of sensors": (
        '"Plot: 102"\n"#","Time, s","Temp, °C (S/N: 102, S/N: 7)","RH, % (S/N: 1)"\n' + body("{n},{t},{q},{u}"),
        ("Time, s", "Temp, °C (S/N: 102, S/N: 7)", "RH, % (S/N: 1)"), ("s", "°C", "%"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_a_logger_file_is_read_as_its_author_meant_it(name, tmp_path) -> None:
    text, columns, units = FILES[name]
    time, q, u = columns
    data = read(text, time=time, states={"q": q}, inputs={"u": u})
    (run,) = data.trajectories
    np.testing.assert_array_equal(run.t, T)
    np.testing.assert_array_equal(run.x[:, 0], Q)
    np.testing.assert_array_equal(run.u[:, 0], U)
    seen = {one.column: one.unit for one in looked_at(text, tmp_path).columns}
    assert tuple(map(seen.get, columns)) == units
    if ";" not in text:
        rows = [line.split("\t" if "\t" in text else None) for line in text.split("\n")]
        book = openpyxl.Workbook()
        for row in rows if "\t" in text else []:
            book.active.append(row)
        if book.active.max_row > 1:
            book.save(tmp_path / "log.xlsx")
            again = ph.Measurements.from_excel(
                tmp_path / "log.xlsx", time=time, states={"q": q}, inputs={"u": u}
            )
            assert again.trajectories[0].x.tolist() == run.x.tolist()


def test_a_row_of_units_is_believed_where_nobody_says_otherwise() -> None:
    text = "run,time,angle\n-,s,deg\n1,0.00,70.1\n1,0.02,69.4\n2,0,3\n2,0.02,4\n"
    options: dict[str, Any] = {"trajectory": "run", "states": {"q": "angle"}}
    data = read(text, time="time", **options)
    assert data.units == {"t": "s", "q": "deg"}
    assert read(text, time="time", units={"q": ""}, **options).units["q"] == ""
    tables = [io.StringIO(text), io.StringIO(text.replace("deg", "rad"))]
    with pytest.raises(
        ph.DataError, match=r"'q' has the unit 'rad', but in a .* 'deg'"
    ):
        ph.Measurements.from_csv(tables, time="time", **options)
    dates = "when,q\nh,m\n2026-01-01 00:00,1\n2026-01-01 00:01,2\n"
    assert read(dates, time="when", states=["q"]).units == {"t": "s", "q": "m"}


def test_what_was_understood_is_told_with_its_keys(tmp_path: Path) -> None:
    text = "Bench 3\n\nt;q\ns;mm\n# begin\n0;1,5\n1;2,5\n2;3,5\nEnd\n"
    seen = looked_at(text, tmp_path)
    assert [str(one) for one in seen.read] == [
        "skip = 2          header in line 3, samples in lines 6 to 8; not read: lines "
        "from 9 on",
        "units_row = 4     units in line 4",
        'separator = ";"   between cells',
        'decimal = ","     before decimals; a point marks thousands',
    ]


@pytest.mark.parametrize(("between", "n"), [
    ("End of run 1\nt,q,u\n", 8),
    ("t,q,u\n", 8),
    ("\nx,y\ns,m\n", 9),
    ("# step\n", 8),
    ("%step, 2 V\n", 8),
])  # fmt: skip
def test_a_file_with_several_tables_or_a_comment_is_to_be_cut(
    between: str, n: int, tmp_path: Path
) -> None:
    rows = body("{t},{q},{u}")
    text = f"t,q,u\n{rows}{between}{rows}"
    words = between.split()[0].split(",")[0]
    said = rf"line {n} contains '{words}.*samples stand above it and below .* Cut the"
    with pytest.raises(ph.DataError, match=said):
        read(text, time="t", states=["q"])
    with pytest.raises(ph.DataError, match=said):
        looked_at(text, tmp_path)
    book = openpyxl.Workbook()
    for line in text.splitlines():
        book.active.append(line.split(","))
    book.save(tmp_path / "log.xlsx")
    with pytest.raises(ph.DataError, match=said.replace("line", "row")):
        ph.Measurements.from_excel(tmp_path / "log.xlsx", time="t", states=["q"])
    # What the user said is no part of the table is none.
    data = read(f"x,y\n0,1\n1,2\nt,q,u\n{rows}", skip=3, time="t", states=["q"])
    assert data.trajectories[0].x[:, 0].tolist() == Q


@pytest.mark.parametrize(("text", "said"), [
    ("t,q\n0,1\nOL,OL\n1,2\n2,3\n", "line 3 contains 'OL, OL'"),
    ("t,q,u\n0,1,2\n#DIV/0!,,0.5\n2,3,4\n", "column 't', line 3: '#DIV/0!'"),
    ("t,q,u\n0,1,2\n#N/A,#N/A,#N/A\n2,3,4\n", "line 3 contains '#N/A, #N/A, #N/A'"),
    ("t,q\n#REF!,1\n1,2\n2,3\n", "line 2: '#REF!' is neither a number nor a date"),
    ("t,q\n0,1\n#VALUE!,2\n2,3\n", "line 3: '#VALUE!'"),
    ("t,q\n0,1\n1,2\nMean,0.5\n", "line 4: 'Mean'"),
    ("t,q\n0,1\n1,1_000\n2,3\n", "line 3: '1_000'"),
    ("t\tq\n0\t1,000\n1\t1,500\n", "'1,000' is not a real number.*decimal = "),
    ("t,q\n0,1\n1,2\n\n3\n4\n", "line 5 has 1 cell"),
])  # fmt: skip
def test_no_sample_and_no_sign_is_dropped_or_read_otherwise(text, said) -> None:
    with pytest.raises(ph.DataError, match=said):
        read(text, time="t", states=["q"])


# ---- clocks ----

BEGIN = dt.datetime(2024, 3, 5, 14, 30)
SERIAL = (BEGIN - dt.datetime(1899, 12, 30)) / dt.timedelta(days=1)
UNIX = (BEGIN - dt.datetime(1970, 1, 1)) / dt.timedelta(seconds=1)


@pytest.mark.parametrize(("header", "form", "column", "date_format"), [
    ("Date,Time", "2024-03-05,14:30:{0:06.3f}", ("Date", "Time"), ""),
    ("Datum,Uhrzeit", "05.03.2024,14:30:{0:06.3f}", ("Datum", "Uhrzeit"), "%d.%m.%Y %H:%M:%S.%f"),
    ("Time,Millis", "2024-03-05 14:30:{1:02d},{2}", ("Time", "Millis"), ""),
    ("Date&Time,ms", "2024/03/05 14:30:{1:02d},{2:03d}", ("Date&Time", "ms"), "%Y/%m/%d %H:%M:%S"),
    ("time", "03/15/24 02:30:{1:02d} PM", "time", "%m/%d/%y %I:%M:%S %p"),
    ("timestamp", "{unix:.1f}", "timestamp", "unix"),
    ("timestamp", "{unix_ms:.0f}", "timestamp", "unix ms"),
    ("Date", "{serial:.9f}", "Date", "excel"),
])  # fmt: skip
def test_clocks_of_loggers_become_seconds(
    header: str, form: str, column: Any, date_format: str, tmp_path: Path
) -> None:
    seconds = [0.0, 1.0, 2.0] if "PM" in form else [0.0, 0.25, 1.5]
    lines = []
    for s, q in zip(seconds, (3.0, 4.5, 2.0), strict=True):
        unix, serial = UNIX + s, SERIAL + s / 86400
        clock = form.format(
            s,
            int(s),
            round(1000 * (s % 1)),
            unix=unix,
            unix_ms=1000 * unix,
            serial=serial,
        )
        lines.append(f"{clock},{q}\n")
    seen = looked_at(f"{header},q\n{''.join(lines)}", tmp_path)
    assert seen.time is not None
    assert seen.time.source == column
    assert seen.time.date_format == date_format
    data = ph.Measurements.from_csv(
        seen.path, time=column, states=["q"], date_format=date_format or None
    )
    rounding = 0.1 if "unix:" in form else 1e-4  # of what the file has
    np.testing.assert_allclose(data.trajectories[0].t, seconds, atol=rounding)
    assert data.trajectories[0].origin is not None


def two_clocks(first: str = "Time A [s]", second: str = "Time B [s]") -> str:
    """A position every half second, and a force every second, from 1 s on."""
    t = np.arange(40) / 2
    rows = [
        f"{t[n]},{np.sin(t[n])},{n + 1 if n < 17 else ''},{3 * n if n < 17 else ''}\n"
        for n in range(40)
    ]
    return f"{first},Position [m],{second},Force [N]\n{''.join(rows)}"


def test_channels_of_another_clock_are_put_on_the_times(tmp_path: Path) -> None:
    (tmp_path / "two.csv").write_text(two_clocks())
    words: Any = {"time": "Time A [s]", "states": {"q": "Position [m]"}}
    words |= {"inputs": {"u": "Force [N]"}, "clocks": {"u": "Time B [s]"}}
    data = ph.Measurements.from_csv(tmp_path / "two.csv", **words)
    (run,) = data.trajectories
    np.testing.assert_array_equal(run.t, np.arange(2, 35) / 2)  # that both cover
    np.testing.assert_allclose(run.x[:, 0], np.sin(run.t), atol=1e-12)
    np.testing.assert_allclose(run.u[:, 0], 3 * (run.t - 1), atol=1e-12)
    held = ph.Measurements.from_csv(tmp_path / "two.csv", hold="zero", **words)
    (run,) = held.trajectories
    np.testing.assert_array_equal(run.u[:, 0], 3 * np.minimum(np.floor(run.t - 1), 16))
    assert run.t[-1] == 19.5  # the last value is held
    words |= {"inputs": None, "states": {"q": "Position [m]", "f": "Force [N]"}}
    words["clocks"] = {"f": "Time B [s]"}
    (run,) = ph.Measurements.from_csv(tmp_path / "two.csv", **words).trajectories
    assert len(run.t) == 40 and np.isfinite(run.x[:, 1]).sum() == 33
    (tmp_path / "two.csv").write_text(two_clocks().replace(",5,12", ",2,12"))
    for clocks, said in (
        ({"v": "Time B [s]"}, "clocks: there is no state and no input 'v'"),
        ({"f": "Time C"}, "has no column 'Time C'"),
        ({"f": "Time B [s]"}, "line 6: .*increase from line to line"),
    ):
        with pytest.raises(ph.DataError, match=said):
            ph.Measurements.from_csv(
                tmp_path / "two.csv", **{**words, "clocks": clocks}
            )


def test_a_study_file_says_which_clock_a_channel_has(tmp_path: Path) -> None:
    seen = looked_at(two_clocks(), tmp_path)
    said = {one.column: (one.part, one.said) for one in seen.columns}
    assert said["Time B [s]"] == ("left out", "another time column (its own times)")
    assert said["Force [N]"] == (
        "input",
        "0 to 48, 23 cells missing; times in Time B [s]",
    )
    text = first_text(seen, [tmp_path / "log.csv"], tmp_path)
    assert 'Force = { column = "Force [N]", unit = "N", clock = "Time B [s]" }' in text
    assert DataSection.of(tomllib.loads(text)["data"]).measurements(
        tmp_path
    ).trajectories[0].u[:2, 0].tolist() == [0.0, 1.5]
    seen = looked_at(two_clocks(second="Time B [ms]"), tmp_path)
    said = {one.column: (one.part, one.said) for one in seen.columns}
    assert said["Force [N]"] == (
        "left out",
        "another time column, Time B [ms], in another unit than Time A [s]: put it on common "
        "times to use it",
    )


def test_a_second_clock_with_the_same_moments_is_left_out(tmp_path: Path) -> None:
    t = np.arange(40) / 2
    q, u = np.sin(t), np.cos(2 * t)
    same = [f"{t[n]},{q[n]},{1000 * t[n] + 5},{u[n]}\n" for n in range(40)]
    seen = looked_at("Time,Position,Time_ms,Force\n" + "".join(same), tmp_path)
    assert [one.part for one in seen.columns] == ["time", "state", "left out", "input"]


# ---- binary files ----


def mdf_file(path: Path) -> Path:
    asammdf = pytest.importorskip("asammdf")
    t = np.array(T)
    slow = t[::2]
    with asammdf.MDF(version="4.10") as mdf:
        signal = asammdf.Signal
        fast = [
            signal(np.array(Q), t, name="q", unit="mm"),
            signal(np.array(U), t, name="u", unit="N"),
        ]
        mdf.append(fast, acq_name="fast")
        mdf.append([signal(slow**2, slow, name="oil", unit="degC")], acq_name="slow")
        return Path(mdf.save(path, overwrite=True))


def tdms_file(path: Path) -> Path:
    nptdms = pytest.importorskip("nptdms")
    told = {"wf_increment": 0.5, "wf_start_offset": 0.0, "wf_samples": len(T)}
    channels = [
        nptdms.ChannelObject("fast", "q", np.array(Q), told | {"unit_string": "mm"}),
        nptdms.ChannelObject("fast", "u", np.array(U), told | {"unit_string": "N"}),
        nptdms.ChannelObject("slow", "oil", np.array([1.0, 2.5, 1.5])),
    ]
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(channels)
    return path


def mcap_file(path: Path, **told: bytes) -> Path:
    """Topics with messages of ROS 2 and in JSON."""
    writer = pytest.importorskip("mcap.writer")
    definition = told.get("definition", b"float64 q\nfloat64 u\nstring note\n")
    with path.open("wb") as file:
        log = writer.Writer(file)
        log.start("ros2")
        kind = log.register_schema("bench_msgs/msg/Bench", "ros2msg", definition)
        fast = log.register_channel("fast", "cdr", kind)
        slow = log.register_channel("slow", "json", 0)
        for t, q, u in zip(T, Q, U, strict=True):
            note = struct.pack("<I", 3) + b"ok\0"
            cdr = b"\0\1\0\0" + struct.pack("<dd", q, u) + note
            log.add_message(fast, int(1e18) + round(1e9 * t), cdr, 0)
            if t in T[::2]:
                said = b'{"oil": {"temperature": 21.5}, "gear": [1, 2]}'
                said = said if t else b'{"oil": {"temperature": 21.5}, "gear": []}'
                log.add_message(slow, int(1e18) + round(1e9 * t), said, 0)
        log.finish()
    return path


def db3_file(path: Path) -> Path:
    """The topics of a bag of ROS 2 that does not say what its messages contain."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    bag = path.with_suffix("")
    with rosbag2.Writer(bag, version=8) as writer:
        for topic, places in (("fast", T), ("slow", T[::2])):
            kind = "geometry_msgs/msg/Point"
            channel = writer.add_connection(topic, kind, typestore=store)
            for t in places:
                point = store.types[kind](x=Q[T.index(t)], y=U[T.index(t)], z=0.0)
                sent = store.serialize_cdr(point, kind)
                writer.write(channel, int(1e18) + round(1e9 * t), sent)
    return next(bag.glob("*.db3")).rename(path)


# By the end of the name: what writes the file, and its columns q and u.
GROUPED: dict[str, tuple[Callable[[Path], Path], str, str]] = {
    "mf4": (mdf_file, "q", "u"),
    "tdms": (tdms_file, "q", "u"),
    "mcap": (mcap_file, "q", "u"),
    "db3": (db3_file, "x", "y"),
}


@pytest.mark.parametrize("kind", GROUPED)
def test_a_group_of_channels_is_a_table_and_groups_are_never_mixed(
    kind: str, tmp_path: Path
) -> None:
    make, q, u = GROUPED[kind]
    path = make(tmp_path / f"log.{kind}")
    reader: Any = getattr(ph.Measurements, READERS[path.suffix])
    columns: dict[str, Any] = {"time": "time", "states": [q], "inputs": [u]}
    (run,) = reader(path, group="fast", **columns)
    assert run.t.tolist() == T
    assert run.x[:, 0].tolist() == Q
    assert run.u[:, 0].tolist() == U
    with pytest.raises(
        ph.DataError, match=r"several groups.*\['fast', 'slow'\].*group = "
    ):
        reader(path, **columns)
    with pytest.raises(ph.DataError, match=r"no group 'fst'.*Did you mean 'fast'"):
        reader(path, group="fst", **columns)
    seen = survey(path)
    has_units = kind in ("mf4", "tdms")
    assert [(one.column, one.unit) for one in seen.columns[:3]] == [
        ("time", "s"),
        (q, "mm" if has_units else ""),
        (u, "N" if has_units else ""),
    ]
    assert seen.read[0].is_set and str(seen.read[0]) == 'group = "fast"    others: slow'


def test_groups_without_a_name_are_numbered(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version="4.10") as mdf:
        for values in (T, U):
            mdf.append([asammdf.Signal(np.array(values), np.array(T), name="q")])
        path = mdf.save(tmp_path / "log.mf4", overwrite=True)
    columns: dict[str, Any] = {"time": "time", "states": ["q"]}
    (run,) = ph.Measurements.from_mdf(path, group="group 2", **columns)
    assert run.x[:, 0].tolist() == U


X = np.array([0, 1, 3, 7, 12, 20], np.int16)
POINTS = {"raw_0": 1, "phys_0": 10.0, "phys_1": 20.0}
NUMBERS: dict[str, tuple[Any, Any, list[float]]] = {
    "same": (X, None, X.tolist()),
    "line": (X, {"a": 0.5, "b": -1.0}, (0.5 * X - 1).tolist()),
    "ratio": (
        X,
        {"P1": 0, "P2": 1, "P3": 2, "P4": 0, "P5": 0.5, "P6": 4},
        ((X + 2) / (0.5 * X + 4)).tolist(),
    ),
    "square": (
        X,
        {"P1": 2, "P2": 0, "P3": 0, "P4": 0, "P5": 4, "P6": 0},
        (X / 2).tolist(),
    ),
    "between points": (
        X,
        POINTS | {"raw_1": 11, "interpolation": True},
        [10.0, 10.0, 12.0, 16.0, 20.0, 20.0],
    ),
    "nearest point": (
        X,
        POINTS | {"raw_1": 5, "interpolation": False},
        [10.0, 10.0, 10.0, 20.0, 20.0, 20.0],
    ),
}
RANGES = {
    **{"lower_0": 0, "upper_0": 3, "phys_0": 1.0},
    **{"lower_1": 7, "upper_1": 12, "phys_1": 2.0},
    "default": -1.0,
}
NUMBERS_4: dict[str, tuple[Any, Any, list[float]]] = {
    "ranges": (X, RANGES, [1.0, 1.0, 1.0, 2.0, 2.0, -1.0]),
    "ranges of reals": (X.astype(float), RANGES, [1.0, 1.0, -1.0, 2.0, -1.0, -1.0]),
    "beside a text": (
        X,
        {"val_0": 20, "text_0": b"no signal", "default_addr": {"a": 2.0, "b": 0.0}},
        [0.0, 2.0, 6.0, 14.0, 24.0, np.nan],
    ),
    "beside texts": (
        X,
        {
            "lower_0": 5,
            "upper_0": 15,
            "text_0": b"low",
            "default_addr": {"a": 2.0, "b": 0.0},
        },
        [0.0, 2.0, 6.0, np.nan, np.nan, 40.0],
    ),
}
REFUSED: dict[str, tuple[Any, Any]] = {
    "formula": (X, {"formula": "X1+1"}),
    "words": (X, {"val_0": 0, "text_0": b"off", "val_1": 1, "text_1": b"on"}),
    "text": (np.array([b"a"] * 6), None),
}  # fmt: skip


def mdf_with(channels: dict[str, Any], version: str, path: Path) -> Path:
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version=version) as mdf:
        signals = []
        for name, (raw, conversion, *_) in channels.items():
            words: Any = {"encoding": "latin-1"} if raw.dtype.kind == "S" else {}
            signal = asammdf.Signal(
                raw, np.array(T), name=name, conversion=conversion, **words
            )
            signals.append(signal)
        mdf.append(signals, acq_name="log")
        return Path(mdf.save(path, overwrite=True))


@pytest.mark.parametrize("version", ["3.30", "4.10"])
def test_conversions_that_are_numbers_are_applied_and_others_refused_by_name(
    version: str, tmp_path: Path
) -> None:
    numbers = NUMBERS | (NUMBERS_4 if version >= "4" else {})
    path = mdf_with(numbers | REFUSED, version, tmp_path / "log.mf4")
    read = partial(ph.Measurements.from_mdf, path, time="time")
    states = {f"x{i}": name for i, name in enumerate(numbers)}
    (run,) = read(states=states)
    for values, (_, _, expected) in zip(run.x.T, numbers.values(), strict=True):
        np.testing.assert_allclose(values, expected, rtol=1e-15)
    with pytest.raises(
        ph.DataError, match=r"log.*', group '.*': the channel 'formula' .* executed"
    ):
        read(states=["formula"])
    seen = survey(path)
    assert [one.column for one in seen.columns] == ["time", *numbers]
    assert {one.name for one in seen.table.further} == set(REFUSED)


def test_invalid_samples_of_a_channel_are_missing(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    is_invalid = np.arange(6) == 2
    with asammdf.MDF(version="4.10") as mdf:
        signal = asammdf.Signal(
            np.array(Q), np.array(T), name="q", invalidation_bits=is_invalid
        )
        mdf.append([signal])
        path = mdf.save(tmp_path / "log.mf4", overwrite=True)
    (run,) = ph.Measurements.from_mdf(path, time="time", states=["q"])
    np.testing.assert_array_equal(run.x[:, 0], np.where(is_invalid, np.nan, Q))


@pytest.mark.parametrize(("reader", "library", "content"), [
    ("from_mdf", "asammdf", b"MDF"),
    ("from_parquet", "pyarrow", b"PAR1"),
    ("from_bag", "mcap", b"\x89MCAP"),
    ("from_hdf5", "h5py", b"\x89HDF\r\n\x1a\n"),
    ("from_mat", "h5py", b" " * 512 + b"\x89HDF\r\n\x1a\n"),
])  # fmt: skip
def test_a_library_that_is_not_installed_is_named_with_its_extra(
    reader: str, library: str, content: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    said = rf'needs {library}.*"phsi_opt\[loggers\]".*Measurements.from_dataframe'
    with pytest.raises(ph.DataError, match=said):
        getattr(ph.Measurements, reader)(io.BytesIO(content), time="time", states=["q"])


def test_numbers_of_messages_are_columns_and_messages_of_other_kinds_are_named(
    tmp_path: Path,
) -> None:
    path = mcap_file(tmp_path / "log.mcap")
    names = ["oil.temperature", "gear.1"]
    states = dict(zip("ab", names, strict=True))
    (run,) = ph.Measurements.from_bag(path, group="slow", time="time", states=states)
    assert run.t.tolist() == T[::2]
    np.testing.assert_array_equal(run.x, [[21.5, np.nan], [21.5, 2.0], [21.5, 2.0]])
    code = mcap_file(path, definition=b"float64 q=__import__('os').mkdir('a')\n")
    said = "'message' cannot be read: messages of the type bench_msgs/msg/Bench"
    with pytest.raises(ph.DataError, match=said):
        ph.Measurements.from_bag(code, group="fast", time="time", states=["q"])


def test_parquet_has_numbers_dates_and_missing_values(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    begin = dt.datetime(2024, 3, 5, tzinfo=dt.UTC)
    when = [begin + dt.timedelta(seconds=t) for t in T]
    field = pyarrow.field("q", pyarrow.float64(), metadata={"unit": "mm"})
    columns = {"when": when, "q": [*Q[:-1], None], "on": [u > 1 for u in U]}
    columns["since"] = [dt.timedelta(seconds=t) for t in T]
    table = pyarrow.table({**columns, "axes": [[1.0, 2.0]] * len(T)})
    table = table.set_column(1, field, table["q"])
    path = tmp_path / "log.parquet"
    parquet.write_table(table, path)
    data = ph.Measurements.from_parquet(path, time="when", states=["q", "on"])
    assert data.units["q"] == "mm"
    assert data.trajectories[0].t.tolist() == T
    clocked = ph.Measurements.from_parquet(path, time="since", states=["q"])
    assert clocked.units["t"] == "s" and clocked.stacked("t").tolist() == T
    np.testing.assert_array_equal(data.stacked("x")[:, 0], [*Q[:-1], np.nan])
    assert data.stacked("x")[:, 1].tolist() == [u > 1 for u in U]
    seen = survey(path)
    assert [one.part for one in seen.columns] == ["time", "state", "input", "left out"]
    assert [one.name for one in seen.table.further] == ["axes"]
    with pytest.raises(ph.DataError, match=r"read it with Measurements.from_parquet"):
        ph.Measurements.from_csv(path, time="when", states=["q"])


def test_hdf5_has_groups_as_structs_units_and_no_other_files(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "log.h5"
    Path(tmp_path, "raw").write_bytes(np.array(Q).tobytes())
    with h5py.File(path, "w") as file:
        file["log/time"] = T
        file["log/Motor Speed"] = Q
        file["log/Motor Speed"].attrs["unit"] = "rpm"
        file["log/fixed"], file["log/listed"] = Q, Q
        file["log/fixed"].attrs["unit"] = np.bytes_("rpm")  # a text of fixed length
        file["log/listed"].attrs["units"] = np.array(["rpm"], h5py.string_dtype())
        file["X"] = np.column_stack([U, Q])
        pairs = list(zip(T, U, strict=True))
        file["record"] = np.array(pairs, dtype=[("t", "f8"), ("u", "f8")])
        file["linked"] = h5py.ExternalLink("other.h5", "q")
        raw = [(str(tmp_path / "raw"), 0, 8 * len(T))]
        file.create_dataset("outside", (len(T),), "f8", external=raw)
    states = {"q": "Motor Speed", "u": "X(:,1)", "v": "record.u"}
    data = ph.Measurements.from_hdf5(path, time="log/time", states=states)
    assert data.units["q"] == "rpm"
    assert data.stacked("t").tolist() == T
    np.testing.assert_array_equal(data.stacked("x"), np.column_stack([Q, U, U]))
    elsewhere = "in another file, which is not read"
    said = rf"'linked' \(a link, which is not followed\).*'outside' \({elsewhere}\)"
    with pytest.raises(ph.DataError, match=said):
        ph.Measurements.from_hdf5(path, time="log.time", states=["outside"])
    units = {one.column: one.unit for one in survey(path).columns}
    for name in ("Motor Speed", "fixed", "listed"):
        assert units[f"log.{name}"] == "rpm"


def test_matlab_7_3_is_read_as_older_files_are(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "log.mat"
    with h5py.File(path, "w", userblock_size=512) as file:

        def save(name: str, values: Any, kind: bytes = b"double") -> Any:
            file[name] = np.atleast_2d(values)
            file[name].attrs["MATLAB_class"] = np.bytes_(kind)
            return file[name].ref

        save("t", T)  # a column, whose axes MATLAB writes in reverse
        save("log/X", np.array([Q, U]))
        save("name", [111, 107], b"char")
        places = [[save("#refs#/a", Q), save("#refs#/b", U)]]
        file.create_dataset("Y/Data", data=np.array(places, dtype=h5py.ref_dtype))
    states = {"q": "X(:,1)", "u": "Y(2).Data"}
    (run,) = ph.Measurements.from_mat(path, time="t", states=states)
    assert run.t.tolist() == T
    np.testing.assert_array_equal(run.x, np.column_stack([Q, U]))
    with pytest.raises(ph.DataError, match=r"'name' \(text\)"):
        ph.Measurements.from_mat(path, time="t", states=["z"])


def test_channels_of_a_group_that_begin_apart_are_tables_of_their_own(
    tmp_path: Path,
) -> None:
    nptdms = pytest.importorskip("nptdms")
    told = {"wf_increment": 0.5, "wf_samples": len(T)}
    late = told | {"wf_start_offset": 2.0}
    channels = [
        nptdms.ChannelObject("log", "q", np.array(Q), told | {"wf_start_offset": 0.0}),
        nptdms.ChannelObject("log", "u", np.array(U), late),
    ]
    with nptdms.TdmsWriter(tmp_path / "log.tdms") as writer:
        writer.write_segment(channels)
    read = partial(ph.Measurements.from_tdms, tmp_path / "log.tdms", time="time")
    (run,) = read(group="log 2", states=["u"])
    assert run.t.tolist() == [t + 2.0 for t in T]
    with pytest.raises(ph.DataError, match="no column 'u'"):
        read(group="log 1", states=["u"])

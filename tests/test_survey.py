"""A look at a table that nobody has described: its clock, its parts, what is wrong."""

from pathlib import Path

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.study_file.survey import TableSurvey, survey, surveys


@pytest.fixture
def table(tmp_path: Path) -> Path:
    return tmp_path / "log.csv"


def seen_in(table: Path, text: str) -> TableSurvey:
    table.write_text(text)
    return survey(table)


def of_columns(table: Path, **columns: np.ndarray) -> TableSurvey:
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(map(repr, map(float, row))) for row in rows]
    return seen_in(table, "\n".join([",".join(columns), *lines]))


def remarks(seen: TableSurvey) -> dict[str, tuple[str, str]]:
    return {one.column: (one.part, one.remark) for one in seen.columns}


# ---- the clock


@pytest.mark.parametrize(("text", "time", "span", "said"), [
    ("t,q\n1,2\n3,1\n7,5\n", "t", (1.0, 7.0), "1 to 7"),
    ("q,x\n1,2\n3,1\n7,5\n", "q", (1.0, 7.0), "1 to 7"),  # which increases
    ("q\n1\n3\n2\n", None, None, "no column increases from line to line; name the column of the times."),
    ("t,q\n1,2\n1,1\n7,5\n", "t", None, "1 to 7"),
    ("time,x,q\na,1,2\nb,3,1\nc,7,5\n", "x", (1.0, 7.0), "1 to 7"),  # texts
    ("q,dt\n1,0.1\n3,\n2,\n", None, (0.0, 0.2), "no column increases from line to line; name the column of the times."),
    ("t,q\n2020-01-01,2\n2020-01-02,1\n", "t", None, "the times are dates"),
    ("t,q\n20210131,1\n20210201,2\n20210202,1\n", "t", None, "numbers such as 20210131 look like dates"),
    ("t,q\n03/04/2026,1\n03/05/2026,2\n", "t", None, 'the times are dates; or date_format = "%d/%m/%Y"'),
])  # fmt: skip
def test_the_times_are_found_with_their_span(table, text, time, span, said) -> None:
    seen = seen_in(table, text)
    assert (seen.time and seen.time.column) == time
    assert seen.span == (span and pytest.approx(span))
    assert seen.said == said


def test_numbers_may_be_a_clock_of_dates(table: Path) -> None:
    for first, clock in ((44227, "excel"), (1612051200, "unix"), (3, "")):
        assert seen_in(table, f"t [s],q\n{first},1\n{first + 1},2\n").clock == clock
    assert seen_in(table, "q\n1\n3\n2\n").clock == ""


def test_date_and_time_of_day_are_put_together(table: Path) -> None:
    days = ["31.01.2021"] * 2 + ["01.02.2021"]
    clocks = ("23:59:58", "23:59:59", "00:00:00")
    rows = [f"{d},{c},{k}\n" for k, (d, c) in enumerate(zip(days, clocks, strict=True))]
    seen = seen_in(table, "date,time,q\n" + "".join(rows))
    assert seen.time is not None
    assert seen.time.source == ("date", "time")
    assert seen.time.date_format == "%d.%m.%Y %H:%M:%S"
    assert remarks(seen)["time"] == ("left out", "belongs to the times in date")
    assert remarks(seen)["q"][0] == "state"


def test_a_clock_beside_the_times_counts_the_same_moments_or_its_own(table) -> None:
    t = np.arange(40.0)
    rng = np.random.default_rng(0)
    q, v = rng.normal(size=(2, 40))
    # 0.9 % of a step beside the common moments, or 1.1 %.
    for share, said in ((0.009, "same spacing as t"), (0.011, "its own times")):
        other = 5 + 1000 * t
        other[20] += 1000 * share
        seen = of_columns(table, t=t, q=q, time_ms=other, v=v)
        parts = remarks(seen)
        assert parts["time_ms"] == ("left out", f"another time column ({said})")
        assert (parts["v"][0] == "state") == (said == "same spacing as t")


@pytest.mark.parametrize(
    "name", ["T_room", "T_in", "T_C", "T_amb", "T_1", "t_oil", "t_1"]
)
@pytest.mark.parametrize("clock", ["time_s", "zeit", "x", "when"])
def test_a_clock_is_what_increases_and_no_temperature(table, name, clock) -> None:
    k = np.arange(40)
    rising = 20 + np.log1p(k)
    wave = 20 + np.sin(k)
    for temperature in (wave, rising)[: 1 if clock == "x" else 2]:
        stamp = [f"2026-01-01 00:{n:02}" if clock == "when" else str(2 * n) for n in k]
        rows = zip(temperature, stamp, np.cos(k), strict=True)
        lines = [f"{a:.3f},{b},{c}\n" for a, b, c in rows]
        seen = seen_in(table, f"{name},{clock},q\n{''.join(lines)}")
        assert seen.time is not None and seen.time.column == clock
        assert remarks(seen)[name][0] == ("input" if name == "T_in" else "state")


def test_times_have_a_unit_before_what_counts_lines_that_are_missing(table) -> None:
    n = np.r_[np.arange(20.0), np.arange(50.0, 80.0)]
    seen = of_columns(table, **{"sample": n, "elapsed [s]": 2 * n, "q": np.sin(n)})
    assert remarks(seen) == {
        "sample": ("left out", "0 to 79; counts the lines"),
        "elapsed [s]": ("time", "0 to 158"),
        "q": ("state", "-1 to 0.9995"),
    }


def test_times_that_were_rounded_are_proposed_with_their_step(table: Path) -> None:
    t = 0.1353 * np.arange(2000)
    lines = [f"{a:.2E}\t{np.sin(0.1 * a):.2E}\n" for a in t]
    seen = seen_in(table, "Tank\nRun 12\n\n" + "".join(lines))
    assert seen.time is not None and seen.time.column == "0"
    assert "time = { step = 0.1353 }" in seen.time.remark
    with pytest.raises(
        ph.DataError, match=r"as rounded times do: .*step=0\.1353"
    ) as error:
        ph.Measurements.from_csv(table, time=0, states={"y": 1})
    assert "drop" not in str(error.value) and "remove" not in str(error.value)
    # A held input that never falls, and a counter of a machine, are no such clock.
    seen = seen_in(table, "u,q\n" + "".join(f"{k // 10},{k % 7}\n" for k in range(40)))
    assert seen.time is None


# ---- runs


def test_a_clock_that_begins_anew_begins_a_run(table: Path) -> None:
    t = np.tile(0.05 * np.arange(40), 3)
    t[40:] += np.repeat([0.02, -0.02], 40)
    lines = [f"{a:.2f},{np.cos(a + k):.4f}\n" for k, a in enumerate(t)]
    seen = seen_in(table, "t_s,x_m\n" + "".join(lines))
    assert seen.runs == ["log/1", "log/2", "log/3"]
    said = "the clock begins anew in line 42, line 82: 3 runs"
    assert seen.said == f"-0.02 to 1.97; {said}"
    data = ph.Measurements.from_csv(table, time="t_s", states={"q": "x_m"})
    assert [run.name for run in data] == seen.runs
    assert [run.n_samples for run in data] == [40, 40, 40]
    assert said in " ".join(str(data).split())
    assert said in data.noticed["noticed"][0]


def test_a_clock_that_goes_back_elsewhere_is_refused_without_harm(table: Path) -> None:
    table.write_text("t,q\n0,1\n1,2\n2,3\n1,4\n2,5\n")
    with pytest.raises(
        ph.DataError, match=r"line 5: time goes back from 2.0 in line 4 to 1.0"
    ) as error:
        ph.Measurements.from_csv(table, time="t", states=["q"])
    assert "cut the file where a run begins" in str(error.value)
    assert "Sort" not in str(error.value)
    table.write_text("t,q\n0,1\n1,2\n1,2\n2,5\n")
    with pytest.raises(ph.DataError, match=r"line 4: .* The rows are the same: remove"):
        ph.Measurements.from_csv(table, time="t", states=["q"])


def test_runs_are_named_by_a_column_that_has_few_names(table: Path) -> None:
    rows = [f"{'ab'[k // 3]},{k % 3},{k * k % 5}\n" for k in range(6)]
    seen = seen_in(table, "run,t,q\n" + "".join(rows))
    assert remarks(seen)["run"] == ("run", "2 runs")
    assert (len(seen.runs), seen.n_lines) == (2, 6)
    assert seen.span == (0.0, 2.0)
    # Not where there are as many as lines, or one alone.
    for names in ("abcdef", "aaaaaa"):
        rows = [f"{name},{k},{k * k % 5}\n" for k, name in enumerate(names)]
        seen = seen_in(table, "run,t,q\n" + "".join(rows))
        assert seen.run is None and len(seen.runs) == 1


# ---- what a column is


def test_the_parts_of_columns_follow_from_their_names_and_values(table: Path) -> None:
    n = np.arange(60)
    wave = np.sin(n)
    seen = of_columns(
        table,
        **{
            "t [s]": 0.1 * n,
            "index": n,
            "q [m]": wave,
            "q_ref": wave,
            "lag [ms]": wave,
        },
        **{"force": wave + 1.05, "Ta": wave + 2, "level": np.where(n < 30, 1.0, 2.0)},
        **{"still": 0 * n + 3.5},
        **{"supply [V]": np.where(n % 9 == 4, np.nan, np.where(n < 30, 6.0, 9.0))},
    )
    assert remarks(seen) == {
        "t [s]": ("time", "0 to 5.9"),
        "index": ("left out", "0 to 59; counts the lines"),
        "q [m]": ("state", "-1 to 0.9999"),
        "q_ref": ("left out", "-1 to 0.9999; a set point, by its name"),
        "lag [ms]": (
            "left out",
            "-1 to 0.9999; in a unit of time, and another column has the times",
        ),
        "force": ("input", "0.05001 to 2.05"),
        "Ta": ("state", "1 to 3; possibly an input"),
        "level": ("input", "1 to 2; constant between jumps: held"),
        "still": ("left out", "always 3.5"),
        "supply [V]": (
            "input",
            "6 to 9, 7 cells missing; constant between jumps: held; an input must be "
            "known at every sample",
        ),
    }
    held = {one.column: one.hold for one in seen.columns if one.hold}
    assert held == {"level": "zero", "supply [V]": "zero"}
    names = [one.name for one in seen.columns if one.name]
    assert names == ["q", "force", "Ta", "level", "supply"]


def test_a_set_point_of_what_is_not_measured_drives_the_machine(table: Path) -> None:
    t = np.arange(40.0)
    jumps = np.where(t < 20, 2.0, 5.0)
    seen = of_columns(
        table,
        **{"t [s]": t, "level [cm]": np.sin(t), "level setpoint [m]": 0 * t + jumps},
        **{"pump setpoint [l/min]": jumps, "valve target [%]": np.cos(t)},
    )
    assert [one.column for one in seen.of_part("input")] == [
        "pump setpoint [l/min]",
        "valve target [%]",
    ]
    assert remarks(seen)["level setpoint [m]"][0] == "left out"


def test_a_cell_that_is_wrong_is_told_with_its_line(table: Path) -> None:
    cells = ["1", "2", "x y", "", "inf", "3"]
    seen = seen_in(table, "t,q\n" + "".join(f"{k},{c}\n" for k, c in enumerate(cells)))
    column = seen.columns[1]
    assert column.wrong.startswith("column 'q', line 4: 'x y' is not a real number.")
    assert column.said == "1 to 3, 1 cell missing"
    assert column.n_missing == 1
    # Texts are told, at most three.
    seen = seen_in(table, "t,q,note\n0,1,a\n1,2,b\n2,3,c\n")
    assert remarks(seen)["note"] == ("left out", 'text: "a", "b", "c"')


def test_what_is_no_study_is_refused(table: Path) -> None:
    with pytest.raises(ph.DataError, match=r"has 1 line below its header; at least 2"):
        seen_in(table, "t,q\n0,1\n")
    said = r"no column of numbers that could be a state: t: 0 to 1; note: text: \"a\", \"b\"\."
    with pytest.raises(ph.DataError, match=said):
        seen_in(table, "t,note\n0,a\n1,b\n")
    # What only may be an input is a state where nothing else is.
    assert remarks(seen_in(table, "t,u\n0,1\n1,2\n"))["u"][0] == "state"


def test_files_of_one_study_have_the_same_columns_in_any_order(tmp_path: Path) -> None:
    tables = ("t,q,v\n0,1,2\n1,2,1\n", "v,t,q\n0,1,2\n1,2,1\n", "t,q,w\n0,1,2\n1,2,1\n")
    paths = [tmp_path / f"{name}.csv" for name in "abc"]
    for path, text in zip(paths, tables, strict=True):
        path.write_text(text)
    assert len(surveys(paths[:2])) == 2
    with pytest.raises(ph.DataError, match=r"c.csv has other columns .*: v, w are"):
        surveys(paths)


# ---- long records


@pytest.mark.parametrize(("n", "period", "kept"), [
    (5000, 5000, 1),  # not long
    (20_000, 5000, 10),
    (20_000, 20, 2),  # a wave of 20 samples is little changed by means of two
    (20_000, 3, 1),
])  # fmt: skip
def test_a_long_record_may_be_thinned_as_far_as_its_states_allow(
    table: Path, n: int, period: int, kept: int
) -> None:
    t = np.arange(float(n))
    seen = of_columns(table, t=t, q=np.sin(2 * np.pi * t / period), u=np.cos(t))
    assert seen.is_long == (n > 5000)
    assert seen.thinning == kept

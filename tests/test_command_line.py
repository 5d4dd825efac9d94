"""``phsi-opt``: every command, what it says and how it ends, and Ctrl-C."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import phsi_opt as ph
from phsi_opt.command_line import app as commands
from phsi_opt.command_line.app import app, with_names
from phsi_opt.command_line.job import (
    COMPARE,
    DIAGNOSE,
    EXPERIMENT,
    EXPORT,
    FIT,
    GO_THROUGH,
    MEANINGS,
    ExitCode,
    ExperimentPlan,
    Finished,
    Job,
    Message,
    answer_to,
)
from phsi_opt.command_line.jobs import plain
from phsi_opt.command_line.jobs import run as run_job
from phsi_opt.presentation.numbers import duration
from phsi_opt.study_file import kept_fits
from phsi_opt.study_file.keys import KEYS
from phsi_opt.study_file.survey import survey
from problems.examples.friction_spring import CSV
from tests.waiting import HANGS_AFTER, wait_for

FITTING = "fitting the base model"
ADDING = "adding"
ROOT = Path(ph.__file__).parents[1]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
COMMAND = [sys.executable, "-m", "phsi_opt.command_line"]
runner = CliRunner()


class Said(NamedTuple):
    """How a command ended in this process."""

    code: int
    out: str
    err: str


def said(*arguments: object) -> Said:
    """A command that needs no solver, in this process."""
    result = runner.invoke(app, [str(one) for one in arguments])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return Said(result.exit_code, result.stdout, result.stderr)


def run(*arguments: object, at: Path) -> subprocess.CompletedProcess[str]:
    """A command as a user types it."""
    return subprocess.run(
        [*COMMAND, *map(str, arguments)],
        cwd=at,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
    )


def spring_study(folder: Path, few: str = "") -> Path:
    """The study file of the demonstration, with three of its eight runs."""
    shipped = ROOT / "phsi_opt" / "study_file" / "examples" / "spring"
    lines = (shipped / "friction_spring.csv").read_text().splitlines()
    left_out = tuple(f"run {number}" for number in range(4, 9))
    kept = [line for line in lines if not line.startswith(left_out)]
    if few:
        kept[1:] = kept[1::2]
    (folder / "friction_spring.csv").write_text("\n".join(kept))
    path = folder / "study.toml"
    path.write_text((shipped / "study.toml").read_text().rstrip() + few)
    return path


@pytest.fixture
def demo(tmp_path: Path) -> Path:
    return spring_study(tmp_path)


FEW = '\neffects = ["coulomb friction", "quadratic drag", "cubic stiffness"]\n'


@pytest.fixture
def short(tmp_path: Path) -> Path:
    """With few effects to consider, sooner solved."""
    return spring_study(tmp_path, FEW)


@pytest.fixture(scope="module")
def after_fit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    study = spring_study(tmp_path_factory.mktemp("fitted"), FEW)
    run_job(Job(FIT, study), lambda message: None)
    return study


@pytest.fixture
def fitted(after_fit: Path, tmp_path: Path) -> Path:
    """The same once its base model was fitted."""
    return shutil.copytree(after_fit.parent, tmp_path / "fitted") / after_fit.name


@pytest.fixture(scope="module")
def after_diagnosis(
    after_fit: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, str, Any]:
    """The study once it was diagnosed, and what `lines_and_answer` told."""
    folder = shutil.copytree(after_fit.parent, tmp_path_factory.mktemp("d") / "study")
    return (
        folder / after_fit.name,
        *lines_and_answer(DIAGNOSE, folder / after_fit.name),
    )


@pytest.fixture
def diagnosed(after_diagnosis: tuple[Path, str, Any], tmp_path: Path) -> Path:
    study = after_diagnosis[0]
    return shutil.copytree(study.parent, tmp_path / "diagnosed") / study.name


def left_over(at: Path) -> list[str]:
    return sorted(path.name for path in at.glob(".*"))


# ---- help, names, codes --------------------------------------------------------------


def test_help_tells_the_commands_and_the_exit_codes() -> None:
    assert said("--version").out == f"phsi_opt {metadata.version('phsi_opt')}\n"
    text = said("--help").out
    for command in app.registered_commands:
        assert command.callback is not None
        assert (command.name or command.callback.__name__) in text
    for code, meaning in MEANINGS.items():
        assert f"{code.value}: {meaning[:20]}" in text
    assert said("chek").code == ExitCode.BAD_INPUT


@pytest.mark.parametrize(("arguments", "words"), [
    (["fit", "gone.toml"], "there is no such file; phsi-opt init"),
    (["check", "broken.toml"], "this is not TOML"),
    (["add", "gap", "broken.toml"], "this is not TOML"),
    (["init", "gone.csv"], "there is no such file; check the path"),
])  # fmt: skip
def test_a_refusal_loads_nothing_slow(tmp_path, arguments, words) -> None:
    (tmp_path / "broken.toml").write_text("[data")
    command = [COMMAND[0], "-X", "importtime", *COMMAND[1:], *arguments]
    refused = subprocess.run(
        command, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True
    )
    assert refused.returncode == ExitCode.BAD_INPUT
    assert words in refused.stderr
    imported = {line.rpartition("|")[2].strip() for line in refused.stderr.splitlines()}
    assert "typer" in imported
    assert not {"numpy", "casadi", "pandas", "scipy"} & imported


def test_a_report_without_a_name_gets_one() -> None:
    name = commands.REPORT_NAME
    assert with_names(["init", "--model"]) == ["init", "--model", "?"]
    assert with_names(["study", "--report"]) == ["study", "--report", name]
    assert with_names(["study", "--report", "--auto"]) == [
        *("study", "--report", name, "--auto")
    ]
    named = ["study", "--report", "mine.md", "--auto"]
    assert with_names(named) == named


# ---- init ----------------------------------------------------------------------------


def test_init_writes_a_study_file_and_says_what_it_needs(tmp_path: Path) -> None:
    study = tmp_path / "study.toml"
    result = said("init", CSV, "--study", study)
    assert result.code == ExitCode.DONE
    assert "model.H: expected the energy" in result.out
    text = study.read_text()
    assert 'trajectory = "run"  # 8 runs' in text
    assert 'time = { column = "t_s", unit = "s" }  # 0 to 5' in text
    assert 'position = { column = "position_m", unit = "m" }' in text
    assert complained(study) == ["model.H"]
    again = said("init", CSV, "-o", study)
    assert again.code == ExitCode.BAD_INPUT and "exists already" in again.err
    assert study.read_text() == text
    forced = json.loads(said("init", CSV, "-o", study, "--force", "--json").out)
    assert forced["exit_code"] == ExitCode.DONE
    assert [one["key"] for one in forced["needs"]] == ["model.H"]
    assert [one["part"] for one in forced["columns"]] == ["run", "time", "state"]
    energy = text.replace('H = ""', 'H = "k*exp(10000*position)"')
    study.write_text(energy.replace("# m = 2.5", "k = 1.0"))
    refused = said("check", study)
    assert refused.code == ExitCode.BAD_INPUT
    assert "has no finite value, or one beyond 1e+100, at" in refused.err


@pytest.mark.parametrize(("table", "words"), [
    ("t;q [m];u\n0;1;2\n1;2;3\n2;4;3\n", ['column = "q [m]", unit = "m"', 'u = { column = "u" }']),
    ("q,dt\n1,0.1\n2,\n3,\n", ["time = { step = 0.1, unit = \"s\" }", "the time between samples"]),
    ("q\n1\n3\n2\n", ["no column increases from line to line"]),
    ("t,q,c\n0,1,5\n1,2,5\n5,4,5\n6,1,5\n", ["# 0 to 6", "c: always 5"]),
    ("t,q\n0,1\n1,nan\n2,3\n", ["1 cell missing"]),
    ("when,T (degC)\n2020-01-01 00:00,1\n2020-01-01 00:15,2\n", ['column = "when", unit = "s"', "the times are dates"]),
    ("x (m),y (m)\n0,1\n1,2\n", ["no column increases"]),
    ("date,T (degC)\n2020-01-01 00:00,1\n2020-01-01 00:15,2\n", ['column = "date", unit = "s"']),
    ("time,lambda,2nd,sin\n0,1,2,3\n1,2,3,5\n2,4,1,4\n", ["x_lambda = ", "x2nd = ", "x_sin = "]),
    ("time;q\n0,0;1,5\n0,5;2,5\n1,0;-1,5\n", ["# 0 to 1", "-1.5 to 2.5"]),
    ("0.0 5 1\n0.5 7 2\n1.0 6 5\n", ['column = "0"', 'column = "1"']),
    ("time,a,a,b\n0,1,2,1\n1,2,3,2\n2,4,1,1\n", ["a: 2 columns have this name"]),
    ("t,q\n0,1\n1,2\n2,3\n", ["# [data.inputs]", "# between = [0, 2]", "# thinned = 2", "# trajectory = "]),
    ("t,Ta,yref,StepTime(s)\n0,1,2,1\n1,2,3,2\n2,4,1,2\n", ['Ta = { column = "Ta" }  # 1 to 4; possibly an input', '# Ta = { column', '# inputs = ["Ta"]', "yref: 1 to 3; a set point", "StepTime(s): 1 to 2; in a unit of time"]),
    ("t,name,q\n0,a very long name of a thing,1\n1,b,2\n2,c,1\n3,d,2\n", ['text: "a very long name of ...", "b", "c", ...']),
    ("t,q\n0,1\n1,broken\n2,3\n3,inf\n4,2\n", ['q = { column = "q" }  # 1 to 3', "correct in the data file: column 'q', line 3: 'broken' is not a real number. Correct"]),
    ("t,q\n0,1\n1,2\n1,3\n0.5,4\n", ['time = { column = "t" }', "correct in the data file: column 't', line 4: 1.0 repeats the time of line 3;"]),
    ("t,q\n0,1\n,2\n1,3\n2,4\n", ['time = { column = "t" }', "correct in the data file: column 't', line 3: the value is nan; times"]),
    ("q\n1\n3\n2\n", ['# time = { step = 0.01, unit = "s" }']),
    ("t,q\n0,1\n1,2\n", ['in seconds? then add unit = "s"']),
    ("when,q\n22.11.2021 09:15,1\n22.11.2021 09:30,2\n", ['date_format = "%d.%m.%Y %H:%M" }']),
    ("when,q\n1/2/2021,1\n1/13/2021,2\n1/14/2021,2\n", ['date_format = "%m/%d/%Y" }']),
    ("when,q\n03/04/2026 10:00,1\n03/04/2026 10:01,2\n", ['date_format = "%d/%m/%Y %H:%M" }', 'dates; or date_format = "%m/%d/%Y %H:%M"']),
    ("when,q\n03/04/2026,1\n03/05/2026,2\n", ['date_format = "%m/%d/%Y" }', 'dates; or date_format = "%d/%m/%Y"']),
    ("t,q\n1612051200,1\n1612051260,2\n", ['unit = "s", date_format = "unix" }']),
    ("t,q\n44227,1\n44228,2\n", ['are they dates of a spreadsheet? then date_format = "excel"']),
    ("Datum;q\n44227,5;1\n44228,5;2\n", ['date_format = "excel" }', 'decimal = ","']),
    ("when,q\n20210131,1\n20210201,2\n20210202,1\n", ['column = "when", unit = "s", date_format = "%Y%m%d" }', "numbers such as 20210131 look like dates"]),
    ("run,t,q\na,0,1\na,1,2\na,2,1\nb,0,2\nb,1,1\n,2,2\n", ['trajectory = "run"  # 2 runs', "column 'run', line 7: the trajectory's name is missing"]),
    ("t,q\ns,m\n0,1\n1,2\n2,1\n", ['q = { column = "q", unit = "m" }', "# units_row = 2  # units in line 2"]),
    ("t,u,q\n0,1,1\n1,,2\n2,2,1\n", ["1 to 2, 1 cell missing; an input must be known at every sample\n"]),
    ("t,u\n0,1\n1,2\n", ['u = { column = "u" }  # 1 to 2; possibly an input']),
])  # fmt: skip
def test_init_looks_at_the_columns(tmp_path, table, words) -> None:
    (tmp_path / "data.csv").write_text(table)
    result = said("init", tmp_path / "data.csv", "-o", tmp_path / "s.toml")
    assert result.code == ExitCode.DONE, result.err
    text = (tmp_path / "s.toml").read_text()
    for word in words:
        assert word in text


HEADERS = {  # what a header tells: part, name, unit
    "q [m]": ("state", "q", "m"),
    "T (degC)": ("state", "T", "degC"),
    "T": ("state", "T_2", ""),
    "x / mm": ("state", "x", "mm"),
    "position_m": ("state", "position", "m"),
    "q_1": ("state", "q_1", ""),
    "flow_rate": ("state", "flow_rate", ""),
    "Temperature 1": ("state", "Temperature_1", ""),
    "Controle_u": ("input", "Controle_u", ""),
    "Heater 1 (%)": ("input", "Heater_1", "%"),
    "%": ("state", "x_2", ""),
    "u2": ("input", "u2", ""),
    "force_kN": ("input", "force", "kN"),
    "v_m_s": ("state", "v", "m/s"),
    "a_m_s2": ("state", "a", "m/s2"),
    "leak_l_min": ("state", "leak", "l/min"),
    "rest_s": ("left out", "", "s"),
    "Set Point 1 (degC)": ("left out", "", "degC"),
    "StepTime": ("state", "StepTime", ""),
}


@pytest.mark.parametrize("time", ["Tempo_s", "Time(s)", "Time (sec)", "t"])
def test_names_units_and_parts_are_read_from_headers(time: str, tmp_path: Path) -> None:
    columns = [",".join([*HEADERS, time])]
    for i in range(9):
        numbers = [f"{(i * j) % 7 + 0.1 * i:.1f}" for j in range(1, len(HEADERS) + 1)]
        columns.append(",".join([*numbers, str(i)]))
    path = tmp_path / "data.csv"
    path.write_text("\n".join(columns))
    seen = {one.column: (one.part, one.name, one.unit) for one in survey(path).columns}
    assert seen.pop(time) == ("time", "", "" if time == "t" else "s")
    assert seen == HEADERS


def test_a_column_that_changes_where_the_times_begin_anew_names_the_runs(
    tmp_path: Path,
) -> None:
    path = tmp_path / "roll.csv"
    rows = [f"{k % 4},{k % 5 + 1},{1 + k // 4},{k % 4 // 2}" for k in range(12)]
    path.write_text("\n".join(["time (min),speed (km/h),pass,gear", *rows]))
    seen = survey(path)
    parts = {one.label: one.part for one in seen.columns}
    assert parts == {"time": "time", "speed": "state", "pass": "run", "gear": "state"}
    assert len(seen.runs) == 3
    path.write_text("\n".join(["time (min),speed (km/h),pass,gear", *rows[:4]]))
    assert survey(path).run is None


def test_init_takes_the_first_sheet_and_names_the_others(tmp_path: Path) -> None:
    frame = pd.DataFrame({"t": [0, 1, 2, 3], "q": [1, 2, 1, 3]})
    with pd.ExcelWriter(tmp_path / "book.xlsx") as book:
        for name in ("day 1", "day 2"):
            frame.to_excel(book, sheet_name=name, index=False)
    study = tmp_path / "s.toml"
    told = said("init", tmp_path / "book.xlsx", "-o", study).out
    assert 'sheet = "day 1"   others: day 2' in told
    assert 'sheet = "day 1"  # others: day 2' in study.read_text()
    assert complained(study) == ["model.H"]
    frame.to_csv(tmp_path / "a.csv", index=False)
    files = (tmp_path / "a.csv", tmp_path / "book.xlsx")
    told = said("init", *files, "-o", study, "--force").out
    assert (
        'data.files[1] = "book.xlsx": the first file is .csv; all files must be of the same kind'
        in told
    )


def complained(study: Path) -> list[str]:
    """The keys of what `check` refuses."""
    content = json.loads(said("check", study, "--json").out)
    return [one["key"] for one in content["complaints"]]


@pytest.mark.parametrize("place", ["", "below"])
def test_init_writes_no_absolute_path_of_a_table_beside_or_below(
    tmp_path: Path, place: str
) -> None:
    (tmp_path / place).mkdir(exist_ok=True)
    table = tmp_path / place / "data.csv"
    table.write_text("t,q\n0,1\n1,2\n2,3\n")
    link = tmp_path / "link"
    link.symlink_to(tmp_path)
    said("init", table.absolute(), "-o", link / "s.toml")
    text = (tmp_path / "s.toml").read_text()
    assert str(tmp_path) not in text
    assert f'files = ["{(Path(place) / "data.csv").as_posix()}"]' in text


@pytest.mark.parametrize(("name", "why"), [
    ("empty.csv", "is empty"),
    ("header.csv", "no line below its header"),
    ("one.csv", "1 line below its header; at least 2"),
    ("long.csv", "line 3 has 3 cells; expected 2"),
    ("short.csv", "line 3 has 1 cell; expected 2"),
    ("still.csv", "no column of numbers that could be a state: t: 0 to 1; q: always 1"),
    ("gone.csv", "gone.csv' cannot be read: there is no such file"),
    ("gone.mat", "gone.mat' cannot be read: there is no such file"),
    ("folder", "folder' cannot be read: it is a folder"),
    ("a.npz", "it contains binary data. Tables are read from text"),
    ("log.mat", "it is of another kind, or it is damaged"),
    ("other.csv", "q, v are only in one of them"),
])  # fmt: skip
def test_files_that_are_no_tables_are_refused_in_words(tmp_path, name, why) -> None:
    (tmp_path / "folder").mkdir()
    np.savez(tmp_path / "a.npz", a=np.ones(3))
    for file, text in {
        "empty.csv": "",
        "header.csv": "a,b\n",
        "one.csv": "a,b\n1,2\n",
        "long.csv": "t,q\n0,1\n1,2,3\n",
        "short.csv": "t,q\n0,1\n1\n",
        "still.csv": "t,q\n0,1\n1,1\n",
        "other.csv": "t,v\n0,1\n1,2\n2,1\n",
        "good.csv": "t,q\n0,1\n1,2\n2,1\n",
        "log.mat": "no",
    }.items():
        (tmp_path / file).write_text(text)
    tables = ["good.csv", name] if name == "other.csv" else [name]
    files = [tmp_path / table for table in tables]
    result = said("init", *files, "-o", tmp_path / "s.toml")
    assert result.code == ExitCode.BAD_INPUT
    assert why in " ".join(result.err.split())
    assert "Errno" not in result.err and "open(" not in result.err
    assert not (tmp_path / "s.toml").exists()


def test_init_says_which_values_of_a_base_model_are_taken_for_known(tmp_path) -> None:
    (tmp_path / "a.csv").write_text("t [s],x [m]\n0,1\n1,2\n2,1\n")
    study = tmp_path / "s.toml"
    told = said("init", tmp_path / "a.csv", "-o", study, "--model", "mass").out
    assert "replace them by those of your machine: m = 1 kg\n" in told
    (tmp_path / "a.csv").write_text("t [s],x [m],F [N]\n0,1,1\n1,2,3\n2,1,2\n")
    measured = ("init", tmp_path / "a.csv", "-o", study, "--model", "mass", "--force")
    assert "Known values" not in said(*measured).out


# ---- check and add -------------------------------------------------------------------


def test_check_says_what_a_study_file_holds(demo: Path) -> None:
    result = said("check", demo)
    assert result.code == ExitCode.DONE
    assert "unknown parameters: k, c\nknown parameters: m = 2.5\n" in result.out
    content = json.loads(said("check", demo, "--json").out)
    assert content["free"] == ["k", "c"]
    assert content["measured"] == ["q"]
    assert content["n_held_out"] == 201
    assert content["empty"] == ['model.F: no forces, such as F = { p = "u" }']
    assert content["noticed"][0]["noticed"] == "every 0.025 s, regular"
    assert content["noticed"][2]["noise"] is None


def test_check_says_what_no_record_can_tell(demo: Path) -> None:
    assert json.loads(said("check", demo, "--json").out)["warnings"] == []
    text = demo.read_text().replace(
        "m = 2.5  # in kg; known, so that it is not estimated", "m = {}"
    )
    demo.write_text(text)
    told = " ".join(said("check", demo).out.split())
    assert "no record can distinguish k, m, c: only" in told
    assert "a sensor of p makes all identifiable" in told


def test_init_and_check_draw_the_data_once_and_replace_no_other_picture(demo) -> None:
    picture = demo.with_name("study_data.svg")
    said("check", demo, "--json")
    assert not picture.exists()
    result = said("check", demo)
    assert f"Picture: {picture}" in result.out
    assert "t: every 0.025 s, regular" in result.out
    drawn = picture.read_bytes()
    assert drawn.startswith(b"<?xml") and b"run" in drawn
    before = picture.stat().st_mtime_ns
    said("check", demo)
    assert picture.stat().st_mtime_ns == before
    demo.write_text(demo.read_text().replace("[data]", "[data]\nbetween = [0, 4]"))
    said("check", demo)
    assert b"each from 0 to 4 s" in picture.read_bytes()
    picture.write_text("mine")
    result = said("init", CSV, "-o", demo, "--force")
    assert "Picture: none: " in result.out
    assert picture.read_text() == "mine"
    assert "position  state  m" in result.out


def test_add_writes_an_effect_and_keeps_what_the_user_wrote(demo: Path) -> None:
    before = demo.read_text()
    result = said("add", "coulomb friction", demo, "--equation", "p", "--json")
    content = json.loads(result.out)
    assert result.code == ExitCode.DONE
    assert content["unknowns"] == ["coulomb_friction_p"]
    assert Path(content["backup"]).read_text() == before
    after = demo.read_text()
    assert after == before.replace("added = []", 'added = ["coulomb friction on p"]')
    again = said("add", "coulomb friction on p", demo, "-e", "p")
    assert again.code == ExitCode.BAD_INPUT
    assert "the model has 'coulomb friction' on p already" in again.err
    assert demo.read_text() == after


def test_the_effects_of_a_model_are_listed_with_equations_and_units(
    demo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(demo.parent)
    listed = said("effects").out
    assert "quadratic drag on p              -c |dH_dp| dH_dp\n" in listed
    assert "quadratic_drag_p in N s^2/m^2\n" in listed
    assert "air drag" in listed and "input delay" not in listed
    assert "sensor offset on q" in listed and "sensor offset on p" not in listed
    every = said("effects", "--all").out
    assert "input delay  " in every and "dead time" in every
    assert max(map(len, (listed + every).splitlines())) <= 80
    rows = json.loads(said("effects", demo, "--json").out)["effects"]
    assert rows[1]["effect"] == "quadratic drag on p"
    assert rows[1]["units"] == {"quadratic_drag_p": "N s^2/m^2"}
    demo.unlink()
    assert said("effects").out == every
    added = said("add", "air drag", "gone.toml")
    assert added.code == ExitCode.BAD_INPUT


# ---- fit, compare, diagnose, study ---------------------------------------------------


def test_a_fit_is_saved_and_taken_up_again(short: Path) -> None:
    fitted = run("fit", "--save", "fit.json", "--json", at=short.parent)
    assert fitted.returncode == ExitCode.DONE, fitted.stderr
    content = json.loads(fitted.stdout)
    assert content["written"] == ["fit.json"]
    fit = ph.Fit.load(short.with_name("fit.json"))
    estimates = {row["name"]: row["value"] for row in content["parameters"]}
    assert fit.values == estimates
    assert content["units"] == {"q": "m"}
    assert content["noise"] == fit.noise
    _, held_out = ph.StudyFile.read(short).split()
    assert held_out is not None
    content = lines_and_answer(COMPARE, short, fit=short.with_name("fit.json"))[
        1
    ].content
    errors = ph.compare(fit, held_out)
    assert (content["rmse"], content["unit"]) == (errors.rmse, "m")
    diagnosed = run(
        *("diagnose", "--fit", "fit.json", "--exit-code", "--json"), at=short.parent
    )
    assert diagnosed.returncode == ExitCode.MISSING, diagnosed.stderr
    assert json.loads(diagnosed.stdout)["proposed"] == ["coulomb friction on p"]
    assert "[0:" in diagnosed.stderr and "] re-fitting with" in diagnosed.stderr
    assert left_over(short.parent) == []


def lines_and_answer(kind: str, study: Path, **options: Any) -> tuple[str, Any]:
    """What a command tells on its way, and what it answers."""
    told: list[Message] = []
    answer = run_job(Job(kind, study, **options), told.append)
    return "\n".join(one for one in told if isinstance(one, str)), answer


def test_no_command_fits_again_what_one_before_it_fitted(short: Path) -> None:
    added = 'added = ["coulomb friction on p"]'
    short.write_text(short.read_text().replace("added = []", added))
    lines, alone = lines_and_answer(COMPARE, short)
    assert FITTING in lines and ADDING in lines
    short.with_name("study.toml.cache").unlink()
    lines_and_answer(FIT, short)
    lines, after_fit = lines_and_answer(COMPARE, short)
    assert FITTING not in lines and ADDING not in lines
    assert "reusing earlier fits (" in lines and "study.toml.cache" in lines
    assert after_fit == alone  # to the last digit
    short.write_text(short.read_text().replace(added, "added = []") + "# a comment")
    assert FITTING not in lines_and_answer(FIT, short)[0]


EVIDENCE = "computing the evidence"  # what a diagnosis tells on its way


def test_no_command_diagnoses_again_what_one_before_it_diagnosed(
    after_diagnosis: tuple[Path, str, Any], diagnosed: Path
) -> None:
    _, lines, alone = after_diagnosis
    assert EVIDENCE in lines
    lines, again = lines_and_answer(DIAGNOSE, diagnosed)
    assert EVIDENCE not in lines
    assert again == alone  # to the last digit
    text = diagnosed.read_text()
    diagnosed.write_text(text.replace('"quadratic drag", ', ""))
    assert EVIDENCE in lines_and_answer(DIAGNOSE, diagnosed)[0], "other effects"


@pytest.mark.slow
def test_every_figure_and_its_numbers_are_written(
    diagnosed: Path, tmp_path: Path
) -> None:
    assert said("export", diagnosed).code == ExitCode.BAD_INPUT  # no kind of file
    folder = tmp_path / "figures"
    options: Any = {"figures": folder, "kinds": ("csv", "svg", "png")}
    lines, answer = lines_and_answer(EXPORT, diagnosed, **options)
    assert EVIDENCE not in lines  # the diagnosis is taken up
    names = {path.name for path in folder.iterdir()}
    assert names == {Path(one).name for one in answer.content["files"]}
    kinds = {"csv", "svg", "png"}
    runs = ("run_2_held_out_position", "run_1_training_position")
    for name in ("errors", "measurements", *runs):
        assert {f"{name}.{kind}" for kind in kinds} <= names
    table = pd.read_csv(folder / "run_1_training_position.csv")
    lost = table["measured, position (m)"] - table["base model, position (m)"]
    assert np.allclose(lost, table["base model, residual (m)"])
    measured = pd.read_csv(folder / "measurements.csv")
    known = pd.read_csv(diagnosed.with_name("friction_spring.csv"))
    for run, own in known.groupby("run"):
        drawn = measured[measured["run"] == run]
        assert np.allclose(drawn["t (s)"], own["t_s"], atol=1e-6)
        assert np.allclose(drawn.iloc[:, 2], own["position_m"])
    assert (folder / "errors.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_study_takes_up_the_diagnoses_of_the_one_before(diagnosed: Path) -> None:
    job = Job(GO_THROUGH, diagnosed, is_auto=True)
    told: list[Message] = []
    first = run_job(job, told.append)
    assert str(told).count("screening") == 1, "of what the larger model lacks"
    told.clear()
    assert run_job(job, told.append) == first
    assert EVIDENCE not in str(told)
    text = diagnosed.read_text()
    added = 'added = ["coulomb friction on p"]'
    diagnosed.write_text(text.replace("added = []", added))
    assert EVIDENCE not in lines_and_answer(DIAGNOSE, diagnosed)[0]
    other = 'runs = ["run 3"]\n[final]\nruns = ["run 2"]'
    diagnosed.write_text(text.replace("share = 0.4", other))
    assert EVIDENCE in lines_and_answer(DIAGNOSE, diagnosed)[0], "other data that judge"


def test_an_experiment_is_designed_in_the_units_of_the_data(fitted: Path) -> None:
    for file in (fitted, fitted.with_name("friction_spring.csv")):
        text = file.read_text().replace("position_m", "position_mm")
        text = text.replace("m = 2.5", 'm = { value = 2.5, unit = "kg" }')
        file.write_text(text.replace('_mm", unit = "m"', '_mm", unit = "mm"'))
    table = fitted.with_name("next.csv")
    plan = ExperimentPlan(table, ("q=-2:2", "t=2"), ("p=0",), "k")
    lines, answer = lines_and_answer(EXPERIMENT, fitted, plan=plan)
    assert EVIDENCE not in lines
    assert abs(answer.content["x0"]["q"]) <= 0.002  # m
    before, after = answer.content["std_errors"]["k"]
    assert after < before
    assert "Start at q = " in answer.text and "mm" in answer.text
    assert table.read_text().startswith("t [s]\n0\n")
    wrong = ExperimentPlan(table, ("q",))
    with pytest.raises(ph.ModelError, match="--limit='q'"):
        lines_and_answer(EXPERIMENT, fitted, plan=wrong)


def kept_fit(study: Path) -> ph.Fit | None:
    """The fit of the base model that the next command would take."""
    file = ph.StudyFile.read(study)
    return kept_fits.KeptFits.of(study, file, file.split()[0]).with_effects()


def test_a_fit_of_something_else_is_not_taken(fitted, monkeypatch) -> None:
    assert kept_fit(fitted) is not None
    for name, old, new in [
        ("study.toml", "m = 2.5", "m = 2.6"),
        ("study.toml", "start = 10.0", "start = 11.0"),
        ("study.toml", 'unit = "m"', 'unit = ""'),
        ("study.toml", "share = 0.4", "share = 0.4\n[final]\nruns = []"),
        ("study.toml", "[study]", "[loss]\nsteps = 2\n[study]"),
        ("friction_spring.csv", "run 1,0.1,0.326095", "run 1,0.1,0.326096"),
        ("study.toml.cache", '"value": ', '"value": 1'),
        ("study.toml.cache", '{"key"', "{'key'"),
        ("study.toml.cache", "\n", ""),
    ]:
        path = fitted.with_name(name)
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))
        assert kept_fit(fitted) is None, (name, new)
        path.write_text(text)
    assert kept_fit(fitted) is not None
    monkeypatch.setattr(kept_fits, "version", lambda name: "0.0.9")
    assert kept_fit(fitted) is None
    told: list[Message] = []
    run_job(Job(FIT, fitted), told.append)
    assert FITTING in told
    assert kept_fit(fitted) is not None


@pytest.mark.slow
def test_a_study_finds_what_is_missing_and_writes_it_down(diagnosed: Path) -> None:
    before = diagnosed.read_text()
    result = run(
        *("study", "--auto", "--max-steps", 1, "--write"),
        *("--report", "report.html", "--save", "fit.json"),
        at=diagnosed.parent,
    )
    assert result.returncode == ExitCode.DONE, result.stderr
    assert "coulomb friction on p" in result.stdout
    assert "written: report.html" in result.stderr
    assert (
        "Coulomb friction in the equation of p"
        in diagnosed.with_name("report.html").read_text()
    )
    names = ph.Fit.load(diagnosed.with_name("fit.json")).names
    assert "coulomb_friction_p" in names
    assert ph.StudyFile.read(diagnosed).steps.added == ("coulomb friction on p",)
    assert diagnosed.with_name("study.toml.bak").read_text() == before
    assert left_over(diagnosed.parent) == []


def test_what_fails_ends_with_its_own_code(demo: Path) -> None:
    nowhere = said("fit", demo, "--save", demo.parent / "nowhere" / "fit.json")
    assert nowhere.code == ExitCode.BAD_INPUT
    assert "cannot be written" in nowhere.err
    assert answer_to(ph.SolveError("x")).code == ExitCode.FAILED
    assert answer_to(ph.DataError("x")).code == ExitCode.BAD_INPUT
    complaint = ph.Complaint("data.time", "3", "no")
    told = answer_to(ph.StudyFileError("s.toml", [complaint]))
    assert told.content["complaints"] == [vars(complaint)]
    several = [ph.Complaint("held_out.runs", str(k), "no such run") for k in range(25)]
    shown = str(ph.StudyFileError("s.toml", [complaint, *several])).splitlines()
    assert shown[0] == "s.toml: 26 things to correct" and len(shown) == 6
    assert shown[-1] == "  held_out.runs: and 22 more like these"


# ---- Ctrl-C --------------------------------------------------------------------------


def begun(at: Path, after: str, *arguments: str) -> "subprocess.Popen[str]":
    """A command in processes of its own group, once it has said something."""
    process = subprocess.Popen(
        [*COMMAND, *arguments],
        cwd=at,
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stderr is not None
    for line in process.stderr:
        if after in line:
            break
    return process


def stopped(at: Path, after: str, arguments: list[str], number: int) -> Said:
    """A command that gets a signal, as Ctrl-C goes to all processes of a terminal."""
    process = begun(at, after, *arguments)
    os.killpg(process.pid, number)
    out, err = process.communicate(timeout=HANGS_AFTER)
    wait_for(lambda: not any(_living(process.pid)))  # nothing of it goes on
    return Said(process.returncode, out, err)


def _living(group: int) -> Iterator[int]:
    """Processes of a group, without those that ended and were not asked about."""
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, of_group = entry.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue  # it has just ended
        if int(of_group) == group and state != "Z":
            yield int(entry.parent.name)


def test_ctrl_c_ends_a_study_and_keeps_the_finished_steps(fitted: Path) -> None:
    arguments = ["study", "--auto", "--save", "fit.json", "--report", "report.html"]
    ended = stopped(fitted.parent, "screening", [*arguments, "--json"], signal.SIGINT)
    assert ended.code == ExitCode.INTERRUPTED
    content = json.loads(ended.out)
    assert content["interrupted"]
    assert [row["effect"] for row in content["history"]] == ["base model"]
    assert content["written"] == ["fit.json", "report.html"]
    assert "Traceback" not in ended.err
    assert "written: fit.json" in ended.err
    assert set(ph.Fit.load(fitted.with_name("fit.json")).names) == {"k", "c"}
    assert "base model" in fitted.with_name("report.html").read_text()
    assert left_over(fitted.parent) == []


def test_a_working_process_that_dies_is_told(fitted: Path) -> None:
    process = begun(fitted.parent, "screening", "study", "--auto", "--save", "fit.json")
    (working,) = working_processes(process.pid)
    os.kill(working, signal.SIGKILL)
    _, err = process.communicate(timeout=HANGS_AFTER)
    assert process.returncode == ExitCode.FAILED
    assert "ended without a result" in err
    assert ph.Fit.load(fitted.with_name("fit.json")).names == ("k", "c")


def test_the_working_process_ends_with_the_one_that_waits_for_it(fitted: Path) -> None:
    process = begun(fitted.parent, "screening", "study", "--auto")
    process.kill()
    assert process.stderr is not None and process.stdout is not None
    process.stderr.close()
    process.stdout.close()
    process.wait()
    wait_for(lambda: not any(_living(process.pid)))


def working_processes(parent: int) -> Iterator[int]:
    """The children that work, not the one that multiprocessing has for itself."""
    children = Path(f"/proc/{parent}/task/{parent}/children")
    if not children.exists():
        pytest.skip("this system does not list the children of a process")
    for child in children.read_text().split():
        command = Path(f"/proc/{child}/cmdline").read_bytes()
        if b"resource_tracker" not in command:
            yield int(child)


# ---- demo and page -------------------------------------------------------------------


def test_the_demonstration_ships_and_overwrites_nothing(tmp_path, monkeypatch) -> None:
    jobs: list[Any] = []
    monkeypatch.setattr(commands, "do", lambda job, as_json: jobs.append(job))
    assert said("demo", tmp_path / "d").code == 0
    assert jobs[0].is_auto and jobs[0].study == tmp_path / "d" / "study.toml"
    assert (tmp_path / "d" / "friction_spring.csv").read_bytes() == CSV.read_bytes()
    assert ph.StudyFile.read(tmp_path / "d" / "study.toml").model().free == ("k", "c")
    (tmp_path / "d" / "study.toml").write_text("mine")
    again = said("demo", tmp_path / "d")
    assert again.code == ExitCode.BAD_INPUT
    assert "was not overwritten" in again.err
    assert len(jobs) == 1


def test_the_page_says_how_to_install_what_it_needs(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "nicegui", None)  # as where it is not installed
    result = said("page")
    assert result.code == ExitCode.BAD_INPUT
    assert "pip install 'phsi_opt[app]'" in result.err


def test_the_page_opens_the_study_of_its_folder(tmp_path, monkeypatch) -> None:
    opened: list[Path | None] = []
    serve = "phsi_opt.page.serve.serve"
    monkeypatch.setattr(serve, lambda study, **_: opened.append(study))
    monkeypatch.chdir(tmp_path)
    assert said("page").code == 0
    Path("study.toml").touch()
    for named in ((), ("other.toml",)):
        assert said("page", *named).code == 0
    assert opened == [None, Path("study.toml"), Path("other.toml")]


def test_a_study_that_breaks_off_says_so_in_its_report(fitted, monkeypatch) -> None:
    def breaks(*_: object, **__: object) -> str:
        raise RuntimeError("a mistake on the way")

    monkeypatch.setattr(ph.Study, "auto", breaks)
    told: list[Message] = []
    job = Job(GO_THROUGH, fitted, is_auto=True, report=fitted.with_name("report.html"))
    with pytest.raises(RuntimeError):
        run_job(job, told.append)
    kept = [one for one in told if isinstance(one, Finished)][-1]
    assert kept.files == (fitted.with_name("report.html"),)
    report = kept.files[0].read_text(encoding="utf-8")
    assert "the study failed: a mistake on the way.</h1>" in report
    assert "So far: the error on data not used for fitting is" in report
    assert "base model" in kept.text


# ---- small parts ---------------------------------------------------------------------


def test_durations_are_told_as_people_read_them() -> None:
    assert [duration(s) for s in (7.9, 750, 3723)] == ["0:07", "12:30", "1:02:03"]


def test_what_is_not_finite_is_null_in_json() -> None:
    value = {"a": float("nan"), "b": (1.5, float("inf")), "c": Path("x"), "d": None}
    assert plain(value) == {"a": None, "b": [1.5, None], "c": "x", "d": None}


# ---- the reference -------------------------------------------------------------------


def test_the_reference_lists_every_key_command_and_exit_code() -> None:
    text = (ROOT / "docs" / "command_line.md").read_text()
    for key in KEYS:
        assert f"| `{key.path}` | {key.form} | {key.meaning} |" in text
    for command in app.registered_commands:
        assert command.callback is not None
        name = command.name or command.callback.__name__
        assert f"`phsi-opt {name}" in text
    for code, meaning in MEANINGS.items():
        assert f"| {code.value} | {meaning} |" in text

"""The page without a browser: drafts, session, worker, limits, words."""

import asyncio
import gc
import os
import signal
import sys
import threading
import time
import weakref
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from runpy import run_path
from typing import Any

import openpyxl
import pytest

import phsi_opt as ph
from phsi_opt.page.draft_views import EXAMPLES, unknown_names
from phsi_opt.page.drafts import (
    MOST_UPLOADED,
    NOTHING,
    DataDraft,
    draft_of,
    match_states,
)
from phsi_opt.page.guards import UploadLimit
from phsi_opt.page.parts import complaint_words, words
from phsi_opt.page.serve import is_loopback, serve
from phsi_opt.page.session import Job, Session
from phsi_opt.page.study_view import beside, rows_of
from phsi_opt.page.worker import Shown, Turns, waits
from phsi_opt.presentation.content import StudyContent
from phsi_opt.study_file.columns import INPUT, STATE, TIME, UNUSED, Column
from phsi_opt.study_file.gallery import GALLERY
from phsi_opt.study_file.toml_text import toml_tables
from tests.page_tools import spring_table
from tests.test_logger_files import mdf_file, tdms_file
from tests.waiting import HANGS_AFTER, wait_for

# What the page was given of ``studied``, and whether what is missing was said to be
# worked out.
SHOWN: list[tuple[StudyContent, bool]] = []
CONSIDERED = ("coulomb friction", "quadratic drag", "cubic stiffness")


def pid_of(session: Session) -> int:
    """The number of the process that solves."""
    assert session._worker is not None
    return session._worker.process.pid or 0


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{pid}/status")
    return not status.exists() or "State:\tZ" not in status.read_text()


def filled(folder: Path) -> Session:
    """A session with the spring of the demonstration."""
    session = Session(folder)
    assert session.upload("spring.csv", spring_table()), session.upload_error
    session.choose(GALLERY["mass"])
    mass = next(one for one in session.draft.model.parameters if one["name"] == "m")
    mass["value"] = 2.5
    assert session.check() == ()
    return session


def consider_few(session: Session) -> None:
    """Few effects, so that a diagnosis ends sooner."""
    session.draft.kept["study"] = {"effects": list(CONSIDERED)}


@pytest.fixture(autouse=True)
def few_processes(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files are read in this process; ``studied`` and a browser have one for that."""
    monkeypatch.setattr(Session, "_call", lambda _, __, read, *given: read(*given))
    if {"studied", "worker"}.isdisjoint(request.fixturenames):
        monkeypatch.setattr(Session, "_ready_worker", lambda _: None)


@pytest.fixture
def worker() -> None:
    """Asked for where something is solved: processes for that are begun."""


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    made = filled(tmp_path)
    yield made
    made.close()


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    """The spring, fitted, with the friction that was found added."""
    made = filled(tmp_path_factory.mktemp("studied"))
    consider_few(made)
    show = Session._show

    def noted(self: Session, shown: Shown) -> None:
        show(self, shown)
        SHOWN.append((shown.content, self.is_diagnosing))

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Session, "_show", noted)
        made.fit()
        wait_for(lambda: made.job is None)
        assert made.content is not None, made.message
        assert made.content.present is not None, made.message
        made.auto()
        wait_for(lambda: made.job is None)
    yield made
    made.close()


# ---- the table -----------------------------------------------------------------------


@pytest.mark.parametrize(("content", "said"), [
    (b"", "is empty"),
    (b"t,q\n0,1\n1\n", "line 3 has 1 cell; expected 2"),
    (b"t,q,q\n0,1,1\n1,2,2\n", "q: 2 columns have this name"),
    (b"0" * (MOST_UPLOADED + 1), "at most 20 MB"),
], ids=["empty", "short", "twice", "large"])  # fmt: skip
def test_what_is_no_table_is_refused(tmp_path: Path, content: bytes, said: str) -> None:
    session = Session(tmp_path / "own")
    assert not session.upload("../../x.csv", content)
    assert said in session.upload_error
    assert [one.key for one in session.complaints] == ["data.files"]
    assert not list(tmp_path.rglob("x.csv")), "a name with a path is no path"
    session.close()


def test_nothing_is_diagnosed_before_it_is_fitted(tmp_path: Path, worker: None) -> None:
    session = Session(tmp_path)
    session.diagnose()
    wait_for(lambda: session.job is None)
    assert session.message == "Nothing has been fitted yet; press Fit first."
    with pytest.raises(ph.DataError, match="nothing has been fitted yet"):
        session.study_file()
    assert session.failure
    session.check()
    assert session.failure == "", "a failure is told until the draft changes"
    session.close()


@pytest.mark.parametrize("is_installed", [True, False])
def test_the_file_of_a_logger_is_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_installed: bool
) -> None:
    content = tdms_file(tmp_path / "log.tdms").read_bytes()
    if not is_installed:
        monkeypatch.setitem(sys.modules, "nptdms", None)
    session = Session(tmp_path / "own")
    assert session.upload("log.TDMS", content) == is_installed
    if is_installed:
        assert session.seen_data.chart is not None, session.complaints
        assert session.draft.data is not None
        assert session.draft.content()["data"]["group"] == "fast"
        assert [one.unit for one in session.draft.data.of_part(STATE)] == ["mm"]
    else:
        said = "file 'log.TDMS' needs nptdms. Install it: pip install"
        assert said in session.upload_error
    session.close()


def workbook(path: Path) -> Path:
    book = openpyxl.Workbook()
    for name, column in (("fast", "q (mm)"), ("slow", "oil (degC)")):
        rows = [("t (s)", column), *((n / 2, n * n % 7) for n in range(8))]
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(row)
    book.remove(book.worksheets[0])
    book.save(path)
    return path


@pytest.mark.parametrize("make", [workbook, mdf_file, tdms_file])
def test_another_sheet_or_group_of_a_file_is_chosen(make: Any, tmp_path: Path) -> None:
    suffix = {workbook: ".xlsx", mdf_file: ".mf4", tdms_file: ".tdms"}[make]
    key = "sheet" if make is workbook else "group"
    content = make(tmp_path / f"log{suffix}").read_bytes()
    session = Session(tmp_path / "own")
    assert session.upload(f"a{suffix}", content), session.upload_error
    known: Any = session.draft.data
    assert known.sheets == ("fast", "slow")
    known.parts["held_out"]["way"] = NOTHING
    session.choose_sheet("slow")
    data: Any = session.draft.data
    if make is tdms_file:  # its slow group has one column, and no times
        assert [one.column for one in data.columns] == ["oil"]
    else:
        assert data.columns[1].unit == "degC", session.upload_error
    assert session.draft.content()["data"][key] == "slow"
    assert data.parts["held_out"]["way"] == NOTHING, "what was said stays"
    assert session.upload(f"b{suffix}", content), session.upload_error
    assert list(data.places) == [f"a{suffix}", f"b{suffix}"]
    assert data.sheets[0] == "slow"
    (tmp_path / "again.toml").write_text(session.draft.as_it_is().text)
    told = toml_tables((tmp_path / "again.toml").read_text())
    again = DataDraft.of(told, session.draft.places)
    assert again.sheets[0] == "slow"
    assert session.step(-1) == session.step(-1) == "data"
    session.choose_sheet("none of this name")
    back: Any = session.draft.data
    assert back.sheets[0] == "fast"
    session.close()


def test_tables_with_the_same_columns_are_runs_and_others_take_their_place(
    tmp_path: Path,
) -> None:
    session = Session(tmp_path)
    session.upload("a.csv", b"t;q\n0;1,5\n1;3,5\n2;2,0\n")
    data = session.draft.data
    assert data is not None
    data.columns[1].unit = "mm"
    session.upload("b.csv", b"t;q\n0;2,5\n1;1\n2;4\n")
    assert data.runs == ["a", "b"]
    session.remove_file("a.csv")
    assert list(data.places) == ["b.csv"]
    assert data.columns[1].unit == "mm", "what was said of it stays"
    assert session.upload("c.csv", b"Zeit,Weg\n0,2\n1,1\n2,4\n"), session.upload_error
    assert session.draft.places.keys() == {"c.csv"}
    assert "c.csv has other columns: it replaces b.csv" in session.message
    session.remove_file("c.csv")
    session.close()
    assert session.draft.data is None
    assert "there is no table yet" in session.complaints[0].said


# ---- the model -----------------------------------------------------------------------


def test_columns_become_the_states_of_the_same_unit() -> None:
    columns = [
        Column("v", unit="m/s", part=STATE, name="v"),
        Column("x", unit="mm", part=STATE, name="x"),
        Column("u", unit="N", part=INPUT, name="u"),
    ]
    data = DataDraft({"a.csv": Path("a.csv")}, columns)
    match_states(data, GALLERY["pendulum"])
    assert columns[1].part == "left out"
    force = columns[2]
    assert force.part == "left out", "an input in N, where a torque acts"
    force.name = "force"
    base = match_states(data, GALLERY["mass"])
    assert (columns[1].part, columns[1].name) == (STATE, "q"), "it comes back"
    assert columns[0].name == "v", "a velocity is no momentum"
    assert data.unmeasured == {}
    draft = draft_of(base, data)
    assert (force.name, draft.names("inputs")) == ("u", ["u"])
    assert draft.table["F"] == {"q": "v", "v": "-(k*q + c*v)/m + u/m"}
    columns[0].part = UNUSED
    assert match_states(data, GALLERY["mass"]) is GALLERY["mass"]
    assert data.unmeasured == {"p": "kg m/s"}
    assert not any(one["is_assumed"] for one in draft.parameters), (
        "a force shows the mass"
    )


def test_a_column_taken_for_a_state_is_the_input_that_a_base_model_needs() -> None:
    columns = [
        Column("Spannung", unit="V", part=STATE, name="Spannung"),
        Column("Strom", unit="mA", part=STATE, name="Strom"),
    ]
    data = DataDraft({"a.csv": Path("a.csv")}, columns)
    match_states(data, GALLERY["rlc"])
    assert [(one.part, one.name) for one in columns] == [(INPUT, "u"), (STATE, "i")]
    assert data.unmeasured == {"uC": "V"}
    assert draft_of(GALLERY["rlc"], data).names("inputs") == ["u"]


def test_the_run_for_the_end_is_chosen_like_those_held_out(session: Session) -> None:
    data = session.draft.data
    assert data is not None
    final = data.parts["final"]
    content = session.draft.content()
    assert (content["held_out"], content["final"]) == ({"share": 0.3}, {})
    final["runs"] = ["run 1"]
    for way, told in (("runs", ["run 1"]), (NOTHING, [])):
        final["way"] = way
        assert session.check() == ()
        assert session.draft.content()["final"] == {"runs": told}
    data.parts["held_out"]["way"] = final["way"] = "runs"
    data.parts["held_out"]["runs"] = ["run 1"]
    (found,) = session.check()
    assert found.key.split(".")[0] in ("held_out", "final"), found


def test_dates_are_read_in_the_order_of_which_they_can_be(tmp_path: Path) -> None:
    days = ["01/12/2026,23:50:00", "01/12/2026,23:55:00", "01/13/2026,00:00:00"]
    lines = [f"{day},{20 + i}" for i, day in enumerate(days)]
    table = "\n".join(["Date,Time,Room (degC)", *lines]) + "\n"
    session = Session(tmp_path)
    assert session.upload("room.csv", table.encode()), session.upload_error
    data = session.draft.data
    assert data is not None
    date = data.columns[0]
    assert date.heading == "Date + Time"
    assert date.date_format == "%m/%d/%Y %H:%M:%S"
    session.choose(GALLERY["room"])
    assert not [one for one in session.check() if one.key.startswith("data.time")]
    date.part = UNUSED
    data.time |= {"step": 5.0, "unit": "min"}
    assert not [one for one in session.check() if one.key.startswith("data.time")]
    date.part = TIME
    assert date.date_format == "%m/%d/%Y %H:%M:%S"


def test_the_live_check_names_what_is_wrong(session: Session) -> None:
    session.draft.model.table["H"] = "kk*q**2/2 + p**2/(2*m)"
    session.draft.model.table["R"]["p"] = "c*("
    session.draft.model.parameters[0]["lower"] = "twenty"
    words = {one.key: complaint_words(one) for one in session.check()}
    assert "Energy H" in words["model.H"]
    assert "'kk' is not known here" in words["model.H"]
    assert "Did you mean 'k'?" in words["model.H"]
    assert words["model.R.p"].startswith("Loss R of p")
    assert words["parameters.k.lower"].startswith("Lower bound of k")
    assert unknown_names(session.complaints) == ["kk"]
    session.draft.model.table["R"]["p"] = "d"
    session.draft.model.table["F"]["p"] = "f*v0"
    assert unknown_names(session.check()) == ["kk", "d", "f", "v0"]
    session.fit()
    assert session.job is None
    assert "cannot be fitted yet" in session.message
    session.draft.model.table["R"]["p"] = "r*exp(-q)"
    session.draft.model.table["F"]["p"] = ["f1*t", "f2"]
    assert unknown_names(session.check()) == ["kk", "r", "f1", "f2"]


SPRING_FILE = """
[data]
files = ["spring.csv"]
trajectory = "run"
between = [0, 4]
decimal = "."
thinned = 2
time = { column = "t_s", unit = "s" }
[data.states]
q = { column = "position_m", unit = "m", noise = 0.04 }
p = { measured = false, unit = "kg m/s" }
[held_out]
runs = ["run 3"]
[final]
runs = ["run 2"]
[model]
states = ["q", "p"]
pairs = [["q", "p"]]
H = "k*q**2/2 + p**2/(2*m)"
R = { p = "c" }
F = { p = { body = "t", coefficient = { start = 0.5 } } }
[parameters]
m = 2.5
k = { start = 10.0, lower = 0, unit = "N/m", per_trajectory = true }
c = { lower = 0 }
[study]
added = ["coulomb friction on p"]
without = ["harmonic force"]
[loss]
huber = 1.5
"""


def test_a_study_file_becomes_drafts_and_comes_back(tmp_path: Path) -> None:
    (tmp_path / "spring.csv").write_bytes(spring_table())
    path = tmp_path / "study.toml"
    path.write_text(SPRING_FILE)
    session = Session(tmp_path / "session", path)
    assert session.complaints == ()
    (tmp_path / "again.toml").write_text(session.draft.as_it_is().text)
    again = ph.StudyFile.read(tmp_path / "again.toml")
    assert again.text() == ph.StudyFile.read(path).text()


def test_the_measurements_are_drawn_before_there_is_a_model(tmp_path: Path) -> None:
    session = Session(tmp_path)
    assert session.seen_data.chart is None
    session.upload("spring.csv", spring_table())
    seen = session.seen_data
    assert seen.chart is not None
    assert [panel.label for panel in seen.chart.panels] == ["position (m)"]
    assert [row["channel"] for row in seen.rows] == ["t", "position"]
    session.check()
    assert session.seen_data is seen, "nothing has changed"
    assert session.draft.data is not None
    session.draft.data.columns[2].unit = "metre"
    session.check()
    assert session.seen_data.rows[1]["unit"] == "metre"
    session.draft.data.columns[1].part = UNUSED
    session.check()
    assert session.seen_data.chart is None
    session.close()


# ---- the work ------------------------------------------------------------------------


def test_the_hidden_effect_is_found_and_the_error_falls(studied: Session) -> None:
    content = studied.content
    assert content is not None and content.present is not None
    base, larger = content.steps
    assert larger.label == "coulomb friction in the equation of p"
    assert larger.judged is not None and base.judged is not None
    assert larger.judged < 0.8 * base.judged
    told = content.headline
    assert told.status == content.present.verdict == "nothing missing"
    assert told.discovery.lead.startswith("Coulomb friction (")
    assert f"fell from {base.judged:.3g} to {larger.judged:.3g} m" in told.sentence
    assert content.forces and not content.present.forces
    ranked = {row.effect: row for row in content.present.ranking}
    assert ranked["quadratic drag on p"].size == "size not determined"  # at a limit


def test_the_time_that_remains_is_told_from_the_steps_that_are_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    job = Job(partial(print), "Fitting and diagnosing", began=100.0)
    told = []
    for line, seconds in (
        ("screening 26 candidate effects", 4.0),
        ("computing the evidence of drag (1 of 4)", 6.0),
        ("computing the evidence of friction (2 of 4)", 2.0),
        ("computing the evidence of a gap (3 of 4)", 0.0),
        ("re-fitting with friction", 1.0),
    ):
        job.take(line)
        told.append(job.times)
        now[0] += seconds
    assert told == [
        "0:00",  # what is not counted is not guessed
        "0:04",
        "0:10, at most 0:18 more for these 4",
        "0:12, at most 0:08 more for these 4",
        "0:12",
    ]


def test_it_is_told_whether_a_model_is_diagnosed_or_will_be(studied: Session) -> None:
    told = [(len(one.steps), one.present is not None) for one, _ in SHOWN]
    fitted = [(1, False), (1, True)]
    assert told == [*fitted, (2, False), (2, True), (2, True)]
    for content, is_diagnosing in SHOWN:
        assert is_diagnosing == (content.present is None)
        said = words("not_asked", content.steps[-1], "m", is_diagnosing)
        assert ("diagnosis is running" in said) == is_diagnosing
    assert {one.stopped for one, _ in SHOWN} == {""}, "the verdict says why"
    assert all(one.content.present is not None for one in studied.models)


def test_the_exported_script_reproduces_every_step(
    studied, tmp_path, monkeypatch
) -> None:
    assert studied.content is not None
    (tmp_path / "spring.csv").write_bytes(spring_table())
    script = tmp_path / "study.py"
    script.write_text(studied.study_file().script())
    monkeypatch.chdir(tmp_path)
    errors = [step.judged.rmse for step in run_path(str(script))["study"].steps]
    expected = [step.judged for step in studied.content.steps]
    # On the page the re-fit begins where the diagnosis ended: the same optimum, found
    # from elsewhere.
    assert errors == pytest.approx(expected, rel=1e-3)
    (tmp_path / "study.toml").write_text(studied.study_file().text())
    assert ph.StudyFile.read(tmp_path / "study.toml").steps.added == (
        "coulomb friction on p",
    )


def test_the_fitted_model_is_exported_with_its_error(studied: Session) -> None:
    studied.report("model.c")
    wait_for(lambda: studied.job is None)
    assert studied.report_path is not None
    text = studied.report_path.read_text()
    assert "void model_rates" in text and "coulomb_friction_p" in text
    assert "On the measurements that it was compared with" in text


def test_undo_and_redo_solve_nothing_and_lose_no_model(studied: Session) -> None:
    larger = studied.content
    assert larger is not None
    assert [one.name for one in studied.models] == [
        "base model",
        "+ Coulomb friction in the equation of p",
    ]
    assert studied.compared == 0
    assert not studied.can_step(1)
    assert studied.step(-1) == "study"
    assert studied.job is None
    assert studied.content is not None
    assert studied.content.steps == (replace(larger.steps[0], final=None),)
    assert studied.content.present is not None
    assert studied.content.present.proposed == ("coulomb friction on p",)
    assert "coulomb friction on p" not in studied.study_file().text()
    assert studied.can_step(1)
    assert studied.compared is None
    assert studied.step(1) == "study"
    assert studied.content is larger
    studied.step(-1)
    studied.rest()  # a further worker goes on from the model that is shown
    studied.add("quadratic drag on p")
    wait_for(lambda: len(studied.models) == 3)
    studied.cancel()
    assert studied.content.added == ("quadratic drag on p",)
    studied.go_to(1)
    assert studied.content is larger
    studied.look.run = 1
    run = larger.runs[1]
    base, present = studied.models[0].content, studied.models[2].content
    content, drawn = beside({"one": base, "other": present}, run, 0)
    assert content.names == ("one", "other")
    assert len(drawn.channels[0].models) == 2
    rows = rows_of([base, larger])
    assert list(rows)[:3] == ["training error", "held-out error", "k"]
    assert rows["Coulomb friction in the equation of p"][0] == ""
    (law,) = studied.models[1].laws
    assert law.law is not None, "it is drawn through the missing force"


def test_every_edit_is_undone_and_done_again(tmp_path: Path) -> None:
    session = filled(tmp_path)
    assert session.draft.data is not None
    session.draft.data.columns[2].unit = "metre"
    session.check()
    session.draft.model.table["H"] = "k*q**2 + p**2/(2*m)"
    session.check()
    seen = session.seen_data
    assert session.check() == (), "nothing has changed: no step of its own"
    written = session.draft.as_it_is()
    assert session.step(-1) == "model"
    assert session.draft.model.table["H"] == "k*q**2/2 + p**2/(2*m)"
    assert session.step(-1) == "data"
    assert session.draft.data.columns[2].unit == "m"
    assert session.seen_data.rows[1]["unit"] == "m"
    while session.can_step(-1):
        session.step(-1)
    assert session.draft.data is None
    assert session.step(-1) == ""
    while session.can_step(1):
        session.step(1)
    assert session.draft.as_it_is() == written
    assert session.complaints == (), "the file that was uploaded is still there"
    assert str(session.seen_data.rows) == str(seen.rows)
    session.step(-1)
    session.draft.model.table["H"] = "k*q**2/4 + p**2/(2*m)"
    session.check()
    assert not session.can_step(1), "a new change begins from here"


def test_steps_of_two_windows_wait_for_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = filled(tmp_path)
    session.draft.model.table["H"] = "k*q**2 + p**2/(2*m)"
    session.check()
    written, version, shape = session.draft.as_it_is(), session.version, session.shape
    told, goes_on = threading.Event(), threading.Event()

    def slow(self: Session) -> None:
        told.set()
        assert goes_on.wait(HANGS_AFTER)

    monkeypatch.setattr(Session, "_check", slow)
    steps = [threading.Thread(target=session.step, args=(by,)) for by in (-1, 1)]
    steps[0].start()
    assert told.wait(HANGS_AFTER)
    assert session.shape > shape, "its fields are drawn before it is checked"
    assert session.version > version, "and its buttons: a key may follow at once"
    assert session.can_step(1)
    steps[1].start()
    goes_on.set()
    for step in steps:
        step.join()
    assert session.draft.as_it_is() == written
    assert session.can_step(-1) and not session.can_step(1)
    session.close()


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_example_is_a_study_without_complaint(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Session, "_order", lambda one, *_: setattr(one, "job", "fit"))
    session = Session(tmp_path)
    session.open_example(name)
    assert session.job is not None, session.complaints
    session.close()


def test_a_study_file_opens_when_its_tables_are_there(tmp_path: Path) -> None:
    folder = Path(ph.__file__).parent / "study_file" / "examples" / "motor"
    session = Session(tmp_path)
    text = (folder / "study.toml").read_bytes()
    assert session.upload("mine.toml", text)
    assert session.message == "mine.toml reads motor.csv: upload this as well."
    assert session.upload("motor.csv", (folder / "motor.csv").read_bytes())
    assert session.complaints == (), session.upload_error
    assert session.draft.model.table["F"] == {"w": "(K*u - b*w)/J"}
    assert not session.upload("wrong.toml", b"[data]\nfiles = 3")
    assert "wrong.toml" in session.upload_error
    assert session.draft.model.table["F"] == {"w": "(K*u - b*w)/J"}, "nothing is lost"
    elsewhere = text.replace(b"motor.csv", b"/etc/hostname")
    assert session.upload("other.toml", elsewhere)
    assert session.message.startswith("other.toml reads /etc/hostname: upload this")
    assert session.upload("mine.toml", text)
    assert session.message == "", "the other file is not waited for any more"
    session.close()


def test_refusals_speak_of_the_fields_of_the_page(session: Session) -> None:
    mass = next(one for one in session.draft.model.parameters if one["name"] == "m")
    del mass["value"]
    said = [complaint_words(one) for one in session.check()]
    assert "Parameter m: enter the known value, such as 2.5." in said
    del session.draft.model.table["states"]
    said = [complaint_words(one) for one in session.check()]
    assert "States: expected the names of the states, such as q, p." in said
    advice = 'the model has this name: give { column = "..." }, or { measured = false }. Other'
    words = complaint_words(ph.Complaint("data.states.x", "", advice))
    assert words.startswith("Column of x: it is in the model: give its name to a")


def test_what_was_found_is_kept_when_a_solve_is_cancelled_or_its_worker_lost(
    worker, session
) -> None:
    consider_few(session)
    session.fit()
    wait_for(lambda: session.content is not None)  # fitted; the diagnosis goes on
    assert session.job is not None
    assert session._worker is not None
    pid = pid_of(session)
    session.cancel()
    assert not is_running(pid)
    assert session.job is None
    assert session.message.startswith("Cancelled: Fitting and diagnosing.")
    assert session.content.present is None
    fitted = session.content
    session.diagnose()
    assert session._worker is not None
    os.kill(pid_of(session), signal.SIGKILL)
    wait_for(lambda: session.job is None)
    assert "ended unexpectedly (Diagnosing)" in session.message
    assert session.content is fitted and not session.is_stale
    session.diagnose()
    wait_for(lambda: session.job is None)
    assert session.message == ""
    further = session.content
    assert further and further.present is not None, "it went on from what was kept"


def test_a_session_that_ends_leaves_no_memory_process_or_file(
    tmp_path: Path, worker: None
) -> None:
    session = filled(tmp_path / "own")
    session.show_up()
    assert session._worker is not None
    pid = pid_of(session)
    known = weakref.ref(session)
    session.close()
    del session
    wait_for(lambda: gc.collect() >= 0 and known() is None)
    assert not is_running(pid)
    assert list(tmp_path.iterdir()) == []


def test_orders_wait_for_their_turn_and_a_lost_worker_gives_it_back(
    worker: None, session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def waits_for(one: Session, n: int) -> bool:
        return one.job is not None and one.job.line == waits(n)

    monkeypatch.setattr("phsi_opt.page.worker.TURNS", Turns(1))
    other, last = filled(tmp_path / "other"), filled(tmp_path / "last")
    consider_few(other)
    session.fit()
    wait_for(lambda: bool(session.job and session.job.line))
    other.fit()
    wait_for(lambda: waits_for(other, 1))
    last.fit()
    wait_for(lambda: waits_for(last, 2))
    other.cancel()  # who waits no more is not waited for
    wait_for(lambda: waits_for(last, 1))
    other.fit()
    wait_for(lambda: waits_for(other, 2))
    assert session._worker is not None
    os.kill(pid_of(session), signal.SIGKILL)
    wait_for(lambda: session.job is None)
    assert "(Fitting and diagnosing)" in session.message
    wait_for(lambda: waits_for(other, 1))
    last.cancel()
    wait_for(lambda: other.content is not None)
    assert other.job and "waiting" not in other.job.words, "its turn has come"
    session.fit()
    wait_for(lambda: waits_for(session, 1))
    other.cancel()
    wait_for(lambda: session.content is not None)
    last.fit()
    session.cancel()
    wait_for(lambda: bool(last.job and last.job.line not in ("", waits(1))))
    os.kill(pid_of(session), signal.SIGSTOP)  # it takes no study yet
    session.diagnose()
    wait_for(lambda: waits_for(session, 1))
    for one in (other, last):
        one.close()


# ---- sessions and limits -------------------------------------------------------------


def received(limit: UploadLimit, body: bytes, told: int | None) -> int:
    """The status of an answer to a request; 200 where it was passed on whole."""
    headers = [] if told is None else [(b"content-length", str(told).encode())]
    sent: list[Any] = []

    async def receive() -> Any:
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: Any) -> None:
        sent.append(message)

    asyncio.run(limit({"type": "http", "headers": headers}, receive, send))
    return int(sent[0]["status"])


@pytest.mark.parametrize(
    ("n_bytes", "told", "status"),
    [(10, 10, 200), (10, None, 200), (11, 11, 413), (5, 11, 413), (11, 5, 400)],
)
def test_requests_that_are_too_large_are_refused(n_bytes, told, status) -> None:
    async def application(scope: Any, receive: Any, send: Any) -> None:
        message = await receive()
        is_whole = message["type"] == "http.request"
        await send({"type": "http.response.start", "status": 200 if is_whole else 400})

    limit = UploadLimit(application, most=10)
    assert received(limit, b"0" * n_bytes, told) == status


def test_the_page_is_for_this_machine_alone_unless_told_otherwise(tmp_path) -> None:
    assert serve.__defaults__ is not None
    for host in (serve.__defaults__[1], "localhost", "::1"):
        assert is_loopback(host)
    assert not is_loopback("0.0.0.0")
    assert not is_loopback("example.org")
    path = tmp_path / "study.toml"
    path.write_text("[data]\n")  # told before anything is served
    with pytest.raises(ph.StudyFileError, match="things to correct"):
        serve(path)

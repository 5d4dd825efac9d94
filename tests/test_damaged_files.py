"""Files that are no tables, are damaged or are made to do harm: told, never a crash."""

import io
import os
import re
import signal
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pytest
from scipy.io import savemat

import phsi_opt as ph
from phsi_opt import reading
from phsi_opt.command_line.file_jobs import first_study
from phsi_opt.data import reading_apart

T = np.arange(40.0)
N_DAMAGED = 8  # workbooks; always the same ones
LONGEST_WAIT = 600  # seconds; only a hang takes so long
COLUMNS: dict[str, Any] = {"time": "t", "states": ["q"]}


# ---- what is no regular file, and what is too large ----------------------------------

READERS: dict[str, Callable[[Path], Any]] = {
    "a.csv": lambda path: ph.Measurements.from_csv(path, **COLUMNS),
    "a.xlsx": lambda path: ph.Measurements.from_excel(path, **COLUMNS),
    "a.mat": lambda path: ph.Measurements.from_mat(path, **COLUMNS),
    "a.json": ph.Fit.load,
    "a.toml": ph.StudyFile.read,
    "b.csv": lambda path: first_study([path], path.with_name("s.toml"), force=False),
}


@pytest.fixture(params=READERS)
def entry(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, Any]:
    """The path of a file that is not there yet, and what reads it."""
    return tmp_path / request.param, READERS[request.param]


@pytest.fixture
def held_pipe() -> Iterator[Callable[[Path], None]]:
    """Makes pipes that never end: each has a writer, who writes nothing more."""
    handles = []
    before = signal.signal(signal.SIGALRM, _fail)
    signal.alarm(LONGEST_WAIT)

    def make(path: Path) -> None:
        os.mkfifo(path)
        handles.append(os.open(path, os.O_RDWR | os.O_NONBLOCK))

    yield make
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)
    for handle in handles:
        os.close(handle)


def _fail(*_: Any) -> None:
    pytest.fail(f"the pipe was waited for, {LONGEST_WAIT} s")  # no reader catches this


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_is_refused_and_not_waited_for(entry, held_pipe) -> None:
    path, read = entry
    held_pipe(path)
    with pytest.raises(
        ph.DataError, match="it is a pipe, a socket or a device, not a regular file"
    ):
        read(path)


@pytest.mark.skipif(not Path("/dev/null").exists(), reason="no devices as files here")
def test_a_device_and_a_file_that_is_too_large_are_refused_before_they_are_read(
    entry: tuple[Path, Any],
) -> None:
    path, read = entry
    path.symlink_to("/dev/null")
    with pytest.raises(ph.DataError, match="a device, not a regular file"):
        read(path)
    path.unlink()
    with path.open("wb") as file:
        file.truncate(reading.LARGEST_FILE + 1)  # takes no place on the disk
    most = 1 if path.suffix == ".toml" else 500
    with pytest.raises(ph.DataError, match=f"MB or more; at most {most} MB are read"):
        read(path)


def test_a_loop_of_links_and_an_endless_path_are_refused_in_a_few_words(
    entry: tuple[Path, Any],
) -> None:
    path, read = entry
    path.symlink_to(path)
    with pytest.raises(ph.DataError, match=r"(cannot be read|no such file|symbolic)"):
        read(path)
    for long in (path.with_name("a" * 4000 + path.suffix), path / ("b/" * 2000)):
        with pytest.raises(ph.DataError) as refusal:
            read(long)
        assert len(str(refusal.value)) < 700


def test_a_name_without_end_is_shortened_in_every_message(tmp_path: Path) -> None:
    name = "q" * 100_000
    (tmp_path / "a.csv").write_text(f"t,{name}\n0,1\n1,x\n2,3\n")
    with pytest.raises(ph.DataError) as refusal:
        ph.Measurements.from_csv(tmp_path / "a.csv", time="t", states={"q": name})
    assert len(str(refusal.value)) < 1000
    with pytest.raises(ph.ModelError) as wrong:
        ph.FirstOrder([name], {"x": f"{name}*y"})
    assert len(str(wrong.value)) < 1000


# ---- damaged tables ------------------------------------------------------------------


def mat_file(**options: Any) -> bytes:
    content: dict[str, Any] = {"t": T, "q": T**2, "name": "text"}
    if options.get("format") != "4":
        content["log"] = {"a": T, "X": np.column_stack([T, T])}
        content["cells"] = np.array([T, "a"], object)
        content["z"] = 1j * T
    file = io.BytesIO()
    savemat(file, content, **options)
    return file.getvalue()


def workbook() -> bytes:
    book = openpyxl.Workbook()
    for row in [["t", "q"], *zip(T.tolist(), (T**2).tolist(), strict=True)]:
        book.active.append(row)
    file = io.BytesIO()
    book.save(file)
    return file.getvalue()


def with_part(name: str, change: Callable[[bytes], bytes]) -> io.BytesIO:
    """The workbook with one of its parts changed; the checksums are right again."""
    changed = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(workbook())) as book,
        zipfile.ZipFile(changed, "w", zipfile.ZIP_DEFLATED) as copy,
    ):
        for part in book.namelist():
            content = book.read(part)
            copy.writestr(part, change(content) if part == name else content)
    changed.seek(0)
    return changed


SHEET = "xl/worksheets/sheet1.xml"
PARTS = (SHEET, "xl/workbook.xml", "xl/styles.xml", "xl/_rels/workbook.xml.rels")
from_mat = ph.Measurements.from_mat
from_excel = ph.Measurements.from_excel


def flipped(content: bytes, rng: np.random.Generator, signs: bytes = b"") -> bytes:
    """The content with some bytes changed, or cut."""
    damaged = bytearray(content)
    for _ in range(rng.integers(1, 9)):
        place = rng.integers(len(damaged))
        damaged[place] = rng.choice(list(signs)) if signs else rng.integers(256)
    if rng.random() < 0.1:
        damaged = damaged[: rng.integers(len(damaged))]
    return bytes(damaged)


def read_or_refused(content: bytes, read: Any, path: Path) -> None:
    path.write_bytes(content)
    try:
        read(path, **COLUMNS)
    except ph.DataError as error:
        assert path.name in str(error)


# Seeds with which SciPy 1.17 alone crashed (83, 217), ran out of memory (200, 826),
# raised what it does not promise (85, 118, 0), refused or read the file.
@pytest.mark.parametrize(("content", "seeds"), [
    (mat_file(), (0, 83, 85, 200)),
    (mat_file()[:520], (118, 217, 826)),
    (mat_file(do_compression=True), (34,)),
    (mat_file(format="4"), (1,)),
], ids=["matlab 5", "matlab 5, short", "matlab 7", "matlab 4"])  # fmt: skip
def test_a_matlab_file_with_flipped_bytes_is_read_or_refused_by_name(
    content: bytes, seeds: tuple[int, ...], tmp_path: Path
) -> None:
    for seed in seeds:
        damaged = flipped(content, np.random.default_rng(seed))
        read_or_refused(damaged, from_mat, tmp_path / "bench.mat")


@pytest.mark.filterwarnings("ignore:Cell .* is marked as a date")
@pytest.mark.filterwarnings("ignore:Unknown extension")
def test_a_workbook_whose_xml_is_damaged_is_read_or_refused_by_name() -> None:
    rng = np.random.default_rng(0)
    n_refused = 0
    for number in range(N_DAMAGED):
        damage = with_part(
            PARTS[number % len(PARTS)],
            lambda xml: flipped(xml, rng, b'0123456789AZ<>"/ -.'),
        )
        damage.name = "bench.xlsx"
        try:
            from_excel(damage, **COLUMNS)
        except ph.DataError as error:
            n_refused += 1
            assert "bench.xlsx" in str(error)
    assert n_refused


# ---- MATLAB --------------------------------------------------------------------------


def test_a_matlab_variable_that_grows_beyond_the_bound_is_refused(monkeypatch) -> None:
    zeros = io.BytesIO()
    savemat(zeros, {"t": np.zeros(10_000)}, do_compression=True)
    zeros.seek(0)
    monkeypatch.setattr(reading, "LARGEST_FILE", 50_000)
    with pytest.raises(ph.DataError, match=r"MB when decompressed; at most 0\.05 MB"):
        from_mat(zeros, **COLUMNS)


def test_a_file_that_was_read_is_read_again_without_a_process(monkeypatch) -> None:
    content = mat_file()
    first = from_mat(io.BytesIO(content), **COLUMNS)
    with monkeypatch.context() as without:
        without.setattr(reading_apart, "SCRIPT", Path("none"))
        again = from_mat(io.BytesIO(content), **COLUMNS)
    assert again.trajectories[0].x.tolist() == first.trajectories[0].x.tolist()
    monkeypatch.setattr(reading_apart, "READING_LIMITS", reading_apart.Limits(kept=0))
    from_mat(io.BytesIO(content), **COLUMNS)
    monkeypatch.setattr(reading_apart, "SCRIPT", Path("none"))
    with pytest.raises(ph.DataError, match="exit code"):
        from_mat(io.BytesIO(content), **COLUMNS)


@pytest.mark.parametrize(("script", "wait", "why"), [
    ("import os; os.abort()", 60.0, "is damaged: the reader ended with exit code"),
    ("import time; time.sleep(600)", 0.5, "it was not read in 0.5 s"),
    ("open('answer.json', 'w').write('{')", 60.0, "Expecting property name"),
    ("", 60.0, "there is no such file"),
], ids=["crash", "endless", "half an answer", "no answer"])  # fmt: skip
def test_a_file_whose_reading_crashes_or_never_ends_is_refused(
    script: str, wait: float, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "script.py"
    place.write_text(script)
    monkeypatch.setattr(reading_apart, "SCRIPT", place)
    monkeypatch.setattr(
        reading_apart, "READING_LIMITS", reading_apart.Limits(wait=wait)
    )
    with pytest.raises(
        ph.DataError, match=f"open file cannot be read: .*{why}.* as CSV"
    ):
        from_mat(io.BytesIO(mat_file()), **COLUMNS)


# ---- Excel ---------------------------------------------------------------------------


@pytest.mark.parametrize(("old", "new"), [
    (rb"A1:B41", b"A1:B3"),
    (rb"A1:B41", b"C1:D9"),
    (rb"<row ", b"<row spans='1:2' "),
    (rb' r="[A-Z]*\d+"', b""),
    (rb'<row r="\d+"', b"<row"),
])  # fmt: skip
def test_a_sheet_is_read_whole_whatever_dimension_and_places_it_states(
    old: bytes, new: bytes
) -> None:
    book = with_part(SHEET, lambda xml: re.sub(old, new, xml))
    data = from_excel(book, **COLUMNS)
    np.testing.assert_array_equal(data.trajectories[0].x[:, 0], T**2)


@pytest.mark.parametrize(("old", "new", "message"), [
    (b'<row r="41"', b'<row r="4"', "row 4, or a cell in it, out of order"),
    (b'<row r="41"', b'<row r="40"', "row 40, or a cell in it, out of order"),
    (b'r="A41"', b'r="C41"', "row 41, or a cell in it, out of order"),
    (b'r="B41"', b'r="ABCD41"', "it is damaged .*ABCD"),
    (b'<row r="41"', b'<row r="999999999999"', "beyond 1048576 rows"),
    (b"<worksheet", b"<!DOCTYPE a []><worksheet", "defines XML entities"),
    (b"<worksheet", "<wörksheet".encode("utf-16"), "is not XML in UTF-8"),
])  # fmt: skip
def test_a_sheet_that_would_lose_rows_or_grow_is_refused(old, new, message) -> None:
    def change(xml: bytes) -> bytes:
        assert xml.count(old) == 1
        return new + xml if new.startswith(b"\xff") else xml.replace(old, new)

    with pytest.raises(ph.DataError, match=message):
        from_excel(with_part(SHEET, change), **COLUMNS)


def test_one_filled_cell_far_away_does_not_make_a_sheet_that_fills_the_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reading, "LARGEST_FILE", 500_000)  # bytes; 32 of a cell
    assert from_excel(with_part(SHEET, bytes), **COLUMNS).n_samples == len(T)
    book = with_part(SHEET, lambda xml: xml.replace(b'r="B41"', b'r="XFD41"'))
    with pytest.raises(ph.DataError, match="more than 15625 cells"):
        from_excel(book, **COLUMNS)


# ---- study files and fits ------------------------------------------------------------

DEEP = 50_000
FORCED = "[model]\nstates = ['q', 'p']\nF.p = "  # by the term that follows


@pytest.mark.parametrize(("text", "message"), [
    (".".join("a" * DEEP) + " = 1", "line 1 has a key of more than 32 parts"),
    ("\n[" + ".".join("a" * DEEP) + "]", "line 2 has a key of more than 32"),
    ("a = " + "[" * DEEP + "]" * DEEP, "more than 32 tables or lists"),
    ("a = " + "{ a = " * 40 + "1" + "}" * 40, "more than 32 tables or lists"),
    ("a = { b = 1, " + ".".join("c" * DEEP) + " = 1 }", "key of more than 32"),
    ("a = 0x" + "f" * DEEP, "a whole number has more than 300 digits"),
    ('"\\' * DEEP, "this is not TOML"),
    ("#" + "x" * 1_000_000, "at most 1 MB are read"),
    ("".join(f"k{i} = 1\n" for i in range(DEEP)), "the rest of the file was not checked"),
    (f"[study]\neffects = {['a'] * DEEP}", f"it has {DEEP} entries; at most 100 are read"),
    (f"[study]\nadded = {['a'] * DEEP}", f"it has {DEEP} entries"),
    ("[parameters]\n" + "".join(f"k{i} = 1\n" for i in range(DEEP)), "at most 1000"),
    ("[[effects]]\nname = 'a'\n" * 101, "it has 101 entries"),
    (f"[held_out]\nruns = {['a'] * DEEP}", "at most 1000"),
    (f"[model]\nstates = {['a'] * DEEP}", f"it has {DEEP} entries"),
    (f"{FORCED}{{ polynomials = ['q', 'p'], degree = 60 }}", "would have 1891 terms; at most 500"),
    (f"{FORCED}{{ trigonometric = 'q', n = {10**12} }}", "would have 2000000000000 terms"),
    (f"{FORCED}'9**9**9'", "exceeds 64; rescale the term"),
    (f"{FORCED}'{'(' * 3000}q{')' * 3000}'", "cannot be read: too many nested"),
], ids=[
    *("key", "header", "list", "table", "inner", "number", "quotes", "long", "wrong"),
    *("effects", "added", "parameters", "own", "runs", "states", "polynomials", "waves"),
    *("tower", "brackets"),
])  # fmt: skip
def test_a_study_file_made_to_do_harm_is_refused_at_once(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "study.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ph.StudyFileError, match=message):
        ph.StudyFile.read(path)


# ---- open files ----------------------------------------------------------------------


class Endless:
    """An open file that never ends, and cannot be read whole."""

    def __init__(self, part: str | bytes) -> None:
        self.part = part

    def read(self, size: int) -> str | bytes:
        return self.part * size


@pytest.mark.parametrize(
    ("part", "read"),
    [("0", ph.Measurements.from_csv), (b"\0", from_mat), (b"\0", from_excel)],
)
def test_an_open_file_without_end_is_refused(part, read, monkeypatch) -> None:
    monkeypatch.setattr(reading, "LARGEST_FILE", 3_000_000)
    with pytest.raises(ph.DataError, match=r"cannot be read: .* at most 3 MB are read"):
        read(Endless(part), **COLUMNS)

"""Files made to run code, to fill the memory or to never end: refused in seconds."""

import io
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import openpyxl
import pytest
from scipy.io import savemat
from scipy.io.matlab import MatlabObject

import phsi_opt as ph
from phsi_opt.data import reading_apart

T = np.arange(40) * 0.1
Q = np.cos(T)


def code(mark: Path) -> str:
    """What makes a file, the mark, where it is executed."""
    return f"__import__('os').system('touch {mark}')"


# ---- the files -----------------------------------------------------------------------


def mdf(*, version: str = "4.10", q: Any = None, clock: Any = None) -> bytes:
    """Two channels; conversions of the channel q and of the times."""
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version=version) as file:
        signals = [
            asammdf.Signal(np.arange(40), T, name="q", unit="m", conversion=q),
            asammdf.Signal(Q, T, name="r", unit="mm"),
        ]
        file.append(signals, acq_name="log")
        if clock is not None:
            channel = file.groups[0].channels[0]
            blocks = asammdf.blocks
            of = blocks.v4_blocks if version >= "4" else blocks.v2_v3_blocks
            channel.conversion = of.ChannelConversion(**clock)
        with TemporaryDirectory() as folder:
            return Path(file.save(Path(folder, "log.mdf"))).read_bytes()


def patched(content: bytes, block: bytes, offset: int, number: int) -> bytes:
    """The content with a number of eight bytes in its first block of this kind."""
    place = content.index(block) + offset
    return content[:place] + struct.pack("<Q", number) + content[place + 8 :]


def mdf_without_end() -> bytes:
    """The first group of channels names itself as the next."""
    content = mdf()
    return patched(content, b"##CG", 24, content.index(b"##CG"))


def tdms(values: Any = Q, **properties: Any) -> bytes:
    nptdms = pytest.importorskip("nptdms")
    given = {"wf_increment": 0.1, "wf_start_offset": 0.0, **properties}
    file = io.BytesIO()
    with nptdms.TdmsWriter(file) as writer:
        writer.write_segment([nptdms.ChannelObject("log", "q", values, given)])
    return file.getvalue()


def scaled(**properties: Any) -> bytes:
    """TDMS values that follow from a polynomial."""
    given: dict[str, Any] = {
        "NI_Number_Of_Scales": 1,
        "NI_Scale[0]_Scale_Type": "Polynomial",
        "NI_Scale[0]_Polynomial_Coefficients_Size": 1,
        "NI_Scale[0]_Polynomial_Coefficients[0]": 1.0,
    }
    return tdms(**given | {f"NI_{name}": one for name, one in properties.items()})


def mat(content: dict[str, Any]) -> bytes:
    file = io.BytesIO()
    savemat(file, content)
    return file.getvalue()


def mat_of_cells(n_cells: int) -> bytes:
    """A MATLAB file with a list of so many empty cells, compressed to a thousandth."""
    cell = struct.pack("<II", 14, 48)
    cell += struct.pack("<IIIIIIiiIIII", 6, 8, 6, 0, 5, 8, 0, 0, 1, 0, 9, 0)
    head = struct.pack("<IIIIIIiiHH4s", 6, 8, 1, 0, 5, 8, n_cells, 1, 1, 1, b"t")
    content = head + cell * n_cells
    packed = zlib.compress(struct.pack("<II", 14, len(content)) + content, 1)
    return mat({"q": Q})[:128] + struct.pack("<II", 15, len(packed)) + packed


def workbook(cells: bytes, head: bytes = b"") -> bytes:
    """A workbook of one sheet, with these rows, and a head of its XML."""
    book = openpyxl.Workbook()
    book.active.append(["t", "q"])
    plain, changed = io.BytesIO(), io.BytesIO()
    book.save(plain)
    with (
        zipfile.ZipFile(plain) as old,
        zipfile.ZipFile(changed, "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for name in old.namelist():
            text = old.read(name)
            if name == "xl/worksheets/sheet1.xml":
                text = head + text.replace(b"</sheetData>", cells + b"</sheetData>")
            new.writestr(name, text)
    return changed.getvalue()


FORMULA = "its values follow from a formula, which is not executed"
XXE = b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>'
ROW = b"<row><c><v>1</v></c><c><v>2</v></c></row>"
READERS: dict[str, Callable[..., Any]] = {
    "mdf": ph.Measurements.from_mdf,
    "tdms": ph.Measurements.from_tdms,
    "mat": ph.Measurements.from_mat,
    "xlsx": ph.Measurements.from_excel,
}
# The file, given what it would execute, and what its refusal says.
RUN_CODE: dict[str, tuple[Callable[[str], bytes], str]] = {
    "mdf": (lambda text: mdf(q={"formula": f"X+0*{text}"}), FORMULA),
    "mdf 3": (lambda text: mdf(version="3.30", q={"formula": f"X1+0*{text}"}), FORMULA),
    "mdf, times": (
        lambda text: mdf(clock={"conversion_type": 3, "formula": f"X+0*{text}"}),
        f"the channel 'time' cannot be read: {FORMULA}",
    ),
    "mdf, within a table": (
        lambda text: mdf(
            q={
                "val_0": 3,
                "text_0": b"no signal",
                "default_addr": {"formula": f"X+0*{text}"},
            }
        ),
        FORMULA,
    ),
    "tdms": (
        lambda text: scaled(**{"Scale[0]_Polynomial_Coefficients[0]": text}),
        "it is damaged",
    ),
    "mat": (
        lambda text: mat(
            {"time": T, "q": MatlabObject(np.array([(text,)], [("a", "O")]), "eval")}
        ),
        "has no column 'q'",
    ),
    "xlsx": (
        lambda text: workbook(f"<row><c t='str'><f>{text}</f></c></row>".encode()),
        "no column 'time'",
    ),
    "xlsx, entities": (lambda text: workbook(ROW, XXE), "defines XML entities"),
}
FILL_MEMORY: dict[str, tuple[Callable[[], bytes], str]] = {
    "mdf": (
        lambda: patched(mdf(), b"##CG", 80, 2**40),
        "MB of samples; at most 500 MB are read",
    ),
    "tdms": (lambda: scaled(Number_Of_Scales=2**31 - 1), "more than 3 GB of memory"),
    "tdms, texts": (
        lambda: tdms(["a"] * 77).replace(
            struct.pack("<Q", 77), struct.pack("<Q", 2**40)
        ),
        "MB of samples; at most 500 MB are read",
    ),
    "mat": (
        lambda: struct.pack("<iiiii2s", 0, 2**30, 4, 0, 2, b"q"),
        "more than 3 GB of memory",
    ),
    "xlsx": (
        lambda: workbook(b"<row>" + b"<c/>" * 2_500_000 + b"</row>"),
        "a row of its part 'xl/worksheets/sheet1.xml' has too many cells",
    ),
}
# Files that are read for more than so many seconds of processor time. (asammdf alone
# takes about three until it begins.)
NEVER_END: dict[str, tuple[Callable[[], bytes], float]] = {
    "mdf": (mdf_without_end, 6),
    "tdms": (lambda: scaled(Number_Of_Scales=100_000_000), 2),
    "mat": (lambda: mat_of_cells(3_000_000), 2),
    "xlsx": (lambda: workbook(ROW * 400_000), 2),
}


def refused(content: bytes, name: str, said: str) -> None:
    """The file is refused, with its path and in these words."""
    kind = name.split()[0].strip(",")
    with pytest.raises(ph.DataError, match=said):
        READERS[kind](io.BytesIO(content), time="time", states=["q"])


@pytest.mark.parametrize("name", RUN_CODE)
def test_a_file_made_to_run_code_runs_nothing(name: str, tmp_path: Path) -> None:
    make, said = RUN_CODE[name]
    mark = tmp_path / "ran"
    content = make(code(mark))
    mark.unlink(missing_ok=True)
    refused(content, name, said)
    assert not mark.exists()


@pytest.mark.parametrize("name", FILL_MEMORY)
def test_a_file_made_to_fill_the_memory_is_refused(name: str) -> None:
    make, said = FILL_MEMORY[name]
    refused(make(), name, said)


@pytest.mark.parametrize("name", NEVER_END)
def test_a_file_that_is_never_read_to_its_end_is_refused(name, monkeypatch) -> None:
    make, seconds = NEVER_END[name]
    monkeypatch.setattr(reading_apart, "READING_LIMITS", reading_apart.Limits(seconds))
    refused(make(), name, f"it was not read in {seconds} s")

"""Hostile texts, and damaged binary files, for the search for errors.

Texts repeat a few letters up to 100 000 times: a regular expression that is not linear
takes minutes over some of them. Files are made by the libraries of their formats, some
with formulas that make the file `MARKER` where they are executed, and then damaged.
"""

import io
import struct
import zipfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
from hypothesis import strategies as st
from scipy.io import savemat

from problems.benchmarks.fuzz_inputs import FOLDER, MARKER, REPEATED, damaged

T = np.linspace(0.0, 2.0, 21)
# Of whole numbers of 2, 4 and 8 bytes: they take the place of sizes and addresses.
SIZES = (
    0,
    1,
    64,
    2**15,
    2**16 - 1,
    2**24,
    2**31 - 1,
    2**32 - 1,
    2**40,
    2**63,
    2**64 - 1,
)
FORMULAS = (
    "X*2 + 1",
    f"X+0*__import__('os').system('touch {MARKER}')",
    f"__import__('pathlib').Path('{MARKER}').touch()",
    "9**9**9**9",
    "X" + "*X" * 20_000,
    "(" * 5000 + "X" + ")" * 5000,
)
TABLE_OF_VALUES = {"raw_0": 0.0, "phys_0": 1.0, "raw_1": 20.0, "phys_1": 5.0}
OF_RANGES = {"lower_0": 0.0, "upper_0": 9.0, "lower_1": 9.0, "upper_1": 30.0}
TEXTS = {"text_0": "off", "text_1": "on"}
NESTED = {"formula": FORMULAS[1]}
CONVERSIONS: tuple[Mapping[str, Any] | None, ...] = (
    None,
    {"a": 2.0, "b": 1.0},
    {"P1": 0.0, "P2": 2.0, "P3": 1.0, "P4": 0.0, "P5": 0.0, "P6": 1.0},
    TABLE_OF_VALUES,
    {**TABLE_OF_VALUES, "interpolation": True},
    {**OF_RANGES, "phys_0": 1.0, "phys_1": 2.0, "default": 0.0},
    {"val_0": 0.0, "val_1": 1.0, **TEXTS},
    {"val_0": 0.0, "val_1": 1.0, "text_0": "off", "text_1": NESTED},
    {"val_0": 0.0, "val_1": 1.0, **TEXTS, "default_addr": NESTED},
    {**OF_RANGES, "text_0": NESTED, "text_1": "on"},
    *({"formula": text} for text in FORMULAS),
)


def mdf_of(
    conversion: Mapping[str, Any] | None, version: str, compression: Any
) -> bytes:
    """An MDF file with two channels, one of whole numbers that are converted."""
    import asammdf

    whole = np.arange(len(T), dtype=np.uint8)
    known = dict(conversion) if conversion else None
    channels = [
        asammdf.Signal(np.cos(T), T, name="q", unit="m"),
        asammdf.Signal(whole, T, name="u", unit="N", conversion=known),
    ]
    path = Path(FOLDER.name, "made.mf4")
    with asammdf.MDF(version=version) as file:
        file.append(channels)
        saved = Path(file.save(path, overwrite=True, compression=compression))
    return saved.read_bytes()


@cache
def mdf_files() -> list[bytes]:
    """MDF files with every kind of conversion, old and new, plain and compressed."""
    new = [mdf_of(one, "4.10", n % 3) for n, one in enumerate(CONVERSIONS)]
    formulas = [one for one in CONVERSIONS[-3:] if one and len(one["formula"]) < 250]
    old = [mdf_of(one, "3.30", 0) for one in (*CONVERSIONS[:5], *formulas)]
    return [*new, *old]


@cache
def tdms_files() -> list[bytes]:
    """TDMS files with one segment or two, plain or scaled."""
    import nptdms

    told = {"wf_increment": 0.1, "wf_start_offset": 0.0, "unit_string": "m", "by": "me"}
    numbers = nptdms.ChannelObject("a", "q", np.cos(T), told)
    whole = nptdms.ChannelObject("a", "u", np.arange(len(T)), told)
    scaling = {
        **told,
        "NI_Number_Of_Scales": 1,
        "NI_Scale[0]_Scale_Type": "Linear",
        "NI_Scale[0]_Linear_Slope": 2.0,
        "NI_Scale[0]_Linear_Y_Intercept": 1.0,
        "NI_Scale[0]_Linear_Input_Source": 0xFFFFFFFF,
    }
    scaled = nptdms.ChannelObject("a", "q", np.arange(len(T), dtype=np.int16), scaling)
    files = []
    for segments in (
        [[numbers, whole]],
        [[numbers, whole], [numbers, whole]],
        [[scaled, whole]],
    ):
        content = io.BytesIO()
        with nptdms.TdmsWriter(content) as writer:
            for channels in segments:
                writer.write_segment(channels)
        files.append(content.getvalue())
    return files


@cache
def mat_files() -> list[bytes]:
    """MATLAB files with numbers, texts, structs and cells, plain and compressed."""
    struct_of = {"a": T, "b": {"c": T}}
    cells = np.array(["x", T], dtype=object)
    held = {"t": T, "q": T**2, "name": "text", "log": struct_of, "z": 1j * T}
    files = []
    for options in ({}, {"do_compression": True}, {"format": "4"}):
        content = io.BytesIO()
        is_old = "format" in options
        held_here = {"t": T, "q": T**2} if is_old else {**held, "cells": cells}
        savemat(content, held_here, **options)
        files.append(content.getvalue())
    return files


def workbook(rows: Sequence[Sequence[Any]]) -> bytes:
    """A workbook with these cells."""
    book = openpyxl.Workbook()
    sheet: Any = book.active
    for row in rows:
        sheet.append(row)
    file = io.BytesIO()
    book.save(file)
    return file.getvalue()


@cache
def workbook_parts() -> dict[str, bytes]:
    """The parts of a workbook by name."""
    rows = [["t", "q", "said"], *([t, t**2, "one"] for t in T.tolist())]
    with zipfile.ZipFile(io.BytesIO(workbook(rows))) as book:
        return {name: book.read(name) for name in book.namelist()}


@st.composite
def workbooks(draw: st.DrawFn) -> bytes:
    """A workbook of which one part, or the archive itself, is damaged."""
    parts = dict(workbook_parts())
    name = draw(st.sampled_from(sorted(parts)))
    if draw(st.booleans()):
        parts[name] = draw(damaged(parts[name]))
    else:
        piece = draw(
            st.sampled_from([b"<c ", b"<c/>", b"<row>", b"<!--", b"&a;", b"<"])
        )
        first = draw(st.integers(0, len(parts[name])))
        many = piece * draw(st.sampled_from([100, 10_000, 1_000_000]))
        parts[name] = parts[name][:first] + many + parts[name][first:]
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as book:
        for part, text in parts.items():
            book.writestr(part, text)
    is_cut = draw(st.integers(0, 3)) == 0
    return draw(broken(lambda: [content.getvalue()])) if is_cut else content.getvalue()


@st.composite
def broken(draw: st.DrawFn, files: Callable[[], Sequence[bytes]]) -> bytes:
    """One of the files, as it is or with bits, sizes or the end changed."""
    content = bytearray(draw(st.sampled_from(files())))
    for _ in range(draw(st.integers(0, 3))):
        place = draw(st.integers(0, max(len(content) - 1, 0)))
        what = draw(st.sampled_from(["bit", "size", "size", "zeros", "cut", "twice"]))
        if what == "bit" and content:
            content[place] ^= 1 << draw(st.integers(0, 7))
        elif what == "size":
            n = draw(st.sampled_from([2, 4, 8]))
            size = draw(st.sampled_from(SIZES)) % 256**n
            place -= place % n
            content[place : place + n] = struct.pack("<Q", size)[:n]
        elif what == "zeros":
            content[place : place + 64] = bytes(64)
        elif what == "cut":
            del content[place:]
        else:
            content[place:place] = content[place:]
    return bytes(content)


@st.composite
def tables_with_texts(draw: st.DrawFn) -> str:
    """A CSV table with a long text as a name, a unit, a cell, or a line above."""
    text = draw(REPEATED)
    if draw(st.booleans()):
        text = '"' + text.replace('"', '""') + '"'
    parts = {"above": "# log", "name": "q", "unit": "m", "time": "0", "cell": "1.5"}
    parts[draw(st.sampled_from(sorted(parts)))] = text
    return ("{above}\nt,{name}\ns,{unit}\n{time},{cell}\n1,2\n2,3\n3,4.5\n").format(
        **parts
    )

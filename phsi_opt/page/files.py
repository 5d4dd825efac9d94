"""Uploaded tables: which are taken, and how their names are shown.

A name is what its owner calls a file; no path is made of it. What is refused could not
stand in a study file, or not be a file beside it.
"""

import re
import unicodedata
from pathlib import PurePosixPath

# Bytes of one uploaded file. A table of a million numbers takes about 10 MB.
MOST_UPLOADED = 20_000_000
MOST_FILES = 50  # of one study; each is a run
# What the name of an uploaded table may end in; the ending tells how it is read.
TABLE_KINDS = (".csv", ".txt", ".tsv", ".dat", ".xlsx")
MOST_NAME_BYTES = 255  # of the name of a file, in UTF-8: what file systems take
# Names that mean a device in Windows, whatever they end in.
DEVICE = re.compile(
    r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9\u00b9\u00b2\u00b3])\s*(\.|$)",
    re.IGNORECASE,
)
UNPRINTED = ("Cc", "Cs")  # categories of Unicode: control characters, half characters
MOST_SHOWN = 40  # characters of a name that is refused


def in_megabytes(size: int) -> str:
    """A number of bytes in words: '20 MB'."""
    return f"{size / 1e6:.3g} MB"


def without_path(name: str) -> str:
    """The last part of a name, without the folders that a browser may tell."""
    return re.split(r"[/\\]", name)[-1]


def suffix_of(name: str) -> str:
    """What a name ends in, in lower case, such as ".csv"."""
    return PurePosixPath(name).suffix.lower()


def name_refusal(name: str) -> str:
    """Why a file of this name is not taken, in a sentence; "" where it is."""
    shown = repr(name if len(name) <= MOST_SHOWN else f"{name[:MOST_SHOWN]}...")
    if not name.strip(" ."):
        return f"{shown} is no name of a file; expected one such as bench.csv."
    if any(unicodedata.category(sign) in UNPRINTED for sign in name):
        return f"the name {shown} has control characters; expected letters."
    if len(name.encode()) > MOST_NAME_BYTES:
        n_bytes = len(name.encode())
        return (
            f"the name {shown} has {n_bytes} bytes; expected at most {MOST_NAME_BYTES}."
        )
    if DEVICE.match(name):
        return f"{shown} means a device in Windows; expected another name."
    if suffix_of(name) not in TABLE_KINDS:
        kinds = ", ".join(TABLE_KINDS)
        return f"{shown} does not end as a table does; expected {kinds}."
    return ""

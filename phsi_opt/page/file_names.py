"""Names of uploaded tables: which can be shown and written, and which are refused.

A name is what its owner calls a file; no path is made of it. What is refused could not
stand in a study file, or not be a file beside it.
"""

import re
import unicodedata
from pathlib import PurePosixPath

from phsi_opt.page.limits import MOST_NAME_BYTES, TABLE_KINDS

# Names that mean a device in Windows, whatever they end in.
DEVICE = re.compile(
    r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9\u00b9\u00b2\u00b3])\s*(\.|$)",
    re.IGNORECASE,
)
UNPRINTED = ("Cc", "Cs")  # categories of Unicode: control characters, half characters
MOST_SHOWN = 40  # characters of a name that is refused


def without_path(name: str) -> str:
    """The last part of a name, without the folders that a browser may tell."""
    return re.split(r"[/\\]", name)[-1]


def suffix_of(name: str) -> str:
    """What a name ends in, in lower case, such as ".csv"."""
    return PurePosixPath(name).suffix.lower()


def name_refusal(name: str) -> str:
    """Why a file of this name is not taken, in a sentence; "" where it is."""
    if not name.strip(" ."):
        return f"{shown(name)} is no name of a file; expected one such as bench.csv."
    if any(unicodedata.category(sign) in UNPRINTED for sign in name):
        return f"the name {shown(name)} has control characters; expected letters."
    if len(name.encode()) > MOST_NAME_BYTES:
        return (
            f"the name {shown(name)} has {len(name.encode())} bytes; expected at most "
            f"{MOST_NAME_BYTES}."
        )
    if DEVICE.match(name):
        return f"{shown(name)} means a device in Windows; expected another name."
    if suffix_of(name) not in TABLE_KINDS:
        kinds = ", ".join(TABLE_KINDS)
        return f"{shown(name)} does not end as a table does; expected {kinds}."
    return ""


def shown(name: str) -> str:
    """A name in quotes, shortened, with its control characters spelt out."""
    short = name if len(name) <= MOST_SHOWN else f"{name[:MOST_SHOWN]}..."
    return repr(short)

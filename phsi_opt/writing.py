"""A file is written whole or not at all: aside first, then renamed into its place.

A process that is killed while it writes leaves what was there before, and at most a
file that ends in ``.part``.
"""

import os
import tempfile
from pathlib import Path


def write_whole(path: str | Path, text: str) -> Path:
    """Write a text file as UTF-8; whoever reads it sees all of it, or none.

    Args:
        path: Of the file, in a folder that exists. A file that is there is replaced.
        text: All of its content.

    Returns:
        The path.
    """
    place = Path(path)
    # in the same folder, because a file system is not renamed across
    handle, name = tempfile.mkstemp(".part", f".{place.name[:40]}.", place.parent)
    try:
        with open(handle, "w", encoding="utf-8") as file:
            file.write(text)
        os.chmod(name, _usual_rights())
        os.replace(name, place)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    return place


def _usual_rights() -> int:
    """The rights of a new file; a temporary one is its owner's alone."""
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask

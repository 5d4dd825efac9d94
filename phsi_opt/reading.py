"""A user's file is read whole: a regular file, of a size that the memory can bear.

A pipe or a device may never end. What the bytes mean is the business of those who ask.
"""

import os
import stat
from pathlib import Path
from typing import Any

# Bytes; a text table of that size is some 50 million numbers.
LARGEST_FILE = 500_000_000
WHY_NOT_READ: dict[type[OSError], str] = {
    FileNotFoundError: "there is no such file; check the path",
    IsADirectoryError: "it is a folder; give the path of a file",
    NotADirectoryError: "a part of its path is not a folder; check the path",
    PermissionError: "access is not permitted; check the permissions",
}


def file_bytes(path: str | os.PathLike[str], most: int | None = None) -> bytes:
    """All bytes of a regular file, or of the one that a link leads to.

    Args:
        path: Of the file.
        most: Bytes that it may have; None: `LARGEST_FILE`.

    Raises:
        OSError: It cannot be read, is no regular file or is too large; `why_not_read`
            says why.
        TypeError: This is no path.
    """
    most = LARGEST_FILE if most is None else most
    try:
        status = os.stat(Path(path))
    except ValueError:  # what Python says of a NUL
        raise OSError("a path cannot contain NUL") from None
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError
    if not stat.S_ISREG(status.st_mode):
        raise OSError(
            "it is a pipe, a socket or a device, not a regular file; write its content "
            "to a file and give the path of that file"
        )
    check_size(status.st_size, most)
    with open(path, "rb") as file:
        content: bytes = read_at_most(file, most)
    return content


def file_text(path: str | os.PathLike[str], most: int | None = None) -> str:
    """The UTF-8 text of a file, its lines ended by "\\n", without a byte order mark.

    Raises:
        OSError: As in `file_bytes`.
        TypeError: This is no path.
        UnicodeDecodeError: It is not UTF-8.
    """
    text = file_bytes(path, most).decode("utf-8-sig")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_at_most(file: Any, most: int) -> Any:
    """What an open file still holds, bytes or text; or what it gives instead of these.

    Raises:
        OSError: It holds more than ``most`` bytes or characters, or cannot be read.
    """
    parts = []
    size = 0
    while True:
        part = file.read(1_000_000)  # bytes at once
        if not isinstance(part, bytes | str):
            return part
        parts.append(part)
        size += len(part)
        check_size(size, most)
        if not part:
            return part.join(parts)  # type: ignore[arg-type]


def check_size(size: int, most: int, when: str = "or more") -> None:
    """Refuse what has more bytes than may be read.

    Raises:
        OSError: It has.
    """
    if size > most:
        raise OSError(
            f"it has {size / 1e6:.1f} MB {when}; at most {most / 1e6:g} MB are read"
        )


def why_not_read(error: OSError) -> str:
    """Why a file cannot be read (or written), in words."""
    for kind, said in WHY_NOT_READ.items():
        if isinstance(error, kind):
            return said
    return error.strerror or str(error)

"""A file is written whole or not at all: aside first, then renamed into its place.

A process that is killed while it writes leaves what was there before, and a file that
ends in ``.part``, which whoever writes that file next removes.
"""

import glob
import os
import shutil
from contextlib import suppress
from pathlib import Path
from secrets import token_hex
from typing import BinaryIO

from phsi_opt.errors import DataError, shown
from phsi_opt.reading import file_bytes, why_not_read

try:
    import fcntl
except ImportError:  # Windows, where a file that is open cannot be removed
    fcntl = None  # type: ignore[assignment]


def write_whole(path: str | Path, content: str | bytes) -> Path:
    """Write a file and return its path; whoever reads it sees all of it, or none.

    Args:
        path: Of the file, in a folder that exists. A file that is there is replaced.
        content: All of it; text is written as UTF-8, with the line ends that it has.

    Raises:
        DataError: The file cannot be written; what was there stays.
    """
    place = written_path(path)
    try:
        _replace(place, content.encode() if isinstance(content, str) else content)
    except (OSError, ValueError) as error:
        raise _unwritable(path, error) from None
    return place


def write_new(path: Path, content: bytes, otherwise: str) -> None:
    """Write a file that is not there yet, or has this content already.

    Args:
        path: Of the file.
        content: All of it.
        otherwise: What to do where another file is there.

    Raises:
        DataError: Another file is there, or the file cannot be written.
    """
    known = None
    if os.path.exists(path):
        with suppress(OSError):  # it is no regular file
            known = file_bytes(path)
        if known != content:
            said = "exists already with different content, and was not overwritten"
            raise DataError(f"{path} {said}; {otherwise}")
    write_whole(path, content)


def written_path(path: str | Path) -> Path:
    """The path of a file that will be written, before the work for it begins.

    Raises:
        DataError: This is no path, a folder, or in a folder that does not exist.
    """
    try:
        place = Path(path)
        if place.is_dir():
            raise IsADirectoryError
        if not place.parent.is_dir():
            raise FileNotFoundError
    except (OSError, TypeError, ValueError) as error:
        raise _unwritable(path, error) from None
    return place


def make_folder(path: Path) -> None:
    """Make a folder, and those above it, where it is not there.

    Raises:
        DataError: It cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise _unwritable(path, error, "folder") from None


def _unwritable(path: str | Path, error: Exception, what: str = "file") -> DataError:
    why = f"expected a path ({error})"
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        why = "its folder does not exist; create it, or give another path"
    elif isinstance(error, OSError):
        why = why_not_read(error)
    named = repr(str(path)) if isinstance(path, str | Path) else shown(path)
    return DataError(f"{what} {named} cannot be written: {why}.")


def remove_unfinished(place: Path) -> None:
    """Remove what processes that are gone have begun to write of a file."""
    place = Path(os.path.realpath(place))
    for part in place.parent.glob(_part(glob.escape(place.name[:40]), "?" * 8)):
        with suppress(OSError), part.open("rb") as file:
            _lock(file)
            part.unlink()


def _replace(place: Path, content: bytes) -> None:
    place = Path(
        os.path.realpath(place)
    )  # where the name is a link, the file that it leads to
    remove_unfinished(place)
    # in the same folder, because a file system is not renamed across
    part = place.with_name(_part(place.name[:40], token_hex(4)))
    try:
        with part.open("xb") as file:
            _lock(file)
            file.write(content)
        if place.exists():
            shutil.copymode(place, part)
        os.replace(part, place)
    except BaseException as error:
        part.unlink(missing_ok=True)
        is_taken = isinstance(error, FileNotFoundError | BlockingIOError)
        if not is_taken or not place.parent.is_dir():
            raise
        _replace(place, content)  # before or after the lock, another removed the part


def _part(name: str, random: str) -> str:
    return f".{name}.{random}.part"


def _lock(file: BinaryIO) -> None:
    """Lock an open file until it is closed; a killed process loses its locks."""
    try:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:  # there is no lock where the file system has none
        if isinstance(error, BlockingIOError | PermissionError):
            raise

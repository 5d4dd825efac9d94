"""A file is written whole or not at all: aside first, then renamed into its place.

A process that is killed while it writes leaves what was there before, and at most a
file that ends in ``.part``.
"""

import os
import tempfile
from pathlib import Path

from phsi_opt.errors import DataError

NO_FOLDER = "its folder does not exist; create it, or give another path"
WHY_NOT_WRITTEN: dict[type[OSError], str] = {
    IsADirectoryError: "it is a folder; give the path of a file",
    FileNotFoundError: NO_FOLDER,
    NotADirectoryError: NO_FOLDER,
    PermissionError: "writing is not permitted there; check the permissions",
}


def write_whole(path: str | Path, content: str | bytes) -> Path:
    """Write a file; whoever reads it sees all of it, or none.

    Args:
        path: Of the file, in a folder that exists. A file that is there is replaced.
        content: All of it; text is written as UTF-8, with the line ends that it has.

    Returns:
        The path.

    Raises:
        DataError: The file cannot be written; what was there stays.
    """
    place = written_path(path)
    try:
        _replace(place, content.encode() if isinstance(content, str) else content)
    except (OSError, ValueError) as error:
        raise _unwritable(path, error) from None
    return place


def written_path(path: str | Path) -> Path:
    """The path of a file that will be written, before the work for it begins.

    Raises:
        DataError: This is no path, or of a folder that does not exist.
    """
    try:
        place = Path(path)
        if not place.parent.is_dir():
            raise FileNotFoundError
    except (OSError, TypeError, ValueError) as error:
        raise _unwritable(path, error) from None
    return place


def _unwritable(path: str | Path, error: Exception) -> DataError:
    """The error of a file that cannot be written, with what to do."""
    why = f"expected a path ({error})"
    if isinstance(error, OSError):
        why = f"{error.strerror}; give another path" if error.strerror else str(error)
    for kind, said in WHY_NOT_WRITTEN.items():
        if isinstance(error, kind):
            why = said
    return DataError(f"file {str(path)!r} cannot be written: {why}.")


def _replace(place: Path, content: bytes) -> None:
    if place.is_dir():
        raise IsADirectoryError
    place = place.resolve()  # where the name is a link, the file that it leads to
    mask = os.umask(0)
    os.umask(mask)
    # The rights of a new file; a temporary one is its owner's alone.
    rights = place.stat().st_mode & 0o777 if place.exists() else 0o666 & ~mask
    # in the same folder, because a file system is not renamed across
    handle, name = tempfile.mkstemp(".part", f".{place.name[:40]}.", place.parent)
    try:
        with open(handle, "wb") as file:
            file.write(content)
        os.chmod(name, rights)
        os.replace(name, place)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise

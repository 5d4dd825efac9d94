"""Opening files: their content, and the names that messages and trajectories use.

What the content means is the business of `tables`, `excel_tables` and `matlab_tables`.
"""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TextIO

from phsi_opt.errors import DataError

Source = str | os.PathLike[str] | TextIO
BinarySource = str | os.PathLike[str] | IO[bytes]
OTHER_READERS = {  # the files that are no text, by their suffix
    ".xlsx": "from_excel",
    ".xlsm": "from_excel",
    ".mat": "from_mat",
}


@dataclass(frozen=True)
class TextFile:
    """The text of one file.

    Attributes:
        title: What messages call it: "file 'bench.csv'" or "open file".
        run: The name of its trajectory where no column tells it.
        text: The text, without a byte order mark.
    """

    title: str
    run: str
    text: str


@dataclass(frozen=True)
class BinaryFile:
    """The bytes of one file.

    Attributes:
        title: What messages call it: "file 'bench.xlsx'" or "open file".
        run: The name of its trajectory where no column tells it.
        content: All of its bytes.
    """

    title: str
    run: str
    content: bytes


def text_files(source: Source | Iterable[Source]) -> Iterator[TextFile]:
    """The files one after the other; each is read when its turn comes.

    Args:
        source: A path, an open text file, or several of them.

    Raises:
        DataError: This is no source, or a file cannot be read as UTF-8 text.
    """
    for one, title, run in _titled(source, "an open text file"):
        _check_is_text(one, title)
        yield TextFile(title, run, _text(one, title))


def binary_files(source: BinarySource | Iterable[BinarySource]) -> Iterator[BinaryFile]:
    """The files one after the other; each is read when its turn comes.

    Args:
        source: A path, a file that is open for reading bytes, or several of them.

    Raises:
        DataError: This is no source, or a file cannot be read.
    """
    for one, title, run in _titled(source, "an open binary file"):
        yield BinaryFile(title, run, _bytes(one, title))


def _titled(source: Any, open_file: str) -> list[tuple[Any, str, str]]:
    """Each source, its title and the name of its run."""
    sources = _listed(source, open_file)
    paths = [_path(one) for one in sources]
    runs = _run_names(paths)
    titled = []
    for one, path, run in zip(sources, paths, runs, strict=True):
        title = "open file" if path is None else f"file {path!r}"
        titled.append((one, title, run))
    return titled


def _listed(source: Any, open_file: str) -> list[Any]:
    if isinstance(source, str | os.PathLike) or hasattr(source, "read"):
        return [source]
    if not isinstance(source, list | tuple | Iterator):
        raise DataError(
            f"source is a {type(source).__name__}; "
            f"expected a path, a list of paths or {open_file}."
        )
    sources = list(source)
    if not sources:
        raise DataError("source is an empty list; expected at least one path.")
    return sources


def _path(source: Any) -> str | None:
    """The path as the user wrote it; None for an open file without one."""
    if isinstance(source, str | os.PathLike):
        return str(source)
    name = getattr(source, "name", None)
    return name if isinstance(name, str) and name else None


def _run_names(paths: list[str | None]) -> list[str]:
    """The files' names without folder and suffix; the whole path where two agree."""
    stems = []
    for number, path in enumerate(paths, start=1):
        stems.append(f"run {number}" if path is None else Path(path).stem)
    names = []
    for path, stem in zip(paths, stems, strict=True):
        is_shared = stems.count(stem) > 1
        names.append(path if path is not None and is_shared else stem)
    return names


def _check_is_text(source: Any, title: str) -> None:
    suffix = Path(_path(source) or "").suffix.lower()
    if suffix in OTHER_READERS:
        raise DataError(
            f"{title} is no text table; read it with "
            f"Measurements.{OTHER_READERS[suffix]}."
        )
    if suffix in (".xls", ".ods"):
        raise DataError(f"{title} is no text table; save it as .xlsx or CSV.")


def _text(source: Any, title: str) -> str:
    try:
        text = _read(source, "r")
    except UnicodeDecodeError as error:
        if b"\0" in error.object:
            raise DataError(
                f"{title} is no text: it holds zero bytes. A table is a text with "
                "lines of numbers (.csv, .txt), an .xlsx or a .mat file."
            ) from error
        byte = error.object[error.start]
        raise DataError(
            f"{title} is not UTF-8 text: byte {error.start} is {byte:#04x}. Save it as "
            "'CSV UTF-8' in the program it comes from; in Python the file may also be "
            "given opened with its encoding, open(path, encoding='latin-1')."
        ) from error
    except OSError as error:
        raise _unreadable(title, error) from error
    if not isinstance(text, str):
        raise DataError(
            f"{title} gives {type(text).__name__}; expected text. "
            "Open it in text mode: open(path)."
        )
    return text.removeprefix("\ufeff")  # the byte order mark which spreadsheets write


def _bytes(source: Any, title: str) -> bytes:
    try:
        content = _read(source, "rb")
    except OSError as error:
        raise _unreadable(title, error) from error
    if not isinstance(content, bytes):
        raise DataError(
            f"{title} gives {type(content).__name__}; expected bytes. "
            "Open it in binary mode: open(path, 'rb')."
        )
    return content


def _unreadable(title: str, error: OSError) -> DataError:
    return DataError(
        f"{title} cannot be read ({error.strerror or error}). Check the path and the "
        "permissions."
    )


def _read(source: Any, mode: str) -> Any:
    if hasattr(source, "read"):
        return source.read()
    if not isinstance(source, str | os.PathLike):
        raise DataError(
            f"source holds a {type(source).__name__}; expected paths or open files."
        )
    path = Path(source)
    return path.read_bytes() if mode == "rb" else path.read_text(encoding="utf-8")

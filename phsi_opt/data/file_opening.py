"""Opening files: their content, and the names that messages and trajectories use.

What the content means is the business of `tables`, `excel_tables` and `matlab_tables`.
"""

import codecs
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Generic, TextIO, TypeVar

from phsi_opt import reading
from phsi_opt.errors import DataError

Source = str | os.PathLike[str] | TextIO
BinarySource = str | os.PathLike[str] | IO[bytes]
NO_TEXT_TABLES = {  # what to do with files that are no text, by their suffix
    ".xlsx": "read it with Measurements.from_excel",
    ".xlsm": "read it with Measurements.from_excel",
    ".mat": "read it with Measurements.from_mat",
    ".xls": "save it as .xlsx or CSV",
    ".ods": "save it as .xlsx or CSV",
}
KINDS_READ = "text (.csv, .txt, .dat), Excel (.xlsx) and MATLAB (.mat)"
GUESSED = "its text is not UTF-8 and was read as Windows-1252"
Content = TypeVar("Content", str, bytes)
NO_TEXT = re.compile(r"[\x00-\x08\x0e-\x1f]")  # signs that no text table has


@dataclass(frozen=True)
class NamedFile(os.PathLike[str]):
    """A file that messages and trajectories call otherwise than the disk does.

    Attributes:
        place: Where it lies.
        name: What its owner calls it, such as "bench.csv"; no path leads there.
    """

    place: Path
    name: str

    def __fspath__(self) -> str:
        return str(self.place)

    def __str__(self) -> str:
        return self.name

    @property
    def suffix(self) -> str:
        """What its name ends in, such as ".csv"."""
        return Path(self.name).suffix

    def exists(self) -> bool:
        """Whether it is there."""
        return self.place.exists()


DataFile = Path | NamedFile


@dataclass(frozen=True)
class OpenedFile(Generic[Content]):
    """What one file holds, and what it is called.

    Attributes:
        title: What messages call it: "file 'bench.csv'" or "open file".
        run: The name of its trajectory where no column tells it.
        content: All of its bytes; or its text without a byte order mark, the lines
            ended by "\\n".
        remark: What was guessed of its encoding; "" where nothing was.
    """

    title: str
    run: str
    content: Content
    remark: str = ""


TextFile = OpenedFile[str]
BinaryFile = OpenedFile[bytes]


def text_files(source: Source | Iterable[Source]) -> Iterator[TextFile]:
    """The files one after the other; each is read when its turn comes.

    Args:
        source: A path, an open text file, or several of them.

    Raises:
        DataError: This is no source, or a file cannot be read as text.
    """
    for one, title, run in _titled(source, "an open text file"):
        instead = NO_TEXT_TABLES.get(Path(_path(one) or "").suffix.lower())
        if instead:
            raise DataError(f"{title} is no text table; {instead}.")
        remark = ""
        if hasattr(one, "read"):
            text = _content(one, title, str)
            text = text.removeprefix("\ufeff")  # spreadsheets write a byte order mark
        else:
            text, remark = _decoded(_content(one, title, bytes), title)
        text = text.replace("\r\n", "\n").replace("\r", "\n")
        yield TextFile(title, run, text, remark)


def binary_files(source: BinarySource | Iterable[BinarySource]) -> Iterator[BinaryFile]:
    """The files one after the other; each is read when its turn comes.

    Args:
        source: A path, a file that is open for reading bytes, or several of them.

    Raises:
        DataError: This is no source, or a file cannot be read.
    """
    for one, title, run in _titled(source, "an open binary file"):
        yield BinaryFile(title, run, _content(one, title, bytes))


def _titled(source: Any, open_file: str) -> Iterator[tuple[Any, str, str]]:
    """Each source, its title and the name of its run."""
    if _is_path(source) or hasattr(source, "read"):
        source = [source]
    if not isinstance(source, list | tuple | Iterator):
        raise DataError(
            f"source is a {type(source).__name__}; "
            f"expected a path, a list of paths or {open_file}."
        )
    sources = list(source)
    if not sources:
        raise DataError("source is an empty list; expected at least one path.")
    _check_files_once(sources)
    paths = [_path(one) for one in sources]
    for one, path, run in zip(sources, paths, _run_names(paths), strict=True):
        if not _is_path(one) and not hasattr(one, "read"):
            raise DataError(
                f"source holds a {type(one).__name__}; expected paths or open files."
            )
        yield one, "open file" if path is None else f"file {path!r}", run


def _is_path(source: Any) -> bool:
    return isinstance(source, str | os.PathLike)


def _check_files_once(sources: list[Any]) -> None:
    # A NUL, which no path has, is told when the file is opened.
    paths = [
        str(one) if "\0" in str(one) else os.path.realpath(one)
        for one in sources
        if _is_path(one)
    ]
    for place, n_times in Counter(paths).items():
        if n_times > 1:
            raise DataError(
                f"the file {place!r} is listed {n_times} times; its runs "
                "are one measurement. List it once."
            )


def _path(source: Any) -> str | None:
    """The path as the user wrote it; None for an open file without one."""
    if _is_path(source):
        return str(source)
    name = getattr(source, "name", None)
    return name if isinstance(name, str) and name else None


def _run_names(paths: list[str | None]) -> list[str]:
    """The files' names without folder and suffix; the whole path where two agree."""
    stems = []
    for number, path in enumerate(paths, start=1):
        stems.append(f"run {number}" if path is None else Path(path).stem)
    n_files = Counter(stems)
    names = []
    for path, stem in zip(paths, stems, strict=True):
        names.append(path if path is not None and n_files[stem] > 1 else stem)
    return names


def _decoded(content: bytes, title: str) -> tuple[str, str]:
    """A file's text: UTF-8, UTF-16 where it begins so, or else Windows-1252.

    Numbers are the same in all of them; in a text of another encoding the names of
    columns alone look strange.
    """
    is_utf_16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    encodings = {"utf-16": ""} if is_utf_16 else {"utf-8-sig": "", "cp1252": GUESSED}
    for encoding, remark in encodings.items():
        try:
            text = content.decode(encoding)
        except UnicodeDecodeError:
            continue
        if NO_TEXT.search(text) is None:
            return text, remark
    raise DataError(
        f"{title} is no table: it holds binary data and no text. Tables are read from "
        f"{KINDS_READ}. Save it as one of these."
    )


def _content(source: Any, title: str, kind: type[Content]) -> Content:
    """All of a file: bytes of a path, bytes or text of an open file."""
    try:
        if hasattr(source, "read"):
            content = reading.read_at_most(source, reading.LARGEST_FILE)
        else:
            content = reading.file_bytes(source)
    except UnicodeDecodeError as error:
        byte = error.object[error.start]
        raise DataError(
            f"{title} is not UTF-8 text: it has the byte {byte:#04x}. Give its "
            "path, or open it with its encoding: open(path, encoding='latin-1')."
        ) from error
    except OSError as error:
        why = reading.why_not_read(error)
        raise DataError(f"{title} cannot be read: {why}.") from error
    except ValueError as error:  # it is closed
        raise DataError(f"{title} cannot be read: {error}.") from error
    if not isinstance(content, kind):
        expected = {
            str: "text. Open it in text mode: open(path)",
            bytes: "bytes. Open it in binary mode: open(path, 'rb')",
        }
        raise DataError(
            f"{title} gives {type(content).__name__}; expected {expected[kind]}."
        )
    return content

"""Opening files: their content, and the names that messages and trajectories use.

What the content means is the business of `text_tables` and `binary_tables`.
"""

import codecs
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TextIO

from phsi_opt import reading
from phsi_opt.errors import DataError, shown

Source = str | os.PathLike[str] | TextIO
BinarySource = str | os.PathLike[str] | IO[bytes]
# The readers of `Measurements` of files that are no text, by their suffix.
READERS = {
    **dict.fromkeys((".xlsx", ".xlsm"), "from_excel"),
    **dict.fromkeys((".mf4", ".mdf"), "from_mdf"),
    **dict.fromkeys((".h5", ".hdf5"), "from_hdf5"),
    **dict.fromkeys((".parquet", ".pq"), "from_parquet"),
    **dict.fromkeys((".bag", ".db3", ".mcap"), "from_bag"),
    ".mat": "from_mat",
    ".tdms": "from_tdms",
}
# What to do with others.
NOT_READ = dict.fromkeys((".xls", ".ods"), "save it as .xlsx or CSV")
GUESSED = "its text is not UTF-8 and was read as Windows-1252"
PATHS = (str, os.PathLike)
NO_TEXT = re.compile(r"[\x00-\x08\x0e-\x1f]")  # characters that no text table has


@dataclass(frozen=True)
class NamedFile(os.PathLike[str]):
    """A file that messages and trajectories call otherwise than the disk does."""

    place: Path  # where it lies
    name: str  # what its owner calls it, such as "bench.csv"; no path leads there

    def __fspath__(self) -> str:
        return str(self.place)

    def __str__(self) -> str:
        return self.name

    @property
    def suffix(self) -> str:
        return Path(self.name).suffix


DataFile = Path | NamedFile


@dataclass(frozen=True)
class OpenedFile:
    """What one file holds, and what it is called."""

    title: str  # what messages call it: "file 'bench.csv'" or "open file"
    run: str  # the name of its trajectory where no column gives it
    # all of its bytes; or its text without a byte order mark, the lines ended by "\\n"
    content: Any
    remark: str = ""  # what was guessed of its encoding; "" where nothing was


def opened_files(source: Any, as_text: bool) -> Iterator[OpenedFile]:
    """The text or the bytes of a path, an open file, or several of them, in turn."""
    is_one = hasattr(source, "read") or not isinstance(source, list | tuple | Iterator)
    sources = [source] if is_one else list(source)
    is_fine = [isinstance(file, PATHS) or hasattr(file, "read") for file in sources]
    if not sources or not all(is_fine):
        open_file = "an open file" if as_text else "an open binary file"
        raise DataError(
            f"source={shown(source)} is not possible; expected a path, {open_file}, or "
            "a list of these."
        )
    for file, run in zip(sources, run_names(sources), strict=True):
        path = _path(file)
        title = f"file {path!r}" if path else "open file"
        suffix = Path(path or "").suffix.lower()
        if as_text and suffix in {*READERS, *NOT_READ}:
            reader = f"read it with Measurements.{READERS.get(suffix)}"
            raise DataError(
                f"{title} is not a text table; {NOT_READ.get(suffix, reader)}."
            )
        content, remark = _content(file, title, as_text), ""
        if as_text:
            content, remark = _text(content, title)
        yield OpenedFile(title, run, content, remark)


def run_names(sources: Iterable[Any]) -> list[str]:
    """The files' names without folder and suffix; the whole path where two agree."""
    sources = list(sources)
    places = []
    for file in filter(lambda one: isinstance(one, PATHS), sources):
        with suppress(ValueError):  # what no path has is refused when it is opened
            places.append(os.path.realpath(file))
    for place, n_times in Counter(places).items():
        if n_times > 1:
            raise DataError(
                f"the file {place!r} is listed {n_times} times, so its runs would be "
                "counted more than once. List it once."
            )
    named = list(map(_path, sources))
    stems = [Path(path).stem if path else f"run {i}" for i, path in enumerate(named, 1)]
    return [
        path if path and stems.count(stem) > 1 else stem
        for path, stem in zip(named, stems, strict=True)
    ]


def _path(source: Any) -> str | None:
    """The path as the user wrote it; None for an open file without one."""
    if isinstance(source, PATHS):
        return str(source)
    name = getattr(source, "name", None)
    return name if isinstance(name, str) and name else None


def _text(content: str | bytes, title: str) -> tuple[str, str]:
    """A file's text, and a remark where its encoding was guessed.

    UTF-8, UTF-16 where it begins so, or else Windows-1252. Numbers are the same in all
    of them; in a text of another encoding the names of columns alone look strange.
    """
    remark = ""
    if isinstance(content, bytes):
        content, remark = _decoded(content, title)
    text = content.removeprefix("\ufeff")  # spreadsheets write a byte order mark
    return text.replace("\r\n", "\n").replace("\r", "\n"), remark


def _decoded(content: bytes, title: str) -> tuple[str, str]:
    is_utf_16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    encodings = {"utf-16": ""} if is_utf_16 else {"utf-8": "", "cp1252": GUESSED}
    for encoding, remark in encodings.items():
        with suppress(UnicodeDecodeError):
            text = content.decode(encoding)
            if NO_TEXT.search(text) is None:
                return text, remark
    raise DataError(
        f"{title} is not a table: it contains binary data. Tables are read from text "
        f"and, by their ending, from {', '.join(sorted(READERS))}. Save it as one of "
        "these, or read it yourself and use Measurements.from_dataframe."
    )


def _content(source: Any, title: str, as_text: bool) -> Any:
    """All of a file: bytes of a path; bytes or text of an open file, as asked for."""
    try:
        if hasattr(source, "read"):
            content = reading.read_at_most(source, reading.LARGEST_FILE)
        else:
            content = reading.file_bytes(source)
    except (OSError, ValueError) as error:  # a ValueError: it is closed, or not UTF-8
        why: object = f"{error}. Give its path"
        if isinstance(error, OSError):
            why = reading.why_not_read(error)
        raise DataError(f"{title} cannot be read: {why}.") from error
    if not isinstance(content, bytes | str if as_text else bytes):
        raise DataError(
            f"{title} gives {type(content).__name__}; expected "
            f"{'str or ' * as_text}bytes, as open(path, 'rb') does."
        )
    return content

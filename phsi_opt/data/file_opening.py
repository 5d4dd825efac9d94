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
from typing import IO, Any, TextIO

from phsi_opt import reading
from phsi_opt.errors import DataError

Source = str | os.PathLike[str] | TextIO
BinarySource = str | os.PathLike[str] | IO[bytes]
OTHER_READERS = {  # the files that are no text, by their suffix
    ".xlsx": "from_excel",
    ".xlsm": "from_excel",
    ".mat": "from_mat",
}
KINDS_READ = "text (.csv, .txt, .dat), Excel (.xlsx) and MATLAB (.mat)"
GUESSED = "its text is not UTF-8 and was read as Windows-1252"
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
class TextFile:
    """The text of one file.

    Attributes:
        title: What messages call it: "file 'bench.csv'" or "open file".
        run: The name of its trajectory where no column tells it.
        text: The text, without a byte order mark.
        remark: What was guessed of its encoding; "" where it is UTF-8 or UTF-16.
    """

    title: str
    run: str
    text: str
    remark: str = ""


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
        DataError: This is no source, or a file cannot be read as text.
    """
    for one, title, run in _titled(source, "an open text file"):
        _check_is_text(one, title)
        if hasattr(one, "read"):
            yield TextFile(title, run, _text(one, title))
        else:
            yield _decoded(_bytes(one, title), title, run)


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
    _check_files_once(sources)
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


def _check_files_once(sources: list[Any]) -> None:
    paths = [one for one in sources if isinstance(one, str | os.PathLike)]
    places = [_place(path) for path in paths]
    for number, place in enumerate(places):
        if place in places[:number]:
            raise DataError(
                f"the file {place!r} is listed {places.count(place)} times; its runs "
                "are one measurement. List it once."
            )


def _place(path: str | os.PathLike[str]) -> str:
    try:
        return os.path.realpath(path)
    except ValueError:  # no path; told when the file is opened
        return str(path)


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
    n_files = Counter(stems)
    for path, stem in zip(paths, stems, strict=True):
        is_shared = n_files[stem] > 1
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
    """The text of an open file."""
    try:
        text = reading.read_at_most(source, reading.LARGEST_FILE)
    except UnicodeDecodeError as error:
        byte = error.object[error.start]
        raise DataError(
            f"{title} is not UTF-8 text: it has the byte {byte:#04x}. Give its "
            "path, or open it with its encoding: open(path, encoding='latin-1')."
        ) from error
    except (OSError, ValueError) as error:  # ValueError: it is closed
        raise _unreadable(title, error) from error
    if not isinstance(text, str):
        raise DataError(
            f"{title} gives {type(text).__name__}; expected text. "
            "Open it in text mode: open(path)."
        )
    return text.removeprefix("\ufeff")  # the byte order mark which spreadsheets write


def _decoded(content: bytes, title: str, run: str) -> TextFile:
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
            text = text.replace("\r\n", "\n").replace("\r", "\n")
            return TextFile(title, run, text, remark)
    raise DataError(
        f"{title} is no table: it holds binary data and no text. Tables are read from "
        f"{KINDS_READ}. Save it as one of these."
    )


def _bytes(source: Any, title: str) -> bytes:
    is_open = hasattr(source, "read")
    if not is_open and not isinstance(source, str | os.PathLike):
        raise DataError(
            f"source holds a {type(source).__name__}; expected paths or open files."
        )
    try:
        if is_open:
            content = reading.read_at_most(source, reading.LARGEST_FILE)
        else:
            content = reading.file_bytes(source)
    except (OSError, ValueError) as error:  # ValueError: it is closed
        raise _unreadable(title, error) from error
    if not isinstance(content, bytes):
        raise DataError(
            f"{title} gives {type(content).__name__}; expected bytes. "
            "Open it in binary mode: open(path, 'rb')."
        )
    return content


def _unreadable(title: str, error: OSError | ValueError) -> DataError:
    why = reading.why_not_read(error) if isinstance(error, OSError) else str(error)
    return DataError(f"{title} cannot be read: {why}.")

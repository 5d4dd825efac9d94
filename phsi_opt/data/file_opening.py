"""Opening text files: their text, and the names that messages and trajectories use.

What the text means is the business of `tables`.
"""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from phsi_opt.errors import DataError

Source = str | os.PathLike[str] | TextIO


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


def text_files(source: Source | Iterable[Source]) -> Iterator[TextFile]:
    """The files one after the other; each is read when its turn comes.

    Args:
        source: A path, an open text file, or several of them.

    Raises:
        DataError: This is no source, or a file cannot be read as UTF-8 text.
    """
    sources = _listed(source)
    paths = [_path(one) for one in sources]
    runs = _run_names(paths)
    for one, path, run in zip(sources, paths, runs, strict=True):
        title = "open file" if path is None else f"file {path!r}"
        yield TextFile(title, run, _text(one, title))


def _listed(source: Any) -> list[Any]:
    if isinstance(source, str | os.PathLike) or hasattr(source, "read"):
        return [source]
    if not isinstance(source, list | tuple | Iterator):
        raise DataError(
            f"source is a {type(source).__name__}; "
            "expected a path, a list of paths or an open text file."
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


def _text(source: Any, title: str) -> str:
    try:
        text = _read(source)
    except UnicodeDecodeError as error:
        raise DataError(
            f"{title} is not UTF-8 text ({error}). Save it as 'CSV UTF-8'."
        ) from error
    except OSError as error:
        raise DataError(
            f"{title} cannot be read ({error}). Check the path and the permissions."
        ) from error
    if not isinstance(text, str):
        raise DataError(
            f"{title} gives {type(text).__name__}; expected text. "
            "Open it in text mode: open(path)."
        )
    return text.removeprefix("\ufeff")  # the byte order mark which spreadsheets write


def _read(source: Any) -> Any:
    if hasattr(source, "read"):
        return source.read()
    if isinstance(source, str | os.PathLike):
        return Path(source).read_text(encoding="utf-8")
    raise DataError(
        f"source holds a {type(source).__name__}; expected paths or open text files."
    )

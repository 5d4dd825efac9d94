"""Results of a sweep in a folder: one file per key, written whole or not at all.

A result is what JSON can hold: numbers, texts, lists, mappings by text. Every digit of
a number is kept. Nothing of a file is ever run as code.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from phsi_opt.errors import DataError
from phsi_opt.reading import file_text
from phsi_opt.writing import write_whole

FORMAT = "phsi_opt sweep 1"
LONGEST_NAME = 100  # characters of a file's name; file systems take 255 bytes
DIGEST_LENGTH = 16  # hexadecimal digits that tell long keys apart


@dataclass(frozen=True)
class KeptResults:
    """The results of one sweep, in a folder that is made when the first one is kept.

    Attributes:
        folder: Where the files are.
        of: What the results depend on beside their keys, in a word or a digest; a file
            that says something else is refused.
    """

    folder: Path
    of: str = ""

    def keep(self, key: str, result: Any) -> None:
        """Write the result of a key.

        Raises:
            DataError: JSON cannot hold the result.
        """
        content = {"format": FORMAT, "of": self.of, "key": key, "result": result}
        try:
            text = json.dumps(content, default=_plain)
        except (TypeError, ValueError) as error:
            raise DataError(
                f"the result of {key!r} cannot be kept as JSON: {error}. Return "
                "numbers, texts, lists and mappings, or sweep without a folder."
            ) from None
        self.folder.mkdir(parents=True, exist_ok=True)
        write_whole(self.path_of(key), text + "\n")

    def found(self, keys: Iterable[str]) -> Iterator[tuple[str, Any]]:
        """Those of the keys that are kept, with their results.

        A file that cannot be read counts as none: its result is computed anew.

        Raises:
            DataError: A file is of another sweep.
        """
        if not self.folder.is_dir():
            return
        for key in keys:
            content = self._content(key)
            if content is not None:
                yield key, content["result"]

    def path_of(self, key: str) -> Path:
        """The file of a key; it may not exist."""
        name = quote(key, safe=" ")
        if len(name) > LONGEST_NAME or name.startswith("."):
            digest = hashlib.sha256(key.encode()).hexdigest()[:DIGEST_LENGTH]
            name = f"{name[: LONGEST_NAME - DIGEST_LENGTH]}-{digest}".lstrip(".")
        return self.folder / f"{name}.json"

    def _content(self, key: str) -> dict[str, Any] | None:
        path = self.path_of(key)
        try:
            content = json.loads(file_text(path))
        except (OSError, ValueError, RecursionError):
            return None
        if not isinstance(content, dict) or "result" not in content:
            return None
        is_same = content.get("of") == self.of and content.get("key") == key
        if content.get("format") != FORMAT or not is_same:
            raise DataError(
                f"{path} holds a result of another sweep: {content.get('of')!r} in the "
                f"file, {self.of!r} asked for. Take another folder, or empty this one."
            )
        return content


def _plain(value: Any) -> Any:
    """NumPy's numbers and arrays as Python's."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no number, text, list or mapping")

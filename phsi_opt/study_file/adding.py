"""Writing an effect into the text of a study file, with all that the user wrote kept.

The text itself is changed, at one place, so that comments and order stay; the result is
read again and must say what the file said before, and the effect. The file as it was is
kept beside it.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from phsi_opt.errors import DataError
from phsi_opt.reading import file_bytes
from phsi_opt.study_file.toml_tables import toml_tables
from phsi_opt.study_file.toml_text import toml_value
from phsi_opt.writing import write_whole

HEADER = re.compile(r"^[ \t]*\[study\][ \t]*(#.*)?\r?$", re.MULTILINE)
ANY_HEADER = re.compile(r"^[ \t]*\[", re.MULTILINE)
ADDED_KEY = re.compile(r"^[ \t]*added[ \t]*=[ \t]*\[", re.MULTILINE)
# A text in quotes, a comment, or a bracket: what matters inside a list of texts.
TOKEN = re.compile(r'"(?:[^"\\\n]|\\.)*"|' r"'[^'\n]*'|#[^\n]*|[\[\]]")
NEW_SECTION = """
# Effects added so far, the oldest first.
[study]
"""


@dataclass(frozen=True)
class Addition:
    """What `add_effects` did.

    Attributes:
        path: of the study file.
        backup: the file as it was before.
    """

    path: Path
    backup: Path


def add_effects(path: Path, names: Iterable[str]) -> Addition:
    """Write effects into the list ``added`` of a study file.

    Args:
        path: of the study file.
        names: of the effects, such as ``"coulomb friction on p"``.

    Raises:
        DataError: the file is written in a way that cannot be changed safely; then
            nothing is written.
    """
    path = path.resolve()  # where the name is a link, the file that it leads to
    bytes_before = file_bytes(path)
    text = bytes_before.decode("utf-8-sig")
    changed = text_with_added(text, list(names), str(path))
    backup = _backup_path(path)
    write_whole(backup, bytes_before)
    write_whole(path, changed)
    return Addition(path, backup)


def _backup_path(path: Path) -> Path:
    """A name that no file has: study.toml.bak, study.toml.bak2, ..."""
    backup = path.with_name(f"{path.name}.bak")
    number = 2
    while backup.exists():
        backup = path.with_name(f"{path.name}.bak{number}")
        number += 1
    return backup


def text_with_added(text: str, names: list[str], title: str = "the file") -> str:
    """The text with names at the end of the list ``added`` of the section [study].

    Args:
        text: of a study file.
        names: of effects.
        title: what messages call the file.

    Raises:
        DataError: the text is written in a way that cannot be changed safely.
    """
    expected = toml_tables(text)
    study = dict(expected.get("study", {}))
    study["added"] = [*study.get("added", []), *names]
    expected["study"] = study
    changed = _changed(text, names)
    if _parsed(changed) != expected:
        raise DataError(
            f"{title} has its section [study] in a form that is not changed "
            "automatically; nothing was written. Write into it: "
            f"added = {toml_value(study['added'])}"
        )
    return changed


def _parsed(text: str) -> object:
    try:
        return toml_tables(text)
    except ValueError:
        return None


def _changed(text: str, names: list[str]) -> str:
    newline = "\r\n" if "\r\n" in text else "\n"
    header = HEADER.search(text)
    line = f"added = {toml_value(names)}{newline}"
    if header is None:
        end = "" if text.endswith("\n") or not text else newline
        return f"{text}{end}{NEW_SECTION.replace(chr(10), newline)}{line}"
    begin = text.find("\n", header.end()) + 1 or len(text)
    following = ANY_HEADER.search(text, begin)
    key = ADDED_KEY.search(text, begin, following.start() if following else len(text))
    if key is None:
        start = newline if begin == len(text) and not text.endswith("\n") else ""
        return f"{text[:begin]}{start}{line}{text[begin:]}"
    place = _after_last_text(text, key.end())
    written = ", ".join(map(toml_value, names))
    comma = ", " if place > key.end() else ""
    return f"{text[:place]}{comma}{written}{text[place:]}"


def _after_last_text(text: str, begin: int) -> int:
    """Where the last text of a list ends; ``begin`` where the list is empty."""
    place = begin
    for token in TOKEN.finditer(text, begin):
        if token[0] == "]":
            break
        if not token[0].startswith("#"):
            place = token.end()
    return place

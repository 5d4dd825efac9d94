"""Writing an effect into the text of a study file, with all that the user wrote kept.

tomlkit keeps comments, order and forms. The result is read again and must say what the
file said before, and the effect. The file as it was is kept beside it.
"""

from collections.abc import Iterable
from itertools import chain, count, filterfalse
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from phsi_opt.errors import DataError
from phsi_opt.reading import file_bytes
from phsi_opt.study_file.keys import listed
from phsi_opt.study_file.toml_text import toml_tables, toml_value
from phsi_opt.writing import write_whole

ABOUT_ADDED = "effects added so far, the oldest first"


def add_effects(path: Path, names: Iterable[str]) -> Path:
    """Write effects into the list ``added`` of a study file.

    Args:
        path: of the study file.
        names: of the effects, such as ``"coulomb friction on p"``.

    Returns:
        The path of the file as it was before.

    Raises:
        DataError: the file is written in a way that cannot be changed safely; then
            nothing is written.
    """
    path = path.resolve()  # where the name is a link, the file that it leads to
    bytes_before = file_bytes(path)
    changed = _with_added(bytes_before.decode("utf-8-sig"), list(names), path)
    backup = _backup_path(path)
    write_whole(backup, bytes_before)
    write_whole(path, changed)
    return backup


def _backup_path(path: Path) -> Path:
    """A name that no file has: study.toml.bak, study.toml.bak2, ..."""
    numbers = chain([""], count(2))
    names = (path.with_name(f"{path.name}.bak{number}") for number in numbers)
    return next(filterfalse(Path.exists, names))


def _with_added(text: str, names: list[str], path: Path) -> str:
    """The text with names at the end of the list ``added`` of the section [study]."""
    try:
        expected = toml_tables(text)
        study = expected.setdefault("study", {})
        names = [*listed(study.get("added", ())), *names]
        study["added"] = names
        changed = _changed(text, names)
        is_safe = toml_tables(changed) == expected
    except (TOMLKitError, ValueError, TypeError, AttributeError):
        is_safe = False
    if not is_safe:
        raise DataError(
            f"{path} has its section [study] in a form that is not changed "
            "automatically; nothing was written. Write into it: "
            f"added = {toml_value(names)}"
        )
    return changed


def _changed(text: str, names: list[str]) -> str:
    """The text with these names in its list; those that it has stay as they are."""
    document = tomlkit.parse(text)
    study: Any = document.setdefault("study", tomlkit.table().comment(ABOUT_ADDED))
    if isinstance(study.get("added"), list):
        study["added"].extend(names[len(study["added"]) :])
    else:
        study["added"] = names
    changed = document.as_string()
    if text.count("\n") == text.count("\r\n") > 0:
        changed = changed.replace("\r\n", "\n").replace("\n", "\r\n")
    return changed

"""TOML: read with bounds, the lines of its keys, values written, an effect added.

`tomllib` takes a time that grows with the square of the parts of a dotted key, and
reads tables by recursion; so do those who walk them. What lies too deep is refused.

An effect is written into the text with all that the user wrote kept: tomlkit keeps
comments, order and forms. The result is read again and must say what the file said
before, and the effect.
"""

import json
import os
import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, count, filterfalse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from phsi_opt.errors import Complaint, DataError, StudyFileError, shown
from phsi_opt.reading import file_bytes, file_text, why_not_read
from phsi_opt.writing import write_whole

if TYPE_CHECKING:
    from jinja2 import Template

MOST_NESTED = 32  # tables, lists and parts of a key in each other; a study needs 8
LARGEST_STUDY = 1_000_000  # bytes of a study file, which a person writes
# A text that is never closed ends where it could; every match is possessive ("+" behind
# another sign), so that a search takes a time in proportion to the text.
KEY_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"?|'[^'\n]*+'?)"""
DOTTED = rf"{KEY_PART}(?:[ \t]*+\.[ \t]*+{KEY_PART})"
LONG_KEY = re.compile(
    rf"(?:^|[{{,])[ \t]*+\[{{0,2}}+[ \t]*+{DOTTED}{{{MOST_NESTED}}}", re.MULTILINE
)
ENTRY = re.compile(rf"[ \t]*+(\[{{0,2}})[ \t]*+({DOTTED}*+)[ \t]*+[=\]]")
LINE_OF_ERROR = re.compile(r"at line (\d+)")
BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
DELETE = "\x7f"  # the one character that JSON leaves as it is and TOML does not allow


def tables_of(path: Path) -> dict[str, Any]:
    """The tables of a TOML file."""
    try:
        text = file_text(path, LARGEST_STUDY)
        return toml_tables(text)
    except FileNotFoundError:
        said = "there is no such file; phsi-opt init DATA.csv writes one."
    except UnicodeDecodeError as error:
        byte = error.object[error.start]
        line = error.object[: error.start].count(b"\n") + 1
        said = f"line {line} is not UTF-8 text (byte {byte:#04x}); save it as UTF-8."
    except ValueError as error:
        place = LINE_OF_ERROR.search(str(error))
        at = place and text.splitlines()[int(place[1]) - 1].strip()
        said = (
            f"this is not TOML: {error}{f': {shown(at)}' if at else ''}. Put text "
            "in quotes, use a decimal point, write sections as [name], and use each "
            "key once."
        )
    except OSError as error:
        said = f"it cannot be read: {why_not_read(error)}."
    raise StudyFileError(path, [Complaint("", "", said)])


def toml_tables(text: str) -> dict[str, Any]:
    """The tables of a TOML text."""
    long_key = LONG_KEY.search(text)
    if long_key is not None:
        line = text.count("\n", 0, long_key.end()) + 1
        raise ValueError(f"line {line} has a key of more than {MOST_NESTED} parts")
    try:
        tables = tomllib.loads(text)
        _check_bounds(tables)
    except RecursionError:
        said = f"more than {MOST_NESTED} tables or lists are nested"
        raise ValueError(said) from None
    return tables


def _check_bounds(value: Any, depth: int = 0) -> None:
    if depth > MOST_NESTED:
        raise RecursionError
    if isinstance(value, int) and abs(value) > 10**300:
        raise ValueError("a whole number has more than 300 digits")
    further = value.values() if isinstance(value, dict) else value
    for entry in further if isinstance(value, dict | list) else ():
        _check_bounds(entry, depth + 1)


def lines_of(text: str) -> dict[str, int]:
    """The line on which each key begins, by its path such as ``"data.time"``."""
    lines: dict[str, int] = {}
    n_tables: Counter[str] = Counter()  # of those in two brackets
    table = ""
    for number, line in enumerate(text.split("\n"), 1):
        entry = ENTRY.match(line)
        if entry is None:
            continue
        brackets, path = entry.groups()
        if brackets == "[[":
            n_tables[path] += 1
            path = f"{path}[{n_tables[path] - 1}]"
        if brackets:
            table = path
        elif table:
            path = f"{table}.{path}"
        lines.setdefault(path, number)
    return lines


def key_text(name: str) -> str:
    """A key: bare where TOML allows, else in quotes."""
    return name if BARE_KEY.fullmatch(name) else toml_value(name)


def toml_value(value: Any) -> str:
    """A value on one line; what a study file does not hold, such as a date, as text."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace(DELETE, "\\u007f")
    if isinstance(value, Mapping):
        pairs = [f"{key_text(name)} = {toml_value(one)}" for name, one in value.items()]
        return f"{{ {', '.join(pairs)} }}" if pairs else "{}"
    if isinstance(value, Sequence):
        return f"[{', '.join(map(toml_value, value))}]"
    return repr(float(value)) if isinstance(value, float) else str(value)


def text_template(name: str) -> "Template":
    """A template of this room, for a text that is no page."""
    from phsi_opt.presentation.sentences import environment  # loads NumPy

    found = environment("phsi_opt.study_file", "templates", keep_trailing_newline=True)
    found.filters |= {"toml": toml_value, "key": key_text}
    return found.get_template(name)


# ---- an effect into a text -----------------------------------------------------------

ABOUT_ADDED = "effects added so far, the oldest first"


def add_effects(path: Path, names: Iterable[str]) -> Path:
    """Write effects into ``added`` of a study file; return where the old file is."""
    path = Path(
        os.path.realpath(path)
    )  # where the name is a link, the file that it leads to
    bytes_before = file_bytes(path)
    changed = _with_added(bytes_before.decode("utf-8-sig"), list(names), path)
    numbers = chain([""], count(2))  # study.toml.bak, study.toml.bak2, ...
    backups = (path.with_name(f"{path.name}.bak{number}") for number in numbers)
    backup = next(filterfalse(Path.exists, backups))
    write_whole(backup, bytes_before)
    write_whole(path, changed)
    return backup


def _with_added(text: str, names: list[str], path: Path) -> str:
    """The text with names at the end of the list ``added`` of the section [study]."""
    try:
        expected = toml_tables(text)
        study = expected.setdefault("study", {})
        added = study.get("added", ())
        names = [*([added] if isinstance(added, str) else added), *names]
        study["added"] = names
        changed = _changed(text, names)
        is_safe = toml_tables(changed) == expected
    except (TOMLKitError, ValueError, TypeError, AttributeError):
        is_safe = False
    if not is_safe:
        raise DataError(
            f"the section [study] of {path} cannot be changed automatically; nothing "
            f"was written. Write in this section: added = {toml_value(names)}"
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

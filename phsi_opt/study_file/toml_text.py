"""TOML: read with bounds, the lines of its keys, and values as it writes them.

`tomllib` takes a time that grows with the square of the parts of a dotted key, and
reads tables by recursion; so do those who walk them. What lies too deep is refused.
"""

import json
import re
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Template

MOST_NESTED = 32  # tables, lists and parts of a key in each other; a study needs 8
LARGEST_STUDY = 1_000_000  # bytes of a study file, which a person writes
LARGEST_WHOLE = 10**300  # of what floats can hold
# A text that is never closed ends where it could; every match is possessive ("+" behind
# another sign), so that a search takes a time in proportion to the text.
KEY_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"?|'[^'\n]*+'?)"""
DOTTED = rf"{KEY_PART}(?:[ \t]*+\.[ \t]*+{KEY_PART})"
LONG_KEY = re.compile(
    rf"(?:^|[{{,])[ \t]*+\[{{0,2}}+[ \t]*+{DOTTED}{{{MOST_NESTED}}}", re.MULTILINE
)
ENTRY = re.compile(rf"[ \t]*+(\[{{0,2}})[ \t]*+({DOTTED}*+)[ \t]*+[=\]]")
BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
DELETE = "\x7f"  # the one character that JSON leaves as it is and TOML does not allow


def toml_tables(text: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        ValueError: it is no TOML, or something in it lies too deep or is too large.
    """
    long_key = LONG_KEY.search(text)
    if long_key is not None:
        line = text.count("\n", 0, long_key.end()) + 1
        raise ValueError(f"line {line} has a key of more than {MOST_NESTED} parts")
    try:
        tables = tomllib.loads(text)
        _check_bounds(tables)
    except RecursionError:
        said = f"more than {MOST_NESTED} tables or lists lie in each other"
        raise ValueError(said) from None
    return tables


def _check_bounds(value: Any, depth: int = 0) -> None:
    if depth > MOST_NESTED:
        raise RecursionError
    if isinstance(value, int) and abs(value) > LARGEST_WHOLE:
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

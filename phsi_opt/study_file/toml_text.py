"""Values as TOML writes them: texts, numbers, lists, and tables on one line.

Python reads TOML (``tomllib``) and does not write it. What a study file needs is this
page; a package for it would be one more dependency.
"""

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
DELETE = "\x7f"  # the one character that JSON leaves as it is and TOML does not allow


def key_text(name: str) -> str:
    """A key: bare where TOML allows, else in quotes."""
    return name if BARE_KEY.fullmatch(name) else text_value(name)


def text_value(text: str) -> str:
    """A text in double quotes."""
    return json.dumps(text, ensure_ascii=False).replace(DELETE, "\\u007f")


def toml_value(value: Any) -> str:
    """A value on one line.

    Raises:
        TypeError: it is nothing that a study file holds.
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return text_value(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(float(value))
    if isinstance(value, Mapping):
        return _table(value)
    if isinstance(value, Sequence):
        return f"[{', '.join(map(toml_value, value))}]"
    raise TypeError(f"{value!r} has no form in TOML")


def _table(content: Mapping[str, Any]) -> str:
    if not content:
        return "{}"
    pairs = []
    for name, value in content.items():
        pairs.append(f"{key_text(name)} = {toml_value(value)}")
    return f"{{ {', '.join(pairs)} }}"

"""TOML read with bounds: what lies too deep is refused before `tomllib` walks it.

`tomllib` takes a time that grows with the square of the parts of a dotted key, and what
follows it walks tables by recursion.
"""

import re
import tomllib
from typing import Any

MOST_NESTED = 32  # tables, lists and parts of a key in each other; a study needs 8
MOST_SIGNS = 250  # of a name without quotes, or a number: floats go further
LARGEST_STUDY = 1_000_000  # of a study file, which a person writes
# A text that is never closed ends where it could; every match is possessive ("+" behind
# another sign), so that a search takes a time in proportion to the text.
KEY_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"?|'[^'\n]*+'?)"""
LONG_TEXT = r'''"""(?:[^"\\]|\\.|"(?!""))*+(?:""")?|''' + (
    r"""'''(?:[^']|'(?!''))*+(?:''')?"""
)
TOML_TOKEN = re.compile(
    rf"{LONG_TEXT}|#[^\n]*+|(?P<open>[\[{{])|(?P<close>[\]}}])|"
    rf"(?P<key>{KEY_PART}(?:[ \t]*+\.[ \t]*+{KEY_PART})*+)",
    re.DOTALL,
)
DOT = re.compile(rf"{KEY_PART}|\.")


def toml_tables(text: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        ValueError: it is no TOML, or something in it lies too deep or is too large.
    """
    _check_tokens(text)
    return tomllib.loads(text)


def _check_tokens(text: str) -> None:
    depth = 0
    for token in TOML_TOKEN.finditer(text):
        parts = DOT.findall(token["key"] or "")
        if token["open"]:
            depth += 1
        elif token["close"]:
            depth = max(depth - 1, 0)
        said = ""
        if max(depth, parts.count(".") + 1) > MOST_NESTED:
            said = (
                f"more than {MOST_NESTED} tables, lists or parts of a key in each other"
            )
        elif any(len(part) > MOST_SIGNS and part[0] not in "\"'" for part in parts):
            said = f"a name or number of more than {MOST_SIGNS} signs"
        if said:
            line = text.count("\n", 0, token.start()) + 1
            raise ValueError(f"line {line} has {said}")

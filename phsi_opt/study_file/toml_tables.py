"""TOML read with bounds: what lies too deep is refused before `tomllib` walks it.

`tomllib` takes a time that grows with the square of the parts of a dotted key, and what
follows it walks tables by recursion.
"""

import re
import tomllib
from typing import Any

MOST_NESTED = 32  # tables, lists and parts of a key in each other; a study needs 8
MOST_BYTES = 1_000_000  # of a study file, which a person writes
# A text that is never closed ends where it could; every match is possessive ("+" behind
# another sign), so that a search takes a time in proportion to the text.
PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"?|'[^'\n]*+'?)"""
LONG_TEXT = r'''"""(?:[^"\\]|\\.|"(?!""))*+(?:""")?|''' + (
    r"""'''(?:[^']|'(?!''))*+(?:''')?"""
)
TOKEN = re.compile(
    rf"{LONG_TEXT}|#[^\n]*+|(?P<open>[\[{{])|(?P<close>[\]}}])|"
    rf"(?P<key>{PART}(?:[ \t]*+\.[ \t]*+{PART})*+)",
    re.DOTALL,
)
DOT = re.compile(rf"{PART}|\.")


def toml_tables(text: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        ValueError: it is no TOML, or something in it lies too deep or is too large.
    """
    _check_nesting(text)
    return tomllib.loads(text)


def _check_nesting(text: str) -> None:
    depth = 0
    for token in TOKEN.finditer(text):
        n_parts = 1
        if token["open"]:
            depth += 1
        elif token["close"]:
            depth = max(depth - 1, 0)
        elif token["key"]:
            n_parts = DOT.findall(token["key"]).count(".") + 1
        if max(depth, n_parts) > MOST_NESTED:
            line = text.count("\n", 0, token.start()) + 1
            raise ValueError(
                f"line {line} has more than {MOST_NESTED} tables, lists or parts of a "
                "key in each other; expected fewer"
            )

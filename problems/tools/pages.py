"""Pages of results/ from templates: Markdown with Jinja, its prose wrapped as in code.

A template lies in the folder ``pages`` of its room. Filters: ``table``, ``frame`` and
``block`` show data, ``listed`` is "a, b and c", ``number`` two digits, ``fmt`` any
format of Python: ``{{ share|fmt(".0%") }}``.
"""

import re
from collections.abc import Iterable

import jinja2
import pandas as pd

from problems.tools import markdown
from problems.tools.provenance import ROOT

FENCED = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)


def _block(text: str) -> str:
    return f"```text\n{text}\n```"


def _frame(shown: pd.DataFrame, digits: int = 3) -> str:
    return "\n".join(markdown.frame(shown, digits)).rstrip()


def _listed(words: Iterable[object]) -> str:
    found = list(words)
    return markdown.enumerated(found) if found else "none"


_TEMPLATES = jinja2.Environment(
    loader=jinja2.FileSystemLoader(ROOT / "problems"),
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.filters |= {
    "block": _block,
    "fmt": format,
    "frame": _frame,
    "listed": _listed,
    "number": markdown.number,
    "table": markdown.table,
}


def render(template: str, **values: object) -> str:
    """The page of a template such as "thesis/pages/grids.md", a paragraph a line."""
    parts = FENCED.split(_TEMPLATES.get_template(template).render(values))
    # Every second part is a block, which stays as it is.
    parts[::2] = [_unwrapped(part) for part in parts[::2]]
    return "".join(parts)


def _unwrapped(text: str) -> str:
    """Paragraphs and items of lists on one line each; tables stay."""
    text = re.sub(r"(?<=\S)[ ]*\n\s*(?=[.,;:)])", "", text)
    joined = re.sub(r"(?<=\S)[ ]*\n[ ]*(?=[^\s|#!-])", " ", text)
    return re.sub(r"\n{3,}", "\n\n", joined)

"""Pages of results/ from templates: Markdown with Jinja, its prose wrapped as in code.

A template lies in the folder ``pages`` of its room. Filters: ``table``, ``frame`` and
``block`` show data, ``listed`` is "a, b and c", ``fmt`` any format of Python:
``{{ share|fmt(".0%") }}``.
"""

import re
from collections.abc import Iterable, Mapping, Sequence

import jinja2
import pandas as pd

from problems.tools.provenance import ROOT, write

FENCED = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)


def table(records: pd.DataFrame | Sequence[Mapping[str, object]]) -> str:
    """A table in Markdown; a bar inside a cell would end it and becomes "or"."""
    shown = pd.DataFrame(records)
    return lines(map(str, shown.columns), shown.astype(str).to_numpy().tolist())


def lines(header: Iterable[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown from its header and its rows of cells."""
    names = list(header)
    return "\n".join(map(_line, (names, ["---"] * len(names), *rows)))


def _line(cells: Sequence[object]) -> str:
    shown = [str(cell).replace("|", " or ") for cell in cells]
    return f"| {' | '.join(shown)} |"


def number(value: float) -> str:
    """Two digits, without an exponent where the number is large."""
    return f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}"


def _block(text: str) -> str:
    return f"```text\n{text}\n```"


def _frame(shown: pd.DataFrame, digits: int = 3) -> str:
    """A block with a data frame without its index."""
    number_format = f"{{:.{digits}g}}".format
    return _block(shown.to_string(index=False, float_format=number_format))


def _listed(words: Iterable[object]) -> str:
    """The words as in: a, b and c."""
    *first, last = list(map(str, words)) or ["none"]
    return f"{', '.join(first)} and {last}" if first else last


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
    "table": table,
}


def render(template: str, **values: object) -> str:
    """The page of a template such as "thesis/pages/grids.md", a paragraph a line."""
    parts = FENCED.split(_TEMPLATES.get_template(template).render(values))
    # Every second part is a block, which stays as it is.
    parts[::2] = [_unwrapped(part) for part in parts[::2]]
    return "".join(parts)


def publish(page: str, text: str, is_written: bool) -> None:
    """Print a page, and write it to results/ unless the run was a small one."""
    print(text)
    if is_written:
        write(page, text)


def _unwrapped(text: str) -> str:
    """Paragraphs and items of lists on one line each; tables stay."""
    text = re.sub(r"(?<=\S)[ ]*\n\s*(?=[.,;:)])", "", text)
    joined = re.sub(r"(?<=\S)[ ]*\n[ ]*(?=[^\s|#!-])", " ", text)
    return re.sub(r"\n{3,}", "\n\n", joined)

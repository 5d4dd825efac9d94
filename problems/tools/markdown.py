"""The parts of a page in results/: tables, blocks of text, paragraphs.

Prose stands wrapped in the code and on one line in the page. A number in it that is a
result is computed from the table beside it.
"""

from collections.abc import Iterable, Mapping, Sequence

import pandas as pd


def table(records: pd.DataFrame | Sequence[Mapping[str, object]]) -> str:
    """A table in Markdown; a bar inside a cell would end it and becomes "or"."""
    frame = pd.DataFrame(records)
    header = [str(name) for name in frame.columns]
    return lines(header, frame.astype(str).to_numpy().tolist())


def lines(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown from its header and its rows of cells."""
    rule = ["---"] * len(header)
    return "\n".join(_line(row) for row in (header, rule, *rows))


def _line(cells: Sequence[object]) -> str:
    shown = [str(cell).replace("|", " or ") for cell in cells]
    return f"| {' | '.join(shown)} |"


def block(text: str) -> list[str]:
    """Lines of a page that show a text as it is, such as a printed table."""
    return ["```text", text, "```", ""]


def frame(shown: pd.DataFrame, digits: int = 3) -> list[str]:
    """A block with a data frame without its index, numbers with ``digits`` digits."""
    return block(shown.to_string(index=False, float_format=f"{{:.{digits}g}}".format))


def paragraph(text: str) -> str:
    """One line of prose from a text that is wrapped in the code."""
    return " ".join(text.split())


def enumerated(words: Iterable[object]) -> str:
    """The words as in: a, b and c."""
    *first, last = map(str, words)
    return f"{', '.join(first)} and {last}" if first else last


def number(value: float) -> str:
    """Two digits, without an exponent where the number is large."""
    return f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}"

"""A report as Markdown, from sections of text and of output as it is printed."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from phsi_opt.errors import DataError
from phsi_opt.writing import write_whole

SUFFIXES = (".md", ".txt")


@dataclass(frozen=True)
class Section:
    """A heading with what stands below it.

    Attributes:
        heading: its text; ``level``: 1 for the title.
        text: prose or a list, as Markdown.
        outputs: printed output, each in a block of its own.
    """

    heading: str
    level: int
    text: str = ""
    outputs: tuple[str, ...] = ()

    @property
    def paragraphs(self) -> list[str]:
        """Heading, text and blocks."""
        found = [f"{'#' * self.level} {_without_tags(self.heading)}"]
        if self.text:
            found.append(_without_tags(self.text))
        return found + [_block(output) for output in self.outputs]


def _without_tags(text: str) -> str:
    """Prose in which no name of the data is read as HTML."""
    return text.replace("<", "&lt;")


def _block(output: str) -> str:
    """Output between fences that are longer than any that stands in it."""
    runs = re.findall(r"`{3,}", output)
    fence = "`" * (1 + max(map(len, runs), default=2))
    return f"{fence}text\n{output}\n{fence}"


def report_text(sections: Sequence[Section]) -> str:
    """The sections as Markdown."""
    paragraphs: list[str] = []
    for section in sections:
        paragraphs += section.paragraphs
    return "\n\n".join(paragraphs) + "\n"


def write_report(sections: Sequence[Section], path: Path) -> Path:
    """Write a report.

    Raises:
        DataError: for a kind of file, or a place, that cannot be written.
    """
    if path.suffix not in SUFFIXES:
        raise DataError(
            f"a report is written as .html, {' or '.join(SUFFIXES)}; "
            f"{path.name!r} is none of these."
        )
    return write_whole(path, report_text(sections))

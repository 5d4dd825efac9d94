"""A report as Markdown, from sections of text and of output as it is printed."""

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
        found = [f"{'#' * self.level} {self.heading}"]
        if self.text:
            found.append(self.text)
        for output in self.outputs:
            found.append(f"```text\n{output}\n```")
        return found


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

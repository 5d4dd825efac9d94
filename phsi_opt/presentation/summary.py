"""What a result says of itself, once, for the terminal, for rich and for notebooks.

A result describes itself by a `Summary` of texts and tables. Whatever stands in a name
is shown as it is: in HTML it is escaped, and rich's markup has no meaning in it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from textwrap import TextWrapper
from typing import TYPE_CHECKING, Any

from phsi_opt.presentation.numbers import LINE_WIDTH

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Console, ConsoleOptions, RenderableType

    from phsi_opt.presentation.tables import PrintedTable


@dataclass(frozen=True, eq=False)
class Part:
    """A heading, sentences, lines of ``code`` whose blanks matter, and a table."""

    heading: str = ""
    text: str = ""
    code: str = ""
    table: "pd.DataFrame | None" = None


@dataclass(frozen=True, eq=False)
class Summary:
    """A title of one line, and what follows."""

    title: str
    parts: tuple[Part, ...] = ()


class Summarised:
    """A result with a summary, which rich and notebooks show."""

    _between = "\n\n"  # what stands between the parts of its text

    def _summary(self) -> Summary:
        raise NotImplementedError

    def __repr__(self) -> str:
        """The summary as text; tables within 80 characters."""
        return text_of_summary(self._summary(), self._between)

    def _repr_html_(self) -> str:
        from phsi_opt.presentation.tables import html_of_table, html_shown

        return html_shown("summary", self._summary(), html_of_table)

    def __rich_console__(
        self, console: "Console", options: "ConsoleOptions"
    ) -> "Iterator[RenderableType]":
        from rich.text import Text

        summary = self._summary()
        text = Text(text_of_summary(summary, self._between, options.max_width))
        text.highlight_words([summary.title.partition("\n")[0]], "bold")
        yield text


def text_of_summary(
    summary: Summary, between: str = "\n\n", width: int = LINE_WIDTH
) -> str:
    """The summary as text within a width, also its tables."""
    blocks = [filled(summary.title, width=width)]
    for part in summary.parts:
        text = filled(part.text, width=width)
        lines = list(filter(None, (part.heading, text, part.code)))
        if part.table is not None:
            from phsi_opt.presentation.tables import text_of_table

            lines.append(text_of_table(part.table, width, len(part.table)))
        blocks.append("\n".join(lines))
    return between.join(block for block in blocks if block)


def filled(text: str, indent: str = "", width: int = LINE_WIDTH) -> str:
    """Sentences in lines of a terminal; what goes on is indented further."""
    wrapper = TextWrapper(width, indent, f"{indent}  ")
    wrapper.break_long_words = wrapper.break_on_hyphens = False
    return "\n".join(map(wrapper.fill, text.splitlines()))


def printed_table(*args: Any, **kwargs: Any) -> "PrintedTable":
    """A data frame that prints itself whole, from the arguments of `DataFrame`."""
    from phsi_opt.presentation.tables import PrintedTable

    return PrintedTable(*args, **kwargs)

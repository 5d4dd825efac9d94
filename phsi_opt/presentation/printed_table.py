"""The data frame that results are given as; imported where one is made, for pandas."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pandas as pd

from phsi_opt.presentation.tables import html_of_table, rich_of_table, text_of_table

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions
    from rich.table import Table
    from rich.text import Text


class PrintedTable(pd.DataFrame):
    """A data frame that prints and shows itself with all of its columns.

    In all else it is a `pandas.DataFrame`; numbers keep all digits, four are shown.
    """

    @property
    def _constructor(self) -> "type[PrintedTable]":
        return PrintedTable

    def __repr__(self) -> str:
        """All columns within 80 characters, in several blocks if need be."""
        return text_of_table(self)

    def _repr_html_(self) -> str:
        return html_of_table(self)

    def __rich_console__(
        self, console: "Console", options: "ConsoleOptions"
    ) -> "Iterator[Table | Text]":
        """What rich prints."""
        yield from rich_of_table(self, options.max_width)

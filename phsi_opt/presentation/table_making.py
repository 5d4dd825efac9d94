"""Tables of results; pandas is imported when the first one is made."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from phsi_opt.presentation.printed_table import PrintedTable


def printed_table(*args: Any, **kwargs: Any) -> "PrintedTable":
    """A data frame that prints itself with all of its columns.

    Args:
        *args: As those of `pandas.DataFrame`.
        **kwargs: Likewise.
    """
    from phsi_opt.presentation.printed_table import PrintedTable

    return PrintedTable(*args, **kwargs)

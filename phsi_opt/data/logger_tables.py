"""Tables of binary logger files: MDF (asammdf) and TDMS (nptdms).

A file has groups of channels; those of a group have common times, which are the first
column. Channels of a group that are sampled otherwise are a group of their own. Groups
are never put on common times: one of them is the table. `logger_reader` reads it.
"""

from collections.abc import Iterable
from importlib.util import find_spec
from itertools import starmap
from typing import Any

from phsi_opt.data.file_opening import OpenedFile
from phsi_opt.data.reading_apart import read_apart
from phsi_opt.data.tables import Table, Variable, table_of_columns
from phsi_opt.errors import DataError


def table_of_groups(
    file: OpenedFile,
    wanted: Iterable[Any] | None,
    library: str,
    group: str | None,
) -> Table:
    """Channels of a group; its times are in s.

    Args:
        file: an MDF or a TDMS file.
        wanted: the columns that are looked for; None: all, of the largest of several
            groups.
        library: that reads it, asammdf or nptdms.
        group: the group; None: the only one.

    Raises:
        DataError: the file cannot be read, or the group is not clear.
    """
    if find_spec(library) is None:
        raise DataError(
            f'{file.title} needs {library}. Install it: pip install "phsi_opt[loggers]"'
        )
    found, arrays = read_apart(
        file,
        "logger_reader",
        "Export its channels as CSV.",
        library=library,
        asked=None if wanted is None else list(wanted),
        part=group,
        may_be_several=wanted is None,
    )
    lengths = set(map(len, arrays))
    if len(lengths) > 1:
        raise DataError(
            f"{file.title} is damaged: the channels of a group have {sorted(lengths)} "
            "samples. Export them as CSV."
        )
    return table_of_columns(
        file,
        found["names"],
        arrays,
        sheets=tuple(found["parts"]),
        units=dict(zip(found["names"], found["units"], strict=True)),
        further=tuple(starmap(Variable, found["further"])),
    )

"""Tables of binary logger files: MDF (asammdf) and TDMS (nptdms).

A file has groups of channels; those of a group have common times, which are the first
column. Channels of a group that are sampled otherwise are a group of their own. Groups
are never put on common times: one of them is the table.
"""

import io
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from phsi_opt.data.file_opening import OpenedFile
from phsi_opt.data.tables import Table, chosen_part
from phsi_opt.errors import DataError

TIME = "time"


@dataclass(frozen=True)
class Group:
    """Channels with common times."""

    columns: dict[str, np.ndarray] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, values: Any, unit: Any = "") -> None:
        """Add a channel; arrays in a channel are left out."""
        if np.ndim(values) == 1 and len(values):
            self.columns[name] = np.asarray(values)
            self.units[name] = str(unit or "")


def table_of_groups(
    file: OpenedFile, library: str, group: str | None, may_be_several: bool = False
) -> Table:
    """The channels of a group, read by one of `GROUPS_BY`; its times are in s.

    Raises:
        DataError: the file cannot be read, or the group is not clear.
    """
    import pandas as pd

    try:
        groups = dict(GROUPS_BY[library](io.BytesIO(file.content)))
    except ImportError as error:
        raise DataError(
            f'{file.title} needs {library}. Install it: pip install "phsi_opt[loggers]"'
        ) from error
    except Exception as error:  # the libraries promise no classes of their errors
        raise DataError(
            f"{file.title} cannot be read by {library} ({type(error).__name__}: "
            f"{error}). Export its channels as CSV."
        ) from error
    filled = [name for name, one in groups.items() if set(one.columns) - {TIME}]
    # Those with most samples first.
    filled.sort(key=lambda name: -len(next(iter(groups[name].columns.values()))))
    name = chosen_part(group, filled, filled, "group", file.title, may_be_several)
    frame = pd.DataFrame(groups[name].columns)
    frame.index = pd.RangeIndex(1, len(frame) + 1)
    units = groups[name].units
    parts = tuple(sorted(filled, key=lambda one: one != name))
    return Table(file.title, "row", frame, file.run, sheets=parts, units=units)


def _groups_of_mdf(content: io.BytesIO) -> Iterator[tuple[str, Group]]:
    from asammdf import MDF

    with MDF(content) as mdf:
        recorded: list[Any] = mdf.groups
        for number, one in enumerate(recorded):
            group = Group()
            group.add(TIME, mdf.get_master(number), "s")
            for index, channel in enumerate(one.channels):
                if index != mdf.masters_db.get(number):
                    signal = mdf.get(group=number, index=index)
                    group.add(channel.name, signal.samples, signal.unit)
            name = getattr(one.channel_group, "acq_name", "") or f"group {number + 1}"
            yield name, group


def _groups_of_tdms(content: io.BytesIO) -> Iterator[tuple[str, Group]]:
    from nptdms import TdmsFile

    for one in TdmsFile.read(content).groups():
        by_clock: dict[Any, Group] = {}
        for channel in one.channels():
            step = channel.properties.get("wf_increment")
            clock = (len(channel), step, channel.properties.get("wf_start_offset"))
            group = by_clock.setdefault(clock, Group())
            if step and TIME not in group.columns:
                group.add(TIME, channel.time_track(), "s")
            unit = channel.properties.get("unit_string")
            group.add(channel.name, channel[:], unit)
        for number, group in enumerate(by_clock.values(), 1):
            yield one.name if len(by_clock) == 1 else f"{one.name} {number}", group


GROUPS_BY = {"asammdf": _groups_of_mdf, "nptdms": _groups_of_tdms}

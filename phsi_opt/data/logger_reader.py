"""Read channels of logger files, by the library of each, in a process of its own.

Nothing that a file says is executed: the libraries that could are absent. Of an MDF
file only raw values are read. It states how these become physical ones; asammdf applies
all of that, and executes formulas. Here each kind that is a number is a function of its
block in the file and of the raw values x. Kinds and parameters are those of the ASAM
standard; "old" files are those of version 3.
"""

import itertools
import sys
from collections.abc import Callable, Iterator
from functools import partial
from operator import attrgetter
from types import ModuleType
from typing import Any

import numpy as np

from phsi_opt.data.bag_reader import groups_of_bag
from phsi_opt.data.channel_groups import NO_NUMBERS, TIME, Group, Signal
from phsi_opt.data.tables import chosen_part
from phsi_opt.errors import DataError, shown
from phsi_opt.reading import check_size

# asammdf executes formulas by numexpr and sympy, makes tables by pandas, and reads what
# is attached to a file by canmatrix. Together they take 2 s to import.
NOT_NEEDED = ("canmatrix.formats", "canmatrix.canmatrix", "canmatrix", "pandas")
EXECUTING = ("numexpr", "sympy")
OTHER_TYPES = {True: (7, 8), False: range(6, 17)}  # types of data, by whether it is old


class Unused(ModuleType):
    """A library that is imported and not used: all of its names are empty classes."""

    def __getattr__(self, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})


NAME_OF = attrgetter("name")


def read(
    content: Any,
    title: str,
    most: int,
    library: str,
    asked: list[str] | None,
    part: str | None,
    may_be_several: bool,
) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The channels of a group that are asked for, or all (None, or if any is missing).

    Raises:
        OSError: they are too large.
        DataError: the group is not clear, or a channel cannot be read.
    """
    groups: dict[str, Group] = {}
    for name, group in GROUPS_BY[library](content):
        groups[f"{name} {len(groups) + 1}" if name in groups else name] = group
    filled = []
    for name, group in groups.items():
        if group.n_samples and set(map(NAME_OF, group.channels)) - {TIME}:
            filled.append(name)
    filled.sort(key=lambda name: -groups[name].n_samples)
    part = chosen_part(part, filled, filled, "group", title, may_be_several)
    group = groups[part]
    check_size(group.size, most, "of samples")
    names = set(map(NAME_OF, group.channels))
    wanted = asked if asked is not None and names.issuperset(asked) else names
    chosen = [one for one in group.channels if one.name in wanted]
    columns = list(itertools.filterfalse(attrgetter("why_not"), chosen))
    others = list(filter(attrgetter("why_not"), chosen))
    is_unread = set(map(NAME_OF, columns)) <= {TIME}
    for one in others:
        if asked is not None and (one.name in asked or is_unread):
            raise DataError(
                f"{title}, group {shown(part)}: the channel {shown(one.name)} cannot "
                f"be read: {one.why_not}. Export it as numbers."
            )
    return {
        "names": list(map(NAME_OF, columns)),
        "units": [str(one.unit or "") for one in columns],
        "parts": sorted(filled, key=lambda name: name != part),
        "further": [(one.name, one.why_not) for one in others],
    }, [one.values() for one in columns]


def _groups_of_mdf(content: Any) -> Iterator[tuple[str, Group]]:
    for name in NOT_NEEDED + EXECUTING:
        sys.modules[name] = Unused(name)
    from asammdf import MDF

    open_mdf: Any = MDF
    mdf = open_mdf(content, process_bus_logging=False)
    is_old = mdf.version < "4"
    for number, recorded in enumerate(mdf.groups):
        header = recorded.channel_group
        n = header.cycles_nr
        expanded = sum(block.original_size for block in recorded.data_blocks)
        group = Group(n, max(8 * n, n * header.samples_byte_nr, expanded))
        of = getattr(header, "cg_master_index", None)  # a group whose times are used
        of = number if of is None else of
        master = mdf.masters_db.get(of)
        if master is not None:
            clock = mdf.groups[of].channels[master]
            why_not = why_refused(clock.conversion, is_old)
            times = partial(_times_in_mdf, mdf, number, clock, is_old)
            group.channels.append(Signal(TIME, "s", times, why_not))
        for index, one in enumerate(recorded.channels):
            if index == mdf.masters_db.get(number):
                continue
            why_not = why_refused(one.conversion, is_old)
            if (
                recorded.channel_dependencies[index]
                or one.data_type in OTHER_TYPES[is_old]
            ):
                why_not = NO_NUMBERS
            unit = getattr(one.conversion, "unit", "") or getattr(one, "unit", "")
            values = partial(_values_in_mdf, mdf, number, index, is_old)
            group.channels.append(Signal(one.name, unit, values, why_not))
        yield getattr(header, "acq_name", "") or f"group {number + 1}", group


def _times_in_mdf(mdf: Any, number: int, clock: Any, is_old: bool) -> np.ndarray:
    conversion, clock.conversion = clock.conversion, None
    return physical(conversion, is_old, mdf.get_master(number))


def _values_in_mdf(mdf: Any, number: int, index: int, is_old: bool) -> np.ndarray:
    raw, is_invalid = mdf.get(
        group=number,
        index=index,
        samples_only=True,
        raw=True,
        ignore_invalidation_bits=True,  # they are missing samples
    )
    conversion = mdf.groups[number].channels[index].conversion
    values = physical(conversion, is_old, raw)
    if is_invalid is not None and is_invalid.any():
        return np.where(is_invalid, np.nan, values)
    return values


def _groups_of_tdms(content: Any) -> Iterator[tuple[str, Group]]:
    from nptdms import TdmsFile

    for one in TdmsFile.open(content).groups():
        by_clock: dict[Any, Group] = {}
        for channel in one.channels():
            n = len(channel)
            step = channel.properties.get("wf_increment")
            clock = (n, step, channel.properties.get("wf_start_offset"))
            group = by_clock.setdefault(clock, Group(n, 0))
            if step and not group.channels:
                group.channels.append(Signal(TIME, "s", channel.time_track))
            group.size += n * (getattr(channel.data_type, "size", None) or 8)
            unit = channel.properties.get("unit_string")
            values = partial(_values_in_tdms, channel)
            group.channels.append(Signal(channel.name, unit, values))
        for number, group in enumerate(by_clock.values(), 1):
            yield one.name if len(by_clock) == 1 else f"{one.name} {number}", group


def _values_in_tdms(channel: Any) -> np.ndarray:
    values = np.asarray(channel[:])
    return values.astype(str) if values.dtype.kind == "O" else values


def _groups_of_parquet(content: Any) -> Iterator[tuple[str, Group]]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = pq.ParquetFile(content)
    counted = file.metadata
    row_groups = map(counted.row_group, range(counted.num_row_groups))
    size = sum(one.total_byte_size for one in row_groups)
    n = counted.num_rows
    group = Group(n, max(size, 8 * n * counted.num_columns))
    for column in file.schema_arrow:
        told = column.metadata or {}
        unit = (told.get(b"unit") or told.get(b"units") or b"").decode()
        unit = "s" if pa.types.is_duration(column.type) else unit
        is_nested = pa.types.is_nested(column.type) or pa.types.is_binary(column.type)
        values = partial(_values_in_parquet, file, column.name)
        why_not = NO_NUMBERS if is_nested else ""
        group.channels.append(Signal(column.name, unit, values, why_not))
    yield "table", group


def _values_in_parquet(file: Any, name: str) -> np.ndarray:
    import pyarrow as pa

    column = file.read([name], use_threads=False).column(0)
    kind = column.type
    if pa.types.is_timestamp(kind) or pa.types.is_date(kind):
        return np.asarray(column.cast(pa.timestamp("us")).to_numpy())
    if pa.types.is_duration(kind):
        return np.asarray(column.to_numpy() / np.timedelta64(1, "s"))
    if pa.types.is_decimal(kind) or pa.types.is_boolean(kind):
        column = column.cast(pa.float64())
    elif not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        return np.array(column.cast(pa.string()).fill_null("").to_pylist(), dtype=str)
    return np.asarray(column.to_numpy())


GROUPS_BY = {
    "asammdf": _groups_of_mdf,
    "nptdms": _groups_of_tdms,
    "pyarrow": _groups_of_parquet,
    "rosbags": groups_of_bag,
}


# ---- conversions of MDF files --------------------------------------------------------

FORMULA = "its values follow from a formula, which is not executed"
TEXTS = "its values are texts"


def physical(block: Any, is_old: bool, x: np.ndarray) -> np.ndarray:
    """The physical values of raw ones; without a conversion, they are the same."""
    return x if block is None else KINDS[is_old][block.conversion_type](block, x)


def why_refused(block: Any, is_old: bool) -> str:
    """Why a conversion is not applied; "" where it is."""
    if block is None:
        return ""
    kind = block.conversion_type
    if KINDS[is_old].get(kind) is _beside_texts:
        others = list(filter(_is_conversion, block.referenced_blocks.values()))
        if block.referenced_blocks.get("default_addr") not in others:
            return TEXTS
        return max(why_refused(other, is_old) for other in others)
    if kind in KINDS[is_old]:
        return ""
    return FORMULA if kind in ((7, 8, 10) if is_old else (3,)) else TEXTS


def _is_conversion(block: Any) -> bool:
    return hasattr(block, "conversion_type")


def _same(block: Any, x: np.ndarray) -> np.ndarray:
    return x


def _linear(block: Any, x: np.ndarray) -> np.ndarray:
    return np.asarray(block.a * x + block.b)


def _rational(block: Any, x: np.ndarray) -> np.ndarray:
    above = [block.P1, block.P2, block.P3]
    below = [block.P4, block.P5, block.P6]
    if above[-1] == below[-1] == 0:  # a common factor x
        above.pop()
        below.pop()
    with np.errstate(all="ignore"):  # what is not finite is refused by its row
        return np.polyval(above, x.astype(float)) / np.polyval(below, x)


def _table(block: Any, x: np.ndarray, is_interpolated: bool) -> np.ndarray:
    n = getattr(block, "val_param_nr", 0) // 2 or block.ref_param_nr
    raw = np.array([block[f"raw_{i}"] for i in range(n)])
    values = np.array([block[f"phys_{i}"] for i in range(n)])
    if (np.diff(raw) <= 0).any():
        raise OSError("it has a table of a conversion whose raw values do not increase")
    if is_interpolated:
        return np.interp(x, raw, values)
    return values[np.searchsorted((raw[1:] + raw[:-1]) / 2, x)]  # of the nearest


def _of_ranges(block: Any, x: np.ndarray) -> np.ndarray:
    values = np.full(len(x), block.default, float)
    for i in range((block.val_param_nr - 1) // 3):
        values[_within(block, i, x)] = block[f"phys_{i}"]
    return values


def _beside_texts(block: Any, x: np.ndarray) -> np.ndarray:
    """A conversion of most values; others are texts, such as "no signal": missing."""
    others = dict(block.referenced_blocks)
    values = physical(others.pop("default_addr"), False, x).astype(float)
    for name, other in others.items():
        own = _within(block, name.removeprefix("text_"), x)
        is_number = _is_conversion(other)
        values[own] = physical(other, False, x[own]) if is_number else np.nan
    return values


def _within(block: Any, i: object, x: np.ndarray) -> np.ndarray:
    """A range of whole numbers includes its upper end, as does a single value."""
    if block.conversion_type == 7:
        return x == block[f"val_{i}"]
    high = block[f"upper_{i}"]
    return (block[f"lower_{i}"] <= x) & (x < high if x.dtype.kind == "f" else x <= high)


Kind = Callable[[Any, np.ndarray], np.ndarray]
INTERPOLATED: Kind = partial(_table, is_interpolated=True)
NEAREST: Kind = partial(_table, is_interpolated=False)
KINDS: dict[bool, dict[int, Kind]] = {
    True: {65535: _same, 0: _linear, 1: INTERPOLATED, 2: NEAREST, 9: _rational},
    False: {0: _same, 1: _linear, 2: _rational, 4: INTERPOLATED, 5: NEAREST}
    | {6: _of_ranges, 7: _beside_texts, 8: _beside_texts},
}

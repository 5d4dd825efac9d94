"""How measurements come from tables: text, Excel and MATLAB files, and data frames.

The readers' shared words: ``states`` and ``inputs`` map names to columns, or list the
columns whose names they share; a state mapped to None was not measured. A column of a
file is its header, or an integer, its position counted from 0.
"""

import datetime as dt
import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Required, Self, TypedDict, Unpack

import numpy as np

from phsi_opt.arguments import checked_types, is_size, require_known, types_of
from phsi_opt.data.binary_tables import table_of_excel, table_of_groups, table_of_mat
from phsi_opt.data.checks import Hold, check_unique, checked_names
from phsi_opt.data.file_opening import BinarySource, Source, opened_files
from phsi_opt.data.headers import OF_MATRIX, Header, unit_of_header
from phsi_opt.data.tables import Table, numbers_in, rows_of_runs
from phsi_opt.data.text_tables import TextFormat, table_of_csv
from phsi_opt.data.times import (
    Moment,
    begun_anew,
    names_of_parts,
    runs_of_clock,
    times_in,
)
from phsi_opt.data.trajectory import Trajectory
from phsi_opt.errors import DataError, shown
from phsi_opt.interrupts import interruptible
from phsi_opt.presentation.units import are_alike, contradict

if TYPE_CHECKING:
    import pandas as pd

# name -> column, or a list of names which are columns
Label = str | int | float | dt.date | None  # None: it has no column
Labels = Label | list[Label] | tuple[Label, ...]  # several of date and time of day
ColumnMap = Mapping[str, Labels] | Sequence[str]
Part = tuple[str, ...]  # that a column plays, as a study file names it below [data]
RUN_PART: Part = ("trajectory",)
TIME_PART: Part = ("time", "column")


class TableWords(TypedDict, total=False):
    """What every reader can be given, by the names that `from_csv` explains."""

    time: Labels
    states: Required[ColumnMap]
    inputs: ColumnMap | None
    hold: Hold
    trajectory: str | None
    units: Mapping[str, str] | None
    noise: Mapping[str, float] | None
    step: float | None
    start: Any
    date_format: str | None
    clocks: Mapping[str, Label] | None


class TableError(DataError):
    """Columns of a table cannot be used; the message is about the first.

    Attributes:
        by_part: The fault of each part: ``("time", "column")``, ``("trajectory",)``,
            ``("states", name, "column")`` or ``("inputs", name, "column")``; or
            "unit" in place of "column".
    """

    def __init__(self, by_part: Mapping[Part, DataError]) -> None:
        super().__init__(str(next(iter(by_part.values()))))
        self.by_part = by_part


class TableReaders:
    """The readers of `Measurements`, each of which makes one."""

    @classmethod
    @interruptible
    def from_csv(
        cls,
        source: Source | Iterable[Source],
        *,
        columns: Sequence[str] | None = None,
        separator: str | None = None,
        decimal: str | None = None,
        skip: int | None = None,
        units_row: int | None = None,
        **words: Unpack[TableWords],
    ) -> Self:
        """Read text tables.

        The text is UTF-8. What separates the cells (comma, semicolon, tab, blanks), the
        sign before decimals, the header and the line of the units are found in the text
        where they are not given; settings and comments above the table and text below
        it are skipped. Several tables in a file, and comments between samples, are
        refused. Empty cells, nan and NA are missing samples.

        Args:
            source: A path, an open text file, or several of them: then each file is a
                trajectory of its own.
            time: The column of the times: numbers, dates as in ISO 8601
                ("2021-11-22 09:15:00", with "Z" or "+01:00" where the offset is known),
                or times of day; None: they are counted by ``step``. A list where date,
                time of day and milliseconds have columns of their own.
            states: Maps names to columns (or lists columns whose names they share); a
                state mapped to None was not measured. A column is its header, or its
                position as an integer from 0.
            inputs: The same for the inputs, which must be measured.
            trajectory: The column that names each line's trajectory. The lines of one
                trajectory need not be contiguous but keep their order.
            hold, units, noise: As the attributes of `Measurements`; units that are not
                given are those of a line of units, or of the header: "q [m]", "v_m_s".
            step: The time between lines, where no column tells it.
            start: Where times are dates: the moment at which t is 0, such as
                "2021-11-22"; None: the first sample of each trajectory. Dates are
                read in seconds.
            date_format: Dates written otherwise, in the signs of strptime, such as
                "%d.%m.%Y %H:%M", or "%Y%m%d" for 20210131; "excel" for days as
                spreadsheets count them, "unix", "unix ms" or "unix us" for seconds
                since 1970 or parts of them. "": the times are numbers, even where
                these look like dates.
            clocks: The column of the own times of a state or input, by its name, where
                these are not the times above, but in their unit. It is interpolated at
                the times above, or held for ``hold="zero"``; a state beyond its own
                times is missing, and lines before or behind those of an input are left
                out.
            columns: The names of the columns of a table without a header; None: "0",
                "1", ...
            separator: The sign between cells, " " for any number of blanks.
            decimal: The sign before decimals, "." or ","; the other one may mark
                thousands.
            skip: The number of lines above the header.
            units_row: The line of the units; 0: there is none.

        Raises:
            DataError: Something cannot be used; with file, column and line number (the
                header is line 1 when it is the file's first).
        """
        form = TextFormat(columns, separator, decimal, skip, units_row)
        return cls._from_files(source, words, table_of_csv, form, as_text=True)

    @classmethod
    @interruptible
    def from_excel(
        cls,
        source: BinarySource | Iterable[BinarySource],
        *,
        sheet: str | None = None,
        columns: Sequence[str] | None = None,
        decimal: str | None = None,
        skip: int | None = None,
        units_row: int | None = None,
        **words: Unpack[TableWords],
    ) -> Self:
        """Read sheets of Excel workbooks (.xlsx); otherwise as `from_csv`.

        Formulas count with the values that Excel stored; one that was never calculated
        is an empty cell.

        Args:
            source: A path, a file opened for reading bytes, or several of them.
            sheet: The sheet; None: the only one that is not empty.
            columns, decimal, skip, units_row: As in `from_csv`.
            **words: time, states, inputs, hold, trajectory, units, noise, step, start
                and date_format, as in `from_csv`.

        Raises:
            DataError: Something cannot be used; with file, sheet, column and row.
        """
        form = TextFormat(columns, None, decimal, skip, units_row)
        return cls._from_files(source, words, table_of_excel, sheet, form)

    @classmethod
    @interruptible
    def from_mat(
        cls,
        source: BinarySource | Iterable[BinarySource],
        **words: Unpack[TableWords],
    ) -> Self:
        """Read MATLAB files; those of version 7.3 need the extra ``loggers``.

        A column is a vector, a column or row of a matrix, or a field of a struct, and
        is called as in MATLAB: "y", "X(:,2)", "X(2,:)", "log.y", or
        "log.Y(3).Data". Rows are counted from 1.

        Args:
            source, words: As in `from_excel`.

        Raises:
            DataError: Something cannot be used; with file, column and row, and with
                what the file holds where a column is not found.
        """
        return cls._from_files(source, words, table_of_mat)

    @classmethod
    @interruptible
    def from_hdf5(
        cls,
        source: BinarySource | Iterable[BinarySource],
        **words: Unpack[TableWords],
    ) -> Self:
        """Read HDF5 files (.h5, .hdf5); this needs the extra ``loggers``.

        A column is a dataset with one axis, or a column of one with two, called as in
        `from_mat`: "log.y" is the dataset y of the group log, "log.X(:,2)" the second
        column of X. Units are those of attributes "unit" or "units".

        Args:
            source, words: As in `from_excel`.

        Raises:
            DataError: Something cannot be used; as in `from_mat`.
        """
        return cls._from_files(source, words, table_of_mat)

    @classmethod
    @interruptible
    def from_mdf(
        cls,
        source: BinarySource | Iterable[BinarySource],
        *,
        group: str | None = None,
        **words: Unpack[TableWords],
    ) -> Self:
        """Read MDF files (.mf4, .mdf); this needs the extra ``loggers``.

        A column is a channel; "time" has the times of its group, in s. Groups with
        other times are not resampled: one of them is read.

        Args:
            group: The group of channels; None: the only one.
            source, words: As in `from_excel`.

        Raises:
            DataError: Something cannot be used; with file, channel and row.
        """
        return cls._from_files(source, words, table_of_groups, "from_mdf", group)

    @classmethod
    @interruptible
    def from_tdms(
        cls,
        source: BinarySource | Iterable[BinarySource],
        *,
        group: str | None = None,
        **words: Unpack[TableWords],
    ) -> Self:
        """Read TDMS files; otherwise as `from_mdf`.

        "time" has the times of waveforms, in s; other channels have a channel of times,
        or ``step``.

        Args:
            source, group, words: As in `from_mdf`.

        Raises:
            DataError: Something cannot be used; with file, channel and row.
        """
        return cls._from_files(source, words, table_of_groups, "from_tdms", group)

    @classmethod
    @interruptible
    def from_parquet(
        cls,
        source: BinarySource | Iterable[BinarySource],
        **words: Unpack[TableWords],
    ) -> Self:
        """Read Parquet files; this needs the extra ``loggers``.

        Units are those of the metadata of a column, "unit" or "units".

        Args:
            source, words: As in `from_excel`.

        Raises:
            DataError: Something cannot be used; with file, column and row.
        """
        return cls._from_files(source, words, table_of_groups, "from_parquet", None)

    @classmethod
    @interruptible
    def from_bag(
        cls,
        source: BinarySource | Iterable[BinarySource],
        *,
        group: str | None = None,
        **words: Unpack[TableWords],
    ) -> Self:
        """Read bags of ROS 1 (.bag) and ROS 2 (.db3), and MCAP files.

        This needs the extra ``loggers``. A group is a topic, whose messages are those
        of ROS or, in an MCAP file, JSON. A column is a number in them, called by its
        place: "pose.position.x", "data.2". "time" has the times at which they were
        recorded, in s since the first message of the file.

        Args:
            group: The topic; None: the only one.
            source, words: As in `from_mdf`.

        Raises:
            DataError: Something cannot be used; with file, channel and row.
        """
        return cls._from_files(source, words, table_of_groups, "from_bag", group)

    @classmethod
    @interruptible
    def from_dataframe(cls, frame: "pd.DataFrame", **words: Unpack[TableWords]) -> Self:
        """Read a data frame, which is not changed; columns are its labels.

        Args:
            frame: The table.
            **words: The others, as in `from_excel`.

        Raises:
            DataError: Something cannot be used; with the row's label in the index.
        """
        import pandas as pd

        if not isinstance(frame, pd.DataFrame):
            raise DataError(
                f"frame is a {type(frame).__name__}; "
                "expected a pandas.DataFrame (files: from_csv)."
            )
        table = Table("data frame", "row", frame, "run 1")
        return cls.from_tables([table], **words)

    @classmethod
    def _from_files(
        cls,
        source: Any,
        words: TableWords,
        table_of: Callable[..., Table],
        *options: Any,
        as_text: bool = False,
    ) -> Self:
        wanted = _layout(words).columns
        files = opened_files(source, as_text)
        tables = [table_of(file, wanted, *options) for file in files]
        return cls.from_tables(tables, **words)

    @classmethod
    def from_tables(
        cls, tables: Sequence[Table], headers: bool = True, **words: Unpack[TableWords]
    ) -> Self:
        """From tables, whose trajectories are in the order in which they begin.

        Where several tables have a column that names the trajectory, the table's own
        name comes first: "bench/run 3". Times that are dates have the unit s.

        Args:
            tables: At least one, as a file or a data frame has it.
            headers: Whether headers tell units that are not given.
            **words: The others, as in `from_excel`.

        Raises:
            TableError: Columns cannot be used.
            DataError: Something else cannot be used.
        """
        layout = _layout(words)
        trajectories: list[Trajectory] = []
        faults: dict[Part, DataError] = {}
        are_dates = False
        for table in tables:
            prefix = f"{table.run}/" if len(tables) > 1 and layout.trajectory else ""
            runs, origins = _runs_in(table, layout, prefix, faults)
            trajectories += runs
            are_dates = are_dates or bool(origins)
        if faults:
            raise TableError(faults)
        units = _units(words.get("units") or {}, are_dates, tables, layout, headers)
        make: Any = cls  # a `Measurements`, which names its fields
        made: Self = make(
            tuple(trajectories),
            states=tuple(layout.states),
            inputs=tuple(layout.inputs),
            units=units,
            hold=words.get("hold", "linear"),
            noise=words.get("noise"),
            labels=_labels(layout, units),
        )
        return made


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Which column of a table plays which part, in the words of the readers."""

    states: Any
    time: Any = None
    inputs: Any = None
    trajectory: str | None = None
    step: float | None = None
    start: Any = None
    date_format: str | None = None
    clocks: Any = None
    hold: Any = "linear"

    def __post_init__(self) -> None:
        step = self.step
        if (self.time is None) == (step is None):
            raise DataError(
                f"time={self.time!r} and step={step!r}; expected exactly one of them: "
                "the column of the times, or the time between neighbouring rows."
            )
        if step is not None and (not is_size(step) or step == 0):
            raise DataError(
                f"step={step!r} is not a time between rows; expected a positive number."
            )
        if step is not None and (self.start, self.date_format) != (None, None):
            raise DataError(
                "start and date_format apply to a column of dates; omit them if you "
                "give step=..."
            )
        for what in ("inputs", "states"):
            columns = getattr(self, what)
            if not isinstance(columns, Mapping):
                names = checked_names(() if columns is None else columns, what)
                check_unique(names, "name")
                columns = dict(zip(names, names, strict=True))
            object.__setattr__(self, what, dict(columns))
        object.__setattr__(self, "clocks", dict(self.clocks or {}))
        for name in self.clocks:
            said = f"clocks: there is no state and no input {name!r}"
            require_known(name, [*self.states, *self.inputs], said, DataError)
        parts = [one for one in self.parts.values() if isinstance(one, list | tuple)]
        if None in self.inputs.values() or not all(parts):
            raise DataError(
                f"inputs={self.inputs!r}, states={self.states!r} or time={self.time!r} "
                "has an entry without a column; inputs must be measured."
            )

    @property
    def parts(self) -> dict[Part, Any]:
        """The column of each part, None where it has none."""
        parts: dict[Part, Any] = {RUN_PART: self.trajectory, TIME_PART: self.time}
        for what in ("states", "inputs"):
            for name, column in getattr(self, what).items():
                parts[what, name, "column"] = column
        return parts

    @property
    def columns(self) -> list[Any]:
        clocks = dict.fromkeys(self.clocks.values())
        return [*itertools.chain(*map(columns_in, self.parts.values())), *clocks]

    def is_held(self, name: str) -> bool:
        """Whether it is an input that keeps its value until the next sample."""
        hold = self.hold if isinstance(self.hold, str) else self.hold.get(name)
        return name in self.inputs and hold == "zero"


def columns_in(column: Any) -> list[Any]:
    """The columns of one part: none, one, or those that date and time have."""
    if isinstance(column, list | tuple):
        return list(column)
    return [] if column is None else [column]


def _layout(words: TableWords) -> Layout:
    right = checked_types(words, types_of(TableWords), DataError)
    others = ("units", "noise")
    return Layout(**{name: one for name, one in right.items() if name not in others})


def _runs_in(
    table: Table, layout: Layout, prefix: str, faults: dict[Part, DataError]
) -> tuple[list[Trajectory], list[Moment]]:
    """The trajectories of a table, with their moments where t is 0; faults are noted.

    There are none where there is a fault, and no moments where times are numbers.
    """
    rows: dict[str, np.ndarray] = {}
    runs: list[list[np.ndarray]] = []  # the same, divided where the clock begins anew
    t = np.empty(len(table.frame))
    origins: list[Moment] = []
    none = np.empty((len(t), 0))
    columns: dict[str, list[np.ndarray]] = {"states": [none], "inputs": [none]}
    for part, column in layout.parts.items():
        try:
            for one in columns_in(column):
                _check_column(table, one, layout)
            if part == RUN_PART:
                rows = rows_by_name(table, column)
            elif part == TIME_PART:
                t, origins = _times(table, layout, list(rows.values()))
                runs = [runs_of_clock(t, own) for own in rows.values()]
            else:
                values = np.full(len(t), np.nan)
                what, name, _ = part
                has_clock = name in layout.clocks
                if column is not None:
                    may_be_missing = has_clock or what == "states"
                    values = numbers_in(table, column, may_be_missing)
                if has_clock and origins:
                    raise DataError(
                        f"clocks: {name!r} has times of its own, and the times are "
                        "dates; expected numbers. Put both on common times."
                    )
                if has_clock:
                    parts = itertools.chain(*runs)
                    values = _at_times(table, layout, name, values, t, parts)
                columns[what].append(values)
        except DataError as error:
            faults.setdefault(part, error)
    if faults:
        return [], origins
    if table.frame.empty:
        raise DataError(
            f"{table.title} has no samples; "
            "expected at least 2 rows of numbers below the header."
        )
    x, u = map(np.column_stack, columns.values())
    trajectories = []
    ending = table.ending
    begins: Iterable[Any] = origins or itertools.repeat(None)
    for name, own, begin in zip(rows, runs, begins, strict=False):
        origin = begin if isinstance(begin, dt.datetime) else None
        begun = begun_anew([table.row(part[0]) for part in own[1:]])
        remark = "; ".join(filter(None, (begun, ending)))
        names = names_of_parts(prefix + name, len(own))
        for called, samples in zip(names, own, strict=True):
            known = samples[np.isfinite(u[samples]).all(axis=1)]
            arrays = (t[known], x[known], u[known])
            trajectories.append(Trajectory(called, *arrays, origin, remark))
            remark = ending = ""
    return trajectories, origins


def _at_times(
    table: Table,
    layout: Layout,
    name: str,
    values: np.ndarray,
    t: np.ndarray,
    runs: Iterable[np.ndarray],
) -> np.ndarray:
    """The values of a channel with a clock at the times t, NaN beyond its own times."""
    clock = layout.clocks[name]
    _check_column(table, clock, layout)
    times = numbers_in(table, clock, may_be_missing=True)
    found = np.full(len(t), np.nan)
    for rows in runs:
        own = rows[np.isfinite(times[rows] + values[rows])]
        late = own[1:][np.diff(times[own]) <= 0]
        if len(own) < 2 or len(late):
            raise DataError(
                f"{table.place(clock, int([*late, *rows][0]))} expected at least two "
                "times of its own for each run, which increase from line to line."
            )
        if layout.is_held(name):
            places = np.searchsorted(times[own], t[rows], side="right")
            found[rows] = np.append(np.nan, values[own])[places]
        else:
            ends = {"left": np.nan, "right": np.nan}
            found[rows] = np.interp(t[rows], times[own], values[own], **ends)
    return found


def _times(
    table: Table, layout: Layout, runs: list[np.ndarray]
) -> tuple[np.ndarray, list[Moment]]:
    """The times of all rows, and the moments at which t is 0, where they are dates."""
    if layout.step is None:
        return times_in(table, layout.time, runs, layout.start, layout.date_format)
    t = np.empty(len(table.frame))
    for rows in runs:
        t[rows] = layout.step * np.arange(len(rows))
    return t, []


def _units(
    given: Any, are_dates: bool, tables: Sequence[Table], layout: Layout, headers: bool
) -> Any:
    """The given units, and others of dates, the tables' own rows, and headers."""
    units = {"t": "s", **given} if are_dates else dict(given)
    if are_dates and units["t"] != "s":
        raise DataError(
            f"units: the time 't' has the unit {units['t']!r}, and dates are read in "
            "seconds; expected 's'. Leave 't' out of units."
        )
    faults: dict[Part, DataError] = {}
    times = {} if are_dates else {"t": layout.time}
    columns = {**times, **layout.states, **layout.inputs}
    for table, name in itertools.product(tables, columns):
        column = str(columns[name])
        of_header = unit_of_header(column, name == "t")
        of_file = table.units.get(column) or of_header
        if name in given and _contradict(given[name], of_file, column):
            what = "states" if name in layout.states else "inputs"
            part = ("time", "unit") if name == "t" else (what, name, "unit")
            faults[part] = DataError(
                f"units: {name!r} has the unit {str(given[name])!r}, but the column "
                f"{shown(column)} of {table.title} is in {of_file!r}; expected the "
                "unit of the numbers in the file. Give that, or correct the file."
            )
        unit = table.units.get(column) or of_header * headers
        if name not in given and unit and units.setdefault(name, unit) != unit:
            raise DataError(
                f"{table.title}: {name!r} has the unit {unit!r}, but in a table "
                f"before it {units[name]!r}; expected one unit. Convert the tables, so "
                "that all have the same."
            )
    if faults:
        raise TableError(faults)
    return units


def _labels(layout: Layout, units: Mapping[str, str]) -> dict[str, str]:
    """What headers call states and inputs: a few words, without the unit.

    None that two channels would share, or that is the name of another one.
    """
    found = {}
    channels = {**layout.states, **layout.inputs}
    for name, column in channels.items():
        if not isinstance(column, str) or OF_MATRIX.fullmatch(column):
            continue
        unit = units.get(name, "").removeprefix("deg")
        told = Header.of(column).label.removesuffix(f"_{unit}")
        told = " ".join(told.replace("_", " ").split())
        if 1 < len(told) <= 30 and told != name:
            found[name] = told
    n_uses = Counter([*found.values(), *channels])
    return {name: told for name, told in found.items() if n_uses[told] == 1}


def _contradict(given: str, of_file: str, column: str) -> bool:
    """Whether a given unit is surely not the file's; "_A" may count sensors."""
    may_be_index = len(of_file) == 1 and column.endswith(f"_{of_file}")
    is_sure = not may_be_index or are_alike(given, of_file)
    return is_sure and contradict(given, of_file)


def _check_column(table: Table, column: Any, layout: Layout) -> None:
    found = table.frame.columns.tolist()
    said = f"{table.title} has no column {shown(column)}"
    require_known(column, found, said, DataError)
    n_found = found.count(column)
    if n_found > 1:
        raise DataError(
            f"{table.title} has {n_found} columns called {shown(column)}; expected "
            "one. Rename them so that it is clear which one is meant."
        )
    if layout.columns.count(column) > 1:
        raise DataError(
            f"{table.title}: the column {shown(column)} is used twice; expected one "
            "column per name. Choose another one."
        )


def rows_by_name(table: Table, column: Any) -> dict[str, np.ndarray]:
    """Row numbers of each trajectory, in the order in which the trajectories begin."""
    if column is None:
        return {table.run: np.arange(len(table.frame))}
    cells = table.frame[column]
    try:
        names = cells.astype(str).str.strip()
    except ValueError as error:  # of a number of thousands of digits
        raise DataError(f"a name of a trajectory cannot be shown: {error}.") from None
    is_missing = (cells.isna() | (names == "")).to_numpy()
    if is_missing.any():
        place = table.place(column, int(np.argmax(is_missing)))
        raise DataError(
            f"{place} the trajectory's name is missing; "
            "every sample must name its trajectory."
        )
    return rows_of_runs(names)

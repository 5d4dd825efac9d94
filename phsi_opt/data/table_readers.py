"""How measurements come from tables: text, Excel and MATLAB files, and data frames.

The readers' shared words: ``states`` and ``inputs`` map names to columns, or list the
columns whose names they share; a state mapped to None was not measured. A column of a
file is its header, or an integer, its position counted from 0.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self

from phsi_opt.data.checks import Hold
from phsi_opt.data.excel_tables import table_of_excel
from phsi_opt.data.file_opening import (
    BinarySource,
    Source,
    binary_files,
    text_files,
)
from phsi_opt.data.layout import (
    ColumnMap,
    Layout,
    table_layout,
    trajectories_in,
)
from phsi_opt.data.matlab_tables import table_of_mat
from phsi_opt.data.tables import Table, table_of_csv, table_of_frame
from phsi_opt.data.text_cells import TextFormat

if TYPE_CHECKING:
    import pandas as pd


class TableReaders:
    """The readers of `Measurements`, each of which makes one."""

    @classmethod
    def from_csv(
        cls,
        source: Source | Iterable[Source],
        *,
        time: str | int | None = None,
        states: ColumnMap,
        inputs: ColumnMap | None = None,
        hold: Hold = "linear",
        trajectory: str | None = None,
        units: Mapping[str, str] | None = None,
        noise: Mapping[str, float] | None = None,
        step: float | None = None,
        start: Any = None,
        date_format: str | None = None,
        columns: Sequence[str] | None = None,
        separator: str | None = None,
        decimal: str | None = None,
    ) -> Self:
        """Read text tables.

        The text is UTF-8. What separates the cells (comma, semicolon, tab, blanks), the
        sign before decimals and whether the first line is a header are found in the
        text where they are not given. Empty cells, nan and NA are missing samples.

        Args:
            source: A path, an open text file, or several of them: then each file is a
                trajectory of its own.
            time: The column of the times: numbers, dates as in ISO 8601
                ("2021-11-22 09:15:00", with "Z" or "+01:00" where the offset is known),
                or times of day; None: they are counted by ``step``.
            states: Maps names to columns (or lists columns whose names they share); a
                state mapped to None was not measured. A column is its header, or its
                position as an integer from 0.
            inputs: The same for the inputs, which must be measured.
            trajectory: The column that names each line's trajectory. The lines of one
                trajectory need not be contiguous but keep their order.
            hold, units, noise: As the attributes of `Measurements`.
            step: The time between lines, where no column tells it.
            start: Where times are dates: the moment at which t is 0, such as
                "2021-11-22"; None: the first sample of each trajectory. Dates are
                read in seconds.
            date_format: Dates written otherwise, in the signs of strptime, such as
                "%d.%m.%Y %H:%M", or "%Y%m%d" for 20210131. "": the times are numbers,
                even where these look like such dates.
            columns: The names of the columns of a table without a header; None: "0",
                "1", ...
            separator: The sign between cells, " " for any number of blanks.
            decimal: The sign before decimals, "." or ",".

        Raises:
            DataError: Something cannot be used; with file, column and line number (the
                header is line 1 when it is the file's first).
        """
        layout = table_layout(
            time, states, inputs, trajectory, step, start, date_format
        )
        text_format = TextFormat(columns, separator, decimal)
        tables = []
        for file in text_files(source):
            tables.append(table_of_csv(file, layout.columns, text_format))
        return cls._from_tables(tables, layout, units, hold, noise)

    @classmethod
    def from_excel(
        cls,
        source: BinarySource | Iterable[BinarySource],
        *,
        time: str | int | None = None,
        states: ColumnMap,
        inputs: ColumnMap | None = None,
        sheet: str | None = None,
        hold: Hold = "linear",
        trajectory: str | None = None,
        units: Mapping[str, str] | None = None,
        noise: Mapping[str, float] | None = None,
        step: float | None = None,
        start: Any = None,
        date_format: str | None = None,
        columns: Sequence[str] | None = None,
        decimal: str | None = None,
    ) -> Self:
        """Read sheets of Excel workbooks (.xlsx); otherwise as `from_csv`.

        Formulas count with the values that Excel stored; one that was never calculated
        is an empty cell.

        Args:
            source: A path, a file opened for reading bytes, or several of them.
            sheet: The sheet; None: the only one that is not empty.
            time, states, inputs, trajectory: As in `from_csv`.
            step, start, date_format, columns, decimal: As in `from_csv`.
            hold, units, noise: As the attributes of `Measurements`.

        Raises:
            DataError: Something cannot be used; with file, sheet, column and row.
        """
        layout = table_layout(
            time, states, inputs, trajectory, step, start, date_format
        )
        text_format = TextFormat(columns, None, decimal)
        tables = []
        for file in binary_files(source):
            tables.append(table_of_excel(file, layout.columns, sheet, text_format))
        return cls._from_tables(tables, layout, units, hold, noise)

    @classmethod
    def from_mat(
        cls,
        source: BinarySource | Iterable[BinarySource],
        *,
        time: str | None = None,
        states: ColumnMap,
        inputs: ColumnMap | None = None,
        hold: Hold = "linear",
        trajectory: str | None = None,
        units: Mapping[str, str] | None = None,
        noise: Mapping[str, float] | None = None,
        step: float | None = None,
        start: Any = None,
        date_format: str | None = None,
    ) -> Self:
        """Read MATLAB files of version 4 to 7.

        A column is a vector, a column or row of a matrix, or a field of a struct, and
        is called as in MATLAB: "y", "X(:,2)", "X(2,:)", "log.y". Rows are counted
        from 1.

        Args:
            source: A path, a file opened for reading bytes, or several of them: then
                each file is a trajectory of its own.
            time: The column of the times; None: they are counted by ``step``.
            states: Maps names to columns (or lists columns whose names they share); a
                state mapped to None was not measured.
            inputs: The same for the inputs, which must be measured.
            trajectory: A column whose value names each sample's trajectory.
            hold, units, noise: As the attributes of `Measurements`.
            step: The time between samples, where no column tells it.
            start, date_format: As in `from_csv`, for numbers such as 20210131.

        Raises:
            DataError: Something cannot be used; with file, column and row, and with
                what the file holds where a column is not found.
        """
        layout = table_layout(
            time, states, inputs, trajectory, step, start, date_format
        )
        tables = [table_of_mat(file, layout.columns) for file in binary_files(source)]
        return cls._from_tables(tables, layout, units, hold, noise)

    @classmethod
    def from_dataframe(
        cls,
        frame: "pd.DataFrame",
        *,
        time: Any = None,
        states: ColumnMap,
        inputs: ColumnMap | None = None,
        hold: Hold = "linear",
        trajectory: str | None = None,
        units: Mapping[str, str] | None = None,
        noise: Mapping[str, float] | None = None,
        step: float | None = None,
        start: Any = None,
        date_format: str | None = None,
    ) -> Self:
        """Read a data frame, which is not changed; columns are its labels.

        Args:
            frame: The table.
            time, states, inputs, trajectory: As in `from_csv`.
            step, start, date_format: As in `from_csv`.
            hold, units, noise: As the attributes of `Measurements`.

        Raises:
            DataError: Something cannot be used; with the row's label in the index.
        """
        table = table_of_frame(frame)
        layout = table_layout(
            time, states, inputs, trajectory, step, start, date_format
        )
        return cls._from_tables([table], layout, units, hold, noise)

    @classmethod
    def _from_tables(
        cls,
        tables: Sequence[Table],
        layout: Layout,
        units: Mapping[str, str] | None,
        hold: Hold,
        noise: Mapping[str, float] | None,
    ) -> Self:
        make: Any = cls  # a `Measurements`, which names its fields
        trajectories, all_units = trajectories_in(tables, layout, units)
        made: Self = make(
            trajectories,
            states=tuple(layout.states),
            inputs=tuple(layout.inputs),
            units=all_units,
            hold=hold,
            noise=noise,
        )
        return made

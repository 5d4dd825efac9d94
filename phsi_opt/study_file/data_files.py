"""Whether the data files bear out what a study file says of them.

Every column of every file is looked at, so that one look tells all that is wrong.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from phsi_opt.data.excel_tables import filled_sheets, table_of_excel
from phsi_opt.data.file_opening import DataFile, binary_files, text_files
from phsi_opt.data.layout import Layout
from phsi_opt.data.matlab_tables import table_of_mat, table_of_vectors
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.tables import Table, numbers_in, rows_of_runs, table_of_csv
from phsi_opt.data.text_cells import TextFormat
from phsi_opt.data.times import clock_of
from phsi_opt.errors import DataError, did_you_mean
from phsi_opt.study_file.complaints import Complaints, Place
from phsi_opt.study_file.sections import DataSection, HeldOut, reader_of

TIME_PLACE = ("time", "column")
RUN_PLACE = ("trajectory",)


def table_at(
    path: DataFile, wanted: Iterable[Any] = (), section: DataSection | None = None
) -> Table:
    """The table of a file, column by column.

    Args:
        path: of the file; its suffix tells what it is.
        wanted: the columns that are looked for.
        section: what the user said of the table; None: nothing, and of a MATLAB file
            all vectors of the commonest length are taken, of a workbook the first sheet
            with content.

    Raises:
        DataError: it cannot be read as such a table.
    """
    told = section or DataSection()
    separator = None if reader_of(path) == "from_excel" else told.separator
    form = TextFormat(told.columns, separator, told.decimal)
    if reader_of(path) == "from_csv":
        (text,) = text_files(path)
        return table_of_csv(text, wanted, form)
    (file,) = binary_files(path)
    if reader_of(path) == "from_excel":
        first = next(iter(sheets_in(path)), None) if section is None else told.sheet
        return table_of_excel(file, wanted, first, form)
    return table_of_vectors(file) if section is None else table_of_mat(file, wanted)


def sheets_in(path: DataFile) -> list[str]:
    """The sheets of a workbook that have content; none of another file.

    Raises:
        DataError: it cannot be read.
    """
    if reader_of(path) != "from_excel":
        return []
    (file,) = binary_files(path)
    return filled_sheets(file)


def check_measurements(
    section: DataSection, folder: Path, found: Complaints
) -> Measurements | None:
    """The measurements; None, and what is wrong noted, where they cannot be read."""
    if found.about("data"):
        return None
    for number, path in enumerate(section.paths(folder)):
        numbers = () if len(section.files) == 1 else (number,)
        _check_file(section, path, ("data", "files", *numbers), found)
    if found.about("data"):
        return None
    try:
        return section.measurements(folder)
    except DataError as error:
        found.add(error, "data", value="")
        return None


def _check_file(
    section: DataSection, path: DataFile, place: Place, found: Complaints
) -> None:
    """Look at each column by itself, for the first wrong cell of each."""
    wanted = _wanted(section)
    if not path.exists():
        found.add(
            "there is no such file; paths are relative to the study file.", *place
        )
        return
    if reader_of(path) != section.reader:
        suffix = Path(section.files[0]).suffix.lower()
        found.add(f"the first file is {suffix}; give files of one kind.", *place)
        return
    try:
        table = table_at(path, wanted.values(), section)
    except DataError as error:
        found.add(error, *place)
        return
    for where, column in wanted.items():
        try:
            _check_column(table, where, column, section)
        except DataError as error:
            found.add(error, "data", *where)


def _wanted(section: DataSection) -> dict[tuple[str, ...], str | int]:
    """The columns that are asked for, by their places in [data]."""
    columns = {TIME_PLACE: section.time.column, RUN_PLACE: section.trajectory}
    for what in ("states", "inputs"):
        for name, channel in getattr(section, what).items():
            columns[what, name, "column"] = channel.column
    return {place: column for place, column in columns.items() if column is not None}


def _check_column(
    table: Table, place: tuple[str, ...], column: str | int, section: DataSection
) -> None:
    known = table.frame.columns.tolist()
    if column not in known:
        raise DataError(
            f"{table.title} has no such column; it has {', '.join(map(str, known))}."
            f"{did_you_mean(column, known)}"
        )
    if known.count(column) > 1 or place == RUN_PLACE:
        return  # told where the table is read as a whole
    if place == TIME_PLACE:
        time = section.time
        start = time.start or None
        layout = Layout(
            states={}, time=column, start=start, date_format=time.date_format
        )
        clock_of(table, layout, _rows(table, section.trajectory))
    else:
        numbers_in(table, column, may_be_missing=place[0] == "states")


def _rows(table: Table, column: str | None) -> list[np.ndarray]:
    """The row numbers of each run; none where their column cannot be used."""
    if column is None:
        return [np.arange(len(table.frame))]
    is_usable = table.frame.columns.tolist().count(column) == 1
    return list(rows_of_runs(table.frame[column]).values()) if is_usable else []


def check_held_out(held_out: HeldOut, data: Measurements, found: Complaints) -> None:
    """Note what is held out and is not there, or leaves nothing to fit."""
    for run in held_out.runs or ():
        try:
            data.trajectory_number(run)
        except DataError as error:
            found.add(error, "held_out", "runs", value=run)
    if found.about("held_out"):
        return
    try:
        held_out.split(data)
    except DataError as error:
        found.add(error, "held_out")

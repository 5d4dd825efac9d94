"""The data files of a study file, with all that is wrong in them."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from phsi_opt.data.excel_tables import filled_sheets, table_of_excel
from phsi_opt.data.file_opening import DataFile, binary_files, run_names, text_files
from phsi_opt.data.matlab_tables import table_of_mat, table_of_vectors
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.table_readers import TableError
from phsi_opt.data.tables import Table, table_of_csv
from phsi_opt.data.text_cells import TextFormat
from phsi_opt.study_file.complaints import Complaints
from phsi_opt.study_file.sections import DataSection, HeldOut, reader_of


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
    wanted = section.wanted
    paths = section.paths(folder)
    names: list[str] = []
    with found.noting("data", "files"):
        names = run_names(paths)
    tables = []
    for number, name in enumerate(names):
        path = paths[number]
        numbers = () if len(section.files) == 1 else (number,)
        place = ("data", "files", *numbers)
        if not path.exists():
            said = "there is no such file; paths are relative to the study file."
            found.add(said, *place)
        elif reader_of(path) != section.reader:
            suffix = Path(section.files[0]).suffix.lower()
            found.add(f"the first file is {suffix}; give files of one kind.", *place)
        else:
            with found.noting(*place):
                tables.append(replace(table_at(path, wanted, section), run=name))
    if not tables:
        return None
    with found.noting("data", value=""):
        try:
            return section.measured(tables)
        except TableError as error:
            for part, fault in error.by_part.items():
                found.add(fault, "data", *part)
    return None


def check_held_out(held_out: HeldOut, data: Measurements, found: Complaints) -> None:
    """Note what is held out and is not there, or leaves nothing to fit."""
    for run in held_out.runs or ():
        with found.noting("held_out", "runs", value=run):
            data.trajectory_number(run)
    if not found.about("held_out"):
        with found.noting("held_out"):
            held_out.split(data)

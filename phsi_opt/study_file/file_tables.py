"""The tables of data files as they are found: text, Excel, MATLAB, column by column.

For looking at columns one by one; `Measurements` has the readers of whole files.
"""

from collections.abc import Iterable
from typing import Any

from phsi_opt.data.excel_tables import filled_sheets, table_of_excel
from phsi_opt.data.file_opening import DataFile, binary_files, text_files
from phsi_opt.data.matlab_tables import table_of_mat, table_of_vectors
from phsi_opt.data.tables import Table, table_of_csv
from phsi_opt.data.text_cells import TextFormat
from phsi_opt.study_file.sections import READERS, DataSection


def table_at(
    path: DataFile,
    wanted: Iterable[Any],
    section: DataSection | None = None,
    sheet: str | None = None,
) -> Table:
    """The table of a file.

    Args:
        path: of the file; its suffix tells what it is.
        wanted: the columns that are looked for.
        section: what the user said of the table; None: nothing, and of a MATLAB file
            all vectors of the commonest length.
        sheet: of a workbook, where there is no section.

    Raises:
        DataError: it cannot be read as such a table.
    """
    columns = separator = decimal = None
    if section is not None:
        columns = section.columns
        separator = section.separator
        decimal = section.decimal
        sheet = section.sheet
    reader = READERS.get(path.suffix.lower())
    if reader == "from_mat":
        (file,) = binary_files(path)
        return table_of_vectors(file) if section is None else table_of_mat(file, wanted)
    if reader == "from_excel":
        (file,) = binary_files(path)
        return table_of_excel(file, wanted, sheet, TextFormat(columns, None, decimal))
    (text,) = text_files(path)
    return table_of_csv(text, wanted, TextFormat(columns, separator, decimal))


def sheets_in(path: DataFile) -> list[str]:
    """The sheets of a workbook that have content; none of another file.

    Raises:
        DataError: it cannot be read.
    """
    if READERS.get(path.suffix.lower()) != "from_excel":
        return []
    (file,) = binary_files(path)
    return filled_sheets(file)

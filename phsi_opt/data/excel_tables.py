"""Tables in Excel workbooks: a sheet with a header row or without, cell by cell.

`excel_reader` reads the cells.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from phsi_opt.data.file_opening import OpenedFile
from phsi_opt.data.reading_apart import read_apart
from phsi_opt.data.tables import Table, chosen_part
from phsi_opt.data.text_tables import TextFormat, table_of_rows

REPAIR_WORKBOOK = (
    "Open it in a spreadsheet program and save it again as .xlsx or as CSV, without a "
    "password."
)


def table_of_excel(
    file: OpenedFile,
    wanted: Iterable[Any],
    sheet: str | None,
    form: TextFormat,
    may_be_several: bool = False,
) -> Table:
    """The cells of a sheet; empty rows, and empty columns behind the last, are skipped.

    Without the name of a sheet it is the only one with content, or the first of several
    where there may be several. The form is that of cells that hold text.

    Raises:
        DataError: this is no workbook, there is no such sheet, or it is empty.
    """
    read, _ = read_apart(file, "excel_reader", REPAIR_WORKBOOK)
    sheets: dict[str, Any] = dict(read)
    filled = [name for name, rows in sheets.items() if rows]
    sheet = chosen_part(
        sheet, list(sheets), filled, "sheet", file.title, may_be_several
    )
    title = f"{file.title}, sheet {sheet!r}"
    rows = dict(sheets[sheet])
    width = max(map(len, rows.values()))
    for cells in rows.values():
        cells += [""] * (width - len(cells))
    table = table_of_rows(file, title, "row", rows, wanted, form, "")
    return replace(table, sheets=tuple(sorted(filled, key=lambda one: one != sheet)))

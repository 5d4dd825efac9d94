"""Tables in Excel workbooks: a sheet with a header row or without, cell by cell."""

import datetime as dt
import io
from collections.abc import Iterable, Sequence
from typing import Any

from phsi_opt.data.file_opening import BinaryFile
from phsi_opt.data.tables import Table, labels_of, names_by_position
from phsi_opt.data.text_cells import TextFormat, decimal_of, is_header
from phsi_opt.data.workbook_checks import EXCEL_ROWS, check_workbook
from phsi_opt.errors import DataError, did_you_mean

MOST_CELLS = 50_000_000  # of a sheet, with the empty ones between; 20 GB of memory
Rows = dict[int, list[Any]]  # the cells of each row that is not empty, by its number


def table_of_excel(
    file: BinaryFile,
    wanted: Iterable[Any],
    sheet: str | None,
    text_format: TextFormat,
) -> Table:
    """The cells of a sheet; empty rows, and empty columns behind the last, are skipped.

    Args:
        file: The workbook.
        wanted: The columns that are looked for, by name or by number from 0.
        sheet: The sheet's name; None: the only one that is not empty.
        text_format: The columns of a table without a header, and the sign before
            decimals in cells that hold text.

    Raises:
        DataError: This is no workbook, there is no such sheet, or it is empty.
    """
    import pandas as pd

    sheets = _sheets(file)
    name = _chosen(sheets, sheet, file.title)
    title = f"{file.title}, sheet {name!r}"
    rows = sheets[name]
    width = max(len(cells) for cells in rows.values())
    padded = {}
    for number, cells in rows.items():
        padded[number] = cells + [None] * (width - len(cells))
    first_number = min(padded)
    if text_format.columns is None and is_header(_texts(padded[first_number])):
        header = _header(padded.pop(first_number))
    else:
        header = names_by_position(text_format.columns, width, title)
    labels = labels_of(header, wanted, title)
    frame = pd.DataFrame(
        list(padded.values()),
        index=list(padded),
        columns=pd.Index(labels, dtype=object),
        dtype=object,
    )
    decimal = text_format.decimal
    if decimal is None:
        texts = (cell for cells in padded.values() for cell in cells)
        decimal = decimal_of(filter(_is_text, texts), separator=",")
    return Table(title, "row", frame, file.run, decimal)


def filled_sheets(file: BinaryFile) -> list[str]:
    """The names of the sheets with content, in the order of the workbook.

    Args:
        file: The workbook.

    Raises:
        DataError: This is no workbook.
    """
    return [name for name, rows in _sheets(file).items() if rows]


def _sheets(file: BinaryFile) -> dict[str, Rows]:
    """The filled rows of all sheets, by the sheets' names."""
    import openpyxl

    check_workbook(file)
    try:
        book = openpyxl.load_workbook(
            io.BytesIO(file.content), read_only=True, data_only=True
        )
        sheets = {}
        for sheet in book.worksheets:
            sheet.reset_dimensions()  # what a file states of them may be wrong
            rows = sheet.iter_rows(values_only=True)
            sheets[sheet.title] = _filled_rows(
                rows, f"{file.title}, sheet {sheet.title!r}"
            )
        book.close()
    except DataError:
        raise
    except Exception as error:  # openpyxl promises no classes of its errors
        raise DataError(
            f"{file.title} is no Excel workbook that can be read "
            f"({type(error).__name__}: {error}). Open it in a spreadsheet program and "
            "save it again as .xlsx, without a password, or as CSV."
        ) from error
    return sheets


def _filled_rows(rows: Iterable[Sequence[Any]], title: str) -> Rows:
    filled = {}
    widest = 0
    for number, cells in enumerate(rows, start=1):
        width = len(cells)
        while width and _is_empty(cells[width - 1]):
            width -= 1
        if width:
            filled[number] = list(cells[:width])
            widest = max(widest, width)
        if number > EXCEL_ROWS or widest * len(filled) > MOST_CELLS:
            raise DataError(
                f"{title} has more than {EXCEL_ROWS} rows, which Excel does not have, "
                f"or more than {MOST_CELLS} cells. Save its table as CSV."
            )
    return filled


def _is_empty(cell: Any) -> bool:
    return cell is None or (isinstance(cell, str) and not cell.strip())


def _is_text(cell: Any) -> bool:
    return isinstance(cell, str)


def _chosen(sheets: dict[str, Rows], sheet: str | None, title: str) -> str:
    if sheet is not None:
        if sheet not in sheets:
            hint = did_you_mean(sheet, list(sheets))
            raise DataError(
                f"{title} has no sheet {sheet!r}; "
                f"expected one of its sheets {list(sheets)}.{hint}"
            )
        filled = [sheet] if sheets[sheet] else []
    else:
        filled = [name for name, rows in sheets.items() if rows]
    if not filled:
        what = "is empty" if sheet is None else f"has nothing on its sheet {sheet!r}"
        raise DataError(
            f"{title} {what}; expected a header row and at least 2 rows of numbers."
        )
    if len(filled) > 1:
        raise DataError(
            f"{title} has several sheets with content: {filled}. "
            f'Say which one: sheet = "{filled[0]}".'
        )
    return filled[0]


def _header(cells: list[Any]) -> list[str]:
    return ["" if _is_empty(cell) else str(cell).strip() for cell in cells]


def _texts(cells: list[Any]) -> list[str]:
    """The cells as a text table would hold them."""
    texts = []
    for cell in cells:
        is_moment = isinstance(cell, dt.datetime | dt.time | dt.timedelta)
        texts.append("0" if is_moment else "" if _is_empty(cell) else str(cell).strip())
    return texts

"""Tables in Excel workbooks: a sheet with a header row or without, cell by cell.

An .xlsx file is a zip archive of XML. A small archive can grow to fill the memory; so
can XML that defines entities, which workbooks never do. openpyxl passes in silence over
rows and cells that do not stand in order; they are looked for before it reads.
"""

import io
import re
import zipfile
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from phsi_opt import reading
from phsi_opt.data.file_opening import OpenedFile
from phsi_opt.data.table_extent import Rows, n_filled
from phsi_opt.data.tables import Table, chosen_part
from phsi_opt.data.text_tables import TextFormat, table_of_rows
from phsi_opt.errors import DataError

MOST_CELLS = 50_000_000  # of a sheet, with the empty ones between; 20 GB of memory
USUAL_COMPRESSION = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
SHEET_PART = re.compile(r"xl/worksheets/[^/]+\.xml")
DEFINITIONS = re.compile(rb"<!(?:DOCTYPE|ENTITY)")
# Rows and cells with their places: <row r="3">, <c r="B3">.
PLACE = re.compile(
    rb"<(?:\w+:)?(row|c)\b(?:[^>]*?\sr=[\"'](?P<column>[A-Z]*)(?P<row>\d+)[\"'])?"
)
REPAIR = "Open it in a spreadsheet program and save it again as .xlsx or as CSV"
# What `zipfile` raises for a damaged archive, or one with a password.
DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, EOFError, OSError),
    *(LookupError, ValueError, RuntimeError),
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
    sheets = _sheets(file)
    filled = [name for name, rows in sheets.items() if rows]
    sheet = chosen_part(
        sheet, list(sheets), filled, "sheet", file.title, may_be_several
    )
    title = f"{file.title}, sheet {sheet!r}"
    rows = sheets[sheet]
    table = table_of_rows(file, title, "row", rows, wanted, form, "")
    return replace(table, sheets=tuple(sorted(filled, key=lambda one: one != sheet)))


def _sheets(file: OpenedFile) -> dict[str, Rows]:
    """The filled rows of all sheets, by the sheets' names."""
    import openpyxl

    _check_workbook(file)
    content = io.BytesIO(file.content)
    try:
        book = openpyxl.load_workbook(content, read_only=True, data_only=True)
        sheets = {}
        for sheet in book.worksheets:
            sheet.reset_dimensions()  # what a file states of them may be wrong
            rows = sheet.iter_rows(values_only=True)
            title = f"{file.title}, sheet {sheet.title!r}"
            sheets[sheet.title] = _filled_rows(rows, title)
        book.close()
    except DataError:
        raise
    except Exception as error:  # openpyxl promises no classes of its errors
        raise DataError(
            f"{file.title} is not an Excel workbook that can be read "
            f"({type(error).__name__}: {error}). {REPAIR}, without a password."
        ) from error
    return sheets


def _filled_rows(rows: Iterable[Sequence[Any]], title: str) -> Rows:
    """The rows that are not empty, all as wide as the widest."""
    filled: Rows = {}
    width = 0
    for number, row in enumerate(rows, start=1):
        cells = ["" if value is None else value for value in row]
        cells = [cell.strip() if isinstance(cell, str) else cell for cell in cells]
        del cells[n_filled(cells) :]
        if cells:
            filled[number] = cells
            width = max(width, len(cells))
        if number > 1_048_576 or width * len(filled) > MOST_CELLS:
            raise DataError(
                f"{title} has more than 1048576 rows (the limit of Excel) or more "
                f"than {MOST_CELLS} cells. Save its table as CSV."
            )
    for cells in filled.values():
        cells += [""] * (width - len(cells))
    return filled


def _check_workbook(file: OpenedFile) -> None:
    """Refuse a workbook that cannot be read safely and wholly."""
    title = file.title
    try:
        with zipfile.ZipFile(io.BytesIO(file.content)) as archive:
            size = sum(part.file_size for part in archive.infolist())
            if size > reading.LARGEST_FILE:
                raise DataError(
                    f"{title} has {size / 1e6:.1f} MB when decompressed; at most "
                    f"{reading.LARGEST_FILE / 1e6:g} MB are read. Save its table as "
                    "CSV."
                )
            for part in archive.infolist():
                if part.compress_type not in USUAL_COMPRESSION:  # read without a bound
                    raise DataError(
                        f"{title} is not an .xlsx workbook: its part "
                        f"{part.filename!r} has an unsupported compression. {REPAIR}."
                    )
                _check_part(part.filename, archive.read(part), title)
    except DataError:
        raise
    except DAMAGED as error:
        raise DataError(
            f"{title} is not an .xlsx workbook, or it is damaged ({error}). {REPAIR}, "
            "without a password."
        ) from error


def _check_part(name: str, content: bytes, title: str) -> None:
    is_xml = name.endswith((".xml", ".rels"))
    begin = content[:100].removeprefix(b"\xef\xbb\xbf").lstrip()
    if is_xml and content and not begin.startswith(b"<"):
        raise DataError(f"{title} is damaged: its part {name!r} is not XML in UTF-8.")
    if DEFINITIONS.search(content):
        raise DataError(
            f"{title} is not a usual Excel workbook: its part {name!r} defines XML "
            f"entities, which are unsafe to expand. {REPAIR}."
        )
    if not SHEET_PART.fullmatch(name):
        return
    row, last = 0, (0, b"")  # the last row, and the last column of it
    for tag, letters, number in PLACE.findall(content):
        if tag == b"row":
            is_next = not number or int(number) > row
            row, last = int(number or row + 1), (0, b"")
        else:
            column = (len(letters), letters)  # orders A, Z, AA, XFD
            is_next = not letters or last < column < (4, b"")  # the last one is XFD
            last = max(last, column)
        if not is_next:
            raise DataError(
                f"{title}, {name!r} has the row or cell {(letters + number).decode()} "
                f"out of order, so rows could be lost. {REPAIR}."
            )

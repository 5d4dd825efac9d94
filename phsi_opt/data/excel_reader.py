"""Read the sheets of an Excel workbook, by openpyxl, in a process of its own.

An .xlsx file is a zip archive of XML. A small archive can grow to fill the memory; so
can XML that defines entities, which workbooks never do. Rows and cells out of order
would be lost in silence by openpyxl's own loop over a sheet.
"""

import re
import zipfile
from collections.abc import Iterator
from typing import Any

import openpyxl
from openpyxl.worksheet._reader import WorkSheetParser

from phsi_opt.data.table_extent import n_filled
from phsi_opt.reading import check_size

MOST_ROWS, MOST_COLUMNS = 1_048_576, 16_384  # the limits of Excel
USUAL_COMPRESSION = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
DEFINITIONS = re.compile(rb"<!(?:DOCTYPE|ENTITY)")
CELLS = (b"<c ", b"<c>", b"<c/")
Row = tuple[int, list[Any]]


def read(
    content: Any, title: str, most: int
) -> tuple[list[tuple[str, list[Row]]], list[Any]]:
    """The names of the sheets, each with its filled rows and their numbers."""
    with zipfile.ZipFile(content) as archive:
        size = sum(part.file_size for part in archive.infolist())
        check_size(size, most, "when decompressed")
        for part in archive.infolist():
            if part.compress_type not in USUAL_COMPRESSION:  # read without a bound
                raise OSError(f"its part {part.filename!r} has an unusual compression")
            _check_part(part.filename, archive.read(part))
    book = openpyxl.load_workbook(content, read_only=True, data_only=True)
    sheets = []
    for sheet in book.worksheets:
        rows = list(_filled_rows(sheet, most))
        sheets.append((sheet.title, rows))
    return sheets, []


def _check_part(name: str, content: bytes) -> None:
    begin = content[:100].removeprefix(b"\xef\xbb\xbf").lstrip()
    is_xml = name.endswith((".xml", ".rels"))
    if is_xml and content and not begin.startswith(b"<"):
        raise OSError(f"it is damaged: its part {name!r} is not XML in UTF-8")
    if DEFINITIONS.search(content):
        raise OSError(
            f"its part {name!r} defines XML entities, which are unsafe to expand"
        )
    if name.startswith("xl/worksheets/"):
        for row in content.split(b"<row"):
            if sum(map(row.count, CELLS)) > MOST_COLUMNS:
                raise OSError(f"a row of its part {name!r} has too many cells")


def _filled_rows(sheet: Any, most: int, bytes_each: int = 32) -> Iterator[Row]:
    """The rows; a cell in a list takes 8 bytes for its place and 24 for a number."""
    book = sheet.parent
    source = sheet._get_source()
    formats = book._date_formats, book._timedelta_formats
    parser = WorkSheetParser(source, sheet._shared_strings, True, book.epoch, *formats)
    last = size = width = n_rows = 0
    for number, found in parser.parse():
        cells: list[Any] = []
        is_next = last < number <= MOST_ROWS
        for cell in found:
            column, value = cell["column"], cell["value"]
            is_next = is_next and len(cells) < column <= MOST_COLUMNS
            cells += [""] * (column - 1 - len(cells))
            if isinstance(value, str):
                value = value.strip()
                size += len(value)
            cells.append("" if value is None else value)
        if not is_next:
            raise OSError(
                f"its sheet {sheet.title!r} has row {number}, or a cell in it, out of "
                f"order or beyond {MOST_ROWS} rows and {MOST_COLUMNS} columns"
            )
        last = number
        del cells[n_filled(cells) :]
        if cells:
            n_rows += 1
            width = max(width, len(cells))
            yield number, cells
        if bytes_each * width * n_rows + size > most:
            raise OSError(
                f"its sheet {sheet.title!r} has more than {most // bytes_each} cells, "
                "or too long texts"
            )

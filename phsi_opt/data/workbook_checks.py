"""Excel workbooks before they are read: whole, of a bounded size, nothing that grows.

An .xlsx file is a zip archive of XML. A small archive can grow to fill the memory; so
can XML that defines entities, which workbooks never do. openpyxl passes in silence over
rows and cells that do not stand in order; they are looked for here.
"""

import io
import re
import zipfile
import zlib

from phsi_opt import reading
from phsi_opt.data.file_opening import BinaryFile
from phsi_opt.errors import DataError

EXCEL_ROWS = 1_048_576  # of a sheet, as Excel has
COLUMN_LETTERS = 3  # of a column: the last is XFD
NO_COLUMN = (0, b"")
USUAL_COMPRESSION = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
SHEET_PART = re.compile(r"xl/worksheets/[^/]+\.xml")
DEFINITIONS = re.compile(rb"<!(?:DOCTYPE|ENTITY)")
# Rows and cells with their places: <row r="3">, <c r="B3">.
PLACE = re.compile(
    rb"<(?:\w+:)?(row|c)\b(?:[^>]*?\sr=[\"'](?P<column>[A-Z]*)(?P<row>\d+)[\"'])?"
)
# What `zipfile` raises for a damaged archive, or one with a password.
ZIP_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    OSError,
    LookupError,
    ValueError,
    RuntimeError,
)


def check_workbook(file: BinaryFile) -> None:
    """Refuse a workbook that cannot be read safely and wholly.

    Raises:
        DataError: It is no .xlsx file, is damaged or too large, defines entities, or
            has rows or cells that do not stand in order.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(file.content)) as archive:
            _check_size(archive, file.title)
            for part in archive.infolist():
                _check_part(part.filename, archive.read(part), file.title)
    except DataError:
        raise
    except ZIP_DAMAGE as error:
        raise DataError(
            f"{file.title} is no Excel workbook of the kind .xlsx, or is damaged "
            f"({error}). Save it as .xlsx, without a password, or as CSV."
        ) from error


def _check_size(archive: zipfile.ZipFile, title: str) -> None:
    parts = archive.infolist()
    size = sum(part.file_size for part in parts)
    if size > reading.LARGEST_FILE:
        raise DataError(
            f"{title} has {size / 1e6:.1f} MB when decompressed; at most "
            f"{reading.LARGEST_FILE / 1e6:g} MB are read. Save its table as CSV."
        )
    for part in parts:  # others are read without a bound
        if part.compress_type not in USUAL_COMPRESSION:
            raise DataError(
                f"{title} is no Excel workbook of the kind .xlsx: its part "
                f"{part.filename!r} is compressed in another way. Save it as .xlsx."
            )


def _check_part(name: str, content: bytes, title: str) -> None:
    is_xml = name.endswith((".xml", ".rels"))
    begin = content[:100].removeprefix(b"\xef\xbb\xbf").lstrip()
    if is_xml and content and not begin.startswith(b"<"):
        raise DataError(f"{title} is damaged: its part {name!r} is no XML in UTF-8.")
    if DEFINITIONS.search(content):
        raise DataError(
            f"{title} is no usual Excel workbook: its part {name!r} defines XML "
            "entities, which can grow without end. Save it as CSV."
        )
    if SHEET_PART.fullmatch(name):
        _check_order(content, f"{title}, {name!r}")


def _check_order(sheet: bytes, title: str) -> None:
    """Refuse rows and cells that do not stand in order."""
    row = 0
    last = NO_COLUMN
    for tag, letters, number in PLACE.findall(sheet):
        if tag == b"row":
            following = int(number) if number else row + 1
            is_next = following > row
            row = following
            last = NO_COLUMN
        else:
            column = (len(letters), letters)  # orders A, Z, AA, XFD
            is_next = not letters or column > last
            last = max(last, column)
        if not is_next or len(letters) > COLUMN_LETTERS:
            place = (letters + number).decode()
            raise DataError(
                f"{title} has the row or cell {place} in the wrong place, and rows "
                "could be lost. Open it in a spreadsheet program and save it again."
            )

"""A first look at a table: its columns, what each may be, and what cannot be read.

A column is numeric where most of its cells are numbers; then a cell that is none is
refused with its line, since it is a mistake and not a name. What each column may be is
guessed as for a first study file.
"""

from collections.abc import Mapping
from pathlib import Path

from phsi_opt.data.file_opening import NamedFile
from phsi_opt.data.tables import Table, numbers_in
from phsi_opt.data.text_cells import MISSING_CELLS, NUMBER
from phsi_opt.errors import DataError
from phsi_opt.page.drafts import NOT_USED, RUN, ColumnDraft, DataDraft
from phsi_opt.study_file import survey
from phsi_opt.study_file.data_files import table_at
from phsi_opt.study_file.survey import ColumnSurvey

N_EXAMPLES = 3  # cells shown of each column
MOSTLY = 0.5  # share of numbers above which a column is meant to be numeric


def look_at(places: Mapping[str, Path]) -> DataDraft:
    """The columns of the files, with a guess of what each is.

    Args:
        places: tables with the same columns, a run each; where they lie, by name.

    Raises:
        DataError: a file cannot be read, or has other columns than the first.
    """
    draft = DataDraft(dict(places))
    for name, place in places.items():
        _take_file(draft, NamedFile(place, name))
    draft.runs = list(dict.fromkeys(draft.runs))
    return draft


def _take_file(draft: DataDraft, file: NamedFile) -> None:
    table = table_at(file, ())
    _check_header(table)
    for name in table.frame.columns:
        _check_numbers(table, str(name))
    columns = []
    surveyed = survey.survey(file)
    for seen in surveyed.columns:
        columns.append(_column(table, seen))
    if surveyed.step is not None:
        draft.step = f"{surveyed.step:g}"
    if not draft.columns:
        draft.columns = columns
    _check_same_columns(draft.columns, columns, table.title)
    draft.n_samples += len(table.frame)
    draft.runs += _runs(table, columns)


def _check_header(table: Table) -> None:
    headers = [str(name) for name in table.frame.columns]
    for name in headers:
        if headers.count(name) > 1:
            raise DataError(
                f"{table.title}: the header has {name!r} twice; give each column a "
                "name of its own."
            )


def _check_numbers(table: Table, name: str) -> None:
    """Refuse a column of numbers with a cell that is none.

    Raises:
        DataError: with the file, the column and the line.
    """
    if _share_of_numbers(_cells(table, name)) > MOSTLY:
        numbers_in(table, name, may_be_missing=True)


def _cells(table: Table, name: str) -> list[str]:
    return [str(cell) for cell in table.frame[name]]


def _share_of_numbers(cells: list[str]) -> float:
    n_numbers = 0
    n_filled = 0
    for cell in cells:
        n_filled += cell.strip().lower() not in MISSING_CELLS
        n_numbers += _is_number(cell.strip())
    return n_numbers / max(n_filled, 1)


def _is_number(cell: str) -> bool:
    """Whether it is one with a decimal point or comma."""
    return NUMBER.fullmatch(cell) is not None


def _column(table: Table, seen: ColumnSurvey) -> ColumnDraft:
    """The draft of a column; parts have the same words here and there but for one."""
    cells = _cells(table, seen.column)
    is_numeric = _share_of_numbers(cells) > MOSTLY
    role = NOT_USED if seen.part == survey.UNUSED else seen.part
    examples = tuple(cells[:N_EXAMPLES])
    name = seen.name
    return ColumnDraft(seen.column, role, name, seen.unit, "", examples, is_numeric)


def _check_same_columns(
    first: list[ColumnDraft], columns: list[ColumnDraft], title: str
) -> None:
    expected = [str(column.column) for column in first]
    found = [str(column.column) for column in columns]
    if expected != found:
        raise DataError(
            f"{title} has the columns {', '.join(found)}; expected "
            f"{', '.join(expected)}, as in the first file."
        )


def _runs(table: Table, columns: list[ColumnDraft]) -> list[str]:
    """Names of the runs: of a column, else that of the file."""
    for column in columns:
        if column.role == RUN:
            return [str(cell) for cell in table.frame[column.column].unique()]
    return [table.run]

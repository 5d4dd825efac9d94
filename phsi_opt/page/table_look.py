"""A first look at a table: its columns, what each may be, and what cannot be read.

A column is numeric where most of its cells are numbers; then a cell that is none is
refused with its line, since it is a mistake and not a name. What each column may be is
guessed as for a first study file.
"""

import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from phsi_opt.data.file_opening import NamedFile
from phsi_opt.data.tables import numbers_in
from phsi_opt.page.drafts import NOT_USED, ColumnDraft, DataDraft
from phsi_opt.presentation.numbers import shortened
from phsi_opt.study_file.columns import UNUSED
from phsi_opt.study_file.survey import check_alike, survey


def look_at(places: Mapping[str, Path]) -> DataDraft:
    """The columns of the files, with a guess of what each is.

    Args:
        places: tables with the same columns, a run each; where they lie, by name.

    Raises:
        DataError: a file cannot be read, or has other columns than the first.
    """
    draft = DataDraft(dict(places))
    seen = [survey(NamedFile(place, name)) for name, place in places.items()]
    for one in seen:
        for column in one.columns:
            if column.is_numeric:
                numbers_in(one.table, column.column, may_be_missing=True)
        check_alike(seen[0].columns, one.columns, one.table.title)
        draft.n_samples += one.n_lines
        draft.runs += one.run.cells.tolist() if one.run else [one.table.run]
        if one.step is not None:
            draft.time = {"step": one.step}
    draft.runs = list(dict.fromkeys(draft.runs))
    for column in seen[0].columns:  # parts have the same words here but for one
        role = NOT_USED if column.part == UNUSED else column.part
        told = {"name": column.name, "unit": column.unit}
        examples = tuple(column.cells[:3])
        is_numeric = column.is_numeric
        found = ColumnDraft(column.column, role, told, examples, is_numeric)
        draft.columns.append(found)
    return draft


# ---- which tables are taken ----------------------------------------------------------

# Bytes of one uploaded file. A table of a million numbers takes about 10 MB.
MOST_UPLOADED = 20_000_000
MOST_FILES = 50  # of one study; each is a run
# What the name of an uploaded table may end in; the ending tells how it is read.
TABLE_KINDS = (".csv", ".txt", ".tsv", ".dat", ".xlsx")


def in_megabytes(size: int) -> str:
    """A number of bytes in words: '20 MB'."""
    return f"{size / 1e6:.3g} MB"


def without_path(name: str) -> str:
    """The last part of a name, without the folders that a browser may tell."""
    return re.split(r"[/\\]", name)[-1]


def suffix_of(name: str) -> str:
    """What a name ends in, in lower case, such as ".csv"."""
    return PurePosixPath(name).suffix.lower()


def name_refusal(name: str) -> str:
    """Why a file of this name is not taken, in a sentence; "" where it is."""
    shown = repr(shortened(name, 40))
    if not name.isprintable():
        return f"the name {shown} has control characters; expected letters."
    if suffix_of(name) not in TABLE_KINDS:
        kinds = ", ".join(TABLE_KINDS)
        return f"{shown} does not end as a table does; expected {kinds}."
    return ""

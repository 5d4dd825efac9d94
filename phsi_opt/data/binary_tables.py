"""Tables of binary files: Excel workbooks, loggers' files, MATLAB and HDF5 files.

Each is read in a process of its own, by `excel_reader` (a sheet, cell by cell),
`logger_reader` (MDF, TDMS, Parquet, ROS bags, MCAP) and `array_reader` (MATLAB, HDF5).

A logger's file has groups of channels; those of a group have common times, which are
the first column. Channels of a group that are sampled otherwise are a group of their
own. Groups are never put on common times: one of them is the table.

A column of a MATLAB file is a vector, a column or row of a matrix, or a field of a
struct, called as in MATLAB: ``y``, ``X(:,2)``, ``X(2,:)``, ``log.y``, ``log.X(:,2)``,
``log.Y(3).Data``; a field may go without its struct where one struct alone has it.
Cells, texts and tables are not read, but are named where something is not found. Those
of an HDF5 file, as MATLAB 7.3 and others write them, are called likewise.
"""

from collections import ChainMap
from collections.abc import Iterable
from dataclasses import replace
from importlib.util import find_spec
from itertools import starmap
from typing import Any

import numpy as np

from phsi_opt.data.file_opening import OpenedFile
from phsi_opt.data.reading_apart import read_apart
from phsi_opt.data.tables import Table, Variable, chosen_part, table_of_columns
from phsi_opt.data.text_tables import TextFormat, table_of_rows
from phsi_opt.errors import DataError, did_you_mean

REPAIR_WORKBOOK = (
    "Open it in a spreadsheet program and save it again as .xlsx or as CSV, without a "
    "password."
)
# The libraries that read the files of each reader of `Measurements`.
LOGGERS = {
    "from_mdf": ("asammdf",),
    "from_tdms": ("nptdms",),
    "from_parquet": ("pyarrow",),
    "from_bag": ("rosbags", "mcap"),
}


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


def table_of_groups(
    file: OpenedFile,
    wanted: Iterable[Any] | None,
    reader: str,
    group: str | None,
) -> Table:
    """Channels of a group; its times are in s.

    Args:
        file: of a logger.
        wanted: the columns that are looked for; None: all, of the largest of several
            groups.
        reader: of `Measurements`, one of `LOGGERS`.
        group: the group; None: the only one.
    """
    _require(file, *LOGGERS[reader])
    found, arrays = read_apart(
        file,
        "logger_reader",
        "Export its channels as CSV.",
        library=LOGGERS[reader][0],
        asked=None if wanted is None else list(wanted),
        part=group,
        may_be_several=wanted is None,
    )
    lengths = set(map(len, arrays))
    if len(lengths) > 1:
        raise DataError(
            f"{file.title} is damaged: the channels of a group have {sorted(lengths)} "
            "samples. Export them as CSV."
        )
    return table_of_columns(
        file,
        found["names"],
        arrays,
        sheets=tuple(found["parts"]),
        units=dict(zip(found["names"], found["units"], strict=True)),
        further=tuple(starmap(Variable, found["further"])),
    )


def _require(file: OpenedFile, *libraries: str) -> None:
    """Refuse a file whose libraries are not installed."""
    for library in libraries:
        if find_spec(library) is None:
            raise DataError(
                f"{file.title} needs {library}. Install it: pip install "
                '"phsi_opt[loggers]"; or read the file with another program and give '
                "its table to Measurements.from_dataframe."
            )


# ---- MATLAB --------------------------------------------------------------------------

Vectors = dict[Variable, dict[str, np.ndarray]]  # those of each variable, by name
SAVE_AGAIN = (
    "Save it again in MATLAB by save(name, '-v7'), or write the table as CSV by "
    "writetable or writematrix."
)
HDF5 = b"\x89HDF\r\n\x1a\n"  # how it begins; MATLAB writes 512 bytes before


def table_of_mat(file: OpenedFile, wanted: Iterable[Any]) -> Table:
    """The columns that are looked for, as they would be called in MATLAB."""
    variables = _variables(file)
    found = {name: _column(name, variables, file.title) for name in wanted}
    columns = {name: values for name, (values, _) in found.items()}
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise DataError(
            f"{file.title}: the columns differ in length: {lengths}; "
            f"expected one value per sample in each. {_listing(variables)}"
        )
    units = {name: unit for name, (_, unit) in found.items()}
    return table_of_columns(file, list(columns), list(columns.values()), units=units)


def table_of_vectors(file: OpenedFile) -> Table:
    """All vectors of the commonest length, where nobody said which are looked for."""
    variables = _variables(file)
    # A matrix that is taken for a table has few columns.
    few = {one: vectors for one, vectors in variables.items() if len(vectors) <= 20}
    lengths = [vector.size for own in few.values() for vector in own.values()]
    n_rows = max(lengths, key=lambda n: (n > 1, lengths.count(n), n), default=0)
    if n_rows < 2:
        raise DataError(
            f"{file.title} contains no column of numbers: expected a vector, or a "
            f"matrix of few columns, with 2 rows or more. {_listing(variables)}"
        )
    columns: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    further = []
    for variable in variables:
        own = few.get(variable, {}).items()
        fitting = {name: one.ravel() for name, one in own if one.size == n_rows}
        columns |= fitting
        units |= dict.fromkeys(fitting, variable.unit)
        if not fitting:
            further.append(variable)
    found = (list(columns), list(columns.values()))
    return table_of_columns(file, *found, units=units, further=tuple(further))


def _column(name: Any, variables: Vectors, title: str) -> tuple[np.ndarray, str]:
    """The vector of this name, which may go without its struct, and its unit."""
    wanted = str(name)
    vectors = ChainMap(*reversed(variables.values()))

    def fitting(wanted: str) -> list[str]:
        if wanted in vectors:
            return [wanted]
        return [one for one in vectors if one.endswith(f".{wanted}")]

    if not fitting(wanted):
        wanted = wanted.replace(" ", "").replace("/", ".")
    names = fitting(wanted)
    axis = {"(:,1)": 1, "(1,:)": 0}.get(wanted[-5:])
    if not names and axis is not None:  # all of a vector, written as of a matrix
        whole = fitting(wanted[:-5])
        names = [one for one in whole if vectors[one].shape[axis] == 1]
    if len(names) == 1:
        of = next(one for one, own in variables.items() if names[0] in own)
        return vectors[names[0]].ravel(), of.unit
    if names:
        raise DataError(
            f"{title}: {name!r} is a field of several structs; choose one of {names}."
        )
    hint = did_you_mean(wanted, vectors)
    raise DataError(f"{title} has no column {name!r}. {_listing(variables)}{hint}")


def _listing(variables: Vectors) -> str:
    listed = [f"{one.name!r} ({one.said})" for one in variables]
    others = len(listed) - 50
    more = f" and {others} more" if others > 0 else ""
    return f"The file contains: {', '.join(listed[:50]) or 'nothing'}{more}."


def _described(
    name: str, unit: str, values: np.ndarray
) -> tuple[Variable, dict[str, np.ndarray]]:
    """A variable in words, and the vectors in it, as they are called in MATLAB."""
    if values.dtype.kind == "U":
        return Variable(name, str(values)), {}
    if not values.size:
        return Variable(name, "empty"), {}
    if values.ndim > 2:
        axes = f"an array with {values.ndim} dimensions, which is not supported"
        return Variable(name, axes), {}
    if values.size == 1:
        number = None if np.iscomplexobj(values) else float(values.item())
        return Variable(name, f"the number {values.item():g}", number), {name: values}
    n_rows, n_columns = values.shape
    if 1 in values.shape:
        said = f"{values.size} numbers"
        return Variable(name, said, unit=unit), {name: values}
    is_high = n_rows >= n_columns
    form = f"{name}(:,{{}})" if is_high else f"{name}({{}},:)"
    vectors = enumerate(values.T if is_high else values, 1)
    size = f"{n_rows} x {n_columns} numbers: {form.format(1)}, ..."
    columns = {form.format(i): vector for i, vector in vectors}
    return Variable(name, size, unit=unit), columns


def _variables(file: OpenedFile) -> Vectors:
    """The variables of a file, in its order; fields of structs as "struct.field"."""
    is_hdf5 = file.content[:8] == HDF5 or file.content[512:520] == HDF5
    if is_hdf5:
        _require(file, "h5py")
    repair = "Write its table as CSV." if is_hdf5 else SAVE_AGAIN
    names, values = read_apart(file, "array_reader", repair, is_hdf5=is_hdf5)
    return dict(map(_described, *zip(*names, strict=True), values) if names else ())

"""Columns of MATLAB files: vectors, columns or rows of matrices, fields of structs.

A column is called as in MATLAB: ``y``, ``X(:,2)``, ``X(2,:)``, ``log.y``,
``log.X(:,2)``; a field may go without its struct where one struct alone has it. Cells,
texts, tables and structs in structs are not read, but are named where something is not
found.

SciPy's compiled reader trusts the sizes that a file states: a damaged file can crash
the process that reads it, or fill its memory. It reads in a process of its own,
`matlab_worker`.
"""

import os
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np

from phsi_opt import reading
from phsi_opt.data.file_opening import BinaryFile
from phsi_opt.data.tables import Table, Variable
from phsi_opt.errors import DataError, did_you_mean

INDEXED = re.compile(r"(?P<name>[\w.]+)\((?P<row>:|\d+),\s*(?P<column>:|\d+)\)")
MOST_VECTORS = 20  # columns that a matrix has, at most, where it is taken for a table
WORKER = Path(__file__).with_name("matlab_worker.py")
TIME_LIMIT = 120.0  # seconds; a file of 500 MB takes about 5


def table_of_mat(file: BinaryFile, wanted: Iterable[Any]) -> Table:
    """The columns that are looked for, in the order in which they are.

    Args:
        file: A MATLAB file of version 4 to 7.
        wanted: The columns, as they would be called in MATLAB.

    Raises:
        DataError: This is no such file, a column is not there or could be several, or
            the columns differ in length.
    """
    content = _Content(file)
    columns = {name: content.column(name) for name in wanted}
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise DataError(
            f"{file.title}: the columns differ in length: {lengths}; "
            f"expected one value per sample in each. {content.listing}"
        )
    return _table(file, columns)


def table_of_vectors(file: BinaryFile) -> Table:
    """All vectors of the commonest length, where nobody said which are looked for.

    Of a matrix these are its columns, or its rows where it is wider than high.

    Raises:
        DataError: This is no such file, or no vector in it has two numbers; with the
            names and sizes of what it holds.
    """
    content = _Content(file)
    vectors: dict[str, np.ndarray] = {}
    for name, matrix in content.matrices.items():
        vectors |= _vectors_of(name, matrix)
    lengths = [len(vector) for vector in vectors.values()]
    n_rows = max(lengths, key=lambda n: (lengths.count(n), n), default=0)
    if n_rows < 2:
        raise DataError(
            f"{file.title} holds no column of numbers: no vector, and no matrix of few "
            f"columns, has 2 numbers or more. {content.listing}"
        )
    columns = {
        name: vector for name, vector in vectors.items() if len(vector) == n_rows
    }
    return _table(file, columns, tuple(_further(content, n_rows)))


def _table(
    file: BinaryFile,
    columns: dict[Any, np.ndarray],
    further: tuple[Variable, ...] = (),
) -> Table:
    import pandas as pd

    frame = pd.DataFrame(columns)
    frame.index = pd.RangeIndex(1, len(frame) + 1)  # as MATLAB counts
    return Table(file.title, "row", frame, file.run, further=further)


def _further(content: "_Content", n_rows: int) -> Iterator[Variable]:
    """What is no column of so many rows."""
    for name, matrix in content.matrices.items():
        if n_rows not in map(len, _vectors_of(name, matrix).values()):
            is_number = matrix.size == 1 and not np.iscomplexobj(matrix)
            value = float(matrix.item()) if is_number else None
            said = _size(matrix) if value is None else f"the number {value:g}"
            yield Variable(name, said, value)
    for name, said in content.others.items():
        yield Variable(name, said)


def _vectors_of(name: str, matrix: np.ndarray) -> dict[str, np.ndarray]:
    """The columns of a table in a matrix, as they are called in MATLAB."""
    n_rows, n_columns = matrix.shape
    if min(n_rows, n_columns) == 1:
        return {name: matrix.ravel()} if matrix.size > 1 else {}
    if min(n_rows, n_columns) > MOST_VECTORS:
        return {}
    if n_rows >= n_columns:
        return {f"{name}(:,{i + 1})": matrix[:, i] for i in range(n_columns)}
    return {f"{name}({i + 1},:)": matrix[i] for i in range(n_rows)}


class _Content:
    """What a file holds.

    Attributes:
        title: What messages call the file.
        matrices: The numbers (n_rows, n_columns), by name; fields as "struct.field".
        others: What cannot be read, in words.
        listing: All of it, as a sentence.
    """

    def __init__(self, file: BinaryFile) -> None:
        self.title = file.title
        self.matrices: dict[str, np.ndarray] = {}
        self.others: dict[str, str] = {}
        listed = []
        for name, value in _variables(file).items():
            if value.dtype.kind == "U":
                self.others[name] = str(value)
            elif value.ndim != 2:
                self.others[name] = (
                    f"an array with {value.ndim} axes, which is not read"
                )
            elif not value.size:
                self.others[name] = "empty"
            else:
                self.matrices[name] = value
            listed.append(f"{name!r} ({self.others.get(name) or _size(value)})")
        self.listing = f"The file holds: {', '.join(listed) or 'nothing'}."

    def column(self, name: Any) -> np.ndarray:
        if not isinstance(name, str):
            raise DataError(
                f"{self.title}: the column {name!r} is no name; expected text, as in "
                f"MATLAB. {self.listing}"
            )
        indexed = INDEXED.fullmatch(name)
        if indexed is not None:
            return self._indexed(name, indexed)
        matrix = self._matrix(name)
        if 1 not in matrix.shape:
            raise DataError(
                f"{self.title}: {name!r} is a matrix of {_size(matrix)}; "
                f"choose one of its columns or rows, such as '{name}(:,1)' or "
                f"'{name}(1,:)'."
            )
        return matrix.ravel()

    def _indexed(self, name: str, indexed: re.Match[str]) -> np.ndarray:
        matrix = self._matrix(indexed["name"])
        row = indexed["row"]
        column = indexed["column"]
        is_one_colon = (row == ":") != (column == ":")
        number = int(column if row == ":" else row) if is_one_colon else 0
        vectors = matrix.T if row == ":" else matrix
        if not 1 <= number <= len(vectors):
            raise DataError(
                f"{self.title} has no column {name!r}: {indexed['name']!r} is of "
                f"{_size(matrix)}, counted from 1; expected such as (:,1) or (1,:)."
            )
        chosen: np.ndarray = vectors[number - 1]
        return chosen

    def _matrix(self, name: str) -> np.ndarray:
        """The matrix of this name, which may go without its struct."""
        fields = [known for known in self.matrices if known.endswith(f".{name}")]
        if name in self.matrices or len(fields) == 1:
            return self.matrices[name if name in self.matrices else fields[0]]
        if fields:
            raise DataError(
                f"{self.title}: {name!r} is a field of several structs; "
                f"say which one of {fields}."
            )
        said = f"{self.title} has no column {name!r}"
        if name in self.others:
            said = f"{self.title}: {name!r} is {self.others[name]}"
        hint = did_you_mean(name, list(self.matrices))
        raise DataError(f"{said}. {self.listing}{hint}")


def _size(matrix: np.ndarray) -> str:
    if matrix.size == 1:
        return "one number"
    if 1 in matrix.shape:
        return f"{matrix.size} numbers"
    return f"{matrix.shape[0]} x {matrix.shape[1]} numbers"


def _variables(file: BinaryFile) -> dict[str, np.ndarray]:
    """The variables of a file, in its order; fields of structs as "struct.field".

    Of what is no array of numbers, an array of one text says what it is.
    """
    try:
        with TemporaryFile() as content, TemporaryFile() as arrays:
            content.write(file.content)
            content.seek(0)
            why = _read_apart(content.fileno(), arrays.fileno())
            if not why:
                arrays.seek(0)
                with np.load(arrays, allow_pickle=False) as found:
                    names, *values = (found[key] for key in found.files)
                return dict(zip(names.tolist(), values, strict=True))
    except OSError as error:
        why = reading.why_not_read(error)
    raise DataError(
        f"{file.title} cannot be read: {why}. Save it again in MATLAB by "
        "save(name, '-v7'), or write the table as CSV by writetable or writematrix."
    )


def _read_apart(content: int, arrays: int) -> str:
    """Let the worker read from one open file into another; why it could not, or ""."""
    if getattr(sys, "frozen", False) or not sys.executable:
        return "that needs a Python interpreter, and this program is without one"
    command = [sys.executable, "-P", "-X", "utf8", str(WORKER)]
    try:
        run = subprocess.run(
            [*command, str(reading.LARGEST_FILE)],
            stdin=content,
            stdout=arrays,
            stderr=subprocess.PIPE,
            timeout=TIME_LIMIT,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},  # they would take memory
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    except subprocess.TimeoutExpired:
        return f"it is damaged or too large: it was not read in {TIME_LIMIT:g} s"
    if run.returncode == 0:
        return ""
    said = run.stderr.decode(errors="replace").splitlines()
    if run.returncode == 1 and said:
        return said[-1]
    return f"it is damaged: its reading ended with exit code {run.returncode}"

"""Columns of MATLAB files: vectors, columns or rows of matrices, fields of structs.

A column is called as in MATLAB: ``y``, ``X(:,2)``, ``X(2,:)``, ``log.y``,
``log.X(:,2)``; a field may go without its struct where one struct alone has it. Cells,
texts, tables and structs in structs are not read, but are named where something is not
found.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from phsi_opt.data.file_opening import BinaryFile
from phsi_opt.data.matlab_process import mat_variables
from phsi_opt.data.tables import Table, Variable
from phsi_opt.errors import DataError, did_you_mean

INDEXED = re.compile(r"(?P<name>[\w.]+)\((?P<row>:|\d+),\s*(?P<column>:|\d+)\)")
MOST_VECTORS = 20  # columns that a matrix has, at most, where it is taken for a table


def table_of_mat(file: BinaryFile, wanted: Iterable[Any]) -> Table:
    """The columns that are looked for, in the order in which they are.

    Args:
        file: A MATLAB file of version 4 to 7.
        wanted: The columns, as they would be called in MATLAB.

    Raises:
        DataError: This is no such file, a column is not there or could be several, or
            the columns differ in length.
    """
    import pandas as pd

    content = _Content.of(file)
    columns = {}
    for name in wanted:
        columns[name] = content.column(name)
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise DataError(
            f"{file.title}: the columns differ in length: {lengths}; "
            "expected one value per sample in each. "
            f"The file holds: {content.listing()}."
        )
    frame = pd.DataFrame(columns)
    frame.index = pd.RangeIndex(1, len(frame) + 1)  # as MATLAB counts
    return Table(file.title, "row", frame, file.run)


def table_of_vectors(file: BinaryFile) -> Table:
    """All vectors of the commonest length, where nobody said which are looked for.

    Of a matrix these are its columns, or its rows where it is wider than high.

    Args:
        file: A MATLAB file of version 4 to 7.

    Raises:
        DataError: This is no such file, or no vector in it has two numbers; with the
            names and sizes of what it holds.
    """
    import pandas as pd

    content = _Content.of(file)
    vectors = content.vectors()
    n_rows = _commonest_length(vectors)
    if n_rows < 2:
        raise DataError(
            f"{file.title} holds no column of numbers: no vector, and no matrix of few "
            f"columns, has 2 numbers or more. It holds: {content.listing()}."
        )
    frame = pd.DataFrame({name: v for name, v in vectors.items() if len(v) == n_rows})
    frame.index = pd.RangeIndex(1, n_rows + 1)
    further = tuple(_further(content, n_rows))
    return Table(file.title, "row", frame, file.run, further=further)


def _further(content: "_Content", n_rows: int) -> Iterator[Variable]:
    """What is no column of so many rows."""
    for name, matrix in content.matrices.items():
        if n_rows not in [len(vector) for vector in _vectors_of(name, matrix).values()]:
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


def _commonest_length(vectors: Mapping[str, np.ndarray]) -> int:
    """Of lengths that are equally common, the largest; 0 where there is none."""
    lengths = [len(vector) for vector in vectors.values()]
    return max(lengths, key=lambda length: (lengths.count(length), length), default=0)


@dataclass(frozen=True, eq=False)
class _Content:
    """What a file holds.

    Attributes:
        title: What messages call the file.
        matrices: The numbers (n_rows, n_columns), by name; fields as "struct.field".
        others: What cannot be read, in words.
    """

    title: str
    matrices: Mapping[str, np.ndarray]
    others: Mapping[str, str]

    @classmethod
    def of(cls, file: BinaryFile) -> "_Content":
        matrices = {}
        others = {}
        for name, value in mat_variables(file).items():
            said = _why_not_read(value)
            if said:
                others[name] = said
            else:
                matrices[name] = value
        return cls(file.title, matrices, others)

    def column(self, name: Any) -> np.ndarray:
        if not isinstance(name, str):
            raise DataError(
                f"{self.title}: the column {name!r} is no name; expected text, as in "
                f"MATLAB. The file holds: {self.listing()}."
            )
        indexed = INDEXED.fullmatch(name)
        if indexed is not None:
            return self._indexed(name, indexed)
        matrix = self.matrices[self._full_name(name)]
        if 1 not in matrix.shape:
            raise DataError(
                f"{self.title}: {name!r} is a matrix of {_size(matrix)}; "
                f"choose one of its columns or rows, such as '{name}(:,1)' or "
                f"'{name}(1,:)'."
            )
        return matrix.ravel()

    def vectors(self) -> dict[str, np.ndarray]:
        """All columns that a table could have, (n_rows,) each."""
        found = {}
        for name, matrix in self.matrices.items():
            found.update(_vectors_of(name, matrix))
        return found

    def _indexed(self, name: str, indexed: re.Match[str]) -> np.ndarray:
        matrix = self.matrices[self._full_name(indexed["name"])]
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

    def _full_name(self, name: str) -> str:
        """The name with its struct."""
        if name in self.matrices:
            return name
        fields = [known for known in self.matrices if known.endswith(f".{name}")]
        if len(fields) == 1:
            return fields[0]
        if fields:
            raise DataError(
                f"{self.title}: {name!r} is a field of several structs; "
                f"say which one of {fields}."
            )
        said = f"{self.title} has no column {name!r}"
        if name in self.others:
            said = f"{self.title}: {name!r} is {self.others[name]}"
        hint = did_you_mean(name, list(self.matrices))
        raise DataError(f"{said}. The file holds: {self.listing()}.{hint}")

    def listing(self) -> str:
        """All that is in the file, in words."""
        listed = []
        for name, matrix in self.matrices.items():
            listed.append(f"{name!r} ({_size(matrix)})")
        for name, said in self.others.items():
            listed.append(f"{name!r} ({said})")
        return ", ".join(listed) or "nothing"


def _why_not_read(value: np.ndarray) -> str:
    """What a value is, where it is no matrix of numbers; "" for such."""
    if value.dtype.kind == "U":
        return str(value)
    if value.ndim != 2:
        return f"an array with {value.ndim} axes, which is not read"
    return "" if value.size else "empty"


def _size(matrix: np.ndarray) -> str:
    if matrix.size == 1:
        return "one number"
    if 1 in matrix.shape:
        return f"{matrix.size} numbers"
    return f"{matrix.shape[0]} x {matrix.shape[1]} numbers"

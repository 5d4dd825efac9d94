"""The bytes of MATLAB files of version 4 and 5 to 7: matrices of numbers, and structs.

Read here and not by `scipy.io.loadmat`, whose compiled reader trusts the sizes that a
file states: a damaged file can end the process. Here every size is checked before the
bytes behind it are taken. Texts, cells, sparse matrices, tables and objects are named
and passed over.

The format: https://www.mathworks.com/help/pdf_doc/matlab/matfile_format.pdf
"""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from phsi_opt.reading import LARGEST_FILE

HEADER_BYTES = 128
HDF5_MARK = b"\x89HDF"
MOST_VARIABLES = 10_000  # in a file, with the fields of structs
MOST_AXES = 64  # as NumPy has

COMPRESSED = 15
MATRIX = 14
# The types of stored numbers, by the numbers of the format.
STORED_TYPES = {
    **{1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4"},
    **{7: "f4", 9: "f8", 12: "i8", 13: "u8"},
}
STRUCT_CLASS = 2
OPAQUE = 17  # tables, texts in double quotes, objects of new classes
NUMBER_CLASSES = range(6, 16)  # classes of matrices of numbers, double to uint64
OTHER_CLASSES = {
    1: "cells, which are not read; see writetable",
    3: "an object, which is not read; see writetable",
    4: "text",
    5: "a sparse matrix, which is not read; see full",
    16: "a function handle, which is not read",
    OPAQUE: "a table or an object, which is not read; see writetable",
}
IN_STRUCT = "a list of structs or a struct in a struct, which is not read"
TWICE = "there twice, which is not read; rename one of the two"
STORED_V4 = ("f8", "f4", "i4", "i2", "u2", "u1")
KINDS_V4 = {1: OTHER_CLASSES[4], 2: OTHER_CLASSES[5]}  # 0 is a matrix of numbers

# What a variable is: its numbers, its fields, or what it is in words.
Value = np.ndarray | dict[str, Any] | str


class FormatError(Exception):
    """The bytes are no MATLAB file, or a damaged one; the text says where."""


class Version73Error(FormatError):
    """This is a file of version 7.3, which is HDF5."""


def variables_in(content: bytes) -> dict[str, Value]:
    """The variables of a file, in its order.

    Args:
        content: All bytes of the file.

    Returns:
        By name: an array with two axes or more; a struct as the mapping of its fields;
        of all else what it is, in words.

    Raises:
        FormatError: These bytes are no such file, or a damaged one.
    """
    if content.startswith(HDF5_MARK):
        raise Version73Error
    if len(content) < 20:
        raise FormatError(f"it has {len(content)} bytes, which are too few")
    is_version_4 = 0 in content[:4]
    found = _variables_v4(content) if is_version_4 else _variables_v5(content)
    variables: dict[str, Value] = {}
    for name, value in found:
        variables[name] = TWICE if name in variables else value
        if len(variables) > MOST_VARIABLES:
            raise FormatError(f"it holds more than {MOST_VARIABLES} variables")
    return variables


# ---- version 5 to 7 ------------------------------------------------------------------


@dataclass
class _Bytes:
    """Bytes that are read from the first to the last.

    Attributes:
        content: All of them.
        order: "<" or ">", where numbers have their lowest byte first or last.
        what: They are part of it, for messages.
        place: Where the next one is.
    """

    content: memoryview
    order: str
    what: str
    place: int = 0

    @property
    def is_left(self) -> bool:
        return self.place < len(self.content)

    def take(self, n: int) -> memoryview:
        """The next n bytes."""
        n_left = len(self.content) - self.place
        if not 0 <= n <= n_left:
            raise FormatError(
                f"{self.what} states {n} bytes at byte {self.place}, where {n_left} "
                "are left; the file is cut or damaged"
            )
        taken = self.content[self.place : self.place + n]
        self.place += n
        return taken

    def numbers(self, kind: str, n: int) -> np.ndarray:
        """The next n numbers of a type, (n,)."""
        return self.decoded(kind, self.take(n * np.dtype(kind).itemsize))

    def decoded(self, kind: str, stored: memoryview) -> np.ndarray:
        """Bytes as numbers of a type, in this machine's order."""
        if len(stored) % np.dtype(kind).itemsize:
            raise FormatError(
                f"{self.what} has {len(stored)} bytes for numbers of "
                f"{np.dtype(kind).itemsize} bytes"
            )
        return np.frombuffer(stored, self.order + kind).astype(kind)

    def element(self) -> tuple[int, memoryview]:
        """The next element: the number of its type, and its bytes."""
        kind, size = struct.unpack(f"{self.order}II", self.take(8))
        if kind >> 16:  # a small one: its bytes stand in place of the size
            size = kind >> 16
            if size > 4:
                raise FormatError(f"{self.what} has a small element of {size} bytes")
            return kind & 0xFFFF, self.content[self.place - 4 : self.place - 4 + size]
        taken = self.take(size)
        if kind != COMPRESSED and self.is_left:
            self.take(min(-size % 8, len(self.content) - self.place))
        return kind, taken

    def text(self) -> str:
        """The next element as a name."""
        _, name = self.element()
        return bytes(name).decode("utf-8", errors="replace").rstrip("\0")

    def values(self) -> np.ndarray:
        """The next element as numbers, (n,)."""
        kind, stored = self.element()
        if kind not in STORED_TYPES:
            raise FormatError(f"{self.what} has numbers of an unknown type {kind}")
        return self.decoded(STORED_TYPES[kind], stored)

    def whole_numbers(self) -> list[int]:
        """The first of the next element's numbers, which must be whole."""
        values = self.values()
        if values.dtype.kind not in "iu":
            raise FormatError(f"{self.what} has fractions where its size should stand")
        numbers: list[int] = values[: MOST_AXES + 1].tolist()
        return numbers

    def of(self, content: memoryview, what: str) -> "_Bytes":
        """Other bytes of the same file."""
        return _Bytes(content, self.order, what)


def _variables_v5(content: bytes) -> Iterator[tuple[str, Value]]:
    file = _Bytes(memoryview(content), _order_of(content), "it")
    file.take(HEADER_BYTES)
    n_bytes = 0
    while file.is_left:
        kind, stored = file.element()
        if kind == COMPRESSED:
            opened = file.of(_decompressed(stored, LARGEST_FILE - n_bytes), "it")
            n_bytes += len(opened.content)
            kind, stored = opened.element()
        if kind != MATRIX:
            raise FormatError(f"it has an element of type {kind}, which is no variable")
        name, value = _variable(file.of(stored, "a variable"))
        if name:  # what has none belongs to MATLAB itself
            yield name, value


def _order_of(content: bytes) -> str:
    """The order of the bytes, as the header says."""
    if len(content) < HEADER_BYTES:
        raise FormatError(f"it has {len(content)} bytes, which are too few")
    mark = content[126:128]
    if mark not in (b"IM", b"MI"):
        raise FormatError("its first 128 bytes are no header of a MATLAB file")
    version = content[125] if mark == b"IM" else content[124]
    if version == 2:
        raise Version73Error
    if version != 1:
        raise FormatError(f"its version {version} is unknown")
    return "<" if mark == b"IM" else ">"


def _decompressed(stored: memoryview, most: int) -> memoryview:
    """The bytes of a compressed element."""
    reader = zlib.decompressobj()
    try:
        content = reader.decompress(stored, most + 1)
    except zlib.error as error:
        raise FormatError(f"a compressed variable is damaged: {error}") from None
    if len(content) > most:
        raise FormatError(
            f"it has more than {LARGEST_FILE / 1e6:g} MB when decompressed"
        )
    if not reader.eof:
        raise FormatError("a compressed variable is cut")
    return memoryview(content)


def _variable(part: _Bytes, is_field: bool = False) -> tuple[str, Value]:
    """The name of a matrix, and what it is."""
    flags = part.whole_numbers()
    if not flags:
        raise FormatError("a variable has no flags")
    kind = flags[0] & 0xFF
    if kind == OPAQUE:
        return part.text(), OTHER_CLASSES[OPAQUE]
    shape = _shape(part)
    name = part.text()
    part.what = f"the variable {name!r}"
    if kind in NUMBER_CLASSES:
        return name, _matrix(part, shape, is_complex=bool(flags[0] & 0x800))
    if kind != STRUCT_CLASS:
        if kind not in OTHER_CLASSES:
            raise FormatError(f"{part.what} is of an unknown class {kind}")
        return name, OTHER_CLASSES[kind]
    if is_field or shape != (1, 1):
        return name, IN_STRUCT
    return name, _fields(part)


def _shape(part: _Bytes) -> tuple[int, ...]:
    shape = tuple(part.whole_numbers())
    if not 2 <= len(shape) <= MOST_AXES or min(shape) < 0:
        raise FormatError(f"a variable states the size {shape}")
    return shape


def _matrix(part: _Bytes, shape: tuple[int, ...], is_complex: bool) -> np.ndarray:
    real = _shaped(part.values(), shape, part.what)
    if not is_complex:
        return real
    return real + 1j * _shaped(part.values(), shape, part.what)


def _shaped(values: np.ndarray, shape: tuple[int, ...], what: str) -> np.ndarray:
    """The numbers of a matrix, whose first index runs fastest."""
    if math.prod(shape) != len(values):
        size = " x ".join(map(str, shape))
        raise FormatError(f"{what} states {size} numbers and holds {len(values)}")
    return values.reshape(shape if values.size else (0, 0), order="F")


def _fields(part: _Bytes) -> dict[str, Value]:
    """The fields of a struct."""
    length = part.whole_numbers()
    names = bytes(part.element()[1])
    if len(length) != 1 or length[0] < 1 or len(names) % length[0]:
        raise FormatError(f"{part.what} has damaged names of fields")
    fields: dict[str, Value] = {}
    for begin in range(0, len(names), length[0]):
        name = names[begin : begin + length[0]].split(b"\0")[0]
        kind, stored = part.element()
        if kind != MATRIX:
            raise FormatError(f"{part.what} has a field that is no variable")
        if len(fields) >= MOST_VARIABLES:
            raise FormatError(f"{part.what} has more than {MOST_VARIABLES} fields")
        value: Value = np.zeros((0, 0))  # [] of a struct that is new
        if stored:
            _, value = _variable(part.of(stored, part.what), is_field=True)
        text = name.decode("utf-8", errors="replace")
        fields[text] = TWICE if text in fields else value
    return fields


# ---- version 4 -----------------------------------------------------------------------


def _variables_v4(content: bytes) -> Iterator[tuple[str, Value]]:
    order = "<" if struct.unpack("<i", content[:4])[0] in range(5000) else ">"
    file = _Bytes(memoryview(content), order, "it")
    while file.is_left:
        kind, *shape, is_complex, n_name = map(int, file.numbers("i4", 5))
        stored, contents = divmod(kind, 10)  # of a VAX or Cray, 200 and more
        if stored not in (*range(6), *range(100, 106)) or contents > 2:
            raise FormatError(f"a variable begins with {kind}, which is no type")
        if min(*shape, n_name) < 0:
            raise FormatError(f"a variable states the size {tuple(shape)}")
        name = bytes(file.take(n_name)).split(b"\0")[0].decode("latin-1")
        file.what = f"the variable {name!r}"
        parts = []
        for _ in range(2 if is_complex else 1):
            values = file.numbers(STORED_V4[stored % 100], math.prod(shape))
            parts.append(_shaped(values, tuple(shape), file.what))
        matrix = parts[0] + 1j * parts[1] if is_complex else parts[0]
        yield name, KINDS_V4.get(contents, matrix)

"""Read the numbers of HDF5 files, also of MATLAB 7.3, by h5py, in an own process.

As of `matlab_reader`: arrays with two axes, and texts that say of all else what it is.
Groups are structs: the dataset "y" of the group "log" is "log.y". MATLAB writes arrays
with the axes in reverse, and structs of a list as references to their fields. A link,
or a dataset that leads to another file, is not followed.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from phsi_opt.data.matlab_reader import UNREAD
from phsi_opt.reading import check_size

ELSEWHERE = "in another file, which is not read"
LINKED = "a link, which is not followed"


def read(
    content: Any, title: str, most: int
) -> tuple[list[tuple[str, str]], list[np.ndarray]]:
    """The names with their units, and the values.

    Raises:
        OSError: they are too large.
    """
    import h5py

    with h5py.File(content, "r") as file:
        found = list(_named(file, "", file))
        size = sum(getattr(one, "nbytes", 0) for _, one, _ in found)
        check_size(size, most, "when decompressed")
        names = [(name, unit) for name, _, unit in found]
        return names, [_array(one) for _, one, _ in found]


Named = Iterator[tuple[str, Any, str]]  # the name, a dataset or what it is, the unit


def _named(file: Any, name: str, one: Any) -> Named:
    """A dataset, or those of a group; what is not read as what it is."""
    import h5py

    if isinstance(one, h5py.Dataset):
        yield from _of_dataset(file, name, one)
    elif "MATLAB_sparse" in one.attrs or "MATLAB_object_decode" in one.attrs:
        yield name, UNREAD, ""
    else:
        for key in one:
            inner = f"{name}.{key}" if name else key
            if not isinstance(one.get(key, getlink=True), h5py.HardLink):
                yield inner, LINKED, ""
            elif not key.startswith("#"):  # what MATLAB refers to
                yield from _named(file, inner, one[key])


def _of_dataset(file: Any, name: str, one: Any) -> Named:
    import h5py

    kind = one.attrs.get("MATLAB_class", b"")
    told = np.ravel(one.attrs.get("unit", one.attrs.get("units", "")))
    unit = told[0] if told.size == 1 else ""
    unit = unit.decode(errors="replace") if isinstance(unit, bytes) else unit
    is_listed = h5py.check_ref_dtype(one.dtype) and kind != b"cell"
    if one.external or one.is_virtual:
        yield name, ELSEWHERE, ""
    elif is_listed and one.size <= 1000:  # the field of each struct of a list
        struct, _, key = name.rpartition(".")
        for number, place in enumerate(one[()].ravel(), 1):
            yield from _named(file, f"{struct}({number}).{key}", file[place])
    elif "MATLAB_object_decode" in one.attrs:
        yield name, UNREAD, ""
    elif one.dtype.names:
        for key in one.dtype.names:
            yield f"{name}.{key}" if name else key, one.fields(key), ""
    else:
        yield name, one, str(unit) if isinstance(unit, str) else ""


def _array(one: Any) -> np.ndarray:
    if isinstance(one, str):
        return np.array(one)
    values = np.asarray(one[()] if hasattr(one, "attrs") else one[:])
    kind = getattr(one, "attrs", {}).get("MATLAB_class", b"")
    if kind == b"char" or values.dtype.kind not in "biufc":
        return np.array("cells, which are not supported" if kind == b"cell" else "text")
    if "MATLAB_empty" in getattr(one, "attrs", {}):
        return np.array([])
    values = values.astype(values.dtype.newbyteorder("="), copy=False)
    if values.ndim < 2:
        return values.reshape(-1, 1)
    return values.T if kind else values

"""Read the numbers of MATLAB and HDF5 files, by SciPy and h5py, in an own process.

Files of MATLAB up to version 7 are read by SciPy; those of 7.3 are HDF5. Arrays are the
values of the variables: numbers as they are; a text says of all else what it is.
Structs, and groups of HDF5, are called as in MATLAB: the dataset "y" of the group "log"
is "log.y". In HDF5 MATLAB writes arrays with the axes in reverse, and structs of a list
as references to their fields. A link, or a dataset that leads to another file, is not
followed.
"""

import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.io.matlab import MatlabOpaque, loadmat

from phsi_opt.errors import shown
from phsi_opt.reading import check_size

UNREAD = (
    "a sparse matrix, a table or an object, which is not supported; convert it with "
    "full or writetable"
)
ELSEWHERE = "in another file, which is not read"
LINKED = "a link, which is not followed"
Named = Iterator[tuple[str, Any, str]]  # the name, its values or what it is, the unit


def read(
    content: Any, title: str, most: int, is_hdf5: bool
) -> tuple[list[tuple[str, str]], list[np.ndarray]]:
    """The names of the variables with their units, and the values."""
    if not is_hdf5:
        return _within(most, list(_in_matlab(content)))
    import h5py

    with h5py.File(content, "r") as file:
        return _within(most, list(_in_group(file, "", file)))


def _within(
    most: int, found: list[tuple[str, Any, str]]
) -> tuple[list[tuple[str, str]], list[np.ndarray]]:
    size = sum(getattr(one, "nbytes", 0) for _, one, _ in found)
    check_size(size, most, "when decompressed")
    names = [(name, unit) for name, _, unit in found]
    return names, [_array(one) for _, one, _ in found]


def _joined(name: str, key: str) -> str:
    return f"{name}.{key}" if name else key


# ---- of MATLAB up to version 7 -------------------------------------------------------


def _in_matlab(content: Any) -> Named:
    # SciPy calls each table "None": several are no duplicates, and get their names.
    lost = 'Duplicate variable name "(?!None")|Unreadable variable'
    warnings.filterwarnings("error", lost)
    variables: dict[str, tuple[str, Any, str]] = {}
    for name, value in loadmat(content).items():
        if isinstance(value, MatlabOpaque):
            name = str(value["s0"].item(), "latin-1")
        if not name.startswith("__"):
            variables |= {one[0]: one for one in _in_variable(name, value)}
    yield from variables.values()


def _in_variable(name: str, value: Any) -> Named:
    """A variable, or the fields of its structs: "log.y", "log.Y(3).Data"."""
    is_struct = isinstance(value, np.ndarray) and value.dtype.names is not None
    if isinstance(value, MatlabOpaque) or not is_struct or not value.size:
        yield name, _numbers_or_words(value), ""
        return
    if value.size > 1000:  # a recording has one for each signal
        yield name, f"a list of {value.size} structs, which is not supported", ""
        return
    for place, struct in enumerate(value.ravel(order="F"), 1):
        own_name = name if value.size == 1 else f"{name}({place})"
        for field in value.dtype.names:
            yield from _in_variable(f"{own_name}.{field}", struct[field])


def _numbers_or_words(value: Any) -> Any:
    array = np.asarray(value)
    if isinstance(value, MatlabOpaque) or type(value).__module__.startswith("scipy."):
        return UNREAD
    if array.dtype.kind in "biufc":
        return array
    if array.dtype.kind in "US":
        return f"the text {shown(str(array.item()))}" if array.size == 1 else "text"
    if not array.size:
        return np.array([])
    return "cells, which are not supported; convert them with writetable"


# ---- of HDF5 -------------------------------------------------------------------------


def _in_group(file: Any, name: str, one: Any) -> Named:
    """A dataset, or those of a group; what is not read as what it is."""
    import h5py

    if isinstance(one, h5py.Dataset):
        yield from _in_dataset(file, name, one)
    elif "MATLAB_sparse" in one.attrs or "MATLAB_object_decode" in one.attrs:
        yield name, UNREAD, ""
    else:
        for key in one:
            inner = _joined(name, key)
            if not isinstance(one.get(key, getlink=True), h5py.HardLink):
                yield inner, LINKED, ""
            elif not key.startswith("#"):  # what MATLAB refers to
                yield from _in_group(file, inner, one[key])


def _in_dataset(file: Any, name: str, one: Any) -> Named:
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
            yield from _in_group(file, f"{struct}({number}).{key}", file[place])
    elif "MATLAB_object_decode" in one.attrs:
        yield name, UNREAD, ""
    elif one.dtype.names:
        for key in one.dtype.names:
            yield _joined(name, key), one.fields(key), ""
    else:
        yield name, one, str(unit) if isinstance(unit, str) else ""


def _array(one: Any) -> np.ndarray:
    """Values, or the text of what they are."""
    if isinstance(one, str):
        return np.array(one)
    attributes = getattr(one, "attrs", {})  # of a dataset
    values = np.asarray(one[()] if hasattr(one, "attrs") else one[:])
    kind = attributes.get("MATLAB_class", b"")
    if kind == b"char" or values.dtype.kind not in "biufc":
        return np.array("cells, which are not supported" if kind == b"cell" else "text")
    if "MATLAB_empty" in attributes:
        return np.array([])
    values = values.astype(values.dtype.newbyteorder("="), copy=False)
    if values.ndim < 2:
        return values.reshape(-1, 1)
    return values.T if kind else values

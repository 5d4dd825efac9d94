"""Read the variables of a MATLAB file up to version 7, by SciPy, in an own process.

The arrays are the values of the variables: numbers as they are; a text says of all else
what it is.
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
Named = Iterator[tuple[str, np.ndarray]]


def read(
    content: Any, title: str, most: int
) -> tuple[list[tuple[str, str]], list[np.ndarray]]:
    """The names of the variables, each with its unit, which is "", and the values.

    Raises:
        OSError: they are too large.
    """
    # SciPy calls each table "None": several are no duplicates. `_named` names them.
    lost = 'Duplicate variable name "(?!None")|Unreadable variable'
    warnings.filterwarnings("error", lost)
    loaded = loadmat(content)
    variables: dict[str, np.ndarray] = {}
    for name, value in loaded.items():
        if isinstance(value, MatlabOpaque):
            name = str(value["s0"].item(), "latin-1")
        if not name.startswith("__"):
            variables |= _named(name, value)
    size = sum(value.nbytes for value in variables.values())
    check_size(size, most, "when decompressed")
    return [(name, "") for name in variables], list(variables.values())


def _named(name: str, value: Any) -> Named:
    """A variable, or the fields of its structs: "log.y", "log.Y(3).Data"."""
    is_struct = isinstance(value, np.ndarray) and value.dtype.names is not None
    if isinstance(value, MatlabOpaque) or not is_struct or not value.size:
        yield name, _numbers_or_words(value)
        return
    if value.size > 1000:  # a recording has one for each signal
        yield name, np.array(f"a list of {value.size} structs, which is not supported")
        return
    for place, struct in enumerate(value.ravel(order="F"), 1):
        own_name = name if value.size == 1 else f"{name}({place})"
        for field in value.dtype.names:
            yield from _named(f"{own_name}.{field}", struct[field])


def _numbers_or_words(value: Any) -> np.ndarray:
    array = np.asarray(value)
    if isinstance(value, MatlabOpaque) or type(value).__module__.startswith("scipy."):
        return np.array(UNREAD)
    if array.dtype.kind in "biufc":
        return array.astype(array.dtype.newbyteorder("="), copy=False)
    if array.dtype.kind in "US":
        return np.array(
            f"the text {shown(str(array.item()))}" if array.size == 1 else "text"
        )
    if not array.size:
        return np.array([])
    return np.array("cells, which are not supported; convert them with writetable")

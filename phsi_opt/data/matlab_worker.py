"""A script: the variables of the MATLAB file at its standard input, as .npz.

`matlab_tables` starts it. It imports NumPy and SciPy alone, so that it starts fast. The
first array holds the names of the variables, the others hold their values: numbers as
they are; a text says of all else what it is.
"""

import sys
import warnings
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
from scipy.io.matlab import MatlabOpaque, loadmat

UNREAD = (
    "a sparse matrix, a table or an object, which is not supported; convert it with "
    "full or writetable"
)


def main(most: int) -> None:
    """Read a file whose numbers have at most so many bytes; say why it cannot be."""
    with suppress(ImportError, ValueError, OSError):  # where the system can
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        most_memory = 3_000_000_000  # bytes; a file of 500 MB takes less than half
        resource.setrlimit(resource.RLIMIT_AS, (most_memory, most_memory))
    # SciPy calls each table "None": several are no duplicates. `_named` names them.
    lost = 'Duplicate variable name "(?!None")|Unreadable variable'
    warnings.filterwarnings("error", lost)
    try:
        loaded = loadmat(sys.stdin.buffer)
        variables = dict(_named(loaded))
    except NotImplementedError:
        sys.exit("it is a MATLAB file of version 7.3 (HDF5), which is not supported")
    except Exception as error:
        said = " ".join(f"{type(error).__name__}: {error}".split())
        sys.exit(f"it is not a MATLAB file, or it is damaged ({said})")
    if sum(value.nbytes for value in variables.values()) > most:
        sys.exit(f"it has more than {most / 1e6:g} MB when decompressed")
    np.savez(sys.stdout.buffer, np.array(list(variables), str), *variables.values())


def _named(loaded: dict[str, Any]) -> Iterator[tuple[str, np.ndarray]]:
    """The variables, and the fields of structs as "struct.field"."""
    for name, value in loaded.items():
        if isinstance(value, MatlabOpaque):
            yield str(value["s0"].item(), "latin-1"), np.array(UNREAD)
        elif isinstance(value, np.ndarray) and value.dtype.names and value.size == 1:
            for field in value.dtype.names:
                yield f"{name}.{field}", _numbers_or_words(value[field].item())
        elif not name.startswith("__"):
            yield name, _numbers_or_words(value)


def _numbers_or_words(value: Any) -> np.ndarray:
    array = np.asarray(value)
    if isinstance(value, MatlabOpaque) or type(value).__module__.startswith("scipy."):
        return np.array(UNREAD)
    if array.dtype.names:
        return np.array(
            "a list of structs or a struct in a struct, which is not supported"
        )
    if array.dtype.kind in "biufc":
        return array.astype(array.dtype.newbyteorder("="), copy=False)
    is_text = array.dtype.kind in "US"
    return np.array(
        "text"
        if is_text
        else "cells, which are not supported; convert them with writetable"
    )


if __name__ == "__main__":
    main(int(sys.argv[1]))

"""A script: the variables of the MATLAB file at its standard input, as .npz.

`matlab_process` starts it. It imports NumPy and SciPy alone, so that it starts fast.
The first array holds the names of the variables, the others hold their values: numbers
as they are; a text says of all else what it is.
"""

import sys
import warnings
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
from scipy.io.matlab import MatlabOpaque, loadmat

MOST_MEMORY = 3_000_000_000  # bytes of addresses; a file of 500 MB takes less than half
KINDS_OF_NUMBERS = "biufc"  # the kinds of NumPy's types that hold numbers


def main(most: int) -> None:
    """Read a file whose numbers have at most so many bytes; say why it cannot be."""
    _limit_resources()
    # SciPy calls each table "None": several are no duplicates. `_named` names them.
    lost = 'Duplicate variable name "(?!None")|Unreadable variable'
    warnings.filterwarnings("error", lost)
    try:
        variables = dict(_named(loadmat(sys.stdin.buffer)))
    except NotImplementedError:
        sys.exit("it is a MATLAB file of version 7.3 (HDF5), which is not read")
    except Exception as error:
        said = " ".join(f"{type(error).__name__}: {error}".split())
        sys.exit(f"it is no MATLAB file, or a damaged one ({said})")
    if sum(value.nbytes for value in variables.values()) > most:
        sys.exit(f"it has more than {most / 1e6:g} MB when decompressed")
    np.savez(sys.stdout.buffer, np.array(list(variables), str), *variables.values())


def _limit_resources() -> None:
    """Bound the memory and write no core file, where the system can."""
    with suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))


def _named(loaded: dict[str, Any]) -> Iterator[tuple[str, np.ndarray]]:
    """The variables, and the fields of structs as "struct.field"."""
    for name, value in loaded.items():
        if name.startswith("__"):
            continue
        if isinstance(value, MatlabOpaque):
            yield str(value["s0"].item(), "latin-1"), _numbers_or_words(value)
        elif type(value) is np.ndarray and value.dtype.names and value.size == 1:
            for field in value.dtype.names:
                yield f"{name}.{field}", _numbers_or_words(value[field].item())
        else:
            yield name, _numbers_or_words(value)


def _numbers_or_words(value: Any) -> np.ndarray:
    if type(value) is not np.ndarray:
        said = "a sparse matrix, a table or an object, which is not read; see full and "
        return np.array(said + "writetable")
    if value.dtype.names:
        return np.array("a list of structs or a struct in a struct, which is not read")
    if value.dtype.kind in KINDS_OF_NUMBERS:
        return value.astype(value.dtype.newbyteorder("="), copy=False)
    is_text = value.dtype.kind in "US"
    return np.array("text" if is_text else "cells, which are not read; see writetable")


if __name__ == "__main__":
    main(int(sys.argv[1]))

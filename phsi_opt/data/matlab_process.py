"""MATLAB files, read by SciPy in a process of its own.

SciPy's compiled reader trusts the sizes that a file states. A damaged file can crash
the process that reads it, or fill its memory: `matlab_worker` is what may crash.
"""

import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import numpy as np

from phsi_opt import reading
from phsi_opt.data.file_opening import BinaryFile
from phsi_opt.errors import DataError

WORKER = Path(__file__).with_name("matlab_worker.py")
TIME_LIMIT = 120.0  # seconds; a file of 500 MB takes about 5
REPAIR = (
    "Save it again in MATLAB by save(name, '-v7'), or write the table as CSV by "
    "writetable or writematrix."
)


def mat_variables(file: BinaryFile) -> dict[str, np.ndarray]:
    """The variables of a file, in its order; fields of structs as "struct.field".

    Args:
        file: A MATLAB file of version 4 to 7.

    Returns:
        By name: the numbers, (n_rows, n_columns) or with more axes; of all else an
        array of one text, which says what it is.

    Raises:
        DataError: This is no such file, or a damaged one.
    """
    if getattr(sys, "frozen", False) or not sys.executable:
        why = "that needs a Python interpreter, and this program is without one"
        raise DataError(f"{file.title} cannot be read: {why}. {REPAIR}")
    try:
        with TemporaryFile() as content, TemporaryFile() as arrays:
            content.write(file.content)
            content.seek(0)
            why = _why_not_read(content.fileno(), arrays.fileno())
            if not why:
                return _variables(arrays)
    except OSError as error:
        why = reading.why_not_read(error)
    raise DataError(f"{file.title} cannot be read: {why}. {REPAIR}")


def _why_not_read(content: int, arrays: int) -> str:
    """Let the worker read from one open file into another; "" where it could."""
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


def _variables(arrays: IO[bytes]) -> dict[str, np.ndarray]:
    arrays.seek(0)
    with np.load(arrays, allow_pickle=False) as found:
        names, *values = (found[key] for key in found.files)
    return dict(zip(names.tolist(), values, strict=True))

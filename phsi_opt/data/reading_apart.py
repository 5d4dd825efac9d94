"""Binary files are parsed in a process of their own: time, memory and size are bounded.

The parsers of other projects trust what a file states, and some execute what it says: a
damaged file can crash the process that reads it, fill its memory or never end. So a
script, `reader_script`, lets one of the readers read the file. The file, the answer and
all else that a parser writes lie in a folder of their own. An answer consists of plain
data (JSON, dates marked as such) and of arrays (.npz without pickled objects). Answers
are kept, since the page reads the same files at every check.
"""

import datetime as dt
import hashlib
import io
import json
import os
import signal
import subprocess
import sys
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from phsi_opt import reading
from phsi_opt.data.file_opening import OpenedFile
from phsi_opt.errors import DataError, shown

SCRIPT = Path(__file__).with_name("reader_script.py")
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMEXPR_MAX_THREADS")
DATES: dict[str, Any] = {
    "datetime": dt.datetime.fromisoformat,
    "date": dt.date.fromisoformat,
    "time": dt.time.fromisoformat,
    "timedelta": lambda written: dt.timedelta(microseconds=int(written)),
}


@dataclass(frozen=True)
class Limits:
    """What the reading of files may take, of one at a time."""

    seconds: float = 120.0  # of processor time; a file of 500 MB takes about 10
    wait: float = 600.0  # seconds by the clock: a machine may be busy
    memory: int = 3_000_000_000  # bytes; a file of 500 MB takes less than half
    kept: int = 100_000_000  # bytes of all answers that are kept


READING_LIMITS = Limits()
# Plain data and arrays as they were written, the latest last, by the digest of what was
# asked and of the file.
_kept: dict[bytes, tuple[bytes, bytes]] = {}


def read_apart(
    file: OpenedFile, reader: str, repair: str, **asked: Any
) -> tuple[Any, list[np.ndarray]]:
    """The answer of a reader: plain data, and arrays.

    Args:
        file: what is read.
        reader: the module whose function ``read`` reads it.
        repair: what to do about a file that cannot be read, as a sentence.
        **asked: further arguments of the reader.
    """
    asked |= {"title": file.title, "most": reading.LARGEST_FILE}
    question = {"reader": reader, "asked": asked, "limits": asdict(READING_LIMITS)}
    request = json.dumps(question, default=shown).encode()
    digest = hashlib.sha256(request)
    digest.update(file.content)
    key = digest.digest()
    try:
        written = _kept.pop(key, None) or _written(file.content, request)
        answer = _answer(*written)
        why = answer["why"]
    except OSError as error:
        why = reading.why_not_read(error)
    if why:
        raise DataError(f"{file.title} cannot be read: {why}. {repair}")
    if "message" in answer:
        raise DataError(answer["message"])
    _kept[key] = written
    while sum(map(len, chain(*_kept.values()))) > READING_LIMITS.kept:
        _kept.pop(next(iter(_kept)))
    return answer["content"], answer["arrays"]


def _written(content: bytes, request: bytes) -> tuple[bytes, bytes]:
    """The answer of the script: plain data, and arrays where it gives some."""
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        Path(folder, "content").write_bytes(content)
        why = _why_not(_run(folder, request))
        if why:
            raise OSError(why)
        plain = Path(folder, "answer.json")
        arrays = Path(folder, "arrays.npz")
        return plain.read_bytes(), arrays.read_bytes() if arrays.exists() else b""


def _run(folder: str, request: bytes) -> int | None:
    """Let the script read; the code with which it ends, None where it has no end."""
    if getattr(sys, "frozen", False) or not sys.executable:
        raise OSError(
            "this needs a Python interpreter, which this program does not have"
        )
    places = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), folder)
    try:
        run = subprocess.run(
            [sys.executable, "-P", "-X", "utf8", str(SCRIPT)],
            input=request,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=READING_LIMITS.wait,
            cwd=folder,
            # Threads of the libraries would take memory.
            env=os.environ | places | dict.fromkeys(THREADS, "1"),
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    except subprocess.TimeoutExpired:
        return None
    return run.returncode


def _why_not(code: int | None) -> str:
    """Why the script gave no answer, in words; "" where it gave one."""
    out_of_time = -getattr(signal, "SIGXCPU", 0)
    if code is None or (code and code == out_of_time):
        time = f"{READING_LIMITS.wait if code is None else READING_LIMITS.seconds:g} s"
        return f"it is damaged or too large: it was not read in {time}"
    return f"it is damaged: the reader ended with exit code {code}" if code else ""


def _answer(plain: bytes, written: bytes) -> dict[str, Any]:
    try:
        answer: dict[str, Any] = json.loads(plain, object_hook=_dates)
        if "content" in answer:
            with np.load(io.BytesIO(written), allow_pickle=False) as arrays:
                answer["arrays"] = [arrays[name] for name in arrays.files]
    except ValueError as error:
        raise OSError(
            f"it is damaged: the reader's answer is, too ({error})"
        ) from error
    return answer


def _dates(found: dict[str, Any]) -> Any:
    """The date that a mark of the script stands for; other data as they are."""
    if found.keys() == {"kind", "written"}:
        return DATES[found["kind"]](found["written"])
    return found

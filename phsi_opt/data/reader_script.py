"""A script, started by `reading_apart`: it lets a reader read the file "content".

A reader is a module with the function ``read(content, title, most, ...)``: the open
file, what messages call it, and the bytes that its content may have. It returns plain
data and arrays, or raises an `OSError` that says why the file cannot be read, or a
`DataError` with the whole message. The script imports nothing from the folder in which
it lies; phsi_opt is the package that started it.
"""

import datetime as dt
import json
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np


def main() -> None:
    """Read the request at the standard input, and write the answer."""
    request = json.load(sys.stdin)
    limits = request["limits"]
    _limit(**limits)
    package = ModuleType("phsi_opt")
    package.__path__ = [str(Path(__file__).parents[1])]
    sys.modules["phsi_opt"] = package
    try:
        content, arrays = _read(request["reader"], request["asked"])
        np.savez("arrays.npz", *arrays)
        written = json.dumps({"why": "", "content": content}, default=_marked)
    except MemoryError:
        why = f"it needs more than {limits['memory'] / 1e9:g} GB of memory"
        written = json.dumps({"why": why})
    except import_module("phsi_opt.errors").DataError as error:
        written = json.dumps({"why": "", "message": str(error)})
    except OSError as error:
        written = json.dumps({"why": str(error)})
    except Exception as error:  # the libraries promise no classes of their errors
        said = " ".join(f"{type(error).__name__}: {error}".split())
        why = f"it is of another kind, or it is damaged ({said[:200]})"
        written = json.dumps({"why": why})
    Path("answer.json").write_text(written, encoding="utf-8")


def _read(reader: str, asked: dict[str, Any]) -> tuple[Any, list[np.ndarray]]:
    with open("content", "rb") as content:
        module: Any = import_module(f"phsi_opt.data.{reader}")
        answer: tuple[Any, list[np.ndarray]] = module.read(content, **asked)
        return answer


def _limit(seconds: float, memory: int, **_: Any) -> None:
    try:
        import resource
    except ImportError:  # Windows: the time is bounded by who started this
        return
    bounds = {"CORE": 0, "CPU": int(seconds), "AS": memory, "FSIZE": memory}
    for name, most in bounds.items():
        with suppress(AttributeError, ValueError, OSError):
            number = getattr(resource, f"RLIMIT_{name}")
            resource.setrlimit(number, (most, most + 1))


def _marked(cell: Any) -> dict[str, Any]:
    """A date and its kind; no other object is met."""
    if isinstance(cell, dt.timedelta):
        written = cell // dt.timedelta(microseconds=1)
    else:
        written = cell.isoformat()
    return {"kind": type(cell).__name__, "written": written}


if __name__ == "__main__":
    main()

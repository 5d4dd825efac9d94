"""What the benchmarks of running programs share: a driven spring and its records,
programs in folders of their own, and attempts at moments drawn by a seed.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TypeVar

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.benchmarks import chains
from problems.tools.provenance import ROOT

T = TypeVar("T")
Row = Mapping[str, object]
COMMAND = ("-m", "phsi_opt.command_line")
EXAMPLE = Path(str(files("phsi_opt.study_file") / "examples" / "spring"))
MODEL = chains.driven(1)


def record(seed: int = 0, n: int = 400, is_complete: bool = False) -> ph.Measurements:
    """The position (or both states) of a driven spring with dry friction."""
    return chains.driven_data(1, n, seed, is_complete)


def rmse_of_seed(seed: int) -> float:
    """One case of a sweep."""
    data = record(seed)
    return ph.compare(ph.identify(MODEL, data), data).rmse


def begun(arguments: Sequence[str], folder: Path) -> "subprocess.Popen[str]":
    """Python with arguments in another folder, in a group of processes of its own."""
    path = f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    return subprocess.Popen(
        [sys.executable, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def attempts(
    name: str,
    attempt: Callable[[float], T | None],
    longest: float,
    each: int,
    rng: np.random.Generator,
) -> tuple[list[T], int, int]:
    """What ``each`` attempts gave that came up to ``longest`` s after the start; of how
    many all was over before (they gave None); how many raised, and were wrong.
    """
    found: list[T] = []
    n_late = n_wrong = 0
    while len(found) + n_wrong < each and n_late < 5 * each:
        delay = rng.uniform(0.0, longest)
        try:
            one = attempt(delay)
        except Exception as error:
            print(f"{name}, after {delay:.2f} s: {error!r}", flush=True)
            n_wrong += 1
            continue
        n_late += one is None
        found += [] if one is None else [one]
    return found, n_late, n_wrong


def collected(rows: Iterable[Row]) -> pd.DataFrame:
    """The rows as a table, each printed when it is there."""
    found = []
    for row in rows:
        print(row, flush=True)
        found.append(row)
    return pd.DataFrame(found)

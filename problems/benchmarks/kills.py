"""What is left when a process is killed while it writes: 100 kills, drawn by a seed.

    python -m problems.benchmarks.kills

Saves, reports and the cache are written again and again by a process that is killed in
the middle; commands and sweeps are killed between their start and their end. Then what
was there before must be whole, the same work is done once more and must end well, and
no hidden file may be left. Results: results/kills.md.
"""

import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.study_file.kept_fits import KeptFits
from problems.benchmarks.stress import (
    COMMAND,
    EXAMPLE,
    MODEL,
    Row,
    attempts,
    begun,
    collected,
    record,
    rmse_of_seed,
)
from problems.tools import provenance
from problems.tools.command_line import option
from problems.tools.pages import render

PATIENCE = 120.0  # s for what is begun again
SEEDS = {f"seed {seed}": seed for seed in range(4)}
Check = Callable[[Path], None]


@dataclass(frozen=True)
class Killed:
    """Work that is killed, and what must be so afterwards.

    Args:
        name: in the table.
        start: begins the work in a folder; the kill is for the whole group.
        longest: seconds after the start until the kill, at most.
        again: does the work again, to its end.
        check: raises where something is lost or half written.
    """

    name: str
    start: Callable[[Path], int]
    longest: float
    again: Check
    check: Check


def forked(work: Check, folder: Path) -> int:
    """A copy of this process that does a work again and again."""
    pid = os.fork()
    if pid == 0:
        try:
            while True:
                work(folder)
        finally:
            os._exit(1)
    os.setpgid(pid, pid)
    return pid


def started(arguments: Sequence[str], folder: Path) -> int:
    """The number of a program that has begun."""
    return begun(arguments, folder).pid


def done(arguments: Sequence[str], folder: Path) -> None:
    """The same program, to its end."""
    process = begun(arguments, folder)
    try:
        _, said = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()  # if it goes on
    assert process.returncode == 0, said[-500:]


def swept(folder: Path) -> None:
    """A sweep that goes on where a folder has results."""
    found = {one.key: one for one in ph.sweep(rmse_of_seed, SEEDS, folder=folder / "s")}
    assert sorted(found) == list(SEEDS)


def kept_results_are_whole(folder: Path) -> None:
    """Each file of the sweep is a whole result."""
    for path in (folder / "s").glob("*.json"):
        assert pd.read_json(path, typ="series")["format"].startswith("phsi_opt sweep")


def study_file_is_whole(folder: Path) -> None:
    """The user's text and comments, with or without the effect; backups are earlier."""
    before = (EXAMPLE / "study.toml").read_text("utf-8")
    for path in folder.glob("study.toml*"):
        if path.suffix != ".cache":
            lines = path.read_text("utf-8").splitlines()
            own = [line for line in lines if not line.startswith("added")]
            assert own == [
                line for line in before.splitlines() if not line.startswith("added")
            ]
            ph.StudyFile.read(shutil.copy(path, folder / "copy.toml"))


def add_again(folder: Path) -> None:
    """The effect is added unless it is there already."""
    if "coulomb" not in (folder / "study.toml").read_text("utf-8"):
        done([*COMMAND, "add", "coulomb friction", "-e", "p"], folder)
    assert "coulomb" in (folder / "study.toml").read_text("utf-8")


SWEEP = ("-m", "problems.benchmarks.kills", "--sweep")
STUDY = (*COMMAND, "study", "--save", "fit.json", "--report", "report.html")


def works() -> Iterator[Killed]:
    """What is killed."""
    fit = ph.identify(MODEL, record())
    study = ph.Study(MODEL, record())
    study.diagnose()

    def save(folder: Path) -> None:
        fit.save(folder / "fit.json")

    def load(folder: Path) -> None:
        assert ph.Fit.load(folder / "fit.json").values == fit.values

    def report(folder: Path) -> None:
        study.report(folder / "report.html")

    def report_is_whole(folder: Path) -> None:
        assert (folder / "report.html").read_text("utf-8").rstrip().endswith("</html>")

    def cache(folder: Path) -> None:
        KeptFits(folder / "study.toml.cache", "key").keep(study)
        # written anew the next time
        KeptFits(folder / "study.toml.cache", "another key").keep(study)

    def cache_is_whole(folder: Path) -> None:
        digest, text, end = (folder / "study.toml.cache").read_text().split("\n")
        assert digest and text.endswith("}") and end == ""

    def fit_files(folder: Path) -> None:
        study_file_is_whole(folder)
        if (folder / "fit.json").exists():
            ph.Fit.load(folder / "fit.json")
        if (folder / "report.html").exists():
            report_is_whole(folder)

    yield Killed("save of a fit", partial(forked, save), 0.3, save, load)
    yield Killed("report", partial(forked, report), 1.0, report, report_is_whole)
    yield Killed("cache", partial(forked, cache), 1.0, cache, cache_is_whole)
    yield Killed(
        "sweep with a folder",
        partial(started, SWEEP),
        10.0,
        partial(done, SWEEP),
        kept_results_are_whole,
    )
    add = (*COMMAND, "add", "coulomb friction", "-e", "p")
    yield Killed(
        "phsi-opt add", partial(started, add), 2.5, add_again, study_file_is_whole
    )
    yield Killed(
        "phsi-opt study", partial(started, STUDY), 6.0, partial(done, STUDY), fit_files
    )


def kill(work: Killed, delay: float) -> int | None:
    """How many parts a work left that was killed after a time; None: it was done."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        shutil.copytree(EXAMPLE, folder, dirs_exist_ok=True)
        if work.longest <= 1.0:  # what is written again and again is there before
            work.again(folder)
        pid = work.start(folder)
        time.sleep(delay)
        ended, _ = os.waitpid(pid, os.WNOHANG)
        if not ended:
            os.killpg(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        n_parts = len(list(folder.rglob(".*")))
        work.check(folder)
        work.again(folder)
        work.check(folder)
        hidden = [one.name for one in folder.rglob(".*")]
        assert not hidden, hidden
        return None if ended else n_parts


def rows(each: int) -> Iterator[Row]:
    """Kill every work so often; one row each."""
    rng = np.random.default_rng(0)
    for work in works():
        attempt = partial(kill, work)
        parts, n_late, n_wrong = attempts(work.name, attempt, work.longest, each, rng)
        yield {
            "work": work.name,
            "kills": len(parts),
            "done before": n_late,
            "parts left by kills": sum(parts),
            "lost or not resumed": n_wrong,
        }


if __name__ == "__main__":
    if "--sweep" in sys.argv:
        swept(Path.cwd())
    else:
        multiprocessing.set_start_method("spawn")
        found = collected(rows(int(option("each", "18"))))
        page = render("benchmarks/pages/kills.md", rows=found)
        provenance.write("kills.md", page)

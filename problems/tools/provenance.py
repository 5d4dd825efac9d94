"""What every result says of itself: command, commit, duration, machine."""

import platform
import subprocess
import sys
import time
from functools import cache
from pathlib import Path

from phsi_opt.writing import write_whole

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "results"
BEGIN = time.monotonic()


def provenance(made_by: str = "", seconds: float | None = None) -> str:
    """One line for the head of a result, made by this process or by a given command.

    ``seconds`` are those of all cases, where this process may have found some of them
    done; None: those since it began.
    """
    system = f"{platform.system()} {platform.machine()}"
    machine = f"{system}, Python {platform.python_version()}"
    seconds = time.monotonic() - BEGIN if seconds is None else seconds
    made_by = f"command: {made_by or command()}; commit: {commit()}"
    return f"{made_by}; seconds: {seconds:.0f}; machine: {machine}"


def command() -> str:
    """The command line of this process as one would type it in the project's root."""
    script, *arguments = sys.argv
    return " ".join(["python", *_program(script), *map(_relative, arguments)])


def _program(script: str) -> list[str]:
    """``-m`` and the dotted name of a script of the project; another as given."""
    path = Path(script).resolve()
    if path.suffix != ".py" or not path.is_relative_to(ROOT):
        return [script]
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ["-m", ".".join(parts)]


def _relative(argument: str) -> str:
    """Paths inside the project from its root, any other argument as it was given."""
    path = Path(argument).resolve()
    if path.exists() and path.is_relative_to(ROOT):
        return str(path.relative_to(ROOT))
    return argument


@cache
def commit() -> str:
    """The commit in short, at the first call of a process, which runs on the code of
    then; unknown without git.
    """
    return (git("rev-parse", "--short", "HEAD") or "unknown").strip()


def git(*arguments: str) -> str | None:
    """What git prints of the project; None if it fails or is not there."""
    try:
        done = subprocess.run(
            ["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
        )
    except OSError:
        return None
    return done.stdout if done.returncode == 0 else None


def write(
    name: str, text: str, made_by: str = "", seconds: float | None = None
) -> Path:
    """Write a text result under results/; the last two as of `provenance`."""
    if sys.argv[0] == "-c":
        raise RuntimeError(
            f"results/{name} is written by a script of the project, not by python -c: "
            "run the script, so that the page names a command that makes it again."
        )
    path = RESULTS / name
    path.parent.mkdir(parents=True, exist_ok=True)
    head = provenance(made_by, seconds)
    return write_whole(path, f"<!-- {head} -->\n\n{text.rstrip()}\n")

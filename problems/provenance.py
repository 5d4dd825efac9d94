"""What every result says of itself: command, commit, machine."""

import platform
import subprocess
import sys
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "results"


def provenance() -> str:
    """One line for the head of a result."""
    command = " ".join(
        [
            "python",
            *[
                str(Path(a).resolve().relative_to(ROOT)) if Path(a).exists() else a
                for a in sys.argv
            ],
        ]
    )
    machine = (
        f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"
    )
    return f"command: {command}; commit: {commit()}; machine: {machine}"


@cache
def commit() -> str:
    """The commit in short, at the first call of a process, which runs on the code of
    then; unknown without git.
    """
    try:
        run = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
    except OSError:
        return "unknown"
    return run.stdout.strip() or "unknown"


def write(name: str, text: str) -> Path:
    """Write a text result under results/."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / name
    path.write_text(f"<!-- {provenance()} -->\n\n{text.rstrip()}\n", encoding="utf-8")
    return path

"""Processor time of commands, and that of importing the libraries they are built on.

    python -m problems.benchmarks.command_line [--quick]

Each command runs several times in a folder with the files of the demonstration; the
shortest time counts, user and system, with all processes that it starts. A busy machine
makes all times longer, so that their ratio to the import is what to compare.
"""

import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from problems.benchmarks.stress import COMMAND, EXAMPLE
from problems.tools import provenance
from problems.tools.command_line import flag
from problems.tools.pages import publish, render

N_TIMES = 3
IMPORTS = "importing numpy, scipy, pandas, casadi"
COMMANDS = {
    IMPORTS: ("-c", "import numpy, scipy, pandas, casadi"),
    "--help": (*COMMAND, "--help"),
    "fit missing.toml": (*COMMAND, "fit", "missing.toml"),
    "check broken.toml": (*COMMAND, "check", "broken.toml"),
    "init missing.csv": (*COMMAND, "init", "missing.csv"),
    "check": (*COMMAND, "check"),
    "effects": (*COMMAND, "effects"),
    "fit": (*COMMAND, "fit"),
    "compare, after fit": (*COMMAND, "compare"),
}
LIMITS = {"--help": 0.5, "fit missing.toml": 0.5, "check broken.toml": 0.5}
LIMITS |= {"init missing.csv": 0.5, "check": 2.0, "fit": 4.0}


def seconds(arguments: Sequence[str], folder: Path) -> float:
    """Processor time of a Python process and its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "PYTHONPATH": str(provenance.ROOT)}
    environment |= {"PYTHONPYCACHEPREFIX": str(folder / "pyc")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, *arguments]
    subprocess.run(command, cwd=folder, env=environment, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    user = after.ru_utime - before.ru_utime
    return user + after.ru_stime - before.ru_stime


def shortest(n_times: int) -> dict[str, float]:
    """The shortest time of each command, all of them in turn."""
    found = dict.fromkeys(COMMANDS, float("inf"))
    with TemporaryDirectory() as place:
        folder = Path(place)
        for file in EXAMPLE.iterdir():
            shutil.copy(file, folder)
        (folder / "broken.toml").write_text("[data")
        for number in range(n_times + 1):
            (folder / "study.toml.cache").unlink(missing_ok=True)
            for name, arguments in COMMANDS.items():
                taken = seconds(arguments, folder)
                if number:  # in the first round Python compiles what it imports
                    found[name] = min(found[name], taken)
    return found


def page(found: dict[str, float]) -> str:
    """The page as Markdown."""
    rows = []
    for name, taken in found.items():
        ratio = round(taken / found[IMPORTS], 1)
        times = {"seconds": round(taken, 2), "imports": ratio}
        rows.append({"command": name, **times, "at most": LIMITS.get(name, "")})
    return render("benchmarks/pages/command_line.md", rows=rows, n_times=N_TIMES)


def main() -> None:
    """Measure, and write the page."""
    quick = flag("quick")
    text = page(shortest(1 if quick else N_TIMES))
    publish("command_line.md", text, not quick)


if __name__ == "__main__":
    main()

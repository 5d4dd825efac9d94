"""Every experiment of the thesis, two at a time; what is timed comes last, one script
after the other, and after it the table of docs/thesis.md.

    python -m problems.thesis.run_all [--quick]
"""

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from problems.tools.command_line import flag
from problems.tools.provenance import ROOT

SCRIPTS = (  # the longest first, so that both processors end together
    "noise_draws",
    "experiments",
    "open_questions",
    "grids",
    "integrators",
    "significance",
    "regularization",
)
TIMED = ("solver_speed", "compare")
LAST = "side_by_side"  # reads the pages of the others


@dataclass(frozen=True)
class Outcome:
    """How a script ended."""

    name: str
    return_code: int


def run(name: str) -> Outcome:
    """Run one script; the end of its output is shown when it fails."""
    began = time.perf_counter()
    command = [sys.executable, "-m", f"problems.thesis.{name}", *sys.argv[1:]]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False
    )
    minutes = (time.perf_counter() - began) / 60
    if done.returncode:
        said = (done.stdout + done.stderr).splitlines()
        print(f"{name}: failed after {minutes:.1f} min", *said[-30:], sep="\n")
    else:
        print(f"{name}: done after {minutes:.1f} min", flush=True)
    return Outcome(name, done.returncode)


def main() -> int:
    """Number of scripts that failed."""
    first = ", ".join(SCRIPTS)
    then = ", ".join(TIMED)
    print(f"{first}, then {then}; the results go to results/", flush=True)
    # A quick run measures no time, so nothing has to run alone.
    beside = (*SCRIPTS, *TIMED) if flag("quick") else SCRIPTS
    alone = (LAST,) if flag("quick") else (*TIMED, LAST)
    with ThreadPoolExecutor(2) as pool:
        outcomes = list(pool.map(run, beside))
    for name in alone:
        outcomes.append(run(name))
    return sum(outcome.return_code != 0 for outcome in outcomes)


if __name__ == "__main__":
    sys.exit(main())

"""Every experiment of the thesis, two at a time; the timed comparison comes last and
alone.

python -m problems.thesis.run_all [--quick]
"""

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

from problems.tools.provenance import ROOT

SCRIPTS = (
    "experiments",
    "noise_draws",
    "grids",
    "integrators",
    "significance",
    "regularization",
)
TIMED = "compare"


def run(name: str) -> tuple[str, int, float]:
    """Run one script; its output is shown when it fails."""
    began = time.perf_counter()
    arguments = [sys.executable, "-m", f"problems.thesis.{name}", *sys.argv[1:]]
    done = subprocess.run(
        arguments, cwd=ROOT, capture_output=True, text=True, check=False
    )
    seconds = time.perf_counter() - began
    tail = (
        "\n".join((done.stdout + done.stderr).splitlines()[-30:])
        if done.returncode
        else ""
    )
    print(
        f"{name}: {'failed' if done.returncode else 'done'} after {seconds / 60:.1f} min\n{tail}".rstrip(),
        flush=True,
    )
    return name, done.returncode, seconds


def main() -> int:
    """Number of scripts that failed."""
    print(f"{', '.join(SCRIPTS)}, then {TIMED}; the results go to results/", flush=True)
    with ThreadPoolExecutor(2) as pool:
        outcomes = list(pool.map(run, SCRIPTS))
    outcomes.append(run(TIMED))
    return sum(code != 0 for _, code, _ in outcomes)


if __name__ == "__main__":
    sys.exit(main())

"""Every experiment of the thesis, two at a time; what is timed comes last, one script
after the other, and after it the table of docs/thesis.md.

    python -m problems.thesis.run_all [--quick]

--quick runs each with few data on one system, says its main numbers and writes nothing.
"""

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

from problems.tools.command_line import flag
from problems.tools.provenance import ROOT

# The longest first, so that both processors end together; the pages of each, and what
# of a quick run is said.
SCRIPTS = {
    "noise_draws": "thesis/noise_draws.md",
    "experiments": "thesis/{henon_heiles,schrodinger,mass_spring,tanks}.md and figures",
    "open_questions": "thesis/open_questions.md",
    "grids": "thesis/grids.md and figures",
    "integrators": "thesis/integrators.md and figures",
    "significance": "thesis/significance.md",
    "regularization": "thesis/regularization.md and its figure",
}
TIMED = {
    "solver_speed": "thesis/solver_speed.md",
    "compare": "solver_vs_gradient_descent.md",
}
LAST = "side_by_side"  # reads the pages of the others
QUICK_SYSTEMS = {
    "noise_draws": ["henon_heiles"],
    "grids": ["henon_heiles"],
    "compare": ["henon_heiles", "mass_spring"],
}
SAID = 40  # lines at the end of what a script says


def run(name: str) -> int:
    """Run one script, and say what it wrote; its return code."""
    began = time.perf_counter()
    command = [sys.executable, "-m", f"problems.thesis.{name}", *sys.argv[1:]]
    if flag("quick"):
        command += QUICK_SYSTEMS.get(name, [])
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False
    )
    said = [line for line in done.stdout.splitlines() if not line.startswith("...")]
    page = {**SCRIPTS, **TIMED}.get(name)
    minutes = (time.perf_counter() - began) / 60
    head = f"{name}: done after {minutes:.1f} min"
    if done.returncode:
        head = f"{name}: failed after {minutes:.1f} min"
        said += done.stderr.splitlines()
    elif not flag("quick"):
        head += f"; wrote results/{page}" if page else "; wrote docs/thesis.md"
        said = []
    print(head, *said[-SAID:], sep="\n", flush=True)
    return done.returncode


def main() -> int:
    """Number of scripts that failed."""
    then = ", ".join(TIMED)
    print(f"{', '.join(SCRIPTS)}, then {then}", flush=True)
    # A quick run measures no time, so nothing has to run alone.
    at_once = (*SCRIPTS, *TIMED) if flag("quick") else tuple(SCRIPTS)
    alone = (LAST,) if flag("quick") else (*TIMED, LAST)
    with ThreadPoolExecutor(2) as pool:
        codes = list(pool.map(run, at_once))
    codes += [run(name) for name in alone]
    failed = sum(code != 0 for code in codes)
    ended = (
        "nothing is written by a quick run" if flag("quick") else "pages in results/"
    )
    print(f"{len(codes) - failed} of {len(codes)} scripts ended well; {ended}.")
    return failed


if __name__ == "__main__":
    sys.exit(main())

"""Every experiment of the thesis: its page in results/, and its figures.

    python -m problems.thesis.run [--quick] [--jobs=2] [name ...]

Names are those of `EXPERIMENTS`; all without one, each in a process of its own.
--quick: each with few data, on one system; its page is said and not written.
"""

import sys
import time
from collections.abc import Callable
from concurrent.futures import as_completed
from functools import partial

from problems.thesis.comparison import descent_page, draws_page, system_page
from problems.thesis.grids import grids_page
from problems.thesis.integrators import integrators_page
from problems.thesis.questions import questions_page
from problems.thesis.regularization import regularization_page
from problems.tools.command_line import chosen, flag, option
from problems.tools.provenance import write
from problems.tools.workers import fresh_processes

SAID = 30  # lines of a page that a quick run says
# Of each experiment, the page and what makes its text from ``quick``; those that take
# longest come first, so that all processors end together.
EXPERIMENTS: dict[str, tuple[str, Callable[[bool], str]]] = {
    "mass_spring": ("thesis/mass_spring.md", partial(system_page, "mass_spring")),
    "descent": ("solver_vs_gradient_descent.md", descent_page),
    "noise_draws": ("thesis/noise_draws.md", draws_page),
    "open_questions": ("thesis/open_questions.md", questions_page),
    "grids": ("thesis/grids.md", grids_page),
    "integrators": ("thesis/integrators.md", integrators_page),
    "tanks": ("thesis/tanks.md", partial(system_page, "tanks")),
    "henon_heiles": ("thesis/henon_heiles.md", partial(system_page, "henon_heiles")),
    "schrodinger": ("thesis/schrodinger.md", partial(system_page, "schrodinger")),
    "regularization": ("thesis/regularization.md", regularization_page),
}
LONG = ("mass_spring", "tanks", "schrodinger")  # are left out of a quick run


def made(name: str, quick: bool) -> str:
    """Make one page, and say what was done."""
    began = time.monotonic()
    page, make = EXPERIMENTS[name]
    text = make(quick)
    head = f"{name}: done after {(time.monotonic() - began) / 60:.1f} min; "
    if quick:
        tables = [line for line in text.splitlines() if "|" in line]
        return "\n".join([f"{head}a quick run writes nothing", *tables[:SAID]])
    write(page, text, f"python -m problems.thesis.run {name}")
    return f"{head}wrote results/{page}"


def main() -> int:
    """Number of experiments that failed."""
    quick = flag("quick")
    names = chosen() or [n for n in EXPERIMENTS if not quick or n not in LONG]
    unknown = set(names) - set(EXPERIMENTS)
    if unknown:
        raise SystemExit(f"{unknown.pop()!r} is none of {', '.join(EXPERIMENTS)}.")
    n_failed = 0
    with fresh_processes(int(option("jobs", "2"))) as pool:
        asked = {pool.submit(made, name, quick): name for name in names}
        for future in as_completed(asked):
            error = future.exception()
            n_failed += error is not None
            failed = f"{asked[future]}: failed: {type(error).__name__}: {error}"
            print(failed if error else future.result(), flush=True)
    print(f"{len(names) - n_failed} of {len(names)} experiments ended well.")
    return n_failed


if __name__ == "__main__":
    sys.exit(main())

"""How often intervals hold the truth when something acts beside the model.

    python -m problems.benchmarks.coverage [--first=SEED] [--seeds=N] [--page]

Fits are kept in results/coverage_fits.csv one by one: the same command takes up a run
that was cut short. With --page the page is written from what is kept.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from problems.benchmarks.coverage_fits import jobs, make
from problems.tools import provenance
from problems.tools.command_line import option

FIRST_SEED = 5000
N_SEEDS = 200
FITS = provenance.RESULTS / "coverage_fits.csv"


def run(first: int, n_seeds: int) -> None:
    """All fits that are missing."""
    for job in jobs():
        make(job, range(first, first + n_seeds), FITS)


if __name__ == "__main__":
    run(int(option("first", str(FIRST_SEED))), int(option("seeds", str(N_SEEDS))))

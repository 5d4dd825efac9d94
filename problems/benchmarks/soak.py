"""Whether a process that fits and studies for a long time grows.

    python -m problems.benchmarks.soak                        # 300 fits, 30 studies
    python -m problems.benchmarks.soak --fits=20 --studies=2  # fewer, and no page

Each fit has data of its own; each study adds an effect, is reported and drawn. Memory,
open files, figures and threads are counted on the way. Results: results/soak.md.
"""

import gc
import os
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import phsi_opt as ph
from problems.benchmarks.stress import MODEL, Row, collected, record
from problems.tools import provenance
from problems.tools.command_line import option
from problems.tools.pages import render
from problems.tools.pictures import plt

N_SAMPLES = 150
EFFECTS = ["coulomb friction", "quadratic drag"]
LOSSES = (ph.MaximumLikelihood(), ph.PHSILoss(), ph.MaximumLikelihood(huber=2.0))


def counted() -> dict[str, float]:
    """What this process holds."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return {
        "memory (MB)": pages * os.sysconf("SC_PAGE_SIZE") / 1e6,
        "open files": len(os.listdir("/proc/self/fd")),
        "figures": len(plt.get_fignums()),
        "threads": threading.active_count(),
        "threads of the system": len(os.listdir("/proc/self/task")),
    }


def fit(seed: int) -> None:
    """Fit, save, load, compare and draw."""
    data = record(seed, N_SAMPLES, is_complete=True)
    found = ph.identify(MODEL, data, LOSSES[seed % len(LOSSES)])
    with tempfile.TemporaryDirectory() as folder:
        found.save(Path(folder) / "fit.json")
        ph.compare(ph.Fit.load(Path(folder) / "fit.json"), data).plot()
    plt.close("all")


def study(seed: int) -> None:
    """Study, add, report and draw."""
    done = ph.Study(MODEL, record(1000 + seed, N_SAMPLES), effects=EFFECTS)
    done.auto(1)
    with tempfile.TemporaryDirectory() as folder:
        done.report(Path(folder) / "report.html")
    done.plot_history()
    plt.close("all")


def soaked(n_fits: int, n_studies: int) -> Iterator[Row]:
    """The counts after every tenth of the fits, then of the studies."""
    for name, work, n in (("fits", fit, n_fits), ("studies", study, n_studies)):
        for seed in range(n):
            work(seed)
            if (seed + 1) % max(n // 10, 1) == 0:
                yield {"after": f"{seed + 1} {name}", **counted()}


if __name__ == "__main__":
    n_fits, n_studies = int(option("fits", "300")), int(option("studies", "30"))
    found = collected(soaked(n_fits, n_studies))
    if (n_fits, n_studies) == (300, 30):
        memory = found["memory (MB)"]
        page = render(
            "benchmarks/pages/soak.md",
            rows=found,
            n=N_SAMPLES,
            n_fits=n_fits,
            n_studies=n_studies,
            growth_fits=memory[9] - memory[1],
            growth_studies=memory.iloc[-1] - memory[11],
        )
        provenance.write("soak.md", page)

"""How close do the estimates come to the Cramer-Rao bound, and do the intervals hold
what they promise?

    python -m problems.benchmarks.efficiency.run [--quick] [--page] [--jobs=N]
        [--scheduler=ADDRESS] [--seeds=N] [experiment ...]

Rows per seed are kept in results/efficiency/<experiment>.csv as they are computed: a
run that was interrupted goes on where it stopped, and --page writes the page anew.
--quick runs two seeds of each experiment and writes nothing.
"""

import os

# Before NumPy is loaded: the processes are the parallelism.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.sweeps.sweep import sweep
from problems.benchmarks.efficiency.cases import CASES, Case, Sample
from problems.benchmarks.efficiency.page import figure, page, verdict
from problems.tools import provenance
from problems.tools.command_line import chosen, flag, option
from problems.tools.kept_tables import append_rows, rewrite
from problems.tools.workers import workers

METHODS: dict[str, ph.MaximumLikelihood | ph.PHSILoss] = {
    "likelihood": ph.MaximumLikelihood(),
    "one-step": ph.PHSILoss(),
}
COLUMNS = [
    "seed",
    "method",
    "parameter",
    "truth",
    "bound",
    "efficient",
    "estimate",
    "std_error",
    "joint",
    "seconds",
    "outcome",
]
FORMAT = "%.8g"
SEEDS_APART = 1000  # more than any experiment has

Task = tuple[str, int]  # experiment and seed


@dataclass(frozen=True)
class Attempt:
    """What a fit gave: nothing but the reason where it failed."""

    seconds: float
    values: dict[str, float] = field(default_factory=dict)
    std_errors: dict[str, float] = field(default_factory=dict)
    outcome: str = "solved"


def fits(case: Case, seed: int) -> pd.DataFrame:
    """All methods on the data of one seed: a row per method and parameter."""
    sample = case.sample(seed)
    rows = []
    for method, loss in METHODS.items():
        if method == "likelihood" or case.one_step:
            attempt = _attempt(case, sample, loss)
            key = {"seed": seed, "method": method}
            rows += [key | row for row in _rows(case, sample, attempt)]
    return pd.DataFrame(rows, columns=COLUMNS)


def _attempt(
    case: Case, sample: Sample, loss: ph.MaximumLikelihood | ph.PHSILoss
) -> Attempt:
    began = time.perf_counter()
    try:
        fit = ph.identify(case.model(), sample.data, loss)
        # Standard errors are computed when they are asked for.
        values = fit.values
        std_errors = fit.std_errors
    # Whatever goes wrong is a fit that failed, and is counted.
    except Exception as error:
        reason = f"{type(error).__name__}: {str(error)[:200]}"
        return Attempt(time.perf_counter() - began, outcome=reason)
    return Attempt(time.perf_counter() - began, dict(values), dict(std_errors))


def _rows(case: Case, sample: Sample, attempt: Attempt) -> list[dict[str, object]]:
    """A row per parameter."""
    truth = case.system().truth
    estimates = {name: attempt.values.get(name, np.nan) for name in truth}
    errors = [estimates[name] - true for name, true in truth.items()]
    joint = sample.joint(np.array(errors))
    rows = []
    known = zip(truth, sample.bound, sample.efficient, strict=True)
    for name, bound, efficient in known:
        rows.append(
            {
                "parameter": name,
                "truth": truth[name],
                "bound": bound,
                "efficient": efficient,
                "estimate": estimates[name],
                "std_error": attempt.std_errors.get(name, np.nan),
                "joint": joint,
                "seconds": attempt.seconds,
                "outcome": attempt.outcome,
            }
        )
    return rows


def main(
    names: list[str] | None = None, n_seeds: int | None = None, jobs: int | None = None
) -> None:
    """Run what is not yet in the tables, and write the page."""
    for name in names or list(CASES):
        tasks = _open_tasks(name, n_seeds)
        with workers(jobs) as executor:
            for done in sweep(_fitted, tasks, executor=executor, progress=_say):
                append_rows(_path(name), done.result, FORMAT)
        ordered = table(name).sort_values("seed", kind="stable")
        rewrite(_path(name), ordered, FORMAT)
        print(verdict(table(name)), flush=True)
    write_page()


def _open_tasks(name: str, n_seeds: int | None) -> dict[str, Task]:
    """The seeds of an experiment that are not in its table."""
    done = set(table(name)["seed"]) if _path(name).exists() else set()
    first = first_seed(name)
    wanted = range(first, first + (n_seeds or CASES[name].n_seeds))
    return {f"{name}, seed {seed}": (name, seed) for seed in wanted if seed not in done}


def _fitted(task: Task) -> pd.DataFrame:
    name, seed = task
    return fits(CASES[name], seed)


def _say(line: str) -> None:
    print(line, flush=True)


def quick(names: list[str] | None = None, n_seeds: int = 2) -> dict[str, pd.DataFrame]:
    """A few seeds of each experiment in this process; nothing is written."""
    found = {}
    for name in names or list(CASES):
        seeds = range(first_seed(name), first_seed(name) + n_seeds)
        parts = [fits(CASES[name], seed) for seed in seeds]
        found[name] = pd.concat(parts, ignore_index=True)
    return found


def first_seed(name: str) -> int:
    """Every experiment draws from seeds of its own, so that their errors are
    independent.
    """
    return 5000 + SEEDS_APART * list(CASES).index(name)


def _path(name: str) -> Path:
    return provenance.RESULTS / "efficiency" / f"{name}.csv"


def table(name: str) -> pd.DataFrame:
    """The kept rows of an experiment."""
    return pd.read_csv(_path(name))


def write_page() -> None:
    """The page and the figure from the tables of all experiments that have been run."""
    found = {name: table(name) for name in CASES if _path(name).exists()}
    provenance.write("efficiency.md", page(found))
    figure(found)


if __name__ == "__main__":
    experiments = chosen() or None
    if flag("page"):
        write_page()
    elif flag("quick"):
        for case_name, case_rows in quick(experiments).items():
            print(f"{case_name}: {verdict(case_rows)}")
    else:
        seeds = int(option("seeds", "0")) or None
        main(experiments, seeds)

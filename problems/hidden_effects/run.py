"""Does the diagnosis find effects that were hidden in the data, and nothing where
nothing is hidden?

python -m problems.hidden_effects.run [--quick] [--page] [--list] [--jobs=N] [--seeds=N]
[row ...]

A row is named in full (coulomb_friction_0.03) or by its beginning (coulomb_friction,
sensor). What came out of each case is kept in results/hidden_effects/<row>.csv as it is
computed: a run that was interrupted goes on where it stopped, and --page writes the
page anew. --quick runs one seed of each row in this process and writes nothing.
"""

import os

os.environ.setdefault(
    "OMP_NUM_THREADS", "1"
)  # before NumPy is loaded: the processes are the parallelism
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Iterator
from multiprocessing import get_context

import pandas as pd

from problems.hidden_effects.examination import examine
from problems.hidden_effects.page import page
from problems.hidden_effects.rows import ROWS
from problems.hidden_effects.scores import summary_line
from problems.hidden_effects.store import COLUMNS, FOLDER, path_of, table
from problems.tools.command_line import chosen, flag, option


def _task(job: tuple[str, int]) -> dict[str, object]:
    name, seed = job
    return examine(ROWS[name], seed)


def main(names: list[str], n_seeds: int, jobs: int = 2) -> None:
    """Examine what is not yet in the tables, the first seeds of all rows first, and
    write the page.
    """
    FOLDER.mkdir(parents=True, exist_ok=True)
    done = {
        name: set(table(name)["seed"]) if path_of(name).exists() else set()
        for name in names
    }
    tasks = [
        (name, seed)
        for seed in range(n_seeds)
        for name in names
        if seed not in done[name]
    ]
    for record in _computed(tasks, jobs):
        name = str(record["row"])
        line = pd.DataFrame([record], columns=COLUMNS)
        line.to_csv(
            path_of(name),
            mode="a",
            header=not path_of(name).exists(),
            index=False,
            float_format="%.6g",
        )
    for name in names:
        rows = table(name).sort_values("seed", kind="stable")
        rows.to_csv(path_of(name), index=False, float_format="%.6g")
        print(summary_line(name, rows), flush=True)
    page()


def _computed(tasks: list[tuple[str, int]], jobs: int) -> Iterator[dict[str, object]]:
    if jobs == 1:
        yield from map(_task, tasks)
    elif tasks:
        with get_context("spawn").Pool(jobs) as pool:
            yield from pool.imap_unordered(_task, tasks)


def quick(names: list[str], n_seeds: int = 1) -> pd.DataFrame:
    """A few seeds of each row in this process; nothing is written."""
    records = [examine(ROWS[name], seed) for name in names for seed in range(n_seeds)]
    return pd.DataFrame(records, columns=COLUMNS)


def chosen_rows(given: list[str]) -> list[str]:
    """The rows that are named in full or by their beginning; all where none is given."""
    for text in given:
        if not any(name.startswith(text) for name in ROWS):
            raise SystemExit(f"no row begins with {text!r}; --list prints them.")
    return [
        name
        for name in ROWS
        if name in given or any(name.startswith(text) for text in given) or not given
    ]


if __name__ == "__main__":
    selected = chosen_rows(chosen())
    if flag("list"):
        print("\n".join(selected))
    elif flag("page"):
        page()
    elif flag("quick"):
        found = quick(selected, int(option("seeds", "1")))
        print(found.dropna(axis=1, how="all").to_string(index=False))
    else:
        main(selected, int(option("seeds", "50")), int(option("jobs", "2")))

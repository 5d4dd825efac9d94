"""Does the diagnosis find effects that were hidden in the data, and nothing where
nothing is hidden?

    python -m problems.hidden_effects.run [--quick] [--page] [--list] [--jobs=N]
        [--scheduler=ADDRESS] [--first=SEED] [--seeds=N] [row ...]

A row is named in full (coulomb_friction_0.03) or by its beginning (coulomb_friction,
sensor). What came out of each case is kept in results/hidden_effects/<row>.csv as it is
computed: a run that was interrupted goes on where it stopped, and --page writes the
page anew. --quick runs one seed of each row in this process and writes nothing. Seeds
from 1000 on (--first=1000) are those that nobody looked at while the diagnosis became
what it is; the page tells them apart from the first ones.
"""

import os

# Before NumPy is loaded: the processes are the parallelism.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pandas as pd

from phsi_opt.sweeps.sweep import sweep
from problems.hidden_effects import store
from problems.hidden_effects.examination import examine
from problems.hidden_effects.page import write_page
from problems.hidden_effects.rows import ROWS
from problems.hidden_effects.scores import summary_line
from problems.tools.command_line import chosen, flag, option
from problems.tools.workers import workers

N_SEEDS = 50

Task = tuple[str, int]  # row and seed


def main(names: list[str], seeds: range, jobs: int | None = None) -> None:
    """Examine what is not yet in the tables, and write the page.

    The first seeds of all rows come first.
    """
    tasks = _open_tasks(names, seeds)
    with workers(jobs) as executor:
        for done in sweep(_examined, tasks, executor=executor, progress=_say):
            store.append(done.result)
    for name in names:
        print(summary_line(name, store.sort(name)), flush=True)
    write_page()


def _open_tasks(names: list[str], seeds: range) -> dict[str, Task]:
    done = {name: set(store.table(name)["seed"]) for name in names}
    tasks = {}
    for seed in seeds:
        for name in names:
            if seed not in done[name]:
                tasks[f"{name}, seed {seed}"] = (name, seed)
    return tasks


def _say(line: str) -> None:
    print(line, flush=True)


def _examined(task: Task) -> dict[str, object]:
    name, seed = task
    return examine(ROWS[name], seed)


def quick(names: list[str], n_seeds: int = 1) -> pd.DataFrame:
    """A few seeds of each row in this process; nothing is written."""
    records = [examine(ROWS[name], seed) for name in names for seed in range(n_seeds)]
    return pd.DataFrame(records, columns=store.COLUMNS)


def chosen_rows(given: list[str]) -> list[str]:
    """The rows that are named in full or by their beginning; all where none is given.

    Raises:
        SystemExit: no row begins with one of the names.
    """
    for text in given:
        if not any(name.startswith(text) for name in ROWS):
            raise SystemExit(f"no row begins with {text!r}; --list prints them.")
    if not given:
        return list(ROWS)
    return [name for name in ROWS if name.startswith(tuple(given))]


if __name__ == "__main__":
    selected = chosen_rows(chosen())
    if flag("list"):
        print("\n".join(selected))
    elif flag("page"):
        write_page()
    elif flag("quick"):
        found = quick(selected, int(option("seeds", "1")))
        print(found.dropna(axis=1, how="all").to_string(index=False))
    else:
        first = int(option("first", "0"))
        n_given = int(option("seeds", str(N_SEEDS)))
        main(selected, range(first, first + n_given))

"""Does the diagnosis name what an engineer would believe, on machines of the field?

    python -m problems.field_machines.run [--first=SEED] [--seeds=N] [--kinds=a,b]
        [--prepared] [--page] [--jobs=N] [--scheduler=ADDRESS]

What came out of each case is kept in results/field_machines/<kind>.csv as it is
computed: a run that was interrupted goes on where it stopped. --prepared examines the
same cases from records that were prepared in three other ways; --page writes the page
anew and nothing else. Seeds below 21000 were used for developing, and those up to 33999
were seen since; those from 34000 on are reported.
"""

import os

# Before NumPy is loaded: the processes are the parallelism.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from phsi_opt.sweeps.sweep import sweep
from problems.field_machines import store
from problems.field_machines.examination import examine
from problems.field_machines.kinds import FIRST_REPORTED, KINDS
from problems.field_machines.page import write_page
from problems.field_machines.preparation import examine_prepared
from problems.tools.command_line import flag, option
from problems.tools.workers import workers

N_SEEDS = 20

Task = tuple[str, int, bool]  # kind, seed, whether from prepared records


def main(
    names: list[str], seeds: range, is_prepared: bool, jobs: int | None = None
) -> None:
    """Examine what is not yet in the tables, the first seeds of all kinds first."""
    tasks = _open_tasks(names, seeds, is_prepared)
    with workers(jobs) as executor:
        for done in sweep(_examined, tasks, executor=executor):
            store.append(done.result, is_prepared)
            print(_line(done.result), flush=True)


def _open_tasks(names: list[str], seeds: range, is_prepared: bool) -> dict[str, Task]:
    done = {}
    for name in names:
        done[name] = set(store.table(name, is_prepared)["seed"])
    tasks = {}
    for seed in seeds:
        for name in names:
            if seed not in done[name]:
                tasks[f"{name}, seed {seed}"] = (name, seed, is_prepared)
    return tasks


def _examined(task: Task) -> dict[str, object]:
    name, seed, is_prepared = task
    examined = examine_prepared if is_prepared else examine
    return examined(KINDS[name], seed)


def _line(record: dict[str, object]) -> str:
    """What a user sees while it runs."""
    shown = ("kind", "seed", "hidden", "answer", "findings", "same", "outcome")
    return ", ".join(str(record[name]) for name in shown if record.get(name))


def chosen_kinds(given: str) -> list[str]:
    """The kinds of a list with commas; all where none is given.

    Raises:
        SystemExit: there is no such kind.
    """
    names = [name for name in given.split(",") if name]
    for name in names:
        if name not in KINDS:
            raise SystemExit(f"no kind {name!r}; there are {', '.join(KINDS)}.")
    return names or list(KINDS)


if __name__ == "__main__":
    if not flag("page"):
        first = int(option("first", str(FIRST_REPORTED)))
        n_seeds = int(option("seeds", str(N_SEEDS)))
        chosen = chosen_kinds(option("kinds", ""))
        main(chosen, range(first, first + n_seeds), flag("prepared"))
    write_page()

"""The battery on fresh seeds at a fixed cost.

    python -m problems.judges.battery --first=SEED [--minutes=60] [--processes=2]
        [--name=battery]

The cases are a list that follows from the seed and the cost alone: rounds over all
effects, noises and kinds (`cases.IN_ROUND`), each in a random order, cut where
`SECONDS_A_CASE` processor seconds each have used up the minutes of all processes. Every
case is kept in results/judges as it is done; the same command goes on where it was
interrupted. For the same seeds on other code give another --name.

Seeds from 30000 on are for pages; try changes of the code on those from 10000 on, with
--name=try_..., whose files are not committed.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pandas as pd

from problems.battery import store
from problems.battery.ask import ROW, Task
from problems.battery.records import FIELD, HIDDEN
from problems.battery.score import by_kind, by_noise, confusions, hidden_rows
from problems.judges.cases import IN_ROUND, path_of, rounds
from problems.tools.command_line import option
from problems.tools.pages import render
from problems.tools.provenance import write

SECONDS_A_CASE = 7.0  # of a processor: the mean of a round on a busy machine


def task_list(first: int, minutes: float, processes: int) -> list[Task]:
    """The cases that cost so much."""
    n_tasks = round(60 * minutes * processes / SECONDS_A_CASE)
    return rounds(first, IN_ROUND, n_tasks)


def table(name: str, battery: str, tasks: list[Task]) -> pd.DataFrame:
    """The kept cases of a list."""
    rows = store.table(path_of(f"{name}_{battery}.csv"), battery)
    wanted = {(task.row, task.seed) for task in tasks if task.battery == battery}
    pairs = zip(rows[ROW[battery]], rows["seed"], strict=True)
    return rows[[pair in wanted for pair in pairs]]


def run(name: str, tasks: list[Task], processes: int) -> None:
    """Examine what is not kept yet."""
    store.run(
        tasks,
        lambda task: path_of(f"{name}_{task.battery}.csv"),
        lambda task, record: print(task, record["outcome"], flush=True),
        processes,
        further=("processor",),
    )


def page(hidden: pd.DataFrame, field: pd.DataFrame, first: int) -> str:
    """What was right, by class, with 95 % intervals (Wilson)."""
    both = pd.concat([hidden, field])
    shown: dict[str, object] = {}
    if len(hidden):
        shown = {"hidden": hidden_rows(hidden), "instead": confusions(hidden)}
    if len(field):
        kinds = {str(name): rows for name, rows in field.groupby("kind")}
        shown |= {"by_kind": by_kind(kinds), "by_noise": by_noise(field)}
    return render(
        "judges/pages/battery.md",
        n_hidden=len(hidden),
        n_field=len(field),
        first=first,
        mean=both["processor"].mean(),
        total=both["processor"].sum(),
        commits=both["commit"].unique(),
        **shown,
    )


def main() -> None:
    """Examine the list, and write the page."""
    if not option("first", ""):
        raise SystemExit(
            "--first=SEED: seeds that nobody has seen (see problems/battery/draw.py)."
        )
    first = int(option("first", ""))
    processes = int(option("processes", "2"))
    name = option("name", "battery")
    tasks = task_list(first, float(option("minutes", "60")), processes)
    run(name, tasks, processes)
    hidden, field = (table(name, battery, tasks) for battery in (HIDDEN, FIELD))
    write(f"judges/{name}.md", page(hidden, field, first))


if __name__ == "__main__":
    main()

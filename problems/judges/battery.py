"""The battery on fresh seeds at a fixed cost.

    python -m problems.judges.battery --first=SEED [--minutes=60] [--processes=2]
        [--name=battery] [--rows=ROW,ROW]

The cases are a list that follows from the seed and the cost alone: rounds over all
effects, noises and kinds (`cases.IN_ROUND`), each in a random order, cut where
`SECONDS_A_CASE` processor seconds each have used up the minutes of all processes. Every
case is kept in results/judges/<name>.json, which is not committed, as it is done; the
same command goes on where it was interrupted. For other code give another --name. With
--rows the list has cases of these rows alone.

Seeds from 30000 on are for pages; try changes of the code on those from 10000 on, with
--name=try_..., whose files are not committed.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Collection

import numpy as np
import pandas as pd

from problems.battery.ask import Task, examined
from problems.battery.draw import LOUDEST, QUIETEST
from problems.battery.experiments import MODEL_ERROR
from problems.battery.records import FIELD, HIDDEN
from problems.battery.score import by_kind, by_noise, confusions, hidden_rows
from problems.judges.cases import IN_ROUND, Record, kept, rounds, run
from problems.tools.command_line import option
from problems.tools.pages import render
from problems.tools.provenance import write

# Columns of the page that not every record has.
COUNTED = ["misfit", "covered", "after", "added", "first", "first_equation"]
COUNTED += ["verdict", "base_error", "answer"]
SECONDS_A_CASE = 7.0  # of a processor: the mean of a round on a busy machine


def task_list(
    first: int, minutes: float, processes: int, rows: Collection[str] = ()
) -> list[Task]:
    """The cases that cost so much."""
    n_tasks = round(60 * minutes * processes / SECONDS_A_CASE)
    return rounds(first, IN_ROUND, n_tasks, rows)


def tables(
    done: dict[str, Record], tasks: list[Task]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The kept cases of a list, hidden effects and machines of the field."""
    found: dict[str, list[Record]] = {HIDDEN: [], FIELD: []}
    for task in tasks:
        if str(task) in done:
            found[task.battery].append(dict.fromkeys(COUNTED, np.nan) | done[str(task)])
    return pd.DataFrame(found[HIDDEN]), pd.DataFrame(found[FIELD])


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
        quietest=QUIETEST,
        loudest=LOUDEST,
        model_error=MODEL_ERROR,
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
    rows = [row for row in option("rows", "").split(",") if row]
    tasks = task_list(first, float(option("minutes", "60")), processes, rows)
    file = f"{name}.json"
    done = kept(file)
    run(file, examined, tasks, done, processes)
    hidden, field = tables(done, tasks)
    write(f"judges/{name}.md", page(hidden, field, first))


if __name__ == "__main__":
    main()

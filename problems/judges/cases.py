"""Which cases of the battery the judges examine, and the records that they keep.

The lists are balanced and reproducible (`problems.battery.draw` says which seeds are
for what). Records are results of the code of one day, as JSON in results/judges.
"""

import json
from collections.abc import Callable, Collection, Mapping
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np

from phsi_opt.sweeps.sweep import sweep
from phsi_opt.writing import write_whole
from problems.battery.ask import Task
from problems.battery.draw import TABLES
from problems.tools import provenance
from problems.tools.workers import workers

# Cases by the kind of row of hidden effects, and of machines of the field (with
# something to name, with nothing). Multiples of three meet all noises of the field.
IN_ROUND = {
    "one": 1,
    "sensor": 1,
    "tanks": 2,
    "two": 3,
    "three": 3,
    "shaken": 3,
    "outside": 6,
    "nothing": 3,
    "lasting": 3,
    "machine": 3,
    "complete": 6,
}
IN_VERDICTS = {
    "one": 1,
    "sensor": 3,
    "tanks": 4,
    "two": 9,
    "three": 0,
    "shaken": 0,
    "outside": 15,
    "nothing": 10,
    "lasting": 0,
    "machine": 6,
    "complete": 18,
}

SAID = ("verdict", "findings", "answer", "first", "outcome")  # of a record, as it comes

Record = dict[str, Any]


def rounds(
    first: int, numbers: Mapping[str, int], n_tasks: int, rows: Collection[str] = ()
) -> list[Task]:
    """The first tasks of round after round, each in a random order of its own.

    Every round has new seeds, from ``first`` on; of some ``rows`` alone, if given.
    """
    every = (task for k in count() for task in one_round(first, numbers, k))
    chosen = (task for task in every if not rows or task.row in rows)
    return list(islice(chosen, n_tasks))


def one_round(first: int, numbers: Mapping[str, int], k: int = 0) -> list[Task]:
    """The tasks of the round ``k``."""
    tasks = []
    for battery, rows in TABLES.items():
        for row in rows.values():
            n = numbers[row.kind]
            seeds = range(first + k * n, first + (k + 1) * n)
            tasks += [Task(battery, row.name, seed) for seed in seeds]
    order = np.random.default_rng([first, k]).permutation(len(tasks))
    return [tasks[place] for place in order]


def path_of(name: str) -> Path:
    """The file of a judge; it may not exist."""
    return provenance.RESULTS / "judges" / name


def keep(name: str, records: Mapping[str, Record]) -> None:
    """Write records by name, with command, commit and machine."""
    path = path_of(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"provenance": provenance.provenance(), "records": records}
    text = json.dumps(content, indent=1, default=lambda number: number.item())
    write_whole(path, text + "\n")


def kept(name: str) -> dict[str, Record]:
    """Records by name; none where nothing was kept."""
    path = path_of(name)
    if not path.exists():
        return {}
    return dict(json.loads(path.read_text(encoding="utf-8"))["records"])


def run(
    name: str,
    examined: Callable[[Task], Record],
    tasks: list[Task],
    done: dict[str, Record],
    jobs: int,
) -> None:
    """Examine what is not done, and keep each as it comes."""
    open_tasks = {str(task): task for task in tasks if str(task) not in done}
    with workers(jobs) as executor:
        for one in sweep(examined, open_tasks, executor=executor):
            done[one.key] = one.result
            keep(name, done)
            said = {k: str(v) for k, v in one.result.items() if k in SAID and v}
            print(f"{len(done)}: {one.key}: {said}", flush=True)

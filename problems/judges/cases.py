"""Which cases of both batteries are examined: lists that are balanced and reproducible.

Seeds 20000 to 20999 are those of the frozen verdicts and of nothing else. Those from
30000 on are reported (`battery`): nobody looks at one while the package is developed,
and a page names its first. Development of the judges used 10000 to 10999. Before,
`problems.hidden_effects` used seeds below 50, 1000 to 1049 and 3000 to 3149, and
`problems.field_machines` seeds below 600 and 8000 to 8899.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count, islice

import numpy as np

from problems.field_machines.kinds import KINDS
from problems.field_machines.sizes import MODEL_ERROR
from problems.hidden_effects.rows import ROWS

HIDDEN, FIELD = "hidden_effects", "field_machines"
FIRST_VERDICT = 20_000
FIRST_REPORTED = 30_000
# Cases by the kind of row of hidden effects, and of machines of the field (with
# something to name, with nothing). Multiples of three meet all noises of the field.
IN_ROUND = {
    "one": 1,
    "sensor": 1,
    "tanks": 2,
    "two": 3,
    "outside": 6,
    "nothing": 3,
    "machine": 3,
    "complete": 6,
}
IN_VERDICTS = {
    "one": 1,
    "sensor": 3,
    "tanks": 4,
    "two": 9,
    "outside": 15,
    "nothing": 10,
    "machine": 6,
    "complete": 18,
}


@dataclass(frozen=True)
class Task:
    """A case: its battery, the row or kind of machine, the seed."""

    battery: str
    row: str
    seed: int

    def __str__(self) -> str:
        return f"{self.battery} {self.row} {self.seed}"


def rounds(first: int, numbers: Mapping[str, int], n_tasks: int) -> list[Task]:
    """The first tasks of round after round, each in a random order of its own.

    Every round has new seeds, from ``first`` on.
    """
    every = (task for k in count() for task in one_round(first, numbers, k))
    return list(islice(every, n_tasks))


def one_round(first: int, numbers: Mapping[str, int], k: int = 0) -> list[Task]:
    """The tasks of the round ``k``."""
    tasks = []
    for (battery, row), n in _numbers_of_rows(numbers).items():
        seeds = range(first + k * n, first + (k + 1) * n)
        tasks += [Task(battery, row, seed) for seed in seeds]
    order = np.random.default_rng([first, k]).permutation(len(tasks))
    return [tasks[place] for place in order]


def _numbers_of_rows(numbers: Mapping[str, int]) -> dict[tuple[str, str], int]:
    found = {(HIDDEN, row.name): numbers[row.kind] for row in ROWS.values()}
    for kind in KINDS.values():
        if kind.model_error == MODEL_ERROR:
            said = "complete" if kind.is_complete else "machine"
            found[FIELD, kind.name] = numbers[said]
    return found

"""Does the diagnosis find effects that were hidden in the data, and nothing where
nothing is hidden?

    python -m problems.battery.run hidden_effects|field_machines [row ...] [--page]
        [--list] [--first=SEED] [--seeds=N] [--prepared] [--jobs=N]
        [--scheduler=ADDRESS]

A row is named in full (coulomb_friction_0.03) or by its beginning (coulomb_friction,
sensor); all without one. What came out of each case is kept in
results/hidden_effects/<row>.csv or results/field_machines/<row>.csv as it is computed:
a run that was interrupted goes on where it stopped. --list prints the rows; --page
writes the page anew and nothing else; --prepared examines machines of the field from
records that were prepared in three other ways.

Hidden effects: seeds from 1000 on are those that nobody looked at while the diagnosis
became what it is; the page tells them apart from the first ones. Machines of the field:
seeds below 21000 were used for developing, and those up to 33999 were seen since.
"""

import os

# Before NumPy is loaded: the processes are the parallelism.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Sequence

from problems.battery import store
from problems.battery.ask import Found, Task
from problems.battery.draw import TABLES
from problems.battery.page import FIRST_OF_PAGE, write_field, write_hidden
from problems.battery.records import FIELD, HIDDEN
from problems.tools.command_line import chosen, flag, option

WRITE = {HIDDEN: write_hidden, FIELD: write_field}
FIRST = {HIDDEN: 0, FIELD: FIRST_OF_PAGE}
N_SEEDS = {HIDDEN: 50, FIELD: 20}
SHOWN = ("truth", "hidden", "verdict", "first", "answer", "findings", "same", "outcome")


def main(
    battery: str,
    names: Sequence[str],
    seeds: range,
    is_prepared: bool = False,
    jobs: int | None = None,
) -> None:
    """Examine what is not yet in the tables, the first seeds of all rows first, and
    write the page.
    """
    store.run(
        [Task(battery, name, seed, is_prepared) for seed in seeds for name in names],
        lambda task: store.path_of(battery, task.row, is_prepared),
        _say,
        jobs,
    )
    WRITE[battery]()


def _say(task: Task, record: Found) -> None:
    shown = [str(record[name]) for name in SHOWN if record.get(name)]
    print(f"{task}: {', '.join(shown)}", flush=True)


def chosen_rows(battery: str, given: Sequence[str]) -> list[str]:
    """The rows that are named in full or by their beginning; all where none is given.

    Raises:
        SystemExit: no row begins with one of the names.
    """
    rows = TABLES[battery]
    for text in given:
        if not any(name.startswith(text) for name in rows):
            raise SystemExit(f"no row begins with {text!r}; --list prints them.")
    beginnings = tuple(text for text in given if text not in rows) if given else ("",)
    return [name for name in rows if name in given or name.startswith(beginnings)]


if __name__ == "__main__":
    battery, *given = chosen() or [""]
    if battery not in TABLES:
        raise SystemExit(f"name one of {' and '.join(TABLES)} first.")
    selected = chosen_rows(battery, given)
    if flag("list"):
        print("\n".join(selected))
    elif flag("page"):
        WRITE[battery]()
    else:
        first = int(option("first", str(FIRST[battery])))
        n_given = int(option("seeds", str(N_SEEDS[battery])))
        main(battery, selected, range(first, first + n_given), flag("prepared"))

"""The tables in which examined cases are kept: results/hidden_effects/<row>.csv and
results/field_machines/<row>.csv, with <row>_prepared.csv for the preparations.

A case is appended as it is examined, so that an interrupted run goes on where it
stopped.
"""

from collections.abc import Callable, Iterable
from pathlib import Path

import pandas as pd

from phsi_opt.sweeps.sweep import sweep
from problems.battery.ask import PREPARED, ROW, Found, Task, examined
from problems.battery.records import FIELD, HIDDEN
from problems.tools import provenance
from problems.tools.kept_tables import append_rows
from problems.tools.workers import workers

HIDDEN_COLUMNS = """
    row seed noise masses measured input free known n_train truth equation value listed
    target base_ratio base_error verdict first first_equation confusable_with right tie
    misfit coefficient std_error covered after rank added seconds drawing outcome commit
    """
FIELD_COLUMNS = """
    kind seed noise hidden truth coefficient listed disturbance ratio disturbed measured
    inputs free n_train sensor answer findings verdicts added after seconds drawing
    outcome commit
    """
COLUMNS = {HIDDEN: HIDDEN_COLUMNS.split(), FIELD: FIELD_COLUMNS.split()}
PREPARED_COLUMNS = ["kind", "seed", *PREPARED, "same", "outcome", "commit"]
# Columns that are read as written: one of "false" alone would be read as a truth value.
TEXTS = ("truth", "findings", "verdicts", "added", "inputs", "free", "answer")


def path_of(battery: str, row: str, is_prepared: bool = False) -> Path:
    """The table of a row; it may not exist."""
    end = "_prepared" if is_prepared else ""
    return provenance.RESULTS / battery / f"{row}{end}.csv"


def columns(battery: str, is_prepared: bool = False) -> list[str]:
    """The columns of a table."""
    return PREPARED_COLUMNS if is_prepared else COLUMNS[battery]


def table(path: Path, battery: str, is_prepared: bool = False) -> pd.DataFrame:
    """The kept cases, in the order of their seeds; none where nothing was run."""
    if not path.exists():
        return pd.DataFrame(columns=columns(battery, is_prepared))
    texts = list(PREPARED if is_prepared else TEXTS) if battery == FIELD else []
    rows = pd.read_csv(path, dtype=dict.fromkeys(texts, str))
    rows[texts] = rows[texts].fillna("")
    return rows.sort_values("seed", kind="stable", ignore_index=True)


def run(
    tasks: Iterable[Task],
    path: Callable[[Task], Path],
    say: Callable[[Task, Found], None],
    jobs: int | None = None,
    further: tuple[str, ...] = (),
) -> None:
    """Examine what is not yet in the tables, in this order, and keep it.

    Args:
        path: The table of a task.
        say: Called with each task that is done, and its record.
        jobs: Number of processes.
        further: Columns besides the usual ones.
    """
    done: dict[Path, set[tuple[str, int]]] = {}
    missing = {}
    for task in tasks:
        if path(task) not in done:
            rows = table(path(task), task.battery, task.is_prepared)
            names = rows[ROW[task.battery]]
            done[path(task)] = set(zip(names, rows["seed"], strict=True))
        if (task.row, task.seed) not in done[path(task)]:
            missing[str(task)] = task
    with workers(jobs) as executor:
        for case in sweep(examined, missing, executor=executor):
            task = missing[case.key]
            kept = [*columns(task.battery, task.is_prepared), *further]
            line = pd.DataFrame([case.result], columns=kept)
            append_rows(path(task), line, "%.6g")
            say(task, case.result)

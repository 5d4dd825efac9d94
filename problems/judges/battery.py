"""Both batteries on fresh seeds at a fixed cost.

    python -m problems.judges.battery --first=SEED [--minutes=60] [--processes=2]
        [--name=battery]

The cases are a list that follows from the seed and the cost alone: rounds over all
effects, noises and kinds (`cases.IN_ROUND`), each in a random order, cut where
`SECONDS_A_CASE` processor seconds each have used up the minutes of all processes. Every
case is kept in results/judges as it is done; the same command goes on where it was
interrupted. For the same seeds on other code give another --name.

Seeds from 30000 on are for pages (`cases`); try changes of the code on those from 10000
on, with --name=try_..., whose files are not committed.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time

import pandas as pd

from phsi_opt.sweeps.sweep import sweep
from problems.field_machines import examination as field_examination
from problems.field_machines import page as field_page
from problems.field_machines import store as field_store
from problems.field_machines.kinds import KINDS
from problems.hidden_effects import examination as hidden_examination
from problems.hidden_effects import store as hidden_store
from problems.hidden_effects.rows import ROWS
from problems.hidden_effects.scores import confusions, summary_row, target_of
from problems.judges.cases import FIELD, HIDDEN, IN_ROUND, Task, rounds
from problems.judges.frozen import path_of
from problems.tools import markdown
from problems.tools.command_line import option
from problems.tools.kept_tables import append_rows
from problems.tools.provenance import write
from problems.tools.workers import workers

SECONDS_A_CASE = 7.0  # of a processor: the mean of a round on a busy machine
COLUMNS = {
    HIDDEN: [*hidden_store.COLUMNS, "processor"],
    FIELD: [*field_store.COLUMNS, "processor"],
}
ROW = {HIDDEN: "row", FIELD: "kind"}  # the column that names a task's row


def task_list(first: int, minutes: float, processes: int) -> list[Task]:
    """The cases that cost so much."""
    n_tasks = round(60 * minutes * processes / SECONDS_A_CASE)
    return rounds(first, IN_ROUND, n_tasks)


def examined(task: Task) -> dict[str, object]:
    """The record of a task, as its battery keeps it."""
    began = time.process_time()
    if task.battery == HIDDEN:
        record = hidden_examination.examine(ROWS[task.row], task.seed)
    else:
        record = field_examination.examine(KINDS[task.row], task.seed)
    return record | {"processor": time.process_time() - began}


def table(name: str, battery: str, tasks: list[Task]) -> pd.DataFrame:
    """The kept cases of a list."""
    path = path_of(f"{name}_{battery}.csv")
    if not path.exists():
        return pd.DataFrame(columns=COLUMNS[battery])
    texts = list(field_store.TEXTS) if battery == FIELD else []
    rows = pd.read_csv(path, dtype=dict.fromkeys(texts, str))
    rows[texts] = rows[texts].fillna("")
    wanted = {(task.row, task.seed) for task in tasks if task.battery == battery}
    pairs = zip(rows[ROW[battery]], rows["seed"], strict=True)
    return rows[[pair in wanted for pair in pairs]]


def run(name: str, tasks: list[Task], processes: int) -> None:
    """Examine what is not kept yet."""
    done = set()
    for battery in (HIDDEN, FIELD):
        rows = table(name, battery, tasks)
        for row, seed in zip(rows[ROW[battery]], rows["seed"], strict=True):
            done.add(Task(battery, row, seed))
    open_tasks = {str(task): task for task in tasks if task not in done}
    with workers(processes) as executor:
        found = sweep(
            examined,
            open_tasks,
            executor=executor,
            progress=lambda s: print(s, flush=True),
        )
        for one in found:
            battery = open_tasks[one.key].battery
            line = pd.DataFrame([one.result], columns=COLUMNS[battery])
            append_rows(path_of(f"{name}_{battery}.csv"), line, "%.6g")


def page(hidden: pd.DataFrame, field: pd.DataFrame, first: int) -> str:
    """What was right, by class, with 95 % intervals (Wilson)."""
    both = pd.concat([hidden, field])
    seconds = both["processor"]
    text = markdown.paragraph(f"""
        {len(hidden)} hidden effects and {len(field)} machines of the field on seeds
        from {first} on, {seconds.mean():.1f} processor seconds a case,
        {seconds.sum() / 3600:.2f} hours in all; what counts as right is said in
        `results/hidden_effects.md` and `results/field_machines.md`. Commits:
        {", ".join(map(str, both["commit"].unique()))}.
        """)
    lines = ["# Both batteries on fresh seeds", "", text, ""]
    if len(hidden):
        lines += ["## Hidden effects", "", markdown.table(hidden_rows(hidden)), ""]
        lines += ["What came instead:", "", markdown.table(confusions(hidden)), ""]
    if len(field):
        kinds = {str(name): rows for name, rows in field.groupby("kind")}
        lines += ["## Machines of the field", ""]
        lines += [markdown.table(field_page.summary(kinds)), ""]
        lines += [markdown.table(field_page.by_noise(field)), ""]
    return "\n".join(lines)


def hidden_rows(hidden: pd.DataFrame) -> list[dict[str, object]]:
    """A line for one effect at each noise, for each effect, and for each other kind."""
    kinds = hidden["row"].map(lambda name: ROWS[name].kind)
    one = hidden[kinds.eq("one")]
    by_effect = one["row"].map(lambda name: ROWS[name].effects[0])
    parts = [(f"one effect, noise {n:g}", rows) for n, rows in one.groupby("noise")]
    parts += [
        (str(kind), rows) for kind, rows in hidden[kinds.ne("one")].groupby(kinds)
    ]
    parts += [(str(effect), rows) for effect, rows in one.groupby(by_effect)]
    lines = []
    for label, rows in parts:
        target = target_of(ROWS[str(rows["row"].iloc[0])])
        lines.append(summary_row(label, rows, target))
    return lines


def main() -> None:
    """Examine the list, and write the page."""
    if not option("first", ""):
        raise SystemExit("--first=SEED: seeds that nobody has seen (see cases.py).")
    first = int(option("first", ""))
    processes = int(option("processes", "2"))
    name = option("name", "battery")
    tasks = task_list(first, float(option("minutes", "60")), processes)
    run(name, tasks, processes)
    hidden = table(name, HIDDEN, tasks)
    field = table(name, FIELD, tasks)
    write(f"judges/{name}.md", page(hidden, field, first))


if __name__ == "__main__":
    main()

"""What a study does once that it did several times, and what that saves.

    python -m problems.benchmarks.record_reuse --before=FOLDER [--runs=N]

FOLDER is a checkout of the package as it was before `Record` (commit 294e64e). Both run
the demonstration in turns, each time in a process of its own, with a counter around the
functions that align, lay out and hash measurements, estimate the missing force and run
a model freely. Counts are exact; of the times the medians and their ratios are given.
"""

import importlib
import json
import os
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from functools import wraps
from pathlib import Path
from types import ModuleType
from typing import Any

import phsi_opt as ph

COUNTING = "--count"
STEPS = ("base model", "diagnosis", "tables and sentences", "figure", "auto")
# What is counted, by the place of the function that does it.
NOW = {
    "aligned": "phsi_opt.transcription.grid.aligned",
    "laid out": "phsi_opt.transcription.grid.grid_of",
    "fingerprints": "phsi_opt.data.measurements.Measurements.digest",
    "missing forces": "phsi_opt.estimation.missing_force.missing_force_of",
    "free runs": "phsi_opt.comparison.compare.compare_record",
    "force along the record": "phsi_opt.force_analysis.force_record.ForceRecord.of",
}
BEFORE = {
    "aligned": "phsi_opt.identify.matched",
    "laid out": "phsi_opt.grid.grid_of",
    "fingerprints": "phsi_opt.work.data_digest",
    "missing forces": "phsi_opt.compare.force_of",
    "free runs": "phsi_opt.compare.compared",
    "force along the record": "phsi_opt.along.along",
}
CSV = Path(__file__).resolve().parents[1] / "examples/data/friction_spring.csv"


# --- in a process of its own: count and time one study


def count() -> dict[str, Any]:
    """Counts and seconds per step of the demonstration's study."""
    is_now = (Path(ph.__file__).parent / "transcription").exists()
    counter: Counter[str] = Counter()
    for what, place in (NOW if is_now else BEFORE).items():
        _count_calls(counter, what, place)
    found: dict[str, Any] = {}

    def step(name: str, do: Callable[[], Any]) -> Any:
        counter.clear()
        began = time.perf_counter()
        result = do()
        seconds = time.perf_counter() - began
        found[name] = {"seconds": seconds, "counts": dict(counter)}
        return result

    train, test = _measurements().split(0.6)
    study = step(STEPS[0], lambda: ph.Study(_model(), train, held_out=test))
    diagnosis = step(STEPS[1], lambda: (study.compare(), study.diagnose())[1])
    step(STEPS[2], lambda: (diagnosis.where, diagnosis.follows, diagnosis.sentences))
    draw = diagnosis.figure if is_now else diagnosis.plot_where
    step(STEPS[3], draw)
    step(STEPS[4], study.auto)
    found["errors"] = study.history["held_out_rmse"].tolist()
    return found


def _measurements() -> ph.Measurements:
    return ph.Measurements.from_csv(
        CSV,
        time="t_s",
        trajectory="run",
        states={"q": "position_m", "p": None},
        units={"q": "m", "t": "s"},
    )


def _model() -> ph.PseudoHamiltonian:
    stiffness = ph.Parameter(10.0, lower=0, unit="N/m")
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/(2*m)", k=stiffness, m=2.5),
        R=ph.damping("p"),
    )


def _count_calls(counter: Counter[str], what: str, place: str) -> None:
    """Count every call of a function, property or class method by its dotted place."""
    parts = place.split(".")
    owner: Any = None
    for n in range(len(parts) - 1, 0, -1):
        try:
            owner = importlib.import_module(".".join(parts[:n]))
            break
        except ModuleNotFoundError:
            continue
    for name in parts[n:-1]:
        owner = getattr(owner, name)
    found = vars(owner)[parts[-1]]

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            counter[what] += 1
            return function(*args, **kwargs)

        return call

    if isinstance(found, classmethod):
        setattr(owner, parts[-1], classmethod(counted(found.__func__)))
    elif hasattr(found, "func"):  # a cached property
        found.func = counted(found.func)
    else:
        _replace_everywhere(found, counted(found))


def _replace_everywhere(old: object, new: object) -> None:
    """In every module of the package that has imported the function."""
    for module in list(sys.modules.values()):
        if isinstance(module, ModuleType) and module.__name__.startswith("phsi_opt"):
            for name, value in list(vars(module).items()):
                if value is old:
                    setattr(module, name, new)


# --- the page


def main(before: Path, n_runs: int) -> None:
    """Run both in turns and write the page."""
    from problems.tools.provenance import ROOT

    runs: dict[str, list[dict[str, Any]]] = {"before": [], "now": []}
    for _ in range(n_runs):
        for name, folder in (("before", before), ("now", ROOT)):
            runs[name].append(_counted_in(folder))
            print(f"... {name}", flush=True)
    errors = {json.dumps(run["errors"]) for each in runs.values() for run in each}
    if len(errors) > 1:
        raise RuntimeError(f"the studies differ: {errors}")
    _write_page(runs, n_runs)


def _counted_in(folder: Path) -> dict[str, Any]:
    environment = {
        **os.environ,
        "PYTHONPATH": str(folder),
        "OMP_NUM_THREADS": "1",
        "MPLBACKEND": "Agg",
    }
    command = [sys.executable, str(Path(__file__).resolve()), COUNTING]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def _write_page(runs: Mapping[str, list[dict[str, Any]]], n_runs: int) -> None:
    from problems.tools import markdown
    from problems.tools.provenance import write

    counts = []
    for step in STEPS:
        old = runs["before"][0][step]["counts"]
        new = runs["now"][0][step]["counts"]
        for what in NOW:
            if old.get(what, 0) or new.get(what, 0):
                counts.append((step, what, old.get(what, 0), new.get(what, 0)))
    times = []
    for step in STEPS:
        old_times = [run[step]["seconds"] for run in runs["before"]]
        new_times = [run[step]["seconds"] for run in runs["now"]]
        ratios = [new / old for old, new in zip(old_times, new_times, strict=True)]
        middle = statistics.median(ratios)
        spread = f"{min(ratios):.2f} to {max(ratios):.2f}"
        old_median = f"{statistics.median(old_times):.2f}"
        new_median = f"{statistics.median(new_times):.2f}"
        times.append((step, old_median, new_median, f"{middle:.2f} ({spread})"))
    count_head = ["step", "what", "times before", "times now"]
    time_head = ["step", "seconds before", "seconds now", "now / before (range)"]
    text = [
        "# One record, made once",
        "",
        "The study of the demonstration, before and with one record of fit and data "
        f"that is handed on; {n_runs} runs of each in turns, a process each, one "
        "thread. The errors of the studies are the same to the last bit.",
        "",
        markdown.lines(count_head, counts),
        "",
        "Medians, and of the ratios pair by pair the median and the range:",
        "",
        markdown.lines(time_head, times),
    ]
    write("record_reuse.md", "\n".join(text))


if __name__ == "__main__":
    if COUNTING in sys.argv:
        print(json.dumps(count()))
    else:
        from problems.tools.command_line import option

        main(Path(option("before", "")).resolve(), int(option("runs", "5")))

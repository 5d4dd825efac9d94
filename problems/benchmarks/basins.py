"""From starts far off, along records of many periods: how often is the right optimum
found, and what does it cost?

    python -m problems.benchmarks.basins [--quick] [--page] [SETTING ...]

Settings are numbers, counted from 0; rows of the others are kept in basins.csv.

Seeds 0 to 999 are for development.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.errors import SolveError
from problems.benchmarks.basin_machines import (
    KINDS,
    NOTHING,
    UNREST,
    BasinCase,
    draw_case,
)
from problems.tools.command_line import chosen, flag
from problems.tools.intervals import share
from problems.tools.kept_tables import rewrite
from problems.tools.pages import render
from problems.tools.provenance import RESULTS, write

FIRST_SEED = 5000
# Difference of the deviance up to which a fit is no less likely than its reference:
# what three parameters more would explain by chance.
SAME_OPTIMUM = 3.0


@dataclass(frozen=True)
class Setting:
    """How far off the start is, what the model lacks, machines of each kind."""

    off: float
    lacks: str
    n: int


TABLE = RESULTS / "basins.csv"
SETTINGS = (
    Setting(0.5, NOTHING, 50),
    Setting(0.7, NOTHING, 20),
    Setting(0.7, UNREST, 10),
)


def row(kind: str, seed: int, setting: Setting) -> dict[str, object]:
    """One machine, identified."""
    case = draw_case(kind, seed, setting.off, setting.lacks)
    misfit, error, seconds = _identified(case)
    if setting.lacks == NOTHING:
        reference = _misfit(case, case.data.trajectories[0].x - case.noise)
    else:
        near = replace(case, model=case.model.with_values(case.truth))
        reference = min(_identified(near)[0], misfit)
    return {
        "off": setting.off,
        "lacks": setting.lacks,
        "kind": kind,
        "seed": seed,
        "periods": case.n_periods,
        "samples": case.data.n_samples,
        "input": case.is_driven,
        "measured": " ".join(case.data.measured),
        "right": misfit - reference < SAME_OPTIMUM,
        "seconds": seconds,
        "excess": misfit - reference,
        "frequency_error": error,
    }


def _identified(case: BasinCase) -> tuple[float, float, float]:
    """Deviance but for a constant of the record, the largest relative error of the
    parameters that set the frequencies, and processor seconds.
    """
    began = time.process_time()
    try:
        fit = ph.identify(case.model, case.data)
    except SolveError:
        return np.inf, np.inf, time.process_time() - began
    seconds = time.process_time() - began
    names = case.frequency_parameters
    error = max(abs(fit.values[name] / case.truth[name] - 1) for name in names)
    return _misfit(case, fit.states[0]), error, seconds


def _misfit(case: BasinCase, states: np.ndarray) -> float:
    """The sum over channels of n_values log(mean squared residual)."""
    (run,) = case.data.trajectories
    total = 0.0
    for k in range(states.shape[1]):
        is_measured = np.isfinite(run.x[:, k])
        if is_measured.any():
            residual = (run.x[:, k] - states[:, k])[is_measured]
            total += is_measured.sum() * np.log(np.mean(residual**2))
    return float(total)


def summary(frame: pd.DataFrame) -> pd.DataFrame:
    """A row per setting and kind of machine, and one for all kinds together."""
    rows = []
    for (off, lacks), of_setting in frame.groupby(["off", "lacks"], sort=False):
        for kind in (*KINDS, "all"):
            own = of_setting[of_setting["kind"].eq(kind) | (kind == "all")]
            rows.append(
                {
                    "start off": f"{100 * float(str(off)):.0f} %",
                    "the model lacks": lacks,
                    "machine": kind,
                    "n": len(own),
                    "right": int(own["right"].sum()),
                    "CPU s": round(float(own["seconds"].sum()), 1),
                }
            )
    return pd.DataFrame(rows)


def page(frame: pd.DataFrame) -> str:
    """The result as Markdown."""
    asked = frame[(frame["off"] == SETTINGS[0].off) & (frame["lacks"] == NOTHING)]
    return render(
        "benchmarks/pages/basins.md",
        seeds=(frame["seed"].min(), frame["seed"].max()),
        summary=summary(frame),
        right=share(int(asked["right"].sum()), len(asked)),
        n=len(asked),
        wrong=frame[~frame["right"]],
    )


def main(first: int, settings: Sequence[Setting]) -> pd.DataFrame:
    """Machines of each kind in each setting, from a seed on."""
    rows = []
    for setting in settings:
        for seed in range(first, first + setting.n):
            for kind in KINDS:
                rows.append(row(kind, seed, setting))
                print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def recorded(number: int) -> pd.DataFrame:
    """Rows of one setting measured anew, with those of the others as they were."""
    new = main(FIRST_SEED, [SETTINGS[number]])
    new.insert(0, "setting", number)
    if TABLE.exists():
        known = pd.read_csv(TABLE)
        others = known[known["setting"] != number]
        new = pd.concat([others, new]).sort_values("setting", kind="stable")
    rewrite(TABLE, new, "%.6g")
    return new


if __name__ == "__main__":
    if flag("quick"):
        print(page(main(0, [replace(each, n=1) for each in SETTINGS])))
    elif flag("page"):
        write("basins.md", page(pd.read_csv(TABLE)))
    else:
        numbers = [int(text) for text in chosen()] or range(len(SETTINGS))
        for number in numbers:
            rows = recorded(number)
        write("basins.md", page(rows))

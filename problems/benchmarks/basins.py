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
from problems.tools import markdown
from problems.tools.command_line import chosen, flag
from problems.tools.intervals import share
from problems.tools.kept_tables import rewrite
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
    as_it_is = _identified(case)
    if setting.lacks == NOTHING:
        reference = _misfit(case, case.data.trajectories[0].x - case.noise)
    else:
        near = replace(case, model=case.model.with_values(case.truth))
        reference = min(_identified(near).misfit, as_it_is.misfit)
    return {
        "off": setting.off,
        "lacks": setting.lacks,
        "kind": kind,
        "seed": seed,
        "periods": case.n_periods,
        "samples": case.data.n_samples,
        "input": case.is_driven,
        "measured": " ".join(case.data.measured),
        "right": as_it_is.misfit - reference < SAME_OPTIMUM,
        "seconds": as_it_is.seconds,
        "excess": as_it_is.misfit - reference,
        "frequency_error": as_it_is.frequency_error,
    }


@dataclass(frozen=True)
class Found:
    """What one call of `identify` found.

    Attributes:
        misfit: deviance but for a constant of the record.
        frequency_error: of the parameters that set the frequencies, the largest
            relative error.
        seconds: of processor time.
    """

    misfit: float
    frequency_error: float
    seconds: float


def _identified(case: BasinCase) -> Found:
    began = time.process_time()
    try:
        fit = ph.identify(case.model, case.data)
    except SolveError:
        return Found(np.inf, np.inf, time.process_time() - began)
    seconds = time.process_time() - began
    errors = []
    for name in case.frequency_parameters:
        errors.append(abs(fit.values[name] / case.truth[name] - 1))
    return Found(_misfit(case, fit.states[0]), max(errors), seconds)


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
        groups = [(kind, of_setting[of_setting["kind"] == kind]) for kind in KINDS]
        for kind, of_kind in [*groups, ("all", of_setting)]:
            rows.append(
                {
                    "start off": f"{100 * float(str(off)):.0f} %",
                    "the model lacks": lacks,
                    "machine": kind,
                    **_shares(of_kind),
                }
            )
    return pd.DataFrame(rows)


def _shares(frame: pd.DataFrame) -> dict[str, object]:
    """What was right, and at what cost."""
    return {
        "n": len(frame),
        "right": int(frame["right"].sum()),
        "CPU s": round(float(frame["seconds"].sum()), 1),
    }


def page(frame: pd.DataFrame) -> str:
    """The result as Markdown."""
    first = int(frame["seed"].min())
    last = int(frame["seed"].max())
    wrong = frame[~frame["right"]]
    lines = ["# Starts far off along records of many periods", "", _what(first, last)]
    lines += ["", markdown.table(summary(frame)), "", _reading(frame), ""]
    if len(wrong):
        lines += ["## Those that are wrong", "", *markdown.frame(wrong)]
    return "\n".join(lines)


def _what(first: int, last: int) -> str:
    return markdown.paragraph(f"""
        Oscillators, pendulums and chains of two masses, 10 to 60 periods of the slowest
        motion in one record, 18 to 40 samples in a period, noise of 1 to 3 %, half of
        them with an input, positions alone or momenta too; seeds {first} to {last},
        which were not looked at while the method was developed. Parameters that set the
        frequencies start too small or too large by the share that is given, all others
        by up to half. Right is a fit that is no less likely than the true motion; where
        the model lacks a force (2 to 20 % of the springs'), than the likelier of the
        fits that begin at the true values and at the start. A pendulum that turns over
        has what drives it halved, because it would be chaotic.
        """)


def _reading(frame: pd.DataFrame) -> str:
    """What the table says, in a sentence."""
    asked = frame[(frame["off"] == SETTINGS[0].off) & (frame["lacks"] == NOTHING)]
    found = share(int(asked["right"].sum()), len(asked))
    return markdown.paragraph(f"""
        From starts half off, {found} of {len(asked)} are right.
        """)


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

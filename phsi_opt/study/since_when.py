"""Since when a missing force is there: from the start, or from a time on."""

from typing import Any

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import CERTAIN_FORCE
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import N_WINDOWS, THROUGHOUT, rms, window_of
from phsi_opt.presentation.content import Answer
from phsi_opt.presentation.durations import (
    date_words,
    dates_words,
    time_words,
    times_words,
)
from phsi_opt.presentation.sentences import say
from phsi_opt.statistics import TINY
from phsi_opt.study.answers import only_follows

# Share of the strongest run's force from which on another has it as well.
STRONG_RUN = 0.5
# Times that a force is stronger behind its beginning than before; where it follows a
# motion that decays or grows, parts of a run differ by less.
BEGINNING = 3.0
PARTS = 40  # of a run, among which its beginning is sought
# A force comes and goes where in so many stretches it is stronger than this share of
# its strongest one; a record is looked at in so many stretches.
STRETCHES = 20
# Share of a window's samples that lack a channel, from which on it is said.
GAP_IN_WINDOW = 0.1
STRONG_STRETCH = 1 / 3
FEWEST_BURSTS = 3


def since_when(diagnosis: Diagnosis, trained: Comparison) -> Answer:
    """Since when the surest missing force is there, in which runs, where most clearly.

    A beginning is told where one run alone has the force, which is several times weaker
    before it; the start only where the force is clear in the first tenth of every run
    that has it.

    Args:
        diagnosis: of a model.
        trained: the model on its training data.
    """
    force = diagnosis.analysis.force_in()
    if force.is_uncertain:
        return Answer("At no time surely.")
    record = force.record
    runs = [np.flatnonzero(record.run == k) for k in range(len(record.trajectories))]
    sizes = [rms(force.w[inside]) for inside in runs]
    n_strong = sum(size > STRONG_RUN * max(sizes) for size in sizes)
    strongest = runs[force.strongest_run]
    clear = [inside for inside in runs if _is_clear(force, inside)] or runs
    starts = [np.array_split(inside, N_WINDOWS)[0] for inside in clear]
    name = record.trajectories[force.strongest_run]
    facts: dict[str, Any] = {
        "begin": _beginning(force, strongest) if n_strong == 1 else "",
        "again": "again and again" if _comes_and_goes(force, strongest) else "",
        "n_runs": len(runs),
        "n_clear": len(clear),
        "is_from_start": all(_is_clear(force, one) for one in starts if len(one)),
        "window": _window(force),
        "run": name if len(runs) > 1 else "the training record",
        "gaps": gaps_of(diagnosis, force),
        "only_follows": only_follows(trained, diagnosis.base),
    }
    return say(__package__, "since", **facts)


def gaps_of(diagnosis: Diagnosis, force: EquationForce) -> list[str]:
    """Which channels lack samples where the force is strongest."""
    window = window_of(str(force.where["time_window"]))
    if window is None:
        return []
    data = diagnosis.data
    run = data.trajectories[data.trajectory_number(str(force.where["trajectory"]))]
    inside = (run.t >= window[0]) & (run.t <= window[1])
    shares = np.mean(np.isnan(run.x[inside]), axis=0)
    lacking = np.flatnonzero(shares > GAP_IN_WINDOW)
    return [data.states[k] for k in lacking if data.states[k] in data.measured]


def _comes_and_goes(force: EquationForce, inside: np.ndarray) -> bool:
    """Whether a run has several stretches of a clear force, and weak ones between."""
    stretches = np.array_split(inside, min(STRETCHES, len(inside)))
    sizes = np.array([rms(force.w[stretch]) for stretch in stretches])
    least = STRONG_STRETCH * np.max(sizes)
    if least < float(np.median(force.deviation[inside])):
        return False
    is_strong = (sizes > least).astype(int)
    return int(np.sum(np.diff(is_strong, prepend=0) > 0)) >= FEWEST_BURSTS


def _window(force: EquationForce) -> str:
    """The times at which the force is strongest; "" where none stand out."""
    times = str(force.where["time_window"])
    if THROUGHOUT in times:
        return ""
    record = force.record
    told = times_words(times, record.units.get("t", ""), float(record.t.max()))
    date = dates_words(times, record.origin_of(str(force.where["trajectory"])))
    return f"t = {told}{_in_brackets(date)}"


def _in_brackets(date: str) -> str:
    return f" ({date})" if date else ""


def _is_clear(force: EquationForce, inside: np.ndarray) -> bool:
    """Whether a part of the force exceeds its standard deviation."""
    typical = float(np.median(force.deviation[inside]))
    return rms(force.w[inside]) > CERTAIN_FORCE * typical


def _beginning(force: EquationForce, inside: np.ndarray) -> str:
    """The time before which the force is far weaker, in words; "": none is such."""
    record = force.record
    parts = np.array_split(inside, min(PARTS, len(inside)))
    sizes = [rms(force.w[part]) for part in parts]
    for part, size in zip(parts[1:], sizes[1:], strict=True):
        first = part[0]
        before = rms(force.w[inside[0] : first])
        after = rms(force.w[first : inside[-1] + 1])
        is_strong = size > STRONG_STRETCH * max(sizes)
        if is_strong and after > BEGINNING * max(before, TINY):
            t = float(record.t[first] - record.h[first] / 2)
            date = date_words(t, record.origin_of(str(force.where["trajectory"])))
            longest = float(record.t.max())
            told = time_words(t, record.units.get("t", ""), longest=longest)
            return told + _in_brackets(date)
    return ""

"""Since when a missing force is there, in words: from the start, or from a time on."""

import numpy as np

from phsi_opt.criteria import CERTAIN_FORCE
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.force_uncertainty import deviation_of
from phsi_opt.force_analysis.localization import N_WINDOWS, THROUGHOUT
from phsi_opt.presentation.durations import (
    date_words,
    dates_words,
    time_words,
    times_words,
)
from phsi_opt.presentation.numbers import capitalised
from phsi_opt.statistics import TINY

# Share of the strongest run's force from which on another has it as well.
STRONG_RUN = 0.5
# Times that a force is stronger behind its beginning than before; where it follows a
# motion that decays or grows, tenths differ by less.
BEGINNING = 3.0


def since_when(diagnosis: Diagnosis) -> str:
    """Since when the surest missing force is there, in which runs, where most clearly.

    A beginning is told where one run alone has the force, which is several times weaker
    before it; the start only where the force is clear in the first tenth of every run
    that has it.
    """
    force = EquationForce.of(diagnosis.analysis, None)
    if force.is_uncertain:
        return "At no time surely."
    runs = _runs(force)
    sizes = [_rms(force.w[inside]) for inside in runs]
    n_strong = sum(size > STRONG_RUN * max(sizes) for size in sizes)
    name = str(force.where["trajectory"])
    begin = None
    if n_strong == 1:
        begin = _beginning(force, runs[force.record.trajectories.index(name)])
    if begin is not None:
        return _since_then(force, begin)
    return _throughout(force, runs)


def _since_then(force: EquationForce, begin: float) -> str:
    """From a time on, which has a force before it that is far weaker."""
    record = force.record
    unit = record.units.get("t", "")
    name = str(force.where["trajectory"])
    origin = record.origin_of(name)
    of_run = name if len(record.trajectories) > 1 else "the training record"
    when = f"{time_words(begin, unit)}{_in_brackets(date_words(begin, origin))}"
    since = f"Far stronger from about t = {when} of {of_run} on"
    window = _window(force)
    return f"{since}; strongest at {window}." if window else f"{since}."


def _throughout(force: EquationForce, runs: list[np.ndarray]) -> str:
    """In which runs, from their start or not known how early, where most clearly."""
    clear = [inside for inside in runs if _is_clear(force, inside)] or runs
    starts = [np.array_split(inside, N_WINDOWS)[0] for inside in clear]
    is_from_start = all(_is_clear(force, start) for start in starts if len(start))
    n_others = len(runs) - len(clear)
    if len(runs) == 1:
        since = "from the start" if is_from_start else "throughout"
        of_run = " of the training record"
    else:
        which = f"in {len(clear)} of {len(runs)} runs"
        which = which if n_others else f"in all {len(runs)} runs"
        since = f"{which}, {'from their beginning' if is_from_start else 'throughout'}"
        of_run = f" of {force.where['trajectory']}"
    if n_others:
        others = "one" if n_others == 1 else str(n_others)
        since += f"; not seen clearly in the other {others}"
    window = _window(force)
    if not window:
        return capitalised(f"{since}; about as strong all the time.")
    most = "strongest at" if is_from_start else "seen most clearly at"
    return capitalised(f"{since}; {most} {window}{of_run}.")


def _window(force: EquationForce) -> str:
    """The times at which the force is strongest; "" where none stand out."""
    times = str(force.where["time_window"])
    if THROUGHOUT in times:
        return ""
    unit = force.record.units.get("t", "")
    origin = force.record.origin_of(str(force.where["trajectory"]))
    dates = _in_brackets(dates_words(times, origin))
    return f"t = {times_words(times, unit)}{dates}"


def _runs(force: EquationForce) -> list[np.ndarray]:
    """The intervals of each run."""
    record = force.record
    return [np.flatnonzero(record.run == k) for k in range(len(record.trajectories))]


def _is_clear(force: EquationForce, inside: np.ndarray) -> bool:
    """Whether a part of the force exceeds its standard deviation."""
    deviation = deviation_of(force.record.estimate)[inside, force.number]
    return _rms(force.w[inside]) > CERTAIN_FORCE * float(np.median(deviation))


def _in_brackets(date: str) -> str:
    return f" ({date})" if date else ""


def _beginning(force: EquationForce, inside: np.ndarray) -> float | None:
    """The time before which the force is far weaker; None: there is none such."""
    tenths = np.array_split(inside, min(N_WINDOWS, len(inside)))
    contrasts = []
    for k in range(1, len(tenths)):
        before = _rms(force.w[np.concatenate(tenths[:k])])
        after = _rms(force.w[np.concatenate(tenths[k:])])
        contrasts.append(after / max(before, TINY))
    if not contrasts or max(contrasts) < BEGINNING:
        return None
    first = tenths[int(np.argmax(contrasts)) + 1][0]
    return float(force.record.t[first] - force.record.h[first] / 2)


def _rms(w: np.ndarray) -> float:
    return float(np.sqrt(np.mean(w**2)))

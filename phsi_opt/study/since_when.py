"""Since when a missing force is there, in words: from the start, or from a time on."""

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import CERTAIN_FORCE
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import N_WINDOWS, THROUGHOUT, rms, window_of
from phsi_opt.force_analysis.units import spaced
from phsi_opt.presentation.content import Answer
from phsi_opt.presentation.durations import (
    date_words,
    dates_words,
    scale_of_time,
    times_words,
)
from phsi_opt.presentation.numbers import capitalised, lowered
from phsi_opt.statistics import TINY
from phsi_opt.study.certainty import only_follows

# Share of the strongest run's force from which on another has it as well.
STRONG_RUN = 0.5
# Times that a force is stronger behind its beginning than before; where it follows a
# motion that decays or grows, parts of a run differ by less.
BEGINNING = 3.0
PARTS = 40  # of a run, among which its beginning is sought
# A force comes and goes where in so many stretches it is stronger than this share of
# its strongest one; a record is looked at in so many stretches.
STRETCHES = 20
OF_RECORD = " of the training record"
FOLLOWED = (
    "All along the data held out; in the training data the parameters make up for it."
)
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
    strongest = runs[record.trajectories.index(str(force.where["trajectory"]))]
    begin = _beginning(force, strongest) if n_strong == 1 else None
    again = "again and again" if _comes_and_goes(force, strongest) else ""
    answer = _throughout(force, runs, again)
    if begin is not None:
        answer = _since_then(force, begin, again)
    lead = f"{answer.lead} {_gap_words(diagnosis, force)}".strip()
    if only_follows(trained, diagnosis.base):
        return Answer(FOLLOWED, f"The missing force is there: {lowered(lead)}")
    return Answer(lead, answer.detail)


def _gap_words(diagnosis: Diagnosis, force: EquationForce) -> str:
    """Which channels lack samples where the force is strongest; "" for none."""
    window = window_of(str(force.where["time_window"]))
    if window is None:
        return ""
    data = diagnosis.data
    run = data.trajectories[data.trajectory_number(str(force.where["trajectory"]))]
    inside = (run.t >= window[0]) & (run.t <= window[1])
    shares = np.mean(np.isnan(run.x[inside]), axis=0)
    gaps = [
        state
        for state, share in zip(data.states, shares, strict=True)
        if state in data.measured and share > GAP_IN_WINDOW
    ]
    if not gaps:
        return ""
    return f"Samples of {' and '.join(gaps)} are missing where it is strongest."


def _since_then(force: EquationForce, begin: float, again: str) -> Answer:
    """From a time on, which has a force before it that is far weaker."""
    record = force.record
    name = str(force.where["trajectory"])
    of_run = OF_RECORD if len(record.trajectories) == 1 else f" of {name}"
    scale = scale_of_time(float(record.t.max()), record.units.get("t", ""))
    date = _in_brackets(date_words(begin, record.origin_of(name)))
    when = f"{begin / scale.size:.3g}{spaced(scale.unit)}{date}"
    window = _window(force)
    strongest = f"Strongest at {window}{of_run}." if window else ""
    lead = ", ".join(filter(None, (f"From about t = {when} on", again)))
    return Answer(f"{lead}.", strongest)


def _throughout(force: EquationForce, runs: list[np.ndarray], again: str) -> Answer:
    """In which runs, from their start or not known how early, where most clearly."""
    clear = [inside for inside in runs if _is_clear(force, inside)] or runs
    starts = [np.array_split(inside, N_WINDOWS)[0] for inside in clear]
    is_from_start = all(_is_clear(force, start) for start in starts if len(start))
    n_others = len(runs) - len(clear)
    begin = "From the start" if is_from_start else "" if again else "All the time"
    which = ""
    of_run = OF_RECORD
    if len(runs) > 1:
        all_runs = "both" if len(runs) == 2 else f"all {len(runs)}"
        clear_ones = f"{len(clear)} of {len(runs)}" if n_others else all_runs
        which = f"in {clear_ones} training runs"
        of_run = f" of {force.where['trajectory']}"
    lead = capitalised(", ".join(filter(None, (begin, again, which))))
    told = []
    window = _window(force)
    if window:
        most = "Strongest" if is_from_start else "Seen most clearly"
        told.append(f"{most} at {window}{of_run}.")
    elif not again:
        told.append("About as strong all the time.")
    if n_others:
        others = "one" if n_others == 1 else str(n_others)
        told.append(f"Not seen clearly in the other {others}.")
    return Answer(f"{lead}.", " ".join(told))


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
    origin = record.origin_of(str(force.where["trajectory"]))
    told = times_words(times, record.units.get("t", ""), float(record.t.max()))
    return f"t = {told}{_in_brackets(dates_words(times, origin))}"


def _is_clear(force: EquationForce, inside: np.ndarray) -> bool:
    """Whether a part of the force exceeds its standard deviation."""
    typical = float(np.median(force.deviation[inside]))
    return rms(force.w[inside]) > CERTAIN_FORCE * typical


def _in_brackets(date: str) -> str:
    return f" ({date})" if date else ""


def _beginning(force: EquationForce, inside: np.ndarray) -> float | None:
    """The time before which the force is far weaker; None: there is none such."""
    parts = np.array_split(inside, min(PARTS, len(inside)))
    sizes = [rms(force.w[part]) for part in parts]
    for part, size in zip(parts[1:], sizes[1:], strict=True):
        first = part[0]
        before = rms(force.w[inside[0] : first])
        after = rms(force.w[first : inside[-1] + 1])
        is_strong = size > STRONG_STRETCH * max(sizes)
        if is_strong and after > BEGINNING * max(before, TINY):
            return float(force.record.t[first] - force.record.h[first] / 2)
    return None

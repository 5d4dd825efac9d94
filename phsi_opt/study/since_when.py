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
from phsi_opt.presentation.numbers import lowered
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
GAP_IN_WINDOW = (
    0.1  # share of a window's samples that lack a channel, from which on it is said
)
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
    runs = _runs(force)
    sizes = [rms(force.w[inside]) for inside in runs]
    n_strong = sum(size > STRONG_RUN * max(sizes) for size in sizes)
    strongest = runs[force.record.trajectories.index(str(force.where["trajectory"]))]
    begin = _beginning(force, strongest) if n_strong == 1 else None
    is_in_bursts = _comes_and_goes(force, strongest)
    if begin is not None:
        answer = _since_then(force, begin, is_in_bursts)
    else:
        answer = _throughout(force, runs, is_in_bursts)
    gaps = _gap_words(diagnosis, force)
    lead = f"{answer.lead} {gaps}".strip()
    if only_follows(trained, diagnosis.base):
        return Answer(FOLLOWED, f"The missing force is there: {lowered(lead)}")
    return Answer(lead, answer.detail)


def _gap_words(diagnosis: Diagnosis, force: EquationForce) -> str:
    """Which channels lack samples where the force is strongest; "" for none."""
    name = str(force.where["trajectory"])
    window = window_of(str(force.where["time_window"]))
    data = diagnosis.data
    run = data.trajectories[data.trajectory_number(name)]
    if window is None:
        return ""
    inside = (run.t >= window[0]) & (run.t <= window[1])
    gaps = []
    for k, state in enumerate(data.states):
        if (
            state in data.measured
            and np.mean(np.isnan(run.x[inside, k])) > GAP_IN_WINDOW
        ):
            gaps.append(state)
    if not gaps:
        return ""
    return f"Samples of {' and '.join(gaps)} are missing where it is strongest."


def _since_then(force: EquationForce, begin: float, is_in_bursts: bool) -> Answer:
    """From a time on, which has a force before it that is far weaker."""
    record = force.record
    unit = record.units.get("t", "")
    name = str(force.where["trajectory"])
    origin = record.origin_of(name)
    is_one = len(record.trajectories) == 1
    of_run = OF_RECORD if is_one else f" of {name}"
    scale = scale_of_time(float(record.t.max()), unit)
    when = f"{begin / scale.size:.3g}{spaced(scale.unit)}"
    when += _in_brackets(date_words(begin, origin))
    again = ", again and again" if is_in_bursts else ""
    window = _window(force)
    strongest = f"Strongest at {window}{of_run}." if window else ""
    return Answer(f"From about t = {when} on{again}.", strongest)


def _throughout(
    force: EquationForce, runs: list[np.ndarray], is_in_bursts: bool
) -> Answer:
    """In which runs, from their start or not known how early, where most clearly."""
    clear = [inside for inside in runs if _is_clear(force, inside)] or runs
    starts = [np.array_split(inside, N_WINDOWS)[0] for inside in clear]
    is_from_start = all(_is_clear(force, start) for start in starts if len(start))
    n_others = len(runs) - len(clear)
    lead = "From the start" if is_from_start else "All the time"
    if is_in_bursts:
        lead = "From the start, again and again" if is_from_start else "Again and again"
    of_run = OF_RECORD
    if len(runs) > 1:
        all_runs = "both" if len(runs) == 2 else f"all {len(runs)}"
        which = f"{len(clear)} of {len(runs)}" if n_others else all_runs
        lead += f", in {which} training runs"
        of_run = f" of {force.where['trajectory']}"
    told = []
    window = _window(force)
    if window:
        most = "Strongest" if is_from_start else "Seen most clearly"
        told.append(f"{most} at {window}{of_run}.")
    elif not is_in_bursts:
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
    deviation = force.deviation[inside]
    if least < float(np.median(deviation)):
        return False
    is_strong = (sizes > least).astype(int)
    n_bursts = int(np.sum(np.diff(is_strong, prepend=0) > 0))
    return n_bursts >= FEWEST_BURSTS


def _window(force: EquationForce) -> str:
    """The times at which the force is strongest; "" where none stand out."""
    times = str(force.where["time_window"])
    if THROUGHOUT in times:
        return ""
    record = force.record
    origin = record.origin_of(str(force.where["trajectory"]))
    dates = _in_brackets(dates_words(times, origin))
    longest = float(record.t.max())
    return f"t = {times_words(times, record.units.get('t', ''), longest)}{dates}"


def _runs(force: EquationForce) -> list[np.ndarray]:
    """The intervals of each run."""
    record = force.record
    return [np.flatnonzero(record.run == k) for k in range(len(record.trajectories))]


def _is_clear(force: EquationForce, inside: np.ndarray) -> bool:
    """Whether a part of the force exceeds its standard deviation."""
    deviation = force.deviation[inside]
    return rms(force.w[inside]) > CERTAIN_FORCE * float(np.median(deviation))


def _in_brackets(date: str) -> str:
    return f" ({date})" if date else ""


def _beginning(force: EquationForce, inside: np.ndarray) -> float | None:
    """The time before which the force is far weaker; None: there is none such."""
    parts = np.array_split(inside, min(PARTS, len(inside)))
    sizes = [rms(force.w[part]) for part in parts]
    for k in range(1, len(parts)):
        before = rms(force.w[np.concatenate(parts[:k])])
        after = rms(force.w[np.concatenate(parts[k:])])
        is_strong = sizes[k] > STRONG_STRETCH * max(sizes)
        if is_strong and after > BEGINNING * max(before, TINY):
            first = parts[k][0]
            return float(force.record.t[first] - force.record.h[first] / 2)
    return None

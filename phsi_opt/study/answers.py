"""The answers to what is wrong, where, and what to do, of one diagnosis.

Report and page tell them on their first screens; a report's paragraph on each step has
them too. Here are the facts; the sentences stand in ``words.jinja``.
"""

from typing import Any

import numpy as np
import pandas as pd

from phsi_opt.comparison.compare import Comparison, is_failing
from phsi_opt.criteria import CERTAIN_FORCE
from phsi_opt.diagnosis.candidate import Candidate, Finding, Grade, Verdict
from phsi_opt.diagnosis.record import PROPOSED_EXPERIMENT, Diagnosis
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import N_WINDOWS
from phsi_opt.force_analysis.next_step import likely_cause
from phsi_opt.force_analysis.words import VIBRATION_WORDS, place_answer
from phsi_opt.model.laws import is_second_storage
from phsi_opt.presentation.content import Answer
from phsi_opt.presentation.durations import date_words, time_words
from phsi_opt.presentation.numbers import listed, number, with_error
from phsi_opt.presentation.sentences import say
from phsi_opt.presentation.units import spaced
from phsi_opt.statistics import TINY, rms

FAST_DISTURBANCE = "fast disturbance"
NEAR_FLOOR = 1.1  # times the noise floor: the error of what is fitted to the noise


def answer(name: str, diagnosis: Diagnosis, is_held_out: bool, **more: Any) -> Answer:
    """What ``words.jinja`` says under a name of a diagnosis.

    Args:
        name: such as "missing", "wrong", "to_do" or "certainty".
        diagnosis: of a model.
        is_held_out: whether data held out judge.
        **more: facts beside those of the diagnosis.
    """
    force = diagnosis.analysis.force_in()
    strength = float(force.where["strength"]) / force.scale.size
    facts = {
        "d": diagnosis,
        "force": force,
        "units": diagnosis.record.data.units,
        "which": "held-out" if is_held_out else "training",
        "judged": "data not used for fitting" if is_held_out else "the training data",
        "ratio": diagnosis.base.rmse / diagnosis.base.noise_floor,
        # Times the noise floor up to which an error is that of the noise, and from
        # which it alone says that something is missing.
        "at_noise": 1.05,
        "sure_error": 1.5,
        "strength": f"{number(strength, 3)}{spaced(force.scale.unit)} (rms)",
        "classes": list(map(class_of, diagnosis.findings)),
        "has_class": not all(finding.is_name for finding in diagnosis.findings),
        "disturbance": disturbance_word(diagnosis),
        "nearest": nearest_candidate(diagnosis),
        "vibration": VIBRATION_WORDS,
        "experiment": PROPOSED_EXPERIMENT,
        "fall_with": lambda candidate: 100 * _fall_with(diagnosis, candidate),
        "is_at_floor": lambda found: not is_failing(found),
        "off_channels": off_channels,
        "evidence_words": evidence_words,
        "found": list(map(finding_words, diagnosis.findings)),
        "likely_cause": likely_cause,
        "is_second_storage": is_second_storage,
    }
    return say(__package__, name, **facts, **more)


def where_answer(diagnosis: Diagnosis, is_past: bool = False) -> Answer:
    """The equation, what the force follows, or else the place where it is largest.

    What a cause explains is told where nothing has a name; the effect that is found, or
    was added, says it better.
    """
    force = diagnosis.analysis.force_in()
    if force.is_uncertain:
        return answer("where", diagnosis, is_held_out=True)
    is_known = is_past or diagnosis.verdict == Verdict.NAMED
    place = place_answer(force, is_past or bool(diagnosis.findings), is_known)
    # Where the members of the classes that were found act, each place once.
    places: dict[str, None] = {}
    for finding in diagnosis.findings:
        for effect in () if finding.is_name else finding.effects:
            at = f"in d{effect.equation}/dt"
            if effect.slot == "sensor":
                at = f"at the sensor of {effect.equation}"
            places[at] = None
    return answer(
        "where", diagnosis, is_held_out=True, place=place, places=list(places)
    )


# ---- facts ---------------------------------------------------------------------------


def class_of(finding: Finding) -> str:
    """What was found, with the others of its class."""
    return " or ".join(map(str, finding.effects))


def finding_words(finding: Finding) -> str:
    """An effect with its size, and the others of its class."""
    first = str(finding.effects[0])
    size = with_error(finding.coefficient, finding.std_error)
    return f"{first}, {size}{spaced(finding.unit)}{alternatives(finding, first)}"


def alternatives(finding: Finding, name: str) -> str:
    """The other members of a class, in brackets; "" where there are none."""
    others = ", ".join(one for one in map(str, finding.effects) if one != name)
    return f" (or {others}: the data do not tell)" if others else ""


def evidence_words(candidate: Candidate) -> str:
    """How clearly an effect is there, such as "decisive, log evidence 95"."""
    if not candidate.was_weighed:
        return "not weighed"
    return f"{candidate.grade}, log evidence {number(candidate.log_evidence, 2)}"


def nearest_candidate(diagnosis: Diagnosis) -> Candidate | None:
    """What comes nearest where something is missing and nothing is named.

    That is the likeliest effect, if there is any evidence of it; None where not.
    """
    if diagnosis.verdict != Verdict.UNEXPLAINED or not diagnosis.ranking:
        return None
    first = diagnosis.ranking[0]
    return None if first.grade == Grade.NONE else first


def _fall_with(diagnosis: Diagnosis, candidate: Candidate) -> float:
    """The share of the error that it takes away; 0 where that is not known."""
    found = candidate.comparison
    return 0.0 if found is None else 1 - found.rmse / diagnosis.base.rmse


def disturbance_word(diagnosis: Diagnosis) -> str:
    """What stands beside a verdict whose force shakes; "" for others."""
    force = diagnosis.analysis.force_in()
    is_open = not diagnosis.findings and not force.is_uncertain
    is_missing = diagnosis.verdict != Verdict.NOTHING_MISSING
    is_fast = is_missing and is_open and force.pace.is_vibration
    return FAST_DISTURBANCE if is_fast else ""


def samples_to_average(diagnosis: Diagnosis) -> int:
    """How many samples hide a force that shakes in their mean; 0 where none does."""
    if not disturbance_word(diagnosis):
        return 0
    return diagnosis.analysis.force_in().pace.samples_per_cycle


def undetermined_words(parameters: pd.DataFrame) -> str:
    """The parameters whose standard error exceeds their value; "" for none.

    Args:
        parameters: of a fit: name, value, std_error.
    """
    value = parameters["value"].to_numpy(dtype=float)
    error = parameters["std_error"].to_numpy(dtype=float)
    is_open = np.isfinite(error) & (error > np.abs(value))
    names = list(map(str, parameters["name"][is_open]))
    if not names:
        return ""
    return (
        f"Parameters that these data do not determine: {listed(names)} "
        "(standard error above the value); do not rely on them."
    )


def off_channels(judged: Comparison) -> pd.DataFrame:
    """The three channels that are farthest off, the worst first.

    As in `Comparison.table`, with the shares of their movement that the model is off,
    and that the noise alone is, in percent.
    """
    table = judged.table.assign(off=100 - judged.table["fit_percent"])
    ratio: pd.Series = table["noise_floor"] / table["rmse"].clip(lower=TINY)
    table["noise"] = table["off"] * ratio
    worst = np.argsort(-np.nan_to_num(table["off"].to_numpy(float)), kind="stable")
    return table.iloc[worst[:3]]


def only_follows(trained: Comparison, judged: Comparison) -> bool:
    """Whether a model fits its training data to the noise, and no other data."""
    floor = judged.noise_floor
    return trained.rmse < NEAR_FLOOR * floor and judged.rmse > 2 * floor


# ---- since when ----------------------------------------------------------------------

STRONG_STRETCH = 1 / 3  # share of the strongest stretch's force, of one that counts


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
    n_strong = np.sum(np.array(sizes) > max(sizes) / 2)
    strongest = runs[force.strongest_run]
    clear = [inside for inside in runs if _is_clear(force, inside)] or runs
    starts = [np.array_split(inside, N_WINDOWS)[0] for inside in clear]
    window = force.window_words(longest=float(record.t.max()))
    facts: dict[str, Any] = {
        "begin": _beginning(force, strongest) if n_strong == 1 else "",
        "again": "again and again" if _comes_and_goes(force, strongest) else "",
        "n_runs": len(runs),
        "n_clear": len(clear),
        "is_from_start": all(_is_clear(force, one) for one in starts if len(one)),
        "window": f"t = {window}" if window else "",
        "run": force.window.trajectory if len(runs) > 1 else "the training record",
        "gaps": gaps_of(diagnosis, force),
        "only_follows": only_follows(trained, diagnosis.base),
    }
    return say(__package__, "since", **facts)


def gaps_of(diagnosis: Diagnosis, force: EquationForce) -> list[str]:
    """Which channels lack a tenth of the samples where the force is strongest."""
    window = force.window
    if window.is_whole:
        return []
    data = diagnosis.data
    run = data.trajectories[data.trajectory_number(window.trajectory)]
    inside = (run.t >= window.begin) & (run.t <= window.end)
    shares = np.mean(np.isnan(run.x[inside]), axis=0)
    lacking = np.flatnonzero(shares > 0.1)
    return [data.states[k] for k in lacking if data.states[k] in data.measured]


def _comes_and_goes(force: EquationForce, inside: np.ndarray) -> bool:
    """Whether a run has several stretches of a clear force, and weak ones between.

    It is looked at in twenty stretches.
    """
    stretches = np.array_split(inside, min(20, len(inside)))
    sizes = np.array([rms(force.w[stretch]) for stretch in stretches])
    least = STRONG_STRETCH * np.max(sizes)
    if least < float(np.median(force.deviation[inside])):
        return False
    is_strong = (sizes > least).astype(int)
    return int(np.sum(np.diff(is_strong, prepend=0) > 0)) >= 3


def _is_clear(force: EquationForce, inside: np.ndarray) -> bool:
    """Whether a part of the force exceeds its standard deviation."""
    typical = float(np.median(force.deviation[inside]))
    return rms(force.w[inside]) > CERTAIN_FORCE * typical


def _beginning(force: EquationForce, inside: np.ndarray) -> str:
    """The time before which the force is far weaker, in words; "": none is such.

    A third: parts of a run in which a force follows a motion that decays or grows
    differ by less.
    """
    record = force.record
    parts = np.array_split(inside, min(40, len(inside)))
    sizes = [rms(force.w[part]) for part in parts]
    for part, size in zip(parts[1:], sizes[1:], strict=True):
        first = part[0]
        before = rms(force.w[inside[0] : first])
        after = rms(force.w[first : inside[-1] + 1])
        is_strong = size > STRONG_STRETCH * max(sizes)
        if is_strong and after > 3 * max(before, TINY):
            t = float(record.t[first] - record.h[first] / 2)
            date = date_words(t, record.origin_of(force.window.trajectory))
            longest = float(record.t.max())
            told = time_words(t, record.units.get("t", ""), longest=longest)
            return told + (f" ({date})" if date else "")
    return ""

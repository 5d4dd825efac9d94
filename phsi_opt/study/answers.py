"""The answers to what is wrong, where, and what to do, of one diagnosis.

Report and page tell them on their first screens; a report's paragraph on each step has
them too. Here are the facts; the sentences stand in ``words.jinja``.
"""

from typing import Any

import numpy as np
import pandas as pd

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import FAILING_ERROR
from phsi_opt.diagnosis.candidate import Candidate, Grade
from phsi_opt.diagnosis.finding import Finding
from phsi_opt.diagnosis.next_step import PROPOSED_EXPERIMENT
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.next_step import likely_cause
from phsi_opt.force_analysis.units import spaced
from phsi_opt.force_analysis.words import VIBRATION_WORDS, place_answer
from phsi_opt.model.laws import is_second_storage
from phsi_opt.presentation.content import Answer
from phsi_opt.presentation.numbers import listed, number, with_error
from phsi_opt.presentation.sentences import say
from phsi_opt.presentation.units import scale_of_errors
from phsi_opt.statistics import TINY

# Times the noise floor from which an error alone says that something is missing.
SURE_ERROR = 1.5
AT_NOISE = 1.05  # times the noise floor up to which an error is that of the noise
FAST_DISTURBANCE = "fast disturbance"
MOST_CHANNELS = 3  # that are told, the worst first
# Errors over the noise floor: of training data that are fitted to the noise, and of
# data held out that are not foretold.
NEAR_FLOOR = 1.1
FAR_ABOVE_FLOOR = 2.0
PERCENT = 100.0  # of a whole


def answer(name: str, diagnosis: Diagnosis, is_held_out: bool, **more: Any) -> Answer:
    """What ``words.jinja`` says under a name of a diagnosis.

    Args:
        name: such as "missing", "wrong", "to_do" or "certainty".
        diagnosis: of a model.
        is_held_out: whether data held out judge.
        **more: facts beside those of the diagnosis.
    """
    force = diagnosis.analysis.force_in()
    facts = {
        "d": diagnosis,
        "force": force,
        "units": diagnosis.record.data.units,
        "which": "held-out" if is_held_out else "training",
        "judged": "data not used for fitting" if is_held_out else "the training data",
        "ratio": diagnosis.base.rmse / diagnosis.base.noise_floor,
        "at_noise": AT_NOISE,
        "sure_error": SURE_ERROR,
        "strength": strength_words(force),
        "classes": [class_of(finding) for finding in diagnosis.findings],
        "has_class": not all(finding.is_name for finding in diagnosis.findings),
        "disturbance": disturbance_word(diagnosis),
        "nearest": nearest_candidate(diagnosis),
        "vibration": VIBRATION_WORDS,
        "experiment": PROPOSED_EXPERIMENT,
        "fall_with": lambda candidate: PERCENT * _fall_with(diagnosis, candidate),
        "is_at_floor": _is_at_floor,
        "off_words": off_words,
        "evidence_words": evidence_words,
        "found": [finding_words(finding) for finding in diagnosis.findings],
        "likely_cause": likely_cause,
        "is_second_storage": is_second_storage,
        "scale_of_errors": scale_of_errors,
        "spaced": spaced,
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
    places = _open_places(diagnosis)
    return answer("where", diagnosis, is_held_out=True, place=place, places=places)


def _open_places(diagnosis: Diagnosis) -> list[str]:
    """Where the members of the classes that were found act, each place once."""
    places = []
    for finding in diagnosis.findings:
        for effect in () if finding.is_name else finding.effects:
            at = f"in d{effect.equation}/dt"
            if effect.slot == "sensor":
                at = f"at the sensor of {effect.equation}"
            places.append(at)
    return list(dict.fromkeys(places))


# ---- facts ---------------------------------------------------------------------------


def strength_words(force: EquationForce) -> str:
    """Root mean square of a missing force with its unit."""
    strength = float(force.where["strength"]) / force.scale.size
    return f"{number(strength, 3)}{spaced(force.scale.unit)} (rms)"


def class_of(finding: Finding) -> str:
    """What was found, with the others of its class."""
    return " or ".join(map(str, finding.effects))


def finding_words(finding: Finding) -> str:
    """An effect with its size, and the others of its class."""
    first, *others = map(str, finding.effects)
    size = with_error(finding.coefficient, finding.std_error)
    told = f"{first}, {size}{spaced(finding.unit)}"
    if not others:
        return told
    return f"{told} (or {', '.join(others)}: the data do not tell)"


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


def _is_at_floor(found: Comparison) -> bool:
    return found.rmse <= FAILING_ERROR * found.noise_floor


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
    names = [str(name) for name in parameters["name"][is_open]]
    if not names:
        return ""
    return (
        f"Parameters that these data do not determine: {listed(names)} "
        "(standard error above the value); do not rely on them."
    )


def off_words(judged: Comparison) -> list[str]:
    """Such as "q by 0.122 rad (6.7 % of its movement; noise alone 0.1 %)".

    Each of the channels that are farthest off, the worst first.
    """
    table = judged.table
    shares = PERCENT - table["fit_percent"].to_numpy(dtype=float)
    worst = np.argsort(-np.nan_to_num(shares), kind="stable")[:MOST_CHANNELS]
    return [_channel_words(table.iloc[k]) for k in worst.tolist()]


def _channel_words(row: pd.Series) -> str:
    rmse = float(row["rmse"])
    share = PERCENT - float(row["fit_percent"])
    noise = share * float(row["noise_floor"]) / max(rmse, TINY)
    size = f"{number(rmse, 3)}{spaced(str(row['unit']))}"
    beside = f"{number(share, 2)} % of its movement"
    if share >= PERCENT:
        beside = f"{number(share, 3)} % of its movement: a constant would do better"
    return f"{row['state']} by {size} ({beside}; noise alone {number(noise, 2)} %)"


def only_follows(trained: Comparison, judged: Comparison) -> bool:
    """Whether a model fits its training data to the noise, and no other data."""
    floor = judged.noise_floor
    is_fitted = trained.rmse < NEAR_FLOOR * floor
    return is_fitted and judged.rmse > FAR_ABOVE_FLOOR * floor

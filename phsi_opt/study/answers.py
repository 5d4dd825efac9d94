"""The answers to what is wrong, where, and what to do, of one diagnosis.

Report and page tell them on their first screens; a report's paragraph on each step has
them too. Each begins with what is to be understood at once; the numbers come behind.
"""

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import FAILING_ERROR
from phsi_opt.diagnosis.candidate import Candidate, Grade
from phsi_opt.diagnosis.finding import Finding
from phsi_opt.diagnosis.next_step import PROPOSED_EXPERIMENT
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.next_step import likely_cause
from phsi_opt.force_analysis.pace import Pace
from phsi_opt.force_analysis.units import spaced
from phsi_opt.force_analysis.words import VIBRATION_WORDS, place_answer
from phsi_opt.model.laws import is_second_storage
from phsi_opt.model.model import Model
from phsi_opt.model.structure import position_of_momentum
from phsi_opt.presentation.content import Answer
from phsi_opt.presentation.numbers import capitalised, lowered, number, with_error
from phsi_opt.presentation.units import scale_of_errors
from phsi_opt.study.certainty import (
    disturbance_word,
    evidence_words,
    judged_words,
    no_noise_words,
    off_words,
)

QUADRATIC_INPUT = "quadratic input"


# ---- what is missing


def missing_answer(diagnosis: Diagnosis, is_held_out: bool) -> Answer:
    """What is missing, and how far that explains the error.

    What has no name is told by its likely cause, a force that shakes by its speed.
    """
    if diagnosis.findings:
        return Answer(_missing_words(diagnosis), _gain_words(diagnosis, is_held_out))
    force = diagnosis.analysis.force_in()
    if force.is_uncertain:
        lead = f"{no_noise_words(diagnosis)}; no missing force is sure"
    elif force.pace.is_vibration:
        return Answer(f"Something swings {_speed(force)}: {VIBRATION_WORDS}.")
    else:
        cause = likely_cause(force.record.units, force)
        lead = cause or "Something is missing"
    return Answer(f"{'; '.join(filter(None, (lead, _tried_words(diagnosis))))}.")


def _tried_words(diagnosis: Diagnosis) -> str:
    """That nothing that was tried is it; "" where nothing was."""
    n_tried = len(diagnosis.ranking)
    nearest = nearest_candidate(diagnosis)
    fall = 0.0 if nearest is None else _fall_with(diagnosis, nearest)
    if fall > 0 and n_tried > 1:
        percent = number(100 * fall, 2)
        return f"the nearest of {n_tried} effects takes away {percent} % of the error"
    if n_tried == 1:
        return "the one effect tried does not explain it"
    return f"none of the {n_tried} effects tried explains it" if n_tried else ""


def _missing_words(diagnosis: Diagnosis) -> str:
    """The names of what is missing, in a sentence."""
    model = diagnosis.base.model
    told = [
        _plainly(finding, model) or class_of(finding) for finding in diagnosis.findings
    ]
    names = capitalised(" and ".join(told))
    return f"{names} {'is' if len(told) == 1 else 'are'} missing."


def _gain_words(diagnosis: Diagnosis, is_held_out: bool) -> str:
    """By how much the error falls with what is named, and whether more is missing."""
    found = diagnosis.ranking[0].comparison
    rest = "what else is missing is not known yet"
    is_all = diagnosis.verdict == Verdict.NAMED
    if found is None:
        return "" if is_all else f"{capitalised(rest)}."
    with_them = "With them"
    if len(diagnosis.findings) == 1:
        with_them = "With it" if diagnosis.findings[0].is_name else "With the first"
    which = "held-out" if is_held_out else "training"
    if _is_at_floor(found):
        return f"{with_them}, the {which} error falls to the noise."
    percent = number(100 * (1 - found.rmse / diagnosis.base.rmse), 2)
    said = f"{with_them}, the {which} error falls by {percent} %"
    return f"{said}." if is_all else f"{said}; {rest}."


def _plainly(finding: Finding, model: Model) -> str:
    """What an effect is where its name alone says little; "" for others."""
    effect = finding.effects[0]
    if not finding.is_name or not effect.name.startswith(QUADRATIC_INPUT):
        return ""
    (term,) = effect.term
    is_force = effect.equation in position_of_momentum(model)
    what = "a force" if is_force else "something"
    law = term.body.replace("**", "^")
    return f"{effect} ({what} in proportion to {law})"


def _speed(force: EquationForce) -> str:
    pace: Pace = force.pace
    return pace.speed_words(force.record.units)


# ---- what is wrong


def wrong_answer(diagnosis: Diagnosis, is_held_out: bool) -> Answer:
    """How far the simulated model is off, and how large the missing force is."""
    worst, *others = off_words(diagnosis.base)
    force = diagnosis.analysis.force_in()
    told = f"Simulated on {judged_words(is_held_out)}"
    told += f"; it also misses {' and '.join(others)}." if others else "."
    lacking = "" if force.is_uncertain else _lacking(force)
    return Answer(f"The model misses {worst}.", f"{told} {lacking}".strip())


def _lacking(force: EquationForce) -> str:
    """Size of the missing force, alone and beside the rate that the model has."""
    beside = force.pace.size_words(f"d{force.equation}/dt")
    said = f"The model's d{force.equation}/dt is off by {strength_words(force)}"
    return f"{said}, {beside}." if beside else f"{said}."


def was_wrong_words(diagnosis: Diagnosis, whose: str) -> str:
    """What a model lacked, and how much of it, told when it was added."""
    force = diagnosis.analysis.force_in()
    size = strength_words(force)
    if force.is_uncertain:
        return f"The residuals showed it; no missing force was sure: {size}."
    names = " and ".join(map(class_of, diagnosis.findings))
    verb = "was" if len(diagnosis.findings) == 1 else "were"
    begin = f"{names} {verb} missing: " if names else ""
    return capitalised(f"{begin}{whose} d{force.equation}/dt was off by {size}.")


def strength_words(force: EquationForce) -> str:
    """Root mean square of a missing force with its unit."""
    scale = force.scale
    strength = float(force.where["strength"]) / scale.size
    return f"{number(strength, 3)}{spaced(scale.unit)} (rms)"


def class_of(finding: Finding) -> str:
    """What was found, with the others of its class."""
    return " or ".join(str(effect) for effect in finding.effects)


# ---- where


def where_answer(diagnosis: Diagnosis, is_past: bool = False) -> Answer:
    """The equation, what the force follows, or else the place where it is largest.

    What a cause explains is told where nothing has a name; the effect that is found, or
    was added, says it better.
    """
    force = diagnosis.analysis.force_in()
    if force.is_uncertain:
        return Answer("No equation, time or region stands out.")
    is_known = is_past or diagnosis.verdict == Verdict.NAMED
    is_named = is_past or bool(diagnosis.findings)
    answer = place_answer(force, is_named, is_known)
    places = _open_places(diagnosis)
    if len(places) < 2:
        return answer
    lead = f"Either {' or '.join(places)}: the data do not tell."
    return Answer(lead, f"As a force it shows {lowered(str(answer))}")


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


# ---- what to do


def to_do_answer(diagnosis: Diagnosis, is_held_out: bool) -> Answer:
    """What to add, with what that leaves; or what to do where nothing is named."""
    if diagnosis.findings:
        return _addition(diagnosis, is_held_out)
    advice = diagnosis.next_step
    nearest = nearest_candidate(diagnosis)
    if nearest is None:
        return advice
    told = f"{nearest.name} ({evidence_words(nearest)})"
    against = ""
    if nearest.grade == Grade.DECISIVE:  # else the grade says it
        against, _, _ = nearest.lost.partition(" (")
    reason = f"; {against}" if against else ""
    fall = _fall_with(diagnosis, nearest)
    less = f": {number(100 * fall, 2)} % less error" if fall > 0 else ""
    if is_second_storage(nearest.effect):
        lead = f"Try {nearest.name}{less}, but not proven."
        return Answer(lead, f"{told}{reason}. {advice.detail}")
    told = f"Nearest of the catalogue is {told}{less}, but not proven{reason}."
    return Answer(advice.lead, f"{advice.detail} {told}".strip())


def samples_to_average(diagnosis: Diagnosis) -> int:
    """How many samples hide a force that shakes in their mean; 0 where none does."""
    if not disturbance_word(diagnosis):
        return 0
    return diagnosis.analysis.force_in().pace.samples_per_cycle


def nearest_candidate(diagnosis: Diagnosis) -> Candidate | None:
    """What comes nearest where something is missing and nothing is named.

    That is the likeliest effect, if there is any evidence of it; None where not.
    """
    if diagnosis.verdict != Verdict.UNEXPLAINED or not diagnosis.ranking:
        return None
    first = diagnosis.ranking[0]
    return None if first.grade == Grade.NONE else first


def _addition(diagnosis: Diagnosis, is_held_out: bool) -> Answer:
    told = capitalised("; ".join(map(finding_words, diagnosis.findings)))
    outcome = _outcome(diagnosis, is_held_out)
    if diagnosis.verdict != Verdict.NAMED:
        outcome += f" Then diagnose again: what is left is {_left_words(diagnosis)}."
    if any(not finding.is_name for finding in diagnosis.findings):
        outcome += f" Which of them, an experiment tells; {PROPOSED_EXPERIMENT}."
    return Answer(f"{told}.", outcome.strip())


def _left_words(diagnosis: Diagnosis) -> str:
    """How much is left with what is proposed, beside the noise."""
    found = diagnosis.ranking[0].comparison
    if found is None or _is_at_floor(found):
        return "more than noise"
    return f"{number(found.rmse / found.noise_floor, 2)} times the noise"


def finding_words(finding: Finding) -> str:
    """An effect with its size, and the others of its class."""
    size = with_error(finding.coefficient, finding.std_error)
    text = f"{finding.effects[0]}, {size}{spaced(finding.unit)}"
    if finding.is_name:
        return text
    others = ", ".join(str(other) for other in finding.effects[1:])
    return f"{text} (or {others}: the data do not tell)"


def _outcome(diagnosis: Diagnosis, is_held_out: bool) -> str:
    """To what the error falls with what is proposed, where that is known."""
    found = diagnosis.ranking[0].comparison
    if found is None:
        return ""
    size, unit = scale_of_errors(found.error_unit)
    which = "held-out" if is_held_out else "training"
    before = number(size * diagnosis.base.rmse, 3)
    after = f"{number(size * found.rmse, 3)}{spaced(unit)}"
    floor = f"noise floor {number(size * found.noise_floor, 3)}"
    at = "at the " if _is_at_floor(found) else ""
    return f"The {which} error falls from {before} to {after} ({at}{floor})."


def _fall_with(diagnosis: Diagnosis, candidate: Candidate) -> float:
    """The share of the error that it takes away; 0 where that is not known."""
    found = candidate.comparison
    return 0.0 if found is None else 1 - found.rmse / diagnosis.base.rmse


def _is_at_floor(found: Comparison) -> bool:
    return found.rmse <= FAILING_ERROR * found.noise_floor

"""The answers to what is wrong, where, and what to do, of one diagnosis.

Report and page tell them on their first screens; a report's paragraph on each step has
them too. Each begins with what is to be understood at once; the numbers come behind.
"""

from phsi_opt.criteria import FAILING_ERROR
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.finding import Finding
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.next_step import likely_cause
from phsi_opt.force_analysis.pace import Pace
from phsi_opt.force_analysis.place_words import place_answer
from phsi_opt.force_analysis.units import spaced
from phsi_opt.force_analysis.wording import VIBRATION_WORDS
from phsi_opt.model.model import Model
from phsi_opt.model.structure import position_of_momentum
from phsi_opt.presentation.numbers import capitalised, number, with_error
from phsi_opt.presentation.report_content import Answer
from phsi_opt.study.off_words import judged_words, misses_words, off_words

QUADRATIC_INPUT = "quadratic input"
NO_FORCE = "The residuals are no noise, but no missing force is sure."


# ---- what is wrong


def wrong_answer(diagnosis: Diagnosis, is_held_out: bool) -> Answer:
    """What is missing, how large it is, and how far the model is off."""
    force = EquationForce.of(diagnosis.analysis, None)
    off = (
        f"Simulated on {judged_words(is_held_out)}, the model is off: "
        f"{off_words(diagnosis.base)}."
    )
    lacking = NO_FORCE if force.is_uncertain else _lacking(force)
    if diagnosis.findings:
        return Answer(_missing_words(diagnosis), f"{lacking} {off}")
    if force.is_uncertain or not force.pace.is_vibration:
        return _by_cause(diagnosis, force, f"{lacking} {off}")
    lead = f"Something swings {_speed(force)}: {VIBRATION_WORDS}."
    return Answer(lead, f"{lacking} {off}")


def _by_cause(diagnosis: Diagnosis, force: EquationForce, detail: str) -> Answer:
    """The likely cause with what the free run misses; else the size alone."""
    cause = ""
    if not force.is_uncertain:
        cause = likely_cause(force.record.units, force)
    misses = misses_words(diagnosis.base)
    if cause:
        return Answer(f"{cause}: the free run {misses}.", detail)
    return Answer(f"The free run {misses}.", detail)


def _missing_words(diagnosis: Diagnosis) -> str:
    """The names of what is missing."""
    model = diagnosis.base.model
    told = [
        _plainly(finding, model) or class_of(finding) for finding in diagnosis.findings
    ]
    names = capitalised(" and ".join(told))
    verb = "is" if len(diagnosis.findings) == 1 else "are"
    if diagnosis.verdict == Verdict.NAMED:
        return f"{names} {verb} missing."
    rest = _rest_words(diagnosis)
    return f"{names} {verb} missing, plus something not yet identified{rest}."


def _plainly(finding: Finding, model: Model) -> str:
    """What an effect is where its name alone says little; "" for others."""
    effect = finding.effects[0]
    if not finding.is_name or not effect.name.startswith(QUADRATIC_INPUT):
        return ""
    (term,) = effect.term
    is_force = effect.equation in position_of_momentum(model)
    what = "a force" if is_force else "something"
    law = term.body.replace("**", "^")
    return f"{what} in proportion to {law} in d{effect.equation}/dt ({effect.name})"


def _rest_words(diagnosis: Diagnosis) -> str:
    """What is left with what is proposed, beside the error before and the noise."""
    found = _proposed(diagnosis).comparison
    if found is None:
        return ""
    floor = found.noise_floor
    above = diagnosis.base.rmse - diagnosis.base.noise_floor
    if not above > 0 or not floor > 0:
        return ""
    share = 100 * max(found.rmse - floor, 0.0) / above
    times = number(found.rmse / floor, 2)
    return (
        f" ({number(share, 2)} % of the error above the noise; {times} times the noise)"
    )


def _lacking(force: EquationForce) -> str:
    """Size of the missing force, alone and beside the rate that the model has."""
    beside = force.pace.size_words(f"d{force.equation}/dt")
    said = f"The model's d{force.equation}/dt is off by {strength_words(force)}"
    return f"{said}, {beside}." if beside else f"{said}."


def _speed(force: EquationForce) -> str:
    pace: Pace = force.pace
    return pace.speed_words(force.record.units)


def was_wrong_words(diagnosis: Diagnosis, whose: str) -> str:
    """What a model lacked, and how much of it, told when it was added."""
    force = EquationForce.of(diagnosis.analysis, None)
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
    force = EquationForce.of(diagnosis.analysis, None)
    if force.is_uncertain:
        return Answer("No equation, time or region stands out.")
    is_known = is_past or diagnosis.verdict == Verdict.NAMED
    is_named = is_past or bool(diagnosis.findings)
    return place_answer(force, is_named, is_known)


# ---- what to do


def to_do_answer(diagnosis: Diagnosis, is_held_out: bool) -> Answer:
    """What to add, with what that leaves; or what to do where nothing is named."""
    if diagnosis.findings:
        return _addition(diagnosis, is_held_out)
    advice = diagnosis.next_step
    if not diagnosis.proposed:
        return advice
    names = " and ".join(map(str, diagnosis.proposed))
    against = _proposed(diagnosis).lost
    reason = f": {against}" if against else ""
    nearest = f"The nearest of the catalogue is {names}. It is not established{reason}."
    return Answer(advice.lead, f"{advice.detail} {nearest}".strip())


def _addition(diagnosis: Diagnosis, is_held_out: bool) -> Answer:
    told = capitalised("; ".join(map(finding_words, diagnosis.findings)))
    outcome = _outcome(diagnosis, is_held_out)
    if diagnosis.verdict != Verdict.NAMED:
        outcome += (
            " What is left then is more than noise, and has no name: add, and "
            "diagnose again."
        )
    return Answer(f"{told}.", outcome.strip())


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
    found = _proposed(diagnosis).comparison
    if found is None:
        return ""
    unit = spaced(found.error_unit)
    which = "held-out" if is_held_out else "training"
    before = number(diagnosis.base.rmse, 3)
    after = f"{number(found.rmse, 3)}{unit}"
    floor = f"noise floor {number(found.noise_floor, 3)}{unit}"
    is_all = found.rmse <= FAILING_ERROR * found.noise_floor
    trend = f"falls from {before} to {after}"
    return f"The {which} error {trend} ({'at the ' if is_all else ''}{floor})."


def _proposed(diagnosis: Diagnosis) -> Candidate:
    """The candidate that is proposed."""
    for candidate in diagnosis.ranking:
        if candidate.effects == diagnosis.proposed:
            return candidate
    return diagnosis.ranking[0]

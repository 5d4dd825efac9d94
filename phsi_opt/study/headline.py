"""The first screen of a report: the verdict, what is wrong, where, since when."""

from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.force_analysis.energy_wording import NO_PATTERN
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import EVERYWHERE
from phsi_opt.force_analysis.units import force_unit, spaced, with_units
from phsi_opt.model.effect import Effect
from phsi_opt.presentation.numbers import number, with_error
from phsi_opt.presentation.report_content import BAD, GOOD, LOOK, Fact, Headline
from phsi_opt.study.force_content import since_when
from phsi_opt.study.record import StudyRecord

NOT_ASKED = "not diagnosed yet"
SEVERITIES = {
    str(Verdict.NOTHING_MISSING): GOOD,
    str(Verdict.NAMED): LOOK,
    str(Verdict.PARTLY_NAMED): LOOK,
    str(Verdict.UNEXPLAINED): BAD,
    NOT_ASKED: LOOK,
}
MOST_REASON = 240  # letters that are read in a few seconds


def headline_of(study: StudyRecord) -> Headline:
    """The verdict on the present model, and the answers of the first screen."""
    present = study.diagnoses.get(len(study.steps) - 1)
    status = NOT_ASKED if present is None else str(present.verdict)
    telling = _telling(study, present)
    if telling is not None:
        facts = _facts_of(study, telling)
    else:
        facts = _facts_without(study, present)
    sentence = _sentence(study, present)
    return Headline(status, SEVERITIES[status], sentence, tuple(facts))


def _telling(study: StudyRecord, present: Diagnosis | None) -> Diagnosis | None:
    """The diagnosis whose answers stand on the first screen.

    That of the present model while something is missing; else the first one that found
    something: it says what was wrong.
    """
    if present is not None and present.verdict != Verdict.NOTHING_MISSING:
        return present
    for _, diagnosis in sorted(study.diagnoses.items()):
        if diagnosis.verdict != Verdict.NOTHING_MISSING:
            return diagnosis
    return None


def errors_in_words(study: StudyRecord) -> str:
    """How the error fell, beside the noise floor."""
    first = study.steps[0].judged
    last = study.last.judged
    which = "held-out" if study.last.held_out is not None else "training"
    unit = spaced(study.unit)
    floor = f"noise floor {number(last.noise_floor, 3)}{unit}"
    if len(study.steps) == 1:
        return f"{which} error {number(last.rmse, 3)}{unit}, {floor}"
    verb = "fell" if last.rmse < first.rmse else "went"
    return (
        f"{which} error {verb} from {number(first.rmse, 3)} to "
        f"{number(last.rmse, 3)}{unit} ({floor})"
    )


def _sentence(study: StudyRecord, present: Diagnosis | None) -> str:
    errors = errors_in_words(study)
    if study.last.added:
        begin = _said_of_added(study, present, errors)
        if present is None:
            return f"{begin} The present model has not been diagnosed."
        if present.verdict == Verdict.NOTHING_MISSING:
            return f"{begin} Now: nothing missing."
        if len(present.reason) <= MOST_REASON:
            return f"{begin} Still {present.verdict}: {present.reason}."
        return f"{begin} Still {present.verdict}; why stands under Where it fails."
    if present is None and study.stopped:
        return f"What the model lacks is not known: {study.stopped}. So far: {errors}."
    if present is None:
        return (
            f"What the model lacks has not been asked yet: {errors}. "
            "Call study.diagnose() or study.auto()."
        )
    said = _said(present, errors)
    return f"{said[:1].upper()}{said[1:]}"


def _said_of_added(study: StudyRecord, present: Diagnosis | None, errors: str) -> str:
    """What was added, with how sure it is, and what that did to the errors."""
    nearest = _nearest(study)
    is_all = present is not None and present.verdict == Verdict.NOTHING_MISSING
    sure: list[str] = []
    unsure: list[str] = []
    for effect in study.last.added:
        is_sure = is_all or str(effect) not in nearest
        (sure if is_sure else unsure).append(str(effect))
    with_them = "With it" if len(study.last.added) == 1 else "With them"
    lacked = (
        f"The base model lacked {' and '.join(sure)}." if sure else "Not explained."
    )
    if unsure:
        lacked += f" Nearest, added but not established: {' and '.join(unsure)}."
    return f"{lacked} {with_them}, the {errors}."


def _nearest(study: StudyRecord) -> set[str]:
    """Effects that were proposed as the nearest, and never established."""
    proposed: set[str] = set()
    established: set[str] = set()
    for diagnosis in study.diagnoses.values():
        proposed.update(map(str, diagnosis.proposed))
        for finding in diagnosis.findings:
            established.update(map(str, finding.effects))
    return proposed - established


def _said(diagnosis: Diagnosis, errors: str) -> str:
    """Verdict and reason; a long reason is told further below in the report."""
    if len(diagnosis.reason) <= MOST_REASON:
        return f"{diagnosis.verdict}: {diagnosis.reason}."
    return f"{diagnosis.verdict}: {errors}. The reason stands under Where it fails."


def _facts_of(study: StudyRecord, diagnosis: Diagnosis) -> list[Fact]:
    return [
        Fact("What is wrong", _wrong(study, diagnosis)),
        Fact("Where", _where(diagnosis)),
        Fact("Since when", since_when(diagnosis)),
        Fact("What to add", _addition(study, diagnosis)),
    ]


def _wrong(study: StudyRecord, diagnosis: Diagnosis) -> str:
    """What the model that was diagnosed lacks, and how much of it."""
    added: tuple[Effect, ...] = ()
    for number_of_step, known in study.diagnoses.items():
        if known is diagnosis:
            added = study.steps[number_of_step].added
    whose = "The base model's"
    if added:
        whose = f"With {' and '.join(map(str, added))}, the model's"
    force = EquationForce.of(diagnosis.analysis, None)
    unit = spaced(force_unit(force.equation, force.record.units))
    size = f"rms {number(float(force.where['strength']), 3)}{unit}"
    if force.is_uncertain:
        return f"The residuals show it; no missing force is sure ({size})."
    return f"{whose} d{force.equation}/dt lacks a force of {size}."


def _where(diagnosis: Diagnosis) -> str:
    """The equation, the region of the states, and what the force follows."""
    force = EquationForce.of(diagnosis.analysis, None)
    if force.is_uncertain:
        return "No equation, time or region stands out."
    region = str(force.where["state_region"])
    place = f"In the equation of {force.equation}"
    if region == EVERYWHERE:
        place += ", all over the visited states"
    else:
        place += f", strong where {with_units(region, force.record.units)}"
    energy = diagnosis.analysis.energy
    causes = dict(zip(energy.table["equation"], energy.sentences, strict=True))
    cause = causes[force.equation]
    if cause == NO_PATTERN:
        return f"{place}. No single cause explains it."
    return f"{place}. It {cause}."


def _addition(study: StudyRecord, diagnosis: Diagnosis) -> str:
    """What to add, or what was added since."""
    texts = []
    for finding in diagnosis.findings:
        effect = finding.effects[0]
        unit = spaced(finding.unit)
        size = with_error(finding.coefficient, finding.std_error)
        text = f"{effect}, {size}{unit}"
        if not finding.is_name:
            others = ", ".join(str(other) for other in finding.effects[1:])
            text += f" (or {others}: the data do not tell)"
        texts.append(text)
    if not texts:
        texts = [f"nearest: {effect}" for effect in diagnosis.proposed]
    if not texts:
        return (
            "No effect of the catalogue explains enough: an effect of your own may, "
            "or other data that show more."
        )
    added = study.last.added
    if added and set(map(str, diagnosis.proposed)) <= set(map(str, added)):
        return f"Added: {'; '.join(texts)}."
    text = "; ".join(texts)
    return f"{text[:1].upper()}{text[1:]}."


def _facts_without(study: StudyRecord, present: Diagnosis | None) -> list[Fact]:
    """The answers where no diagnosis has found anything missing."""
    judged = study.last.judged
    ratio = f"{judged.rmse / judged.noise_floor:.3g} times the noise floor"
    error = errors_in_words(study)
    error = f"{error[:1].upper()}{error[1:]}: {ratio}."
    if present is None:
        return [
            Fact("What is wrong", "Not asked yet."),
            Fact("How far off", error),
            Fact("What to do", "Call study.diagnose() or study.auto()."),
        ]
    return [
        Fact("What is wrong", "Nothing that these data show."),
        Fact("How far off", error),
        Fact("What to add", "Nothing."),
    ]

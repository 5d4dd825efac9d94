"""The first screen of a report: the verdict, what is wrong, where, since when."""

import numpy as np

from phsi_opt.diagnosis.finding import Finding
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.force_analysis.energy_wording import NO_PATTERN, TOGETHER
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.state_plots import region_words
from phsi_opt.force_analysis.units import force_unit, frequency_words, spaced
from phsi_opt.model.effect import Effect
from phsi_opt.presentation.numbers import number, with_error
from phsi_opt.presentation.report_content import BAD, GOOD, LOOK, Fact, Headline
from phsi_opt.presentation.units import STANDARD_DEVIATIONS
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
NEAR_SAMPLING = 0.2  # cycles per sample from which on a force is as fast as the samples
# What is said of a model to which effects were added.
NOW = {
    Verdict.NOTHING_MISSING: "Now nothing is missing.",
    Verdict.NAMED: "Something more is missing, and it is named below.",
    Verdict.PARTLY_NAMED: "More is missing; a part of it is named below.",
    Verdict.UNEXPLAINED: (
        "Something is still missing that no effect of the catalogue explains; why "
        "stands under Where it fails."
    ),
}
# What is said of a model to which nothing was added.
SAID = {
    Verdict.NOTHING_MISSING: "Nothing is missing",
    Verdict.NAMED: "Something is missing, and it is named",
    Verdict.PARTLY_NAMED: "Something is missing, and a part of it is named",
    Verdict.UNEXPLAINED: (
        "Something is missing that no effect of the catalogue explains"
    ),
}
# The questions of the first screen: of what is missing, and of what was.
PRESENT = ("What is wrong", "Where", "Since when", "What to add")
PAST = ("What was wrong", "Where it was", "Since when", "What was added")


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
    size = 1.0
    unit = spaced(study.unit)
    of_floor = unit
    if study.unit == STANDARD_DEVIATIONS:  # of channels with several units
        size = 0.01
        unit = " % of the standard deviation of what was measured"
        of_floor = " %"
    floor = f"noise floor {number(last.noise_floor / size, 3)}{of_floor}"
    after = f"{number(last.rmse / size, 3)}{unit}"
    if len(study.steps) == 1:
        return f"{which} error {after}, {floor}"
    verb = "fell" if last.rmse < first.rmse else "went"
    before = f"{number(first.rmse / size, 3)}{of_floor if size < 1 else ''}"
    return f"{which} error {verb} from {before} to {after} ({floor})"


def _sentence(study: StudyRecord, present: Diagnosis | None) -> str:
    errors = errors_in_words(study)
    if study.last.added:
        begin = _said_of_added(study, present, errors)
        if present is None:
            return f"{begin} The present model has not been diagnosed."
        return f"{begin} {NOW[present.verdict]}"
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
    nearest = _unestablished(study)
    is_all = present is not None and present.verdict == Verdict.NOTHING_MISSING
    sure: list[str] = []
    unsure: list[str] = []
    for effect in study.last.added:
        if is_all or str(effect) not in nearest:
            sure.append(f"{effect}{_alternatives(study, effect)}")
        else:
            unsure.append(str(effect))
    with_them = "With it" if len(study.last.added) == 1 else "With them"
    said = []
    if sure:
        said.append(f"The base model lacked {' and '.join(sure)}.")
    if unsure:
        verb = "was" if len(unsure) == 1 else "were"
        nearest_ones = f"{' and '.join(unsure)} {verb} added as the nearest"
        said.append(f"Not established: {nearest_ones}.")
    return f"{' '.join(said)} {with_them}, the {errors}."


def _alternatives(study: StudyRecord, effect: Effect) -> str:
    """The other members of the class that an effect stands for, in brackets."""
    for diagnosis in study.diagnoses.values():
        for finding in diagnosis.findings:
            names = [str(one) for one in finding.effects]
            if str(effect) in names and not finding.is_name:
                others = [name for name in names if name != str(effect)]
                return f" (or {', '.join(others)}: the data do not tell)"
    return ""


def _unestablished(study: StudyRecord) -> set[str]:
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
    said = SAID[diagnosis.verdict]
    is_unexplained = diagnosis.verdict == Verdict.UNEXPLAINED
    if len(diagnosis.reason) <= MOST_REASON and not is_unexplained:
        return f"{said}: {diagnosis.reason}."
    return f"{said}: {errors}. The reason stands under Where it fails."


def _facts_of(study: StudyRecord, diagnosis: Diagnosis) -> list[Fact]:
    is_past = diagnosis is not study.diagnoses.get(len(study.steps) - 1)
    answers = (
        _wrong(study, diagnosis, is_past),
        _where(diagnosis),
        since_when(diagnosis),
        _addition(study, diagnosis, is_past),
    )
    questions = PAST if is_past else PRESENT
    return [Fact(*pair) for pair in zip(questions, answers, strict=True)]


def _wrong(study: StudyRecord, diagnosis: Diagnosis, is_past: bool) -> str:
    """What the model that was diagnosed lacks, or lacked, and how much of it."""
    added: tuple[Effect, ...] = ()
    for number_of_step, known in study.diagnoses.items():
        if known is diagnosis:
            added = study.steps[number_of_step].added
    whose = "the base model's"
    if added:
        whose = f"with {' and '.join(map(str, added))}, the model's"
    force = EquationForce.of(diagnosis.analysis, None)
    unit = spaced(force_unit(force.equation, force.record.units))
    size = f"{number(float(force.where['strength']), 3)}{unit} (rms)"
    if force.is_uncertain:
        return f"The residuals show it; no missing force is sure: {size}."
    verb = "was" if is_past else "is"
    names = " and ".join(_class_of(finding) for finding in diagnosis.findings)
    begin = f"{names} {verb} missing: " if names else ""
    said = f"{begin}{whose} d{force.equation}/dt {verb} off by {size}"
    if not is_past:
        said += _worst_channel(study)
    said = f"{said[:1].upper()}{said[1:]}"
    frequency = float(force.where["frequency"])
    if frequency * float(np.median(force.record.h)) > NEAR_SAMPLING:
        told = frequency_words(frequency, force.record.units)
        said += (
            f", most of it {told}, near the sampling rate: an error of the sensor "
            "looks so, rather than a force"
        )
    return f"{said}."


def _worst_channel(study: StudyRecord) -> str:
    """How far the free run of the present model is off, where it is worst."""
    table = study.last.judged.table
    ratios = table["rmse"].to_numpy() / table["noise_floor"].to_numpy()
    if not np.isfinite(ratios).any():
        return ""
    place = int(np.nanargmax(ratios))
    worst = table.iloc[place]
    size = f"{number(float(worst['rmse']), 3)}{spaced(str(worst['unit']))}"
    return (
        f", its free run of {worst['state']} by {size}, {ratios[place]:.3g} times the "
        "noise"
    )


def _class_of(finding: Finding) -> str:
    """What was found, with the others of its class."""
    return " or ".join(str(effect) for effect in finding.effects)


def _where(diagnosis: Diagnosis) -> str:
    """The equation, the region of the states, and what the force follows."""
    force = EquationForce.of(diagnosis.analysis, None)
    if force.is_uncertain:
        return "No equation, time or region stands out."
    place = f"In d{force.equation}/dt, {region_words(force)}"
    energy = diagnosis.analysis.energy
    causes = dict(zip(energy.table["equation"], energy.sentences, strict=True))
    cause = causes[force.equation]
    if cause == NO_PATTERN:
        return f"{place}. No single cause explains it."
    return f"{place}. It {cause}."


def _addition(study: StudyRecord, diagnosis: Diagnosis, is_past: bool) -> str:
    """What to add, or what was added since."""
    added = {str(effect) for effect in study.last.added}
    if is_past and not added >= set(map(str, diagnosis.proposed)):
        return f"{', '.join(sorted(added)) or 'Nothing'}."
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
        return _advice(diagnosis)
    text = "; ".join(texts)
    return f"{text[:1].upper()}{text[1:]}."


def _advice(diagnosis: Diagnosis) -> str:
    """What to do where no effect of the catalogue explains enough."""
    force = EquationForce.of(diagnosis.analysis, None)
    begin = "Nothing of the catalogue: try a term of your own"
    if force.is_uncertain:
        return f"{begin}, or record more data."
    energy = diagnosis.analysis.energy
    causes = dict(zip(energy.table["equation"], energy.sentences, strict=True))
    record = "record more data where it is strong"
    if TOGETHER in causes[force.equation]:
        record = "record data in which the input and what it moves with go apart"
    return f"{begin} in d{force.equation}/dt, or {record}."


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

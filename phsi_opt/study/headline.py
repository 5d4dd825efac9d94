"""The first screen of a report: the verdict, what is wrong, where, since when."""

from collections.abc import Sequence

from phsi_opt.comparison.compare import Comparison
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.force_analysis.units import spaced
from phsi_opt.model.effect import Effect
from phsi_opt.presentation.numbers import capitalised, number
from phsi_opt.presentation.report_content import (
    BAD,
    GOOD,
    LOOK,
    Answer,
    Fact,
    Headline,
)
from phsi_opt.presentation.units import STANDARD_DEVIATIONS
from phsi_opt.study.answers import (
    finding_words,
    missing_answer,
    to_do_answer,
    was_wrong_words,
    where_answer,
    wrong_answer,
)
from phsi_opt.study.certainty import (
    certainty_words,
    disturbance_word,
    evidence_words,
    undetermined_words,
)
from phsi_opt.study.record import StudyRecord
from phsi_opt.study.since_when import since_when

NOT_ASKED = "not diagnosed yet"
SEVERITIES = {
    str(Verdict.NOTHING_MISSING): GOOD,
    str(Verdict.NAMED): LOOK,
    str(Verdict.PARTLY_NAMED): LOOK,
    str(Verdict.UNEXPLAINED): BAD,
    NOT_ASKED: LOOK,
}
# What is said of a model to which effects were added.
NOW = {
    Verdict.NOTHING_MISSING: "Now nothing is missing.",
    Verdict.NAMED: "Something more is missing, and it is named below.",
    Verdict.PARTLY_NAMED: "More is missing; a part of it is named below.",
    Verdict.UNEXPLAINED: (
        "Something is still missing that no effect of the catalogue explains."
    ),
}
# The same where an effect was added that is not established.
NOT_SEEN = "No force is evident beside the present model."
NOT_ESTABLISHED = "with an effect that is not established"
# The questions of the first screen: of what is missing, and of what was.
PRESENT = ("What is wrong", "Where", "Since when", "What to add")
UNNAMED = ("What is wrong", "Where", "Since when", "What to do next")
PAST = ("What was wrong", "Where it was", "Since when", "What was added")


def headline_of(study: StudyRecord) -> Headline:
    """The verdict on the present model, and the answers of the first screen."""
    present = study.diagnoses.get(len(study.steps) - 1)
    status = NOT_ASKED if present is None else str(present.verdict)
    telling = telling_diagnosis(study)
    if telling is not None:
        facts = _facts_of(study, telling)
    else:
        facts = _facts_without(study, present)
    severity = SEVERITIES[status]
    beside = "" if present is None else disturbance_word(present)
    if study.unestablished and not beside:
        beside = NOT_ESTABLISHED
        severity = LOOK if severity == GOOD else severity
    return Headline(
        status,
        severity,
        _sentence(study, present),
        tuple(facts),
        beside=beside,
        certainty="" if present is None else certainty_words(present),
        caution=undetermined_words(study.last.fit.parameters),
    )


def telling_diagnosis(study: StudyRecord) -> Diagnosis | None:
    """The diagnosis whose answers stand on the first screen.

    That of the present model while something is missing; else the first one that found
    something: it says what was wrong.
    """
    present = study.diagnoses.get(len(study.steps) - 1)
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
        unit = " % of the measured movement"
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
        begin = _said_of_added(study, errors)
        if present is None:
            return f"{begin} The present model has not been diagnosed."
        if present.verdict == Verdict.NOTHING_MISSING and study.unestablished:
            return f"{begin} {NOT_SEEN}"
        return f"{begin} {NOW[present.verdict]}"
    if present is None and study.stopped:
        return f"What the model lacks is not known: {study.stopped}. So far: {errors}."
    if present is None:
        return (
            f"What the model lacks has not been asked yet: {errors}. "
            "Call study.diagnose() or study.auto()."
        )
    return verdict_sentence(present, study.held_out is not None)


def _said_of_added(study: StudyRecord, errors: str) -> str:
    """What was added, with how sure it is, and what that did to the errors."""
    open_ = {one.name: evidence_words(one) for one in study.unestablished}
    sure: list[str] = []
    unsure: list[str] = []
    for effect in study.last.added:
        if str(effect) not in open_:
            sure.append(f"{effect}{_alternatives(study, effect)}")
        else:
            unsure.append(f"{effect} ({open_[str(effect)]})")
    with_them = "With it" if len(study.last.added) == 1 else "With them"
    said = []
    if sure:
        said.append(f"The base model lacked {' and '.join(sure)}.")
    if unsure:
        said.append(f"Added, but not established: {' and '.join(unsure)}.")
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


def verdict_sentence(diagnosis: Diagnosis, is_held_out: bool) -> str:
    """What a model lacks, that nothing was added to; the facts say more."""
    if diagnosis.verdict == Verdict.NOTHING_MISSING:
        return f"Nothing is missing: {diagnosis.reason}."
    return str(missing_answer(diagnosis, is_held_out))


def _facts_of(study: StudyRecord, diagnosis: Diagnosis) -> list[Fact]:
    if diagnosis is study.diagnoses.get(len(study.steps) - 1):
        return _present_facts(study, diagnosis)
    answers = (
        Answer(was_wrong_words(diagnosis, _whose(study, diagnosis))),
        where_answer(diagnosis, is_past=True),
        since_when(diagnosis, _trained(study, diagnosis)),
        _was_added(study),
    )
    return _facts(PAST, answers)


def _present_facts(study: StudyRecord, diagnosis: Diagnosis) -> list[Fact]:
    is_held_out = study.held_out is not None
    answers = (
        wrong_answer(diagnosis, is_held_out),
        where_answer(diagnosis),
        since_when(diagnosis, study.last.train),
        to_do_answer(diagnosis, is_held_out),
    )
    return _facts(PRESENT if diagnosis.findings else UNNAMED, answers)


def _trained(study: StudyRecord, diagnosis: Diagnosis) -> Comparison:
    """The model that a diagnosis looked at, on its training data."""
    for number_of_step, known in study.diagnoses.items():
        if known is diagnosis:
            return study.steps[number_of_step].train
    return study.last.train


def _facts(questions: Sequence[str], answers: Sequence[Answer]) -> list[Fact]:
    facts = []
    for question, answer in zip(questions, answers, strict=True):
        facts.append(Fact(question, answer.lead, answer.detail))
    return facts


def _whose(study: StudyRecord, diagnosis: Diagnosis) -> str:
    """Of which model a past diagnosis speaks."""
    added: tuple[Effect, ...] = ()
    for number_of_step, known in study.diagnoses.items():
        if known is diagnosis:
            added = study.steps[number_of_step].added
    if not added:
        return "the base model's"
    return f"with {' and '.join(map(str, added))}, the model's"


def _was_added(study: StudyRecord) -> Answer:
    """What was added, with the sizes that diagnoses found, and how clear it was."""
    known = {one.name: f"{one.name}, not established" for one in study.unestablished}
    evidence = {one.name: evidence_words(one) for one in study.unestablished}
    for found in study.diagnoses.values():
        for finding in found.findings:
            name = str(finding.effects[0])
            known[name] = finding_words(finding)
            evidence[name] = evidence_words(found.ranking[0])
    names = [str(effect) for effect in study.last.added]
    told = "; ".join(known.get(name, name) for name in names)
    clear = "; ".join(f"{n}: {evidence[n]}" for n in names if n in evidence)
    if len(names) == 1 and clear:
        clear = f"Evidence: {evidence[names[0]]}"
    detail = f"{capitalised(clear)}." if clear else ""
    return Answer(f"{capitalised(told or 'nothing')}.", detail)


def _facts_without(study: StudyRecord, present: Diagnosis | None) -> list[Fact]:
    """The answers where no diagnosis has found anything missing."""
    judged = study.last.judged
    ratio = f"{number(judged.rmse / judged.noise_floor, 3)} times the noise floor"
    error = errors_in_words(study)
    error = f"{capitalised(error)}: {ratio}."
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

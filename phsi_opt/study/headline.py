"""The verdict on a study: the first screen, and each diagnosis in a paragraph."""

from typing import Any

from phsi_opt.diagnosis.candidate import Finding, Verdict
from phsi_opt.presentation.content import BAD, GOOD, LOOK, Answer, Headline
from phsi_opt.presentation.numbers import capitalised
from phsi_opt.presentation.sentences import say
from phsi_opt.presentation.units import STANDARD_DEVIATIONS, scale_of_errors, spaced
from phsi_opt.study.answers import (
    alternatives,
    answer,
    disturbance_word,
    evidence_words,
    finding_words,
    since_when,
    undetermined_words,
    where_answer,
)
from phsi_opt.study.record import StudyRecord

NOT_ASKED = "not diagnosed yet"
ASK = "Call study.diagnose() or study.auto()."
SEVERITIES = {
    str(Verdict.NOTHING_MISSING): GOOD,
    str(Verdict.NAMED): LOOK,
    str(Verdict.PARTLY_NAMED): LOOK,
    str(Verdict.UNEXPLAINED): BAD,
    NOT_ASKED: LOOK,
}
NOT_ESTABLISHED = "with an effect that is not established"
# The questions of the first screen: of what is missing, and of what was.
PRESENT = ("What is wrong", "Where", "Since when", "What to add")
UNNAMED = ("What is wrong", "Where", "Since when", "What to do next")
# Where no diagnosis was asked for, or none found anything; "" for how far off it is.
NOT_YET = (
    ("What is wrong", "Not asked yet."),
    ("How far off", ""),
    ("What to do", ASK),
)
NOTHING_FOUND = (
    ("What is wrong", "Nothing that these data show."),
    ("How far off", ""),
    ("What to add", "Nothing."),
)
PAST = ("What was wrong", "Where it was", "Since when", "What was added")


def headline_of(study: StudyRecord) -> Headline:
    """The verdict on the present model, and the answers of the first screen."""
    present = study.present
    status = NOT_ASKED if present is None else str(present.verdict)
    severity = SEVERITIES[status]
    beside = "" if present is None else disturbance_word(present)
    if study.unestablished and not beside:
        beside = NOT_ESTABLISHED
        severity = LOOK if severity == GOOD else severity
    certainty = ""
    if present is not None:
        certainty = str(answer("certainty", present, is_held_out=True))
    return Headline(
        status,
        severity,
        _sentence(study),
        _answers(study),
        beside=beside,
        certainty=certainty,
        caution=undetermined_words(study.last.fit.parameters),
    )


def telling_step(study: StudyRecord) -> int | None:
    """The step whose diagnosis is told on the first screen; None: no one is.

    That of the present model while something is missing; else the first one that found
    something: it says what was wrong.
    """
    found = []
    for place, diagnosis in sorted(study.diagnoses.items()):
        if diagnosis.verdict != Verdict.NOTHING_MISSING:
            found.append(place)
    last = len(study.steps) - 1
    return last if last in found else next(iter(found), None)


def said_of(study: StudyRecord, name: str, **facts: Any) -> Answer:
    """What ``words.jinja`` says under a name of the study as a whole."""
    size, unit = scale_of_errors(study.unit)
    short = ""
    if study.unit == STANDARD_DEVIATIONS:  # of channels with several units
        unit, short = "% of the measured movement", " %"
    return say(
        __package__,
        name,
        study=study,
        which="training" if study.last.held_out is None else "held-out",
        size=size,
        unit=spaced(unit),
        short=short,
        **facts,
    )


def _sentence(study: StudyRecord) -> str:
    present = study.present
    lacking = ""
    if present is not None and present.verdict != Verdict.NOTHING_MISSING:
        is_held_out = study.held_out is not None
        lacking = str(answer("missing", present, is_held_out))
    found: list[Finding] = []
    for diagnosis in study.diagnoses.values():
        found += diagnosis.findings
    open_ = {one.name: evidence_words(one) for one in study.unestablished}
    sure = []
    unsure = []
    for effect in study.last.added:
        name = str(effect)
        if name in open_:
            unsure.append(f"{name} ({open_[name]})")
        else:
            others = ""
            for finding in found:
                if name in map(str, finding.effects) and not others:
                    others = alternatives(finding, name)
            sure.append(f"{name}{others}")
    facts = {"sure": sure, "unsure": unsure, "lacking": lacking, "ask": ASK}
    added = study.last.added if len(study.steps) > 1 else ()
    return said_of(study, "sentence", present=present, added=added, **facts).lead


def _answers(study: StudyRecord) -> tuple[Answer, ...]:
    """The four answers of the diagnosis that is told; fewer where none found a lack."""
    place = telling_step(study)
    present = study.present
    if place is None:
        far = said_of(study, "how_far").lead
        told = NOT_YET if present is None else NOTHING_FOUND
        return tuple(Answer(lead or far, question=asked) for asked, lead in told)
    diagnosis = study.diagnoses[place]
    step = study.steps[place]
    is_held_out = study.held_out is not None
    is_past = diagnosis is not present
    if is_past:
        questions = PAST
        whose = "the base model's"
        if step.added:
            whose = f"with {' and '.join(map(str, step.added))}, the model's"
        what_is = answer("was_wrong", diagnosis, is_held_out, whose=whose)
        what_to_do = _was_added(study)
    else:
        questions = PRESENT if diagnosis.findings else UNNAMED
        what_is = answer("wrong", diagnosis, is_held_out)
        what_to_do = answer("to_do", diagnosis, is_held_out)
    where = where_answer(diagnosis, is_past)
    answers = (what_is, where, since_when(diagnosis, step.train), what_to_do)
    asked = zip(questions, answers, strict=True)
    return tuple(Answer(one.lead, one.detail, question) for question, one in asked)


def _was_added(study: StudyRecord) -> Answer:
    """What was added, with the sizes that diagnoses found, and how clear it was."""
    told = {
        one.name: (f"{one.name}, not established", evidence_words(one))
        for one in study.unestablished
    }
    for diagnosis in study.diagnoses.values():
        for finding in diagnosis.findings:
            evidence = evidence_words(diagnosis.ranking[0])
            told[str(finding.effects[0])] = (finding_words(finding), evidence)
    names = list(map(str, study.last.added))
    sizes = [told.get(name, (name, ""))[0] for name in names]
    clear = {name: told[name][1] for name in names if name in told}
    return said_of(study, "was_added", added=names, sizes=sizes, clear=clear)


def step_story(study: StudyRecord, place: int) -> str:
    """One diagnosis in a paragraph, as an engineer would write it.

    Args:
        study: as it stands.
        place: number of the step, counted from 0, whose model was diagnosed.
    """
    diagnosis = study.diagnoses[place]
    is_held_out = study.held_out is not None
    if diagnosis.verdict == Verdict.NOTHING_MISSING:
        return answer("noise_alone", diagnosis, is_held_out).lead
    told = [
        answer("missing", diagnosis, is_held_out),
        answer("wrong", diagnosis, is_held_out),
        where_answer(diagnosis),
        since_when(diagnosis, study.steps[place].train),
        answer("to_do", diagnosis, is_held_out),
    ]
    if place + 1 < len(study.steps):
        label = capitalised(study.steps[place + 1].label)
        told.append(Answer(f"{label}: added in step {place + 1}."))
    return " ".join(map(str, told))

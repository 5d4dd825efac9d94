"""The verdict on a study: the first screen, and each diagnosis in a paragraph."""

from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.force_analysis.units import spaced
from phsi_opt.model.effect import Effect
from phsi_opt.presentation.content import BAD, GOOD, LOOK, Answer, Headline
from phsi_opt.presentation.numbers import capitalised, number
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
    judged_words,
    off_words,
    undetermined_words,
)
from phsi_opt.study.record import StudyRecord
from phsi_opt.study.since_when import since_when

NOT_ASKED = "not diagnosed yet"
ASK = "Call study.diagnose() or study.auto()."
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
    present = study.present
    status = NOT_ASKED if present is None else str(present.verdict)
    severity = SEVERITIES[status]
    beside = "" if present is None else disturbance_word(present)
    if study.unestablished and not beside:
        beside = NOT_ESTABLISHED
        severity = LOOK if severity == GOOD else severity
    return Headline(
        status,
        severity,
        _sentence(study, present),
        _answers(study, present),
        beside=beside,
        certainty="" if present is None else certainty_words(present),
        caution=undetermined_words(study.last.fit.parameters),
    )


def telling_step(study: StudyRecord) -> int | None:
    """The step whose diagnosis is told on the first screen; None: no one is.

    That of the present model while something is missing; else the first one that found
    something: it says what was wrong.
    """
    found = [
        place
        for place, diagnosis in sorted(study.diagnoses.items())
        if diagnosis.verdict != Verdict.NOTHING_MISSING
    ]
    last = len(study.steps) - 1
    if last in found:
        return last
    return found[0] if found else None


def errors_in_words(study: StudyRecord) -> str:
    """How the error fell, beside the noise floor."""
    first = study.steps[0].judged
    last = study.last.judged
    which = "held-out" if study.last.held_out is not None else "training"
    size, unit, short = 1.0, spaced(study.unit), ""
    of_floor = unit
    if study.unit == STANDARD_DEVIATIONS:  # of channels with several units
        size, unit, short = 0.01, " % of the measured movement", " %"
        of_floor = short
    floor = f"noise floor {number(last.noise_floor / size, 3)}{of_floor}"
    after = f"{number(last.rmse / size, 3)}{unit}"
    if len(study.steps) == 1:
        return f"{which} error {after}, {floor}"
    verb = "fell" if last.rmse < first.rmse else "went"
    before = f"{number(first.rmse / size, 3)}{short}"
    return f"{which} error {verb} from {before} to {after} ({floor})"


def _sentence(study: StudyRecord, present: Diagnosis | None) -> str:
    errors = errors_in_words(study)
    if len(study.steps) > 1 and study.last.added:
        said = _said_of_added(study, errors)
        if present is None:
            return said
        is_silent = present.verdict == Verdict.NOTHING_MISSING
        now = NOT_SEEN if is_silent and study.unestablished else NOW[present.verdict]
        return f"{said} {now}"
    if present is None and study.stopped:
        return f"What the model lacks is not known: {study.stopped}. So far: {errors}."
    if present is None:
        return f"What the model lacks has not been asked yet: {errors}. {ASK}"
    if present.verdict == Verdict.NOTHING_MISSING:
        return f"Nothing is missing: {present.reason}."
    return str(missing_answer(present, study.held_out is not None))


def _said_of_added(study: StudyRecord, errors: str) -> str:
    """What was added, with how sure it is, and what that did to the errors."""
    open_ = {one.name: evidence_words(one) for one in study.unestablished}
    sure: list[str] = []
    unsure: list[str] = []
    for effect in study.last.added:
        name = str(effect)
        if name in open_:
            unsure.append(f"{name} ({open_[name]})")
        else:
            sure.append(f"{name}{_alternatives(study, effect)}")
    said = []
    if sure:
        said.append(f"The base model lacked {' and '.join(sure)}.")
    if unsure:
        said.append(f"Added, but not established: {' and '.join(unsure)}.")
    with_them = "With it" if len(study.last.added) == 1 else "With them"
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


def _answers(study: StudyRecord, present: Diagnosis | None) -> tuple[Answer, ...]:
    """The four answers of the diagnosis that is told; fewer where none found a lack."""
    place = telling_step(study)
    if place is None:
        return _without(study, present)
    diagnosis = study.diagnoses[place]
    step = study.steps[place]
    since = since_when(diagnosis, step.train)
    is_held_out = study.held_out is not None
    if diagnosis is present:
        questions = PRESENT if diagnosis.findings else UNNAMED
        what = wrong_answer(diagnosis, is_held_out)
        where = where_answer(diagnosis)
        what_to_do = to_do_answer(diagnosis, is_held_out)
    else:
        questions = PAST
        whose = "the base model's"
        if step.added:
            whose = f"with {' and '.join(map(str, step.added))}, the model's"
        what = Answer(was_wrong_words(diagnosis, whose))
        where = where_answer(diagnosis, is_past=True)
        what_to_do = _was_added(study)
    answers = zip(questions, (what, where, since, what_to_do), strict=True)
    return tuple(Answer(one.lead, one.detail, asked) for asked, one in answers)


def _was_added(study: StudyRecord) -> Answer:
    """What was added, with the sizes that diagnoses found, and how clear it was."""
    known = {one.name: f"{one.name}, not established" for one in study.unestablished}
    evidence = {one.name: evidence_words(one) for one in study.unestablished}
    for diagnosis in study.diagnoses.values():
        for finding in diagnosis.findings:
            name = str(finding.effects[0])
            known[name] = finding_words(finding)
            evidence[name] = evidence_words(diagnosis.ranking[0])
    names = [str(effect) for effect in study.last.added]
    told = "; ".join(known.get(name, name) for name in names)
    clear = "; ".join(f"{n}: {evidence[n]}" for n in names if n in evidence)
    if len(names) == 1 and clear:
        clear = f"Evidence: {evidence[names[0]]}"
    detail = f"{capitalised(clear)}." if clear else ""
    return Answer(f"{capitalised(told or 'nothing')}.", detail)


def _without(study: StudyRecord, present: Diagnosis | None) -> tuple[Answer, ...]:
    """The answers where no diagnosis has found anything missing."""
    judged = study.last.judged
    ratio = f"{number(judged.rmse / judged.noise_floor, 3)} times the noise floor"
    error = f"{capitalised(errors_in_words(study))}: {ratio}."
    if present is None:
        return (
            Answer("Not asked yet.", question="What is wrong"),
            Answer(error, question="How far off"),
            Answer(ASK, question="What to do"),
        )
    return (
        Answer("Nothing that these data show.", question="What is wrong"),
        Answer(error, question="How far off"),
        Answer("Nothing.", question="What to add"),
    )


def step_story(study: StudyRecord, place: int) -> str:
    """One diagnosis in a paragraph, as an engineer would write it.

    Args:
        study: as it stands.
        place: number of the step, counted from 0, whose model was diagnosed.
    """
    diagnosis = study.diagnoses[place]
    is_held_out = study.held_out is not None
    if diagnosis.verdict == Verdict.NOTHING_MISSING:
        off = " and ".join(off_words(diagnosis.base))
        return (
            f"Simulated on {judged_words(is_held_out)}, the model is off: {off}. "
            "That is what noise leaves: no force is evident beside the model, and no "
            "effect is decisive."
        )
    told = [
        missing_answer(diagnosis, is_held_out),
        wrong_answer(diagnosis, is_held_out),
        where_answer(diagnosis),
        since_when(diagnosis, study.steps[place].train),
        to_do_answer(diagnosis, is_held_out),
    ]
    if place + 1 < len(study.steps):
        label = capitalised(study.steps[place + 1].label)
        told.append(Answer(f"{label}: added in step {place + 1}."))
    return " ".join(map(str, told))

"""The answers about a study: what was found and what it changed, how sure, how good.

With those of the diagnosis of the present model they are one list. Terminal, notebook,
``--json``, Markdown, report and page print it. Errors are those that the chart of the
errors shows. Here are the facts; the sentences stand in ``words.jinja``.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from phsi_opt.criteria import FAILING_ERROR
from phsi_opt.diagnosis.candidate import Candidate, Finding, Grade, Verdict
from phsi_opt.diagnosis.record import Diagnosis, is_disturbance
from phsi_opt.errors import some_of
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.catalogue import inertia_words
from phsi_opt.model.effect import Effect
from phsi_opt.model.laws import is_second_storage, parameter_words, place_words
from phsi_opt.presentation.content import (
    GOOD,
    LOOK,
    NEXT,
    VERDICT,
    Answer,
    Headline,
    lines_of,
    unestablished_words,
)
from phsi_opt.presentation.numbers import called as in_words
from phsi_opt.presentation.numbers import (
    lowered,
    number,
    said,
    with_error,
    with_interval,
)
from phsi_opt.presentation.sentences import say
from phsi_opt.presentation.summary import Part, Summary
from phsi_opt.presentation.units import STANDARD_DEVIATIONS, spaced, time_words
from phsi_opt.screening.effect_size import Size
from phsi_opt.study.record import StudyRecord

NOT_ASKED = "not diagnosed yet"
POWERS_OF_TEN = (
    *("ten", "a hundred", "a thousand", "ten thousand"),
    *("a hundred thousand", "a million"),
)


def headline_of(study: StudyRecord) -> Headline:
    """What is said of the present model at once."""
    present = study.present
    status = NOT_ASKED
    asks = Answer("Diagnose it: phsi-opt study --auto, or study.auto().", question=NEXT)
    answers = [Answer("Not diagnosed yet.", question=VERDICT, severity=LOOK), asks]
    if present is not None:
        status = str(present.verdict)
        answers = list(present.answers)
    step = _step_to_distinguish(study)
    if status == Verdict.NOTHING_MISSING and step is not None:
        *others, use = answers
        until = f"Until then, {lowered(use.told)}"
        answers = [*others, replace(step, question=NEXT, detail=until)]
    if study.unestablished and answers[0].severity == GOOD:
        answers[0] = replace(answers[0], severity=LOOK)
    elif study.last.added and status == Verdict.UNEXPLAINED and not study.unestablished:
        answers[0] = replace(answers[0], lead="Found in part.")
    if any(one.findings for one in study.diagnoses.values()):
        answers.append(_how_sure(study))
    data = study.last.judged.data
    longest = max(float(np.ptp(run.t)) for run in data)
    duration = time_words(longest, data.units.get("t", ""))
    good = said_of(study, "how_good", longest=duration)
    answers.append(replace(good, question="How good is the model"))
    fit = study.last.cautioned
    warning = "" if study.last.train.warning else study.last.judged.warning
    open_ = undetermined_words(fit, study.train.labels)
    cautions = filter(None, (fit.caution, warning, open_))
    return Headline(status, _discovery(study), tuple(answers), " ".join(cautions))


def _step_to_distinguish(study: StudyRecord) -> Answer | None:
    """What tells an effect that was added from others that do the same, if any does."""
    for diagnosis in study.diagnoses.values():
        for finding in diagnosis.findings:
            is_added = any(one in study.last.added for one in finding.effects)
            if is_added and not finding.is_name:
                return diagnosis.next_step
    return None


def stopped_words(study: StudyRecord) -> str:
    """Why an automatic study stopped, where that is not the verdict; or ""."""
    present = study.present
    is_verdict = present is not None and study.stopped == present.said
    return "" if is_verdict else study.stopped


def summary_of(study: StudyRecord) -> Summary:
    """The effects that were added, the errors, and all answers."""
    added = ", ".join(map(str, study.last.added)) or "nothing added yet"
    headline = headline_of(study)
    # A fit tells its own caution.
    caution = headline.caution.removeprefix(study.last.cautioned.caution)
    names = [study.told(one.effect) for one in study.unestablished]
    told = [
        headline.sentence,
        *lines_of(headline.answers),
        *(caution.strip(), stopped_words(study), unestablished_words(names)),
    ]
    return Summary(
        f"Study of {type(study.last.fit.model).__name__}, added: {added}",
        (
            Part("errors of free runs", table=study.history),
            Part(text="\n".join(filter(None, told))),
        ),
    )


def _how_sure(study: StudyRecord) -> Answer:
    """The odds of what was found so far."""
    found = [one for one in study.diagnoses.values() if one.findings]
    classes = list(chain(*(one.findings for one in found)))
    least = min(one.ranking[0].log_evidence for one in found)
    answer = said_of(
        study,
        "how_sure",
        {"log_evidence": least},
        odds=odds_words(least),
        n_names=len({tuple(map(str, finding.effects)) for finding in classes}),
        has_class=not all(finding.is_name for finding in classes),
    )
    return replace(answer, question="How sure is it")


def odds_words(log_evidence: float) -> str:
    """How sure an effect is, as odds in words: from a hundred to a million to one."""
    power = int(np.clip(log_evidence / np.log(10), 1, 6))
    how = "practically certain" if power >= 4 else "very likely"
    return f"{how} (odds of more than {POWERS_OF_TEN[power - 1]} to one)"


def said_of(
    study: StudyRecord, name: str, numbers: dict[str, Any] | None = None, **facts: Any
) -> Answer:
    """What ``words.jinja`` says under a name of the study as a whole."""
    size, unit = study.error_scale
    labels = study.train.labels
    percent = " %" if study.unit == STANDARD_DEVIATIONS else ""  # of several channels
    steps = study.errors(size)
    last = steps[-1]
    errors = {"base_error": steps[0].judged, "error": last.judged, "noise": last.floor}
    judged = "the training data"
    if study.last.held_out is not None:
        judged = "data not used for fitting"
    return say(
        __package__,
        name,
        errors | {"unit": unit} | (numbers or {}),
        study=study,
        channels=list(map(partial(in_words, labels=labels), study.train.measured)),
        judged=judged,
        failing=FAILING_ERROR,
        present=study.present,
        added=study.last.added,
        size=size,
        percent=percent,
        short=percent or spaced(unit),
        floor=with_interval(
            last.floor or 0.0, last.floor_ends, percent or spaced(unit)
        ),
        **facts,
    )


def _discovery(study: StudyRecord) -> Answer:
    present = study.present
    added = study.last.added
    names = [one.name for one in added]
    open_ = {one.name: one.lost for one in study.unestablished}
    sure = []
    unsure = []
    for effect in added:
        is_alone = names.count(effect.name) == 1  # in one equation
        name = study.told(effect)
        if is_alone:
            name = name.removesuffix(place_words(effect, study.train.labels))
        beside = _beside(study, effect)
        if str(effect) in open_:
            unsure.append(called(name, *beside, open_[str(effect)]))
        else:
            sure.append(called(name, *beside))
    found = []
    if present is not None:
        found = list(map(partial(finding_words, present), present.findings))
    return said_of(study, "discovery", sure=sure, unsure=unsure, found=found)


def _beside(study: StudyRecord, effect: Effect) -> tuple[str, str]:
    """The present size of an effect that was added, and the others of its class."""
    classes = ""
    for diagnosis in study.diagnoses.values():
        for finding in diagnosis.findings:
            if effect in finding.effects:
                classes = classes or alternatives(diagnosis, finding, effect)
    return size_words(study.last.fit, effect, study.size(effect)), classes


# ---- facts ---------------------------------------------------------------------------


def finding_words(diagnosis: Diagnosis, finding: Finding) -> str:
    """An effect with its size, and the others of its class."""
    first = finding.effects[0]
    fits = [one.fit for one in diagnosis.ranking if one.fit and one.effect == first]
    words = size_words((fits or [diagnosis.base.fit])[0], first, finding.size)
    others = alternatives(diagnosis, finding, first)
    return called(diagnosis.told(first), words, others)


def called(name: str, *beside: str) -> str:
    """An effect, with its size and what else is told of it in brackets."""
    told = "; ".join(filter(None, beside))
    return f"{name} ({told})" if told else name


def size_words(fit: Fit, effect: Effect, size: Size) -> str:
    """The size of an effect, per unit of what no equation tells."""
    if not np.isfinite(size.value):
        return ""
    if is_second_storage(effect):
        return " and ".join(_storage_words(fit, effect))
    told = size.words(effect)
    per = inertia_words(fit.model, effect, fit.units) if told == str(size) else ""
    return f"{said(told)}{per}"


def _storage_words(fit: Fit, effect: Effect) -> list[str]:
    """Time constant and capacity of a second storage; none where they are not known."""
    names = [effect.term.terms[-1].name, f"storage_time_constant_{effect.equation}"]
    if not set(names) <= set(fit.names):
        return []
    rate, time = map(fit.estimates.__getitem__, names)
    places = list(map(fit.names.index, names))
    covariance = fit.covariance[np.ix_(places, places)]
    slopes = np.array([time, rate])
    errors = np.sqrt(np.maximum([covariance[1, 1], slopes @ covariance @ slopes], 0.0))
    told = said(str(Size(time, errors[0]).in_unit(fit.parameter_units[names[1]])))
    ratio = with_error(rate * time, errors[1])  # of the capacities
    return [f"time constant {told}", f"{ratio} times the capacity of the first"]


def alternatives(diagnosis: Diagnosis, finding: Finding, effect: Effect) -> str:
    """The other members of a class; "" where there are none."""
    others = ", ".join(diagnosis.told(one) for one in finding.effects if one != effect)
    return f"or {others}; the data cannot distinguish them" if others else ""


def evidence_words(candidate: Candidate) -> str:
    """How clearly it is there, such as "decisive, log evidence 95"; for tables."""
    if not candidate.was_weighed:
        return "not computed"
    grade = "" if candidate.lost else f"{candidate.grade}, "
    return f"{grade}log evidence {number(candidate.log_evidence, 2)}"


def nearest_candidate(diagnosis: Diagnosis) -> Candidate | None:
    """The likeliest effect where something is missing and nothing is named, if any."""
    is_open = diagnosis.verdict == Verdict.UNEXPLAINED and not diagnosis.data_cause
    if not is_open or not diagnosis.ranking:
        return None
    first = diagnosis.ranking[0]
    return None if first.grade == Grade.NONE else first


def samples_to_average(diagnosis: Diagnosis) -> int:
    """How many samples hide a force that shakes in their mean; 0 where none does."""
    if not is_disturbance(diagnosis):
        return 0
    return diagnosis.analysis.force_in().pace.samples_per_cycle


def undetermined_words(fit: Fit, labels: Mapping[str, str]) -> str:
    """The parameters whose standard error exceeds their value; "" for none."""
    parameters = fit.parameters
    errors = parameters["std_error"].astype(float)
    is_open = errors.gt(parameters["value"].abs()) & np.isfinite(errors)
    words = partial(parameter_words, fit.model, labels=labels)
    names = list(map(words, parameters["name"][is_open]))
    if not names:
        return ""
    return (
        f"Parameters that these data do not determine: {some_of(names)} (the standard "
        "error exceeds the value); do not rely on them."
    )

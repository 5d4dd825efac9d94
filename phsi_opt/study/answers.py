"""The verdict on a study and its answers: what is wrong, where, when, what to do.

A diagnosis has one list of answers; the study adds to that of its present model how
sure it is and how good the model is. Terminal, ``--json``, Markdown, report and page
print these lists. Here are the facts; the sentences stand in ``words.jinja``.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd

from phsi_opt.comparison.compare import Comparison, is_failing
from phsi_opt.criteria import SURE_ERROR
from phsi_opt.diagnosis.candidate import Candidate, Finding, Grade, Verdict
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.errors import some_of
from phsi_opt.estimation.fit import Fit
from phsi_opt.force_analysis.analysis import strength_words, when_answer, where_answer
from phsi_opt.model.catalogue import inertia_words
from phsi_opt.model.effect import Effect
from phsi_opt.model.laws import is_second_storage, parameter_words
from phsi_opt.presentation.content import (
    BAD,
    GOOD,
    LOOK,
    NEXT,
    Answer,
    Headline,
    verdict_words,
)
from phsi_opt.presentation.numbers import capitalised, number, said, with_error
from phsi_opt.presentation.sentences import say
from phsi_opt.presentation.units import (
    STANDARD_DEVIATIONS,
    spaced,
    time_words,
)
from phsi_opt.screening.effect_size import Size
from phsi_opt.statistics import TINY
from phsi_opt.study.record import StudyRecord

NOT_ASKED = "not diagnosed yet"
ASK = "Diagnose it: phsi-opt study --auto, or study.auto()."
SEVERITIES = {
    str(Verdict.NOTHING_MISSING): GOOD,
    str(Verdict.NAMED): LOOK,
    str(Verdict.PARTLY_NAMED): LOOK,
    str(Verdict.UNEXPLAINED): BAD,
    NOT_ASKED: LOOK,
}
POWERS_OF_TEN = (
    *("ten", "a hundred", "a thousand", "ten thousand"),
    *("a hundred thousand", "a million"),
)
NEAR_FLOOR = 1.1  # times the noise floor: the error of what is fitted to the noise


def answer(name: str, diagnosis: Diagnosis, **more: Any) -> Answer:
    """What ``words.jinja`` says under a name of a diagnosis."""
    force = diagnosis.analysis.force_in()
    facts = {
        "d": diagnosis,
        "force": force,
        "units": diagnosis.record.data.units,
        **_shared(diagnosis.base.record is not diagnosis.record),
        "ratio": diagnosis.base.rmse / diagnosis.base.noise_floor,
        # Times the noise floor up to which an error is that of the noise.
        "at_noise": 1.05,
        "sure_error": SURE_ERROR,
        "classes": [" or ".join(map(str, one.effects)) for one in diagnosis.findings],
        "has_class": not all(finding.is_name for finding in diagnosis.findings),
        "disturbance": disturbance_word(diagnosis),
        "nearest": nearest_candidate(diagnosis),
        "fall_with": partial(_fall_with, diagnosis),
        "found": [finding_words(diagnosis, one) for one in diagnosis.findings],
        "force_size": strength_words(force),
    }
    return say(__package__, name, **facts, **more)


def _shared(is_held_out: bool) -> dict[str, Any]:
    """What the data are called that judge, and how errors on them are told."""
    judged = "data not used for fitting" if is_held_out else "the training data"
    return {
        "judged": judged,
        "the_error": f"the error on {judged}",
        "is_failing": is_failing,
        "off_channels": off_channels,
    }


def answers_of(diagnosis: Diagnosis) -> dict[str, Answer]:
    """What is wrong with a model, where and when, and what to do, by question."""
    told = {"What is wrong": answer("wrong", diagnosis)}
    if diagnosis.verdict != Verdict.NOTHING_MISSING:
        told["Where"] = _where(diagnosis)
        told["When"] = when_answer(diagnosis.analysis.force_in())
    return {**told, NEXT: diagnosis.next_step}


def asked(told: Mapping[str, Answer]) -> tuple[Answer, ...]:
    """The answers that say something, with their questions."""
    known = {question: one for question, one in told.items() if one.lead}
    return tuple(replace(one, question=question) for question, one in known.items())


def _where(diagnosis: Diagnosis) -> Answer:
    """Where what was found acts, each place once; else where a force appears."""
    # What it looks like is what the other parameters leave of it.
    effects = chain(*(finding.effects for finding in diagnosis.findings))
    places = dict.fromkeys(map(_acts, effects))
    if places:
        return Answer(f"{capitalised(' or '.join(places))}.")
    force = diagnosis.analysis.force_in()
    if force.is_uncertain:
        return Answer("No equation, time or region is conspicuous.")
    return where_answer(force)


def _acts(effect: Effect) -> str:
    if effect.slot == "sensor":
        return f"at the sensor of {effect.equation}"
    if not effect.equation.isidentifier():
        return f"along {effect.equation}"
    return f"in d{effect.equation}/dt"


# ---- facts ---------------------------------------------------------------------------


def finding_words(diagnosis: Diagnosis, finding: Finding) -> str:
    """An effect with its size, and the others of its class."""
    first = finding.effects[0]
    fits = [one.fit for one in diagnosis.ranking if one.fit and one.effect == first]
    words = size_words((fits or [diagnosis.base.fit])[0], first, finding.size)
    return called(str(first), words, alternatives(finding, str(first)))


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


def alternatives(finding: Finding, name: str) -> str:
    """The other members of a class; "" where there are none."""
    others = ", ".join(one for one in map(str, finding.effects) if one != name)
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


def _fall_with(diagnosis: Diagnosis, candidate: Candidate) -> float:
    """The share of the error that it takes away; 0 where that is not known."""
    found = candidate.comparison
    return 0.0 if found is None else 1 - found.rmse / diagnosis.base.rmse


def disturbance_word(diagnosis: Diagnosis) -> str:
    """What stands beside a verdict whose force shakes; "" for others."""
    force = diagnosis.analysis.force_in()
    is_open = not (diagnosis.findings or diagnosis.data_cause or force.is_uncertain)
    is_missing = diagnosis.verdict != Verdict.NOTHING_MISSING
    is_fast = is_missing and is_open and force.pace.is_vibration
    return "fast disturbance" if is_fast else ""


def samples_to_average(diagnosis: Diagnosis) -> int:
    """How many samples hide a force that shakes in their mean; 0 where none does."""
    if not disturbance_word(diagnosis):
        return 0
    return diagnosis.analysis.force_in().pace.samples_per_cycle


def undetermined_words(fit: Fit) -> str:
    """The parameters whose standard error exceeds their value; "" for none."""
    parameters = fit.parameters
    errors = parameters["std_error"].astype(float)
    is_open = errors.gt(parameters["value"].abs()) & np.isfinite(errors)
    words = partial(parameter_words, fit.model)
    names = list(map(words, parameters["name"][is_open]))
    if not names:
        return ""
    return (
        f"Parameters that these data do not determine: {some_of(names)} (the standard "
        "error exceeds the value); do not rely on them."
    )


def off_channels(judged: Comparison) -> pd.DataFrame:
    """The three channels that are farthest off, the worst first, in percent."""
    ratio: pd.Series = judged.table["noise_floor"] / judged.table["rmse"].clip(
        lower=TINY
    )
    off: pd.Series = 100 - judged.table["fit_percent"]
    table = judged.table.assign(off=off, noise=off * ratio)
    return table.sort_values("off", ascending=False, kind="stable")[:3]


def only_follows(trained: Comparison, judged: Comparison) -> bool:
    """Whether a model fits its training data to the noise, and no other data."""
    floor = judged.noise_floor
    return trained.rmse < NEAR_FLOOR * floor and judged.rmse > 2 * floor


# ---- the study as a whole ------------------------------------------------------------


def headline_of(study: StudyRecord) -> Headline:
    """The verdict on the present model, and the answers of the first screen."""
    present = study.present
    status = NOT_ASKED
    remark = ""
    answers = {NEXT: Answer(ASK)}
    if present is not None:
        status = str(present.verdict)
        remark = disturbance_word(present)
        answers = answers_of(present)
    severity = SEVERITIES[status]
    badge = verdict_words(status)
    if study.unestablished and severity == GOOD:
        severity = LOOK
    elif study.last.added and status == Verdict.UNEXPLAINED and not study.unestablished:
        badge = "partly explained"
    data = study.last.judged.data
    longest = max(float(np.ptp(run.t)) for run in data)
    duration = time_words(longest, data.units.get("t", ""))
    answers["How sure is it"] = _certainty(study)
    answers["How good is the model"] = said_of(study, "how_good", longest=duration)
    fit = study.last.cautioned
    warning = "" if study.last.train.warning else study.last.judged.warning
    cautions = (fit.caution, warning, undetermined_words(fit))
    return Headline(
        status,
        severity,
        _discovery(study),
        badge,
        asked(answers),
        remark=remark,
        caution=" ".join(filter(None, cautions)),
    )


def _certainty(study: StudyRecord) -> Answer:
    """The odds of what was found so far; without a name, whether anything lacks."""
    found = [one for one in study.diagnoses.values() if one.findings]
    if not found:
        return answer("certainty", study.present) if study.present else Answer("")
    classes = list(chain(*(one.findings for one in found)))
    names = {" or ".join(map(str, finding.effects)) for finding in classes}
    return said_of(
        study,
        "how_sure",
        odds=odds_words(min(one.ranking[0].log_evidence for one in found)),
        n_names=len(names),
        has_class=not all(finding.is_name for finding in classes),
    )


def odds_words(log_evidence: float) -> str:
    """How sure an effect is, as odds in words: from a hundred to a million to one."""
    power = int(np.clip(log_evidence / np.log(10), 1, 6))
    how = "practically certain" if power >= 4 else "very likely"
    return f"{how} (odds of more than {POWERS_OF_TEN[power - 1]} to one)"


def said_of(study: StudyRecord, name: str, **facts: Any) -> Answer:
    """What ``words.jinja`` says under a name of the study as a whole."""
    size, unit = study.error_scale
    short = ""
    if study.unit == STANDARD_DEVIATIONS:  # of channels with several units
        unit, short = "% of the standard deviation", " %"
    return say(
        __package__,
        name,
        study=study,
        **_shared(study.last.held_out is not None),
        present=study.present,
        added=study.last.added,
        size=size,
        unit=spaced(unit),
        short=short,
        floor=study.last.judged.floor_words(size, short or spaced(unit)),
        **facts,
    )


def _discovery(study: StudyRecord) -> Answer:
    present = study.present
    lacking = Answer("")
    if present is not None and present.verdict != Verdict.NOTHING_MISSING:
        lacking = answer("missing", present)
    added = study.last.added
    names = [one.name for one in added]
    open_ = {one.name: one.lost for one in study.unestablished}
    sure = []
    unsure = []
    for effect in added:
        is_alone = names.count(effect.name) == 1  # in one equation
        name = effect.name if is_alone else str(effect)
        beside = _beside(study, effect)
        if str(effect) in open_:
            unsure.append(called(name, *beside, open_[str(effect)]))
        else:
            sure.append(called(name, *beside))
    return said_of(study, "discovery", lacking=lacking, sure=sure, unsure=unsure)


def _beside(study: StudyRecord, effect: Effect) -> tuple[str, str]:
    """The present size of an effect that was added, and the others of its class."""
    classes = ""
    for finding in chain(*(one.findings for one in study.diagnoses.values())):
        if effect in finding.effects:
            classes = classes or alternatives(finding, str(effect))
    return size_words(study.last.fit, effect, study.size(effect)), classes

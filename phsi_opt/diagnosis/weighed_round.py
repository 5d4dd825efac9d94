"""The candidates, screened and weighed, the likeliest first."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from phsi_opt.criteria import FAR_BEHIND, FEWEST_WEIGHED, MOST_WEIGHED, STRONG_EVIDENCE
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.errors import SolveError
from phsi_opt.estimation.estimate import Progress
from phsi_opt.model.effect import Effect
from phsi_opt.screening.effect_size import new_names, size_of, size_unit
from phsi_opt.screening.linearized_record import LinearizedRecord
from phsi_opt.screening.score_test import ScoreTest, Screened
from phsi_opt.screening.weighing import EvidenceRecord, Weighed
from phsi_opt.statistics import TINY
from phsi_opt.sweeps.sweep import Ahead

FORCE_DOES = "it would explain no more than a force without a law"


def weighed_round(
    base: DiagnosedModel, record: EvidenceRecord, effects: Sequence[Effect]
) -> tuple[EvidenceRecord, list[Candidate]]:
    """All candidates, the likeliest first.

    Screening tells which of them may gain anything; these are weighed. Where the base
    is likelier from where the likeliest of them ended, all begins again from there.

    Args:
        base: the model that is diagnosed.
        record: beside which models are weighed.
        effects: what may be missing.

    Returns:
        The record with the base where it is most likely, and the candidates.
    """
    while True:  # the evidence of the base rises each time
        candidates, likeliest = _weighed_beside(base, record, effects)
        better = None if likeliest is None else record.better_from(likeliest)
        if better is None:
            return record, candidates
        base.say("the model is likelier from where the likeliest effect was weighed")
        record = better


def _weighed_beside(
    base: DiagnosedModel, record: EvidenceRecord, effects: Sequence[Effect]
) -> tuple[list[Candidate], Weighed | None]:
    """All candidates beside one weighing of the base, and the likeliest that gains."""
    base.say(f"screening {len(effects)} candidate effects")
    test = ScoreTest(LinearizedRecord.beside_force(record))
    screened = []
    for effect in effects:
        found = test.screened(effect)
        if found is not None:
            screened.append(found)
    screened.sort(key=lambda one: -one.gain)
    n_gaining = sum(one.gain > 0 for one in screened)
    chosen = screened[: int(np.clip(n_gaining, FEWEST_WEIGHED, MOST_WEIGHED))]
    cases = {str(place): one for place, one in enumerate(chosen)}
    weigh = partial(_weighed, record)
    ahead = Ahead(weigh, cases, base.executor, base.say)
    candidates: list[Candidate] = []
    likeliest = None
    highest = 0.0
    worth = -np.inf
    try:
        for place, one in enumerate(chosen):
            if one.gain < worth:
                break
            n_effects = len(screened)
            candidate = _expected(base, one)
            try:
                weighed = ahead.result(str(place))
            except SolveError as error:
                base.say(str(error))
                lost = "it could not be weighed"
                candidates.append(replace(candidate, log_bayes=np.nan, lost=lost))
                continue
            candidate = _candidate(base, record, one, weighed, n_effects)
            candidates.append(candidate)
            if candidate.log_evidence > highest:
                highest = candidate.log_evidence
                likeliest = weighed
                worth = FAR_BEHIND * min(one.gain, candidate.log_evidence)
    finally:
        ahead.close()
    for one in screened[len(candidates) :]:
        lost = FORCE_DOES if one.gain <= 0 else "it is expected to gain far less"
        candidates.append(replace(_expected(base, one), lost=lost))
    return _in_order(candidates), likeliest


def _weighed(record: EvidenceRecord, one: Screened, say: Progress) -> Weighed:
    say(f"weighing {one.effect}")
    return record.weighed(one.model, one.values)


def _expected(base: DiagnosedModel, one: Screened) -> Candidate:
    return Candidate(
        effect=one.effect,
        coefficient=one.coefficient,
        std_error=one.std_error,
        unit=size_unit(base.fit.model, one.effect, base.record.data.units),
        values=one.values,
        log_bayes=one.gain,
    )


def _candidate(
    base: DiagnosedModel,
    record: EvidenceRecord,
    one: Screened,
    weighed: Weighed,
    n_effects: int,
) -> Candidate:
    """An effect with what it weighs."""
    alone = record.base
    # Those of its parameters that all trajectories share.
    names = new_names(base.fit.model, one.effect, weighed.names)
    places = [weighed.names.index(name) for name in names]
    size = size_of(
        one.effect,
        weighed.model,
        names,
        weighed.model.values,
        weighed.covariance[np.ix_(places, places)],
    )
    # What was tried is in the prior: values of inner numbers, and effects.
    tried = float(np.log(one.n_tried * n_effects))
    if one.effect.needs_clock and not base.fit.model.inputs:
        # What nobody drives rarely knows the time; runs begun in phase only look so.
        tried += STRONG_EVIDENCE
    place = base.fit.model.index(one.effect.equation)
    held_out = np.nan
    if base.is_held_out:
        held_out = weighed.log_held_out - alone.log_held_out
    return replace(
        _expected(base, one),
        coefficient=size.value,
        std_error=size.std_error,
        values=weighed.model.values,
        states=weighed.states[: record.n_fitted_nodes],
        log_bayes=weighed.log_training - alone.log_training - tried,
        log_predictive=held_out,
        was_weighed=True,
        force_left=weighed.force_share(place) / max(alone.force_share(place), TINY),
        lost=_outside(weighed, names),
    )


def _outside(weighed: Weighed, names: Sequence[str]) -> str:
    """What ended at a bound: no record tells it, or a smaller law does as well."""
    for name in names:
        if name in weighed.at_bounds:
            _, _, inner = name.partition(".")
            return f"its {inner or 'size'} ended at a bound"
    return ""


def _in_order(candidates: Sequence[Candidate]) -> list[Candidate]:
    """By evidence, weighed ones first, with probabilities and what is alike."""
    gains = [one.log_evidence if one.was_weighed else -np.inf for one in candidates]
    highest = max([0.0, *gains])
    odds = np.exp(np.array([0.0, *gains]) - highest)
    found = []
    for one, gain, odd in zip(candidates, gains, odds[1:], strict=True):
        alike = []
        for other, of_other in zip(candidates, gains, strict=True):
            is_near = abs(of_other - gain) < STRONG_EVIDENCE
            if other is not one and one.was_weighed and is_near and gain > 0:
                alike.append(other.name)
        probability = float(odd / np.sum(odds))
        if not one.was_weighed:
            probability = 0.0
        found.append(
            replace(one, probability=probability, confusable_with=tuple(alike))
        )
    order = np.argsort([-gain for gain in gains], kind="stable")
    return [found[place] for place in order]

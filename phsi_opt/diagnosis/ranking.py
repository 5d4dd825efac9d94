"""The candidates, screened and weighed, the likeliest first."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial

import numpy as np

from phsi_opt.criteria import FAR_BEHIND, FEWEST_WEIGHED, MOST_WEIGHED, STRONG_EVIDENCE
from phsi_opt.diagnosis.candidate import Candidate, at_limit
from phsi_opt.diagnosis.refit import DiagnosedModel
from phsi_opt.errors import SolveError
from phsi_opt.model.effect import Effect
from phsi_opt.screening.effect_size import Size, new_names, size_of, size_unit
from phsi_opt.screening.linearized_record import LinearizedRecord
from phsi_opt.screening.score_test import ScoreTest, Screened
from phsi_opt.screening.weighing import EvidenceRecord, Weighed
from phsi_opt.statistics import TINY
from phsi_opt.sweeps.sweep import Progress, ahead

NO_EVIDENCE = "no states follow the measurements with it"


def ranked(
    base: DiagnosedModel, record: EvidenceRecord, effects: Sequence[Effect]
) -> tuple[EvidenceRecord, list[Candidate]]:
    """The candidates, the likeliest first, and the record beside the likeliest base.

    Screening tells which of them may gain anything; these are weighed. Where the base
    is likelier from where the likeliest of them ended, all begins again from there.
    """
    while True:  # the evidence of the base rises each time
        candidates, likeliest = _ranked_beside(base, record, effects)
        better = None if likeliest is None else record.better_from(likeliest)
        if better is None:
            return record, candidates
        base.say(
            "a better optimum of the model was found with the most likely "
            "effect; screening again"
        )
        record = better


def _ranked_beside(
    base: DiagnosedModel, record: EvidenceRecord, effects: Sequence[Effect]
) -> tuple[list[Candidate], Weighed | None]:
    """All candidates beside one weighing of the base, and the likeliest that gains."""
    base.say(f"screening {len(effects)} candidate effects")
    test = ScoreTest(LinearizedRecord.beside_force(record))
    tested = map(test.screened, effects)
    screened = sorted(filter(None, tested), key=lambda one: -one.gain)
    n_gaining = sum(one.gain > 0 for one in screened)
    chosen = screened[: int(np.clip(n_gaining, FEWEST_WEIGHED, MOST_WEIGHED))]
    cases = {str(place): one for place, one in enumerate(chosen)}
    candidates: list[Candidate] = []
    likeliest = None
    highest = 0.0
    worth = -np.inf
    weigh = partial(_weighed, record)
    with closing(ahead(weigh, cases, base.executor, base.say)) as results:
        for one in chosen:
            if one.gain < worth:
                break
            try:
                weighed = next(results)()
            except SolveError:
                base.say(f"{one.effect} is not considered: {NO_EVIDENCE}")
                failed = _expected(base, one, NO_EVIDENCE)
                candidates.append(replace(failed, log_bayes=np.nan))
                continue
            candidate = _candidate(base, record, one, weighed, len(screened))
            candidates.append(candidate)
            if candidate.log_evidence > highest:
                highest = candidate.log_evidence
                likeliest = weighed
                worth = FAR_BEHIND * min(one.gain, candidate.log_evidence)
    for one in screened[len(candidates) :]:
        lost = "its expected evidence is much smaller"
        if one.gain <= 0:
            lost = "it would explain no more than a random disturbance"
        candidates.append(_expected(base, one, lost))
    return _in_order(candidates), likeliest


def _weighed(record: EvidenceRecord, one: Screened, say: Progress) -> Weighed:
    say(f"computing the evidence of {one.effect}")
    return record.weighed(one.model, one.values)


def _expected(base: DiagnosedModel, one: Screened, lost: str) -> Candidate:
    unit = size_unit(base.fit.model, one.effect, base.record.data.units)
    size = Size(one.coefficient, one.std_error).in_unit(unit)
    return Candidate(
        effect=one.effect,
        coefficient=size.value,
        std_error=size.std_error,
        unit=size.unit,
        values=one.values,
        log_bayes=one.gain,
        lost=lost,
    )


def _candidate(
    base: DiagnosedModel,
    record: EvidenceRecord,
    one: Screened,
    weighed: Weighed,
    n_effects: int,
) -> Candidate:
    alone = record.base
    model = base.fit.model
    # Those of its parameters that all trajectories share.
    names = new_names(model, one.effect, weighed.names)
    places = list(map(weighed.names.index, names))
    covariance = weighed.covariance[np.ix_(places, places)]
    size = size_of(one.effect, weighed.model, names, weighed.model.values, covariance)
    size = size.in_unit(size_unit(model, one.effect, base.record.data.units))
    # What was tried is in the prior: values of inner numbers, and effects.
    tried = float(np.log(one.n_tried * n_effects))
    if one.effect.needs_clock and not model.inputs:
        # What nobody drives rarely knows the time; runs begun in phase only look so.
        tried += STRONG_EVIDENCE
    equation = model.index(one.effect.equation)
    forces = [found.force_share(equation) for found in (weighed, alone)]
    held_out = weighed.log_held_out - alone.log_held_out if base.is_held_out else np.nan
    # At a bound: no record tells it, or a smaller law does as well.
    lost = at_limit(weighed.model, names, weighed.at_bounds)
    return replace(
        _expected(base, one, lost),
        coefficient=size.value,
        std_error=size.std_error,
        values=weighed.model.values,
        states=weighed.states[: record.n_fitted_nodes],
        log_bayes=weighed.log_training - alone.log_training - tried,
        log_predictive=held_out,
        was_weighed=True,
        force_left=forces[0] / max(forces[1], TINY),
    )


def _in_order(candidates: Sequence[Candidate]) -> list[Candidate]:
    """By evidence, weighed ones first, with probabilities and what is alike."""
    gains = [one.log_evidence if one.was_weighed else -np.inf for one in candidates]
    odds = np.exp(np.array([0.0, *gains]) - max([0.0, *gains]))
    probabilities = (odds[1:] / np.sum(odds)).tolist()
    found = []
    for one, gain, probability in zip(candidates, gains, probabilities, strict=True):
        names = tuple(
            other.name
            for other, of_other in zip(candidates, gains, strict=True)
            if other is not one and abs(of_other - gain) < STRONG_EVIDENCE and gain > 0
        )
        found.append(replace(one, probability=probability, confusable_with=names))
    order = np.argsort([-gain for gain in gains], kind="stable")
    return [found[place] for place in order]

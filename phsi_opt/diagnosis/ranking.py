"""The candidates, screened and weighed, the likeliest first."""

from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from phsi_opt.criteria import (
    FAR_BEHIND,
    LEAST_FINDING,
    MOST_WEIGHED,
    STRONG_EVIDENCE,
)
from phsi_opt.diagnosis.candidate import Candidate, at_limit
from phsi_opt.diagnosis.refit import DiagnosedModel, fitted_by_steps
from phsi_opt.errors import SolveError
from phsi_opt.initialization.relative_guesses import values_at
from phsi_opt.model.effect import Effect
from phsi_opt.model.functions import formulas_like, unknown_functions
from phsi_opt.model.laws import effect_words, law_of
from phsi_opt.model.parameters import Scan
from phsi_opt.screening.effect_size import Size, new_names, size_of, size_unit
from phsi_opt.screening.linearized_record import LinearizedRecord
from phsi_opt.screening.score_test import ScoreTest, Screened
from phsi_opt.screening.weighing import EvidenceRecord, Weighed
from phsi_opt.statistics import TINY
from phsi_opt.sweeps.sweep import Progress, ahead

NO_EVIDENCE = "with it the model cannot follow the measurements"
UNREPEATED = (
    "the record has only {:.1f} of its periods, and any slow change looks like that"
)
# Leaders of a list of screening that are weighed from a second place.
MOST_LEADERS = 3


@dataclass(eq=False)
class Ranking:
    """The candidates beside one weighing of the base, the likeliest first."""

    record: EvidenceRecord
    # What screening expects of effects that leave a trace, best first, by their names.
    screened: dict[str, Screened]
    candidates: list[Candidate] = field(default_factory=list)
    # What was weighed, by the name of the effect.
    weighed: dict[str, Weighed] = field(default_factory=dict)
    # Odds of the effects that were asked besides those that were screened here.
    before: float = 0.0

    @property
    def odds(self) -> float:
        """Of all effects that were asked, together."""
        known = (law_of(one.effect.name).odds for one in self.screened.values())
        return self.before + sum(known)

    def price(self, one: Screened) -> float:
        """Logarithm of what was tried: values of inner numbers, and effects.

        Of the effects those count more that are met more often (`model.laws`).
        """
        own = law_of(one.effect.name).odds
        return float(np.log(one.n_tried * self.odds / own))

    def take(self, base: DiagnosedModel, one: Screened, weighed: Weighed) -> Candidate:
        """Note what was weighed; the likelier of two counts."""
        found = self._candidate(base, one, weighed)
        for place, other in enumerate(self.candidates):
            if other.effect == one.effect:
                if other.was_weighed and other.log_evidence >= found.log_evidence:
                    return other
                del self.candidates[place]
                break
        self.candidates.append(found)
        self.weighed[found.name] = weighed
        return found

    def join(self, further: "Ranking") -> None:
        """Take in what was weighed beside the same weighing of the base."""
        new = [one for one in further.candidates if one.name not in self.weighed]
        self.weighed = {**further.weighed, **self.weighed}
        self.screened = {one.name: further.screened[one.name] for one in new} | (
            self.screened
        )
        self.before += further.odds - self.odds  # of whatever was asked
        self.candidates = _in_order([*self.candidates, *new])

    def _candidate(
        self, base: DiagnosedModel, one: Screened, weighed: Weighed
    ) -> Candidate:
        alone = self.record.base
        model = base.fit.model
        # Those of its parameters that all trajectories share.
        names = new_names(model, one.effect, weighed.names)
        places = list(map(weighed.names.index, names))
        within = weighed.covariance[np.ix_(places, places)]
        size = size_of(one.effect, weighed.model, names, weighed.model.values, within)
        size = size.in_unit(size_unit(model, one.effect, base.record.data.units))
        held_out = np.nan
        if base.is_held_out:
            held_out = weighed.log_held_out - alone.log_held_out
        gain = weighed.log_training - alone.log_training
        return replace(
            _expected(base, one, lost_of(self.record, one.effect, weighed)),
            coefficient=size.value,
            std_error=size.std_error,
            values=weighed.model.values,
            states=weighed.states[: self.record.n_fitted_nodes],
            log_bayes=gain - self.price(one),
            log_predictive=held_out,
            was_weighed=True,
            force_left=force_left(weighed, alone, model.rows(one.effect.equation)),
        )


def lost_of(record: EvidenceRecord, effect: Effect, weighed: Weighed) -> str:
    """Why an effect that was weighed is rejected; empty: it is not.

    One of its numbers is at a limit: no record tells it, or a smaller law does as well.
    Or it is a wave that the record does not repeat.
    """
    model = record.base.model
    names = new_names(model, effect, weighed.names)
    entries = model.add(effect).entries
    for name in names:
        guess = entries[name].parameter.guess
        if isinstance(guess, Scan):
            grid = record.weighing.aligned.grid
            along = values_at(model, grid, record.base.states, guess.variable)
            turns = weighed.model.values[name] * np.ptp(along) / (2 * np.pi)
            if turns < 2:  # what repeats was there before
                return UNREPEATED.format(turns)
    labels = record.weighing.aligned.data.labels
    return at_limit(weighed.model, names, weighed.at_bounds, labels)


def force_left(weighed: Weighed, alone: Weighed, equations: Sequence[int]) -> float:
    """Size of the force beside a model over that beside a smaller one, at most."""
    left = []
    for equation in equations:
        before = max(alone.force_share(equation), TINY)
        left.append(weighed.force_share(equation) / before)
    return max(left)


def screened_beside(
    linearized: LinearizedRecord, effects: Sequence[Effect]
) -> list[Screened]:
    """What is expected of the effects that leave a trace in a record, best first."""
    test = ScoreTest(linearized)
    return sorted(filter(None, map(test.screened, effects)), key=lambda one: -one.gain)


def ranked(
    base: DiagnosedModel, record: EvidenceRecord, effects: Sequence[Effect]
) -> Ranking:
    """The candidates, the likeliest first, beside the likeliest weighing of the base.

    Screening tells which of them may gain anything; these are weighed. Where the base
    is likelier from where the likeliest of them ended, all begins again from there.
    """
    while True:  # the evidence of the base rises each time
        ranking = _ranked_beside(base, record, effects)
        first = ranking.candidates[:1]
        gaining = [one for one in first if one.was_weighed and one.log_evidence > 0]
        if not gaining:
            return ranking
        better = record.better_from(ranking.weighed[gaining[0].name])
        if better is None:
            return ranking
        base.say(
            "a better optimum of the model was found with the most likely "
            "effect; screening again"
        )
        record = better


def _ranked_beside(
    base: DiagnosedModel,
    record: EvidenceRecord,
    effects: Sequence[Effect],
    before: float = 0.0,
    highest: float = 0.0,
) -> Ranking:
    """All candidates beside one weighing of the base.

    Others were asked before, of a log evidence up to the ``highest``.
    """
    base.say(f"screening {len(effects)} candidate effects")
    screened = screened_beside(LinearizedRecord.beside_force(record), effects)
    by_name = {str(one.effect): one for one in screened}
    ranking = Ranking(record, by_name, before=before)
    chosen = [one for one in screened if one.gain > 0][:MOST_WEIGHED]
    n = len(chosen)
    cases = {f"{k} of {n}": (one, f"{k} of {n}") for k, one in enumerate(chosen, 1)}
    worth = FAR_BEHIND * highest
    weigh = partial(_weighed_in_turn, record)
    with closing(ahead(weigh, cases, base.executor, base.say)) as results:
        for one in chosen:
            if one.gain < worth:
                break
            try:
                weighed = next(results)()
            except SolveError:
                base.say(f"{base.told(one.effect)} was skipped: {NO_EVIDENCE}")
                failed = _expected(base, one, NO_EVIDENCE)
                ranking.candidates.append(replace(failed, log_bayes=np.nan))
                continue
            candidate = ranking.take(base, one, weighed)
            if candidate.log_evidence > highest:
                highest = candidate.log_evidence
                worth = FAR_BEHIND * min(one.gain, candidate.log_evidence)
    for one in screened[len(ranking.candidates) :]:
        lost = "its expected evidence is much smaller"
        if one.gain <= 0:
            lost = "it would explain no more than a random disturbance"
        ranking.candidates.append(_expected(base, one, lost))
    ranking.candidates = _in_order(ranking.candidates)
    return ranking


def rank_again(
    base: DiagnosedModel, ranking: Ranking, effects: Sequence[Effect]
) -> None:
    """Weigh what leads from fits of their own, too; the likelier of both counts.

    Where a force does nearly everything, screening beside it sees little, and a search
    that begins beside it may end anywhere. So what leads this list, or the list of the
    base without a force, is weighed from the free run of its own fit, if this is near
    and explains anything.
    """
    base.say("weighing the most likely effects from their own fits")
    hard: list[Screened] = []
    with suppress(SolveError):  # a state acts on nothing that was measured
        hard = screened_beside(LinearizedRecord.without_force(base.record), effects)
    known = ranking.screened | {str(one.effect): one for one in hard}
    first = [str(one.effect) for one in hard[:MOST_LEADERS]]
    second = [one.name for one in ranking.candidates[:MOST_LEADERS]]
    for name in dict.fromkeys(first + second):
        one = known[name]
        ranking.screened.setdefault(name, one)
        larger = fitted_by_steps(base, _expected(base, one, ""))
        if larger is None or not base.share_explained(larger) > LEAST_FINDING:
            continue
        with suppress(SolveError):
            weighed = ranking.record.fitted(larger.comparisons, has_force=True)
            ranking.take(base, one, weighed)
    ranking.candidates = _in_order(ranking.candidates)


def ranked_functions(
    base: DiagnosedModel, ranking: Ranking, are_candidates: bool, highest: float
) -> Ranking:
    """Unknown functions that lead either list of screening, weighed.

    Where they are candidates, so are the formulas that they may be. Those are weighed
    that may come near the ``highest`` log evidence of what is known.
    """
    base.say("screening unknown functions")
    records = [LinearizedRecord.beside_force(ranking.record)]
    with suppress(SolveError):
        records.append(LinearizedRecord.without_force(base.record))
    model = base.fit.model
    bells = list(unknown_functions(model, records[0].range_of))
    leaders: dict[tuple[str, str], list[Effect]] = {}
    for record in records:
        found: dict[tuple[str, str], list[Effect]] = {}
        for one in screened_beside(record, bells):
            place = (one.effect.family, one.effect.equation)
            found.setdefault(place, []).append(one.effect)
        leaders |= dict(list(found.items())[:MOST_LEADERS])
    functions: list[Effect] = []
    for alike in leaders.values():
        if are_candidates:
            functions += formulas_like(model, alike[0])
        functions += alike
    # The leaders come from all that were asked, and after the effects.
    n_others = len(bells) - sum(map(len, leaders.values()))
    before = ranking.odds + n_others * law_of("unknown").odds
    further = _ranked_beside(base, ranking.record, functions, before, max(highest, 0.0))
    if are_candidates:
        rank_again(base, further, functions)
    further.candidates = [one for one in further.candidates if one.was_weighed]
    return further


def weighed_of(
    record: EvidenceRecord, one: Screened, say: Progress, worth: float = -np.inf
) -> Weighed:
    """A candidate weighed from where it was screened, as far as it is worth that."""
    told = effect_words(one.effect, record.weighing.aligned.data.labels)
    say(f"computing the evidence of {told}")
    return record.weighed(one.model, one.values, worth)


def _weighed_in_turn(
    record: EvidenceRecord, numbered: tuple[Screened, str], say: Progress
) -> Weighed:
    """The same for a candidate with its number among all, such as "3 of 12"."""
    one, number = numbered
    return weighed_of(record, one, lambda line: say(f"{line} ({number})"))


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

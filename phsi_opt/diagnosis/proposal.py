"""What is proposed to be added: one effect, or two together where one is not enough."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import comb

from phsi_opt.comparison.compare import Comparison
from phsi_opt.comparison.model_selection import (
    delta_bic,
    explained_share,
    falls_or_explains_most,
    free_run_deviance,
    is_explained,
    is_failing,
    is_like_noise,
    share_of_change,
)
from phsi_opt.criteria import (
    ALONE_SHARE,
    BIC_TIE,
    FALSE_DISCOVERY_RATE,
    FEWER_BESIDE_ALL,
    HELD_OUT_RISE,
    N_PAIR_RIVALS,
    N_UNSETTLED_PAIRS,
    SIMPLE_SHARE,
    SIMPLE_SHARE_BESIDE_ALL,
)
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.doubts import fitted_size, z_beside_others
from phsi_opt.diagnosis.dry_friction import other_kinds, simplest_dry
from phsi_opt.diagnosis.ranking import as_refitted, expected, request_of
from phsi_opt.diagnosis.refit import Refit, RefitRequest, refit
from phsi_opt.diagnosis.refit_round import RefitRound, until_their_turn
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import Effect
from phsi_opt.model_error.standard_errors import Source
from phsi_opt.screening.prospects import Prospect, Prospects
from phsi_opt.screening.second_look import second_look


@dataclass(frozen=True, eq=False)
class Proposal:
    """One effect, or two together, re-fitted.

    Attributes:
        candidate: what is added.
        done: the re-fit, with its free runs.
    """

    candidate: Candidate
    done: Refit

    @property
    def fit(self) -> Fit:
        """The brief re-fit."""
        return self.done.fit


@dataclass(eq=False)
class _Search:
    """The search for a pair that explains clearly more.

    Attributes:
        base: the model that is diagnosed.
        prospects: its larger models.
        singles: the effects among which pairs are made, best first.
        doubted: those that were re-fitted alone and are not believed.
        known: fits made before, at which a re-fit may begin.
        looked: pairs that were looked at or re-fitted, to be told.
    """

    base: DiagnosedModel
    prospects: Prospects
    singles: Sequence[Prospect]
    doubted: Sequence[Effect]
    known: list[Fit]
    looked: list[Candidate] = field(default_factory=list)

    def best(self, single: Proposal | None) -> Proposal | None:
        """The best pair, or the single effect where no pair is clearly better.

        Dry friction is the simplest of its kinds in the pairs; the others are tried in
        the best one.
        """
        most = self.base.most_pair_refits
        best = self._best_of(single, self.pairs(simplest_dry(self.singles), most))
        if best is None or best.candidate.partner is None:
            return best
        self.known.append(best.fit)
        first, second = best.candidate.effects
        kept = [one for one in self.singles if one.effect not in self.doubted]
        for kinds in other_kinds((first, second), kept):
            best = self._best_of(best, self.pairs(kinds, 1))
        return self._best_of(best, self._replaced(first, second), are_rivals=True)

    def _best_of(
        self, best: Proposal | None, pairs: Sequence[Prospect], are_rivals: bool = False
    ) -> Proposal | None:
        """The best of pairs that are re-fitted, where one clearly beats the best.

        ``are_rivals``: they are re-fitted whatever is expected of them, to be compared.
        """
        rival = best.fit if best else None
        begun = {}
        for place, pair in enumerate(pairs):
            if are_rivals or self._is_promising(best, pair):
                begun[place] = request_of(pair, rival, self.known)
        with RefitRound(self.base, until_their_turn(begun)) as refits:
            for place, pair in enumerate(pairs):
                if are_rivals or self._is_promising(best, pair):
                    best = self._better(best, pair, partial(refits.refit, place))
        return best

    def _replaced(self, first: Effect, second: Effect) -> list[Prospect]:
        """The pair with other laws in place of one of the two, the likeliest of them.

        Of the same family, and no larger: one of them may be as good a name.
        """
        found = []
        for effect, partner in ((first, second), (second, first)):
            partners = [one for one in self.singles if one.effect == partner]
            rivals = []
            for other in self.singles:
                if is_rival_law(other.effect, effect):
                    rivals += self.pairs([other, *partners], 1)
            rivals.sort(key=self.prospects.score, reverse=True)
            found += rivals[:N_PAIR_RIVALS]
        return found

    def pairs(self, singles: Sequence[Prospect], most: int) -> list[Prospect]:
        """The pairs that leave least and do not raise the error on data held out."""
        found = []
        n_unsettled = 0
        most_unsettled = N_UNSETTLED_PAIRS if self.base.may_be_far_from_linear else 0
        for pair in self.prospects.pairs(singles, self.base.judging_record):
            self.looked.append(expected(self.base, self.prospects, pair))
            n_unsettled += pair.look is None
            is_hopeless = pair.look is None and n_unsettled > most_unsettled
            rises = pair.held_out > HELD_OUT_RISE * self.base.judged_misfit
            if not rises and not is_hopeless:
                found.append(pair)
        return found[:most]

    def _better(
        self,
        best: Proposal | None,
        pair: Prospect,
        refitted: Callable[[RefitRequest], Refit | None],
    ) -> Proposal | None:
        """The pair, or what of it is needed, where that clearly beats the best."""
        self.base.say(f"re-fitting with {pair.name}")
        rival = best.fit if best else None
        done = refitted(request_of(pair, rival, self.known))
        candidate = expected(self.base, self.prospects, pair)
        if done is None:
            self._tell(replace(candidate, was_tried=True))
            return best
        n_pairs = comb(len(self.singles), 2)
        candidate = as_refitted(self.base, candidate, done, n_pairs * pair.n_tried)
        self._tell(candidate)
        if not self._is_better(best, candidate, done):
            return best
        return self._needed(Proposal(candidate, done), pair)

    def _is_far_behind(
        self, fit: Fit, one: Prospect, values: Mapping[str, float], share: float
    ) -> bool:
        """Whether a look at one of the two, from these values, leaves much more."""
        look = second_look(self.base.record, one.effects, values)
        if look is None:
            return False
        again = replace(one, look=look)
        behind = self.prospects.delta_bic(again, share)
        return behind > delta_bic(self.base.fit, fit, share) + 2 * BIC_TIE

    def _is_promising(self, best: Proposal | None, pair: Prospect) -> bool:
        """Whether what a pair is expected to leave is less than what the best does."""
        if best is None or pair.look is None:
            return True
        of_pair = self.prospects.delta_bic(pair, 1.0)
        return of_pair < delta_bic(self.base.fit, best.fit, 1.0) - BIC_TIE

    def _tell(self, candidate: Candidate) -> None:
        """Keep what is known of a pair, once."""
        others = [one for one in self.looked if one.name != candidate.name]
        self.looked = [*others, candidate]

    def _is_better(
        self, best: Proposal | None, candidate: Candidate, done: Refit
    ) -> bool:
        """By BIC, by a p-value for all pairs of candidates, and on the other record."""
        if candidate.lost:
            return False
        base = self.base
        before = base.fit if best is None else best.fit
        trained = base.trained if best is None else best.done.trained
        judged = base.judged if best is None else best.done.judged
        share = share_of_change(trained, done.trained)
        handicap = base.handicap(candidate.effects)
        if best is not None:
            handicap -= base.handicap(best.candidate.effects)
        if not delta_bic(before, done.fit, share) < -BIC_TIE - handicap:
            return False
        if not candidate.p_value < FALSE_DISCOVERY_RATE:
            return False
        return falls_or_explains_most(judged, done.judged)

    def _needed(self, both: Proposal, pair: Prospect) -> Proposal:
        """The pair, or the one of the two that does as much alone.

        From the values that it has beside the other.
        """
        best = both
        share = share_of_change(self.base.trained, both.done.trained)
        for one in self.prospects.singles:
            if one.effect not in pair.effects:
                continue
            values = {name: pair.values.get(name, x) for name, x in one.values.items()}
            if self._is_far_behind(best.fit, one, values, share):
                continue
            done = refit(self.base, RefitRequest(one.effects, values, rival=both.fit))
            if done is not None and delta_bic(best.fit, done.fit, share) < BIC_TIE:
                candidate = expected(self.base, self.prospects, one)
                candidate = as_refitted(self.base, candidate, done, one.n_tried)
                best = Proposal(candidate, done)
        return best


def proposal(
    base: DiagnosedModel, prospects: Prospects, ranked: Sequence[Candidate]
) -> tuple[Proposal | None, list[Candidate]]:
    """The best significant effect, or two together where one leaves more than noise.

    Args:
        base: the model that is diagnosed.
        prospects: its larger models.
        ranked: the single candidates, best first.

    Returns:
        What is proposed, and the pairs that were looked at.
    """
    best = _best_single(base, ranked)
    if is_like_noise(base.trained):
        return best, []
    if best is not None:
        done = best.done
        if is_explained(base.judged, done.trained, done.judged):
            return _by_all_data(base, best, ranked), []
    fitted = []
    # What could not be re-fitted alone can hardly be beside another effect.
    failed = []
    for candidate in ranked:
        if candidate.fit is not None:
            fitted.append(candidate.fit)
        elif candidate.was_tried:
            failed.append(candidate.effect)
    kept = [one for one in prospects.singles if one.effect not in failed]
    doubted = [candidate.effect for candidate in ranked if candidate.lost]
    search = _Search(base, prospects, kept, doubted, fitted)
    found = search.best(best)
    return _simplest(base, found, ranked), search.looked


def _simplest(
    base: DiagnosedModel, best: Proposal | None, ranked: Sequence[Candidate]
) -> Proposal | None:
    """The simplest effect that explains nearly as much, where noise is not all left.

    What is left is then error of the model, and larger laws bend to it: a gap beside
    hysteresis leaves less than the damper that is missing. So do two laws of many
    numbers that leave noise alone. Of laws of one size the data held out decide with
    those of training.
    """
    if best is None:
        return None
    done = best.done
    is_all = is_explained(base.judged, done.trained, done.judged)
    least = SIMPLE_SHARE_BESIDE_ALL if is_all else SIMPLE_SHARE
    if not is_all and not _is_clear(base, best):
        least = ALONE_SHARE
    fewer = FEWER_BESIDE_ALL if is_all else 1
    most = explained_share(base.judged, done.judged)
    is_inexact = base.is_held_out and _is_inexact(best)
    for candidate in ranked:
        comparison = candidate.comparison
        if comparison is None or not _is_significant(base, candidate):
            continue
        share = explained_share(base.judged, comparison)
        n_fewer = _n_unknowns(best.candidate) - _n_unknowns(candidate)
        is_better = n_fewer > 0 and is_inexact and share > most
        if is_better or (n_fewer >= fewer and share > least * most):
            best = _single(candidate) or best
    return _by_all_data(base, best, ranked)


def _is_inexact(proposed: Proposal) -> bool:
    """Whether model error shows beside it: then training data prefer larger laws."""
    source = proposed.fit.std_error_source
    return source != Source.NOISE or is_failing(proposed.done.judged)


def _is_clear(base: DiagnosedModel, best: Proposal) -> bool:
    """Whether the second of a pair is clear; a single effect has none."""
    effects = best.candidate.effects
    if len(effects) < 2:
        return True
    sizes = [fitted_size(base.fit, best.fit, one).z for one in effects]
    needed = [z_beside_others(base, one) for one in effects]
    return all(size >= least for size, least in zip(sizes, needed, strict=True))


def _by_all_data(
    base: DiagnosedModel, best: Proposal, ranked: Sequence[Candidate]
) -> Proposal:
    """The single effect that training and held-out data together prefer.

    By BIC and the deviance of the free run on the data held out, among effects that are
    no larger; beside one that leaves noise, among those that are smaller.
    """
    done = best.done
    if not base.is_held_out or best.candidate.partner is not None:
        return best
    is_all = is_explained(base.judged, done.trained, done.judged)
    share = share_of_change(base.trained, done.trained)

    def evidence(fit: Fit, judged: Comparison, effects: Sequence[Effect]) -> float:
        bic = delta_bic(base.fit, fit, share) + base.handicap(effects)
        return bic + share * free_run_deviance(judged)

    least = evidence(best.fit, done.judged, best.candidate.effects)
    size = _n_unknowns(best.candidate) - is_all
    for candidate in ranked:
        fit, judged = candidate.fit, candidate.comparison
        if fit is None or judged is None or _n_unknowns(candidate) > size:
            continue
        if not _is_significant(base, candidate):
            continue
        of_all = evidence(fit, judged, candidate.effects)
        if of_all < least:
            least = of_all
            best = _single(candidate) or best
    return best


def parts_alone(
    base: DiagnosedModel, proposed: Proposal, ranked: Sequence[Candidate]
) -> list[Proposal]:
    """The effects of a pair that are significant alone, best first."""
    found: list[Proposal] = []
    if proposed.candidate.partner is None:
        return found
    for candidate in ranked:
        is_part = candidate.effect in proposed.candidate.effects
        if is_part and _is_significant(base, candidate):
            single = _single(candidate)
            if single is not None:
                found.append(single)
    return found


def is_rival_law(other: Effect, effect: Effect) -> bool:
    """Whether another effect is a law of the same family there, and no larger."""
    if other == effect or other.equation != effect.equation:
        return False
    is_small = other.n_unknowns <= effect.n_unknowns
    return is_small and other.family == effect.family


def _n_unknowns(candidate: Candidate) -> int:
    """Of all effects that are added."""
    return sum(effect.n_unknowns for effect in candidate.effects)


def _best_single(base: DiagnosedModel, ranked: Sequence[Candidate]) -> Proposal | None:
    """The first significant candidate."""
    for candidate in ranked:
        if _is_significant(base, candidate):
            return _single(candidate)
    return None


def _single(candidate: Candidate) -> Proposal | None:
    fit, trained, judged = candidate.fit, candidate.trained, candidate.comparison
    if fit is None or trained is None or judged is None:
        return None
    return Proposal(candidate, Refit(fit, trained, judged, None))


def _is_significant(base: DiagnosedModel, candidate: Candidate) -> bool:
    """Whether p-value and BIC hold, and the error on the judging record falls.

    Or most of it is gone, where that record is too short to tell.
    """
    if candidate.comparison is None or not candidate.delta_bic < 0 or candidate.lost:
        return False
    if not candidate.p_value < FALSE_DISCOVERY_RATE:
        return False
    return falls_or_explains_most(base.judged, candidate.comparison)

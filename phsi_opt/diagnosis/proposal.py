"""What is proposed to be added: one effect, or two together where one is not enough."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import comb

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.comparison.model_selection import (
    delta_bic,
    falls_or_explains_most,
    falls_significantly,
    is_explained,
    is_like_noise,
    p_value_of_larger_model,
    share_of_change,
)
from phsi_opt.criteria import BIC_TIE, FALSE_DISCOVERY_RATE, N_PAIR_REFITS
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.dry_friction import other_kinds, simplest_dry
from phsi_opt.diagnosis.refit import Refit, RefitRequest, refit
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import Effect
from phsi_opt.screening.pair_search import Pair, best_pairs
from phsi_opt.screening.score_test import ScoreTest, Screened


@dataclass(frozen=True, eq=False)
class Proposal:
    """One effect, or two together, with what is left when they are added.

    Attributes:
        effects: what is added.
        fit: the brief re-fit with them.
        trained: its free run on the training record; ``judged``: on the other one.
        size: words on the coefficient of a single effect.
    """

    effects: tuple[Effect, ...]
    fit: Fit
    trained: Comparison
    judged: Comparison
    size: str = ""

    @classmethod
    def of(cls, effects: tuple[Effect, ...], done: Refit) -> "Proposal":
        """The proposal of effects that were re-fitted."""
        return cls(effects, done.fit, done.trained, done.judged)


@dataclass(frozen=True, eq=False)
class _Search:
    """The search for a pair that explains clearly more.

    Attributes:
        base: the model that is diagnosed.
        test: of the training record.
        found: the effects among which pairs are made.
        known: fits made before, at which a re-fit may begin.
    """

    base: DiagnosedModel
    test: ScoreTest
    found: Sequence[Screened]
    known: Sequence[Fit]

    def best(self, single: Proposal | None) -> Proposal | None:
        """The best pair, or the single effect where no pair is clearly better.

        Dry friction is the simplest of its kinds in the pairs; the others are tried in
        the best one.
        """
        best = single
        for pair in best_pairs(self.test, simplest_dry(self.found), N_PAIR_REFITS):
            best = self._better(best, pair)
        if best is None or len(best.effects) != 2:
            return best
        first, second = best.effects
        further = replace(self, known=[*self.known, best.fit])
        for kinds in other_kinds((first, second), self.found):
            for pair in best_pairs(self.test, kinds, 1):
                best = further._better(best, pair)
        return best

    def _better(self, best: Proposal | None, pair: Pair) -> Proposal | None:
        """The pair, or what of it is needed, where that clearly beats the best."""
        first, second = pair
        self.base.say(f"re-fitting with {first.effect} and {second.effect}")
        effects = (first.effect, second.effect)
        request = RefitRequest(
            effects=effects,
            values={**first.values, **second.values},
            rival=best.fit if best else None,
            known=self.known,
        )
        done = refit(self.base, request)
        if done is None or not self._is_better(best, pair, done):
            return best
        return self._needed(Proposal.of(effects, done), pair)

    def _is_better(self, best: Proposal | None, pair: Pair, done: Refit) -> bool:
        """By BIC, by a p-value for all pairs of candidates, and on the other record."""
        base = self.base
        before = base.fit if best is None else best.fit
        trained = base.trained if best is None else best.trained
        judged = base.judged if best is None else best.judged
        share = share_of_change(trained, done.trained)
        if not delta_bic(before, done.fit, share) < -BIC_TIE:
            return False
        n_tried = comb(len(self.found), 2) * pair[0].n_tried * pair[1].n_tried
        share = share_of_change(base.trained, done.trained)
        p_value = n_tried * p_value_of_larger_model(base.fit, done.fit, share)
        if not p_value < FALSE_DISCOVERY_RATE:
            return False
        return falls_or_explains_most(judged, done.judged)

    def _needed(self, both: Proposal, pair: Pair) -> Proposal:
        """The pair, or the one of the two that does as much alone.

        From the values that it has beside the other.
        """
        best = both
        share = share_of_change(self.base.trained, both.trained)
        for one in pair:
            request = RefitRequest([one.effect], one.values, rival=both.fit)
            done = refit(self.base, request)
            if done is not None and delta_bic(best.fit, done.fit, share) < BIC_TIE:
                best = Proposal.of((one.effect,), done)
        return best


def proposal(
    base: DiagnosedModel,
    test: ScoreTest,
    found: Sequence[Screened],
    ranked: Sequence[Candidate],
) -> Proposal | None:
    """The best significant effect, or two together where one leaves more than noise.

    Args:
        base: the model that is diagnosed.
        test: of the training record.
        found: what screening expects of each effect.
        ranked: the candidates, best first.
    """
    best = _best_single(base, ranked)
    if is_like_noise(base.trained):
        return best
    if best is not None and is_explained(base.judged, best.trained, best.judged):
        return best
    fitted = []
    # What could not be re-fitted alone can hardly be beside another effect.
    failed = []
    for candidate in ranked:
        if candidate.fit is not None:
            fitted.append(candidate.fit)
        elif candidate.was_tried:
            failed.append(candidate.effect)
    kept = [one for one in found if one.effect not in failed]
    return _Search(base, test, kept, fitted).best(best)


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
    error = ""
    if np.isfinite(candidate.std_error):
        error = f" +- {candidate.std_error:.2g}"
    tie = ""
    if candidate.confusable_with:
        tie = f"; not told apart from {', '.join(candidate.confusable_with)}"
    size = f", coefficient {candidate.coefficient:.4g}{error}{tie}"
    return Proposal((candidate.effect,), fit, trained, judged, size)


def _is_significant(base: DiagnosedModel, candidate: Candidate) -> bool:
    """Whether p-value and BIC hold, and the error on the judging record falls."""
    if candidate.comparison is None or not candidate.delta_bic < 0:
        return False
    if not candidate.p_value < FALSE_DISCOVERY_RATE:
        return False
    return falls_significantly(base.judged, candidate.comparison)

"""The verdict of a diagnosis: is it there, which laws are it, how much do they explain.

*Is it there*: an effect whose evidence is decisive beside a force that could have done
the same; where one does not explain what is missing, a search takes several together.
*Which law*: the effects that the evidence does not tell from it are a class. *How
much*: a re-fit's free runs, and whether a force remains evident beside it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from operator import methodcaller
from typing import Any

import numpy as np

from phsi_opt.comparison.compare import (
    is_explained,
    is_failing,
    is_small_as_noise,
    is_surely_failing,
)
from phsi_opt.criteria import (
    DECISIVE_EVIDENCE,
    LEAST_ERROR_EXPLAINED,
    LEAST_FINDING,
    MOST_OF_IT,
    MOST_REFITTED,
    STRONG_EVIDENCE,
    SURE_DEVIATIONS,
)
from phsi_opt.data.noise import unresolved_channels
from phsi_opt.diagnosis.candidate import (
    Candidate,
    Finding,
    Grade,
    Verdict,
    at_limit,
    class_of,
)
from phsi_opt.diagnosis.data_causes import data_cause
from phsi_opt.diagnosis.ranking import Ranking, rank_again, ranked, ranked_functions
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.refit import (
    DiagnosedModel,
    WeighedEffects,
    refit,
    thorough_refit,
)
from phsi_opt.diagnosis.search import Combination, Search
from phsi_opt.errors import SolveError
from phsi_opt.initialization.relative_guesses import corner_widths
from phsi_opt.model.effect import Effect, is_wave
from phsi_opt.model.functions import is_function, is_unknown
from phsi_opt.presentation.numbers import called, enumerated
from phsi_opt.screening.effect_size import fitted_size, new_names
from phsi_opt.screening.weighing import EvidenceRecord

WEAK = "its evidence is only"  # begins why an effect is rejected that is not decisive
UNSURE = "its size, {}, does not differ significantly from zero"
UNDETERMINED = "the data do not determine its size"


def concluded(
    base: DiagnosedModel,
    record: EvidenceRecord,
    effects: Sequence[Effect],
    functions: bool,
) -> Diagnosis:
    """The diagnosis of a model, with evidence beside a record, by these effects.

    Where they leave something unexplained, unknown functions are weighed; they are
    candidates too if ``functions`` says so.
    """
    ranking = ranked(base, record, effects)
    return _Judge(base, effects, ranking, functions).concluded()


def without_evidence(base: DiagnosedModel, error: SolveError) -> Diagnosis:
    """The diagnosis by the free runs alone, where the evidence was not found."""
    verdict, said = Verdict.UNEXPLAINED, str(error)
    if base.is_noise:
        verdict, said = Verdict.NOTHING_MISSING, "the residuals are noise"
    return _diagnosis(base, (), verdict, f"{base.error_words}; {said}")


@dataclass(frozen=True, eq=False)
class _Proposal:
    """Effects that may be named, and the base re-fitted with them."""

    effects: tuple[Effect, ...]
    log_evidence: float  # over the base
    force_left: float  # size of the force over that beside the base
    larger: DiagnosedModel
    is_complete: bool  # whether no force is evident beside the re-fit
    # Of several effects, by name: the evidence that is lost without each, and what the
    # data do not tell from it.
    worth: Mapping[str, float] = field(default_factory=dict)
    alike: Mapping[str, Sequence[Effect]] = field(default_factory=dict)

    @property
    def of_force(self) -> float:
        """Share of the missing force (mean square) that they take over."""
        return max(1 - self.force_left**2, 0.0)


@dataclass(eq=False)
class _Judge:
    """One diagnosis on the way to its verdict."""

    base: DiagnosedModel
    effects: Sequence[Effect]
    ranking: Ranking
    functions: bool
    refits: dict[str, DiagnosedModel] = field(default_factory=dict)
    # Those of a search, to be made thorough.
    briefs: dict[str, DiagnosedModel] = field(default_factory=dict)
    rivals: Sequence[Candidate] = ()  # unknown functions that were weighed

    def concluded(self) -> Diagnosis:
        single = self.single()
        if single is None or not single.is_complete:
            if single is None and not self.is_something_missing():
                return self.without_effect(Verdict.NOTHING_MISSING)
            rank_again(self.base, self.ranking, self.effects)
            single = self.single()
        doubts = []
        for proposal in self.proposals(single):
            doubt = self.doubt(proposal)
            if not doubt:
                return self.named(proposal)
            if len(proposal.effects) == 1:
                doubts.append((proposal, doubt))
        if not doubts:
            return self.without_effect(Verdict.UNEXPLAINED)
        return self.not_named(*doubts[-1])

    def proposals(self, single: _Proposal | None) -> Iterator[_Proposal]:
        """What may be named, in the order in which it is asked."""
        search = Search(self.base, self.ranking, self.effects, self.refitted_for_search)
        alone = single if single is not None and single.is_complete else None
        if alone is not None and search.is_complete():
            yield alone
            return
        search.run()
        least = -np.inf if single is None else single.log_evidence
        is_noise = search.is_complete()  # what the likeliest model leaves
        several = self.several(search, least) if is_noise else None
        if several is not None and several.is_complete:
            yield from filter(None, (several, single))
            return
        if alone is not None:
            yield alone
            return
        likelier = [one.log_evidence for one, _ in self.together(search, least)]
        highest = max([least, *likelier])
        self.weigh_functions(highest)
        single = self.single()
        # As long as a force remains, a further law may stand in for what is missing:
        # one effect is asked before several, unless it is a less likely function.
        is_late = single is not None and (
            is_unknown(single.effects[0]) and single.log_evidence < highest
        )
        if single is not None and not is_late:
            yield single
        if not is_noise:
            several = self.several(search, least)
        if several is not None:
            yield several
        if single is not None and is_late:
            yield single

    def weigh_functions(self, highest: float) -> None:
        """Unknown functions, as candidates or to be compared with the laws.

        These have the log evidence ``highest``, one of them or several together.
        """
        functions = ranked_functions(self.base, self.ranking, self.functions, highest)
        self.rivals = [one for one in functions.candidates if not one.lost]
        if not self.functions:
            return
        # A function of many numbers bends to the error of a model, too.
        functions.candidates = [
            one
            for one in functions.candidates
            if not is_function(one.effect) or highest < MOST_OF_IT * one.log_evidence
        ]
        self.ranking.join(functions)

    @property
    def candidates(self) -> list[Candidate]:
        """The ranking, the likeliest first."""
        return self.ranking.candidates

    # ---- effects ---------------------------------------------------------------------

    def note(self, place: int, **known: Any) -> None:
        """Replace a candidate of the ranking by one of which more is known."""
        self.candidates[place] = replace(self.candidates[place], **known)

    def single(self) -> _Proposal | None:
        """An effect that is decisive; this is put first."""
        # Of those that the evidence does not tell from the likeliest the one with
        # fewest unknowns, and that the catalogue has first.
        while tied := self.tied():
            names = [*map(str, self.effects), *self.ranking.screened]
            tied.sort(key=lambda one: names.index(one.name))
            simplest = min(tied, key=lambda one: one.effect.n_unknowns)
            place = self.candidates.index(simplest)
            # Judged is what a study would add.
            larger = self.refit(place, thorough=True)
            if larger is not None:
                one = self.candidates.pop(place)
                self.candidates.insert(0, one)
                is_complete = self.explains_all(one.log_evidence, larger)
                return _Proposal(
                    one.effects, one.log_evidence, one.force_left, larger, is_complete
                )
        return None

    def tied(self) -> list[Candidate]:
        """Effects that the evidence does not tell from the likeliest."""
        # None where all of them together are not decisive: one of them is there if the
        # sum of their odds says so.
        believed = [one for one in self.candidates if one.was_weighed and not one.lost]
        highest = max((one.log_evidence for one in believed), default=-np.inf)
        least = highest - STRONG_EVIDENCE
        tied = [one for one in believed if one.log_evidence > least]
        together = np.logaddexp.reduce([one.log_evidence for one in tied])
        return tied if together >= DECISIVE_EVIDENCE else []

    def together(
        self, search: Search, least: float
    ) -> Iterator[tuple[Combination, Mapping[str, float]]]:
        """Effects that are decisively likelier than one, and what each is worth."""
        for one in search.in_order():
            if one.log_evidence < DECISIVE_EVIDENCE + max(least, 0.0):
                return
            worth = search.worth(one)
            if len(worth) > 1 and min(worth.values()) >= DECISIVE_EVIDENCE:
                yield one, worth

    def several(self, search: Search, least: float) -> _Proposal | None:
        """The likeliest of these that can be re-fitted."""
        for one, worth in islice(self.together(search, least), MOST_REFITTED):
            larger = self.refitted(one, thorough=True)
            if isinstance(larger, str):
                told = self.base.told(*one.effects)
                self.base.say(f"{told} together were skipped: {larger}")
                continue
            return _Proposal(
                search.path(one),
                one.log_evidence,
                one.force_left,
                larger,
                self.explains_all(one.log_evidence, larger),
                worth,
                {name: search.alike(one, name) for name in worth},
            )
        return None

    def refit(self, place: int, thorough: bool) -> DiagnosedModel | None:
        """The base with a candidate; None where that rejects it."""
        one = self.candidates[place]
        if one.fit is not None:
            return self.refits[one.name]
        larger = self.refitted(one, thorough)
        if isinstance(larger, str):
            self.note(place, lost=larger)
            return None
        self.note(place, **self.as_fitted(one.effect, larger))
        self.refits[one.name] = larger
        return larger

    def refitted_for_search(self, one: Combination) -> DiagnosedModel | None:
        """The base with what was weighed: a known re-fit, or one with sharp corners."""
        larger: DiagnosedModel | str | None = self.refits.get(one.name)
        if larger is None and corner_widths(one.weighed.model):
            larger = self.refitted(one, thorough=False)
        if larger is None or isinstance(larger, str):
            return None
        self.briefs[one.name] = larger
        return larger

    def refitted(self, one: WeighedEffects, thorough: bool) -> DiagnosedModel | str:
        """The base with effects that were weighed; or why they are rejected."""
        larger = self.briefs.get(one.name) or refit(self.base, one)
        if larger is None:
            return "the fit failed"
        if thorough:
            larger = thorough_refit(larger)
        base, fit = self.base.fit.model, larger.fit
        for effect in one.effects:
            new = new_names(base, effect, fit.names)
            at_bounds = fit.outcome.at_bounds
            lost = at_limit(fit.model, new, at_bounds, self.base.labels)
            size = fitted_size(base, fit, effect)
            if not np.isfinite(size.std_error):
                return lost or UNDETERMINED
            if lost or not size.z >= SURE_DEVIATIONS:
                return lost or UNSURE.format(size)
        return larger

    def as_fitted(self, effect: Effect, larger: DiagnosedModel) -> dict[str, Any]:
        """What a re-fit tells of one of its effects."""
        size = fitted_size(self.base.fit.model, larger.fit, effect)
        return {
            "coefficient": size.value,
            "std_error": size.std_error,
            "unit": size.unit,
            "fit": larger.fit,
            "trained": larger.trained,
            "comparison": larger.judged,
            "train_rmse": larger.trained.rmse,
            "held_out_rmse": larger.judged.rmse if self.base.is_held_out else np.nan,
            "share": self.base.share_explained(larger),
        }

    # ---- doubts ----------------------------------------------------------------------

    def doubt(self, proposal: _Proposal) -> str:
        """Why what is decisive is not named; empty: it is."""
        larger = proposal.larger
        steps = self.steps_in_words()
        if steps and is_small_as_noise(larger.trained):
            return f"the cause may also be {steps}"
        if self.is_worse(larger):
            return "its free-run error is larger than without it"
        share = self.base.share_explained(larger)
        is_small = is_failing(self.base.judged) and share < LEAST_FINDING
        if proposal.is_complete and not is_small:
            return ""
        if len(proposal.effects) == 1 and is_wave(proposal.effects[0]):
            return "more is missing, and every function contains such waves"
        is_large = proposal.of_force >= MOST_OF_IT or share > LEAST_ERROR_EXPLAINED
        if is_small or not is_large:
            return (
                f"it explains only {100 * proposal.of_force:.0f} % of what is missing "
                f"(mean square) and {100 * max(0.0, share):.0f} % of the error"
            )
        return self.rival(proposal)

    def rival(self, proposal: _Proposal) -> str:
        """A function that is far likelier, of a quantity or of time; empty: none is."""
        waves = [
            one for one in self.candidates if one.was_weighed and is_wave(one.effect)
        ]
        rivals = [*self.rivals, *waves]
        evidence = [one.log_evidence for one in rivals]
        highest = max(evidence, default=-np.inf)
        # Every function contains waves: it need not be far likelier than these.
        has_wave = any(map(is_wave, proposal.effects))
        least = highest if has_wave else MOST_OF_IT * highest
        if not proposal.log_evidence < least:
            return ""
        function = rivals[evidence.index(highest)]
        return (
            f"{self.base.told(function.effect)} is more likely (log evidence "
            f"{highest:.1f} against {proposal.log_evidence:.1f})"
        )

    def is_worse(self, larger: DiagnosedModel) -> bool:
        """Whether a free run is farther off than the base's, and not by noise."""
        pairs = zip(self.base.comparisons, larger.comparisons, strict=True)
        return any(is_failing(new) and new.rmse > old.rmse for old, new in pairs)

    def explains_all(self, log_evidence: float, larger: DiagnosedModel) -> bool:
        """Whether no force is evident beside a re-fit."""
        if is_explained(self.base.judged, larger.trained, larger.judged):
            return True
        return not self.is_force_evident(log_evidence, larger)

    def is_force_evident(self, gain: float, model: DiagnosedModel) -> bool:
        """Whether a model is decisively likelier with a force than without.

        With a force it is likelier than the base by a ``gain``.
        """
        record = self.ranking.record
        try:
            alone = record.fitted(model.comparisons, has_force=False)
        except SolveError:
            return True
        log_evidence = gain + record.base.log_evidence
        return log_evidence - alone.log_evidence > DECISIVE_EVIDENCE

    def is_something_missing(self) -> bool:
        """Whether the base fails, or a force is evident beside it."""
        base = self.base
        is_far = any(map(is_surely_failing, base.comparisons))
        is_far = is_far and base.record.is_of_training  # else parameters may be off
        return not base.is_noise and (is_far or self.is_force_evident(0.0, base))

    def steps_in_words(self) -> str:
        """Steps of sensors that are coarser than the motion; empty: there are none."""
        unresolved = unresolved_channels(self.base.record.data)
        if not unresolved:
            return ""
        return (
            f"the quantisation of {self.names(unresolved)}, whose standard deviation "
            "is less than one step"
        )

    def names(self, channels: Sequence[str]) -> str:
        """Channels as people read them."""
        return ", ".join(map(partial(called, labels=self.base.labels), channels))

    # ---- verdicts --------------------------------------------------------------------

    def named(self, proposal: _Proposal) -> Diagnosis:
        larger = proposal.larger
        self.put_first(proposal)
        findings = tuple(self.finding(proposal, effect) for effect in proposal.effects)
        named = [effect for finding in findings for effect in finding.effects]
        self.reject_others(proposal.effects, named)
        verdict = Verdict.NAMED
        said = enumerated(map(methodcaller("words", self.base.labels), findings))
        reason = f"{said}; {self.base.change_words(larger)}; "
        grade = Grade.of(proposal.log_evidence)
        reason += f"{grade} evidence (log evidence {proposal.log_evidence:.1f})"
        if not proposal.is_complete:
            verdict = Verdict.PARTLY_NAMED
            share = max(0.0, self.base.share_explained(larger))
            reason += (
                f". It accounts for {100 * proposal.of_force:.0f} % of what is "
                f"missing (mean square) and {100 * share:.0f} % of the squared error "
                "above the noise floor; more is missing"
            )
        return self.diagnosis(verdict, reason, larger, findings, proposal.effects)

    def put_first(self, proposal: _Proposal) -> None:
        """Begin the ranking with what is named, of several with what each is worth."""
        named = []
        for effect in proposal.effects:
            one = next(one for one in self.candidates if one.effect == effect)
            self.candidates.remove(one)
            if proposal.worth:
                one = replace(
                    one,
                    **self.as_fitted(effect, proposal.larger),
                    log_bayes=proposal.worth[one.name],
                    log_predictive=np.nan,
                    was_weighed=True,
                    lost="",
                )
            named.append(one)
        self.candidates[:0] = named

    def finding(self, proposal: _Proposal, effect: Effect) -> Finding:
        """An effect with those that the data do not tell from it, and its size."""
        others = proposal.alike.get(str(effect), ())
        if not proposal.worth:
            others = self.members()
        effects = (effect, *others)
        larger = proposal.larger
        size = fitted_size(self.base.fit.model, larger.fit, effect)
        return Finding(
            effects,
            class_of(effects),
            size.value,
            size.std_error,
            self.base.share_explained(larger),
            size.unit,
        )

    def members(self) -> list[Effect]:
        """Effects that the data do not tell from the first."""
        # The likeliest of these are re-fitted; one that a re-fit presses to a bound or
        # to nothing, or that explains nothing, is none of them.
        names = {one.name for one in self.tied()}
        others = enumerate(self.candidates[1:], 1)
        places = [place for place, one in others if one.name in names]
        for place in places[: MOST_REFITTED - 1]:
            self.refit(place, thorough=False)
        members = [self.candidates[place] for place in places]
        if not is_unknown(self.candidates[0].effect):
            # That a function may be a law says nothing.
            members = [one for one in members if not is_unknown(one.effect)]
        return [one.effect for one in members if not one.lost and not one.share <= 0]

    def not_named(self, single: _Proposal, doubt: str) -> Diagnosis:
        self.note(0, lost=doubt)
        first = self.candidates[0]
        self.reject_others((first.effect,))
        reason = (
            f"the nearest is {self.base.told(first.effect)} ({first.size}; log "
            f"evidence {first.log_evidence:.1f}): "
            f"{self.base.change_words(single.larger)}. It is not named: {doubt}"
        )
        return self.diagnosis(Verdict.UNEXPLAINED, reason)

    def without_effect(self, verdict: Verdict) -> Diagnosis:
        """Nothing is missing, or nothing known explains it."""
        base = self.base
        self.reject_others(())
        if verdict == Verdict.NOTHING_MISSING:
            none = "there is no evidence of anything missing, and no effect is decisive"
            return self.diagnosis(verdict, f"{base.error_words}; {none}")
        reason = (
            f"{base.error_words}: there is evidence that something is missing, but no "
            "effect of the catalogue explains it"
        )
        steps = self.steps_in_words()
        if steps:
            reason += f"; it may be {steps}"
        nearest = next((one for one in self.candidates if one.was_weighed), None)
        if nearest is not None and nearest.grade != Grade.NONE:
            reason += (
                f"; the nearest is {base.told(nearest.effect)}, but {nearest.lost}"
            )
        return self.diagnosis(Verdict.UNEXPLAINED, reason)

    def reject_others(
        self, named: Sequence[Effect], alike: Sequence[Effect] = ()
    ) -> None:
        """Why the other candidates are not named; some are alike for the data."""
        first = self.candidates[0] if named else None
        for place, one in enumerate(self.candidates):
            if one.lost or one.effect in named:
                continue
            lost = f"{WEAK} {one.grade} ({one.log_evidence:.1f})"
            if one.grade == Grade.NONE:
                lost = f"there is no evidence for it ({one.log_evidence:.1f})"
            if one.grade == Grade.DECISIVE and first is not None:
                told = self.base.told(first.effect)
                lost = f"the data cannot distinguish it from {told}"
            if first is not None and one.log_evidence < first.log_evidence:
                lost = f"{self.base.told(first.effect)} is more likely"
            if one.effect in alike:
                lost = "the data cannot distinguish it from the named effect"
            self.note(place, lost=lost)

    def diagnosis(self, *parts: Any) -> Diagnosis:
        """The diagnosis of the base by its ranking, with the parts of `_diagnosis`."""
        return _diagnosis(self.base, self.candidates, *parts)


def _diagnosis(
    base: DiagnosedModel,
    ranking: Sequence[Candidate],
    verdict: Verdict,
    reason: str,
    larger: DiagnosedModel | None = None,
    findings: tuple[Finding, ...] = (),
    proposed: tuple[Effect, ...] = (),
) -> Diagnosis:
    """A diagnosis; nothing is named where the data are the cause of the misfit."""
    found = Diagnosis(
        base.record, base.judged, tuple(ranking), verdict, reason, findings, proposed
    )
    cause = data_cause(base, larger or base)
    if cause is None:
        return found if larger is None else replace(found, proposed_fit=larger.fit)
    lost = "the data explain more of the misfit"
    return replace(
        found,
        ranking=tuple(replace(one, lost=one.lost or lost) for one in ranking),
        verdict=Verdict.UNEXPLAINED,
        reason=str(cause),
        findings=(),
        proposed=(),
        data_cause=cause,
    )

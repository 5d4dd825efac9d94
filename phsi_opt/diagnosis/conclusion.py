"""The verdict of a diagnosis: is it there, which law is it, how much does it explain.

*Is it there*: an effect whose evidence is decisive beside a force that could have done
the same. *Which law*: the effects that the evidence does not tell from it are a class.
*How much*: a re-fit's free runs, and whether a force remains evident beside it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
from phsi_opt.diagnosis.ranking import NO_EVIDENCE, ranked
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.refit import DiagnosedModel, refit, thorough_refit
from phsi_opt.errors import SolveError
from phsi_opt.model.effect import Effect, is_wave
from phsi_opt.screening.effect_size import fitted_size, new_names
from phsi_opt.screening.weighing import EvidenceRecord

WEAK = "its evidence is only"  # begins why an effect is rejected that is not decisive


def concluded(
    base: DiagnosedModel, record: EvidenceRecord, effects: Sequence[Effect]
) -> Diagnosis:
    """The diagnosis of a model, with evidence beside a record, by these effects."""
    record, ranking = ranked(base, record, effects)
    return _Judge(base, record, effects, ranking).concluded()


def without_evidence(base: DiagnosedModel, error: SolveError) -> Diagnosis:
    """The diagnosis by the free runs alone, where the evidence was not found."""
    verdict, said = Verdict.UNEXPLAINED, str(error)
    if base.is_noise:
        verdict, said = Verdict.NOTHING_MISSING, "the residuals are noise"
    return _diagnosis(base, (), verdict, f"{base.error_words}; {said}")


@dataclass(eq=False)
class _Judge:
    """One diagnosis on the way to its verdict."""

    # ``is_complete`` is whether no force is evident beside the re-fit with the first
    # effect of the ranking, once that is known.

    base: DiagnosedModel
    record: EvidenceRecord
    effects: Sequence[Effect]
    ranking: list[Candidate]
    is_complete: bool | None = None

    def concluded(self) -> Diagnosis:
        larger = self.first()
        if larger is None:
            return self.without_effect()
        doubt = self.doubt(larger)
        if not doubt:
            return self.named(larger)
        both = self.second(larger)
        if both is None:
            return self.not_named(larger, doubt)
        return self.named(*both)

    # ---- effects ---------------------------------------------------------------------

    def note(self, place: int, **known: Any) -> None:
        """Replace a candidate of the ranking by one of which more is known."""
        self.ranking[place] = replace(self.ranking[place], **known)

    def first(self) -> DiagnosedModel | None:
        """The base with an effect that is decisive; this is put first."""
        # Of those that the evidence does not tell from the likeliest the one with
        # fewest unknowns, and that the catalogue has first.
        while tied := self.tied():
            tied.sort(key=lambda one: self.effects.index(one.effect))
            simplest = min(tied, key=lambda one: one.effect.n_unknowns)
            place = self.ranking.index(simplest)
            # Judged is what a study would add.
            larger = self.refit(place, thorough=True)
            if larger is not None:
                self.ranking.insert(0, self.ranking.pop(place))
                return larger
        return None

    def tied(self) -> list[Candidate]:
        """Effects that the evidence does not tell from the likeliest."""
        # None where all of them together are not decisive: one of them is there if the
        # sum of their odds says so.
        believed = [one for one in self.ranking if one.was_weighed and not one.lost]
        highest = max((one.log_evidence for one in believed), default=-np.inf)
        least = highest - STRONG_EVIDENCE
        tied = [one for one in believed if one.log_evidence > least]
        together = np.logaddexp.reduce([one.log_evidence for one in tied])
        return tied if together >= DECISIVE_EVIDENCE else []

    def refit(self, place: int, thorough: bool) -> DiagnosedModel | None:
        """The base with a candidate; None where that rejects it."""
        one = self.ranking[place]
        if not one.size.z >= SURE_DEVIATIONS:
            self.note(
                place,
                lost=f"its size, {one.size}, does not differ significantly from zero",
            )
            return None
        larger = refit(self.base, one)
        if larger is None:
            self.note(place, lost="could not be re-fitted")
            return None
        if thorough:
            larger = thorough_refit(larger)
        new = new_names(self.base.fit.model, one.effect, larger.fit.names)
        lost = at_limit(larger.fit.model, new, larger.fit.outcome.at_bounds)
        if lost:
            self.note(place, lost=lost)
            return None
        found = fitted_size(self.base.fit.model, larger.fit, one.effect)
        self.note(
            place,
            coefficient=found.value,
            std_error=found.std_error,
            fit=larger.fit,
            trained=larger.trained,
            comparison=larger.judged,
            train_rmse=larger.trained.rmse,
            held_out_rmse=larger.judged.rmse if self.base.is_held_out else np.nan,
            share=self.base.share_explained(larger),
        )
        return larger

    def second(self, larger: DiagnosedModel) -> "tuple[DiagnosedModel, _Judge] | None":
        """The re-fit with a second effect and its judge, where both explain enough."""
        others = [one.effect for one in self.ranking[1:]]
        try:
            record, ranking = ranked(larger, larger.evidence_record(), others)
            second = _Judge(larger, record, others, ranking)
        except SolveError:
            self.base.say(f"no second effect is considered: {NO_EVIDENCE}")
            return None
        both = second.first()
        return None if both is None or self.doubt(both, second) else (both, second)

    # ---- doubts ----------------------------------------------------------------------

    def doubt(self, larger: DiagnosedModel, second: "_Judge | None" = None) -> str:
        """Why what is decisive is not named, alone or with another; empty: it is."""
        first = self.ranking[0]
        effects = [first.effect]
        if second is not None:
            effects.append(second.ranking[0].effect)
        steps = self.steps_in_words()
        if steps and is_small_as_noise(larger.trained):
            return f"the cause may also be {steps}"
        if self.is_worse(larger):
            return "its free-run error is larger than without it"
        if (second or self).explains_all(larger):
            return ""
        if any(is_wave(effect) and effect.needs_clock for effect in effects):
            return "more is missing, and every function of time contains such waves"
        of_force = self.of_force(second)
        share = self.base.share_explained(larger)
        if of_force < MOST_OF_IT and not share > LEAST_ERROR_EXPLAINED:
            return (
                f"it explains only {100 * of_force:.0f} % of what is missing (mean "
                f"square) and {100 * max(0.0, share):.0f} % of the error"
            )
        return self.rival(first)

    def is_worse(self, larger: DiagnosedModel) -> bool:
        """Whether a free run is farther off than the base's, and not by noise."""
        pairs = zip(self.base.comparisons, larger.comparisons, strict=True)
        return any(is_failing(new) and new.rmse > old.rmse for old, new in pairs)

    def explains_all(self, larger: DiagnosedModel) -> bool:
        """Whether no force is evident beside a re-fit; worked out once."""
        if self.is_complete is None:
            is_small = is_explained(self.base.judged, larger.trained, larger.judged)
            gain = self.ranking[0].log_evidence + self.record.base.log_evidence
            self.is_complete = is_small or not self.is_force_evident(gain, larger)
        return self.is_complete

    def is_force_evident(self, log_evidence: float, model: DiagnosedModel) -> bool:
        """Whether a model is decisively likelier with a force than without."""
        try:
            alone = self.record.without_force(model.comparisons)
        except SolveError:
            return True
        return log_evidence - alone.log_evidence > DECISIVE_EVIDENCE

    def steps_in_words(self) -> str:
        """Steps of sensors that are coarser than the motion; empty: there are none."""
        unresolved = unresolved_channels(self.base.record.data)
        if not unresolved:
            return ""
        return (
            f"the quantisation of {', '.join(unresolved)}, whose standard deviation "
            "is less than one step"
        )

    def of_force(self, second: "_Judge | None" = None) -> float:
        """Share of the force (mean square) that the first takes over, or both."""
        first = self.ranking[0]
        remains = first.force_left
        if second is not None:
            other = second.ranking[0]
            is_one_force = other.effect.equation == first.effect.equation
            product = remains * other.force_left
            remains = product if is_one_force else max(remains, other.force_left)
        return max(1 - remains**2, 0.0)

    def rival(self, first: Candidate) -> str:
        """A law of no catalogue that is far likelier; empty where there is none."""
        model = self.base.fit.model
        name = first.effect.equation
        equation = model.index(name)
        alone = self.record.base
        places = [force.place for force in alone.disturbances.forces]
        if first.effect.slot == "sensor" or equation not in places:
            return ""
        function = self.record.with_functions(equation)
        if function is None:
            return ""
        gain = function.log_evidence - alone.log_evidence
        if not first.log_evidence < MOST_OF_IT * gain:
            return ""
        (kind,) = function.disturbances.functions
        return (
            f"an unknown function of {model.states[kind.state]} in d{name}/dt is more "
            f"likely (log evidence {gain:.1f} against {first.log_evidence:.1f})"
        )

    # ---- verdicts --------------------------------------------------------------------

    def named(
        self, larger: DiagnosedModel, second: "_Judge | None" = None
    ) -> Diagnosis:
        judges = [self] if second is None else [self, second]
        findings = tuple(judge.finding(larger) for judge in judges)
        is_complete = judges[-1].explains_all(larger)
        if second is not None:
            first, *others = self.ranking
            other = second.ranking[0]
            others = [one for one in others if one.effect != other.effect]
            self.ranking = [first, other, *others]
        effects = tuple(finding.effects[0] for finding in findings)
        self.reject_others(effects, [one for each in findings for one in each.effects])
        verdict = Verdict.NAMED
        said = " and ".join(map(str, findings))
        one = self.ranking[0]
        graded = f"{one.grade} evidence (log evidence {one.log_evidence:.1f})"
        reason = f"{said}; {self.base.change_words(larger)}; {graded}"
        if not is_complete:
            verdict = Verdict.PARTLY_NAMED
            share = max(0.0, self.base.share_explained(larger))
            reason += (
                f". It accounts for {100 * self.of_force(second):.0f} % of what is "
                f"missing (mean square) and {100 * share:.0f} % of the squared error "
                "above the noise floor; more is missing"
            )
        return self.diagnosis(verdict, reason, larger, findings, effects)

    def finding(self, larger: DiagnosedModel) -> Finding:
        """The first with those that the data do not tell from it, and its size."""
        # The likeliest of these are re-fitted; one that a re-fit presses to a bound or
        # to nothing is none of them.
        names = {one.name for one in self.tied()}
        others = enumerate(self.ranking[1:], 1)
        places = [place for place, one in others if one.name in names]
        for place in places[: MOST_REFITTED - 1]:
            self.refit(place, thorough=False)
        members = [self.ranking[place] for place in (0, *places)]
        effects = tuple(one.effect for one in members if not one.lost)
        size = fitted_size(self.base.fit.model, larger.fit, effects[0])
        return Finding(
            effects,
            class_of(effects),
            size.value,
            size.std_error,
            self.base.share_explained(larger),
            size.unit,
        )

    def not_named(self, larger: DiagnosedModel, doubt: str) -> Diagnosis:
        self.note(0, lost=doubt)
        first = self.ranking[0]
        self.reject_others((first.effect,))
        reason = (
            f"the nearest is {first.name} ({first.size}; log evidence "
            f"{first.log_evidence:.1f}): {self.base.change_words(larger)}. "
            f"It is not named: {doubt}"
        )
        return self.diagnosis(Verdict.UNEXPLAINED, reason)

    def without_effect(self) -> Diagnosis:
        """Nothing is missing, or nothing known explains it."""
        base = self.base
        self.reject_others(())
        log_evidence = self.record.base.log_evidence
        is_far = any(map(is_surely_failing, base.comparisons))
        is_far = is_far and base.record.is_of_training  # else parameters may be off
        if base.is_noise or not (is_far or self.is_force_evident(log_evidence, base)):
            none = "there is no evidence of anything missing, and no effect is decisive"
            reason = f"{base.error_words}; {none}"
            return self.diagnosis(Verdict.NOTHING_MISSING, reason)
        reason = (
            f"{base.error_words}: there is evidence that something is missing, but no "
            "effect of the catalogue explains it"
        )
        steps = self.steps_in_words()
        if steps:
            reason += f"; it may be {steps}"
        nearest = next((one for one in self.ranking if one.was_weighed), None)
        if nearest is not None and nearest.grade != Grade.NONE:
            reason += f"; the nearest is {nearest.name}, but {nearest.lost}"
        return self.diagnosis(Verdict.UNEXPLAINED, reason)

    def reject_others(
        self, named: Sequence[Effect], alike: Sequence[Effect] = ()
    ) -> None:
        """Why the other candidates are not named; some are alike for the data."""
        first = self.ranking[0] if named else None
        for place, one in enumerate(self.ranking):
            if one.lost or one.effect in named:
                continue
            lost = f"{WEAK} {one.grade} ({one.log_evidence:.1f})"
            if one.grade == Grade.NONE:
                lost = f"there is no evidence for it ({one.log_evidence:.1f})"
            if one.grade == Grade.DECISIVE and first is not None:
                lost = f"the data cannot distinguish it from {first.name}"
            if first is not None and one.log_evidence < first.log_evidence:
                lost = f"{first.name} is more likely"
            if one.effect in alike:
                lost = "the data cannot distinguish it from the named effect"
            self.note(place, lost=lost)

    def diagnosis(self, *parts: Any) -> Diagnosis:
        """The diagnosis of the base by its ranking, with the parts of `_diagnosis`."""
        return _diagnosis(self.base, self.ranking, *parts)


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

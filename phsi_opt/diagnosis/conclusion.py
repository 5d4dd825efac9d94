"""The verdict of a diagnosis: is it there, which law is it, how much does it explain.

*Is it there*: an effect whose evidence is decisive beside a force that could have done
the same. *Which law*: the effects that the evidence does not tell from it are a class.
*How much*: a re-fit's free runs, and whether a force remains evident beside it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from phsi_opt.comparison.compare import (
    Comparison,
    is_explained,
    is_small_as_noise,
)
from phsi_opt.criteria import (
    DECISIVE_EVIDENCE,
    LEAST_ERROR_EXPLAINED,
    MOST_OF_IT,
    MOST_REFITTED,
    STRONG_EVIDENCE,
    SURE_DEVIATIONS,
)
from phsi_opt.data.resolution import unresolved_channels
from phsi_opt.diagnosis.candidate import Candidate, Grade
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.finding import Finding, class_of
from phsi_opt.diagnosis.refit import Refit, refit, thorough_refit
from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.diagnosis.weighed_round import weighed_round
from phsi_opt.errors import SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import Effect, is_wave
from phsi_opt.presentation.units import spaced
from phsi_opt.screening.effect_size import fitted_size, new_names
from phsi_opt.screening.weighing import EvidenceRecord


@dataclass(frozen=True, eq=False)
class Conclusion:
    """What a diagnosis says.

    Attributes:
        verdict: in one phrase.
        reason: a sentence or more with the errors before and after.
        ranking: the candidates, with what re-fits gave and why the others lost.
        findings: what is established.
        effects: what is added next; ``fit``: the thorough re-fit with it.
    """

    verdict: Verdict
    reason: str
    ranking: tuple[Candidate, ...]
    findings: tuple[Finding, ...] = ()
    effects: tuple[Effect, ...] = ()
    fit: Fit | None = None


def conclusion(
    base: DiagnosedModel, record: EvidenceRecord, effects: Sequence[Effect]
) -> Conclusion:
    """The verdict on a model.

    Args:
        base: the model that is diagnosed.
        record: beside which models are weighed.
        effects: what may be missing.
    """
    record, ranking = weighed_round(base, record, effects)
    return _Judge(base, record, effects, ranking).concluded()


def without_weighing(base: DiagnosedModel, error: SolveError) -> Conclusion:
    """The verdict on a model that could not be weighed: by its free runs alone."""
    errors = _errors(base)
    if base.is_noise:
        said = f"{errors}; residuals are noise"
        return Conclusion(Verdict.NOTHING_MISSING, said, ())
    return Conclusion(Verdict.UNEXPLAINED, f"{errors}; {error}", ())


@dataclass(eq=False)
class _Judge:
    """One diagnosis on the way to its verdict."""

    base: DiagnosedModel
    record: EvidenceRecord
    effects: Sequence[Effect]
    ranking: list[Candidate]
    nothing_left: bool | None = None
    done: Refit | None = None

    def concluded(self) -> Conclusion:
        done = self.first()
        if done is None:
            return self.without_effect()
        doubt = self.doubt(done)
        if not doubt:
            return self.named(done)
        beside = self.beside(done)
        if beside is None:
            return self.not_named(done, doubt)
        return self.named(done, beside)

    def first(self) -> Refit | None:
        """An effect that is decisive, re-fitted; it is put first.

        Of those that the evidence does not tell from the likeliest the one with fewest
        numbers, and that the catalogue has first.
        """
        while self.tied():
            chosen = min(self.tied(), key=self.size)
            place = self.ranking.index(chosen)
            done = self.refit(place)
            if done is not None:
                self.ranking.insert(0, self.ranking.pop(place))
                return done
        return None

    def tied(self) -> list[Candidate]:
        """Effects that the evidence does not tell from the likeliest.

        None where all of them together are not decisive: one of them is there if the
        sum of their odds says so.
        """
        believed = [one for one in self.ranking if one.was_weighed and not one.lost]
        highest = max((one.log_evidence for one in believed), default=-np.inf)
        tied = []
        for one in believed:
            if one.log_evidence > highest - STRONG_EVIDENCE:
                tied.append(one)
        together = logsumexp([one.log_evidence for one in tied]) if tied else -np.inf
        return tied if together >= DECISIVE_EVIDENCE else []

    def size(self, one: Candidate) -> tuple[int, int]:
        """Number of its unknowns, then its place in the catalogue."""
        return one.effect.n_unknowns, self.effects.index(one.effect)

    def members(self) -> list[Candidate]:
        """Those that the data do not tell from the first, the likeliest re-fitted.

        One that a re-fit presses to a bound or to nothing is none of them.
        """
        names = [one.name for one in self.tied()]
        places = []
        for place, one in enumerate(self.ranking[1:], start=1):
            if one.name in names:
                places.append(place)
        for place in places[: MOST_REFITTED - 1]:
            self.refit(place)
        return [self.ranking[place] for place in places if not self.ranking[place].lost]

    def beside(self, done: Refit) -> "_Judge | None":
        """What is missing beside the first, where both together explain enough."""
        base = replace(self.base, trained=done.trained, judged=done.trained)
        if self.base.is_held_out:
            base = replace(base, judged=done.judged)
        others = [one.effect for one in self.ranking[1:]]
        try:
            record = EvidenceRecord.of(base.record, base.judging_record)
            record, ranking = weighed_round(base, record, others)
            second = _Judge(base, record, others, ranking)
        except SolveError as error:
            base.say(str(error))
            return None
        both = second.first()
        if both is None:
            return None
        if not second.leaves_nothing(both) and self.doubt(both, second):
            return None
        second.done = both
        return second

    def of_force(self, beside: "_Judge | None" = None) -> float:
        """Share of the force (mean square) that the first takes over, or both."""
        first = self.ranking[0]
        left = first.force_left
        if beside is not None:
            second = beside.ranking[0]
            is_one_force = second.effect.equation == first.effect.equation
            of_second = second.force_left
            left = left * of_second if is_one_force else max(left, of_second)
        return max(1 - left**2, 0.0)

    def refit(self, place: int) -> Refit | None:
        """Re-fit a candidate, and note what that gives."""
        base = self.base
        one = self.ranking[place]
        if not one.size.z >= SURE_DEVIATIONS:
            lost = f"its size, {one.size}, may as well be zero"
            self.ranking[place] = replace(one, lost=lost)
            return None
        done = refit(base, one)
        if done is None:
            self.ranking[place] = replace(one, lost="could not be re-fitted")
            return None
        new = new_names(base.fit.model, one.effect, done.fit.names)
        at_bound = [name for name in new if name in done.fit.outcome.at_bounds]
        if at_bound:
            lost = f"{', '.join(at_bound)} ended at a bound"
            self.ranking[place] = replace(one, lost=lost)
            return None
        self.ranking[place] = self.refitted(one, done)
        return done

    def refitted(self, one: Candidate, done: Refit) -> Candidate:
        """A candidate with what its re-fit gave."""
        base = self.base
        return replace(
            one,
            fit=done.fit,
            trained=done.trained,
            comparison=done.judged,
            train_rmse=done.trained.rmse,
            held_out_rmse=done.judged.rmse if base.is_held_out else one.held_out_rmse,
            share=base.share_explained(done.judged.rmse),
        )

    def doubt(self, done: Refit, beside: "_Judge | None" = None) -> str:
        """Why what is decisive is not named, alone or with another; empty: it is."""
        base = self.base
        first = self.ranking[0]
        told = [first] if beside is None else [first, beside.ranking[0]]
        steps = self.steps_in_words()
        if steps and is_small_as_noise(done.trained):
            return f"so may {steps}"
        if self.leaves_nothing(done):
            return ""
        if done.trained.rmse > base.trained.rmse:
            return "its free run is further off than without it"
        if any(is_wave(one.effect) and one.effect.needs_clock for one in told):
            return "a force remains, and any force in time has waves like it in it"
        of_force = self.of_force(beside)
        share = base.share_explained(done.judged.rmse)
        if of_force < MOST_OF_IT and not share > LEAST_ERROR_EXPLAINED:
            return (
                f"it explains only {100 * of_force:.0f} % of the force (mean square) "
                f"and {100 * share:.0f} % of the error"
            )
        return self.rival(first)

    def steps_in_words(self) -> str:
        """Steps of sensors that are coarser than the motion; empty: there are none."""
        unresolved = unresolved_channels(self.base.record.data)
        if not unresolved:
            return ""
        return (
            f"the steps of {', '.join(unresolved)}, which moves by less than one of "
            "them (standard deviation)"
        )

    def rival(self, first: Candidate) -> str:
        """A law of no catalogue that is far likelier; empty where there is none."""
        model = self.base.fit.model
        if first.effect.slot == "sensor":
            return ""
        equation = model.index(first.effect.equation)
        forced = [force.place for force in self.record.base.disturbances.forces]
        if equation not in forced:
            return ""
        function = self.record.with_functions(equation)
        if function is None:
            return ""
        gain = function.log_evidence - self.record.base.log_evidence
        if not first.log_evidence < MOST_OF_IT * gain:
            return ""
        (kind,) = function.disturbances.functions
        return (
            f"an unknown function of {model.states[kind.state]} in "
            f"d{first.effect.equation}/dt is likelier (log evidence {gain:.1f} against "
            f"{first.log_evidence:.1f})"
        )

    def leaves_nothing(self, done: Refit) -> bool:
        """Whether no force is evident beside a re-fit; worked out once."""
        if self.nothing_left is None:
            self.nothing_left = self._leaves_nothing(done)
        return self.nothing_left

    def _leaves_nothing(self, done: Refit) -> bool:
        base = self.base
        if is_explained(base.judged, done.trained, done.judged):
            return True
        runs = [done.trained, done.judged] if base.is_held_out else [done.trained]
        first = self.ranking[0]
        gain = first.log_evidence + self.record.base.log_evidence
        return not self.is_force_evident(gain, runs)

    def is_force_evident(
        self, log_evidence: float, comparisons: Sequence[Comparison]
    ) -> bool:
        """Whether a model is decisively likelier with a force than without."""
        try:
            alone = self.record.without_force(comparisons)
        except SolveError:
            return True
        return log_evidence - alone.log_evidence > DECISIVE_EVIDENCE

    def named(self, done: Refit, beside: "_Judge | None" = None) -> Conclusion:
        """The first, with what is missing beside it, or alone."""
        if beside is None or beside.done is None:
            last = thorough_refit(self.base, done)
            size = fitted_size(self.base.fit, last.fit, self.ranking[0].effect)
            self.ranking[0] = replace(
                self.refitted(self.ranking[0], last),
                coefficient=size.value,
                std_error=size.std_error,
            )
        else:
            last = thorough_refit(beside.base, beside.done)
        first = self.ranking[0]
        findings = [self.finding(last)]
        leaves_nothing = self.leaves_nothing(done)
        share, of_force = first.share, self.of_force(beside)
        if beside is not None and beside.done is not None:
            leaves_nothing = beside.leaves_nothing(beside.done)
            share = self.base.share_explained(last.judged.rmse)
            findings.append(beside.finding(last))
            second = beside.ranking[0]
            others = [one for one in self.ranking[1:] if one.effect != second.effect]
            self.ranking = [first, second, *others]
        names: list[str] = []
        for finding in findings:
            names += map(str, finding.effects[1:])
        for place, one in enumerate(self.ranking):
            if one.name in names:
                lost = one.lost or "the data do not tell it from what is named"
                self.ranking[place] = replace(one, lost=lost)
        effects = tuple(finding.effects[0] for finding in findings)
        self.tell_others(effects)
        said = " and ".join(map(str, findings))
        change = self.change(last)
        verdict = Verdict.NAMED
        reason = f"{said}; {change}; {_grade_words(first)}"
        if not leaves_nothing:
            verdict = Verdict.PARTLY_NAMED
            reason = (
                f"{said}; {change}; {_grade_words(first)}. It accounts for "
                f"{100 * of_force:.0f} % of the missing force (mean square) and "
                f"{100 * share:.0f} % of the squared error above the noise floor; a "
                "force remains"
            )
        ranking = tuple(self.ranking)
        return Conclusion(verdict, reason, ranking, tuple(findings), effects, last.fit)

    def finding(self, last: Refit) -> Finding:
        """The first with those that the data do not tell from it, and its size."""
        first = self.ranking[0]
        effects = (first.effect, *(one.effect for one in self.members()))
        size = fitted_size(self.base.fit, last.fit, first.effect)
        share = self.base.share_explained(last.judged.rmse)
        return Finding(
            effects, class_of(effects), size.value, size.std_error, share, size.unit
        )

    def not_named(self, done: Refit, against: str) -> Conclusion:
        first = replace(self.ranking[0], lost=against)
        self.ranking[0] = first
        self.tell_others((first.effect,))
        reason = (
            f"the nearest is {first.name} ({first.size}), with {_grade_words(first)}: "
            f"{self.change(done)}. It is not named: {against}"
        )
        return Conclusion(Verdict.UNEXPLAINED, reason, tuple(self.ranking))

    def without_effect(self) -> Conclusion:
        """Nothing is missing, or nothing known explains it."""
        base = self.base
        self.tell_others(())
        errors = _errors(base)
        ranking = tuple(self.ranking)
        log_evidence = self.record.base.log_evidence
        if base.is_noise or not self.is_force_evident(log_evidence, base.comparisons):
            none = "no force is evident beside the model, and no effect is decisive"
            return Conclusion(Verdict.NOTHING_MISSING, f"{errors}; {none}", ranking)
        reason = f"{errors}: a force is evident, and no effect explains it"
        steps = self.steps_in_words()
        if steps:
            reason += f"; it may be {steps}"
        nearest = [one for one in self.ranking if one.was_weighed]
        if nearest and nearest[0].grade != Grade.NONE:
            one = nearest[0]
            reason += f"; the nearest, {one.name}, has {_grade_words(one)}"
            if one.lost:
                reason += f", but {one.lost}"
        return Conclusion(Verdict.UNEXPLAINED, reason, ranking)

    def tell_others(self, told: Sequence[Effect]) -> None:
        """Why the candidates that are not told of are not named."""
        for place, one in enumerate(self.ranking):
            if one.lost or one.effect in told:
                continue
            lost = f"its evidence is {one.grade} ({one.log_evidence:.1f})"
            if told and one.log_evidence < self.ranking[0].log_evidence:
                lost = f"{self.ranking[0].name} is likelier"
            self.ranking[place] = replace(one, lost=lost)

    def change(self, done: Refit) -> str:
        """The errors before and after."""
        before = self.base.judged
        after = done.judged
        where = "held-out" if self.base.is_held_out else "training"
        unit = spaced(after.error_unit)
        return (
            f"the {where} error falls from {before.rmse:.4g} to {after.rmse:.4g}{unit} "
            f"(noise floor {after.noise_floor:.4g}{unit})"
        )


def _errors(base: DiagnosedModel) -> str:
    """How far the model is off."""
    where = "held-out" if base.is_held_out else "training"
    unit = spaced(base.judged.error_unit)
    return (
        f"{where} error {base.judged.rmse:.4g}{unit}, "
        f"noise floor {base.judged.noise_floor:.4g}{unit}"
    )


def _grade_words(one: Candidate) -> str:
    return f"{one.grade} evidence (log evidence {one.log_evidence:.1f})"

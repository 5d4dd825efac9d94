"""The verdict of a diagnosis with its reason in words."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from phsi_opt.comparison.model_selection import (
    explained_share,
    is_explained,
    is_failing,
    is_like_noise,
    is_small_as_noise,
)
from phsi_opt.criteria import EXPLAINED_IF_PARTLY, EXPLAINED_IF_PROPOSED
from phsi_opt.data.resolution import unresolved_channels
from phsi_opt.diagnosis.alike import alike, alike_in_pair
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.doubts import fitted_size
from phsi_opt.diagnosis.finding import Finding, class_of
from phsi_opt.diagnosis.objections import objection, objection_beside_the_rest
from phsi_opt.diagnosis.proposal import Proposal, parts_alone
from phsi_opt.diagnosis.remainder import Remainder
from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.estimation.fit import Fit
from phsi_opt.force_analysis.units import spaced
from phsi_opt.model.effect import Effect


@dataclass(frozen=True, eq=False)
class Conclusion:
    """What a diagnosis says.

    Attributes:
        verdict: in one phrase.
        reason: a sentence or more with the errors before and after.
        findings: what is established.
        effects: what is added next: the findings, or the nearest to one.
        fit: the brief re-fit with them; None without effects.
        against: why the best candidate is not named; empty where it is, or where there
            is none.
    """

    verdict: Verdict
    reason: str
    findings: tuple[Finding, ...] = ()
    effects: tuple[Effect, ...] = ()
    fit: Fit | None = None
    against: str = ""


def conclusion(
    base: DiagnosedModel,
    proposed: Proposal | None,
    ranked: Sequence[Candidate],
    pairs: Sequence[Candidate] = (),
) -> Conclusion:
    """The verdict on a model from what is proposed to be added to it.

    Of a pair that is not established, one that is so alone is named.

    Args:
        base: the model that is diagnosed.
        proposed: the best effect or pair; None where none is significant.
        ranked: the single candidates, best first.
        pairs: that were looked at or re-fitted.
    """
    if proposed is None:
        return _without_effect(base, ranked)
    concluded = _concluded(base, proposed, ranked, pairs)
    if concluded.findings:
        return concluded
    for single in parts_alone(base, proposed, ranked):
        alone = _concluded(base, single, ranked, pairs)
        if alone.findings:
            beside = _beside(proposed, single, concluded.against)
            return replace(alone, reason=f"{alone.reason}. {beside}")
    return concluded


def _beside(proposed: Proposal, named: Proposal, against: str) -> str:
    """The one of a pair that is not named, and what is against both, in a sentence."""
    (other,) = (
        effect
        for effect in proposed.candidate.effects
        if effect != named.candidate.effect
    )
    after = proposed.done.judged
    return (
        f"With {other} too the error would be {after.rmse:.4g}"
        f"{spaced(after.error_unit)}, but {against}"
    )


def _concluded(
    base: DiagnosedModel,
    proposed: Proposal,
    ranked: Sequence[Candidate],
    pairs: Sequence[Candidate],
) -> Conclusion:
    """The verdict on what is proposed as it is."""
    done = proposed.done
    effects = proposed.candidate.effects
    is_all = is_explained(base.judged, done.trained, done.judged)
    left = None if is_all else Remainder.of(base, proposed.fit)
    others = {}
    for effect in effects:
        if len(effects) == 1:
            found = alike(base, proposed.candidate, ranked, left)
        else:
            found = alike_in_pair(base, proposed.candidate, effect, pairs)
        others[str(effect)] = found
    findings = _findings(base, proposed, others)
    change = _change(base, proposed)
    said = " and ".join(str(finding) for finding in findings)
    share = explained_share(base.judged, done.judged)
    against = objection(base, proposed, findings, ranked, is_all)
    unresolved = unresolved_channels(base.record.data)
    if unresolved and (is_all or is_small_as_noise(done.trained)):
        steps = f"the steps of {', '.join(unresolved)}"
        reason = (
            f"{said} would explain it, but so may {steps}, which moves by less than "
            f"one of them (standard deviation): {change}"
        )
        against = f"{steps} may look like it"
        return Conclusion(Verdict.UNEXPLAINED, reason, against=against)
    is_enough = share > EXPLAINED_IF_PARTLY or not is_failing(base.judged)
    if is_all and is_enough and not against:
        return Conclusion(
            Verdict.NAMED, f"{said}; {change}", findings, effects, proposed.fit
        )
    percent = f"{100 * share:.0f} % of the squared error above the noise floor"
    remainder = left or Remainder.of(base, proposed.fit)
    against = against or objection_beside_the_rest(base, proposed, share, remainder)
    if share > EXPLAINED_IF_PARTLY and not against:
        left_words = remainder.words(effects)
        reason = (
            f"{said}: that accounts for {percent}; {change}. Of the missing force "
            f"{left_words}; what remains, no effect of the catalogue explains with it"
        )
        return Conclusion(Verdict.PARTLY_NAMED, reason, findings, effects, proposed.fit)
    reason = f"the nearest is {said}, with {percent}: {change}"
    if against:
        reason += f". It is not named: {against}"
    against = against or "it explains too little"
    if share <= EXPLAINED_IF_PROPOSED:
        return Conclusion(Verdict.UNEXPLAINED, reason, against=against)
    return Conclusion(Verdict.UNEXPLAINED, reason, (), effects, proposed.fit, against)


def _change(base: DiagnosedModel, proposed: Proposal) -> str:
    """The errors before and after."""
    before = base.judged
    after = proposed.done.judged
    where = "held-out" if base.is_held_out else "training"
    unit = spaced(after.error_unit)
    return (
        f"the {where} error falls from {before.rmse:.4g} to {after.rmse:.4g}{unit} "
        f"(noise floor {after.noise_floor:.4g}{unit})"
    )


def _findings(
    base: DiagnosedModel, proposed: Proposal, others: Mapping[str, Sequence[Effect]]
) -> tuple[Finding, ...]:
    """A finding per effect; the others of the same name are in its class."""
    share = explained_share(base.judged, proposed.done.judged)
    findings = []
    for effect in proposed.candidate.effects:
        size = fitted_size(base.fit, proposed.fit, effect)
        members = (effect, *others[str(effect)])
        findings.append(
            Finding(
                members,
                class_of(members),
                size.value,
                size.std_error,
                share,
                size.unit,
            )
        )
    return tuple(findings)


def _without_effect(base: DiagnosedModel, ranked: Sequence[Candidate]) -> Conclusion:
    """Nothing is missing, or nothing known explains it."""
    where = "held-out" if base.is_held_out else "training"
    unit = spaced(base.judged.error_unit)
    errors = (
        f"{where} error {base.judged.rmse:.4g}{unit}, "
        f"noise floor {base.judged.noise_floor:.4g}{unit}"
    )
    if is_like_noise(base.trained) and not is_failing(base.judged):
        none = "no effect of the catalogue lowers it significantly"
        return Conclusion(Verdict.NOTHING_MISSING, f"{errors}; {none}")
    reason = f"{errors}, and no effect of the catalogue is established"
    refitted = [one for one in ranked if one.fit is not None and one.lost]
    refitted = [one for one in refitted if one.share > 0]
    if refitted:
        nearest = min(refitted, key=lambda one: one.delta_bic)
        reason += f"; the nearest, {nearest.name}, is not, because {nearest.lost}"
    return Conclusion(Verdict.UNEXPLAINED, reason)

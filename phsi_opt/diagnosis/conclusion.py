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
from phsi_opt.criteria import (
    CLOCK_Z,
    EXPLAINED_IF_MUCH_REMAINS,
    EXPLAINED_IF_NAMED,
    EXPLAINED_IF_PARTLY,
    EXPLAINED_IF_PROPOSED,
    FORCE_GONE_IF_PARTLY,
    INEXACT_SHARE,
    LARGE_LAW_SHARE,
    LARGE_REMAINDER,
    MOST_FAMILIES,
    SIMPLE_SHARE,
    SPRING_Z,
)
from phsi_opt.data.resolution import unresolved_channels
from phsi_opt.diagnosis.alike import alike, alike_in_pair
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.doubts import (
    fitted_size,
    found_by_chance,
    kinds_of,
    unconfirmed,
    z_beside_others,
)
from phsi_opt.diagnosis.finding import Finding
from phsi_opt.diagnosis.proposal import Proposal, parts_alone
from phsi_opt.diagnosis.remainder import Remainder, share_of_motion
from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.estimation.fit import Fit
from phsi_opt.force_analysis.units import spaced
from phsi_opt.model.catalogue_forces import HYSTERESIS
from phsi_opt.model.effect import Effect

LOSS = "a loss of energy whose law the data do not tell"
LOSS_SOMEWHERE = "a loss of energy whose place and law the data do not tell"


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
    against = _against(base, proposed, findings, ranked)
    if not against:
        against = _against_beside_others(base, proposed, is_all)
    if not against and share_of_motion(base.record.estimate) < INEXACT_SHARE:
        against = _against_small(base, effects, share, is_all)
    unresolved = unresolved_channels(base.record.data)
    if is_all and unresolved:
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
    against = against or _against_beside_the_rest(base, proposed, share, remainder)
    if share > EXPLAINED_IF_PARTLY and not against:
        reason = (
            f"{said}: that accounts for {percent}; {change}. Of the missing force "
            f"{remainder}; what remains, no effect of the catalogue explains with it"
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


def families(effects: Sequence[Effect]) -> list[str]:
    """The families of effects, each once, in their order."""
    return list(dict.fromkeys(effect.family for effect in effects))


def class_of(effects: Sequence[Effect]) -> str:
    """What a class is called; of many laws of loss that they take energy."""
    joined = families(effects)
    if len(joined) > MOST_FAMILIES and _are_losses(effects):
        places = {effect.equation for effect in effects}
        return LOSS if len(places) == 1 else LOSS_SOMEWHERE
    return " or ".join(joined)


def _are_losses(effects: Sequence[Effect]) -> bool:
    """Whether all take energy from the motion: then they are alike in that."""
    return all(one.slot == "R" or one.name == HYSTERESIS for one in effects)


def _against(
    base: DiagnosedModel,
    proposed: Proposal,
    findings: Sequence[Finding],
    ranked: Sequence[Candidate],
) -> str:
    """Why what is proposed is not established; empty where it is."""
    for finding in findings:
        joined = families(finding.effects)
        if len(joined) > MOST_FAMILIES and not _are_losses(finding.effects):
            return f"the data do not tell apart {', '.join(joined)}"
    effects = proposed.candidate.effects
    of_energy = _against_two_springs(effects)
    if of_energy:
        return of_energy
    if base.handicap(effects) and share_of_motion(base.record.estimate) < INEXACT_SHARE:
        sizes = [fitted_size(base.fit, proposed.fit, effect) for effect in effects]
        if min(size.z for size in sizes) < CLOCK_Z:
            return f"{_inexact(base)}, and with a clock much can be made to fit"
    judged = proposed.done.judged
    by_chance = ""
    if not explained_share(base.judged, judged) > EXPLAINED_IF_NAMED:
        by_chance = _by_chance(base, proposed, findings, ranked)
    return by_chance or unconfirmed(base, proposed.fit, judged, effects)


def _by_chance(
    base: DiagnosedModel,
    proposed: Proposal,
    findings: Sequence[Finding],
    ranked: Sequence[Candidate],
) -> str:
    """Why one of the findings may be chance; empty where none is.

    A class of a single effect counts by the clearest of its members.
    """
    n_kinds = len(kinds_of(one.effect for one in ranked))
    for finding in findings:
        members = [(finding.effects[0], proposed.fit)]
        for one in ranked:
            is_member = len(findings) == 1 and one.effect in finding.effects[1:]
            if is_member and one.fit is not None and not one.lost:
                members.append((one.effect, one.fit))
        against = found_by_chance(base.fit, members, n_kinds)
        if against:
            return against
    return ""


def _against_beside_others(
    base: DiagnosedModel, proposed: Proposal, is_all: bool
) -> str:
    """Why an effect beside others is not named; empty where it is.

    The clearest one of a first step stands beside nothing but the error of the model.
    Where noise is all that is left, that counts for what needs a clock alone; where the
    error was as small before, for every effect: noise hides errors of the model.

    Args:
        base: the model that is diagnosed.
        proposed: what is added.
        is_all: whether it leaves noise.
    """
    effects = proposed.candidate.effects
    sizes = [fitted_size(base.fit, proposed.fit, effect) for effect in effects]
    found = sorted(zip(sizes, effects, strict=True), key=lambda one: one[0].z)
    is_hidden = is_small_as_noise(base.trained)
    for place, (size, effect) in enumerate(found):
        is_first = place == len(found) - 1 and not base.is_later
        if is_first and is_all and not is_hidden:
            continue
        needs_clock = base.handicap((effect,)) > 0
        if (is_first or is_all) and not (needs_clock or is_hidden):
            continue
        if not size.z >= z_beside_others(base, effect):
            return (
                f"the size of {effect}, {size}, is not clear enough where other causes "
                "may act"
            )
    return ""


def _against_small(
    base: DiagnosedModel, effects: Sequence[Effect], share: float, is_all: bool
) -> str:
    """Why a force as small as what models err by is not named; empty where it is.

    Args:
        base: the model that is diagnosed.
        effects: that are proposed.
        share: of the squared error above the noise floor that they explain.
        is_all: whether they leave noise.
    """
    are_simple = all(one.n_unknowns == 1 and not one.needs_clock for one in effects)
    if is_all and (are_simple or share > LARGE_LAW_SHARE):
        return ""
    if len(effects) == 1 and are_simple and share > SIMPLE_SHARE:
        return ""
    percent = f"{100 * share:.0f} % of the squared error above the noise floor"
    return f"{_inexact(base)}, and only {percent} is explained"


def _against_beside_the_rest(
    base: DiagnosedModel, proposed: Proposal, share: float, remainder: Remainder
) -> str:
    """Why an effect that leaves more than noise is not named; empty where it is.

    Args:
        base: the model that is diagnosed.
        proposed: what is added.
        share: of the squared error above the noise floor that it explains.
        remainder: what it leaves of the missing force.
    """
    if remainder.gone < FORCE_GONE_IF_PARTLY:
        return f"of the missing force {remainder}"
    if share <= EXPLAINED_IF_MUCH_REMAINS and remainder.share > LARGE_REMAINDER:
        percent = 100 * remainder.share
        return (
            f"the force that remains is {percent:.2g} % of the motion's own, more than "
            "models err by"
        )
    for effect in proposed.candidate.effects:
        size = fitted_size(base.fit, proposed.fit, effect)
        if effect.slot == "H" and not size.z >= SPRING_Z:
            return (
                f"the size of {effect}, {size}, is not clear enough: a term of the "
                "energy bends to whatever force goes with the position"
            )
    return ""


def _against_two_springs(effects: Sequence[Effect]) -> str:
    """Why two terms of the energy there are not named; empty where they are.

    Two that are needed together stand for one whose law is another.
    """
    if len(effects) < 2 or any(one.slot != "H" for one in effects):
        return ""
    if len({one.equation for one in effects}) > 1:
        return ""
    first, second = effects
    return (
        f"{first} and {second} may together stand for one force that depends on the "
        "position by another law"
    )


def _inexact(base: DiagnosedModel) -> str:
    """How small the missing force is."""
    percent = 100 * share_of_motion(base.record.estimate)
    return f"the missing force is {percent:.2g} % of the motion's own, as models err"


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

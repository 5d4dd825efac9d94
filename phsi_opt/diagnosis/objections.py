"""Why an effect that is proposed is not named, whatever error it removes.

Each objection is a sentence; an empty one objects to nothing.
"""

from collections.abc import Sequence

from phsi_opt.comparison.model_selection import (
    explained_share,
    is_small_as_noise,
    is_white_noise,
)
from phsi_opt.criteria import (
    CLOCK_Z,
    EXPLAINED_IF_MUCH_REMAINS,
    EXPLAINED_IF_NAMED,
    FORCE_GONE_IF_PARTLY,
    INEXACT_SHARE,
    LARGE_LAW_SHARE,
    LARGE_REMAINDER,
    MOST_FAMILIES,
    SIMPLE_SHARE,
    SPRING_Z,
)
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.doubts import (
    fitted_size,
    found_by_chance,
    kinds_of,
    unconfirmed,
    z_beside_others,
)
from phsi_opt.diagnosis.finding import Finding, are_losses, families
from phsi_opt.diagnosis.proposal import Proposal
from phsi_opt.diagnosis.remainder import Remainder, share_of_motion
from phsi_opt.model.catalogue_energies import is_spring
from phsi_opt.model.effect import Effect


def objection(
    base: DiagnosedModel,
    proposed: Proposal,
    findings: Sequence[Finding],
    ranked: Sequence[Candidate],
    is_all: bool,
) -> str:
    """Why what is proposed is not established; empty where it is.

    Args:
        base: the model that is diagnosed.
        proposed: what is added.
        findings: the same, each with what does as well.
        ranked: the single candidates, best first.
        is_all: whether it leaves noise.
    """
    against = _against(base, proposed, findings, ranked)
    against = against or _against_new_noise(base, proposed)
    against = against or _against_beside_others(base, proposed, is_all)
    if not against and share_of_motion(base.record.estimate) < INEXACT_SHARE:
        against = _against_small(base, proposed, is_all)
    return against


def _against_new_noise(base: DiagnosedModel, proposed: Proposal) -> str:
    """Why what seems to leave noise that lasts is not named; empty where it is.

    Such noise was there before, and would have shown beside what was missing.
    """
    trained = proposed.done.trained
    if is_white_noise(trained) or not trained.record.has_correlated_noise:
        return ""
    if base.record.shows_correlated_noise:
        return ""
    return (
        "what remains lasts from sample to sample, as the noise of these sensors did "
        "not before: it may be the difference from the law that is missing"
    )


def _against(
    base: DiagnosedModel,
    proposed: Proposal,
    findings: Sequence[Finding],
    ranked: Sequence[Candidate],
) -> str:
    """Why one of the findings is not believed by itself; empty where all are."""
    for finding in findings:
        joined = families(finding.effects)
        if len(joined) > MOST_FAMILIES and not are_losses(finding.effects):
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


def _against_two_springs(effects: Sequence[Effect]) -> str:
    """Why two terms of the energy there are not named; empty where they are.

    Two that are needed together stand for one whose law is another.
    """
    if len(effects) < 2 or not all(map(is_spring, effects)):
        return ""
    if len({one.equation for one in effects}) > 1:
        return ""
    first, second = effects
    return (
        f"{first} and {second} may together stand for one force that depends on the "
        "position by another law"
    )


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


def _against_small(base: DiagnosedModel, proposed: Proposal, is_all: bool) -> str:
    """Why a force as small as what models err by is not named; empty where it is.

    Args:
        base: the model that is diagnosed.
        proposed: what is added.
        is_all: whether it leaves noise.
    """
    effects = proposed.candidate.effects
    share = explained_share(base.judged, proposed.done.judged)
    are_simple = all(one.n_unknowns == 1 and not one.needs_clock for one in effects)
    if is_all and (are_simple or share > LARGE_LAW_SHARE):
        return ""
    if len(effects) == 1 and are_simple and share > SIMPLE_SHARE:
        return ""
    percent = f"{100 * share:.0f} % of the squared error above the noise floor"
    return f"{_inexact(base)}, and only {percent} is explained"


def objection_beside_the_rest(
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
        return f"of the missing force {remainder.words()}"
    if share <= EXPLAINED_IF_MUCH_REMAINS and remainder.share > LARGE_REMAINDER:
        percent = 100 * remainder.share
        return (
            f"the force that remains is {percent:.2g} % of the motion's own, more than "
            "models err by"
        )
    for effect in proposed.candidate.effects:
        size = fitted_size(base.fit, proposed.fit, effect)
        if is_spring(effect) and not size.z >= SPRING_Z:
            return (
                f"the size of {effect}, {size}, is not clear enough: a term of the "
                "energy bends to whatever force goes with the position"
            )
    return ""


def _inexact(base: DiagnosedModel) -> str:
    """How small the missing force is."""
    percent = 100 * share_of_motion(base.record.estimate)
    return f"the missing force is {percent:.2g} % of the motion's own, as models err"

"""The verdict of a diagnosis with its reason in words."""

from dataclasses import dataclass

from phsi_opt.comparison.model_selection import (
    explained_share,
    is_explained,
    is_failing,
    is_like_noise,
)
from phsi_opt.criteria import EXPLAINED_IF_PROPOSED
from phsi_opt.data.resolution import unresolved_channels
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.proposal import Proposal
from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import Effect


@dataclass(frozen=True, eq=False)
class Conclusion:
    """What a diagnosis says.

    Attributes:
        verdict: in one phrase.
        reason: a sentence with the errors before and after.
        effects: what the verdict names or, where more than noise is left, proposes.
        fit: the brief re-fit with them; None without effects.
    """

    verdict: Verdict
    reason: str
    effects: tuple[Effect, ...] = ()
    fit: Fit | None = None


def conclusion(base: DiagnosedModel, proposed: Proposal | None) -> Conclusion:
    """The verdict on a model from what is proposed to be added to it."""
    where = "held-out" if base.is_held_out else "training"
    before = base.judged
    if proposed is None:
        return _without_effect(base, where)
    after = proposed.judged
    names = " and ".join(str(effect) for effect in proposed.effects)
    if len(proposed.effects) > 1:
        names += " together"
    change = (
        f"the {where} error falls from {before.rmse:.4g} to {after.rmse:.4g} "
        f"(noise floor {after.noise_floor:.4g})"
    )
    if is_explained(before, proposed.trained, after):
        unresolved = unresolved_channels(base.record.data)
        if unresolved:
            explained = f"{names}{proposed.size} would explain it"
            return _behind_steps(explained, unresolved, change)
        reason = f"{names}{proposed.size}; {change}"
        return Conclusion(Verdict.NAMED, reason, proposed.effects, proposed.fit)
    share = explained_share(before, after)
    is_one = len(proposed.effects) == 1
    explains = "explains" if is_one else "explain"
    leaves = "leaves" if is_one else "leave"
    reason = (
        f"no known effect explains it all. The nearest, {names}{proposed.size}, "
        f"{explains} {100 * share:.0f} % of the squared error above the noise floor, "
        f"and {leaves} more than noise: {change}"
    )
    if share <= EXPLAINED_IF_PROPOSED:
        return Conclusion(Verdict.UNEXPLAINED, reason)
    return Conclusion(Verdict.UNEXPLAINED, reason, proposed.effects, proposed.fit)


def _behind_steps(
    explained: str, unresolved: tuple[str, ...], change: str
) -> Conclusion:
    """Nothing is named from channels whose steps may look like an effect."""
    reason = (
        f"{explained}, but so may the steps of {', '.join(unresolved)}, which moves by "
        f"less than one of them (standard deviation): {change}"
    )
    return Conclusion(Verdict.UNEXPLAINED, reason)


def _without_effect(base: DiagnosedModel, where: str) -> Conclusion:
    """Nothing is missing, or nothing known explains it."""
    errors = (
        f"{where} error {base.judged.rmse:.4g}, "
        f"noise floor {base.judged.noise_floor:.4g}"
    )
    none = "no effect of the catalogue lowers it significantly"
    if not is_like_noise(base.trained) or is_failing(base.judged):
        return Conclusion(Verdict.UNEXPLAINED, f"{errors}, but {none}")
    return Conclusion(Verdict.NOTHING_MISSING, f"{errors}; {none}")

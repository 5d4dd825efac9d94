"""What does as well as an effect that is proposed: the members of its class.

Noise alone leaves a sharp choice between laws. Where more than noise is left, what is
left may be the difference between them, and the choice is as blunt as that.
"""

from collections.abc import Sequence

from phsi_opt.comparison.model_selection import (
    delta_bic,
    falls_significantly,
    free_run_deviance,
    share_of_change,
)
from phsi_opt.criteria import (
    BIC_TIE,
    LARGER_LAW_MARGIN,
    REMAINDER_TIE,
    SIMPLE_SHARE,
    SIMPLE_SHARE_BESIDE_ALL,
)
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.remainder import Remainder
from phsi_opt.model.effect import Effect
from phsi_opt.model_error.standard_errors import Source


def alike(
    base: DiagnosedModel,
    best: Candidate,
    ranked: Sequence[Candidate],
    remainder: Remainder | None,
) -> list[Effect]:
    """The effects that do as well as the best and are no larger.

    Args:
        base: the model that is diagnosed.
        best: a single effect, re-fitted.
        ranked: all candidates.
        remainder: what it leaves of the missing force; None where it leaves noise.
    """
    found = []
    for other in ranked:
        is_single = other.partner is None and other.effect != best.effect
        if not is_single or other.effect.n_unknowns > best.effect.n_unknowns:
            continue
        if base.handicap(other.effects) > base.handicap(best.effects):
            continue  # it needs the clock, and what does as well needs none
        if _is_preferred_in_training(best, other):
            is_tied = True
        elif other.name in best.confusable_with:
            is_tied = not _is_worse_held_out(base, best, other)
            if remainder is not None and not is_tied:
                is_tied = _is_nearly_all(best, other)
        elif remainder is not None:
            is_tied = _is_within(remainder, base, best, other)
        else:
            is_tied = _is_better_held_out(base, best, other)
            is_tied = is_tied or _is_simpler_and_close(base, best, other)
        if is_tied:
            found.append(other.effect)
    return found


def alike_in_pair(
    base: DiagnosedModel, best: Candidate, effect: Effect, pairs: Sequence[Candidate]
) -> list[Effect]:
    """The effects that do as well in the place of one of the two that are proposed.

    Args:
        base: the model that is diagnosed.
        best: two effects, re-fitted.
        effect: one of them.
        pairs: all that were looked at or re-fitted.
    """
    partners = [one for one in best.effects if one != effect]
    found: list[Effect] = []
    if best.fit is None or best.trained is None:
        return found
    share = share_of_change(base.trained, best.trained)
    for pair in pairs:
        others = [one for one in pair.effects if one not in partners]
        if len(others) != 1 or others[0] == effect or pair.fit is None or pair.lost:
            continue
        is_behind = delta_bic(best.fit, pair.fit, share) > BIC_TIE
        if others[0].n_unknowns > effect.n_unknowns or is_behind:
            continue
        if not _is_worse_held_out(base, best, pair):
            found.append(others[0])
    return found


def _is_preferred_in_training(best: Candidate, other: Candidate) -> bool:
    """Whether the training data clearly prefer another one than the data held out."""
    is_known = other.fit is not None and not other.lost
    return is_known and other.delta_bic < best.delta_bic - BIC_TIE


def _is_nearly_all(best: Candidate, other: Candidate) -> bool:
    """Whether another one explains nearly as much of the error on data held out.

    Beside model error a run held out prefers one law or another by chance.
    """
    is_known = other.fit is not None and not other.lost
    return is_known and other.share > SIMPLE_SHARE * best.share


def _is_better_held_out(
    base: DiagnosedModel, best: Candidate, other: Candidate
) -> bool:
    """Whether a similar law leaves noise too, and less on data held out.

    The training data prefer the best, those held out do not: model error, which is
    hidden by the noise, may have made the difference. Losses of other families are
    similar only where model error is found.
    """
    if not base.is_held_out or not _are_similar(best.effect, other.effect):
        return False
    is_exact = best.fit is not None and best.fit.std_error_source == Source.NOISE
    if is_exact and other.effect.family != best.effect.family:
        return False
    if other.lost or not base.is_left_with_noise(other.trained):
        return False
    return bool(other.held_out_rmse < best.held_out_rmse)


def _is_simpler_and_close(
    base: DiagnosedModel, best: Candidate, other: Candidate
) -> bool:
    """Whether a smaller law there explains nearly as much, and the data hardly object.

    What the larger one gains in training it may owe to model error below the noise; so
    it must do better on the data held out, or be far ahead.
    """
    if other.comparison is None or best.comparison is None or other.lost:
        return False
    n_more = best.effect.n_unknowns - other.effect.n_unknowns
    if n_more < 1 or other.effect.equation != best.effect.equation:
        return False
    if not other.share > SIMPLE_SHARE_BESIDE_ALL * best.share:
        return False
    if other.delta_bic < best.delta_bic + LARGER_LAW_MARGIN:
        return True
    return base.is_held_out and not falls_significantly(
        other.comparison, best.comparison
    )


def _is_worse_held_out(base: DiagnosedModel, best: Candidate, other: Candidate) -> bool:
    """Whether data held out clearly prefer the best, where the training data do not.

    They must tell the two apart by themselves, and all data together must.
    """
    if not base.is_held_out or best.comparison is None or other.comparison is None:
        return False
    if not falls_significantly(other.comparison, best.comparison):
        return False
    share = share_of_change(other.comparison, best.comparison)
    fall = free_run_deviance(other.comparison) - free_run_deviance(best.comparison)
    return share * fall + other.delta_bic - best.delta_bic > BIC_TIE


def _is_within(
    remainder: Remainder, base: DiagnosedModel, best: Candidate, other: Candidate
) -> bool:
    """Whether data held out do not prefer the best, or the rest hides the difference.

    That is asked of laws of one family, and of losses: their forces differ by less than
    the force that is missing still.
    """
    if other.fit is None or other.lost:
        return False
    if other.comparison is None or best.comparison is None:
        return False
    if base.is_held_out and not falls_significantly(other.comparison, best.comparison):
        return True
    if not _are_similar(best.effect, other.effect):
        return False
    return Remainder.of(base, other.fit).after < REMAINDER_TIE * remainder.after


def _are_similar(one: Effect, other: Effect) -> bool:
    """Whether two laws are of one family, or both take energy."""
    return one.family == other.family or one.slot == "R" == other.slot

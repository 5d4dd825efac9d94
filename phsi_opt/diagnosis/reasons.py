"""The table of candidates in its order, with the reason why each one lost."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from phsi_opt.criteria import FALSE_DISCOVERY_RATE, HELD_OUT_RISE
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.conclusion import Conclusion
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.proposal import Proposal
from phsi_opt.diagnosis.reason_words import BY_CHANCE


def in_order(
    base: DiagnosedModel,
    candidates: Sequence[Candidate],
    proposed: Proposal | None,
    concluded: Conclusion,
) -> tuple[Candidate, ...]:
    """Candidates with their reasons: what is proposed, what was re-fitted, the others.

    Pairs stand among single effects, by the expected or re-fitted change of BIC.

    Args:
        base: the model that is diagnosed.
        candidates: single effects, best first, then pairs.
        proposed: the best of them; None where none is significant.
        concluded: why that is not named; the classes where it is.
    """
    best = None if proposed is None else proposed.candidate
    rows = [one for one in candidates if best is None or one.name != best.name]
    ordered = [] if best is None else [replace(best, lost=concluded.against)]
    for one in sorted(rows, key=_place):
        lost = one.lost or _reason(base, one, best)
        if best is not None and not one.lost and _is_alike(one, best, concluded):
            lost = f"the data do not tell it from {best.name}"
        ordered.append(replace(one, lost=lost))
    return tuple(ordered)


def _place(one: Candidate) -> tuple[int, float]:
    """Single effects that were re-fitted, in their order; then pairs; then by BIC."""
    if one.fit is not None and one.partner is None:
        return 0, 0.0
    bic = one.delta_bic if np.isfinite(one.delta_bic) else np.inf
    return (1 if one.fit is not None else 2), bic


def _reason(base: DiagnosedModel, one: Candidate, best: Candidate | None) -> str:
    """Why a candidate is not named."""
    if one.was_tried and one.fit is None:
        return "could not be re-fitted"
    if best is not None and _is_part(one, best):
        return "is one of the two that are proposed"
    if best is not None and one.name in best.confusable_with:
        return f"does as well as {best.name}, which is simpler or came first"
    before = base.judged.rmse
    if base.is_held_out and one.held_out_rmse > before:
        rises = one.held_out_rmse > HELD_OUT_RISE * before
        return f"the held-out error {'rises' if rises else 'does not fall'}"
    if not one.p_value < FALSE_DISCOVERY_RATE:
        return f"{BY_CHANCE} (p-value {one.p_value:.1g})"
    if best is None:
        return f"the error on {_judging(base)} does not fall clearly"
    if one.delta_bic > best.delta_bic:
        return f"{best.name} leaves less"
    return f"{best.name} does better on {_judging(base)}, or is simpler"


def _judging(base: DiagnosedModel) -> str:
    """What a model is judged by, in words."""
    return "the data held out" if base.is_held_out else "the training data"


def _is_alike(one: Candidate, best: Candidate, concluded: Conclusion) -> bool:
    """Whether it is the best with another member of a class in place of the first."""
    if len(one.effects) != len(best.effects):
        return False
    for finding in concluded.findings:
        first, *others = finding.effects
        kept = [effect for effect in best.effects if effect != first]
        new = [effect for effect in one.effects if effect not in kept]
        if len(new) == 1 and new[0] in others:
            return True
    return False


def _is_part(one: Candidate, pair: Candidate) -> bool:
    is_pair = pair.partner is not None
    return is_pair and one.partner is None and one.effect in pair.effects

"""The candidates in order: looked at, the best few re-fitted, by BIC and held-out data.

All p-values are adjusted for the number of candidates, so that the share of false names
is controlled (Benjamini and Hochberg, J. R. Stat. Soc. B 57, 1995).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.comparison.model_selection import (
    delta_bic,
    deviance,
    free_run_deviance,
    is_like_noise,
    p_value_of_larger_model,
    share_of_change,
)
from phsi_opt.criteria import (
    BIC_TIE,
    COMPARED_P_VALUE,
    HELD_OUT_RISE,
    HOPELESS_VARIANCE,
    N_UNSETTLED_REFITS,
    REFIT_P_VALUE,
    RIVAL_SCORE,
)
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.doubts import doubt, fitted_size
from phsi_opt.diagnosis.dry_friction import simple_first
from phsi_opt.diagnosis.friction_sharpening import may_extend
from phsi_opt.diagnosis.refit import Refit, RefitRequest
from phsi_opt.diagnosis.refit_round import RefitRound, until_their_turn
from phsi_opt.diagnosis.second_storages import with_second_storages
from phsi_opt.diagnosis.simple_losses import Refitted, begins_at, with_simple_losses
from phsi_opt.estimation.fit import Fit
from phsi_opt.screening.effect_size import size_unit
from phsi_opt.screening.prospects import Prospect, Prospects
from phsi_opt.statistics import false_discovery_adjusted


def ranking(base: DiagnosedModel, prospects: Prospects) -> tuple[Candidate, ...]:
    """All single candidates, best first: those that were re-fitted before the others.

    Args:
        base: the model that is diagnosed.
        prospects: what second looks expect of each effect.
    """
    refitted = _best_refitted(base, prospects)
    refitting = _refitting(base, prospects)
    refitted = with_second_storages(base, prospects, refitted, refitting)
    refitted = with_simple_losses(base, prospects, refitted, refitting)
    ranked = _ranked(base, prospects, refitted)
    tried = [candidate.effect for candidate in ranked]
    others = []
    for one in prospects.singles:
        if one.effect not in tried:
            others.append(expected(base, prospects, one))
    return _adjusted([*ranked, *others])


def _refitting(base: DiagnosedModel, prospects: Prospects) -> Refitted:
    """Re-fits prospects, from their own start or from the states of another fit."""

    def refitted(
        found: Sequence[Prospect], at: Fit | None, rival: Candidate | None
    ) -> list[Candidate]:
        requests = {}
        for place, one in enumerate(found):
            request = request_of(one, None if rival is None else rival.fit, [])
            states = begins_at(base, at)
            if at is not None and states is not None:
                request = replace(request, base_values=at.model.values, states=states)
            requests[place] = request
        result = []
        with RefitRound(base, requests) as refits:
            for place, one in enumerate(found):
                base.say(f"re-fitting with {one.name}")
                done = refits.refit(place, requests[place])
                result.append(_tried(base, prospects, one, done))
        return result

    return refitted


def _tried(
    base: DiagnosedModel, prospects: Prospects, one: Prospect, done: Refit | None
) -> Candidate:
    """A single effect with what came out of its re-fit, if it did not fail."""
    candidate = expected(base, prospects, one)
    if done is None:
        return replace(candidate, was_tried=True)
    return as_refitted(base, candidate, done, one.n_tried)


def expected(base: DiagnosedModel, prospects: Prospects, one: Prospect) -> Candidate:
    """A candidate before its re-fit, with what would do as well as it."""
    trained = base.rmse_of(one.misfit, base.trained)
    judged = trained
    if base.is_held_out:
        judged = base.rmse_of(one.held_out, base.judged)
    return Candidate(
        effect=one.effect,
        partner=one.effects[1] if len(one.effects) > 1 else None,
        coefficient=one.coefficient,
        std_error=one.std_error,
        unit=size_unit(base.fit.model, one.effect, base.record.data.units),
        values=one.values,
        confusable_with=_alike(prospects, one),
        p_value=one.p_value,
        delta_bic=prospects.delta_bic(one, one.share),
        train_rmse=trained,
        held_out_rmse=judged if base.is_held_out else np.nan,
        share=base.share_explained(judged),
    )


def _alike(prospects: Prospects, one: Prospect) -> tuple[str, ...]:
    """Names of the single effects whose trace stands in for that of another."""
    if len(one.effects) > 1 or not one.p_value < COMPARED_P_VALUE:
        return ()
    alike = []
    for other in prospects.singles:
        if other is not one and prospects.test.stands_in(
            one.screened[0], other.screened[0]
        ):
            alike.append(other.name)
    return tuple(alike)


def _best_refitted(base: DiagnosedModel, prospects: Prospects) -> list[Candidate]:
    """The best few, re-fitted; after one that leaves noise only its rivals."""
    chosen = _worth_refitting(base, prospects)
    rows = list(takewhile(_is_worth(base, prospects), simple_first(chosen)))
    rival = _Rival()
    result: list[Candidate] = []
    with RefitRound(base, _begun(base, rows, chosen)) as refits:
        for place, one in enumerate(rows):
            left = max(one.misfit, prospects.n_values)
            if rival.is_out_of_reach(prospects.score(one), left):
                break
            base.say(f"re-fitting with {one.name}")
            known = [done.fit for done in result if done.fit is not None]
            request = request_of(one, rival.fit, known, one is chosen[0])
            done = refits.refit(place, request)
            result.append(_tried(base, prospects, one, done))
            if done is not None:
                rival = rival.after(base, done, prospects.score(one), left)
    return result


def _is_worth(base: DiagnosedModel, prospects: Prospects) -> Callable[[Prospect], bool]:
    """Tells effects worth a re-fit beside a model that leaves noise from others."""
    if not is_like_noise(base.trained):
        return lambda one: True
    n_found = len(prospects.singles)
    return lambda one: one.p_value * n_found < REFIT_P_VALUE


def _begun(
    base: DiagnosedModel, rows: Sequence[Prospect], chosen: Sequence[Prospect]
) -> dict[int, RefitRequest]:
    """By place, the re-fits that do not begin at an earlier one of the round."""
    found = {}
    for place, one in enumerate(rows):
        smaller = rows[:place]
        if not any(may_extend(base, one.effects, other.effects) for other in smaller):
            found[place] = request_of(one, None, [], one is chosen[0])
    return until_their_turn(found)


def _worth_refitting(base: DiagnosedModel, prospects: Prospects) -> list[Prospect]:
    """The effects that are re-fitted, best first.

    What chance explains as well, among so many values scanned, comes last. What raises
    the error on data held out is left out, and all but the best of those whose second
    look did not settle: all of them where such a look says that there is nothing.
    """
    rows = sorted(prospects.singles, key=lambda one: one.p_value >= 1.0)
    most_unsettled = N_UNSETTLED_REFITS if base.may_be_far_from_linear else 0
    chosen = []
    n_unsettled = 0
    for one in rows:
        if _is_refuted(base, one):
            continue
        if one.look is None:
            n_unsettled += 1
            if n_unsettled > most_unsettled:
                continue
        chosen.append(one)
    return chosen[: base.most_refits]


def _is_refuted(base: DiagnosedModel, one: Prospect) -> bool:
    """Whether an effect is expected to raise the error on data held out.

    It is not re-fitted, and does not do as well as one that was.
    """
    return base.is_held_out and one.held_out > HELD_OUT_RISE * base.judged_misfit


def request_of(
    one: Prospect, rival: Fit | None, known: Sequence[Fit], is_likely: bool = False
) -> RefitRequest:
    """A re-fit that begins where a second look ended."""
    return RefitRequest(
        effects=one.effects,
        values=one.values,
        base_values=one.base_values,
        states=None if one.look is None else one.look.states,
        rival=rival,
        known=known,
        is_likely=is_likely,
    )


@dataclass(frozen=True, eq=False)
class _Rival:
    """The best candidate so far, which others must be able to reach.

    Attributes:
        fit: what leaves noise as it is, others before their corners are sharpened.
        misfit: the least expected one of those that leave noise.
        score: the highest of those that leave noise.
    """

    fit: Fit | None = None
    misfit: float = np.inf
    score: float = -np.inf

    def is_out_of_reach(self, score: float, misfit: float) -> bool:
        """Whether a candidate promises too little beside one that leaves noise."""
        is_behind = score < RIVAL_SCORE * self.score - BIC_TIE
        return is_behind or misfit > HOPELESS_VARIANCE * self.misfit

    def after(
        self, base: DiagnosedModel, done: Refit, score: float, misfit: float
    ) -> "_Rival":
        """The best candidate when one more was re-fitted."""
        fit = done.before_sharpening
        rival = self
        if base.is_left_with_noise(done.trained):
            fit = done.fit
            rival = replace(
                self, misfit=min(self.misfit, misfit), score=max(self.score, score)
            )
        if fit is None:
            return rival
        if self.fit is None or delta_bic(self.fit, fit, 1.0) < 0:
            return replace(rival, fit=fit)
        return rival


def as_refitted(
    base: DiagnosedModel, candidate: Candidate, done: Refit, n_tried: int
) -> Candidate:
    """The candidate with what came out of its re-fit.

    Args:
        base: the model that is diagnosed.
        candidate: before the re-fit.
        done: the re-fit.
        n_tried: how many values or effects were tried before.
    """
    size = fitted_size(base.fit, done.fit, candidate.effect)
    share = share_of_change(base.trained, done.trained)
    of_one = p_value_of_larger_model(base.fit, done.fit, share)
    return replace(
        candidate,
        coefficient=size.value,
        std_error=size.std_error,
        fit=done.fit,
        trained=done.trained,
        comparison=done.judged,
        p_value=min(n_tried * of_one, 1.0),
        delta_bic=delta_bic(base.fit, done.fit, share),
        train_rmse=done.trained.rmse,
        held_out_rmse=done.judged.rmse,
        share=base.share_explained(done.judged.rmse),
        lost=doubt(base, done.fit, candidate.effects),
        was_tried=True,
    )


@dataclass(frozen=True, eq=False)
class _Row:
    """A re-fitted candidate with its change of BIC."""

    candidate: Candidate
    fit: Fit
    trained: Comparison
    bic: float = np.nan


def _ranked(
    base: DiagnosedModel, prospects: Prospects, refitted: list[Candidate]
) -> list[Candidate]:
    """By BIC; those that were not re-fitted last.

    The share of independent residuals of the best one is taken for all. Of those that
    BIC hardly tells apart the simplest comes first, and those of one size exchange
    places by what they leave on the data held out. What is not to be believed is last.
    """
    rows = []
    for candidate in refitted:
        if candidate.fit is not None and candidate.trained is not None:
            rows.append(_Row(candidate, candidate.fit, candidate.trained))
    if not rows:
        return refitted
    best = min(rows, key=lambda row: deviance(row.fit))
    share = share_of_change(base.trained, best.trained)
    rows = [replace(row, bic=delta_bic(base.fit, row.fit, share)) for row in rows]
    handicap = [base.handicap(row.candidate.effects) for row in rows]
    rows = [
        replace(row, bic=row.bic + h) for row, h in zip(rows, handicap, strict=True)
    ]
    rows.sort(key=lambda row: (bool(row.candidate.lost), row.bic))
    best_bic = rows[0].bic
    n_close = sum(_is_close(row, best_bic) for row in rows)
    close = _by_held_out(base, rows[:n_close], share)
    close.sort(key=lambda row: row.candidate.effect.n_unknowns)
    ordered = []
    for row in [*close, *rows[n_close:]]:
        bic = row.bic - base.handicap(row.candidate.effects)
        ordered.append(replace(row.candidate, delta_bic=bic))
    rivals = _rivals(base, prospects, ordered, share)
    known = [candidate.name for candidate in ordered]
    refuted = []
    for one in prospects.singles:
        if _is_refuted(base, one) and one.name not in known:
            refuted.append(one.name)
    result = []
    for candidate in ordered:
        tied = [name for name in _tied(base, candidate, rivals) if name not in refuted]
        result.append(replace(candidate, confusable_with=tuple(tied)))
    return result + [candidate for candidate in refitted if candidate.fit is None]


def _is_close(row: _Row, best_bic: float) -> bool:
    return not row.candidate.lost and row.bic < best_bic + BIC_TIE


def _by_held_out(base: DiagnosedModel, close: list[_Row], share: float) -> list[_Row]:
    """Those of one size exchange places by what they leave on the data held out."""

    def total(row: _Row) -> float:
        return row.bic + share * _held_out_deviance(base, row.candidate)

    by_size: dict[int, list[_Row]] = {}
    for row in sorted(close, key=total):
        by_size.setdefault(len(row.fit.names), []).append(row)
    return [by_size[len(row.fit.names)].pop(0) for row in close]


def _held_out_deviance(base: DiagnosedModel, candidate: Candidate) -> float:
    """What the candidate leaves on the data held out; zero where there are none."""
    if not base.is_held_out or candidate.comparison is None:
        return 0.0
    return free_run_deviance(candidate.comparison)


@dataclass(frozen=True)
class _Known:
    """Change of BIC by an effect, and by how much it must beat others."""

    bic: float
    handicap: float


def _rivals(
    base: DiagnosedModel,
    prospects: Prospects,
    refitted: Sequence[Candidate],
    share: float,
) -> dict[str, _Known]:
    """What is known of effects by name: re-fitted, or expected by a second look."""
    found = {}
    for one in prospects.singles:
        if one.look is not None:
            bic = prospects.delta_bic(one, share)
            found[one.name] = _Known(bic, base.handicap(one.effects))
    for candidate in refitted:
        handicap = base.handicap(candidate.effects)
        found[candidate.name] = _Known(candidate.delta_bic, handicap)
    return found


def _tied(
    base: DiagnosedModel, one: Candidate, rivals: dict[str, _Known]
) -> tuple[str, ...]:
    """What the data cannot tell from it: by BIC, or by its trace where that is all."""
    own = base.handicap(one.effects)
    close = []
    for name, rival in rivals.items():
        behind = rival.bic - one.delta_bic
        ahead_by = BIC_TIE + max(rival.handicap - own, 0.0)
        if name != one.name and -ahead_by < behind < BIC_TIE:
            close.append(name)
    by_trace = [name for name in one.confusable_with if name not in rivals]
    return tuple(dict.fromkeys([*close, *by_trace]))


def _adjusted(candidates: list[Candidate]) -> tuple[Candidate, ...]:
    """P-values adjusted for the number of candidates."""
    if not candidates:
        return ()
    adjusted = false_discovery_adjusted([candidate.p_value for candidate in candidates])
    pairs = zip(candidates, adjusted, strict=True)
    return tuple(replace(candidate, p_value=float(p)) for candidate, p in pairs)

"""The candidates in order: screened, the best few re-fitted, by BIC and held-out data.

All p-values are adjusted for the number of candidates, so that the share of false names
is controlled (Benjamini and Hochberg, J. R. Stat. Soc. B 57, 1995).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
    HOPELESS_VARIANCE,
    N_REFITS,
    REFIT_P_VALUE,
    RIVAL_SCORE,
)
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.dry_friction import simple_first
from phsi_opt.diagnosis.refit import Refit, RefitRequest, refit
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import is_wave
from phsi_opt.screening.score_test import ScoreTest, Screened
from phsi_opt.statistics import TINY, false_discovery_adjusted


def ranking(
    base: DiagnosedModel, test: ScoreTest, found: Sequence[Screened]
) -> tuple[Candidate, ...]:
    """All candidates, best first: those that were re-fitted before those that were not.

    Args:
        base: the model that is diagnosed.
        test: of the training record.
        found: what screening expects of each effect, most convincing first.
    """
    screened = [_as_screened(one, found, test) for one in found]
    refitted = _ranked(base, _best_refitted(base, test, screened, found))
    tried = [candidate.effect for candidate in refitted]
    others = [candidate for candidate in screened if candidate.effect not in tried]
    return _adjusted([*refitted, *others])


def _as_screened(
    one: Screened, found: Sequence[Screened], test: ScoreTest
) -> Candidate:
    """The candidate before its re-fit, with those that leave the same trace."""
    alike = []
    if one.p_value < COMPARED_P_VALUE:
        for other in found:
            if other is not one and test.stands_in(one, other):
                alike.append(str(other.effect))
    return Candidate(
        effect=one.effect,
        coefficient=one.coefficient,
        std_error=one.std_error,
        drop=one.drop,
        values=one.values,
        confusable_with=tuple(alike),
        p_value=one.p_value,
    )


def _best_refitted(
    base: DiagnosedModel,
    test: ScoreTest,
    screened: Sequence[Candidate],
    found: Sequence[Screened],
) -> list[Candidate]:
    """The best few, re-fitted; after one that leaves noise only its rivals."""
    pairs = zip(screened, found, strict=True)
    # What chance explains as well, among so many values scanned, comes last.
    rows = sorted(pairs, key=lambda row: row[1].p_value >= 1.0)
    if not rows:
        return []
    likeliest = rows[0][0]
    rival = _Rival()
    is_failing = not is_like_noise(base.trained)
    result: list[Candidate] = []
    for candidate, one in simple_first(rows[:N_REFITS]):
        expected = max(test.misfit - one.drop, test.n_values)
        is_worth = is_failing or one.p_value * len(found) < REFIT_P_VALUE
        if not is_worth or rival.is_out_of_reach(test.score(one), expected):
            break
        base.say(f"re-fitting with {candidate.effect}")
        request = RefitRequest(
            effects=[candidate.effect],
            values=candidate.values,
            base_values=one.base_values,
            rival=rival.fit,
            known=[done.fit for done in result if done.fit is not None],
            is_likely=candidate is likeliest,
        )
        found_fit = refit(base, request)
        if found_fit is None:
            result.append(replace(candidate, was_tried=True))
            continue
        result.append(_as_refitted(base, candidate, one, found_fit))
        rival = rival.after(found_fit, test.score(one), expected)
    return result


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

    def after(self, done: Refit, score: float, misfit: float) -> "_Rival":
        """The best candidate when one more was re-fitted."""
        fit = done.before_sharpening
        rival = self
        if is_like_noise(done.trained):
            fit = done.fit
            rival = replace(
                self, misfit=min(self.misfit, misfit), score=max(self.score, score)
            )
        if fit is None:
            return rival
        if self.fit is None or delta_bic(self.fit, fit, 1.0) < 0:
            return replace(rival, fit=fit)
        return rival


def _as_refitted(
    base: DiagnosedModel, candidate: Candidate, one: Screened, done: Refit
) -> Candidate:
    """The candidate with what came out of its re-fit."""
    size = _size(base.fit, done.fit, candidate)
    share = share_of_change(base.trained, done.trained)
    p_value = one.n_tried * p_value_of_larger_model(base.fit, done.fit, share)
    return replace(
        candidate,
        coefficient=size.value,
        std_error=size.std_error,
        fit=done.fit,
        trained=done.trained,
        comparison=done.judged,
        p_value=p_value,
        was_tried=True,
    )


@dataclass(frozen=True)
class _Size:
    """Size of an effect, in the unit of its coefficient, and its standard error."""

    value: float
    std_error: float


def _size(old: Fit, new: Fit, candidate: Candidate) -> _Size:
    """Coefficient and standard error; the amplitude of a wave, the last of several."""
    names = _new_names(old, new)
    linear = [name for name in names if new.model.entries[name].prunable]
    linear = linear or names[:1]
    places = [new.names.index(name) for name in linear if name in new.names]
    values = np.array([new.estimates[new.names[place]] for place in places])
    covariance = new.covariance[np.ix_(places, places)]
    if not (is_wave(candidate.effect) and len(linear) == 2):
        return _Size(float(values[-1]), float(np.sqrt(covariance[-1, -1])))
    amplitude = float(np.linalg.norm(values))
    direction = values / max(amplitude, TINY)
    variance = direction @ covariance @ direction
    return _Size(amplitude, float(np.sqrt(variance)))


def _new_names(old: Fit, new: Fit) -> list[str]:
    """Names of the estimated parameters that only the larger model has."""
    names = []
    for name, entry in new.model.entries.items():
        if name not in old.model.entries and not entry.parameter.fixed:
            names.append(name)
    return names


@dataclass(frozen=True, eq=False)
class _Row:
    """A re-fitted candidate with its change of BIC."""

    candidate: Candidate
    fit: Fit
    trained: Comparison
    bic: float = np.nan


def _ranked(base: DiagnosedModel, refitted: list[Candidate]) -> list[Candidate]:
    """By BIC; those that were not re-fitted last.

    The share of independent residuals of the best one is taken for all. Those that BIC
    hardly tells apart and that have as many parameters exchange places by what they
    leave on the data held out; a larger one is not preferred for what it bends to fit
    there. Where none leaves noise, all are wrong, and the simplest comes first.
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
    rows.sort(key=lambda row: row.bic)
    n_close = sum(row.bic < rows[0].bic + BIC_TIE for row in rows)
    close = rows[:n_close]
    if any(is_like_noise(row.trained) for row in rows):
        close = _by_held_out(base, close, share)
    else:
        close.sort(key=lambda row: len(row.fit.names))
    ordered = []
    for row in [*close, *rows[n_close:]]:
        ordered.append(replace(row.candidate, delta_bic=row.bic))
    result = []
    for candidate in ordered:
        tied = _tied(candidate, ordered)
        result.append(replace(candidate, confusable_with=tied))
    return result + [candidate for candidate in refitted if candidate.fit is None]


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


def _tied(one: Candidate, refitted: list[Candidate]) -> tuple[str, ...]:
    """What the data cannot tell from it: by BIC after the re-fits, or by its trace."""
    close = []
    for other in refitted:
        is_close = abs(other.delta_bic - one.delta_bic) < BIC_TIE
        if other is not one and is_close:
            close.append(str(other.effect))
    far = {str(other.effect) for other in refitted} - set(close)
    by_trace = [name for name in one.confusable_with if name not in far]
    return tuple(dict.fromkeys([*close, *by_trace]))


def _adjusted(candidates: list[Candidate]) -> tuple[Candidate, ...]:
    """P-values adjusted for the number of candidates."""
    if not candidates:
        return ()
    adjusted = false_discovery_adjusted([candidate.p_value for candidate in candidates])
    pairs = zip(candidates, adjusted, strict=True)
    return tuple(replace(candidate, p_value=float(p)) for candidate, p in pairs)

"""The losses of one number, where the best candidate leaves more than noise.

What a second look says of a law may be wrong, and so may the optimum of a re-fit, as
along a pendulum that goes over the top. No law is named whose simplest rivals were not
re-fitted, once from their own start and once from the states of the best of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from phsi_opt.comparison.model_selection import delta_bic, is_like_noise
from phsi_opt.criteria import BIC_TIE
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.regressed_start import regressed
from phsi_opt.estimation.fit import Fit
from phsi_opt.initialization.relative_guesses import resolve_guesses
from phsi_opt.model.catalogue_forces import HYSTERESIS
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.screening.effect_size import new_names
from phsi_opt.screening.prospects import Prospect, Prospects
from phsi_opt.statistics import TINY

# Candidates re-fitted: from their own start, or from the states of another fit; dry
# friction is made sharp only where it beats the best candidate so far, if there is one.
Refitted = Callable[[Sequence[Prospect], Fit | None, Candidate | None], list[Candidate]]


def with_simple_losses(
    base: DiagnosedModel,
    prospects: Prospects,
    candidates: Sequence[Candidate],
    refitted: Refitted,
) -> list[Candidate]:
    """The candidates, and the simple losses of the equation of the best.

    Args:
        base: the model that is diagnosed.
        prospects: its larger models.
        candidates: those that were re-fitted.
        refitted: makes re-fits of more.
    """
    result = list(candidates)
    best = _best(result)
    if is_like_noise(base.trained):
        return result
    if best is None:
        if not base.is_far_off:
            return result
        return _regressed_losses(base, prospects, result, refitted)
    equation = best.effect.equation
    losses = []
    for one in prospects.singles:
        if is_simple_loss(one.effect) and one.effect.equation == equation:
            losses.append(one)
    # Hysteresis bends to any loss, and may hide a simple one.
    if best.effect.name == HYSTERESIS:
        for one in losses:
            result = _again(base, result, refitted, one, best)
    if base.is_left_with_noise(best.trained):
        return result
    tried = [one.name for one in result]
    untried = [one for one in losses if one.name not in tried]
    result += refitted(untried, None, best)
    best = _best(result)
    if best is None or best.fit is None or not is_simple_loss(best.effect):
        return result
    for one in losses:
        if one.effect.family == best.effect.family and one.name != best.name:
            result = _again(base, result, refitted, one, best)
    return result


def _regressed_losses(
    base: DiagnosedModel,
    prospects: Prospects,
    candidates: list[Candidate],
    refitted: Refitted,
) -> list[Candidate]:
    """The candidates, and the losses begun where the missing force says.

    For a model that no candidate helps: it may have lost its way.
    """
    starts = []
    for one in prospects.singles:
        if not is_simple_loss(one.effect):
            continue
        values = regressed(base, one.effect)
        own = set(values) & set(base.fit.model.entries)
        start = replace(
            one,
            values={name: values[name] for name in values if name not in own},
            base_values={name: values[name] for name in own},
            look=None,
        )
        starts.append(start)
    names = [one.name for one in starts]
    others = [known for known in candidates if known.name not in names]
    return others + refitted(starts, None, None)


def is_simple_loss(effect: Effect) -> bool:
    """Whether an effect is a loss of one number."""
    return effect.slot == "R" and effect.n_unknowns == 1


def _best(candidates: Sequence[Candidate]) -> Candidate | None:
    """The re-fitted candidate of the lowest BIC that is to be believed."""
    found = [one for one in candidates if one.fit is not None and not one.lost]
    return min(found, key=lambda one: one.delta_bic, default=None)


def _again(
    base: DiagnosedModel,
    candidates: list[Candidate],
    refitted: Refitted,
    one: Prospect,
    best: Candidate,
) -> list[Candidate]:
    """The candidates; where one is far behind the best, re-fitted from its states."""
    present = next((known for known in candidates if known.name == one.name), None)
    if best.fit is None:
        return candidates
    if present is not None and present.delta_bic < best.delta_bic + BIC_TIE:
        return candidates
    value = matched(base, best.fit, best.effect, one.effect)
    (another,) = refitted([replace(one, values=value)], best.fit, best)
    if another.fit is None:
        return candidates
    if present is None:
        return [*candidates, another]
    if present.fit is not None and delta_bic(present.fit, another.fit, 1.0) > 0:
        return candidates
    return [another if known is present else known for known in candidates]


def matched(
    base: DiagnosedModel, fit: Fit, effect: Effect, other: Effect
) -> dict[str, float]:
    """Value of another loss whose force is nearest to that of a loss in a fit.

    Least squares of the two forces along the states of the fit.
    """
    model = base.fit.model
    # The coefficient comes first, then what is known of a law, such as its corner.
    known = new_names(model, effect, fit.names)[0]
    larger = fit.model.with_values({known: 0.0}).add(other)
    grid = base.record.estimate.grid
    larger = resolve_guesses(larger, grid, np.concatenate(list(fit.states)))
    sought = new_names(fit.model, other, larger.entries)[0]
    without = _rates(base, larger.with_values({sought: 0.0}), fit)
    of_unit = _rates(base, larger.with_values({sought: 1.0}), fit) - without
    full = fit.model.values[known]
    of_fit = _rates(base, larger.with_values({known: full, sought: 0.0}), fit) - without
    size = np.sum(of_unit * of_fit) / max(np.sum(of_unit**2), TINY)
    return {sought: float(size)}


def _rates(base: DiagnosedModel, model: Model, fit: Fit) -> np.ndarray:
    """dx/dt of a model along the states of a fit, (n_states, n_nodes)."""
    grid = base.record.estimate.grid
    x = np.concatenate([np.asarray(run) for run in fit.states])
    theta = np.array([model.values[name] for name in model.free])
    rates = model.rhs()(x.T, grid.u.T, grid.t[None, :], theta)
    return np.asarray(rates)


def begins_at(base: DiagnosedModel, fit: Fit | None) -> np.ndarray | None:
    """States of a fit, (n_nodes, n_states), for a re-fit; None where grids differ."""
    if fit is None:
        return None
    states = np.concatenate([np.asarray(run) for run in fit.states])
    own = base.record.estimate.x.shape
    return states if states.shape == own else None

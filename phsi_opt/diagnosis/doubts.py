"""Why a re-fitted effect is not believed, whatever error it removes.

An effect whose size is uncertain by as much as itself, that drives another parameter to
its bound, or whose own scale lies outside of the record, bends to fit what something
else did.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import (
    BELIEVED_MISFIT,
    BESIDE_OTHERS_Z,
    CHANCE_LEVEL,
    CLOCK_BESIDE_Z,
    CONFIRMED_Z,
    ESTABLISHED_Z,
    LEAST_PERIODS,
    LEAST_TURNED,
    OUT_OF_PHASE,
    PROPOSED_Z,
    TELLING_ERROR,
)
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.catalogue_forces import HYSTERESIS
from phsi_opt.model.effect import Effect, is_wave
from phsi_opt.model.structure import effort_of
from phsi_opt.model_error.standard_errors import Source
from phsi_opt.presentation.durations import time_words
from phsi_opt.screening.effect_size import Size, new_names, size_of, size_unit
from phsi_opt.screening.second_look import Look, independent_share, second_look
from phsi_opt.statistics import TINY


def fitted_size(base: Fit, fit: Fit, effect: Effect) -> Size:
    """Size of an effect in a re-fit of a base model."""
    names = new_names(base.model, effect, fit.names)
    places = [fit.names.index(name) for name in names]
    covariance = fit.covariance[np.ix_(places, places)]
    size = size_of(effect, fit.model, names, fit.estimates, covariance)
    freedom = float(np.min(fit.degrees_of_freedom[places], initial=np.inf))
    unit = size_unit(base.model, effect, fit.units)
    return replace(size, unit=unit, freedom=freedom)


def z_beside_others(base: DiagnosedModel, effect: Effect) -> float:
    """Standard errors by which a size must differ from zero beside other causes."""
    return CLOCK_BESIDE_Z if base.handicap((effect,)) else BESIDE_OTHERS_Z


def doubt(base: DiagnosedModel, fit: Fit, effects: Sequence[Effect]) -> str:
    """Why effects of a re-fit are not proposed; empty where nothing is against them."""
    driven = _driven_to_bounds(base.fit, fit, effects)
    if driven:
        return f"it drives {', '.join(driven)} to a bound"
    for effect in effects:
        names = new_names(base.fit.model, effect, fit.names)
        at_bound = [name for name in names if name in fit.outcome.at_bounds]
        if at_bound:
            return f"{_in_words(at_bound)} of {effect} ended at a bound"
        size = fitted_size(base.fit, fit, effect)
        if not np.isfinite(size.std_error):
            return f"the data do not tell the size of {effect}"
        if not size.z >= PROPOSED_Z:
            return f"the size of {effect}, {size}, may as well be zero"
        if is_wave(effect):
            period = _period(fit, names)
            if period * LEAST_PERIODS > longest_duration(base.record.data):
                told = time_words(period, base.record.data.units.get("t", ""))
                return f"its period, {told}, is longer than the record shows"
        if effect.name == HYSTERESIS and _turned_share(base, effect) < LEAST_TURNED:
            effort = effort_of(base.fit.model, effect.equation)
            return f"{effort} never turns back, without which {effect} is not shown"
    return ""


def _in_words(names: Sequence[str]) -> str:
    """Parameters of an effect: its size, and inner ones by their own names."""
    own = []
    for name in names:
        _, _, inner = name.partition(".")
        own.append(inner or "the size")
    return " and ".join(own)


def _turned_share(base: DiagnosedModel, effect: Effect) -> float:
    """Share of the record in which an effort has the rarer one of its two signs."""
    model = base.fit.model
    estimate = base.record.estimate
    grid = estimate.grid
    effort = model.function(effort_of(model, effect.equation))
    values = effort(estimate.x.T, grid.u.T, grid.t[None, :], model.theta)
    positive = float(np.mean(np.asarray(values) > 0))
    return min(positive, 1 - positive)


def _driven_to_bounds(old: Fit, new: Fit, effects: Sequence[Effect]) -> list[str]:
    """Parameters of the base that only the re-fit has at a bound.

    But for those of a term in a slot where an effect is added: one kind of loss may
    take the place of another, a hysteresis not that of a spring.
    """
    slots = {effect.slot for effect in effects}
    driven = []
    for name in new.outcome.at_bounds:
        if name not in old.names or name in old.outcome.at_bounds:
            continue
        if new.entry(name).slot not in slots:
            driven.append(name)
    return driven


def found_by_chance(
    base: Fit, members: Sequence[tuple[Effect, Fit]], n_kinds: int
) -> str:
    """Why an effect may be found because so many were tried; empty where it is not.

    The p-value of its size, times the number of kinds of effects (Bonferroni), where
    model error shows: the likelihood ratio counts residuals as noise, and a brief
    record has few values that tell how uncertain a size is (Student's t). Of effects
    that the data cannot tell apart the clearest counts.

    Args:
        base: the model without them.
        members: the effect with the re-fit that it is in, then those that do as well.
        n_kinds: how many kinds of effects were compared (`kinds_of`).
    """
    effect, fit = members[0]
    if fit.std_error_source == Source.NOISE:
        return ""
    sizes = [fitted_size(base, with_it, one) for one, with_it in members]
    p_value = n_kinds * min(
        _p_value(one, size) for (one, _), size in zip(members, sizes, strict=True)
    )
    if p_value < CHANCE_LEVEL:
        return ""
    return (
        f"with {n_kinds} kinds of candidates, model error may look like a size of "
        f"{effect} of {sizes[0]} by chance (p-value of the size, by Student's t: "
        f"{min(p_value, 1.0):.1g})"
    )


def _p_value(effect: Effect, size: Size) -> float:
    """Of the hypothesis that there is none; a loss can only take energy (one-sided)."""
    return size.p_value / 2 if effect.slot == "R" else size.p_value


def kinds_of(effects: Iterable[Effect]) -> set[tuple[str, str]]:
    """The family and equation of effects: laws of one family there are nearly one."""
    return {(effect.family, effect.equation) for effect in effects}


def unconfirmed(
    base: DiagnosedModel, fit: Fit, judged: Comparison, effects: Sequence[Effect]
) -> str:
    """Why effects that are proposed are not established; empty where they are.

    The size of each must differ clearly from zero under what acts beside the model, and
    where the data held out alone tell it, it must differ from zero there too, with the
    same sign.

    Args:
        base: the model that is diagnosed.
        fit: with the effects; ``judged``: its free run on the data that judge.
        effects: what was added.
    """
    for effect in effects:
        size = fitted_size(base.fit, fit, effect)
        if not size.z >= ESTABLISHED_Z:
            return f"the size of {effect}, {size}, is not clear enough"
    if not base.is_held_out:
        return ""
    record = base.judged.record
    before = second_look(record, (), {})
    after = second_look(record, effects, fit.model.values)
    if before is None or after is None:
        return ""
    if after.misfit > BELIEVED_MISFIT * judged.misfit:
        return ""  # with parameters of its own it should leave less than with these
    share = independent_share(before, after)
    for effect in effects:
        size = fitted_size(base.fit, fit, effect)
        there = after.size(effect, record.model, share)
        if there.std_error > TELLING_ERROR * abs(size.value):
            continue  # these data hardly show it
        if is_wave(effect):
            is_same = _is_in_phase(base.fit, fit, after, effect)
        else:
            is_same = there.value * size.value > 0
        if not is_same or there.z < CONFIRMED_Z:
            return f"the data held out give {effect} the size {there}, not {size}"
    return ""


def _is_in_phase(base: Fit, fit: Fit, there: Look, effect: Effect) -> bool:
    """Whether a wave has its phase on other data too: what is random has not."""
    names = new_names(base.model, effect, fit.names)
    linear = [name for name in names if fit.model.entries[name].prunable]
    here = np.array([fit.estimates[name] for name in linear])
    other = np.array([there.model.values[name] for name in linear])
    apart = np.linalg.norm(here - other)
    return bool(apart < OUT_OF_PHASE * np.linalg.norm(here))


def _period(fit: Fit, names: Sequence[str]) -> float:
    """Period of a wave, in the unit of the time."""
    for name in names:
        if not fit.model.entries[name].prunable:
            return 2 * np.pi / max(abs(fit.estimates[name]), TINY)
    return 0.0


def longest_duration(data: Measurements) -> float:
    """Of the trajectories, in the unit of the time."""
    return max(float(run.t[-1] - run.t[0]) for run in data.trajectories)

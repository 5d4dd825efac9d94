"""Size of an effect: its coefficient, or the amplitude of a wave, and how certain."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from phsi_opt.criteria import SURE_DEVIATIONS
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import Effect, is_decay, is_wave
from phsi_opt.model.functions import along_function, is_function, is_unknown
from phsi_opt.model.model import Model
from phsi_opt.model.parameter_units import parameter_units
from phsi_opt.presentation.numbers import estimate_text, number, time_constant_words
from phsi_opt.presentation.units import scale_of
from phsi_opt.statistics import TINY

NOT_DETERMINED = "size not determined"


@dataclass(frozen=True)
class Size:
    """Size of an effect, its standard error, and their unit if it is known."""

    value: float
    std_error: float
    unit: str = ""

    def in_unit(self, unit: str) -> "Size":
        """The same in a unit, as `scale_of` tells it."""
        scale = scale_of(unit)
        return Size(self.value / scale.size, self.std_error / scale.size, scale.unit)

    def words(self, effect: Effect) -> str:
        """As text; of a rate at which a state decays its time constant."""
        if is_function(effect):
            return f"reaches {self}"
        if is_unknown(effect) or not is_decay(effect):
            return str(self)
        return time_constant_words(self.value, self.std_error, self.unit) or str(self)

    @property
    def z(self) -> float:
        """Standard errors from zero; NaN where the standard error is not known."""
        return abs(self.value) / max(self.std_error, TINY)

    def __str__(self) -> str:
        is_smaller = abs(self.value) < self.std_error < np.inf  # or it is not known
        if is_smaller or not np.isfinite(self.value):
            return NOT_DETERMINED
        if not np.isfinite(self.std_error):
            return f"{number(self.value)} {self.unit}".rstrip()
        return estimate_text(self.value, self.std_error, self.unit)


def new_names(base: Model, effect: Effect, known: Iterable[str]) -> list[str]:
    """Names of the free parameters that an effect adds to a model."""
    estimated = set(known)
    names = []
    for name in base.add(effect).entries:
        if name not in base.entries and name in estimated:
            names.append(name)
    return names


def with_no_size(base: Model, *effects: Effect) -> Model:
    """The larger model with coefficients of zero: the base, as far as it contains it.

    A coefficient that is always above or below zero begins at its bound.
    """
    larger = reduce(Model.add, effects, base)
    values = {}
    for name in set(larger.free) - base.entries.keys():
        entry = larger.entries[name]
        if entry.prunable:
            bounds = (entry.parameter.lower, entry.parameter.upper)
            values[name] = float(np.clip(0.0, *bounds))
    return larger.with_values(values)


def names_beside_size(base: Model, effect: Effect, known: Iterable[str]) -> list[str]:
    """Names of the parameters that an effect adds beside its size, as `new_names`."""
    names = new_names(base, effect, known)
    linear = _coefficients(base.add(effect), names) if names else []
    told = linear if is_wave(effect) else linear[-1:]
    return [name for k, name in enumerate(names) if k not in told]


def size_of(
    effect: Effect,
    model: Model,
    names: Sequence[str],
    values: Mapping[str, float],
    covariance: np.ndarray,
) -> Size:
    """Size of an effect; the last of several coefficients, else an inner parameter.

    Of an unknown function its value where this is most surely large.
    """
    if not names:
        return Size(np.nan, np.nan)
    linear = _coefficients(model, names)
    found = np.array([values[names[k]] for k in linear])
    within = covariance[np.ix_(linear, linear)]
    if is_function(effect):
        _, shapes = along_function(effect)
        along = shapes @ found
        spread = np.sqrt(np.maximum(np.sum(shapes @ within * shapes, axis=1), 0.0))
        place = int(np.argmax(np.abs(along) - SURE_DEVIATIONS * spread))
        return Size(float(along[place]), float(spread[place]))
    if not (is_wave(effect) and len(found) == 2):
        return Size(float(found[-1]), _deviation(within[-1, -1]))
    amplitude = float(np.linalg.norm(found))
    direction = found / max(amplitude, TINY)
    return Size(amplitude, _deviation(direction @ within @ direction))


def _deviation(variance: float) -> float:
    """NaN where rounding has made the variance negative: then nothing is known."""
    return float(np.sqrt(variance)) if variance >= 0 else np.nan


def fitted_size(base: Model, fit: Fit, effect: Effect) -> Size:
    """Size of an effect in a fit of a base model with it."""
    names = new_names(base, effect, fit.names)
    places = list(map(fit.names.index, names))
    covariance = fit.covariance[np.ix_(places, places)]
    size = size_of(effect, fit.model, names, fit.estimates, covariance)
    return size.in_unit(size_unit(base, effect, fit.units))


def size_unit(base: Model, effect: Effect, units: Mapping[str, str]) -> str:
    """The unit of an effect's size; "" where it is not known."""
    larger = base.add(effect)
    names = new_names(base, effect, larger.free)
    if not names:
        return ""
    chosen = names[_coefficients(larger, names)[-1]]
    return parameter_units(larger, units)[chosen]


def _coefficients(model: Model, names: Sequence[str]) -> list[int]:
    """Places of the coefficients among parameters; the first where there is none."""
    places = [k for k, name in enumerate(names) if model.entries[name].prunable]
    return places or [0]

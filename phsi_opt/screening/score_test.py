"""Screening: by how much every effect would raise the evidence, without a search.

This is Rao's score test (1948) in the presence of a force that could have done the
same: one small regression of the linearised record's residuals and forces on what the
effect leaves in them gives its coefficients, and the gain of the log evidence, with the
slope of -1/2 log|det K|, the volume of states and forces, as weighing has it. Inner
parameters (a frequency, a width) are scanned, each value a trace more.

A right-hand side per frequency would be too many. The correlation of a wave's trace
with the residuals needs no trace, only the residuals' adjoint: a Fourier sum. The size
of the trace is interpolated between some frequencies. The likely frequencies are then
worked out exactly, and from each the way leads uphill: near a resonance the
interpolated size can be twenty times wrong.
"""

from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from phsi_opt.errors import PhsiOptError, SolveError
from phsi_opt.initialization.relative_guesses import (
    largest,
    open_delays,
    resolve_guesses,
    shifts,
    values_at,
)
from phsi_opt.initialization.starting_values import frequency_grid
from phsi_opt.model.effect import Effect, moves_with_states
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Parameter, Scan, Tried
from phsi_opt.screening.linearized_record import Change, LinearizedRecord
from phsi_opt.screening.sensitivities import Regression, Sensitivities, Trial
from phsi_opt.statistics import TINY, local_maxima

BEYOND_ALL = 1e6  # times the range of a channel, of a size that nothing determines
SCAN_REFINEMENTS = 2  # rounds of finer values around the best one of a scan
# Even, and as many logarithmic, frequencies at which the size of a wave's trace is
# worked out: with 24 even ones the resonance of a model without damping fell between.
N_EXACT_SIZES = 30
N_EXACT_PEAKS = 8  # highest peaks of the estimated gain that are worked out exactly
N_TOGETHER = 50  # waves whose traces are worked out at once


@dataclass(frozen=True, eq=False)
class Screened:
    """What screening expects of one effect."""

    effect: Effect  # the candidate; ``model``: the base with it, its guesses as values
    model: Model = field(repr=False)
    # The expected one (the amplitude of a wave, the inner parameter where the effect
    # has no coefficient); ``std_error``: of it.
    coefficient: float
    std_error: float
    # Expected, of the log evidence, less Schwarz' price of its parameters and the
    # logarithm of how many values were tried.
    gain: float
    n_tried: int  # of values scanned
    # Where to begin: of the effect's parameters and of the base's own.
    values: dict[str, float]


@dataclass(frozen=True, eq=False)
class _Point:
    """Values of inner parameters, the change they make, and its regression."""

    values: dict[str, float]
    change: Change
    trace: np.ndarray  # (n_values, k) what the change leaves in the residual
    regression: Regression


class ScoreTest:
    """One small regression per candidate; the record is linearised once.

    Args:
        linearized: the record, with the forces that act and are not in the model.
    """

    def __init__(self, linearized: LinearizedRecord) -> None:
        self.linearized = linearized

    def screened(self, effect: Effect) -> Screened | None:
        """What is expected of an effect; None where it leaves no trace."""
        linearized = self.linearized
        grid = linearized.grid
        if effect.slot == "sensor":
            number = linearized.model.index(effect.equation)
            if not grid.measured[:, number].any():
                return None
        try:
            trial = self.trial(effect)
        except PhsiOptError:
            return None
        whole = part = Sensitivities(linearized, trial)
        points = []
        for values in product(*(tried.tolist() for tried in trial.tried.values())):
            points.append(dict(zip(trial.tried, values, strict=True)))
        n_tried = len(points)
        is_long = linearized.part is not linearized
        if is_long and (trial.scanned or n_tried > 1):
            part = Sensitivities(linearized.part, trial)
        if trial.frequency and trial.scanned:
            along = grid.t
            if trial.scanned != "t":
                states = linearized.states
                along = values_at(linearized.model, grid, states, trial.scanned)
            if not np.ptp(along) > 0:
                return None
            tried = frequency_grid(grid, along)
            n_tried = len(tried)
            if trial.scanned == "t":
                frequency = _best_in_time(whole, part, trial.frequency, tried)
            else:
                frequency = _best_of_all(part, trial.frequency, tried)
            points = [{trial.frequency: frequency}]
            part = whole
        best = _best(part, points)
        if len(trial.tried) == 1 and n_tried > 1:
            best = _refined(part, best)
        if part is not whole:
            best = _best(whole, [best.values])
        new = [name for name in trial.model.free if name not in linearized.model.free]
        n_values = linearized.likelihood.problem.n_values
        price = len(new) * float(np.log(n_values)) / 2 + float(np.log(n_tried))
        if best.regression.drop / 2 > price:  # else there is nothing to be corrected
            best = self._with_volume(whole, best)
        return self._expected(trial, best, n_tried, price)

    def _with_volume(self, whole: Sensitivities, best: _Point) -> _Point:
        """With the slope of the volume of states and forces in the coefficients.

        Without it a gain of a sensor, say, seems to explain whatever forces can do.
        """
        trial, change = whole.trial, best.change
        states = self.linearized.model.states
        has_volume = self.linearized.record is not None
        if not has_volume or not trial.linear:
            return best
        if not moves_with_states(trial.effect, states):
            return best
        slopes = np.zeros(change.of_defects.shape[1])  # none of friction at rest
        values = dict.fromkeys(trial.linear, 0.0) | best.values
        with suppress(SolveError):
            slopes[: len(trial.linear)] = self.linearized.volume_slopes(
                trial.model, values, trial.linear, change
            )
        return replace(best, regression=whole.regression(best.trace, slopes))

    def trial(self, effect: Effect) -> Trial:
        """The effect in the model, with what is to be tried."""
        base = self.linearized.model
        grid, states = self.linearized.grid, self.linearized.states
        model = base.add(effect)
        tried = {}
        delays = open_delays(model)
        linear = []
        frequency = scanned = None
        for name, entry in model.entries.items():
            if name in base.entries:
                continue
            parameter = entry.parameter
            guess = parameter.guess
            if entry.prunable and not parameter.fixed:
                linear.append(name)
            if isinstance(guess, Tried) and parameter.value is None:
                size = largest(model, grid, states, guess.of)
                tried[name] = size * np.array(guess.shares)
            if name in delays:
                tried[name] = shifts(grid)
            if isinstance(guess, Scan) and frequency is None:
                frequency = name
                scanned = guess.variable if parameter.value is None else None
        model = _within_what_is_tried(resolve_guesses(model, grid, states), tried)
        if not linear and not tried:
            # A user's formula is linearised in its parameters, at their start.
            linear = [name for name in model.free if name not in base.entries]
        if not linear:
            frequency = scanned = None
        return Trial(effect, model, linear, tried, frequency, scanned)

    def _expected(
        self, trial: Trial, point: _Point, n_tried: int, price: float
    ) -> Screened | None:
        """What is expected of an effect at its best point; None: it leaves no trace."""
        linearized = self.linearized
        found = point.regression
        c = found.coefficients
        if not np.all(np.isfinite(c)) or not np.trace(found.information) > TINY:
            return None
        of_base = linearized.parameters_with(
            point.change.of_defects, point.change.of_outputs, c
        )
        own = {}
        coefficients = dict(zip(trial.linear, c.tolist(), strict=False))
        for name, value in (point.values | coefficients).items():
            parameter = trial.model.entries[name].parameter
            own[name] = float(np.clip(value, parameter.lower, parameter.upper))
        coefficient, std_error = _size(trial, point)
        if self._is_beyond_all(point.change, c):
            coefficient = std_error = np.nan
        return Screened(
            effect=trial.effect,
            model=trial.model,
            coefficient=coefficient,
            std_error=std_error,
            gain=max(found.drop, 0.0) / 2 - price,
            n_tried=n_tried,
            values={**of_base, **own},
        )

    def _is_beyond_all(self, change: Change, c: np.ndarray) -> bool:
        """Whether an effect is a million times what a state or a sensor ever does."""
        linearized = self.linearized
        rates = linearized.grid.rates(linearized.states)
        pairs = ((change.of_defects, rates), (change.of_outputs, linearized.shown))
        beyond = False
        for effect, known in pairs:
            usual = BEYOND_ALL * np.ptp(known, axis=0)
            size = np.abs((effect @ c).reshape(known.shape))
            beyond |= bool(np.any((usual > 0) & (size > usual)))
        return beyond


def _size(trial: Trial, point: _Point) -> tuple[float, float]:
    """The coefficient and its standard error, forces of given sizes acting."""
    if not trial.linear:
        return next(iter(point.values.values())), np.nan
    c = point.regression.coefficients
    covariance = np.linalg.pinv(point.regression.information, hermitian=True)
    spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    last = len(trial.linear) - 1
    size = float(np.hypot(*c)) if trial.frequency and len(c) == 2 else float(c[last])
    return size, float(np.max(spread) if trial.frequency else spread[last])


def _within_what_is_tried(model: Model, tried: dict[str, np.ndarray]) -> Model:
    """Inner parameters up to one step beyond what is tried."""
    # What a record cannot show, such as a corner below its resolution, has no prior
    # mass.

    def bounded(name: str, parameter: Parameter) -> Parameter:
        values = np.sort(tried[name])
        if len(values) < 2 or not values[0] > 0:  # steps are ratios
            return parameter
        lower = max(float(values[0] ** 2 / values[1]), parameter.lower)
        upper = min(float(values[-1] ** 2 / values[-2]), parameter.upper)
        return replace(parameter, lower=lower, upper=upper)

    return model.with_parameters(bounded, tried)


# --- Values of inner parameters


def _best(sensitivities: Sensitivities, points: list[dict[str, float]]) -> _Point:
    """The point that explains most."""
    changes = list(map(sensitivities, points))
    parts = np.split(sensitivities.traces(changes), len(points), axis=1)
    tried = []
    for values, change, trace in zip(points, changes, parts, strict=True):
        found = sensitivities.regression(trace)
        tried.append(_Point(values, change, trace, found))
    return max(tried, key=lambda point: point.regression.drop)


def _refined(sensitivities: Sensitivities, best: _Point) -> _Point:
    """The best point among finer and finer values of the one inner parameter."""
    (name,) = sensitivities.trial.tried
    around = np.sort(sensitivities.trial.tried[name])
    for _ in range(SCAN_REFINEMENTS):
        around = _finer(around, best.values[name])
        best = _best(sensitivities, [{name: value} for value in around.tolist()])
    return best


def _finer(values: np.ndarray, best: float) -> np.ndarray:
    """The best value and a point towards each neighbour, half way.

    Geometrically, where all values are positive.
    """
    place = int(np.argmin(np.abs(values - best)))
    if not values[0] > 0:
        near = values[max(place - 1, 0) : place + 2]
        return np.unique([best, *((near + best) / 2)])
    below = values[place - 1] if place else best**2 / values[1]
    above = values[min(place + 1, len(values) - 1)]
    around = [best, np.sqrt(below * best), np.sqrt(above * best)]
    return np.unique(around)


# --- Frequencies of waves


def _best_in_time(
    whole: Sensitivities, part: Sensitivities, name: str, tried: np.ndarray
) -> float:
    """The frequency that explains most; those tried are evenly spaced."""
    gains: dict[int, float] = {}

    def nearby(place: int) -> range:
        return range(max(place - 1, 0), min(place + 2, len(tried)))

    tops = _likely_frequencies(whole, part, name, tried)
    while True:
        wanted = {place for top in tops for place in nearby(top)}
        new = sorted(wanted - gains.keys())
        if not new:
            break
        gains.update(zip(new, _gains(whole, name, tried[new]), strict=True))
        tops = [max(nearby(top), key=gains.__getitem__) for top in tops]
    return float(tried[max(gains, key=gains.__getitem__)])


def _best_of_all(part: Sensitivities, name: str, tried: np.ndarray) -> float:
    """The same of frequencies (n_tried,), each worked out on the part."""
    # For waves along a state: a Fourier sum says little of them, as a slow motion gives
    # every wave along it a slow part.
    gains = []
    for few in np.array_split(tried, 1 + len(tried) // N_TOGETHER):
        gains += _gains(part, name, few)
    return float(tried[int(np.argmax(gains))])


def _gains(
    sensitivities: Sensitivities, name: str, frequencies: np.ndarray
) -> list[float]:
    """Fall of the misfit by a wave of each frequency."""
    traces = _wave_traces(sensitivities, name, frequencies)
    return [sensitivities.regression(trace).drop for trace in np.moveaxis(traces, 1, 0)]


def _wave_traces(
    sensitivities: Sensitivities, name: str, frequencies: np.ndarray
) -> np.ndarray:
    """(n_values, n_frequencies, k)"""
    changes = [sensitivities({name: omega}) for omega in frequencies.tolist()]
    traces = sensitivities.traces(changes)
    return traces.reshape(len(traces), len(frequencies), -1)


def _likely_frequencies(
    whole: Sensitivities, part: Sensitivities, name: str, tried: np.ndarray
) -> list[int]:
    """Places in ``tried`` of the highest peaks of the estimated gain; of few, all."""
    n_tried = len(tried)
    if n_tried <= N_EXACT_SIZES:
        return list(range(n_tried))
    grid = whole.linearized.grid
    # A wave of frequency zero: cos = 1, sin = 0.
    still = whole({name: 0.0}).of_defects.sum(axis=1)
    per_defect = whole.linearized.adjoint() * still
    per_interval = per_defect.reshape(grid.n_intervals, -1).sum(axis=1)
    middle = grid.t[grid.begin] + grid.h / 2
    correlation = np.abs(_fourier_sum(middle, per_interval, tried)) ** 2
    even = np.linspace(0, n_tried - 1, N_EXACT_SIZES)
    logarithmic = np.geomspace(1, n_tried, N_EXACT_SIZES) - 1
    coarse = tried[np.unique(np.concatenate([even, logarithmic]).astype(int))]
    sizes = np.sum(_wave_traces(part, name, coarse) ** 2, axis=(0, 2))
    log_size = np.interp(tried, coarse, np.log(np.maximum(sizes, TINY)))
    gain = correlation / np.exp(log_size)
    peaks = np.flatnonzero(local_maxima(gain, last_of_plateau=True))
    highest: list[int] = peaks[np.argsort(-gain[peaks])][:N_EXACT_PEAKS].tolist()
    return highest


def _fourier_sum(t: np.ndarray, y: np.ndarray, frequencies: np.ndarray) -> np.ndarray:
    """sum y exp(i omega t) at evenly spaced frequencies."""
    wave = y * np.exp(1j * frequencies[0] * t)
    turn = np.exp(1j * (frequencies[1] - frequencies[0]) * t)
    result = np.zeros(len(frequencies), dtype=complex)
    for place in range(len(frequencies)):
        result[place] = wave.sum()
        wave = wave * turn
    return result

"""Screening: what every effect would do to the misfit, without re-fitting.

This is Rao's score test (1948) on the linearised record: one small regression of the
residuals on each candidate's trace gives its coefficients, their errors and the fall of
the misfit. Inner parameters (a frequency, a width) are scanned, each value a trace
more.

Some effects only repeat what the base parameters can do: where the momentum is not
measured, a gain of the input is a change of mass and friction. Along states that obey
the base model such an effect leaves no trace. Along those of the missing force it seems
to explain everything: the whole equation, missing force included, is scaled to nothing.
So an effect is left out whose trace, for changes of one size, all but vanishes along
the fit's own states.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from phsi_opt.criteria import CONFUSABLE_REMAINDER, IMITATED_TRACE, LEAST_TRACE
from phsi_opt.errors import PhsiOptError
from phsi_opt.estimation.record import Record
from phsi_opt.initialization.frequency_scan import frequency_grid
from phsi_opt.initialization.relative_guesses import (
    resolve_guesses,
    values_at,
    values_to_try,
)
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Scan, Tried
from phsi_opt.model.slots import Entry
from phsi_opt.screening.linearized_record import LinearizedRecord
from phsi_opt.screening.regression import Regression, regression
from phsi_opt.screening.sensitivities import Change, Sensitivities, Trial
from phsi_opt.screening.wave_scan import best_frequency, best_of_all
from phsi_opt.statistics import (
    TINY,
    effective_sample_share,
    likelihood_ratio_p_value,
)

SCAN_REFINEMENTS = 2  # rounds of finer values around the best one of a scan
# Share of the misfit that is left at least when its logarithm is taken.
LEAST_MISFIT = 1e-9
# Share of itself by which a parameter of the base may move at the start of a re-fit
# that no second look prepared: where an effect is hardly told from it (the gain of a
# sensor and all losses), the linearisation leads anywhere.
MOST_MOVED = 0.5
Numbers = float | np.ndarray


@dataclass(frozen=True, eq=False)
class ScannedPoint:
    """Values of inner parameters, and the trace there, (n_values, k) or (n_kept, k)."""

    values: dict[str, float]
    trace: np.ndarray


@dataclass(frozen=True, eq=False)
class NearStart:
    """A start beside the base model.

    Attributes:
        values: of the effect's parameters.
        base_values: of the base's own.
    """

    values: dict[str, float]
    base_values: dict[str, float]


@dataclass(frozen=True, eq=False)
class Screened:
    """What screening expects of one effect.

    Attributes:
        effect: the candidate.
        coefficient: the expected one (the amplitude of a wave, the inner parameter
            where the effect has no coefficient); ``std_error``: of it.
        drop: expected fall of the misfit, in units of the noise variance.
        n_free: number of parameters that it adds; ``n_tried``: of values scanned.
        p_value: of the drop, for correlated residuals and all values scanned.
        values: where to start a re-fit; ``base_values``: those of the base's own
            parameters beside the effect.
        near: the same no further than the linearisation is to be trusted.
        trace: (n_values, k); ``explained``: the same times the coefficients.
        scanned: what was tried, traces in the rows that are kept.
    """

    effect: Effect
    coefficient: float
    std_error: float
    drop: float
    n_free: int
    n_tried: int
    p_value: float
    values: dict[str, float]
    base_values: dict[str, float]
    near: "NearStart"
    trace: np.ndarray = field(repr=False)
    explained: np.ndarray = field(repr=False)
    scanned: tuple[ScannedPoint, ...] = field(repr=False)


@dataclass(frozen=True, eq=False)
class _Point:
    """Values of inner parameters, the change they make, its trace and regression."""

    values: dict[str, float]
    change: Change
    trace: np.ndarray
    regression: Regression


class _Candidate:
    """A trial with its sensitivities, here and along the base model's own run."""

    def __init__(self, test: "ScoreTest", trial: Trial) -> None:
        self.trial = trial
        self.here = Sensitivities(test.linearized, trial)
        self._test = test

    @cached_property
    def along_base_run(self) -> Sensitivities | None:
        linearized = self._test.along_base_run
        return None if linearized is None else Sensitivities(linearized, self.trial)


class ScoreTest:
    """Rao's score test (1948): one small regression per candidate.

    The record is linearised once.

    Args:
        record: the fit along the measurements.
        run: the base model's free run, one (n_samples, n_states) per trajectory;
            without it, effects that the base parameters imitate are kept.
    """

    def __init__(self, record: Record, run: Sequence[np.ndarray] = ()) -> None:
        self.linearized = LinearizedRecord.of(record)
        self._run = run

    @property
    def model(self) -> Model:
        """The base model."""
        return self.linearized.model

    @property
    def misfit(self) -> float:
        """Squared residuals that the base leaves, in units of the noise variance."""
        return self.linearized.misfit

    @property
    def n_values(self) -> int:
        """Number of measured values."""
        return self.linearized.n_values

    @cached_property
    def along_base_run(self) -> LinearizedRecord | None:
        """The record linearised along states that obey the base model.

        None where there are none, or where all states are measured: then nothing can be
        scaled.
        """
        is_complete = self.linearized.grid.measured.any(axis=0).all()
        if not self._run or is_complete:
            return None
        return self.linearized.along(self._run)

    def screened(self, effects: Iterable[Effect]) -> list[Screened]:
        """What is expected of effects that leave a trace, the most convincing first."""
        found = []
        for effect in effects:
            expected = self.candidate(effect)
            if expected is not None:
                found.append(expected)
        return sorted(found, key=lambda expected: -self.score(expected))

    def score(self, expected: Screened) -> float:
        """n log(misfit before / after) - k log n: minus the expected change of BIC."""
        return float(self.score_of(expected.drop, expected.n_free))

    def score_of(self, drop: Numbers, n_free: Numbers) -> Any:
        """The same for any fall of the misfit, or for many."""
        n = self.n_values
        left = np.maximum(self.misfit - drop, LEAST_MISFIT * self.misfit)
        ratio = np.maximum(self.misfit, left) / left
        return n * np.log(ratio) - n_free * np.log(n)

    def candidate(self, effect: Effect) -> Screened | None:
        """What is expected of one effect; None where it leaves no trace."""
        if effect.slot == "sensor" and not self._is_measured(effect.equation):
            return None
        try:
            trial = self.trial(effect)
        except PhsiOptError:
            return None
        candidate = _Candidate(self, trial)
        points = _combinations(trial.tried)
        n_tried = len(points)
        if trial.frequency is not None and trial.scanned is not None:
            along = self._along(trial.scanned)
            if not np.ptp(along) > 0:
                return None
            tried = frequency_grid(self.linearized.grid, along)
            n_tried = len(tried)
            omega = self._best_frequency(candidate, trial.frequency, tried)
            points = [{trial.frequency: omega}]
        ranked = self._ranked(candidate, points)
        if not ranked:
            return None
        best = ranked[0]
        if len(trial.tried) == 1 and n_tried > 1:
            best = self._refined(candidate, best)
        expected = self._expected(trial, best, n_tried)
        if expected is None or len(points) == 1:
            return expected
        scanned = [expected.scanned[0]]
        scanned += [self._kept(point) for point in ranked]
        return replace(expected, scanned=tuple(scanned))

    def stands_in(self, one: Screened, other: Screened) -> bool:
        """Whether ``other`` explains what ``one`` explains, up to what noise hides."""
        fitted = np.linalg.lstsq(other.trace, one.explained, rcond=1e-10)[0]
        left = one.explained - other.trace @ fitted
        return float(left @ left) < CONFUSABLE_REMAINDER

    def trial(self, effect: Effect) -> Trial:
        """The effect in the model, with what is to be tried."""
        model = self.model.add(effect)
        new: dict[str, Entry] = {}
        for name, entry in model.entries.items():
            if name not in self.model.entries:
                new[name] = entry
        grid = self.linearized.grid
        states = self.linearized.states
        tried = {}
        frequency = None
        scanned = None
        for name, entry in new.items():
            guess = entry.parameter.guess
            if isinstance(guess, Tried) and entry.parameter.value is None:
                tried[name] = values_to_try(model, grid, states, guess)
            if isinstance(guess, Scan) and frequency is None:
                frequency = name
                scanned = guess.variable if entry.parameter.value is None else None
        linear = _linear_names(new)
        model = resolve_guesses(model, grid, states)
        if not linear and not tried:
            # A user's formula is linearised in its parameters, at their start.
            linear = [name for name in model.free if name in new]
        if not linear:
            frequency = scanned = None
        return Trial(effect, model, linear, tried, frequency, scanned)

    def _along(self, variable: str) -> np.ndarray:
        """What a wave runs along, at the nodes, (n_nodes,)."""
        grid = self.linearized.grid
        if variable == "t":
            return grid.t
        return values_at(self.model, grid, self.linearized.states, variable)

    def _is_measured(self, state: str) -> bool:
        number = self.model.index(state)
        return bool(self.linearized.grid.measured[:, number].any())

    def _best_frequency(
        self, candidate: _Candidate, name: str, tried: np.ndarray
    ) -> float:
        """The one of the frequencies (n_tried,) at which a wave explains most."""

        def drop(trace: np.ndarray) -> float:
            return self._regression(candidate.trial, trace).drop

        is_in_time = candidate.trial.scanned == "t"
        search = best_frequency if is_in_time else best_of_all
        return search(candidate.here, name, tried, drop)

    def _regression(self, trial: Trial, trace: np.ndarray) -> Regression:
        return regression(trial, trace, self.linearized.residual)

    def _ranked(
        self, candidate: _Candidate, points: list[dict[str, float]]
    ) -> list[_Point]:
        """The points, the one that explains most first.

        Those before the first one that the base cannot imitate are left out.
        """
        changes = [candidate.here(values) for values in points]
        traces = self.linearized.traces(
            np.hstack([change.of_defects for change in changes]),
            np.hstack([change.of_outputs for change in changes]),
        )
        tried = []
        parts = np.split(traces, len(points), axis=1)
        for values, change, trace in zip(points, changes, parts, strict=True):
            found = self._regression(candidate.trial, trace)
            tried.append(_Point(values, change, trace, found))
        drops = [point.regression.drop for point in tried]
        order = np.argsort(drops)[::-1]
        for rank, place in enumerate(order):
            if not self._is_imitated(candidate, tried[place]):
                return [tried[k] for k in order[rank:]]
        return []

    def _refined(self, candidate: _Candidate, best: _Point) -> _Point:
        """The best point among finer and finer values of the one inner parameter."""
        (name,) = candidate.trial.tried
        around = np.sort(candidate.trial.tried[name])
        for _ in range(SCAN_REFINEMENTS):
            around = _finer(around, best.values[name])
            points = [{name: float(value)} for value in around]
            ranked = self._ranked(candidate, points)
            best = ranked[0] if ranked else best
        return best

    def _kept(self, point: _Point) -> ScannedPoint:
        return ScannedPoint(point.values, point.trace[self.linearized.kept_rows])

    def _strength(self, change: Change) -> float:
        """What a coefficient of one changes of a rate, or of what is shown.

        As a share of its size, so free of units.
        """
        linearized = self.linearized
        rates = linearized.grid.rates(linearized.states)
        of_rates = np.sqrt(np.mean(rates**2, axis=0))
        of_outputs = np.std(linearized.states, axis=0)
        return max(
            self._largest_share(change.of_defects, of_rates),
            self._largest_share(change.of_outputs, of_outputs),
        )

    def _largest_share(self, columns: np.ndarray, size: np.ndarray) -> float:
        n_states = self.model.n_states
        by_state = columns.reshape(-1, n_states, columns.shape[1])
        rms = np.sqrt(np.mean(by_state**2, axis=(0, 2)))
        return float(np.max(rms / np.maximum(size, TINY)))

    def _is_imitated(self, candidate: _Candidate, point: _Point) -> bool:
        """Whether the base parameters can do what the effect does at a point.

        Along states that obey the base model its trace vanishes then. What explains
        nothing need not be looked at.
        """
        if self.score_of(point.regression.drop, point.trace.shape[1]) <= 0:
            return False
        along_base_run = candidate.along_base_run
        if along_base_run is None:
            return False
        k = len(candidate.trial.linear) or 1
        change = along_base_run(point.values).first(k)
        strength_there = self._strength(change)
        if not strength_there > 0:
            return False  # the base model's states do not reach what excites the effect
        strength = self._strength(point.change.first(k))
        linearized = along_base_run.linearized
        trace_there = linearized.traces(change.of_defects, change.of_outputs)
        there = np.sum(trace_there**2) / strength_there**2
        here = IMITATED_TRACE * np.sum(point.trace[:, :k] ** 2)
        return bool(there < here / max(strength, TINY) ** 2)

    def _expected(self, trial: Trial, point: _Point, n_tried: int) -> Screened | None:
        """What is expected of an effect at its best point; None: it is not excited."""
        trace = point.trace
        found = point.regression
        k = len(trial.linear) or 1
        strength = self._strength(point.change.first(k))
        is_excited = np.trace(found.information) > LEAST_TRACE * strength**2
        if not np.all(np.isfinite(trace)) or not is_excited:
            return None
        drop = max(found.drop, 0.0)
        c = found.coefficients
        explained = trace @ c
        n_free = self._n_new(trial) + trace.shape[1] - k
        return Screened(
            effect=trial.effect,
            coefficient=self._size(trial, point),
            std_error=self._std_error(trial, found, drop),
            drop=drop,
            n_free=n_free,
            n_tried=n_tried,
            p_value=self._p_value(explained, drop, n_free, n_tried),
            values=_start_values(trial, point),
            base_values=self.linearized.parameters_with(
                point.change.of_defects, point.change.of_outputs, c
            ),
            near=self._near_start(trial, point),
            trace=trace,
            explained=explained,
            scanned=(self._kept(point),),
        )

    def _near_start(self, trial: Trial, point: _Point) -> NearStart:
        """Where no parameter of the base moves by more than `MOST_MOVED` of itself."""
        change = point.change
        c = point.regression.coefficients
        moved = self.linearized.relative_change(change.of_defects, change.of_outputs, c)
        share = 1 / max(1.0, moved / MOST_MOVED)
        near = self.linearized.parameters_with(
            change.of_defects, change.of_outputs, share * c
        )
        return NearStart(_start_values(trial, point, share), near)

    def _n_new(self, trial: Trial) -> int:
        return sum(name not in self.model.entries for name in trial.model.free)

    def _size(self, trial: Trial, point: _Point) -> float:
        """The coefficient; the amplitude of a wave; else the inner parameter."""
        c = point.regression.coefficients
        if not trial.linear:
            return next(iter(point.values.values()))
        if trial.frequency and len(c) == 2:
            return float(np.hypot(*c))
        return float(c[len(trial.linear) - 1])

    def _std_error(self, trial: Trial, found: Regression, drop: float) -> float:
        """Of the coefficient, with the variance that is left; NaN without one."""
        if not trial.linear:
            return np.nan
        n_left = max(self.n_values - len(found.coefficients), 1)
        variance = max(self.misfit - drop, 1.0) / n_left
        spread = np.sqrt(found.covariance_diagonal * max(variance, 1.0))
        if trial.frequency:
            return float(np.max(spread))
        return float(spread[len(trial.linear) - 1])

    def _p_value(
        self, explained: np.ndarray, drop: float, n_free: int, n_tried: int
    ) -> float:
        """Of the likelihood ratio, for correlated residuals and all values scanned."""
        linearized = self.linearized
        residual = linearized.residual - explained
        size = linearized.grid.rms_by_channel(residual) + TINY
        share = effective_sample_share(
            linearized.by_trajectory(explained, size),
            linearized.by_trajectory(residual, size),
        )
        ratio = max(self.misfit, TINY) / max(self.misfit - drop, TINY)
        gain = share * self.n_values * np.log(ratio)
        return min(1.0, n_tried * likelihood_ratio_p_value(gain, n_free))


def _combinations(tried: dict[str, np.ndarray]) -> list[dict[str, float]]:
    """Every combination of the values to try, by inner parameter."""
    points = []
    for combination in product(*tried.values()):
        values = [float(value) for value in combination]
        points.append(dict(zip(tried, values, strict=True)))
    return points


def _linear_names(new: dict[str, Entry]) -> list[str]:
    """Names of the new coefficients, in which the model is linear."""
    names = []
    for name, entry in new.items():
        if entry.prunable and not entry.parameter.fixed:
            names.append(name)
    return names


def _start_values(trial: Trial, point: _Point, share: float = 1.0) -> dict[str, float]:
    """Inner values and a share of the coefficients, within their bounds."""
    coefficients = (share * point.regression.coefficients).tolist()
    found = {**point.values, **dict(zip(trial.linear, coefficients, strict=False))}
    values = {}
    for name, value in found.items():
        parameter = trial.model.entries[name].parameter
        values[name] = float(np.clip(value, parameter.lower, parameter.upper))
    return values


def _finer(values: np.ndarray, best: float) -> np.ndarray:
    """The best value and a point towards each neighbour, geometrically half way.

    ``values`` are positive and sorted; below the least the ratio goes on.
    """
    place = int(np.argmin(np.abs(values - best)))
    below = values[place - 1] if place else best**2 / values[1]
    above = values[min(place + 1, len(values) - 1)]
    around = [best, np.sqrt(below * best), np.sqrt(above * best)]
    return np.unique(around)

"""Screening: what every effect of a catalogue would do to the misfit, computed without
re-fitting.

The likelihood of the whole record is linearised at the states of the missing-force
estimate, with the dynamics hard:

    minimise 1/2 |r - C z - Y c|^2 over z = (theta, x) and c, subject to d + J z + D c =
    0

d are the defects of the fitted model at these states, D and Y what a candidate's
coefficients c do to defects and to what the sensors show. One factorisation serves all
candidates: what is left of D and Y in the residuals, with states and base parameters
following, is the candidate's trace T; its coefficients, their errors and the fall of
the misfit are those of a small regression of r on T. Inner parameters are scanned, each
value a column more.

A sensor's candidate is a model whose dynamics are right, so Y is taken at states that
obey them: at those of the missing force, a gain of the sensor would stand in for every
force.

Some effects only repeat what the base parameters can do: where the momentum is not
measured, a gain of the input is a change of mass and friction. Along states that obey
the base model such an effect leaves no trace. Along those of the
missing force it seems to explain everything: the whole equation, missing force
included, is scaled to nothing. So an effect is left out whose trace, for columns of one
size, all but vanishes along the fit's own states.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import casadi as ca
import numpy as np
from scipy.optimize import lsq_linear
from scipy.sparse import csc_matrix, diags, hstack
from scipy.stats import chi2

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import PhsiOptError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.missing_force import ForceEstimate
from phsi_opt.estimation.trajectory_parameters import parameter_matrix, parameters_of
from phsi_opt.initialization.frequency_scan import frequency_grid
from phsi_opt.initialization.relative_guesses import resolve_guesses, values_to_try
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Scan, Tried
from phsi_opt.screening.linearized_record import (
    BACK,
    KEPT,
    LINEARIZATION_SCHEME,
    NEARLY,
    OBEYED,
    column_scale,
)
from phsi_opt.screening.sensitivities import Columns, Trial
from phsi_opt.statistics import TINY, effective_sample_share, local_maxima
from phsi_opt.transcription.defects import defects
from phsi_opt.transcription.elimination import (
    ReducedSystem,
    Step,
    regularized_inverse,
)
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.sensors import SensorOutputs, output_slopes_in_theta

# squared trace of an effect of natural size, in units of the noise, below which it is
# not excited
NO_TRACE = 1e-6
# squared trace along the fit's own states, over that at the missing force's, of what
# others can do
IMITATED = 1e-2
# squared remainder, in units of the noise, below which one effect stands in for another
ALIKE = 9.0
ROUNDS = 2  # of finer values around the best one of a scan
# even, and as many logarithmic, frequencies at which the size of a wave's trace is
# worked out
COARSE = 30
EXACT = 8  # best peaks that are worked out exactly


@dataclass(frozen=True, eq=False)
class Screened:
    """What screening expects of one effect.

    ``coefficient`` and ``std_error``: the expected one (the amplitude of a wave, the
    inner parameter where the effect has no coefficient); ``drop``: expected fall of the
    misfit in units of the noise variance, with ``n_free`` parameters and ``n_tried``
    values scanned; ``values``: where to start a re-fit, ``beside`` those of the base's
    own parameters; ``trace``: (n_values, k).
    """

    effect: Effect
    coefficient: float
    std_error: float
    drop: float
    n_free: int
    n_tried: int
    p_value: float
    values: dict[str, float]
    beside: dict[str, float]
    trace: np.ndarray = field(repr=False)
    explained: np.ndarray = field(repr=False)  # trace times coefficients
    # Inner values, and their traces in the rows that are kept.
    scanned: tuple[tuple[dict[str, float], np.ndarray], ...] = field(repr=False)


class Screen:
    """The record, linearised once; then one small regression per candidate (see the
    module's text).
    """

    def __init__(
        self,
        fit: Fit,
        data: Measurements,
        estimate: ForceEstimate,
        run: Sequence[np.ndarray] = (),
    ) -> None:
        """``run``: states of the base model's free run along each trajectory; none: it
        is not looked for imitations.
        """
        model, grid, x = (
            fit.model.with_values(estimate.rounded),
            estimate.grid,
            estimate.x,
        )
        self.model, self.grid, self.x = model, grid, x
        self._given = fit, data, estimate, run
        unknown = Theta.of(model, tuple(run.name for run in data.trajectories))
        self.values = parameter_matrix(
            model, parameters_of(fit, data)
        )  # (n_free, n_trajectories)
        theta = np.zeros(len(unknown))
        theta[unknown.table] = self.values
        symbol, free = ca.MX.sym("x", x.size), ca.MX.sym("theta", len(unknown))
        states = ca.reshape(symbol, model.n_states, grid.n_nodes)
        d = ca.vec(
            defects(
                model, grid, LINEARIZATION_SCHEME, states, unknown.by_trajectory(free)
            )
        )
        value, A, B = ca.Function(
            "linear", [symbol, free], [d, ca.jacobian(d, symbol), ca.jacobian(d, free)]
        )(x.ravel(), theta)
        self.defects = np.array(value).ravel()
        of_runs, n_theta = np.asarray(unknown.by_trajectory(theta)), len(unknown)
        sensed, seen = SensorOutputs.at(model, grid, x, of_runs), grid.measured
        self.weight = np.where(seen, 1 / estimate.sigma, 0.0).ravel()
        weighted = diags(self.weight)
        own = output_slopes_in_theta(unknown, grid, x, theta).reshape(x.size, n_theta)
        self.unknown, self.theta = unknown, theta
        self.scale = column_scale(csc_matrix(B.sparse()), weighted @ csc_matrix(own))
        slopes, through_sensors = (
            B.sparse() @ diags(self.scale),
            weighted @ csc_matrix(own) @ diags(self.scale),
        )
        self.seen_of = csc_matrix(
            hstack([through_sensors, weighted @ sensed.jacobian])
        )  # from theta and x to residuals
        r = np.where(seen, (grid.y - sensed.values) / estimate.sigma, 0.0).ravel()
        x_places = slice(n_theta, n_theta + x.size)
        hessian = csc_matrix(self.seen_of.T @ self.seen_of)
        self.reduced = ReducedSystem(
            grid,
            model.n_states,
            hessian,
            hstack([slopes, A.sparse()]),
            slice(0, n_theta),
            x_places,
        )
        self.covariance = regularized_inverse(self.reduced.information)
        self.n_theta, self.n_values = n_theta, int(seen.sum())
        rows = np.flatnonzero(self.weight)
        few = (
            np.random.default_rng(0).choice(rows, KEPT, replace=False)
            if len(rows) > KEPT
            else rows
        )
        self.kept = np.sort(few)
        g = self.seen_of.T @ r
        self.step = step = self.reduced.solve(
            g[n_theta:], -self.defects, self.covariance, g[:n_theta]
        )
        self.residual = r - self.seen_of @ step.joined
        self.obeying = x + np.asarray(step.x).reshape(
            x.shape
        )  # states that the base model can take
        self.shown = SensorOutputs.at(model, grid, self.obeying, of_runs).values

    @cached_property
    def own(self) -> "Screen | None":
        """The same along states that obey the base model; None where there are none, or
        where all are measured.
        """
        fit, data, estimate, run = self._given
        if (
            not run or self.grid.measured.any(axis=0).all()
        ):  # nothing that is measured can be scaled
            return None
        own = Screen(fit, data, replace(estimate, x=np.concatenate(run)))
        for _ in range(BACK):  # the run's steps are finer than those of this grid
            if np.linalg.norm(own.defects) < OBEYED * np.linalg.norm(self.defects):
                return own
            back = own.reduced.respond(-own.defects, np.zeros_like(own.covariance)).x
            own = Screen(
                fit, data, replace(estimate, x=own.x + back.reshape(own.x.shape))
            )
        return (
            own
            if np.linalg.norm(own.defects) < NEARLY * np.linalg.norm(self.defects)
            else None
        )

    @cached_property
    def misfit(self) -> float:
        """Squared residuals that the model leaves, in units of the noise variance."""
        return float(self.residual @ self.residual)

    def screened(self, effects: Iterable[Effect]) -> list[Screened]:
        """What is expected of each effect that leaves a trace in the record; most
        convincing first.
        """
        found = [
            one for effect in effects if (one := self.candidate(effect)) is not None
        ]
        return sorted(found, key=lambda one: -self.score(one))

    def score(self, one: Screened) -> float:
        """n log(misfit before / after) - k log n, with what is expected of the effect."""
        return self.score_of(one.drop, one.n_free)

    def score_of(self, drop: float, n_free: int) -> float:
        """The same for any fall of the misfit."""
        n = self.n_values
        left = max(self.misfit - drop, 1e-9 * self.misfit)
        return float(n * np.log(max(self.misfit, left) / left) - n_free * np.log(n))

    def candidate(self, effect: Effect) -> Screened | None:
        """What is expected of one effect; None where it leaves no trace in the record."""
        if (
            effect.slot == "sensor"
            and not self.grid.measured[:, self.model.index(effect.equation)].any()
        ):
            return None
        try:
            trial = self.trial(effect)
        except PhsiOptError:
            return None
        columns = Columns(self, trial)
        points = [
            dict(zip(trial.tried, map(float, v), strict=True))
            for v in product(*trial.tried.values())
        ]
        n_tried = len(points)
        if trial.frequency is not None:
            tried = frequency_grid(self.grid, self.grid.t)
            points, n_tried = (
                [{trial.frequency: self._best_frequency(trial, columns, tried)}],
                len(tried),
            )
        ranked = self._ranked(trial, columns, points)
        if not ranked:
            return None
        best = ranked[0]
        if len(trial.tried) == 1 and n_tried > 1:
            (name,) = trial.tried
            around = np.sort(trial.tried[name])
            for _ in range(ROUNDS):
                around = _finer(around, best[0][name])
                near = [{name: float(value)} for value in around]
                best = (self._ranked(trial, columns, near) or [best])[0]
        one = self._judged(trial, columns, *best, n_tried)
        return one and replace(
            one,
            scanned=(*one.scanned, *self._kept(ranked))
            if len(points) > 1
            else one.scanned,
        )

    def stands_in(self, one: Screened, other: Screened) -> bool:
        """Whether ``other`` explains what ``one`` explains, up to what noise hides."""
        left = (
            one.explained
            - other.trace @ np.linalg.lstsq(other.trace, one.explained, rcond=1e-10)[0]
        )
        return float(left @ left) < ALIKE

    def traces(self, D: np.ndarray, Y: np.ndarray) -> np.ndarray:
        """What is left in the weighted residuals of columns of defects D and of values
        shown Y, base re-estimated.
        """
        return np.asarray(
            self.weight[:, None] * Y + self.seen_of @ self._followed(D, Y).joined
        )

    def _followed(self, D: np.ndarray, Y: np.ndarray) -> Step:
        """How the base's parameters (scaled) and the states follow the columns D and Y."""
        g, n = -(self.seen_of.T @ (self.weight[:, None] * Y)), self.n_theta
        return self.reduced.solve(g[n:], -D, self.covariance, g[:n])

    def beside(self, D: np.ndarray, Y: np.ndarray, c: np.ndarray) -> dict[str, float]:
        """Values of the base's parameters beside an effect of coefficients c, at most
        half way to their bounds.
        """
        found = self.theta + self.scale * (
            self.step.theta + self._followed(D, Y).theta @ c
        )
        bounds = np.array(
            [(e.parameter.lower, e.parameter.upper) for e in self.unknown.entries]
        ).reshape(-1, 2)
        found = np.clip(found, *((bounds.T + self.theta) / 2))
        return dict(zip(self.unknown.names, found.tolist(), strict=True))

    def _by_run(
        self, change: np.ndarray, residual: np.ndarray
    ) -> list[list[np.ndarray]]:
        """Both per trajectory, (n_samples, n_states), in units of the residual's size
        in each state.
        """
        seen, r = self.grid.measured, residual.reshape(self.grid.y.shape)
        size = np.sqrt(np.sum(r**2, axis=0) / np.maximum(seen.sum(axis=0), 1)) + TINY
        edges = self.grid.first[1:]
        return [
            np.split(values.reshape(r.shape) / size, edges)
            for values in (change, residual)
        ]

    def trial(self, effect: Effect) -> Trial:
        """The effect in the model, with what is to be tried."""
        model = self.model.add(effect)
        new = [name for name in model.entries if name not in self.model.entries]
        entries = model.entries
        scans = [
            name for name in new if isinstance(entries[name].parameter.guess, Scan)
        ]
        x = self.x
        tried = {
            name: values_to_try(model, self.grid, x, guess)
            for name in new
            if isinstance(guess := entries[name].parameter.guess, Tried)
            and entries[name].parameter.value is None
        }
        model = resolve_guesses(model, self.grid, x)
        linear = [
            name
            for name in new
            if entries[name].prunable and not entries[name].parameter.fixed
        ]
        if (
            not linear and not tried
        ):  # a user's formula: linearised in its parameters, at their start
            linear = [name for name in model.free if name in new]
        return Trial(
            effect, model, linear, tried, scans[0] if scans and linear else None
        )

    def theta_at(self, model: Model, values: dict[str, float]) -> np.ndarray:
        """The base's parameters and the values given, (n_free, n_trajectories)."""
        old = dict(zip(self.model.free, self.values, strict=True))
        n = self.values.shape[1]
        rows = [
            old.get(name, np.full(n, values.get(name, model.values[name])))
            for name in model.free
        ]
        return np.array(rows).reshape(-1, n)

    def _ranked(
        self, trial: Trial, columns: Columns, points: list[dict[str, float]]
    ) -> list[tuple[dict[str, float], np.ndarray]]:
        """The points with their traces, the one that explains most first, without what
        the base can imitate.
        """
        made = [columns(point) for point in points]
        traces = self.traces(
            np.hstack([D for D, _ in made]), np.hstack([Y for _, Y in made])
        )
        parts = np.split(traces, len(points), axis=1)
        drops = [self._regression(trial, part)[1] for part in parts]
        order = np.argsort(drops)[::-1]
        for n, i in enumerate(order):
            if self.score_of(drops[i], parts[i].shape[1]) <= 0 or not self._is_imitated(
                columns, points[i], made[i], parts[i]
            ):
                return [(points[k], parts[k]) for k in order[n:]]
        return []

    def _kept(
        self, ranked: list[tuple[dict[str, float], np.ndarray]]
    ) -> list[tuple[dict[str, float], np.ndarray]]:
        return [(point, trace[self.kept]) for point, trace in ranked]

    def _best_frequency(
        self, trial: Trial, columns: Columns, tried: np.ndarray
    ) -> float:
        """The frequency whose waves explain most.

        The likely ones are exact, and from each the way leads uphill: beside a
        resonance the size of a trace, which tells what is likely, is known but
        coarsely.
        """
        name = trial.frequency
        assert name is not None

        def drops_at(at: list[int]) -> dict[int, float]:
            traces = self._wave_traces(columns, name, tried[at])
            return {
                k: self._regression(trial, traces[:, i])[1] for i, k in enumerate(at)
            }

        def beside(k: int) -> range:
            return range(max(k - 1, 0), min(k + 2, len(tried)))

        tops, drops = self._likely_frequencies(columns, name, tried), dict[int, float]()
        while new := sorted({k for top in tops for k in beside(top)} - drops.keys()):
            drops |= drops_at(new)
            tops = [max(beside(top), key=lambda k: drops[k]) for top in tops]
        return float(tried[max(drops, key=lambda k: drops[k])])

    def _likely_frequencies(
        self, columns: Columns, name: str, tried: np.ndarray
    ) -> list[int]:
        """Where in ``tried`` waves explain much; of few, all.

        The correlation of a wave's trace with the residuals needs no trace, only the
        residuals' adjoint: a Fourier sum. The size of the trace is interpolated,
        between more frequencies where the resonances are.
        """
        if len(tried) <= COARSE:
            return list(range(len(tried)))
        n, grid = self.n_theta, self.grid
        g = self.seen_of.T @ self.residual
        adjoint = self.reduced.multipliers(g[n:], self.covariance, g[:n])
        still = columns({name: 0.0})[0].sum(
            axis=1
        )  # a wave of frequency zero: cos = 1, sin = 0
        power = (adjoint * still).reshape(grid.n_intervals, -1).sum(axis=1)
        middle = grid.t[grid.begin] + grid.h / 2
        against = np.abs(_fourier(middle, power, tried)) ** 2
        even, dense = (
            np.linspace(0, len(tried) - 1, COARSE),
            np.geomspace(1, len(tried), COARSE) - 1,
        )
        coarse = tried[np.unique(np.concatenate([even, dense]).astype(int))]
        sizes = np.sum(self._wave_traces(columns, name, coarse) ** 2, axis=(0, 2))
        size = np.exp(np.interp(tried, coarse, np.log(np.maximum(sizes, TINY))))
        return [int(k) for k in _peaks(against / size)[:EXACT]]

    def _wave_traces(
        self, columns: Columns, name: str, tried: np.ndarray
    ) -> np.ndarray:
        """(n_values, n_tried, k)"""
        made = [columns({name: float(w)}) for w in tried]
        traces = self.traces(
            np.hstack([D for D, _ in made]), np.hstack([Y for _, Y in made])
        )
        return traces.reshape(len(traces), len(tried), -1)

    def _regression(
        self, trial: Trial, trace: np.ndarray
    ) -> tuple[np.ndarray, float, np.ndarray]:
        """Coefficients within their bounds, fall of the misfit, information."""
        information, right = trace.T @ trace, trace.T @ self.residual
        if not trial.linear:  # the effect has no coefficient: it is there as a whole
            return np.ones(1), float(2 * right[0] - information[0, 0]), information
        at_rest = [(0.0, 1.0)] * (trace.shape[1] - len(trial.linear))
        size = np.sqrt(np.maximum(np.diag(information), TINY))
        factor = np.linalg.cholesky(
            information / np.outer(size, size) + 1e-10 * np.eye(len(size))
        )
        bounds = [
            (
                trial.model.entries[name].parameter.lower,
                trial.model.entries[name].parameter.upper,
            )
            for name in trial.linear
        ]
        lower, upper = np.array(bounds + at_rest).T * size
        z = np.linalg.solve(factor, right / size)
        c = np.linalg.solve(factor.T, z)
        if np.any(c < lower) or np.any(c > upper):
            c = lsq_linear(factor.T, z, (lower, np.maximum(upper, lower + TINY))).x
        c = c / size
        return c, float(2 * c @ right - c @ information @ c), information

    def _strength(self, D: np.ndarray, Y: np.ndarray) -> float:
        """What a coefficient of one changes of a rate, or of what is shown, as a share
        of its size: free of units.
        """
        n = self.model.n_states
        rates, spread = self.grid.rates(self.x), np.std(self.x, axis=0)
        parts = [
            np.sqrt(np.mean(columns.reshape(-1, n, columns.shape[1]) ** 2, axis=(0, 2)))
            / np.maximum(size, TINY)
            for columns, size in ((D, np.sqrt(np.mean(rates**2, axis=0))), (Y, spread))
        ]
        return float(np.max(parts))

    def _is_imitated(
        self,
        columns: Columns,
        point: dict[str, float],
        made: tuple[np.ndarray, np.ndarray],
        trace: np.ndarray,
    ) -> bool:
        """Whether the base parameters can do what the effect does, along states that
        obey the base model.
        """
        own = columns.own
        if own is None:
            return False
        k = len(columns.trial.linear) or 1
        (D, Y), (D_own, Y_own) = made, own(point)
        here, there = (
            self._strength(D[:, :k], Y[:, :k]),
            self._strength(D_own[:, :k], Y_own[:, :k]),
        )
        left, trace = own.screen.traces(D_own[:, :k], Y_own[:, :k]), trace[:, :k]
        # Of no strength there: the base model's states do not reach what excites the
        # effect.
        return there > 0 and bool(
            np.sum(left**2) / there**2
            < IMITATED * np.sum(trace**2) / max(here, TINY) ** 2
        )

    def _judged(
        self,
        trial: Trial,
        columns: Columns,
        point: dict[str, float],
        trace: np.ndarray,
        n_tried: int,
    ) -> Screened | None:
        c, drop, information = self._regression(trial, trace)
        D, Y = columns(point)
        k = len(trial.linear) or 1
        strength = self._strength(D[:, :k], Y[:, :k])
        if (
            not np.all(np.isfinite(trace))
            or not np.trace(information) > NO_TRACE * strength**2
        ):
            return None
        drop = max(drop, 0.0)
        free = [name for name in trial.model.free if name not in self.model.entries]
        left = max(self.misfit - drop, 1.0) / max(self.n_values - len(c), 1)
        spread = np.sqrt(
            np.maximum(np.diag(np.linalg.pinv(information, hermitian=True)), 0.0)
            * max(left, 1.0)
        )
        values = {**point, **dict(zip(trial.linear, c.tolist(), strict=False))}
        values = {
            name: _within(trial.model, name, value) for name, value in values.items()
        }
        if trial.linear:
            size = (
                float(np.hypot(*c))
                if trial.frequency and len(c) == 2
                else float(c[k - 1])
            )
            error = float(np.max(spread)) if trial.frequency else float(spread[k - 1])
        else:
            size, error = next(iter(point.values())), np.nan
        residual = self.residual - trace @ c
        share = effective_sample_share(*self._by_run(trace @ c, residual))
        gain = (
            share
            * self.n_values
            * np.log(max(self.misfit, TINY) / max(self.misfit - drop, TINY))
        )
        n_free = len(free) + trace.shape[1] - k
        p = min(1.0, n_tried * float(chi2.sf(max(gain, 0.0), n_free)))
        beside, scanned = self.beside(D, Y, c), tuple(self._kept([(point, trace)]))
        return Screened(
            trial.effect,
            size,
            error,
            drop,
            n_free,
            n_tried,
            p,
            values,
            beside,
            trace,
            trace @ c,
            scanned,
        )


def _peaks(y: np.ndarray) -> np.ndarray:
    """Where y is larger than beside it, the largest first."""
    at = np.flatnonzero(local_maxima(y, last_of_plateau=True))
    return at[np.argsort(-y[at])]


def _fourier(t: np.ndarray, y: np.ndarray, frequencies: np.ndarray) -> np.ndarray:
    """sum y exp(i omega t) at evenly spaced frequencies: each wave is the last one
    times that of the spacing.
    """
    wave, turn = (
        y * np.exp(1j * frequencies[0] * t),
        np.exp(1j * (frequencies[1] - frequencies[0]) * t),
    )
    result = np.zeros(len(frequencies), dtype=complex)
    for k in range(len(frequencies)):
        result[k] = wave.sum()
        wave = wave * turn
    return result


def _finer(values: np.ndarray, best: float) -> np.ndarray:
    """The best value and a point towards each of its neighbours (of positive, sorted
    values), or below the least.
    """
    i = int(np.argmin(np.abs(values - best)))
    low, high = (
        values[i - 1] if i else best**2 / values[1],
        values[min(i + 1, len(values) - 1)],
    )
    around = [best, np.sqrt(low * best), np.sqrt(high * best)]
    return np.unique(around)


def _within(model: Model, name: str, value: float) -> float:
    parameter = model.entries[name].parameter
    return float(np.clip(value, parameter.lower, parameter.upper))

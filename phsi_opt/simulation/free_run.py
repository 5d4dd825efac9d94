"""The free run of a model at the samples of a record, stepped inside CasADi.

It is fast enough for thousands of records.

Every interval between two samples is a step of Dormand and Prince's explicit scheme of
order five. Steps whose error estimate is too large (at a kink, say) are cut in parts
and the run repeated; it is accepted when half the steps change it by less than
`TOLERANCE`. What cannot be made accurate in this way (a very stiff, broken off or
chaotic run) is left to SciPy (`simulate`), which is also the independent check of this
file.
"""

from dataclasses import dataclass
from functools import lru_cache
from threading import get_ident
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import RK45

from phsi_opt.data.checks import Hold, hold_of_each
from phsi_opt.data.smooth_inputs import SmoothInputs
from phsi_opt.model.model import Model
from phsi_opt.simulation.simulate import simulate
from phsi_opt.statistics import TINY

# change of the run with twice the steps, in standard deviations of each state along the
# run
TOLERANCE = 1e-6
MOST_STEPS_PER_GAP = 150  # per interval on average, beyond which SciPy is faster
LEAST_BUDGET = 20_000  # steps that a short record may take in any case
ROUNDS = 14  # of cutting steps
LARGEST_FACTOR = 8  # parts of a step in one round
FEW = 0.03  # share of the steps: so few are at kinks
CHAOTIC = 0.1  # change by twice the steps from which on no number of steps will do
# Where half the steps change the run too much, the aim for the estimated errors is
# lowered to this share of what would be in proportion, within limits.
SAFETY = 0.3
LARGEST_FALL = 1e-3
SMALLEST_FALL = 0.3
UNSTABLE = 4  # parts of every step after a run that left the range of numbers
LARGEST = 1e100  # squares of larger values leave the range of numbers
# steps per call of the compiled loop: large against the cost of a call, small against
# that of building it
CHUNK = 500
MOST_KEPT_LOOPS = 4  # right-hand sides whose compiled loops are kept
# Least spread of a state that errors are compared with, as a share of its own size and
# of the largest state's: rounding is not an error.
AT_REST = 1e-6
BESIDE_OTHERS = 1e-12
ROUNDING = 1e-6  # of a length over the usual one, when parts are counted


def free_run(
    model: Model, t: Any, x0: Any, u: Any = None, hold: Hold = "linear"
) -> np.ndarray:
    """Solve dx/dt = model(x, u, t) from x0 at t[0], accurate to about `TOLERANCE`.

    Args:
        model: with the present values of its parameters.
        t: (n_samples,) strictly increasing times.
        x0: (n_states,) starting state.
        u: (n_samples, n_inputs) inputs at t; None if the model has no inputs.
        hold: between the samples of u, as in `simulate`.

    Returns:
        (n_samples, n_states).

    Raises:
        DataError: wrong shapes, times or numbers, as in `simulate`.
        SolveError: the solution cannot be continued.
    """
    times = np.asarray(t, dtype=float)
    start = np.asarray(x0, dtype=float)
    inputs = np.zeros((times.size, 0)) if u is None else np.asarray(u, dtype=float)
    found = None
    of_each = hold_of_each(hold, model.inputs)
    if _is_usable(model, times, start, inputs):
        theta = tuple(model.theta.tolist())
        runs = _runs_of(model.rhs(), theta, get_ident())
        found = runs.run(times, start, inputs, of_each)
    if found is not None:
        return found
    # Arguments that cannot be used go to SciPy too: `simulate` says what is wrong with
    # them.
    return simulate(model, t, x0, u, hold=hold)


def rates(model: Model) -> ca.Function:
    """CasADi function (x, u, t) -> dx/dt with the present values of the parameters."""
    return _rates(model.rhs(), model.theta)


def _rates(rhs: ca.Function, theta: Any) -> ca.Function:
    x, u, t = (ca.SX.sym(rhs.name_in(i), rhs.size1_in(i)) for i in range(3))
    return ca.Function("rates", [x, u, t], [rhs(x, u, t, theta)])


@lru_cache(MOST_KEPT_LOOPS)
def _runs_of(rhs: ca.Function, theta: tuple[float, ...], thread: int) -> "Runs":
    """Of (x, u, t, theta) -> dx/dt with values of the parameters.

    Built once for the trajectories of a record, and of the one held out; once for every
    thread, whose runs are written over by the next.
    """
    return Runs(_rates(rhs, np.array(theta)))


def _is_usable(model: Model, t: np.ndarray, x0: np.ndarray, u: np.ndarray) -> bool:
    if t.ndim != 1 or t.size < 2:
        return False
    if x0.shape != (model.n_states,) or u.shape != (t.size, model.n_inputs):
        return False
    is_finite = all(bool(np.all(np.isfinite(values))) for values in (t, x0, u))
    return is_finite and bool(np.all(np.diff(t) > 0))


def _step(rhs: ca.Function, n_watched: int) -> ca.Function:
    """One step of Dormand and Prince's scheme of order five, with its error estimate.

    Its coefficients are SciPy's (J. R. Dormand and P. J. Prince 1980, "A family of
    embedded Runge-Kutta formulae", Journal of Computational and Applied Mathematics 6,
    19-26).

    Args:
        rhs: CasADi function (x, u, t) -> dx/dt; the inputs change linearly.
        n_watched: number of states, the first ones, whose errors are estimated.

    Returns:
        CasADi function (x, column) -> x after the step, size of the estimated error
        (n_watched,); the column holds the time, the length of the step, the inputs and
        their slopes.
    """
    n_inputs = rhs.size1_in(1)
    x = ca.SX.sym("x", rhs.size1_in(0))
    column = ca.SX.sym("column", 2 + 2 * n_inputs)
    t, h = column[0], column[1]
    u, slope = column[2 : 2 + n_inputs], column[2 + n_inputs :]
    rates: list[ca.SX] = []

    def change(weights: np.ndarray) -> ca.SX:
        """Length times the sum of weight * rate, without the weights that are zero."""
        terms = [
            w * rate for w, rate in zip(weights.tolist(), rates, strict=False) if w
        ]
        return h * sum(terms, ca.SX.zeros(x.numel()))

    for weights, c in zip([*RK45.A, RK45.B], [*RK45.C, 1.0], strict=True):
        after = x + change(weights)
        rates.append(rhs(after, u + c * h * slope, t + c * h))
    error = ca.fabs(change(RK45.E))[:n_watched]
    return ca.Function("step", [x, column], [after, error], {"cse": True})


class Runs:
    """Runs of one right-hand side; built once, run along any record.

    Args:
        rhs: CasADi function (x, u, t) -> dx/dt.
        watched: only the errors of so many states, the first ones, count (None: of
            all).
    """

    def __init__(self, rhs: ca.Function, watched: int | None = None) -> None:
        self.n_watched = watched or rhs.size1_in(0)
        step = _step(rhs, self.n_watched)
        self.loop = _Evaluated(step.mapaccum(CHUNK))

    def run(
        self,
        t: np.ndarray,
        x0: np.ndarray,
        u: np.ndarray,
        hold: np.ndarray,
        tolerance: float = TOLERANCE,
    ) -> np.ndarray | None:
        """The states from x0; None where explicit steps cannot make them accurate.

        Args:
            t: (n_samples,) strictly increasing times.
            x0: (n_states,) starting state.
            u: (n_samples, n_inputs).
            hold: (n_inputs,) what each input does between its samples.
            tolerance: as `TOLERANCE`.

        Returns:
            (n_samples, n_states).
        """
        record = _Record.of(t, u, hold)
        steps = _first_steps(t)
        aim = tolerance
        budget = max(MOST_STEPS_PER_GAP * len(t), LEAST_BUDGET)
        for _ in range(ROUNDS):
            run = self._along(record, x0, steps)
            parts = _parts(run, aim)
            if np.all(parts == 1):
                fine = self._along(record, x0, _cut(steps, 2 * parts))
                change = fine.change_from(run)
                if change < tolerance:
                    return fine.x
                if change > CHAOTIC:
                    return None
                fall = np.clip(SAFETY * tolerance / change, LARGEST_FALL, SMALLEST_FALL)
                aim *= float(fall)
                parts = _parts(run, aim)
            if 3 * parts.sum() > budget:  # this run, and one with half its steps
                return None
            steps = _cut(steps, parts)
        return None

    def _along(self, record: "_Record", x0: np.ndarray, steps: "_Steps") -> "_Run":
        """The run in the given steps; NaN from where it leaves the range of numbers."""
        columns = record.columns(steps)
        n_steps = len(steps.h)
        x = np.full((n_steps, len(x0)), np.nan)
        errors = np.full((n_steps, self.n_watched), np.nan)
        at = x0
        for first in range(0, n_steps, CHUNK):
            after, error = self.loop(at, columns[:, first : first + CHUNK])
            at = after[-1].copy()
            size = min(CHUNK, n_steps - first)
            chunk = slice(first, first + size)
            x[chunk] = after[:size]
            errors[chunk] = error[:size]
            if not np.all(np.isfinite(at)):
                break
        ends = np.flatnonzero(np.diff(steps.interval))
        at_samples = np.append(ends, n_steps - 1)
        return _Run(np.vstack([x0, x[at_samples]]), errors)


@dataclass(frozen=True, eq=False)
class _Steps:
    """The steps of a run, all arrays (n_steps,).

    Args:
        interval: between samples that each step is in.
        since: its time since the sample before.
        h: its length.
    """

    interval: np.ndarray
    since: np.ndarray
    h: np.ndarray


@dataclass(frozen=True, eq=False)
class _Record:
    """Times and inputs at the samples; the slope of the inputs in every interval, or
    what those are between samples that are smooth.
    """

    t: np.ndarray
    u: np.ndarray
    slope: np.ndarray
    is_smooth: np.ndarray
    smooth: SmoothInputs | None

    @classmethod
    def of(cls, t: np.ndarray, u: np.ndarray, hold: np.ndarray) -> "_Record":
        """The record with its slopes, which are zero where inputs are held."""
        slope = np.diff(u, axis=0) / np.diff(t)[:, None]
        slope[:, hold == "zero"] = 0.0
        is_smooth = hold == "cubic"
        smooth = SmoothInputs(t, u) if is_smooth.any() else None
        return cls(t, u, slope, is_smooth, smooth)

    def columns(self, steps: _Steps) -> np.ndarray:
        """Time, length, inputs and their slopes of every step, a column each; steps of
        length zero fill the chunk.
        """
        n_steps = len(steps.h)
        n_inputs = self.u.shape[1]
        n_filled = -(-n_steps // CHUNK) * CHUNK
        columns = np.zeros((2 + 2 * n_inputs, n_filled))
        begin = self.t[steps.interval] + steps.since
        slope = self.slope[steps.interval]
        inputs = self.u[steps.interval] + slope * steps.since[:, None]
        if self.smooth is not None:
            first, last = self.smooth.lines(begin, begin + steps.h)
            inputs = np.where(self.is_smooth, first, inputs)
            slope = np.where(self.is_smooth, (last - first) / steps.h[:, None], slope)
        columns[0, :n_steps] = begin
        columns[1, :n_steps] = steps.h
        columns[2 : 2 + n_inputs, :n_steps] = inputs.T
        columns[2 + n_inputs :, :n_steps] = slope.T
        return columns


@dataclass(frozen=True, eq=False)
class _Run:
    """States at the samples, (n_samples, n_states), and the estimated error of every
    step, (n_steps, n_watched).
    """

    x: np.ndarray
    errors: np.ndarray

    @property
    def watched(self) -> np.ndarray:
        """The states whose errors count, (n_samples, n_watched)."""
        return self.x[:, : self.errors.shape[1]]

    @property
    def is_finite(self) -> bool:
        """Whether the run stayed in the range of numbers."""
        is_state = np.all(np.abs(self.x) < LARGEST)
        is_error = np.all(np.abs(self.errors) < LARGEST)
        return bool(is_state and is_error)

    @property
    def scale(self) -> np.ndarray:
        """Spread of every watched state, (n_watched,); for one that rests a small share
        of its size.
        """
        x = self.watched
        size = np.max(np.abs(x), axis=0)
        spread = np.maximum(np.std(x, axis=0), AT_REST * size)
        least = max(BESIDE_OTHERS * np.max(size), TINY)
        return np.maximum(spread, least)

    @property
    def error(self) -> np.ndarray:
        """Largest error of every step, (n_steps,), in spreads of the states."""
        return np.asarray(np.max(self.errors / self.scale, axis=1))

    def change_from(self, other: "_Run") -> float:
        """Largest difference at a sample, in spreads of the states."""
        if not self.is_finite:
            return np.inf
        difference = np.abs(self.watched - other.watched)
        return float(np.max(difference / self.scale))


def _first_steps(t: np.ndarray) -> _Steps:
    """A step per interval; in a gap of the record as many as the samples that it would
    have held.
    """
    h = np.diff(t)
    samples = np.ceil(h / np.median(h) - ROUNDING)
    parts = samples.clip(1, MOST_STEPS_PER_GAP).astype(int)
    whole = _Steps(np.arange(len(h)), np.zeros(len(h)), h)
    return _cut(whole, parts)


def _parts(run: _Run, aim: float) -> np.ndarray:
    """Into how many parts to cut each step, (n_steps,), for an estimated error of at
    most ``aim`` in each.
    """
    if not run.is_finite:
        return np.full(len(run.errors), UNSTABLE)
    factor = (run.error / aim) ** 0.2  # the error is of order five
    parts = np.ceil(np.clip(factor, 1, LARGEST_FACTOR)).astype(int)
    is_cut = parts > 1
    # At a kink the order is lower than five, and few steps are cheap to cut.
    return np.where(is_cut, LARGEST_FACTOR, 1) if np.mean(is_cut) < FEW else parts


def _cut(steps: _Steps, parts: np.ndarray) -> _Steps:
    """Each step cut into equal parts."""
    first = np.repeat(np.cumsum(parts) - parts, parts)
    h = np.repeat(steps.h / parts, parts)
    place = np.arange(len(h)) - first
    since = np.repeat(steps.since, parts) + place * h
    return _Steps(np.repeat(steps.interval, parts), since, h)


class _Evaluated:
    """A CasADi function that is called many times, on NumPy's own memory.

    CasADi's own conversion of a result walks over it as a list of Python's numbers.

    Args:
        function: with dense arguments and results.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function  # its memory must outlive the buffer
        made: Any = function.buffer()
        self._buffer, self._evaluate = made
        self._arguments = []
        for i in range(function.n_in()):
            argument: Any = np.zeros(function.numel_in(i))
            self._arguments.append(argument)
            if argument.size:
                self._buffer.set_arg(i, memoryview(argument))
        self._results = []
        for i in range(function.n_out()):
            result: Any = np.zeros((function.size2_out(i), function.size1_out(i)))
            self._results.append(result)
            if result.size:
                self._buffer.set_res(i, memoryview(result))

    def __call__(self, *arguments: Any) -> list[np.ndarray]:
        """The results, each transposed: a row per column of CasADi's.

        They are written over by the next call.

        Args:
            arguments: arrays in the shapes of CasADi's arguments.
        """
        for own, given in zip(self._arguments, arguments, strict=True):
            own[:] = np.ravel(np.asarray(given, dtype=float), order="F")
        self._evaluate()
        return self._results

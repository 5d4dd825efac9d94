"""Runs of a model from a given state: by SciPy, and stepped inside CasADi.

`simulate` uses no program and no SRK4, so it can check both. It is not made for
thousands of runs: `free_run` is. There every interval between two samples is a step of
the classical Runge-Kutta scheme. Two half steps tell its error, and remove most of it.
Steps whose error is larger than a tolerance (at a kink, say) are cut in parts and the
run repeated. What would need too many of them (a very stiff run, or one that breaks
off) is left to SciPy.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import pairwise
from threading import get_ident
from typing import Any

import casadi as ca
import numpy as np
import scipy

from phsi_opt.arguments import require_choice, typed
from phsi_opt.data.checks import LARGEST_VALUE, Hold, hold_of_each
from phsi_opt.data.trajectory import InputCurve
from phsi_opt.errors import DataError, SolveError, shown, some_of
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import argument_symbols
from phsi_opt.statistics import TINY

Input = Callable[[float], Any]  # of the time
Force = Callable[[float, np.ndarray, np.ndarray], np.ndarray]  # of t, x, u
# evaluations without progress in time, before a simulation is given up
LONGEST_WAIT = 10_000
# evaluations between two samples, and those of a piece in all, that are never refused:
# some ten seconds of work
MOST_PER_SAMPLE = 1_000
ALWAYS_ALLOWED = 1_000_000
METHODS = ("LSODA", "RK45", "RK23", "DOP853", "Radau", "BDF")
TOO_FAST = (
    "The model is much faster than the time between samples. Use consistent units "
    "for rates, frequencies and times, or simulate a shorter time."
)


@typed
@interruptible
def simulate(
    model: Model,
    t: Any,
    x0: Any,
    u: Any = None,
    *,
    hold: Hold = "linear",
    method: str = "LSODA",
    force: Callable[[float, np.ndarray], np.ndarray] | None = None,
) -> np.ndarray:
    """Solve dx/dt = model(x, u, t) from x0 at t[0].

    Args:
        model: with the present values of its parameters.
        t: (n_samples,) strictly increasing times.
        x0: (n_states,) starting state.
        u: (n_samples, n_inputs) inputs at t, or a function of time; None if the model
            has no inputs.
        hold: between the samples of u, "linear", "zero" (zero-order hold) or "cubic"
            (a smooth input: the spline through the samples), or a mapping from the
            names of inputs to these; those it leaves out are "linear".
        method: of `scipy.integrate.solve_ivp`.
        force: function (t, x) -> (n_states,) that is added to dx/dt, for a force that
            is not part of the model.

    Returns:
        (n_samples, n_states).

    Raises:
        DataError: wrong shapes, times or numbers.
        SolveError: the solution cannot be continued.

    Examples:
        >>> decay = ph.FirstOrder(["x"], {"x": ph.formula("-x")})
        >>> ph.simulate(decay, [0.0, 1.0, 2.0], [1.0]).ravel().round(3)
        array([1.   , 0.368, 0.135])
    """
    require_choice("method", method, METHODS)
    t, x0, u = checked_arguments(model, t, x0, u)
    if force is not None:
        check_function("force(t, x)", model.states, force, t[0], x0)
    added = None if force is None else (lambda at, x, u: force(at, x))
    return simulate_forced(model, t, x0, u, added, hold=hold, method=method)


def simulate_forced(
    model: Model,
    t: Any,
    x0: Any,
    u: Any,
    force: Force | None,
    *,
    hold: Hold = "linear",
    method: str = "LSODA",
    past: np.ndarray | None = None,
) -> np.ndarray:
    """`simulate` with a force (t, x, u) -> (n_states,) that may depend on the inputs.

    And with the past of a `Trajectory`, from which delayed inputs come.

    Raises:
        DataError: wrong shapes, times or numbers.
        SolveError: the solution cannot be continued.
    """
    t, x0, u = checked_arguments(model, t, x0, u)
    held = hold_of_each(hold, model.inputs)
    if callable(u):
        longest = float(np.max(np.diff(t)))
        pieces = [(0, len(t) - 1, _with_delayed(model, u, t[0]), longest)]
        samples = np.arange(len(t))
    else:
        inputs = SampledInputs.of(model, t, u, held, past)
        t, samples = inputs.t, inputs.samples
        pieces = list(inputs.pieces())
    f = BufferedFunction(model.rhs())
    states = np.full((len(t), model.n_states), np.nan)
    states[0] = x0
    size = max(float(np.max(np.abs(x0))), 1e-3)  # below, `atol` falls no more
    for first, last, value, longest in pieces:
        most = ALWAYS_ALLOWED + MOST_PER_SAMPLE * (last - first)
        rate = _Rate(f, model.theta, force, value, most)
        times = t[first : last + 1]
        with np.errstate(all="ignore"):
            solution = scipy.integrate.solve_ivp(
                rate,
                (times[0], times[-1]),
                states[first],
                method,
                t_eval=times[1:],
                rtol=1e-8,
                atol=1e-10 * size,
                max_step=longest,
            )
        # Where it ends before the first sample, SciPy gives an empty list.
        y = np.reshape(solution.y, (model.n_states, -1))
        is_finite = np.all(np.isfinite(y), axis=0)
        n_good = int(np.sum(np.cumprod(is_finite)))
        if not solution.success or n_good < last - first:
            unstable = "A state is not finite there."
            why = solution.message if is_finite.all() else unstable
            raise _stopped(times[n_good], why)
        states[first + 1 : last + 1] = y.T
    return states[samples]


@dataclass(frozen=True, eq=False)
class SampledInputs:
    """The inputs of a model's functions along a record, where its delays stay.

    ``u`` (n, n_inputs) are those at times ``t``: the samples, at ``samples``, and where
    delayed ones arrive. ``slope`` is that of the straight lines between them, zero for
    inputs that are held (``is_held``); those that are ``smooth``, by their numbers, go
    on a spline instead.
    """

    t: np.ndarray
    u: np.ndarray
    samples: np.ndarray
    slope: np.ndarray
    is_held: np.ndarray
    smooth: dict[int, InputCurve]

    @classmethod
    def of(
        cls,
        model: Model,
        t: np.ndarray,
        u: np.ndarray,
        hold: np.ndarray,
        past: np.ndarray | None = None,
    ) -> "SampledInputs":
        """From samples (n_samples, n_inputs), and what each input does between them.

        Also from times and inputs before them (n, 1 + n_inputs), where these are known.
        """
        known = np.column_stack([t, u])
        if past is not None:
            known = np.vstack([past, known])
        at, *inputs = known.T
        curves = list(map(partial(InputCurve, at), inputs, hold))
        moments = t
        for name, delay in model.delays:
            own = curves[model.inputs.index(name)]
            late = replace(own, t=at + model.values[delay])
            after = np.searchsorted(moments, late.t).clip(1, len(moments) - 1)
            apart = np.abs(late.t - moments[[after - 1, after]]).min(axis=0)
            is_within = (t[0] < late.t) & (late.t < t[-1])
            new = late.t[(apart > own.instant) & is_within]
            moments = np.union1d(moments, new)
            curves.append(late)
        if model.delays:
            columns = [curve.after(moments) for curve in curves]
            slopes = np.zeros((len(moments), len(model.delays)))  # do not count
            u = np.column_stack([*columns, slopes])
        kinds = np.array([one.hold for one in curves] + ["zero"] * len(model.delays))
        slope = np.diff(u, axis=0) / np.diff(moments)[:, None]
        slope[:, kinds == "zero"] = 0.0
        smooth = {k: one for k, one in enumerate(curves) if one.hold == "cubic"}
        places = np.searchsorted(moments, t)
        return cls(moments, u, places, slope, kinds == "zero", smooth)

    @cached_property
    def _times(self) -> list[float]:
        return self.t.tolist()

    def at(self, last: int, time: float) -> np.ndarray:
        """The inputs (n_inputs,) before a sample, whose jump is not seen yet."""
        left = min(max(bisect_right(self._times, time) - 1, 0), last - 1)
        value = self.u[left] + (time - self.t[left]) * self.slope[left]
        for k, curve in self.smooth.items():
            value[k] = curve.after(np.array(time))
        return np.asarray(value)

    def pieces(self) -> Iterator[tuple[int, int, Input, float]]:
        """First and last time, inputs and longest step of pieces without a jump."""
        changes = np.any(np.diff(self.u[:-1, self.is_held], axis=0) != 0, axis=1)
        ends = np.flatnonzero(changes) + 1
        # No step may be longer than a sample, or a short pulse is stepped over.
        longest = np.inf if self.is_held.all() else float(np.max(np.diff(self.t)))
        for first, last in pairwise([0, *ends.tolist(), len(self.t) - 1]):
            yield first, last, partial(self.at, last), longest


def _with_delayed(model: Model, u: Input, begin: float) -> Input:
    """Inputs that are a function of the time, with the delayed ones behind them."""

    def value(time: float) -> np.ndarray:
        late = []
        for name, delay in model.delays:
            at = max(time - model.values[delay], begin)
            late.append(np.ravel(u(at))[model.inputs.index(name)])
        return np.concatenate([np.ravel(u(time)), late, np.zeros(len(late))])

    return value if model.delays else u


class BufferedFunction:
    """A CasADi function with dense arguments and results, on NumPy's own memory.

    CasADi's own conversion of a result walks over it as a list of Python's numbers.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function  # its memory must outlive the buffer
        made: Any = function.buffer()
        self._buffer, self._evaluate = made
        arguments = range(function.n_in())
        results = range(function.n_out())
        self._arguments = [np.zeros(function.size_in(i)[::-1]) for i in arguments]
        self._results = [np.zeros(function.size_out(i)[::-1]) for i in results]
        part: Any
        for i, part in enumerate(self._arguments):
            if part.size:
                self._buffer.set_arg(i, memoryview(part))
        for i, part in enumerate(self._results):
            if part.size:
                self._buffer.set_res(i, memoryview(part))

    def __call__(self, *arguments: Any) -> list[np.ndarray]:
        """The results, a row per column of CasADi's; so are the arguments.

        They are written over by the next call.
        """
        for own, given in zip(self._arguments, arguments, strict=True):
            own[:] = given
        self._evaluate()
        return self._results


@dataclass
class _Rate:
    """The right-hand side along a piece, with a bound on the number of calls."""

    # It stops a solver that calls it for ever where the solution ends, or with far more
    # steps than there are samples.
    f: BufferedFunction
    theta: np.ndarray
    force: Force | None
    value: Input
    left: int  # calls
    furthest: float = -np.inf
    waited: int = 0

    def __call__(self, at: float, x: np.ndarray) -> np.ndarray:
        if at > self.furthest:
            self.furthest = at
            self.waited = 0
        self.waited += 1
        if self.waited > LONGEST_WAIT:
            raise _stopped(at, "The steps became too small.")
        self.left -= 1
        if self.left < 0:
            raise _stopped(at, TOO_FAST)
        u = self.value(at)
        (rates,) = self.f(x, u, at, self.theta)
        return rates[0] + (0.0 if self.force is None else self.force(at, x, u))


def _stopped(at: float, why: str) -> SolveError:
    return SolveError(
        f"the simulation cannot be continued beyond t={at:g}: {why} The model may be "
        "unstable there; check the signs of its terms or simulate a shorter time."
    )


def _real_numbers(values: Any, name: str) -> np.ndarray:
    with suppress(ValueError):  # rows of different lengths
        array = np.asarray(values)
        if array.dtype.kind in "biuf":
            return array.astype(float)
    raise DataError(f"{name}={shown(values)} must be an array of real numbers.")


def check_function(
    called: str, names: Sequence[str], function: Callable[..., Any], *arguments: Any
) -> None:
    """Call a function once, and refuse one that does not return a number per name.

    Raises:
        DataError: it failed, or returned something else.
    """
    try:
        value = function(*arguments)
    except Exception as error:
        raise DataError(f"the function {called} failed: {shown(error)}.") from error
    size = _real_numbers(value, called).size
    if size != len(names):
        raise DataError(
            f"the function {called} returned {size} numbers; expected {len(names)}, "
            f"one for each of {some_of(list(names))}."
        )


def checked_arguments(
    model: Model, t: Any, x0: Any, u: Any
) -> tuple[np.ndarray, np.ndarray, Any]:
    """Times (n_samples,), starting state (n_states,), inputs (n_samples, n_inputs).

    Inputs that are a function are returned as they are.

    Raises:
        DataError: wrong shapes, times or numbers.
    """
    times = _real_numbers(t, "t")
    is_series = times.ndim == 1 and len(times) >= 2
    is_finite = np.all(np.isfinite(times))
    if not is_series or not is_finite or np.any(np.diff(times) <= 0):
        raise DataError(
            f"t of shape {times.shape} must be at least two finite, strictly "
            "increasing times."
        )
    start = _real_numbers(x0, "x0")
    if start.shape != (model.n_states,) or not np.all(np.abs(start) < LARGEST_VALUE):
        raise DataError(
            f"x0={shown(x0)} must be {model.n_states} finite numbers, one per state "
            f"({', '.join(model.states)})."
        )
    if callable(u):
        check_function("u(t)", model.inputs, u, times[0])
        return times, start, u
    n_inputs = len(model.inputs)
    expected = (len(times), n_inputs)
    if u is None and n_inputs:
        raise DataError(
            f"the model has inputs ({', '.join(model.inputs)}); give u of shape "
            f"{expected}."
        )
    values = np.zeros((len(times), 0)) if u is None else _real_numbers(u, "u")
    if values.ndim == 1 and n_inputs == 1:
        values = values[:, None]
    if values.shape != expected or not np.all(np.abs(values) < LARGEST_VALUE):
        raise DataError(
            f"u has shape {values.shape}; expected finite numbers of shape {expected}."
        )
    return times, start, values


# ---- the fast free run

# Steps per call of the compiled loop: large against the cost of a call, small against
# that of building it.
CHUNK = 500


def free_run(
    model: Model,
    t: Any,
    x0: Any,
    u: Any = None,
    hold: Hold = "linear",
    past: np.ndarray | None = None,
) -> np.ndarray:
    """`simulate`, accurate to about 1e-6 by steps built once where they serve.

    From the past of a `Trajectory`, if there is one.

    Raises:
        DataError: wrong shapes, times or numbers, as in `simulate`.
        SolveError: the solution cannot be continued.
    """
    times, start, inputs = checked_arguments(model, t, x0, u)
    of_each = hold_of_each(hold, model.inputs)
    theta = tuple(model.theta.tolist())
    runs = _runs_of(model.rhs(), theta, get_ident())
    found = runs.run(SampledInputs.of(model, times, inputs, of_each, past), start)
    if found is not None:
        return found
    return simulate_forced(model, t, x0, u, None, hold=hold, past=past)


def rates(rhs: ca.Function, theta: np.ndarray) -> ca.Function:
    """CasADi function (x, u, t) -> dx, which is dx/dt at given parameters."""
    given = argument_symbols(rhs)[:3]
    return ca.Function("rates", given, [rhs(*given, theta)], ["x", "u", "t"], ["dx"])


@lru_cache(maxsize=4)
def _runs_of(rhs: ca.Function, theta: tuple[float, ...], thread: int) -> "Runs":
    """Built once for all records with these parameters, and for every thread."""
    # A thread's runs are written over by its next.
    return Runs(rates(rhs, np.array(theta)))


def _step(rhs: ca.Function) -> ca.Function:
    """A step of the classical Runge-Kutta scheme, extrapolated to order five.

    A CasADi function (x, column) -> x after the step, size of the estimated error. The
    column holds the time, the length of the step, the inputs, which change linearly,
    and their slopes. Two half steps have a sixteenth of the error of a whole one.
    """
    x, u, t = argument_symbols(rhs)
    h = ca.SX.sym("h")
    slope = ca.SX.sym("slope", u.numel())
    moving = ca.vertcat(x, u, t)
    rate = ca.vertcat(rhs(x, u, t), slope, 1.0)
    f = ca.Function("f", [moving, slope], [rate])
    whole = ca.simpleRK(f, 1, 4)(moving, slope, h)[: x.numel()]
    halves = ca.simpleRK(f, 2, 4)(moving, slope, h)[: x.numel()]
    error = (halves - whole) / 15
    column = ca.vertcat(t, h, u, slope)
    after = halves + error
    return ca.Function("step", [x, column], [after, ca.fabs(error)], {"cse": True})


class Runs:
    """Runs of one right-hand side; built once, run along any record.

    Args:
        rhs: CasADi function (x, u, t) -> dx/dt.
        tolerance: of the error of a step, in standard deviations of each state along
            the run. The run itself is some hundred times as accurate as the sum of
            these.
        most_steps: per interval on average, beyond which SciPy is faster.
    """

    def __init__(
        self, rhs: ca.Function, tolerance: float = 1e-9, most_steps: int = 150
    ) -> None:
        self.loop = BufferedFunction(_step(rhs).mapaccum(CHUNK))
        self.tolerance = tolerance
        self.most_steps = most_steps

    def run(self, inputs: SampledInputs, x0: np.ndarray) -> np.ndarray | None:
        """The states (n_samples, n_states); None where explicit steps do not serve."""
        begins = inputs.t[:-1]
        gaps = np.diff(inputs.t)
        samples = np.rint(gaps / np.median(gaps))  # that a gap would have held
        parts = samples.clip(1, self.most_steps).astype(int)
        while parts.sum() <= self.most_steps * len(gaps):
            begins = _cut(begins, inputs.t[-1], parts)
            x, errors = self._along(inputs, x0, begins)
            parts = _parts(x, errors, self.tolerance)
            if np.all(parts == 1):
                return x[inputs.samples]
        return None

    def _along(
        self, inputs: SampledInputs, x0: np.ndarray, begins: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """States at the times, (n, n_states), and errors of steps, (n_steps, n_states).

        NaN from where the run leaves the range of numbers.
        """
        columns = _columns(inputs, begins)
        x = np.full((len(columns), len(x0)), np.nan)
        errors = x.copy()
        at = x0
        for first in range(0, len(columns), CHUNK):
            chunk = slice(first, first + CHUNK)
            x[chunk], errors[chunk] = self.loop(at, columns[chunk])
            at = x[chunk][-1]
            if not np.all(np.isfinite(at)):
                break
        last = np.searchsorted(begins, inputs.t[1:]) - 1
        return np.vstack([x0, x[last]]), errors[: len(begins)]


def _columns(inputs: SampledInputs, begins: np.ndarray) -> np.ndarray:
    """Time, length, inputs, slopes of each step, a row each; length 0: unused."""
    interval = np.searchsorted(inputs.t, begins, side="right") - 1
    h = np.diff(begins, append=inputs.t[-1])
    slope = inputs.slope[interval]
    u = inputs.u[interval] + slope * (begins - inputs.t[interval])[:, None]
    for k, curve in inputs.smooth.items():
        u[:, k], last, *_ = curve.lines(begins, begins + h)
        slope[:, k] = (last - u[:, k]) / h
    columns = np.column_stack([begins, h, u, slope])
    return np.pad(columns, ((0, -len(h) % CHUNK), (0, 0)))


def _cut(begins: np.ndarray, end: float, parts: np.ndarray) -> np.ndarray:
    """The begins of steps, each cut into equal parts; the last one ends at the end."""
    h = np.repeat(np.diff(begins, append=end) / parts, parts)
    first = np.repeat(np.cumsum(parts) - parts, parts)
    return np.repeat(begins, parts) + (np.arange(len(h)) - first) * h


def _parts(
    x: np.ndarray, errors: np.ndarray, tolerance: float, most: int = 8
) -> np.ndarray:
    """Parts to cut each step into, (n_steps,), so that its error is small enough.

    Errors are compared with the spread of the states along the run, (n, n_states): at
    least a millionth of their size, as rounding is not an error.
    """
    size = np.max(np.abs(x), axis=0)
    if not np.all(size < LARGEST_VALUE):  # the run left the range of numbers
        return np.full(len(errors), most // 2)
    rounding = 1e-6
    least = max(rounding**2 * np.max(size), TINY)
    spread = np.maximum(np.std(x, axis=0), np.maximum(rounding * size, least))
    share = np.max(errors / spread, axis=1) / tolerance
    return np.ceil(np.clip(share**0.2, 1, most)).astype(int)

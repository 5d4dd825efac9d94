"""Independent integration of a model by SciPy.

It uses no program and no SRK4, so it can check both.
It is not made for thousands of runs (`free_run` is), nor does it start from anything
but a given state.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from phsi_opt.data.checks import Hold, hold_of_each
from phsi_opt.data.smooth_inputs import SmoothInputs
from phsi_opt.errors import DataError, SolveError
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import Model

Input = Callable[[float], np.ndarray]  # of the time
Force = Callable[[float, np.ndarray, np.ndarray], np.ndarray]  # of t, x, u
RTOL = 1e-8
ATOL = 1e-10  # relative to the size of the starting state
SMALLEST_START = 1e-3  # size of the starting state below which ATOL falls no more
# evaluations without progress in time, before a simulation is given up
LONGEST_WAIT = 10_000
# evaluations between two samples, and those of a piece in all, that are never refused:
# some ten seconds of work
MOST_PER_SAMPLE = 1_000
ALWAYS_ALLOWED = 1_000_000
TOO_FAST = (
    "The model moves far faster than the samples lie apart; give rates, frequencies "
    "and times in units that fit together, or a shorter time."
)


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
        u: (n_samples, n_inputs) inputs at t, or a function of the time; None if the
            model has no inputs.
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
    """
    added: Force | None = None
    if force is not None:
        added = lambda at, x, u: force(at, x)  # noqa: E731
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
) -> np.ndarray:
    """`simulate` with a force that may depend on the inputs.

    Args:
        model: with the present values of its parameters.
        t: as x0, u, hold and method those of `simulate`.
        x0: starting state.
        u: inputs.
        force: function (t, x, u) -> (n_states,) that is added to dx/dt.
        hold: between the samples of u.
        method: of SciPy.

    Raises:
        DataError: wrong shapes, times or numbers.
        SolveError: the solution cannot be continued.
    """
    t = _checked_times(t)
    x0 = _checked_start(model, x0)
    pieces = _pieces(t, _inputs(model, t, u), hold_of_each(hold, model.inputs))
    f = _right_hand_side(model)
    states = np.full((len(t), model.n_states), np.nan)
    states[0] = x0
    size = max(float(np.max(np.abs(x0))), SMALLEST_START)
    for piece in pieces:
        samples = slice(piece.first + 1, piece.last + 1)
        states[samples] = _integrated(
            _Guarded(f, force, piece), t, states[piece.first], method, size
        )
    return states


@dataclass(frozen=True, eq=False)
class _Piece:
    """A stretch from the sample ``first`` to ``last`` over which the input is smooth.

    ``longest``: the longest step that may be taken.
    """

    first: int
    last: int
    value: Input
    longest: float


def _integrated(
    f: "_Guarded", t: np.ndarray, x0: np.ndarray, method: str, size: float
) -> np.ndarray:
    """The states at the samples of a piece after its first one."""
    piece = f.piece
    with np.errstate(all="ignore"):
        found = solve_ivp(
            f,
            (t[piece.first], t[piece.last]),
            x0,
            method,
            t_eval=t[piece.first + 1 : piece.last + 1],
            rtol=RTOL,
            atol=ATOL * size,
            max_step=piece.longest,
        )
    # Where it ends before the first sample, SciPy gives an empty list.
    y = np.reshape(found.y, (len(x0), -1))
    is_whole = y.shape[1] >= piece.last - piece.first
    is_finite = np.all(np.isfinite(y), axis=0)
    if not (found.success and is_whole and is_finite.all()):
        n_good = int(np.argmin(is_finite)) if not is_finite.all() else y.shape[1]
        furthest = t[piece.first + n_good]
        why = found.message if is_finite.all() else "A state is no finite number there."
        raise _stopped(furthest, why)
    return y.T


class _Guarded:
    """The right-hand side along a piece; stops a solver that calls it for ever where
    the solution ends, or with far more steps than there are samples.
    """

    def __init__(self, f: Force, force: Force | None, piece: _Piece) -> None:
        self.f = f
        self.force = force
        self.piece = piece
        self.furthest = -np.inf
        self.waited = 0
        n_samples = piece.last - piece.first
        self.left = ALWAYS_ALLOWED + MOST_PER_SAMPLE * n_samples

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
        u = self.piece.value(at)
        rate = self.f(at, x, u)
        return rate if self.force is None else rate + self.force(at, x, u)


def _stopped(at: float, why: str) -> SolveError:
    return SolveError(
        f"the simulation cannot be continued beyond t={at:g}: {why} The model may be "
        "unstable there; check the signs of its terms or simulate a shorter time."
    )


def _real_numbers(values: Any, name: str) -> np.ndarray:
    """An array of floats.

    Raises:
        DataError: these are no real numbers.
    """
    try:
        array = np.asarray(values)
        if array.dtype.kind in "biuf":
            return array.astype(float)
    except ValueError:  # rows of different lengths
        pass
    raise DataError(f"{name}={values!r} must be an array of real numbers.")


def _checked_times(t: Any) -> np.ndarray:
    times = _real_numbers(t, "t")
    is_series = times.ndim == 1 and len(times) >= 2
    is_finite = np.all(np.isfinite(times))
    if not is_series or not is_finite or np.any(np.diff(times) <= 0):
        raise DataError(
            f"t of shape {times.shape} must be at least two finite, strictly "
            "increasing times."
        )
    return times


def _checked_start(model: Model, x0: Any) -> np.ndarray:
    start = _real_numbers(x0, "x0")
    if start.shape != (model.n_states,) or not np.all(np.isfinite(start)):
        raise DataError(
            f"x0={x0!r} must be {model.n_states} finite numbers, one per state "
            f"({', '.join(model.states)})."
        )
    return start


def _inputs(model: Model, t: np.ndarray, u: Any) -> Any:
    """The inputs as a function of the time, or as an array (n_samples, n_inputs)."""
    if callable(u):
        size = np.size(u(t[0]))
        if size != model.n_inputs:
            raise DataError(
                f"the function u gave {size} numbers; expected {model.n_inputs}, one "
                "per input."
            )
        return u
    expected = (len(t), model.n_inputs)
    if u is None and model.n_inputs:
        raise DataError(
            f"the model has inputs ({', '.join(model.inputs)}); give u of shape "
            f"{expected}."
        )
    values = np.zeros((len(t), 0)) if u is None else _real_numbers(u, "u")
    if values.ndim == 1 and model.n_inputs == 1:
        values = values[:, None]
    if values.shape != expected or not np.all(np.isfinite(values)):
        raise DataError(
            f"u has shape {values.shape}; expected finite numbers of shape {expected}."
        )
    return values


def _pieces(t: np.ndarray, u: Any, hold: np.ndarray) -> Iterator[_Piece]:
    """The stretches over which the inputs are smooth.

    Args:
        t: (n_samples,) times.
        u: (n_samples, n_inputs), or a function of the time.
        hold: (n_inputs,) what each input does between its samples.
    """
    end = len(t) - 1
    sample = float(np.max(np.diff(t)))
    if callable(u):
        yield _Piece(0, end, partial(_called, u), sample)
    elif not u.shape[1]:
        yield _Piece(0, end, partial(_constant, u[0]), np.inf)
    else:
        is_held = hold == "zero"
        held = u[:, is_held]
        changes = np.flatnonzero(np.any(np.diff(held[:-1], axis=0) != 0, axis=1)) + 1
        moving = _moving(t, u, hold == "cubic")
        for first, last in pairwise([0, *changes.tolist(), end]):
            constant = partial(_constant, u[first])
            value = _by_input(is_held, constant, moving)
            # No step may be longer than a sample, or a short pulse is stepped over.
            yield _Piece(first, last, value, np.inf if is_held.all() else sample)


def _moving(t: np.ndarray, u: np.ndarray, is_smooth: np.ndarray) -> Input:
    """Inputs that go from sample to sample, on straight lines or smoothly."""
    slope = np.diff(u, axis=0) / np.diff(t)[:, None]
    lines = partial(_interpolated, t.tolist(), u, slope)
    return _by_input(is_smooth, SmoothInputs(t, u), lines) if is_smooth.any() else lines


def _by_input(chosen: np.ndarray, one: Input, other: Input) -> Input:
    """Of each input one function of the time where it is chosen, else the other."""
    if chosen.all():
        return one
    return partial(_chosen, chosen, one, other) if chosen.any() else other


def _chosen(chosen: np.ndarray, one: Input, other: Input, at: float) -> np.ndarray:
    return np.where(chosen, one(at), other(at))


def _called(u: Callable[[float], Any], at: float) -> np.ndarray:
    return np.atleast_1d(np.asarray(u(at), dtype=float))


def _interpolated(
    t: list[float], u: np.ndarray, slope: np.ndarray, at: float
) -> np.ndarray:
    """The input on the straight lines between its samples, constant outside them."""
    left = bisect_right(t, at) - 1
    left = min(max(left, 0), len(slope) - 1)
    since = max(at, t[0]) - t[left]
    longest = t[-1] - t[left]
    return u[left] + min(since, longest) * slope[left]


def _constant(value: np.ndarray, at: float) -> np.ndarray:
    return value


def _right_hand_side(model: Model) -> Force:
    """The right-hand side on NumPy buffers: no call costs a conversion."""
    made: Any = model.rhs().buffer()  # CasADi's own types say less than what it takes
    buffer, evaluate = made
    x = np.zeros(model.n_states)
    u = np.zeros(max(model.n_inputs, 1))
    t = np.zeros(1)
    theta = model.theta if model.free else np.zeros(1)
    dx = np.zeros(model.n_states)
    arguments: list[Any] = [x, u, t, theta]
    for i, array in enumerate(arguments):
        buffer.set_arg(i, memoryview(array))
    result: Any = dx
    buffer.set_res(0, memoryview(result))

    # CasADi holds bare pointers: ``alive`` keeps what nothing else refers to from being
    # freed under it.
    def f(
        at: float, state: np.ndarray, value: np.ndarray, alive: Any = (buffer, theta)
    ) -> np.ndarray:
        x[:] = state
        t[0] = at
        u[: len(value)] = value
        evaluate()
        return dx.copy()

    return f

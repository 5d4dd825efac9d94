"""Independent integration of a model by SciPy: no program, no SRK4, so it can check
both.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from phsi_opt.errors import DataError, SolveError
from phsi_opt.model.model import Model

RTOL, ATOL = 1e-8, 1e-10  # ATOL is relative to the size of the starting state
LONGEST_WAIT = (
    10_000  # evaluations without progress in time, before a simulation is given up
)


def simulate(
    model: Model,
    t: Any,
    x0: Any,
    u: Any = None,
    *,
    hold: str = "linear",
    method: str = "LSODA",
    force: Callable[[float, np.ndarray], np.ndarray] | None = None,
) -> np.ndarray:
    """Solve dx/dt = model(x, u, t) from x0 at t[0]; returns (n_samples, n_states).

    Args:
        t: (n_samples,) strictly increasing times.
        x0: (n_states,) starting state.
        u: (n_samples, n_inputs) inputs at t, or a function of the time; None if the
            model has no inputs.
        hold: between the samples of u, "linear" or "zero" (zero-order hold).
        method: of `scipy.integrate.solve_ivp`.
        force: function (t, x) -> (n_states,) that is added to dx/dt, for a force that
            is not part of the model.

    Raises `DataError` for wrong shapes and `SolveError` if the solution cannot be
    continued.
    """
    t, x0 = _checked_times(t), _checked_start(model, x0)
    pieces = _pieces(t, _inputs(model, t, u), hold)
    f = _right_hand_side(model)
    if force is not None:
        f = partial(_with_force, f, force)
    states = np.full((len(t), model.n_states), np.nan)
    states[0] = x0
    atol = ATOL * max(float(np.max(np.abs(x0))), 1e-3)
    for first, last, value, longest in pieces:
        guarded = _Guarded(f, value)
        with np.errstate(all="ignore"):
            piece = solve_ivp(
                guarded,
                (t[first], t[last]),
                states[first],
                method,
                t_eval=t[first + 1 : last + 1],
                rtol=RTOL,
                atol=atol,
                max_step=longest,
            )
        if (
            not piece.success
            or not np.all(np.isfinite(piece.y))
            or piece.y.shape[1] < last - first
        ):
            raise _stopped(piece.t[-1] if len(piece.t) else t[first], piece.message)
        states[first + 1 : last + 1] = piece.y.T
    return states


class _Guarded:
    """The right-hand side along one input; stops a solver that calls it for ever where
    the solution ends.
    """

    def __init__(
        self, f: Callable[..., np.ndarray], value: Callable[[float], np.ndarray]
    ) -> None:
        self.f, self.value, self.furthest, self.waited = f, value, -np.inf, 0

    def __call__(self, at: float, x: np.ndarray) -> np.ndarray:
        if at > self.furthest:
            self.furthest, self.waited = at, 0
        self.waited += 1
        if self.waited > LONGEST_WAIT:
            raise _stopped(at, "The steps became too small.")
        return self.f(at, x, self.value(at))


def _stopped(at: float, why: str) -> SolveError:
    return SolveError(
        f"the simulation cannot be continued beyond t={at:g}: {why} "
        "The model may be unstable there; check the signs of its terms or simulate a shorter time."
    )


def _checked_times(t: Any) -> np.ndarray:
    times = np.asarray(t, dtype=float)
    if (
        times.ndim != 1
        or len(times) < 2
        or not np.all(np.isfinite(times))
        or np.any(np.diff(times) <= 0)
    ):
        raise DataError(
            f"t of shape {times.shape} must be at least two finite, strictly increasing times."
        )
    return times


def _checked_start(model: Model, x0: Any) -> np.ndarray:
    start = np.asarray(x0, dtype=float)
    if start.shape != (model.n_states,) or not np.all(np.isfinite(start)):
        raise DataError(
            f"x0={x0!r} must be {model.n_states} finite numbers, one per state ({', '.join(model.states)})."
        )
    return start


def _inputs(model: Model, t: np.ndarray, u: Any) -> Any:
    if callable(u):
        size = np.size(u(t[0]))
        if size != model.n_inputs:
            raise DataError(
                f"the function u gave {size} numbers; expected {model.n_inputs}, one per input."
            )
        return u
    if u is None and model.n_inputs:
        raise DataError(
            f"the model has inputs ({', '.join(model.inputs)}); give u of shape ({len(t)}, {model.n_inputs})."
        )
    values = np.zeros((len(t), 0)) if u is None else np.asarray(u, dtype=float)
    if values.ndim == 1 and model.n_inputs == 1:
        values = values[:, None]
    if values.shape != (len(t), model.n_inputs) or not np.all(np.isfinite(values)):
        raise DataError(
            f"u has shape {values.shape}; expected finite numbers of shape ({len(t)}, {model.n_inputs})."
        )
    return values


def _pieces(
    t: np.ndarray, u: Any, hold: str
) -> Iterator[tuple[int, int, Callable[[float], np.ndarray], float]]:
    """Stretches over which the input is smooth: (first, last sample, input as a
    function of time, longest step).
    """
    end, step = len(t) - 1, float(np.max(np.diff(t)))
    if callable(u):
        yield 0, end, lambda at: np.atleast_1d(np.asarray(u(at), dtype=float)), step
    elif not u.shape[1]:
        yield 0, end, lambda at: u[0], np.inf
    elif hold == "zero":
        changes = np.flatnonzero(np.any(np.diff(u[:-1], axis=0) != 0, axis=1)) + 1
        for first, last in zip([0, *changes], [*changes, end], strict=True):
            yield int(first), int(last), partial(_constant, u[first]), np.inf
    elif hold == "linear":
        # No step may be longer than a sample, or a short pulse is stepped over.
        yield (
            0,
            end,
            partial(
                _interpolated, t.tolist(), u, np.diff(u, axis=0) / np.diff(t)[:, None]
            ),
            step,
        )
    else:
        raise DataError(f"hold={hold!r} is unknown; expected 'linear' or 'zero'.")


def _interpolated(
    t: list[float], u: np.ndarray, slope: np.ndarray, at: float
) -> np.ndarray:
    left = min(max(bisect_right(t, at) - 1, 0), len(slope) - 1)
    return u[left] + min(max(at, t[0]) - t[left], t[-1] - t[left]) * slope[left]


def _constant(value: np.ndarray, at: float) -> np.ndarray:
    return value


def _with_force(
    f: Callable[..., np.ndarray],
    force: Callable[..., np.ndarray],
    at: float,
    x: np.ndarray,
    u: np.ndarray,
) -> np.ndarray:
    return f(at, x, u) + force(at, x)


def _right_hand_side(
    model: Model,
) -> Callable[[float, np.ndarray, np.ndarray], np.ndarray]:
    """The right-hand side on NumPy buffers, without the cost of converting each call."""
    made: Any = model.rhs().buffer()  # CasADi's own types say less than what it takes
    buffer, evaluate = made
    x, u, t, dx = (
        np.zeros(model.n_states),
        np.zeros(max(model.n_inputs, 1)),
        np.zeros(1),
        np.zeros(model.n_states),
    )
    theta = np.array([model.values[name] for name in model.free] or [0.0])
    arrays: list[Any] = [x, u, t, theta, dx]
    for i, array in enumerate(arrays[:-1]):
        buffer.set_arg(i, memoryview(array))
    buffer.set_res(0, memoryview(arrays[-1]))

    # CasADi holds bare pointers: ``alive`` keeps what nothing else refers to from being
    # freed under it.
    def f(
        at: float, state: np.ndarray, value: np.ndarray, alive: Any = (buffer, theta)
    ) -> np.ndarray:
        x[:], t[0] = state, at
        u[: len(value)] = value
        evaluate()
        return dx.copy()

    return f

"""Simulation of models with a network, without torch."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from phsi_opt.errors import DataError, SolveError
from phsi_opt.simulation.simulate import ATOL, RTOL


def network_values(
    layers: Sequence[tuple[np.ndarray, np.ndarray]], v: np.ndarray, first: str = "relu"
) -> np.ndarray:
    """The same as `relu_network` in NumPy, (n_rows, n_outputs)."""
    for i, (weight, bias) in enumerate(layers[:-1]):
        v = v @ weight + bias
        v = np.tanh(v) if i == 0 and first == "tanh" else np.maximum(v, 0.0)
    result: np.ndarray = v @ layers[-1][0] + layers[-1][1]
    return result


def input_of(
    t: np.ndarray, u: Any, n_inputs: int, hold: str
) -> Callable[[float], np.ndarray]:
    """The inputs (n_samples, n_inputs) at t as a function of time, held as the
    measurements declared.
    """
    values = np.zeros((len(t), 0)) if u is None else np.asarray(u, dtype=float)
    if values.shape != (len(t), n_inputs):
        raise DataError(
            f"u has shape {values.shape}; expected ({len(t)}, {n_inputs}), a row per time."
        )
    if hold == "zero":
        return lambda at: np.asarray(
            values[np.clip(np.searchsorted(t, at, "right") - 1, 0, len(t) - 1)]
        )
    return lambda at: np.array([np.interp(at, t, column) for column in values.T])


def integrated(
    rhs: Callable[[float, np.ndarray], np.ndarray],
    t: Any,
    x0: Any,
    states: Sequence[str],
) -> np.ndarray:
    """Solve dx/dt = rhs(t, x) by SciPy's LSODA; (n_samples, n_states). Raises
    `DataError` and `SolveError`.
    """
    times, start = np.asarray(t, dtype=float), np.asarray(x0, dtype=float)
    if (
        times.ndim != 1
        or len(times) < 2
        or not np.all(np.isfinite(times))
        or np.any(np.diff(times) <= 0)
    ):
        raise DataError(
            f"t of shape {times.shape} must be at least two finite, strictly increasing times."
        )
    if start.shape != (len(states),) or not np.all(np.isfinite(start)):
        raise DataError(
            f"x0={x0!r} must be {len(states)} finite numbers, one per state ({', '.join(states)})."
        )
    atol = ATOL * max(float(np.max(np.abs(start))), 1e-3)
    longest = float(np.max(np.diff(times)))
    with np.errstate(all="ignore"):
        solved = solve_ivp(
            rhs,
            (times[0], times[-1]),
            start,
            "LSODA",
            t_eval=times,
            rtol=RTOL,
            atol=atol,
            max_step=longest,
        )
    if (
        not solved.success
        or not np.all(np.isfinite(solved.y))
        or solved.y.shape[1] < len(times)
    ):
        reached = solved.t[-1] if len(solved.t) else times[0]
        raise SolveError(
            f"the simulation cannot be continued beyond t={reached:g}: {solved.message}"
        )
    result: np.ndarray = solved.y.T
    return result

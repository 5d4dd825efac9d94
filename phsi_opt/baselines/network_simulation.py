"""Values and simulation of models with a trained network, without torch."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from phsi_opt.data.smooth_inputs import SmoothInputs
from phsi_opt.errors import DataError, SolveError
from phsi_opt.simulation.simulate import ATOL, RTOL

# (weight (n_in, n_out), bias (n_out,)) of every layer
Layers = tuple[tuple[np.ndarray, np.ndarray], ...]
# Size of the states below which the absolute tolerance does not shrink with them.
SMALLEST_SCALE = 1e-3


def network_values(
    layers: Sequence[tuple[np.ndarray, np.ndarray]], v: np.ndarray, first: str = "relu"
) -> np.ndarray:
    """Value (n_rows, n_outputs) of a network with ReLU between its layers.

    The same as ``torch_networks.relu_network``, in NumPy.
    """
    for i, (weight, bias) in enumerate(layers[:-1]):
        v = v @ weight + bias
        v = np.tanh(v) if i == 0 and first == "tanh" else np.maximum(v, 0.0)
    weight, bias = layers[-1]
    result: np.ndarray = v @ weight + bias
    return result


def state_rows(x: Any, n_states: int) -> np.ndarray:
    """States as an array (n_rows, n_states).

    Raises:
        DataError: if x has another number of columns.
    """
    states = np.atleast_2d(np.asarray(x, dtype=float))
    if states.ndim != 2 or states.shape[1] != n_states:
        raise DataError(
            f"x has shape {np.shape(x)}; expected (n, {n_states}), a column per state."
        )
    return states


def known_columns(
    states: Mapping[str, np.ndarray], t: Any, inputs: Sequence[str], u: Any
) -> dict[str, Any]:
    """Values by name of what a force may depend on; None where nothing was given.

    Args:
        states: values by name, (n_samples,) each.
        t: times (n_samples,), or None.
        inputs: names of the inputs.
        u: their values (n_samples, n_inputs), or None.
    """
    known: dict[str, Any] = dict(states)
    known["t"] = t
    columns = [None] * len(inputs) if u is None else np.atleast_2d(u).T
    known.update(zip(inputs, columns, strict=True))
    return known


def force_variables(
    variables: Sequence[str], known: Mapping[str, Any], n_rows: int
) -> np.ndarray:
    """The variables of a force, (n_rows, n_variables).

    Raises:
        DataError: if a variable was not given.
    """
    columns = []
    for name in variables:
        if known[name] is None:
            argument = "t" if name == "t" else "u"
            raise DataError(f"the force depends on {name!r}; give {argument} beside x.")
        columns.append(np.broadcast_to(known[name], n_rows))
    return np.stack(columns, 1)


def input_of(
    t: np.ndarray, u: Any, n_inputs: int, hold: str
) -> Callable[[float], np.ndarray]:
    """The inputs as a function of time, held as the measurements declared.

    Args:
        t: times (n_samples,).
        u: inputs (n_samples, n_inputs) at t; None for a model without inputs.
        n_inputs: number of inputs of the model.
        hold: between the samples, one of `HOLDS`.

    Raises:
        DataError: if u has another shape.
    """
    values = np.zeros((len(t), 0)) if u is None else np.asarray(u, dtype=float)
    if values.shape != (len(t), n_inputs):
        raise DataError(
            f"u has shape {values.shape}; expected ({len(t)}, {n_inputs}), "
            "a row per time."
        )

    def held(at: float) -> np.ndarray:
        last = np.searchsorted(t, at, "right") - 1
        return np.asarray(values[np.clip(last, 0, len(t) - 1)])

    def interpolated(at: float) -> np.ndarray:
        return np.array([np.interp(at, t, column) for column in values.T])

    if hold == "cubic":
        return SmoothInputs(t, values)
    return held if hold == "zero" else interpolated


def integrated(
    rhs: Callable[[float, np.ndarray], np.ndarray],
    t: Any,
    x0: Any,
    states: Sequence[str],
) -> np.ndarray:
    """Solve dx/dt = rhs(t, x) by SciPy's LSODA; (n_samples, n_states).

    Raises:
        DataError: if t does not increase, or x0 is not a number per state.
        SolveError: if the solution ends before the last time.
    """
    times = np.asarray(t, dtype=float)
    start = np.asarray(x0, dtype=float)
    _check_times(times)
    _check_start(start, x0, states)
    scale = max(float(np.max(np.abs(start))), SMALLEST_SCALE)
    # No step is longer than the longest between samples: none passes over a pulse of
    # the input.
    longest = float(np.max(np.diff(times)))
    with np.errstate(all="ignore"):
        solved = solve_ivp(
            rhs,
            (times[0], times[-1]),
            start,
            "LSODA",
            t_eval=times,
            rtol=RTOL,
            atol=ATOL * scale,
            max_step=longest,
        )
    complete = solved.success and solved.y.shape[1] >= len(times)
    if not complete or not np.all(np.isfinite(solved.y)):
        reached = solved.t[-1] if len(solved.t) else times[0]
        raise SolveError(
            f"the simulation cannot be continued beyond t={reached:g}: {solved.message}"
        )
    result: np.ndarray = solved.y.T
    return result


def _check_times(times: np.ndarray) -> None:
    listed = times.ndim == 1 and len(times) >= 2 and bool(np.all(np.isfinite(times)))
    if not listed or np.any(np.diff(times) <= 0):
        raise DataError(
            f"t of shape {times.shape} must be at least two finite, "
            "strictly increasing times."
        )


def _check_start(start: np.ndarray, given: Any, states: Sequence[str]) -> None:
    if start.shape != (len(states),) or not np.all(np.isfinite(start)):
        raise DataError(
            f"x0={given!r} must be {len(states)} finite numbers, "
            f"one per state ({', '.join(states)})."
        )

"""Motions of an experiment: by SciPy to 1e-8 with all that acts, and quickly, many
variations at once, of the model without the hidden effect.
"""

import warnings
from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from problems.field_machines.disturbances import Disturbance
from problems.field_machines.records import Array, Experiment, InputAt, Motion, Values
from problems.hidden_effects.truth import RunawayError

RTOL = 1e-8


def simulate(
    e: Experiment, size: float, disturbance: Disturbance | None = None
) -> Motion:
    """The motion with the hidden effect of a size, and what acts beside the model.

    Raises:
        RunawayError: the machine leaves every bound.
    """
    shape = e.starts.shape
    nothing = np.zeros((shape[0], 0))

    def rates(t: float, flat: Array, held: Array | None = None) -> Array:
        x = flat.reshape(shape)
        u = nothing if held is None else held
        if held is None and e.input_at is not None:
            u = e.input_at(t, x)
        dx = e.rates(x, u, e.values) + size * e.hidden.law(x, u)
        if disturbance is not None:
            dx[:, e.row] += disturbance.at(t, x)
        return dx.ravel()

    x = _sampled(rates, e) if e.is_sampled else _integrated(rates, e.t, e.starts)
    if e.input_at is None:
        return Motion(x, np.zeros((*x.shape[:2], 0)))
    u = [e.input_at(t, now) for t, now in zip(e.t, x, strict=True)]
    return Motion(x, np.array(u))


def _sampled(rates: object, e: Experiment) -> Array:
    """From sample to sample, the input held in between."""
    assert e.input_at is not None
    found = [e.starts]
    for begin, end in pairwise(e.t):
        held = e.input_at(begin, found[-1])
        both = np.array([begin, end])
        found.append(_integrated(rates, both, found[-1], (held,))[-1])
    return np.array(found)


def _integrated(
    rates: object, t: Array, starts: Array, arguments: tuple[Array, ...] = ()
) -> Array:
    """By LSODA; no kink and no step of the input is passed over."""
    options = {
        "method": "LSODA",
        "t_eval": t,
        "rtol": RTOL,
        "atol": RTOL * np.abs(starts).max(),
        "max_step": float(t[1] - t[0]),
        "args": arguments or None,
    }
    with np.errstate(over="ignore", invalid="ignore"), warnings.catch_warnings():
        # LSODA's own words about a machine that runs away.
        warnings.simplefilter("ignore", UserWarning)
        solved = solve_ivp(rates, (t[0], t[-1]), starts.ravel(), **options)
    if not solved.success or not np.isfinite(solved.y).all():
        raise RunawayError(f"no simulation to t = {t[-1]:.6g}: {solved.message}")
    return solved.y.T.reshape(len(t), *starts.shape)


def recorded(e: Experiment, u: Array) -> InputAt:
    """Inputs as they were recorded (n_samples, n_runs, n_inputs), whatever moves."""

    def input_at(t: float, x: Array) -> Array:
        place = (t - e.t[0]) / (e.t[1] - e.t[0])
        if e.hold == "zero":
            return u[min(int(place + 1e-9), len(u) - 1)]
        k = int(np.clip(place, 0, len(u) - 2))
        return u[k] + (place - k) * (u[k + 1] - u[k])

    return input_at


def quick_runs(e: Experiment, u: Array, values: Values, starts: Array) -> Array:
    """The model's own runs (n_samples, ..., n_runs, n_states) along recorded inputs.

    One step of Runge and Kutta between two samples. ``u``: (n_samples, n_runs,
    n_inputs); ``starts``: (..., n_runs, n_states).
    """
    x = starts
    found = [x]
    h = e.t[1] - e.t[0]
    # Values that are tried on the way may be far off.
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(len(e.t) - 1):
            begin = u[k]
            end = u[k] if e.hold == "zero" else u[k + 1]
            middle = (begin + end) / 2
            k1 = e.rates(x, begin, values)
            k2 = e.rates(x + h / 2 * k1, middle, values)
            k3 = e.rates(x + h / 2 * k2, middle, values)
            k4 = e.rates(x + h * k3, end, values)
            x = x + h / 6 * (k1 + 2 * (k2 + k3) + k4)
            found.append(x)
    return np.array(found)


def typical_rate(e: Experiment, size: float, motion: Motion) -> float:
    """Root mean square rate in the equation of the disturbance."""
    x = motion.x
    values: Mapping[str, float] = e.values
    rates = e.rates(x, motion.u, values) + size * e.hidden.law(x, motion.u)
    return float(np.sqrt(np.mean(rates[e.kept][:, e.row] ** 2)))

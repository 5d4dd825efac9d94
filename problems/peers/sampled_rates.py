"""Rates dx/dt from samples, for the methods that regress them (SINDy, LASSO).

PHSI needs none of this: its loss compares steps, not rates.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pysindy as ps

from phsi_opt.arguments import require_choice
from phsi_opt.data.checks import hold_of_each
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.trajectory import SmoothInputs, Trajectory
from phsi_opt.errors import DataError

# The Savitzky-Golay filter of pysindy's SmoothedFiniteDifference, with pysindy's own
# default of the window and of the degree.
WINDOW = 11  # samples
WINDOW_DEGREE = 3
# Share of their mean by which steps may differ and still count as equal: the rounding
# of times that were written as text.
STEP_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class SampledRates:
    """Rates, and where they hold.

    Attributes:
        x: states (n_rows, n_states).
        u: inputs (n_rows, n_inputs).
        t: times (n_rows,).
        dx: rates (n_rows, n_states).
    """

    x: np.ndarray
    u: np.ndarray
    t: np.ndarray
    dx: np.ndarray


def sampled_rates(data: Measurements, derivative: str) -> SampledRates:
    """The rates of all trajectories, one after the other.

    Args:
        data: every state at every sample.
        derivative: a name in `DERIVATIVES`.

    Raises:
        ModelError: if there is no such derivative.
        DataError: if it cannot be formed from these data.
    """
    require_choice("derivative", derivative, tuple(DERIVATIVES))
    rates_of = DERIVATIVES[derivative]
    hold = hold_of_each(data.hold, data.inputs)
    parts = [rates_of(run, hold) for run in data.trajectories]
    names = ("x", "u", "t", "dx")
    return SampledRates(
        *(np.concatenate([getattr(p, n) for p in parts]) for n in names)
    )


def _midpoint(run: Trajectory, hold: np.ndarray) -> SampledRates:
    """(x1 - x0)/h at (x0 + x1)/2, a row per interval."""
    h = np.diff(run.t)
    u = _mean_inputs(run, hold)
    dx = np.diff(run.x, axis=0) / h[:, None]
    return SampledRates(_middles(run.x), u, _middles(run.t), dx)


def _mean_inputs(run: Trajectory, hold: np.ndarray) -> np.ndarray:
    """The mean of the inputs in every interval, (n_samples - 1, n_inputs)."""
    mean = np.where(hold == "zero", run.u[:-1], _middles(run.u))
    if "cubic" not in hold:
        return mean
    first, last = SmoothInputs(run.t, run.u).lines(run.t[:-1], run.t[1:])
    return np.where(hold == "cubic", (first + last) / 2, mean)


def _middles(values: np.ndarray) -> np.ndarray:
    result: np.ndarray = (values[1:] + values[:-1]) / 2
    return result


def _finite_difference(run: Trajectory, hold: np.ndarray) -> SampledRates:
    """Differences of second order at each sample."""
    _check_length(run, 3, "finite difference")
    dx = np.asarray(ps.FiniteDifference(order=2)(run.x, run.t))
    return SampledRates(run.x, run.u, run.t, dx)


def _smoothed(run: Trajectory, hold: np.ndarray) -> SampledRates:
    """The same after a Savitzky-Golay filter, at the smoothed states."""
    _check_length(run, WINDOW, "smoothed")
    steps = np.diff(run.t)
    if np.ptp(steps) > STEP_ROUNDING * steps.mean():
        raise DataError(
            f"trajectory {run.name!r}: steps from {steps.min():g} to {steps.max():g}, "
            "but derivative='smoothed' needs equal ones; "
            "use 'midpoint' or 'finite difference'."
        )
    smoother = {"window_length": WINDOW, "polyorder": WINDOW_DEGREE}
    method = ps.SmoothedFiniteDifference(smoother_kws=smoother)
    dx = np.asarray(method(run.x, run.t))
    return SampledRates(np.asarray(method.smoothed_x_), run.u, run.t, dx)


DERIVATIVES: dict[str, Callable[[Trajectory, np.ndarray], SampledRates]] = {
    "midpoint": _midpoint,
    "finite difference": _finite_difference,
    "smoothed": _smoothed,
}


def _check_length(run: Trajectory, least: int, derivative: str) -> None:
    if run.n_samples < least:
        raise DataError(
            f"trajectory {run.name!r} has {run.n_samples} samples, "
            f"but derivative={derivative!r} needs at least {least}; use 'midpoint'."
        )

"""The values to which estimates tend where the model is wrong (White, 1982).

The plain likelihood of one measured position with white noise is least squares on the
model's response, with the initial state of every run free. Of many runs without noise
its minimum is where the estimates go as records of that kind grow (White, Econometrica
50). Found here without the package, from the exact response of a linear oscillator.
"""

from functools import cache

import numpy as np
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.signal import lfilter, ss2tf

from problems.benchmarks.disturbed_oscillator import (
    INTERVAL,
    MOTION_SEED,
    TRUTH,
    Disturbance,
    Draw,
    Layout,
    cubic_coefficient,
    positions,
)

# Runs without noise: they leave the limit unknown by a thirtieth of what a single run
# leaves, an eighth of what 16 leave.
N_RUNS = 1000


@cache
def estimate_limits(disturbance: Disturbance, samples: int) -> dict[str, float]:
    """Where the parameters tend with more and more runs of so many samples."""
    draw = Draw.of(MOTION_SEED, disturbance, Layout(N_RUNS, samples))
    shown = positions(draw, cubic_coefficient(disturbance.cubic_share))
    return least_squares_estimate(shown, draw.voltage)


def least_squares_estimate(shown: np.ndarray, voltage: np.ndarray) -> dict[str, float]:
    """Parameters of the linear oscillator from positions and voltages.

    Args:
        shown: (n_runs, n_samples) positions, m.
        voltage: (n_runs, n_samples), linear in between, V.
    """

    def residual(values: np.ndarray) -> np.ndarray:
        stiffness, damping, gain = values
        forced, free = _responses(stiffness, damping, voltage)
        basis = np.linalg.qr(free)[0]
        left = (shown - gain * forced).T
        left = left - basis @ (basis.T @ left)
        return np.asarray(left.ravel())

    found = least_squares(residual, list(TRUTH.values()), xtol=1e-12, ftol=1e-12)
    return dict(zip(TRUTH, found.x.tolist(), strict=True))


def _responses(
    stiffness: float, damping: float, voltage: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Positions from rest by the voltage, and by the two initial states alone.

    Returns:
        (n_runs, n_samples), and (n_samples, 2).
    """
    rates = np.zeros((4, 4))
    rates[0, 1] = 1.0
    rates[1, :3] = (-stiffness, -damping, 1.0)
    rates[2, 3] = 1.0 / INTERVAL
    over_interval = expm(rates * INTERVAL)
    step = over_interval[:2, :2]
    of_rise = over_interval[:2, 3]
    of_level = over_interval[:2, 2] - of_rise
    # With z = x - of_rise u the next state asks for the present voltage alone.
    into = of_level + step @ of_rise
    through, poles = ss2tf(step, into[:, None], np.eye(2)[:1], of_rise[:1, None])
    forced = lfilter(through[0], poles, voltage, axis=1)
    n_samples = voltage.shape[1]
    free = np.zeros((n_samples, 2))
    row = np.array([1.0, 0.0])
    for i in range(n_samples):
        free[i] = row
        row = row @ step
    return forced, free

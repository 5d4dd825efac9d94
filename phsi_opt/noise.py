"""A first guess of the measurement noise, from the data alone.

Each sample is predicted by the cubic through its four neighbours; what is left is noise (and curvature that the
sampling does not resolve, which is why this is only a first guess: `missing` estimates the noise with a model).
"""

import numpy as np

from phsi_opt.measurements import Measurements


def difference_noise(data: Measurements) -> np.ndarray:
    """Standard deviation of the noise per state, (n_states,); NaN where a state has too few samples."""
    return np.array([_channel([(r.t, r.x[:, k]) for r in data.trajectories]) for k in range(data.n_states)])


def _channel(runs: list[tuple[np.ndarray, np.ndarray]]) -> float:
    errors = [_standardised(t[np.isfinite(y)], y[np.isfinite(y)]) for t, y in runs if np.isfinite(y).sum() >= 5]
    if not errors:
        return np.nan
    # The median is not moved by the few samples at a jump of the force; 0.6745 turns it into a standard deviation.
    return float(np.median(np.abs(np.concatenate(errors))) / 0.6745)


def _standardised(t: np.ndarray, y: np.ndarray) -> np.ndarray:
    offsets = (-2, -1, 1, 2)
    middle = np.arange(2, len(t) - 2)
    weights = [
        np.prod([(t[middle] - t[middle + j]) / (t[middle + i] - t[middle + j]) for j in offsets if j != i], axis=0)
        for i in offsets
    ]
    predicted = sum(w * y[middle + i] for w, i in zip(weights, offsets, strict=True))
    spread = np.sqrt(1 + sum(w**2 for w in weights))
    return (y[middle] - predicted) / spread

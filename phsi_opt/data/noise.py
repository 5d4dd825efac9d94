"""A first guess of the measurement noise, from the data alone.

Each sample is predicted by the cubic through its four neighbours; what is left is noise
(and curvature that the sampling does not resolve, which is why this is only a first
guess: `missing` estimates the noise with a model).
"""

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError


def difference_noise(data: Measurements) -> np.ndarray:
    """Standard deviation of the noise per state, (n_states,); NaN where a state has too
    few samples.
    """
    return np.array(
        [
            _channel([(r.t, r.x[:, k]) for r in data.trajectories])
            for k in range(data.n_states)
        ]
    )


def _channel(runs: list[tuple[np.ndarray, np.ndarray]]) -> float:
    errors = [
        _standardised(t[np.isfinite(y)], y[np.isfinite(y)])
        for t, y in runs
        if np.isfinite(y).sum() >= 5
    ]
    if not errors:
        return np.nan
    # The median is not moved by the few samples at a jump of the force; 0.6745 turns it
    # into a standard deviation.
    return float(np.median(np.abs(np.concatenate(errors))) / 0.6745)


def _standardised(t: np.ndarray, y: np.ndarray) -> np.ndarray:
    offsets = (-2, -1, 1, 2)
    middle = np.arange(2, len(t) - 2)
    weights = [
        np.prod(
            [
                (t[middle] - t[middle + j]) / (t[middle + i] - t[middle + j])
                for j in offsets
                if j != i
            ],
            axis=0,
        )
        for i in offsets
    ]
    predicted = sum(w * y[middle + i] for w, i in zip(weights, offsets, strict=True))
    spread = np.sqrt(1 + sum(w**2 for w in weights))
    return (y[middle] - predicted) / spread


# least noise that is assumed, as a share of the spread of a channel: weights stay
# within double precision
CLEANEST = 1e-5


def initial_noise(data: Measurements, given: np.ndarray | None = None) -> np.ndarray:
    """Noise per state to start from: the given one, else from differences of the data;
    1 where nothing was measured.
    """
    guess = difference_noise(data) if given is None else given
    y = np.concatenate([run.x for run in data.trajectories])
    seen = [name in data.measured for name in data.states]
    if not any(
        np.nanmax(y[:, k]) > np.nanmin(y[:, k]) for k in range(len(seen)) if seen[k]
    ):
        raise DataError(
            f"every measured value of {', '.join(data.measured)} is the same ({np.nanmax(y):g}): nothing moves, so "
            "nothing can be identified. Check the columns, or measure while the system moves."
        )
    spread = np.array(
        [np.nanstd(y[:, k]) if seen[k] else 1.0 for k in range(len(seen))]
    )
    spread = np.where(
        spread > 0, spread, np.maximum(np.abs(np.nan_to_num(y)).max(axis=0), 1e-12)
    )
    guess = np.where(np.isfinite(guess), guess, 0.1 * spread)
    return np.where(
        [name in data.measured for name in data.states],
        np.maximum(guess, least_noise(y)),
        1.0,
    )


def least_noise(y: np.ndarray) -> np.ndarray:
    """Least noise that is assumed per channel of y (n_samples, n_states): without any,
    weights would be infinite.
    """
    seen = np.isfinite(y).any(axis=0)
    spread = np.array(
        [np.nanstd(y[:, k]) if seen[k] else 1.0 for k in range(y.shape[1])]
    )
    size = np.maximum(np.abs(np.nan_to_num(y)).max(axis=0), 1e-12)
    return CLEANEST * np.where(spread > 1e-12 * size, spread, size)

"""Where a model fails: trajectory, times, region of the states and frequency of the
missing force; sentences on it.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.sparse.linalg import spsolve

from phsi_opt.criteria import OUTSTANDING_FORCE
from phsi_opt.estimation.missing_force import ForceEstimate, force_deviation
from phsi_opt.force_analysis.force_record import MOST_SOLVED, ForceRecord, spectrum
from phsi_opt.statistics import TINY

N_WINDOWS, N_BINS = (
    10,
    8,
)  # parts of a trajectory, and of the range of a state, in which the force's size is taken


def located(path: ForceRecord) -> pd.DataFrame:
    """Where the missing force of every equation is strong, strongest first; a row per
    equation that may lack one.

    Columns: equation; trajectory (its name) and
    time_window where it is strongest; state_region where it is strong; frequency
    (cycles per unit of time; 0 for a force that is mostly constant); strength (rms);
    times_noise (strength over the typical standard deviation of the estimate: below 1
    it is not sure).
    """
    times = _times_noise(path.estimate)
    rows = []
    for k, name in enumerate(path.equations):
        w = path.force[:, k]
        strength = _rms(w)
        run, window = _window(path, w)
        rows.append(
            (
                name,
                path.trajectories[run],
                window,
                region_of(path, w, path.fit.model.states),
                _frequency(path, w),
                strength,
                times[k],
            )
        )
    columns = [
        "equation",
        "trajectory",
        "time_window",
        "state_region",
        "frequency",
        "strength",
        "times_noise",
    ]
    return pd.DataFrame(rows, columns=columns).sort_values(
        "strength", ascending=False, ignore_index=True
    )


def _times_noise(estimate: ForceEstimate) -> np.ndarray:
    """Size of the force over its typical (median) standard deviation, per equation.

    Both are those of the last sizes of force and noise: while the force's size still
    falls towards zero, the stored force is that of a larger size, and would seem
    certain.
    """
    linear, typical = estimate.linear, np.median(deviation_of(estimate), axis=0)
    force = spsolve(linear.L, linear.innovations).reshape(estimate.w.shape)
    return np.asarray(np.sqrt(np.mean(force**2, axis=0)) / np.maximum(typical, TINY))


def deviation_of(estimate: ForceEstimate) -> np.ndarray:
    """Standard deviation of the force, (n_intervals, n_forced), at as many intervals as
    fit in memory, else between.
    """
    return force_deviation(
        estimate, int(np.clip(MOST_SOLVED / estimate.linear.n_total, 16, 400))
    )


def _rms(w: np.ndarray) -> float:
    return float(np.sqrt(np.mean(w**2)))


def _sizes(w: np.ndarray, part: np.ndarray, n_parts: int) -> np.ndarray:
    """Root mean square of w in every part; 0 for an empty one."""
    count = np.bincount(part, minlength=n_parts)
    return np.sqrt(np.bincount(part, w**2, n_parts) / np.maximum(count, 1))


def _window(path: ForceRecord, w: np.ndarray) -> tuple[int, str]:
    """Number of the trajectory, and the tenth of it, where the force is strongest."""
    count = np.bincount(path.run)
    place = np.arange(len(w)) - (np.cumsum(count) - count)[path.run]
    part = path.run * N_WINDOWS + place * N_WINDOWS // count[path.run]
    size = _sizes(w, part, len(count) * N_WINDOWS)
    best = int(np.argmax(size))
    if size[best] > OUTSTANDING_FORCE * _rms(w):
        inside, note = np.flatnonzero(part == best), ""
    else:
        inside, note = np.flatnonzero(path.run == best // N_WINDOWS), " (throughout)"
    first, last = inside[0], inside[-1]
    begin, end = path.t[first] - path.h[first] / 2, path.t[last] + path.h[last] / 2
    return best // N_WINDOWS, f"{begin:.3g} to {end:.3g}{note}"


def region_of(path: ForceRecord, w: np.ndarray, names: Sequence[str]) -> str:
    """Ranges of the variables in which the force is strong; 'everywhere' where none
    stands out.
    """
    found = []
    for name in names:
        z = path.variable(name)
        low, high = np.quantile(z, [0.01, 0.99])
        edges = np.unique(np.linspace(low, high, N_BINS + 1))
        if len(edges) < 2:
            continue
        part = np.clip(np.searchsorted(edges, z) - 1, 0, len(edges) - 2)
        enough = np.bincount(part, minlength=len(edges) - 1) > 0.02 * len(w)
        strong = enough & (
            _sizes(w, part, len(edges) - 1) > OUTSTANDING_FORCE * _rms(w)
        )
        if (
            1 <= np.count_nonzero(np.diff(np.r_[False, strong].astype(int)) == 1) <= 2
            and not strong.all()
        ):
            found.append(f"{name} {_stretches(edges, strong)}")
    return ", ".join(found) or "everywhere"


def _stretches(edges: np.ndarray, strong: np.ndarray) -> str:
    """Neighbouring strong bins joined: '-1 to -0.6 or 0.7 to 1'."""
    change = np.diff(np.r_[False, strong, False].astype(int))
    begins, ends = (
        edges[np.flatnonzero(change == 1)],
        edges[np.flatnonzero(change == -1)],
    )
    return " or ".join(
        f"{low:.3g} to {high:.3g}" for low, high in zip(begins, ends, strict=True)
    )


def _frequency(path: ForceRecord, w: np.ndarray) -> float:
    """Frequency at which the force is strongest, in cycles per unit of time; 0 where
    most of it is constant.
    """
    if np.mean(w) ** 2 > np.mean(w**2) / 2:
        return 0.0
    f, amplitude = spectrum(path.t, path.run, w - np.mean(w))
    return float(f[np.argmax(amplitude)]) if amplitude.any() else 0.0


def uncertain(estimate: ForceEstimate, n_draws: int = 24, seed: int = 0) -> np.ndarray:
    """Draws of the estimate's error, (n_intervals, n_forced, n_draws), with its
    correlation in time.

    They are solutions of the linearised problem for random noise and random innovations
    of the prior, whose covariance is that of the force given the measurements.
    """
    linear, rng = estimate.linear, np.random.default_rng(seed)
    right = np.zeros((linear.n_total, n_draws))
    right[: linear.n_x] = linear.seen_of.T @ rng.normal(
        size=(linear.seen_of.shape[0], n_draws)
    )
    w = slice(linear.n_x, linear.n_x + linear.n_w)
    right[w] = linear.L.T @ rng.normal(size=(linear.L.shape[0], n_draws))
    return np.asarray(linear.factor.solve(right)[w]).reshape(*estimate.w.shape, n_draws)

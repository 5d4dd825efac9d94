"""What is done to a record before it is modelled: means, a filter, a trend less.

All channels are filtered alike, so that a linear model of them stays true. What was
done is a remark of the trajectory, which `Measurements.noticed` and reports tell.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from phsi_opt.data.noticed import DataLook, trend_of
from phsi_opt.data.trajectory import Trajectory
from phsi_opt.errors import DataError, shown
from phsi_opt.presentation.units import rate_unit, spaced, time_words

# The low-pass of `scipy.signal.resample_poly`: half of its length, in new samples, and
# the shape of its Kaiser window.
HALF_LENGTH = 10
KAISER = 5.0
MOST_FINE = 1e7  # even samples in one trajectory, before the filter


def with_remark(run: Trajectory, remark: str, **changes: object) -> Trajectory:
    """A trajectory with other arrays, and what was done to it."""
    words = "; ".join(filter(None, (run.remark, remark)))
    return replace(run, remark=words, **changes)  # type: ignore[arg-type]


def thinned_run(run: Trajectory, n: int, width: int, hold: np.ndarray) -> Trajectory:
    """A trajectory with a mean of ``width`` samples for every n; (n_inputs,) holds."""
    gaps = DataLook((run,)).gaps
    parts = pairwise([0, *(gaps + 1), run.n_samples])
    picked = np.concatenate([np.arange(a, b - width + 1, n) for a, b in parts])
    if len(picked) < 2:
        raise DataError(
            f"trajectory {run.name!r} has {run.n_samples} samples, too few for "
            f"thinned({shown(n)}): {len(picked)} would remain; expected at least 2."
        )

    def means(values: np.ndarray) -> np.ndarray:
        if width == 1:
            return values.copy()
        windows = np.lib.stride_tricks.sliding_window_view(values, width, axis=0)
        mean: np.ndarray = windows.mean(axis=-1)
        return mean

    t, x, u = map(means, (run.t, run.x, run.u))
    is_held = hold == "zero"
    changes = np.append(
        np.any(np.diff(u[:, is_held], axis=0), axis=1).nonzero(), len(t)
    )
    firsts = changes[np.searchsorted(changes, picked[:-1])] + 1
    is_between = firsts < picked[1:]
    is_between &= np.diff(np.searchsorted(gaps, picked)) == 0
    for first, end in np.c_[firsts, picked[1:]][is_between]:
        x[first] = np.nan
        lengths = np.diff(t[first : end + 1])
        u[first, is_held] = lengths @ u[first:end, is_held] / lengths.sum()
    rows = np.sort(np.append(picked, firsts[is_between]))
    what = f"means of {n} samples" if width > 1 else f"every sample of {n}"
    remark = what if n > 1 else ""
    return with_remark(run, remark, t=t[rows], x=x[rows], u=u[rows])


def resampled_run(
    run: Trajectory, step: float, hold: np.ndarray, unit: str
) -> Trajectory:
    """Behind a low-pass filter, at even times in every part without gaps."""
    from scipy.signal import firwin, upfirdn

    look = DataLook((run,))
    every = float(look.typical_steps[0])
    if step < 0.99 * every:
        raise DataError(
            f"resampled({shown(step)}): trajectory {run.name!r} has a sample every "
            f"{every:.4g}; expected a time that is not shorter."
        )
    n_new = np.ptp(run.t) / step - 2 * HALF_LENGTH
    n_fine = np.ptp(run.t) / every
    if n_new < 1 or n_fine > MOST_FINE:
        what = f"{max(n_new, 0):.0f} samples would remain"
        if n_new >= 1:
            what = f"its clock is too uneven (a sample every {every:.4g} or longer)"
        raise DataError(
            f"trajectory {run.name!r} cannot be resampled({shown(step)}): {what}, as "
            f"the filter needs {2 * HALF_LENGTH} new steps without a gap. Choose "
            "another time, or `thinned`."
        )
    n = max(int(np.ceil(step / every - 0.01)), 2)  # finer samples for each new one
    kernel = firwin(2 * HALF_LENGTH * n + 1, 1 / n, window=("kaiser", KAISER))
    values = np.hstack([run.x, run.u])
    is_held = np.r_[np.zeros(run.x.shape[1], bool), hold == "zero"]
    times = []
    parts = []
    for a, b in pairwise([0, *(look.gaps + 1), run.n_samples]):
        t = run.t[a:b]
        fine = np.arange(t[0], t[-1] + step / n / 1e3, step / n)
        n_new = (len(fine) - len(kernel)) // n + 1
        if n_new < 1:
            continue
        # A held value at a jump is the mean of both sides.
        sides = np.searchsorted(t, fine + step / n * np.array([[-0.25], [0.25]])) - 1
        columns = []
        for held, one in zip(is_held, values[a:b].T, strict=True):
            even = np.interp(fine, t, one)
            if held:
                even = one[np.clip(sides, 0, len(t) - 1)].mean(axis=0)
            filtered = upfirdn(kernel, even, 1, n)
            columns.append(filtered[2 * HALF_LENGTH :][:n_new])
        times.append(fine[HALF_LENGTH * n :: n][:n_new])
        parts.append(np.array(columns).T)
    n_found = sum(map(len, times))
    if n_found < 2:
        raise DataError(
            f"trajectory {run.name!r} cannot be resampled({shown(step)}): {n_found} "
            f"samples would remain, as the filter needs {2 * HALF_LENGTH} new steps "
            "without a gap. Choose a shorter time, or `thinned`."
        )
    found = np.vstack(parts)
    n_states = run.x.shape[1]
    remark = f"low-pass filtered, then a sample every {time_words(step, unit)}"
    changes = {"t": np.concatenate(times), "past": run.past[:0]}
    changes |= {"x": found[:, :n_states], "u": found[:, n_states:]}
    return with_remark(run, remark, **changes)


def detrended_run(
    run: Trajectory, places: Mapping[str, int], units: Mapping[str, str]
) -> Trajectory:
    """Channels without their trend, their means kept; their columns by name."""
    values = np.hstack([run.x, run.u])
    n_states = run.x.shape[1]
    past = run.past.copy()
    told = []
    for name, place in places.items():
        column = values[:, place]
        is_known = np.isfinite(column)
        if is_known.sum() > 1:
            slope, _ = trend_of(run.t[is_known], column[is_known])
            middle = run.t[is_known].mean()
            values[:, place] -= slope * (run.t - middle)
            if place >= n_states:
                past[:, 1 + place - n_states] -= slope * (past[:, 0] - middle)
            rate = spaced(rate_unit(units[name], units["t"]))
            told.append(f"{name} less a trend of {slope:.3g}{rate}")
    changes = {"x": values[:, :n_states], "u": values[:, n_states:], "past": past}
    return with_remark(run, "; ".join(told), **changes)

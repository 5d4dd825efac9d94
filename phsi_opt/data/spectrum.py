"""The spectrum of every channel, before there is a model."""

from itertools import pairwise

import numpy as np

from phsi_opt.data.noticed import DataLook
from phsi_opt.errors import DataError
from phsi_opt.presentation.charts import FORCE, LOG, MODEL, Chart, Curve, Panel
from phsi_opt.presentation.numbers import label
from phsi_opt.presentation.units import computed_unit, scale_of

N_SEGMENTS = 8  # of a record of several lengths, so that the spectrum is smooth
LEAST_SAMPLES = 32  # of a segment


def spectrum_of(look: DataLook) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (n,), in cycles per unit of time, and amplitude densities.

    Welch's method (IEEE Transactions on Audio and Electroacoustics 15, 1967): segments
    that overlap by half, each less its line, under Hann's window; the mean of their
    squares. Times are made even by interpolation; parts end at gaps and missing values.

    Returns:
        Frequencies, and one row of amplitude densities (unit per square root of the
        frequency's) for each channel, NaN where it has no segment.

    Raises:
        DataError: no part of the record is long enough.
    """
    from scipy.signal import welch

    step = float(np.max(look.typical_steps))
    parts = []
    for number, run in enumerate(look.trajectories):
        first = int(np.flatnonzero(look.run == number)[0])
        gaps = look.gaps[(look.gaps >= first) & (look.gaps < first + run.n_samples - 1)]
        values = np.hstack([run.x, run.u]).T
        for a, b in pairwise([0, *(gaps - first + 1), run.n_samples]):
            parts.append(_even(run.t[a:b], values[:, a:b], step))
    longest = max(map(np.size, parts)) // len(values)
    n_samples = sum(map(np.size, parts)) // len(values)
    n = max(min(n_samples // N_SEGMENTS * 2, longest), LEAST_SAMPLES)
    if longest < n:
        raise DataError(
            f"no part of the record has {n} samples without a gap, which a spectrum "
            "needs; choose longer runs."
        )
    total = np.zeros(())
    weights = np.zeros(())
    for part in parts:
        weight = 2 * part.shape[1] // n - 1
        if weight < 1:
            continue
        is_known = np.isfinite(part[:, :1])
        filled = np.where(is_known, part, 0.0)
        frequencies, power = welch(filled, 1 / step, nperseg=n, detrend="linear")
        total = total + weight * power
        weights = weights + weight * is_known
    with np.errstate(invalid="ignore"):  # of a channel that was not measured
        densities = np.sqrt(total / weights)
    return frequencies[1:], np.asarray(densities)[:, 1:]


def _even(t: np.ndarray, values: np.ndarray, step: float) -> np.ndarray:
    """Channels (n_channels, n) at even times; NaN where half or more are missing."""
    even = np.arange(t[0], t[-1] + step / 2, step)
    found = np.full((len(values), len(even)), np.nan)
    for row, y in zip(found, values, strict=True):
        is_known = np.isfinite(y)
        if np.mean(is_known) > 0.5:
            row[:] = np.interp(even, t[is_known], y[is_known])
    return found


def spectrum_chart(look: DataLook) -> Chart:
    """The amplitude density of every channel over frequency, states first."""
    frequencies, densities = spectrum_of(look)
    time = look.units["t"]
    computed = computed_unit(time)
    size = scale_of(computed).size if computed == "s" else 0.0  # s
    unit = "Hz" if size else f"1/{time}" if time else ""
    x = frequencies / (size or 1.0)
    root = np.sqrt(size or 1.0)
    panels = []
    for one, density in zip(look.channels, densities, strict=True):
        if np.isfinite(density).any() and np.nanmax(density) > 0:
            curve = Curve("", x, density * root, FORCE if one.hold else MODEL)
            of = label(one.called, f"{one.unit}/√{unit}" if one.unit and unit else "")
            panels.append(Panel(of, (curve,), height=0.55, scale=LOG))
    return Chart(label("frequency", unit), tuple(panels), "spectrum")

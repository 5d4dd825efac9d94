"""Forces that repeat in time.

A wave with its second harmonic has a frequency that is sought on the stretches of time
that a fit sees, so that it earns nothing by being sought.
"""

from functools import partial

import numpy as np

from phsi_opt.data.spectrum import spectrum
from phsi_opt.force_analysis.cross_validation import piecewise_linear_basis
from phsi_opt.force_analysis.force_record import Force
from phsi_opt.statistics import TINY, local_maxima

# ---- one wave ------------------------------------------------------------------------


def harmonics(phase: np.ndarray) -> np.ndarray:
    """Sine and cosine of a phase (n,), and of twice the phase, (n, 4)."""
    twice = 2 * phase
    waves = [np.sin(phase), np.cos(phase), np.sin(twice), np.cos(twice)]
    return np.column_stack(waves)


def _power(z: np.ndarray, y: np.ndarray, frequencies: np.ndarray) -> np.ndarray:
    """Fall of the sum of squares of y (n,) by a wave of each frequency along z (n,)."""
    # In the phase in which sine and cosine are orthogonal (Lomb, Astrophysics and Space
    # Science 39, 1976). Squares are sums over the samples.
    wave = np.exp(2j * np.pi * np.outer(frequencies, z))
    of_twice = np.sum(wave**2, axis=1)
    turned = wave @ y * np.exp(-0.5j * np.angle(of_twice))
    cosine = (len(z) + np.abs(of_twice)) / 2
    sine = np.maximum(len(z) - cosine, TINY)
    fall: np.ndarray = turned.real**2 / cosine + turned.imag**2 / sine
    return fall


def _near(candidates: np.ndarray, width: float, n_tried: int = 21) -> np.ndarray:
    """Frequencies about the candidates; the candidates if none is positive."""
    tried = np.add.outer(candidates, width * np.linspace(-1, 1, n_tried)).ravel()
    is_positive = tried > 0
    return tried[is_positive] if is_positive.any() else candidates


def _drawn(is_fitted: np.ndarray, most: int = 3000) -> np.ndarray:
    """Places of all that is fitted, or a random choice of them where there are many."""
    places = np.flatnonzero(is_fitted)
    if len(places) <= most:
        return places
    rng = np.random.default_rng(0)
    return np.sort(rng.choice(places, most, replace=False))


# ---- along the time ------------------------------------------------------------------


def functions_of_time(force: Force, is_fitted: np.ndarray) -> np.ndarray:
    """Slow changes, and the wave that fits best, (n_intervals, n_slow + 4)."""
    t = force.record.t
    frequency = _frequency_in_time(force, is_fitted)
    waves = harmonics(2 * np.pi * frequency * (t - t[0]))
    return np.hstack([piecewise_linear_basis(t, n_knots=6), waves])


def period_of(force: Force) -> float | None:
    """Period of the wave in a force that depends on time, within the longest run."""
    everywhere = np.full(len(force.w), True)
    functions = functions_of_time(force, everywhere)
    coefficients = np.linalg.lstsq(functions, force.w, rcond=None)[0]
    wave = functions[:, -4:] @ coefficients[-4:]
    slow = functions[:, :-4] @ coefficients[:-4]
    period = 1 / _frequency_in_time(force, everywhere)
    ends = np.flatnonzero(np.diff(force.record.run)) + 1
    longest = max(map(np.ptp, np.split(force.record.t, ends)))
    return None if np.var(slow) > np.var(wave) or period > longest else period


def _frequency_in_time(force: Force, is_fitted: np.ndarray) -> float:
    """Frequency of the wave that fits best, in cycles per unit of time."""
    t = force.record.t
    varying = np.where(is_fitted, force.w - force.w[is_fitted].mean(), 0.0)
    found = spectrum(t, force.record.run, varying)
    height = found.amplitudes * local_maxima(found.amplitudes)
    peaks = found.frequencies[np.argsort(-height)[:3]]
    tried = _near(peaks, found.resolved)
    places = _drawn(is_fitted)
    power = partial(_power, t[places] - t[0], varying[places])
    best = tried[[np.argmax(power(tried))]]
    nearer = _near(best, found.resolved / 10)
    return float(nearer[np.argmax(power(nearer))])

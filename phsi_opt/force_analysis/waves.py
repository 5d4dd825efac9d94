"""Frequencies of a missing force, and forces that repeat in time.

Spectra say at which frequency a force is strong, with even or uneven samples. A wave
with its second harmonic has a frequency that is sought on the stretches of time that a
fit sees, so that it earns nothing by being sought.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy

from phsi_opt.force_analysis.cross_validation import piecewise_linear_basis
from phsi_opt.force_analysis.force_record import Force
from phsi_opt.statistics import TINY, local_maxima

POINTS_PER_FREQUENCY = 4  # points of a spectrum per resolved frequency


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Amplitudes by frequency, of one signal (n_frequencies,) or k (n_frequencies, k).

    Frequencies are in cycles per unit of time; a sine of amplitude A has the peak A.
    """

    frequencies: np.ndarray
    amplitudes: np.ndarray

    @property
    def peak(self) -> float:
        """Frequency of the largest amplitude; 0 where all are 0."""
        strongest = self.frequencies[np.argmax(self.amplitudes, axis=0)]
        return float(np.max(strongest * self.amplitudes.any(axis=0)))

    @property
    def resolved(self) -> float:
        """Distance of frequencies that the record tells apart; 0 where it is short."""
        return float(POINTS_PER_FREQUENCY * np.sum(np.diff(self.frequencies[:2])))


def spectrum(t: np.ndarray, run: np.ndarray, signal: np.ndarray) -> Spectrum:
    """Amplitude spectrum of one signal or several along trajectories.

    Trajectories are resampled to even steps, tapered (Hann), and averaged in the mean
    square. Frequencies below one cycle per longest trajectory are left out. Times and
    numbers of their trajectories are (n,), each trajectory one stretch of increasing
    times; the signal is (n,), or (n, k) for k signals.
    """
    runs = np.split(np.arange(len(t)), np.flatnonzero(np.diff(run)) + 1)
    runs = [inside for inside in runs if len(inside) > 2]
    duration = max((float(np.ptp(t[inside])) for inside in runs), default=0.0)
    if duration == 0.0:
        return Spectrum(np.zeros(1), np.zeros((1, *signal.shape[1:])))
    typical_steps = [float(np.median(np.diff(t[inside]))) for inside in runs]
    # One short step among millions of long ones does not decide the size.
    step = max(min(typical_steps), duration / 2**18)
    n_fft = scipy.fft.next_fast_len(
        POINTS_PER_FREQUENCY * int(duration / step + 2), real=True
    )
    frequencies = np.fft.rfftfreq(n_fft, step)
    mean_square = np.zeros((len(frequencies), *signal.shape[1:]))
    for inside in runs:
        times = t[inside]
        even = np.arange(times[0], times[-1] + step / 2, step)
        taper = np.hanning(len(even) + 2)[1:-1]
        columns = signal[inside].reshape(len(times), -1).T
        sampled = np.array([np.interp(even, times, column) for column in columns])
        transform = np.fft.rfft(sampled * taper, n_fft).T
        amplitude = 2 * np.abs(transform) / taper.sum()
        share = len(inside) / len(t)
        mean_square += share * amplitude.reshape(mean_square.shape) ** 2
    kept = frequencies * duration > 0.999  # rounding does not lose one cycle
    return Spectrum(frequencies[kept], np.sqrt(mean_square[kept]))


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

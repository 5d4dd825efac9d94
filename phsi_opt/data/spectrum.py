"""At which frequency a signal is strong, with even or uneven samples."""

from dataclasses import dataclass

import numpy as np
import scipy

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

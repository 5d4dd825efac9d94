"""The frequency at which a wave explains most of what a record leaves.

A right-hand side per frequency would be too many. The correlation of a wave's trace
with the residuals needs no trace, only the residuals' adjoint: a Fourier sum. The size
of the trace is interpolated between some frequencies, even and logarithmic ones, so
that a resonance does not fall between two. The likely frequencies are then worked out
exactly, and from each the way leads uphill: beside a resonance the interpolated size
can be twenty times wrong.
"""

import numpy as np

from phsi_opt.screening.regression import regression
from phsi_opt.screening.sensitivities import Sensitivities
from phsi_opt.statistics import TINY, local_maxima

# Even, and as many logarithmic, frequencies at which the size of a wave's trace is
# worked out: with 24 even ones the resonance of a model without damping fell between.
N_EXACT_SIZES = 30
N_EXACT_PEAKS = 8  # highest peaks of the estimated gain that are worked out exactly
N_TOGETHER = 50  # waves whose traces are worked out at once


def best_frequency(
    whole: Sensitivities, part: Sensitivities, name: str, tried: np.ndarray
) -> float:
    """The frequency among ``tried`` (evenly spaced, rad per time) that explains most.

    Args:
        whole: of the wave's amplitudes, at any frequency, on the whole record.
        part: on the part of it on which sizes are worked out.
        name: of the frequency.
        tried: (n_tried,).
    """
    gains: dict[int, float] = {}
    tops = _likely_frequencies(whole, part, name, tried)
    while True:
        wanted: set[int] = set()
        for top in tops:
            wanted.update(_beside(top, len(tried)))
        new = sorted(wanted - gains.keys())
        if not new:
            break
        gains.update(zip(new, _gains(whole, name, tried[new]), strict=True))
        tops = [
            max(_beside(top, len(tried)), key=lambda place: gains[place])
            for top in tops
        ]
    return float(tried[max(gains, key=lambda place: gains[place])])


def best_of_all(part: Sensitivities, name: str, tried: np.ndarray) -> float:
    """The same of frequencies (n_tried,), each worked out on the part.

    For waves along a state: a Fourier sum tells little of them, as a slow motion gives
    every wave along it a slow part.
    """
    gains = []
    for few in np.array_split(tried, 1 + len(tried) // N_TOGETHER):
        gains += _gains(part, name, few)
    return float(tried[int(np.argmax(gains))])


def _gains(
    sensitivities: Sensitivities, name: str, frequencies: np.ndarray
) -> list[float]:
    """Fall of the misfit by a wave of each frequency."""
    traces = _wave_traces(sensitivities, name, frequencies)
    n = len(frequencies)
    return [regression(sensitivities, traces[:, i]).drop for i in range(n)]


def _beside(place: int, n: int) -> range:
    return range(max(place - 1, 0), min(place + 2, n))


def _likely_frequencies(
    whole: Sensitivities, part: Sensitivities, name: str, tried: np.ndarray
) -> list[int]:
    """Places in ``tried`` of the highest peaks of the estimated gain; of few, all."""
    n_tried = len(tried)
    if n_tried <= N_EXACT_SIZES:
        return list(range(n_tried))
    linearized = whole.linearized
    grid = linearized.grid
    # A wave of frequency zero: cos = 1, sin = 0.
    still = whole({name: 0.0}).of_defects.sum(axis=1)
    per_defect = linearized.adjoint() * still
    per_interval = per_defect.reshape(grid.n_intervals, -1).sum(axis=1)
    middle = grid.t[grid.begin] + grid.h / 2
    correlation = np.abs(_fourier_sum(middle, per_interval, tried)) ** 2
    even = np.linspace(0, n_tried - 1, N_EXACT_SIZES)
    logarithmic = np.geomspace(1, n_tried, N_EXACT_SIZES) - 1
    places = np.unique(np.concatenate([even, logarithmic]).astype(int))
    coarse = tried[places]
    sizes = np.sum(_wave_traces(part, name, coarse) ** 2, axis=(0, 2))
    log_size = np.interp(tried, coarse, np.log(np.maximum(sizes, TINY)))
    peaks = _peaks(correlation / np.exp(log_size))
    return [int(place) for place in peaks[:N_EXACT_PEAKS]]


def _wave_traces(
    sensitivities: Sensitivities, name: str, frequencies: np.ndarray
) -> np.ndarray:
    """(n_values, n_frequencies, k)"""
    changes = [sensitivities({name: float(omega)}) for omega in frequencies]
    traces = sensitivities.traces(changes)
    return traces.reshape(len(traces), len(frequencies), -1)


def _peaks(y: np.ndarray) -> np.ndarray:
    """Where y is larger than beside it, the largest first."""
    places = np.flatnonzero(local_maxima(y, last_of_plateau=True))
    return places[np.argsort(-y[places])]


def _fourier_sum(t: np.ndarray, y: np.ndarray, frequencies: np.ndarray) -> np.ndarray:
    """sum y exp(i omega t) at evenly spaced frequencies.

    Each wave is the last one times that of the spacing.
    """
    wave = y * np.exp(1j * frequencies[0] * t)
    turn = np.exp(1j * (frequencies[1] - frequencies[0]) * t)
    result = np.zeros(len(frequencies), dtype=complex)
    for place in range(len(frequencies)):
        result[place] = wave.sum()
        wave = wave * turn
    return result

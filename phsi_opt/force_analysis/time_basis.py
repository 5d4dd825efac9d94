"""Functions of the time: slow changes, and a wave whose frequency is found.

The frequency is found on the stretches of time that a fit sees; so a wave earns nothing
by being sought.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phsi_opt.force_analysis.cross_validation import CrossValidation
from phsi_opt.force_analysis.force_record import ForceRecord
from phsi_opt.force_analysis.piecewise_linear import piecewise_linear_basis
from phsi_opt.force_analysis.spectrum import Spectrum, spectrum
from phsi_opt.force_analysis.waves import drawn, explained_by_wave, harmonics
from phsi_opt.statistics import local_maxima

N_TIME_KNOTS = 6  # of piecewise linear functions of the time
N_PEAKS = 3  # peaks of the spectrum, about which the frequency is sought
# Half the width in which a frequency is sought, in resolved frequencies: about the
# peaks, then about the best.
SEARCH_WIDTHS = (1.0, 0.1)
N_TRIED = 21  # frequencies that are tried in each width
POINTS_PER_FREQUENCY = 4  # points of a spectrum per resolved frequency


@dataclass(frozen=True, eq=False)
class TimeBasis:
    """Functions of the time that may explain a force.

    Attributes:
        frequency: of the wave, in cycles per unit of time.
        slow: piecewise linear functions, (n_intervals, n_knots).
        waves: sine and cosine, and those of the second harmonic, (n_intervals, 4); of
            one phase in all trajectories.
    """

    frequency: float
    slow: np.ndarray
    waves: np.ndarray

    @classmethod
    def of(
        cls, force: ForceRecord, w: np.ndarray, is_fitted: np.ndarray
    ) -> "TimeBasis":
        """The functions whose wave fits a force best.

        Args:
            force: the record, for its times.
            w: the force, (n_intervals,).
            is_fitted: where the wave has to fit, (n_intervals,) of bool.
        """
        frequency = best_frequency(force, w, is_fitted)
        t = force.t - force.t[0]
        slow = piecewise_linear_basis(force.t, N_TIME_KNOTS)
        return cls(frequency, slow, harmonics(2 * np.pi * frequency * t))

    @property
    def columns(self) -> np.ndarray:
        """All functions, (n_intervals, n_knots + 4)."""
        return np.hstack([self.slow, self.waves])


def leave_out_error_with_time(
    force: ForceRecord, validation: CrossValidation, bases: Sequence[np.ndarray]
) -> float:
    """Sum of squares on stretches left out, with functions of the time.

    As `CrossValidation.leave_out_error` of bases (n_intervals, n_columns); the
    frequency is found anew for every fold.
    """
    error = 0.0
    for is_fitted in validation.training_masks:
        basis = TimeBasis.of(force, validation.w, is_fitted)
        columns = np.hstack([*bases, basis.columns])
        error += validation.error_left_out(columns, is_fitted)
    return error


def period_of(force: ForceRecord, equation: str) -> float | None:
    """Period of the wave in a force that depends on time.

    Returns:
        None where slow changes are larger than the wave.
    """
    w = force.force_on(equation)
    everywhere = np.ones(len(w), dtype=bool)
    basis = TimeBasis.of(force, w, everywhere)
    coefficients = np.linalg.lstsq(basis.columns, w, rcond=None)[0]
    n_slow = basis.slow.shape[1]
    slow_part = basis.slow @ coefficients[:n_slow]
    wave = basis.waves @ coefficients[n_slow:]
    if np.var(slow_part) > np.var(wave):
        return None
    return 1 / basis.frequency


def best_frequency(force: ForceRecord, w: np.ndarray, is_fitted: np.ndarray) -> float:
    """Frequency of the wave that fits a force best, in cycles per unit of time.

    The wave has one phase in all trajectories.

    Args:
        force: the record, for its times and trajectories.
        w: the force, (n_intervals,).
        is_fitted: where the wave has to fit, (n_intervals,) of bool.
    """
    varying = np.where(is_fitted, w - w[is_fitted].mean(), 0.0)
    found = spectrum(force.t, force.run, varying, POINTS_PER_FREQUENCY)
    candidates = _highest_peaks(found)
    refined = drawn(np.flatnonzero(is_fitted))
    t = force.t[refined] - force.t[0]
    y = varying[refined]
    for width in SEARCH_WIDTHS:
        tried = _near(candidates, width * _resolved(found.frequencies))
        best = int(np.argmax(explained_by_wave(t, y, tried)))
        candidates = tried[[best]]
    return float(candidates[0])


def _highest_peaks(found: Spectrum) -> np.ndarray:
    """Frequencies of the highest peaks, highest first."""
    height = found.amplitudes * local_maxima(found.amplitudes)
    return found.frequencies[np.argsort(-height)[:N_PEAKS]]


def _resolved(frequencies: np.ndarray) -> float:
    """Distance of frequencies that a record tells apart."""
    if len(frequencies) < 2:
        return 0.0
    return float(POINTS_PER_FREQUENCY * (frequencies[1] - frequencies[0]))


def _near(candidates: np.ndarray, width: float) -> np.ndarray:
    """Frequencies about the candidates; the candidates if none is positive."""
    offsets = width * np.linspace(-1, 1, N_TRIED)
    tried = np.concatenate([candidate + offsets for candidate in candidates])
    is_positive = tried > 0
    return tried[is_positive] if is_positive.any() else candidates

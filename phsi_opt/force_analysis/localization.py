"""Where a missing force is strong, and how fast and large it is.

Trajectory, times and states are found by the size of the force in parts of the record;
a part stands out where the force is clearly larger there than in the whole. A force
that goes back and forth many times as fast as the motion is no law of the motion: it
shakes what is measured, takes a large rate to be seen at all, and hides what bends the
motion itself.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from phsi_opt.criteria import MOST_OF_IT
from phsi_opt.data.spectrum import spectrum
from phsi_opt.force_analysis.cross_validation import OUTER_QUANTILES
from phsi_opt.force_analysis.force_record import Force, ForceRecord
from phsi_opt.presentation.numbers import decimal, number, range_words
from phsi_opt.presentation.units import Scale, frequency_words
from phsi_opt.statistics import TINY, rms, stretches


@dataclass(frozen=True)
class Window:
    """Times of a trajectory where a force is strongest; all of it if none stand out."""

    trajectory: str
    begin: float
    end: float
    is_whole: bool

    def words(self, time: Scale) -> str:
        """The times, in the unit in which they are told."""
        ends = [decimal(time.shown(one), 3) for one in (self.begin, self.end)]
        return f"{' to '.join(ends)}{' (throughout)' if self.is_whole else ''}"


def strongest_window(force: Force, n_windows: int = 10) -> Window:
    """The tenth of a trajectory where a force is strongest, or else all of that."""
    record = force.record
    part = stretches(record.run, n_windows)
    size = _rms_in_parts(force.w, part, int(part.max()) + 1)
    strongest = int(np.argmax(size))
    run = strongest // n_windows
    is_whole = not _stands_out(size, force.w)[strongest]
    inside = np.flatnonzero(record.run == run if is_whole else part == strongest)
    half = record.estimate.grid.h / 2
    begin = record.t[inside[0]] - half[inside[0]]
    end = record.t[inside[-1]] + half[inside[-1]]
    return Window(record.along.runs[run], float(begin), float(end), is_whole)


def _rms_in_parts(w: np.ndarray, part: np.ndarray, n_parts: int) -> np.ndarray:
    """Root mean square of w in every part, (n_parts,); 0 for an empty one."""
    count = np.bincount(part, minlength=n_parts)
    squares = np.bincount(part, w**2, n_parts)
    return np.sqrt(squares / np.maximum(count, 1))


def _stands_out(size: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Whether the size of a force in each part is clearly larger than in the whole."""
    return size > 1.3 * rms(w)


def strong_ranges(z: np.ndarray, w: np.ndarray) -> list[str]:
    """Ranges of a variable, "begin to end", in which a force is strong, if any."""
    low, high = np.quantile(z, OUTER_QUANTILES)
    edges = np.unique(np.linspace(low, high, num=9))
    n_bins = len(edges) - 1
    if n_bins < 1:
        return []
    part = np.clip(np.searchsorted(edges, z) - 1, 0, n_bins - 1)
    is_visited = np.bincount(part, minlength=n_bins) > 0.02 * len(w)
    is_strong = is_visited & _stands_out(_rms_in_parts(w, part, n_bins), w)
    # Neighbouring strong bins are one range: one, or both ends; strong in more ranges
    # of it, the force follows no region of the variable.
    found = scipy.ndimage.find_objects(scipy.ndimage.label(is_strong)[0])
    if is_strong.all() or len(found) > 2:
        return []
    return [range_words(edges[bins.start], edges[bins.stop]) for (bins,) in found]


# ---- how fast and how large ----------------------------------------------------------


@dataclass(frozen=True)
class Pace:
    """How fast a force is beside the motion and the samples, and how large."""

    frequency: float  # of the force; 0 where it is mostly constant
    motion: float  # frequency of the fastest state
    time: float  # in which the fastest state moves by its standard deviation
    interval: float  # typical time between samples
    strength: float  # rms of the force
    own: float  # rms of what the model itself has in the equation

    @classmethod
    def of(cls, force: Force) -> "Pace":
        record = force.record
        x = record.points.x
        rates = np.sqrt(np.mean(record.rates**2, axis=0))
        times = np.std(x, axis=0) / np.maximum(rates, TINY)
        is_constant = np.mean(force.w) ** 2 > MOST_OF_IT * np.mean(force.w**2)
        return cls(
            0.0 if is_constant else _frequency(record, force.w),
            _frequency(record, x),
            float(np.min(times, initial=np.inf)),
            float(np.median(record.estimate.grid.h)),
            rms(force.w),
            rms(record.rates[:, force.row]),
        )

    @property
    def is_vibration(self) -> bool:
        """Whether the force is many times as fast as the motion, or as the samples.

        A cycle of it must also be over before the states move: of a motion that is
        mostly slow, what follows its quick parts is no vibration.
        """
        is_faster = self.is_faster_than_motion and self.frequency * self.time > 1
        return self.is_near_sampling or is_faster

    @property
    def is_near_sampling(self) -> bool:
        """Whether the force is two fifths as fast as the fastest that samples show."""
        return self.frequency * self.interval > 0.2

    @property
    def samples_per_cycle(self) -> int:
        """As many samples as a cycle of the force has; their mean does not show it."""
        return max(round(1 / (self.frequency * self.interval)), 2)

    @property
    def is_faster_than_motion(self) -> bool:
        """Whether the force is ten times as fast as the motion."""
        return self.frequency > 10 * self.motion > 0

    def speed_words(self, units: Mapping[str, str]) -> str:
        """How fast a vibration is: its frequency beside motion and samples."""
        beside = []
        if self.is_faster_than_motion:
            ratio = self.frequency / self.motion
            beside.append(f"{ratio:.2g} times as fast as the motion")
        if self.is_near_sampling or not beside:
            beside.append("near the sampling rate")
        return f"{frequency_words(self.frequency, units)}, {' and '.join(beside)}"

    def size_words(self, quantity: str) -> str:
        """The force beside the sum that the model has: a share or a multiple of it."""
        if not self.own > 0:
            return ""
        ratio = self.strength / self.own
        words = f"{number(ratio, 2)} times" if ratio >= 1 else f"{100 * ratio:.2g} % of"
        return f"{words} the net {quantity} in the model"


def _frequency(record: ForceRecord, signals: np.ndarray) -> float:
    """At which a signal, or the fastest of several, is strongest about its mean."""
    moving = signals - np.mean(signals, axis=0)
    return spectrum(record.t, record.run, moving).peak

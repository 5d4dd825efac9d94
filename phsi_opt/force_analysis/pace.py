"""How fast a missing force is beside the motion, and how large beside the model.

A force that goes back and forth many times as fast as the motion is no law of the
motion: it shakes what is measured, takes a large rate to be seen at all, and hides what
bends the motion itself.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from phsi_opt.criteria import MOST_OF_IT
from phsi_opt.force_analysis.force_record import Force, ForceRecord
from phsi_opt.force_analysis.spectrum import spectrum
from phsi_opt.presentation.numbers import number
from phsi_opt.presentation.units import frequency_words
from phsi_opt.statistics import TINY, rms

# Times the frequency of the motion from which a force is a vibration beside it.
VIBRATION = 10.0


@dataclass(frozen=True)
class Pace:
    """A force beside the motion and the samples.

    Attributes:
        frequency: at which the force is strongest, in cycles per unit of time; 0 where
            it is mostly constant.
        motion: frequency at which the fastest of the states is strongest.
        time: in which the fastest of the states, by the rms of its rate, moves by as
            much as its standard deviation.
        interval: typical time between samples.
        strength: rms of the force.
        own: rms of what the model itself has in the equation.
    """

    frequency: float
    motion: float
    time: float
    interval: float
    strength: float
    own: float

    @classmethod
    def of(cls, force: Force) -> "Pace":
        """The pace of a missing force."""
        record = force.record
        sizes = np.std(record.points.x, axis=0)
        rates = np.sqrt(np.mean(record.rates**2, axis=0))
        return cls(
            0.0 if is_mostly_constant(force.w) else _frequency(record, force.w),
            _frequency(record, record.points.x),
            float(np.min(sizes / np.maximum(rates, TINY), initial=np.inf)),
            float(np.median(record.h)),
            rms(force.w),
            rms(record.rates[:, force.row]),
        )

    @property
    def is_vibration(self) -> bool:
        """Whether the force is many times as fast as the motion, or as the samples.

        A cycle of it must also be over before the states move: of a motion that is
        mostly slow, what follows its quick parts is no vibration.
        """
        is_faster = self._times_motion > VIBRATION and self.frequency * self.time > 1
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
    def _times_motion(self) -> float:
        return self.frequency / self.motion if self.motion > 0 else 0.0

    def speed_words(self, units: Mapping[str, str]) -> str:
        """How fast a vibration is: its frequency beside motion and samples."""
        told = frequency_words(self.frequency, units)
        beside = []
        if self._times_motion > VIBRATION:
            beside.append(f"{self._times_motion:.2g} times as fast as the motion")
        if self.is_near_sampling or not beside:
            beside.append("near the sampling rate")
        return f"{told}, {' and '.join(beside)}"

    def size_words(self, rate: str) -> str:
        """The force beside the rate that the model has: a share or a multiple of it.

        Empty where the model has nothing there. The rate is called such as "dp/dt".
        """
        if not self.own > 0:
            return ""
        ratio = self.strength / self.own
        if ratio >= 1:
            return f"{number(ratio, 2)} times the size of the model's own {rate}"
        return f"{100 * ratio:.2g} % of the model's own {rate}"


def is_mostly_constant(w: np.ndarray) -> bool:
    """Whether most of the mean square of a force (n_intervals,) is that of its mean."""
    return bool(np.mean(w) ** 2 > MOST_OF_IT * np.mean(w**2))


def _frequency(record: ForceRecord, signals: np.ndarray) -> float:
    """At which a signal, or the fastest of several, is strongest about its mean."""
    moving = signals - np.mean(signals, axis=0)
    return spectrum(record.t, record.run, moving).peak

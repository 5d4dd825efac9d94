"""The measurement noise of a likelihood, known or estimated with the parameters.

The program is solved for a noise that it takes as given; then the noise is set to what
the residuals show, and the program solved again, until the noise stays. A first guess,
from the data alone, is that of `phsi_opt.data.noise`.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from phsi_opt.data.measurements import Measurements
from phsi_opt.data.noise import initial_noise, least_noise, quantisation_noise
from phsi_opt.errors import DataError
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.losses import MaximumLikelihood

# Share of the measured values, at least, that counts: with fewer a variance would be
# divided by what is nearly zero.
LEAST_COUNTED = 0.1


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Noise per state before the first solve."""

    sigma: np.ndarray  # (n_states,) standard deviations
    # (n_states,) whether it was declared; the others are estimated.
    is_known: np.ndarray
    least: np.ndarray  # (n_states,) below which none is estimated: that of quantisation

    @classmethod
    def known(cls, sigma: np.ndarray) -> "NoiseLevels":
        """Noise that is known of every state."""
        return cls(sigma, np.ones(len(sigma), dtype=bool), np.zeros(len(sigma)))

    @classmethod
    def beside_force(cls, data: Measurements) -> "NoiseLevels":
        """As the measurements declare it, else the scatter of neighbouring samples."""
        declared = data.noise or {}
        known = np.array([declared.get(name, np.nan) for name in data.states])
        is_known = np.isfinite(known)
        scatter = np.where(is_known, known, initial_noise(data))
        # A force in the equation of a measured position can go through every sample,
        # and the noise would come out as 1e-14. Not more than a hundredth, as steps
        # that are coarse for the motion scatter by its curvature.
        least = np.maximum(quantisation_noise(data), 0.01 * scatter)
        return cls(scatter, is_known, least)

    @classmethod
    def of(cls, data: Measurements, loss: MaximumLikelihood) -> "NoiseLevels":
        """As the loss or the measurements declare it, else a guess from the data.

        A loss that declares noise declares that of every measured state.

        Raises:
            DataError: the declared noise is none, or nothing moves.
        """
        noise = loss.noise if loss.noise is not None else data.noise or {}
        for name in data.measured:
            is_missing = loss.noise is not None and name not in noise
            value = noise.get(name, np.nan)
            is_wrong = name in noise and not (np.isfinite(value) and value > 0)
            if is_missing or is_wrong:
                raise DataError(
                    f"noise of the measured state {name!r} is {noise.get(name)!r}; "
                    "expected a number above zero."
                )
        declared = np.array([noise.get(name, np.nan) for name in data.states])
        sigma = initial_noise(data, declared)
        return cls(sigma, np.isfinite(declared), quantisation_noise(data))

    def channels(self, grid: Grid) -> tuple[int, ...]:
        """Numbers of the measured states whose noise is not known."""
        return tuple(np.flatnonzero(grid.measured_states & ~self.is_known).tolist())


@dataclass(frozen=True, eq=False)
class NoiseIteration:
    """Re-estimates the noise from the residuals of a solve."""

    grid: Grid  # of the program
    levels: NoiseLevels  # what is known, and the least noise
    n_theta: int  # number of free parameters
    huber: float | None  # limit of the loss, or None
    # Whether the objective has an L1 term or priors, whose weight the noise changes.
    is_penalized: bool
    # Change of the logarithm of the noise at which its estimate stays: a tenth of its
    # standard error with 200 values.
    tolerance: float = 0.005

    @property
    def is_needed(self) -> bool:
        """Whether the noise of a state is unknown."""
        return not self.levels.is_known.all()

    def updated(self, sigma: np.ndarray, residual: np.ndarray) -> np.ndarray:
        """The noise that ``residual`` shows, which the program has with ``sigma``.

        Root mean square per channel, (n_states,), with the degrees of freedom that the
        fit used taken off. Of residuals that are cut at Huber's limit the mean square
        that normal noise would leave within it is divided out (proposal 2 of Huber
        1964).
        """
        grid = self.grid
        huber = self.huber
        n_values = len(grid.channel)
        standardized = residual * np.sqrt(n_values / 2)
        n_used = self.n_theta + len(grid.starts) * grid.y.shape[1]
        freedom = max(1 - n_used / n_values, LEAST_COUNTED)
        if huber is not None:  # E[min(|e|, limit)^2] for standard normal e
            outside = 2 * float(scipy.special.ndtr(-huber))
            density = np.exp(-(huber**2) / 2) / np.sqrt(2 * np.pi)
            within = (1 - outside) - 2 * huber * density
            freedom *= within + huber**2 * outside
        estimate = sigma * grid.rms_by_channel(standardized) / np.sqrt(freedom)
        least = np.maximum(self.levels.least, least_noise(grid.y))
        is_estimated = ~self.levels.is_known & grid.measured_states
        return np.where(is_estimated, np.maximum(estimate, least), sigma)

    def change(self, sigma: np.ndarray, updated: np.ndarray) -> float:
        """Of the logarithm of the noise, the largest that moves the estimates."""
        change = np.log(updated / sigma)[self.grid.measured_states]
        largest = float(np.max(np.abs(change)))
        if self.levels.is_known.any() or self.huber is not None or self.is_penalized:
            return largest
        # One factor for all channels leaves the estimates where they are.
        return min(largest, float(np.ptp(change)))

"""The samples of an experiment, with the noise that is known here, as measurements."""

from dataclasses import dataclass

import numpy as np

import phsi_opt as ph
from problems.hidden_effects.rows import N_TRAIN
from problems.hidden_effects.truth import Array, Drive

TRAINING = slice(0, N_TRAIN)
HELD_OUT = slice(N_TRAIN, None)


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of all runs, (n_runs, n_times, n_states).

    ``clean`` are those without noise, ``noise`` what is added; ``sigma`` (n_states,) is
    its standard deviation. States that are not in ``seen`` are not measured.
    """

    t: Array
    clean: Array
    noise: Array
    sigma: Array
    states: tuple[str, ...]
    seen: tuple[int, ...]
    drive: Drive | None = None

    @classmethod
    def drawn(
        cls,
        rng: np.random.Generator,
        clean: Array,
        relative_noise: float,
        t: Array,
        states: tuple[str, ...],
        seen: tuple[int, ...],
        drive: Drive | None = None,
    ) -> "Samples":
        """Noise relative to each channel's deviation over the training runs."""
        sigma = relative_noise * clean[TRAINING].std(axis=(0, 1))
        noise = sigma * rng.normal(size=clean.shape)
        return cls(t, clean, noise, sigma, states, seen, drive)

    def noisy(self, runs: slice) -> ph.Measurements:
        """What is measured of some runs."""
        return self._measurements((self.clean + self.noise)[runs], runs, None)

    def without_noise(self, runs: slice) -> ph.Measurements:
        """The same channels without noise, weighed by its true level."""
        sigma = {self.states[k]: float(self.sigma[k]) for k in self.seen}
        return self._measurements(self.clean[runs].copy(), runs, sigma)

    def _measurements(
        self, y: Array, runs: slice, sigma: dict[str, float] | None
    ) -> ph.Measurements:
        unseen = [k for k in range(len(self.states)) if k not in self.seen]
        y[..., unseen] = np.nan
        names = [f"run {i + 1}" for i in range(len(self.clean))]
        inputs = None
        hold = "linear"
        if self.drive is not None:
            inputs = [values[:, None] for values in self.drive.values[runs]]
            hold = self.drive.hold
        return ph.Measurements.from_arrays(
            [self.t] * len(y),
            list(y),
            inputs,
            states=self.states,
            inputs=None if inputs is None else ["u"],
            hold=hold,
            noise=sigma,
            names=names[runs],
        )

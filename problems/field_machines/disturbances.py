"""What no effect of the catalogue is: a random force, or a random function of the
states.

Both have the root mean square that is asked for along a motion. The function is smooth
and has no part in common, along the motion, with the laws that a catalogue holds.
"""

from dataclasses import dataclass

import numpy as np

from problems.field_machines.records import Array, Experiment, Motion
from problems.hidden_effects.machines import log_uniform

RANDOM_FORCE = "random force"
FUNCTION = "function of the states"
NONE = "none"
# Correlation times of the random force, in the experiment's own time.
TIMES = (0.03, 1.0)
N_WAVES = 12  # of the random function
# Wavelength of its waves over 2 pi, in root mean squares of a state.
SMOOTHNESS = 0.6


@dataclass(frozen=True, eq=False)
class RandomForce:
    """Ornstein and Uhlenbeck's process at the samples (n_samples, n_runs), joined by
    straight lines.
    """

    t: Array
    values: Array

    def at(self, t: float, x: Array) -> Array:
        """The force on every run at a time."""
        place = (t - self.t[0]) / (self.t[1] - self.t[0])
        k = int(np.clip(place, 0, len(self.t) - 2))
        return self.values[k] + (place - k) * (self.values[k + 1] - self.values[k])

    def scaled(self, factor: float) -> "RandomForce":
        """The same force, so many times as strong."""
        return RandomForce(self.t, factor * self.values)


@dataclass(frozen=True, eq=False)
class RandomFunction:
    """A sum of waves in the states, less what is in common with known laws.

    ``waves``: (n_states, N_WAVES); ``scale``: of the states; ``common``: coefficients
    of `known_laws`.
    """

    scale: Array
    waves: Array
    phases: Array
    sizes: Array
    common: Array

    def at(self, t: float, x: Array) -> Array:
        """The function at states (..., n_states)."""
        z = x / self.scale
        waves = np.cos(z @ self.waves + self.phases) @ self.sizes
        return waves - known_laws(z) @ self.common

    def scaled(self, factor: float) -> "RandomFunction":
        """The same function, so many times as strong."""
        sizes = factor * self.sizes
        common = factor * self.common
        return RandomFunction(self.scale, self.waves, self.phases, sizes, common)


Disturbance = RandomForce | RandomFunction


def known_laws(z: Array) -> Array:
    """Powers of each state up to the third, with their signs, and q^2 v; last axis."""
    columns = [np.ones(z.shape[:-1])]
    for k in range(z.shape[-1]):
        one = z[..., k]
        columns += [one, one**2, one * np.abs(one), one**3]
    if z.shape[-1] == 2:
        columns.append(z[..., 0] ** 2 * z[..., 1])
    return np.stack(columns, axis=-1)


def drawn(
    rng: np.random.Generator, kind: str, e: Experiment, motion: Motion
) -> Disturbance:
    """A disturbance of root mean square one along a motion."""
    if kind == RANDOM_FORCE:
        return _random_force(rng, e)
    return _random_function(rng, e, motion)


def _random_force(rng: np.random.Generator, e: Experiment) -> RandomForce:
    n_samples = len(e.t)
    time = float(log_uniform(rng, *TIMES)) * e.time
    memory = np.exp(-(e.t[1] - e.t[0]) / time)
    news = rng.normal(size=(n_samples, e.n_runs))
    values = np.empty_like(news)
    values[0] = news[0]
    for k in range(1, n_samples):
        values[k] = memory * values[k - 1] + np.sqrt(1 - memory**2) * news[k]
    return RandomForce(e.t, values / np.sqrt(np.mean(values[e.kept] ** 2)))


def _random_function(
    rng: np.random.Generator, e: Experiment, motion: Motion
) -> RandomFunction:
    x = motion.x[e.kept]
    scale = np.sqrt(np.mean(x**2, axis=0))
    waves = rng.normal(size=(x.shape[1], N_WAVES)) / SMOOTHNESS
    phases = rng.uniform(0, 2 * np.pi, N_WAVES)
    sizes = rng.normal(size=N_WAVES)
    shape = np.cos(x / scale @ waves + phases) @ sizes
    laws = known_laws(x / scale)
    common, *_ = np.linalg.lstsq(laws, shape, rcond=None)
    left = shape - laws @ common
    function = RandomFunction(scale, waves, phases, sizes, common)
    return function.scaled(1 / np.sqrt(np.mean(left**2)))

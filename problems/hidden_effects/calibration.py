"""The size of a hidden effect, set so that it shows by a given amount.

Searched by re-fits of the model without the effect, from an eighth of the largest size
on.
"""

from dataclasses import dataclass, replace

import numpy as np

from problems.hidden_effects.machines import Setting
from problems.hidden_effects.refit import Refit
from problems.hidden_effects.rows import OF_SIGNAL, STEPS, Aim
from problems.hidden_effects.sizes import unit_of
from problems.hidden_effects.truth import Array, Hidden, measured

# Largest size in the effect's own unit (see `unit_of`): forces in root mean squares of
# the spring's force, times in periods, dead zones in the largest input, limits as the
# share cut off.
LIMITS = {
    "coulomb friction": 0.25,
    "stribeck friction": 0.25,
    "input dead zone": 0.8,
    "input saturation": 0.8,
    "input lag": 0.3,
    "input delay": 0.25,
    "sensor clipping": 0.5,
    "sensor delay": 0.2,
    "sensor gain": 0.5,
    "attached absorber": 0.3,
    "impact": 3.0,
    "shocks": 2.0,
    "viscous damping": 0.25,
    "quadratic input": 0.5,
}
LIMIT = 0.7  # of all others
# Largest error that is accepted, in standard deviations of the signal.
LOUDEST_OF_SIGNAL = 1.3 * OF_SIGNAL
TRIALS = 6  # sizes that are tried
NEAR = (0.8, 1.25)  # shares of the error that is asked for, which are near enough
# A ratio is accepted within these shares of the least and of the asked one.
ACCEPTED = (0.9, 1.4)
ROUNDED = 20  # times the width over which friction turns, where a trial is simulated


@dataclass(frozen=True)
class Trial:
    """A size and the error that it makes."""

    size: float
    error: float


@dataclass(frozen=True)
class Calibrated:
    """An effect at its size, and the free-run error over the noise floor it makes."""

    hidden: Hidden
    ratio: float


def calibrated(hidden: Hidden, s: Setting, aim: Aim) -> Calibrated | None:
    """The effect at the size that meets the target; None where the least ratio is not
    met.
    """
    largest = LIMITS.get(hidden.name, LIMIT) * unit_of(hidden, s)
    least = aim.noise * np.sqrt(aim.least**2 - 1)
    refit = Refit(s)
    size = largest / 8
    trials = [Trial(0.0, 0.0)]
    for _ in range(TRIALS):
        error = refit.error(training_samples((replace(hidden, size=size),), s))
        trials.append(Trial(size, error))
        if is_enough(trials[-1], aim, largest):
            break
        if 1.5 * error * largest / size < least:
            return None  # even the largest size will hardly show
        size = min(next_size(trials, aim.wanted), largest)
        refit.move(size / trials[-1].size)
    ratio = ratio_of(error, aim)
    if is_accepted(ratio, aim) and error < LOUDEST_OF_SIGNAL:
        return Calibrated(replace(hidden, size=trials[-1].size), ratio)
    return None


def training_samples(hidden: tuple[Hidden, ...], s: Setting) -> Array:
    """What the sensors show of the training runs, quickly and without noise."""
    rounded = tuple(_rounded(effect) for effect in hidden)
    drive = s.training_drive
    return measured(s.machine, rounded, s.training_starts, drive, s.t, 2 * STEPS)


def _rounded(hidden: Hidden) -> Hidden:
    """Friction that a few steps between samples can follow; a trial needs no more."""
    shape = dict(hidden.shape)
    if "width" in shape:
        shape["width"] *= ROUNDED
    return replace(hidden, shape=shape)


def ratio_of(error: float, aim: Aim) -> float:
    """Free-run error with the noise over the noise floor."""
    return float(np.sqrt(1 + (error / aim.noise) ** 2))


def is_enough(trial: Trial, aim: Aim, largest: float) -> bool:
    """Whether a size is near the wanted error, or as near as sizes may come."""
    low, high = NEAR
    is_near = low * aim.wanted < trial.error < high * aim.wanted
    is_all = trial.size >= largest and trial.error < aim.wanted
    return is_near or is_all


def is_accepted(ratio: float, aim: Aim) -> bool:
    """Whether an effect shows enough, and not too much."""
    low, high = ACCEPTED
    return low * aim.least <= ratio <= high * aim.target


def next_size(trials: list[Trial], wanted: float) -> float:
    """Between the sizes that enclose the wanted error, in proportion; else beyond the
    largest, at most four times.
    """
    too_small = [trial for trial in trials if trial.error < wanted]
    too_large = [trial for trial in trials if trial.error >= wanted]
    below = max(too_small, key=lambda trial: trial.size)
    above = min(too_large, key=lambda trial: trial.size, default=below)
    if above.size <= below.size:
        factor = wanted / max(below.error, 1e-9)
        return below.size * float(np.clip(factor, 1.2, 4.0))
    share = (wanted - below.error) / (above.error - below.error)
    return below.size + float(np.clip(share, 0.1, 0.9)) * (above.size - below.size)


def shows_held_out(y: Array, without: Array, n_train: int) -> bool:
    """Whether the effect changes the held-out runs at least a third as much as the
    training runs (a brim, a wall).

    ``y`` and ``without``: (n_runs, n_times, n_channels) with and without the effect.
    """
    scaled = (y - without) / y.std(axis=(0, 1))
    change = np.sqrt(np.mean(scaled**2, axis=(1, 2)))
    held_out = np.sqrt(np.mean(change[n_train:] ** 2))
    training = np.sqrt(np.mean(change[:n_train] ** 2))
    return bool(held_out > training / 3)

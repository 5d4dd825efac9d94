"""The size of a hidden effect, set so that it shows by a given amount."""

from dataclasses import replace

import numpy as np

from problems.hidden_effects.machines import Setting
from problems.hidden_effects.refit import Refit
from problems.hidden_effects.rows import N_TRAIN, OF_SIGNAL, STEPS, Aim
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


def calibrated(hidden: Hidden, s: Setting, aim: Aim) -> tuple[Hidden, float] | None:
    """The effect at the size that meets the target, and the ratio reached; None where
    the least ratio is not.
    """
    unit = unit_of(hidden, s)
    largest = LIMITS.get(hidden.name, LIMIT) * unit
    wanted = aim.wanted
    refit, size, points = Refit(s), largest / 8, [(0.0, 0.0)]
    drive = s.drive and replace(s.drive, values=s.drive.values[:N_TRAIN])
    for _ in range(6):
        trial = replace(hidden, size=size)
        error = refit.error(
            measured(
                s.machine, (rounded(trial),), s.starts[:N_TRAIN], drive, s.t, 2 * STEPS
            )
        )
        points.append((size, error))
        if 0.8 * wanted < error < 1.25 * wanted or (size >= largest and error < wanted):
            break
        if 1.5 * error * largest / size < aim.noise * np.sqrt(aim.least**2 - 1):
            return None  # even the largest size will hardly show
        size = min(next_size(points, wanted), largest)
        refit.move(size / points[-1][0])
    ratio = float(np.sqrt(1 + (error / aim.noise) ** 2))
    good = 0.9 * aim.least <= ratio <= 1.4 * aim.target and error < 1.3 * OF_SIGNAL
    return (trial, ratio) if good else None


def rounded(hidden: Hidden) -> Hidden:
    """Friction that a few steps between samples can follow: enough to calibrate."""
    shape = dict(hidden.shape)
    if "width" in shape:
        shape["width"] *= 20
    return replace(hidden, shape=shape)


def next_size(points: list[tuple[float, float]], wanted: float) -> float:
    """Between the sizes that enclose the wanted error, in proportion; else beyond the
    largest, at most four times.
    """
    below = max((p for p in points if p[1] < wanted), key=lambda p: p[0])
    above = min((p for p in points if p[1] >= wanted), key=lambda p: p[0], default=None)
    if above is None or above[0] <= below[0]:
        return below[0] * float(np.clip(wanted / max(below[1], 1e-9), 1.2, 4.0))
    share = (wanted - below[1]) / (above[1] - below[1])
    return below[0] + float(np.clip(share, 0.1, 0.9)) * (above[0] - below[0])


def shows_held_out(y: Array, without: Array, n_train: int) -> bool:
    """Whether the effect changes the held-out runs at least a third as much as the
    training runs (a brim, a wall).
    """
    change = np.sqrt(np.mean(((y - without) / y.std(axis=(0, 1))) ** 2, axis=(1, 2)))
    return bool(
        np.sqrt(np.mean(change[n_train:] ** 2))
        > np.sqrt(np.mean(change[:n_train] ** 2)) / 3
    )

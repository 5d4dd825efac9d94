"""Effects that are hidden in machines of masses: forces, memories, sensors, sizes.

The laws are written here once more, from textbooks; nothing is taken from the catalogue
of the package. ``s`` is the size of an effect, ``h`` its other numbers, ``x`` the
moment that its force sees.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from problems.battery.records import Array

Shape = Mapping[str, float]


@dataclass(frozen=True)
class Drive:
    """Inputs (n_trajectories, n_samples) at a constant step, held as the data declare;
    before t = 0 as at t = 0.
    """

    step: float
    values: Array
    hold: str

    def at(self, t: float) -> Array:
        """The input of every trajectory at time t."""
        last = self.values.shape[1] - 1
        place = max(t / self.step, 0.0)
        if self.hold == "zero":
            return self.values[:, min(int(place + 1e-9), last)]
        k = min(int(place), last - 1)
        change = self.values[:, k + 1] - self.values[:, k]
        return self.values[:, k] + (place - k) * change


@dataclass(frozen=True)
class Moment:
    """What a hidden force sees: time, position and velocity of its mass, of the other
    mass, its memory, the drive.
    """

    t: float
    q: Array
    v: Array
    other: Array
    z: Array
    drive: Drive | None

    def input(self, delay: float = 0.0) -> Array:
        """The input now, or a while ago."""
        assert self.drive is not None
        return self.drive.at(self.t - delay)


@dataclass(frozen=True)
class Hidden:
    """An effect of a size on the mass ``at`` (a sensor: on the state ``at``)."""

    name: str
    at: int
    size: float
    shape: Shape = field(default_factory=dict)


@dataclass(frozen=True)
class Effect:
    """A row of the table.

    Attributes:
        group: "loss", "energy", "force", "input", "memory", "outside" or "sensor".
        law: The force; of a sensor what it shows of x(t), given t and x(t - delay).
        coefficient: What the catalogue counts, from size and shape; None: not compared.
        largest: Size in the effect's own unit (see `unit_of` in `masses`).
        n_memory: Number of its own states, and their ``rates``.
    """

    group: str
    law: Callable[..., Any]
    coefficient: Callable[[float, Shape], float] | None = None
    largest: float = 0.7
    n_memory: int = 0
    rates: Callable[[float, Shape, Moment], list[Array]] | None = None


def _size(s: float, h: Shape) -> float:
    return s


def _signed(s: float, h: Shape) -> float:
    return h["sign"] * s


def _limit(s: float, h: Shape) -> float:
    """A limit that closes in on zero as the size grows to one."""
    return (1 - s) * h["largest"]


def _yield_force(s: float, h: Shape) -> float:
    return s / (h["beta"] + h["gamma"])


def _sign(v: Array, h: Shape) -> Array:
    return np.tanh(v / h["width"])


def _stribeck(s: float, h: Shape, x: Moment) -> Array:
    return -s * (1 + h["rise"] * np.exp(-((x.v / h["speed"]) ** 2))) * _sign(x.v, h)


def _impact(s: float, h: Shape, x: Moment) -> Array:
    depth = np.maximum(x.q - h["wall"], 0.0)
    return -s * depth**1.5 * np.maximum(1 + h["loss"] * x.v, 0.0)


def _pulses(s: float, h: Shape, x: Moment) -> float:
    """Half sines of a given length at three times."""
    total = 0
    for name in ("first", "second", "third"):
        since = x.t - h[name]
        if 0 < since < h["length"]:
            total = total + np.sin(np.pi * since / h["length"])
    return s * total


def _lag(s: float, h: Shape, x: Moment) -> list[Array]:
    return [(x.input() - x.z[..., 0]) / s]


def _bouc_wen(s: float, h: Shape, x: Moment) -> list[Array]:
    """Bouc and Wen, exponent 1: the slope falls to 0 at |z| = 1/(beta + gamma)."""
    z = x.z[..., 0]
    return [x.v - h["beta"] * np.abs(x.v) * z - h["gamma"] * x.v * np.abs(z)]


def _absorber(s: float, h: Shape, x: Moment) -> list[Array]:
    """Position and velocity of a small mass on a spring and a damper."""
    velocity = x.z[..., 1]
    pull = h["omega"] ** 2 * (x.q - x.z[..., 0])
    return [velocity, pull - h["damping"] * (velocity - x.v)]


def _wave(h: Shape, x: Moment) -> Array:
    return np.sin(h["omega"] * x.t + h["phase"])


EFFECTS: dict[str, Effect] = {
    "viscous damping": Effect("loss", lambda s, h, x: -s * x.v, _size, 0.25),
    "coulomb friction": Effect("loss", lambda s, h, x: -s * _sign(x.v, h), _size, 0.25),
    "stribeck friction": Effect("loss", _stribeck, None, 0.25),
    "quadratic drag": Effect("loss", lambda s, h, x: -s * np.abs(x.v) * x.v, _size),
    "cubic drag": Effect("loss", lambda s, h, x: -s * x.v**3, _size),
    "position-dependent damping": Effect(
        "loss", lambda s, h, x: -s * x.q**2 * x.v, _size
    ),
    "linear stiffness": Effect("energy", lambda s, h, x: -s * x.q, _size),
    "quadratic stiffness": Effect(
        "energy", lambda s, h, x: -s * h["sign"] * x.q**2, _signed
    ),
    "cubic stiffness": Effect("energy", lambda s, h, x: -s * x.q**3, _size),
    "gravity torque": Effect(
        "energy", lambda s, h, x: -s * h["sign"] * np.sin(x.q), _signed
    ),
    "coupling stiffness": Effect("energy", lambda s, h, x: -s * (x.q - x.other), _size),
    "gap": Effect(
        "energy",
        lambda s, h, x: -s * (x.q - np.clip(x.q, -h["play"], h["play"])),
        _size,
    ),
    "constant force": Effect("force", lambda s, h, x: s * h["sign"], _signed),
    "harmonic force": Effect("force", lambda s, h, x: s * _wave(h, x), _size),
    "drifting force": Effect("force", lambda s, h, x: s * h["sign"] * x.t, _signed),
    "parametric stiffness": Effect(
        "force", lambda s, h, x: -s * _wave(h, x) * x.q, _size
    ),
    "input gain": Effect("input", lambda s, h, x: s * h["sign"] * x.input(), _signed),
    "quadratic input": Effect(
        "input", lambda s, h, x: s * h["sign"] * x.input() ** 2, _signed, 0.5
    ),
    "input dead zone": Effect(
        "input", lambda s, h, x: -np.clip(x.input(), -s, s), _size, 0.8
    ),
    "input saturation": Effect(
        "input",
        lambda s, h, x: np.clip(x.input(), -_limit(s, h), _limit(s, h)) - x.input(),
        _limit,
        0.8,
    ),
    "input lag": Effect(
        "input", lambda s, h, x: x.z[..., 0] - x.input(), _size, 0.3, 1, _lag
    ),
    "input delay": Effect("input", lambda s, h, x: x.input(s) - x.input(), _size, 0.25),
    "hysteresis": Effect(
        "memory",
        lambda s, h, x: -s * x.z[..., 0],
        _yield_force,
        n_memory=1,
        rates=_bouc_wen,
    ),
    # Forces that no effect of the catalogue describes.
    "force q v^2": Effect("outside", lambda s, h, x: -s * h["sign"] * x.q * x.v**2),
    "force q |v|": Effect(
        "outside", lambda s, h, x: -s * h["sign"] * x.q * np.abs(x.v)
    ),
    "change of stiffness": Effect(
        "outside", lambda s, h, x: -s * x.q * float(x.t > h["when"])
    ),
    "attached absorber": Effect(
        "outside",
        lambda s, h, x: s * h["omega"] ** 2 * (x.z[..., 0] - x.q),
        largest=0.3,
        n_memory=2,
        rates=_absorber,
    ),
    "square wave": Effect("outside", lambda s, h, x: s * np.sign(_wave(h, x))),
    "impact": Effect("outside", _impact, largest=3.0),
    "shocks": Effect("outside", _pulses, largest=2.0),
    "damping in one direction": Effect(
        "outside", lambda s, h, x: -s * np.maximum(x.v, 0.0)
    ),
    "sensor offset": Effect(
        "sensor", lambda s, h, t, x, late: x + h["sign"] * s, _signed
    ),
    "sensor gain": Effect(
        "sensor", lambda s, h, t, x, late: x * (1 + h["sign"] * s), _signed, 0.5
    ),
    "sensor drift": Effect(
        "sensor", lambda s, h, t, x, late: x + h["sign"] * s * t, _signed
    ),
    "sensor clipping": Effect(
        "sensor",
        lambda s, h, t, x, late: np.clip(x, -_limit(s, h), _limit(s, h)),
        _limit,
        0.5,
    ),
    "sensor delay": Effect("sensor", lambda s, h, t, x, late: late, _size, 0.2),
}


def names_of(*groups: str) -> tuple[str, ...]:
    """The effects of some groups."""
    return tuple(name for name, e in EFFECTS.items() if e.group in groups)


ENERGY = names_of("energy")
INPUT = names_of("input")
OUTSIDE = names_of("outside")
SENSORS = names_of("sensor")
ONE = names_of("loss", "energy", "force", "input", "memory")


def law_of(hidden: Hidden) -> Callable[..., Any]:
    """The law of an effect with its size and shape."""
    law = EFFECTS[hidden.name].law
    return lambda *seen: law(hidden.size, hidden.shape, *seen)

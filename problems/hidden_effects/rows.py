"""The rows of the battery: which effects are hidden, at which noise levels."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

import phsi_opt as ph
from problems.hidden_effects.truth import CLOGS, FORCES, LEAKS, OUTSIDE, SENSORS, Array

NOISE_LEVELS = (0.01, 0.03, 0.1)
# Free-run error of the best re-fit without the effect, over the noise floor.
LOUDEST = 30.0
QUIETEST = 3.0
FAINTEST = 1.5  # is enough after `PATIENCE` attempts
PATIENCE = 8
ATTEMPTS = 40  # experiments drawn, before a case is given up
OF_SIGNAL = 0.7  # largest free-run error over the standard deviation of the signal
N_TRAIN = 3
N_TEST = 2
STEPS = 1  # between samples, where a machine is simulated quickly
LOSS = (
    "viscous damping",
    "coulomb friction",
    "stribeck friction",
    "quadratic drag",
    "cubic drag",
    "position-dependent damping",
)
ENERGY = (
    "linear stiffness",
    "quadratic stiffness",
    "cubic stiffness",
    "gravity torque",
    "coupling stiffness",
    "gap",
)
INPUT = (
    "input gain",
    "quadratic input",
    "input dead zone",
    "input saturation",
    "input lag",
    "input delay",
)
FORCE = ("constant force", "harmonic force", "drifting force", "parametric stiffness")
ONE = (*LOSS, *ENERGY, *FORCE, *INPUT, "hysteresis")
SEPARATED = (
    "coulomb friction",
    "cubic stiffness",
    "harmonic force",
    "constant force",
    "quadratic input",
)


@dataclass(frozen=True)
class Row:
    """A row of the battery: what may be hidden, at which noise levels (relative to each
    channel's deviation).
    """

    name: str
    kind: str  # "one", "nothing", "two", "outside", "sensor", "tanks"
    effects: tuple[str, ...]
    noise: tuple[float, ...]


@dataclass(frozen=True)
class Aim:
    """Noise (relative), the free-run error over the noise floor that is asked for, and
    the least that is accepted.
    """

    noise: float
    target: float
    least: float

    @property
    def wanted(self) -> float:
        """The error that is asked for without the noise, in standard deviations of the
        signal.
        """
        return float(self.noise * np.sqrt(self.target**2 - 1))


@dataclass(frozen=True, eq=False)
class Draw:
    """One attempt at a case: its row and seed, the generator of all that is random, and
    what the effect's size should come to.
    """

    row: Row
    seed: int
    rng: np.random.Generator
    aim: Aim


@dataclass(frozen=True)
class Truth:
    """A hidden effect as it should be found: its name, the equations that are right,
    the coefficient if comparable.
    """

    effect: str
    equations: tuple[str, ...]
    coefficient: float = np.nan


@dataclass(frozen=True, eq=False)
class Case:
    """What one row and seed give: the model that lacks the truths, data, the true
    noise, the same data without it.

    ``sigma`` is per state. ``base_ratio``: free-run error of the best re-fit of the
    model over the noise floor, as calibrated; ``target``: what was asked for.
    """

    row: Row
    seed: int
    model: ph.PseudoHamiltonian
    train: ph.Measurements
    test: ph.Measurements
    clean: ph.Measurements
    sigma: Array
    test_noise: Array
    noise: float
    truths: tuple[Truth, ...]
    settings: Mapping[str, object]
    target: float
    base_ratio: float


def _rows() -> dict[str, Row]:
    rows = [Row("nothing", "nothing", (), NOISE_LEVELS)]
    for effect in ONE:
        for noise in NOISE_LEVELS:
            name = f"{effect.replace(' ', '_')}_{noise:g}"
            rows.append(Row(name, "one", (effect,), (noise,)))
    rows.append(Row("two_effects", "two", SEPARATED, NOISE_LEVELS))
    rows.append(Row("outside", "outside", tuple(OUTSIDE), NOISE_LEVELS))
    for effect in SENSORS:
        name = effect.replace(" ", "_")
        rows.append(Row(name, "sensor", (effect,), NOISE_LEVELS))
    rows.append(Row("tanks", "tanks", (*LEAKS, *CLOGS), NOISE_LEVELS[:2]))
    return {row.name: row for row in rows}


ROWS = _rows()
assert set(ONE) == set(FORCES)

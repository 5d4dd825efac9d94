"""The kinds of the battery: which machine, measured how, with what hidden."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from problems.field_machines.chambers import chamber
from problems.field_machines.circuits import circuit
from problems.field_machines.closed_loop import closed_loop
from problems.field_machines.falling import falling
from problems.field_machines.one_mass import (
    long_runs,
    pendulum,
    roll_decay,
    short_run,
)
from problems.field_machines.records import Experiment
from problems.field_machines.sensing import MEMORY, STEPS, Sensing
from problems.field_machines.sizes import MODEL_ERROR
from problems.field_machines.thermal import thermal
from problems.hidden_effects.machines import log_uniform

Draw = Callable[[np.random.Generator], Experiment]

NOISE_LEVELS = (0.005, 0.02, 0.05)
FIRST_REPORTED = 34_000  # seed; those below were seen while developing
FAR_OFF = (0.5, 1.5)  # starting values over the true ones
NEAR = (0.8, 1.25)


@dataclass(frozen=True)
class Kind:
    """A kind of machine.

    ``is_far_off``: its model begins 50 % off; ``has_poor_sensor``: coarse, or of uneven
    noise; ``is_complete``: nothing is hidden; ``model_error``: root mean square of the
    disturbance, in that of the motion's own force.
    """

    name: str
    title: str
    draws: tuple[Draw, ...]
    is_far_off: bool = False
    has_poor_sensor: bool = False
    is_complete: bool = False
    model_error: float = MODEL_ERROR

    def start(self, rng: np.random.Generator) -> float:
        """A starting value over the true one."""
        if self.is_far_off:
            return float(rng.choice(FAR_OFF))
        return float(rng.uniform(*NEAR))

    def sensing(self, rng: np.random.Generator, noise: float) -> Sensing:
        """How its motion is measured, besides noise that lasts."""
        if not self.has_poor_sensor:
            return Sensing(noise)
        if rng.random() < 0.5:
            return Sensing(noise, n_steps=float(log_uniform(rng, *STEPS)))
        return Sensing(noise, is_uneven=True)


def coloured(noise: float) -> Sensing:
    """Noise that lasts."""
    return Sensing(noise, memory=MEMORY)


def _light(rng: np.random.Generator) -> Experiment:
    return falling(rng, is_heavy=False)


def _fed(rng: np.random.Generator) -> Experiment:
    return chamber(rng, has_inflow=True)


ONES = (short_run, _light, roll_decay, pendulum, closed_loop, circuit, thermal, _fed)
KINDS = {
    kind.name: kind
    for kind in (
        Kind("short_run", "one short run", (short_run,)),
        Kind("falling", "falling bodies", (falling,)),
        Kind("roll_decay", "a ship's roll decay", (roll_decay,)),
        Kind("pendulum", "a pendulum over the top", (pendulum,)),
        Kind("closed_loop", "a mass under control", (closed_loop,)),
        Kind("circuit", "a series circuit", (circuit,)),
        Kind("thermal", "two heated bodies", (thermal,)),
        Kind("chamber", "a leaking chamber", (chamber,)),
        Kind(
            "starts_off",
            "starts 50 % off",
            (short_run, roll_decay, pendulum),
            is_far_off=True,
        ),
        Kind(
            "sensors",
            "coarse steps, uneven noise",
            (long_runs, roll_decay),
            has_poor_sensor=True,
        ),
        Kind("nothing", "nothing missing", ONES, is_complete=True),
        Kind(
            "nothing_10",
            "nothing missing, 10 % of model error",
            ONES,
            is_complete=True,
            model_error=0.1,
        ),
    )
}

"""The two tables of machines, and the case of a row and a seed.

Hidden effects: masses on springs and connected tanks with one effect, two, none, one
from outside the catalogue, a fault of a sensor; a table of effects and noise levels.
Machines of the field: kinds of machine, each with model error and a hidden effect.

Seeds 20000 to 20999 are those of the frozen verdicts and of nothing else. Those from
30000 on are reported: nobody looks at one while the package is developed, and a page
names its first. Try changes on those from 10000 on.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from problems.battery import experiments as field
from problems.battery.effects import ONE, OUTSIDE, SENSORS
from problems.battery.experiments import MODEL_ERROR, Experiment, Sensing, Sizing
from problems.battery.field_machines import (
    chamber,
    circuit,
    closed_loop,
    falling,
    long_runs,
    pendulum,
    roll_decay,
    short_run,
    thermal,
)
from problems.battery.masses import OF_SIGNAL, masses_case
from problems.battery.records import FIELD, HIDDEN, Aim, Case, RunawayError, log_uniform
from problems.battery.tanks import FAULTS, tanks_case

FIRST_VERDICT = 20_000
FIRST_REPORTED = 30_000

# Free-run error of the best re-fit without the effect, over the noise floor.
LOUDEST = 30.0
QUIETEST = 3.0
FAINTEST = 1.5  # is enough after `PATIENCE` experiments drawn in vain
PATIENCE = 8
NOISE_LEVELS = (0.01, 0.03, 0.1)
FIELD_NOISE_LEVELS = (0.005, 0.02, 0.05)
FAR_OFF = (0.5, 1.5)  # starting values over the true ones
NEAR = (0.8, 1.25)
SEPARATED = (
    "coulomb friction",
    "cubic stiffness",
    "harmonic force",
    "constant force",
    "quadratic input",
)


@dataclass(frozen=True)
class HiddenRow:
    """What may be hidden, at which noise levels (relative to each channel's deviation).

    ``kind``: "one", "nothing", "lasting" (nothing, in noise that lasts), "two",
    "three", "shaken" (two beside a random force), "outside", "sensor" or "tanks".
    """

    name: str
    kind: str
    effects: tuple[str, ...]
    noise: tuple[float, ...]
    battery: ClassVar[str] = HIDDEN
    attempts: ClassVar[int] = 40

    def attempt(self, rng: np.random.Generator, seed: int, k: int) -> Case | None:
        """The case of the ``k``-th experiment, where its effect shows."""
        noise = float(rng.choice(self.noise))
        loudest = min(LOUDEST, OF_SIGNAL / noise)
        target = float(log_uniform(rng, QUIETEST, loudest))
        aim = Aim(noise, target, QUIETEST if k < PATIENCE else FAINTEST)
        if self.kind == "tanks":
            return tanks_case(rng, self.effects, aim)
        return masses_case(rng, self.kind, self.effects, aim)


@dataclass(frozen=True)
class FieldRow:
    """A kind of machine of the field.

    Attributes:
        is_far_off: Its model begins 50 % off.
        has_poor_sensor: Coarse, or of uneven noise.
        is_complete: Nothing is hidden.
        model_error: Root mean square of the disturbance, in that of the motion's own
            force.
    """

    name: str
    title: str
    machines: tuple[Callable[[np.random.Generator], Experiment], ...]
    is_far_off: bool = False
    has_poor_sensor: bool = False
    is_complete: bool = False
    model_error: float = MODEL_ERROR
    battery: ClassVar[str] = FIELD
    attempts: ClassVar[int] = 60

    @property
    def kind(self) -> str:
        """ "complete" where nothing is hidden, else "machine"."""
        return "complete" if self.is_complete else "machine"

    def attempt(self, rng: np.random.Generator, seed: int, k: int) -> Case | None:
        """The case of one more experiment, where its effect shows."""
        noise = FIELD_NOISE_LEVELS[seed % len(FIELD_NOISE_LEVELS)]
        e = self.machines[int(rng.integers(len(self.machines)))](rng)
        beside = str(rng.choice(field.BESIDE))
        sensing = self._sensing(rng, noise)
        if self.is_complete and rng.random() < 1 / 3:
            beside = field.NONE
            sensing = Sensing(noise, memory=field.MEMORY)
        sizing = Sizing(e, rng, noise, beside, self.model_error)
        sized = sizing.disturbed(0.0, 0.0) if self.is_complete else sizing.sized()
        if sized is None:
            return None
        train, test = field.measured(rng, e, sized.motion, sensing)
        starts = {name: value * self._start(rng) for name, value in e.values.items()}
        hidden = "nothing" if self.is_complete else e.hidden.name
        return Case(
            model=e.model.with_values(starts),
            train=train,
            test=test,
            truths=() if self.is_complete or e.is_faint else e.hidden.truths,
            hidden=f"{hidden}, below the noise" if e.is_faint else hidden,
            noise=noise,
            ratio=sized.ratio,
            size=sized.size,
            has_function=beside == field.FUNCTION and self.model_error > 0,
        )

    def _start(self, rng: np.random.Generator) -> float:
        """A starting value over the true one."""
        return float(rng.choice(FAR_OFF) if self.is_far_off else rng.uniform(*NEAR))

    def _sensing(self, rng: np.random.Generator, noise: float) -> Sensing:
        """How the motion is measured, besides noise that lasts."""
        if not self.has_poor_sensor:
            return Sensing(noise)
        if rng.random() < 0.5:
            return Sensing(noise, n_steps=float(log_uniform(rng, *field.STEPS)))
        return Sensing(noise, is_uneven=True)


Row = HiddenRow | FieldRow


def draw(row: Row, seed: int) -> Case:
    """The case of a row and a seed; drawn anew, from the same generator, until the
    effect shows.
    """
    rng = np.random.default_rng([zlib.crc32(row.name.encode()), seed])
    for k in range(row.attempts):
        try:
            case = row.attempt(rng, seed, k)
        except RunawayError:
            continue
        if case is not None:
            return case
    raise ArithmeticError(
        f"row {row.name!r}, seed {seed}: "
        f"no experiment shows the effect in {row.attempts} attempts."
    )


# --- the tables


def _hidden_rows() -> list[HiddenRow]:
    rows = [HiddenRow("nothing", "nothing", (), NOISE_LEVELS)]
    for effect in ONE:
        for noise in NOISE_LEVELS:
            name = f"{effect.replace(' ', '_')}_{noise:g}"
            rows.append(HiddenRow(name, "one", (effect,), (noise,)))
    rows.append(HiddenRow("lasting_noise", "lasting", (), NOISE_LEVELS))
    for kind in ("two", "three", "shaken"):
        rows.append(HiddenRow(f"{kind}_effects", kind, SEPARATED, NOISE_LEVELS))
    rows.append(HiddenRow("outside", "outside", OUTSIDE, NOISE_LEVELS))
    for effect in SENSORS:
        name = effect.replace(" ", "_")
        rows.append(HiddenRow(name, "sensor", (effect,), NOISE_LEVELS))
    rows.append(HiddenRow("tanks", "tanks", tuple(FAULTS), NOISE_LEVELS[:2]))
    return rows


def _light(rng: np.random.Generator) -> Experiment:
    return falling(rng, is_heavy=False)


def _fed(rng: np.random.Generator) -> Experiment:
    return chamber(rng, has_inflow=True)


ALL = (short_run, _light, roll_decay, pendulum, closed_loop, circuit, thermal, _fed)
OFF = (short_run, roll_decay, pendulum)
COARSE = (long_runs, roll_decay)
ROWS = {row.name: row for row in _hidden_rows()}
KINDS = {
    row.name: row
    for row in (
        FieldRow("short_run", "one short run", (short_run,)),
        FieldRow("falling", "falling bodies", (falling,)),
        FieldRow("roll_decay", "a ship's roll decay", (roll_decay,)),
        FieldRow("pendulum", "a pendulum over the top", (pendulum,)),
        FieldRow("closed_loop", "a mass under control", (closed_loop,)),
        FieldRow("circuit", "a series circuit", (circuit,)),
        FieldRow("thermal", "two heated bodies", (thermal,)),
        FieldRow("chamber", "a leaking chamber", (chamber,)),
        FieldRow("starts_off", "starts 50 % off", OFF, is_far_off=True),
        FieldRow("sensors", "coarse steps, uneven noise", COARSE, has_poor_sensor=True),
        FieldRow("nothing", "nothing missing", ALL, is_complete=True),
    )
}
TABLES: dict[str, dict[str, HiddenRow] | dict[str, FieldRow]] = {
    HIDDEN: ROWS,
    FIELD: KINDS,
}

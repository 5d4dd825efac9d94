"""Random machines and the models that know a part of them.

Everything is drawn from one generator in a fixed order, so that a case is the same
whenever it is drawn.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

import phsi_opt as ph
from phsi_opt.model.terms import Dictionary
from problems.hidden_effects.rows import ENERGY, N_TEST, N_TRAIN, STEPS
from problems.hidden_effects.truth import SENSORS, Array, Drive, Machine, simulate

N_RUNS = N_TRAIN + N_TEST
# Faults of a sensor that show in the relation of position and momentum alone.
NEED_MOMENTA = {"sensor offset", "sensor gain", "sensor drift", "sensor delay"}
NEED_INPUT = {"sensor gain", "sensor delay"}
# Effects beside those of the energy that a cubic spring could be taken for.
LIKE_SPRINGS = {*ENERGY, "hysteresis", "parametric stiffness"}


@dataclass(frozen=True, eq=False)
class Setting:
    """An experiment without its hidden effect: machine, starts, input, times, measured
    states, what the model knows.

    ``present``: names of the parameters in the model, of k1, k2, k12, b1, b2, c1, c2;
    ``free``: those of them that it does not know. ``nominal``: the states (n_samples,
    n_runs, 2 n) without the effect.
    """

    machine: Machine
    starts: Array
    drive: Drive | None
    t: Array
    seen: tuple[int, ...]
    free: tuple[str, ...]
    present: tuple[str, ...]
    period: float
    nominal: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states."""
        return (*_numbered("q", self.machine.n), *_numbered("p", self.machine.n))

    @property
    def training_starts(self) -> Array:
        """Starting states of the training runs."""
        return self.starts[:N_TRAIN]

    @property
    def training_drive(self) -> Drive | None:
        """Input of the training runs."""
        if self.drive is None:
            return None
        return replace(self.drive, values=self.drive.values[:N_TRAIN])


def _numbered(letter: str, n: int) -> tuple[str, ...]:
    """q, or q1 and q2."""
    return (letter,) if n == 1 else tuple(f"{letter}{i + 1}" for i in range(n))


def log_uniform(
    rng: np.random.Generator, low: float, high: float, size: int | None = None
) -> Array:
    """Numbers whose logarithm is uniform."""
    return np.exp(rng.uniform(np.log(low), np.log(high), size))


# --- the setting


def draw_setting(rng: np.random.Generator, effects: tuple[str, ...]) -> Setting:
    """An experiment that excites the effects, and a model that does not have them."""
    hidden = set(effects)
    n = 2 if "coupling stiffness" in hidden or rng.random() < 0.5 else 1
    needs_input = any("input" in name for name in effects) or hidden & NEED_INPUT
    is_driven = bool(needs_input) or rng.random() < 0.5
    has_momenta = bool(hidden & NEED_MOMENTA) or rng.random() < 0.5
    # A sensor's offset or drift is a force on a linear machine: only a spring that is
    # not linear tells them apart.
    is_cubic = bool(hidden & set(SENSORS)) or (
        not hidden & LIKE_SPRINGS and rng.random() < 0.3
    )
    machine = _machine(rng, n, is_cubic, effects)
    period = 2 * np.pi / float(np.exp(np.mean(np.log(_frequencies(machine)))))
    swing = (1.5, 2.5) if "gravity torque" in hidden else (0.7, 1.5)
    amplitude = float(rng.uniform(*swing))
    per_period = rng.uniform(26, 34)
    n_samples = int(rng.uniform(500, 900) / N_TRAIN)
    t = np.arange(n_samples) * period / per_period
    starts = _starts(rng, machine, amplitude)
    drive = _drive(rng, machine, amplitude, t, period) if is_driven else None
    present = _present(machine)
    setting = Setting(
        machine,
        starts,
        drive,
        t,
        seen=tuple(range(2 * n if has_momenta else n)),
        free=_free(rng, present, effects),
        present=present,
        period=period,
    )
    return replace(setting, nominal=simulate(machine, (), starts, drive, t, STEPS))


def _machine(
    rng: np.random.Generator, n: int, is_cubic: bool, effects: tuple[str, ...]
) -> Machine:
    mass = log_uniform(rng, 0.6, 1.8, n)
    stiffness = log_uniform(rng, 0.6, 1.8, n)
    ratio = log_uniform(rng, 0.012, 0.036, n)  # of the critical damping
    damping = 2 * ratio * np.sqrt(stiffness * mass)
    if "viscous damping" in effects:
        damping = np.zeros(n)
    coupling: Array | np.float64 = np.float64(0.0)
    if n == 2 and "coupling stiffness" not in effects:
        coupling = log_uniform(rng, 0.2, 0.6) * stiffness.mean()
    cubic = stiffness * rng.uniform(0.3, 0.9, n) if is_cubic else np.zeros(n)
    pushed = int(rng.integers(n))
    return Machine(mass, stiffness, cubic, damping, np.asarray(coupling), pushed)


def _frequencies(machine: Machine) -> Array:
    """Frequencies (rad per unit of time) of the machine without its cubic springs."""
    K = np.diag(machine.stiffness)
    if machine.n == 2:
        K = K + machine.coupling * np.array([[1, -1], [-1, 1]])
    return np.sqrt(np.linalg.eigvals(K / machine.mass[:, None]).real)


def _starts(rng: np.random.Generator, machine: Machine, amplitude: float) -> Array:
    """Positions and momenta of about the same energy: a random phase for each mass,
    another size for each record.
    """
    shape = (N_RUNS, machine.n)
    of_record = rng.uniform(0.6, 1.2, (N_RUNS, 1))
    of_mass = rng.uniform(0.7, 1.0, shape)
    size = amplitude * of_record * of_mass
    phase = rng.uniform(0, 2 * np.pi, shape)
    positions = size * np.cos(phase)
    momenta = size * np.sqrt(machine.stiffness * machine.mass) * np.sin(phase)
    return np.concatenate([positions, momenta], 1)


def _drive(
    rng: np.random.Generator,
    machine: Machine,
    amplitude: float,
    t: Array,
    period: float,
) -> Drive:
    """A multisine about the resonances, or random steps.

    Its mean square is a fraction of the spring's force.
    """
    if rng.random() < 0.5:
        hold = "linear"
        values = _multisine(rng, t, period)
    else:
        hold = "zero"
        values = _random_steps(rng, t, period)
    rms = rng.uniform(0.25, 0.45) * machine.stiffness[machine.pushed] * amplitude
    return Drive(float(t[1]), values * rms / values.std(), hold)


def _multisine(rng: np.random.Generator, t: Array, period: float) -> Array:
    shape = (N_RUNS, 5, 1)
    omega = 2 * np.pi / period * rng.uniform(0.4, 1.8, shape)
    phase = rng.uniform(0, 2 * np.pi, shape)
    return np.sin(omega * t + phase).sum(axis=1)


def _random_steps(rng: np.random.Generator, t: Array, period: float) -> Array:
    n_held = max(int(rng.uniform(0.3, 0.8) * period / t[1]), 1)
    levels = rng.uniform(-1, 1, (N_RUNS, len(t) // n_held + 1))
    return np.repeat(levels, n_held, axis=1)[:, : len(t)]


def _present(machine: Machine) -> tuple[str, ...]:
    """The parameters in the model. Masses are known."""
    n = machine.n
    names = [f"k{i + 1}" for i in range(n)]
    if machine.coupling > 0:
        names.append("k12")
    if machine.cubic.any():
        names += [f"b{i + 1}" for i in range(n)]
    if machine.damping.any():
        names += [f"c{i + 1}" for i in range(n)]
    return tuple(names)


def _free(
    rng: np.random.Generator, present: tuple[str, ...], effects: tuple[str, ...]
) -> tuple[str, ...]:
    """Those of the parameters that the model does not know."""
    known = set()
    if rng.random() < 0.5:
        known |= {"k12"}
    if rng.random() < 0.5:
        known |= {"b1", "b2"}
    if "linear stiffness" in effects:
        known |= {"k1", "k2", "k12"}
    return tuple(name for name in present if name not in known)


# --- the model


def values_of(machine: Machine) -> dict[str, float]:
    """The parameters of a machine by the names of the model."""
    found = {}
    groups = {"k": machine.stiffness, "b": machine.cubic, "c": machine.damping}
    for letter, values in groups.items():
        for i in range(machine.n):
            found[f"{letter}{i + 1}"] = float(values[i])
    return {**found, "k12": float(machine.coupling)}


def with_values(machine: Machine, values: Mapping[str, Array]) -> Machine:
    """The machine with parameters (n_variations,) for all trajectories."""

    def stacked(letter: str) -> Array:
        columns = [values[f"{letter}{i + 1}"] for i in range(machine.n)]
        return np.stack(columns, axis=-1)[:, None, :]

    return replace(
        machine,
        stiffness=stacked("k"),
        cubic=stacked("b"),
        damping=stacked("c"),
        coupling=values["k12"][:, None],
    )


def model_of(setting: Setting, rng: np.random.Generator) -> ph.PseudoHamiltonian:
    """What is known of the machine; starting values are off by up to a quarter."""
    machine = setting.machine
    n = machine.n
    momenta = setting.states[n:]
    values = values_of(machine)
    parameters: dict[str, ph.Parameter | float] = {**values}
    for name in setting.free:
        start = values[name] * rng.uniform(0.8, 1.25)
        parameters[name] = ph.Parameter(start, lower=0.0)
    is_damped = any(name.startswith("c") for name in setting.present)
    is_driven = setting.drive is not None
    return ph.PseudoHamiltonian(
        states=setting.states,
        inputs=("u",) if is_driven else (),
        S=ph.canonical(n),
        H=_energy(setting, parameters),
        R=ph.damping(*momenta) if is_damped else {},
        F={momenta[machine.pushed]: ph.formula("u")} if is_driven else {},
    )


def _energy(
    setting: Setting, parameters: Mapping[str, ph.Parameter | float]
) -> Dictionary:
    """Springs, cubic springs and kinetic energy."""
    n = setting.machine.n
    q = setting.states[:n]
    p = setting.states[n:]
    shapes = {"k12": f"({q[0]} - {q[-1]})**2/2"}
    masses = {}
    kinetic = []
    for i in range(n):
        shapes[f"k{i + 1}"] = f"{q[i]}**2/2"
        shapes[f"b{i + 1}"] = f"{q[i]}**4/4"
        masses[f"m{i + 1}"] = float(setting.machine.mass[i])
        kinetic.append(f"{p[i]}**2/(2*m{i + 1})")
    springs = [name for name in setting.present if name in shapes]
    potential = [f"{name}*{shapes[name]}" for name in springs]
    of_springs = {name: parameters[name] for name in springs}
    return ph.formula(" + ".join([*potential, *kinetic]), **of_springs, **masses)

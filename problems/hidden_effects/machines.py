"""Random machines and the models that know a part of them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

import phsi_opt as ph
from problems.hidden_effects.rows import ENERGY, N_TEST, N_TRAIN, STEPS
from problems.hidden_effects.truth import SENSORS, Array, Drive, Machine, simulate


@dataclass(frozen=True, eq=False)
class Setting:
    """An experiment without its hidden effect: machine, starts, input, times, measured
    states, what the model knows.

    ``free``: names of the model's free parameters (of k1, k2, k12, b1, b2, c1, c2).
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
        n = self.machine.n
        return tuple(s if n == 1 else f"{s}{i + 1}" for s in "qp" for i in range(n))


def log_uniform(
    rng: np.random.Generator, low: float, high: float, size: int | None = None
) -> Array:
    return np.exp(rng.uniform(np.log(low), np.log(high), size))


def draw_setting(rng: np.random.Generator, effects: tuple[str, ...]) -> Setting:
    """An experiment that excites the effects, and a model that does not have them."""
    n = 2 if "coupling stiffness" in effects or rng.random() < 0.5 else 1
    sensor = any(e in SENSORS for e in effects)
    driven = bool(
        any("input" in e for e in effects)
        or {"sensor gain", "sensor delay"} & set(effects)
    )
    driven = driven or rng.random() < 0.5
    momenta = {"sensor offset", "sensor gain", "sensor drift", "sensor delay"} & set(
        effects
    ) or rng.random() < 0.5
    stiff = any(
        e in ENERGY or e in ("gap", "hysteresis", "parametric stiffness")
        for e in effects
    )
    # A sensor's offset or drift is a force on a linear machine: only a spring that is
    # not linear tells them apart.
    cubic = sensor or (not stiff and rng.random() < 0.3)
    machine = _machine(rng, n, cubic, effects)
    period = 2 * np.pi / float(np.exp(np.mean(np.log(_frequencies(machine)))))
    amplitude = float(
        rng.uniform(1.5, 2.5) if "gravity torque" in effects else rng.uniform(0.7, 1.5)
    )
    per_period, n_samples = rng.uniform(26, 34), int(rng.uniform(500, 900) / N_TRAIN)
    t = np.arange(n_samples) * period / per_period
    starts = _starts(rng, machine, amplitude)
    drive = _drive(rng, machine, amplitude, t, period) if driven else None
    present, free = _known_parts(rng, machine, effects)
    seen = tuple(range(2 * n)) if momenta else tuple(range(n))
    setting = Setting(machine, starts, drive, t, seen, free, present, period)
    return replace(setting, nominal=simulate(machine, (), starts, drive, t, STEPS))


def _machine(
    rng: np.random.Generator, n: int, cubic: bool, effects: tuple[str, ...]
) -> Machine:
    mass, stiffness = log_uniform(rng, 0.6, 1.8, n), log_uniform(rng, 0.6, 1.8, n)
    damping = 2 * log_uniform(rng, 0.012, 0.036, n) * np.sqrt(stiffness * mass)
    if "viscous damping" in effects:
        damping = np.zeros(n)
    coupled = n == 2 and "coupling stiffness" not in effects
    coupling = (
        log_uniform(rng, 0.2, 0.6) * stiffness.mean() if coupled else np.float64(0.0)
    )
    cube = stiffness * rng.uniform(0.3, 0.9, n) if cubic else np.zeros(n)
    return Machine(
        mass, stiffness, cube, damping, np.asarray(coupling), int(rng.integers(n))
    )


def _frequencies(machine: Machine) -> Array:
    K = np.diag(machine.stiffness)
    if machine.n == 2:
        K = K + machine.coupling * np.array([[1, -1], [-1, 1]])
    return np.sqrt(np.linalg.eigvals(K / machine.mass[:, None]).real)


def _starts(rng: np.random.Generator, machine: Machine, amplitude: float) -> Array:
    """Positions and momenta of about the same energy: a random phase for each mass,
    another size for each record.
    """
    shape = (N_TRAIN + N_TEST, machine.n)
    size = (
        amplitude * rng.uniform(0.6, 1.2, (shape[0], 1)) * rng.uniform(0.7, 1.0, shape)
    )
    phase = rng.uniform(0, 2 * np.pi, shape)
    return np.concatenate(
        [
            size * np.cos(phase),
            size * np.sqrt(machine.stiffness * machine.mass) * np.sin(phase),
        ],
        1,
    )


def _drive(
    rng: np.random.Generator,
    machine: Machine,
    amplitude: float,
    t: Array,
    period: float,
) -> Drive:
    """A multisine about the resonances, or random steps; its mean square a fraction of
    the spring's force.
    """
    n_runs, push = N_TRAIN + N_TEST, machine.pushed
    if rng.random() < 0.5:
        omega = 2 * np.pi / period * rng.uniform(0.4, 1.8, (n_runs, 5, 1))
        values, hold = (
            np.sin(omega * t + rng.uniform(0, 2 * np.pi, (n_runs, 5, 1))).sum(axis=1),
            "linear",
        )
    else:
        held = max(int(rng.uniform(0.3, 0.8) * period / t[1]), 1)
        levels = rng.uniform(-1, 1, (n_runs, len(t) // held + 1))
        values, hold = np.repeat(levels, held, axis=1)[:, : len(t)], "zero"
    rms = rng.uniform(0.25, 0.45) * machine.stiffness[push] * amplitude
    return Drive(float(t[1]), values * rms / values.std(), hold)


def _known_parts(
    rng: np.random.Generator, machine: Machine, effects: tuple[str, ...]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The parameters in the model, and which of them are free. Masses are known."""
    n = machine.n
    present = [f"k{i + 1}" for i in range(n)]
    present += ["k12"] if machine.coupling > 0 else []
    present += [f"b{i + 1}" for i in range(n)] if machine.cubic.any() else []
    present += [f"c{i + 1}" for i in range(n)] if machine.damping.any() else []
    known = {"k12"} if rng.random() < 0.5 else set()
    known |= {"b1", "b2"} if rng.random() < 0.5 else set()
    known |= {"k1", "k2", "k12"} if "linear stiffness" in effects else set()
    return tuple(present), tuple(name for name in present if name not in known)


def values_of(machine: Machine) -> dict[str, float]:
    parts = {"k": machine.stiffness, "b": machine.cubic, "c": machine.damping}
    found = {
        f"{name}{i + 1}": float(values[i])
        for name, values in parts.items()
        for i in range(machine.n)
    }
    return {**found, "k12": float(machine.coupling)}


def with_values(machine: Machine, values: Mapping[str, Array]) -> Machine:
    """The machine with parameters (n_variations,) for all trajectories."""

    def stacked(name: str) -> Array:
        return np.stack([values[f"{name}{i + 1}"] for i in range(machine.n)], axis=-1)[
            :, None, :
        ]

    return replace(
        machine,
        stiffness=stacked("k"),
        cubic=stacked("b"),
        damping=stacked("c"),
        coupling=values["k12"][:, None],
    )


def model_of(setting: Setting, rng: np.random.Generator) -> ph.PseudoHamiltonian:
    """What is known of the machine; starting values are off by up to a quarter."""
    machine, states, values = (
        setting.machine,
        setting.states,
        values_of(setting.machine),
    )
    n = machine.n
    q, p = states[:n], states[n:]
    body = {f"k{i + 1}": f"{q[i]}**2/2" for i in range(n)} | {
        f"b{i + 1}": f"{q[i]}**4/4" for i in range(n)
    }
    body |= {"k12": f"({q[0]} - {q[-1]})**2/2"}
    energies = [name for name in setting.present if name in body]
    text = " + ".join(
        [f"{name}*{body[name]}" for name in energies]
        + [f"{p[i]}**2/(2*m{i + 1})" for i in range(n)]
    )
    free = {
        name: ph.Parameter(values[name] * rng.uniform(0.8, 1.25), lower=0.0)
        for name in setting.free
    }
    known: dict[str, ph.Parameter | float] = {**values, **free}
    masses = {f"m{i + 1}": float(machine.mass[i]) for i in range(n)}
    damped = any(name.startswith("c") for name in setting.present)
    return ph.PseudoHamiltonian(
        states=states,
        inputs=() if setting.drive is None else ("u",),
        S=ph.canonical(n),
        H=ph.formula(text, **{name: known[name] for name in energies}, **masses),
        R=ph.damping(*p) if damped else {},
        F={} if setting.drive is None else {p[machine.pushed]: ph.formula("u")},
    )

"""Random machines that swing for many periods, and models that start far off.

A case is the same whenever it is drawn.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import phsi_opt as ph

KINDS = ("oscillator", "pendulum", "two masses")
PERIODS = (10, 60)  # in the record
PER_PERIOD = (18, 40)  # samples
NOISE = (0.01, 0.03)  # share of a channel's standard deviation
OTHERS_OFF = 0.5  # share by which other parameters start off, at most
# Damping ratio times periods: the motion falls to between 0.9 and 0.15 of its start.
DECAY = (0.02, 0.3)
DRIVE = (0.1, 0.3)  # root mean square of the input over the force of the springs
# What the model of a machine may lack: a force on the first momentum.
NOTHING = "nothing"
UNREST = "random force"
LACKS = (NOTHING, UNREST)
LACKING = (0.02, 0.2)  # its size over the force of the springs
N_SINES = 5  # in the input

Array = np.ndarray
Force = Callable[[float, Array], Array]


@dataclass(frozen=True, eq=False)
class FarStart:
    """A machine, its noisy record, and a model that starts far off.

    Attributes:
        truth: true values of the free parameters by name.
        model: the model with its free parameters at the start.
        data: what was measured.
        noise: (n_samples, n_states) noise of the measured states, NaN elsewhere.
    """

    truth: dict[str, float]
    model: ph.PseudoHamiltonian
    data: ph.Measurements
    noise: Array


def draw_case(kind: str, seed: int, off: float = 0.5, lacks: str = NOTHING) -> FarStart:
    """The machine of a seed with its record and its start."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    n_periods = int(rng.integers(PERIODS[0], PERIODS[1] + 1))
    is_driven = bool(rng.random() < 0.5)
    truth = _truth(rng, kind, n_periods, is_driven)
    machine = _model(kind, truth, is_driven)
    period = 2 * np.pi / _slowest(kind, truth)
    n_samples = int(n_periods * rng.uniform(*PER_PERIOD))
    t = np.linspace(0.0, n_periods * period, n_samples)
    start = _starting_states(rng, kind)
    size = _force_size(truth, start)
    u = (_multisine(rng, t, period) * rng.uniform(*DRIVE) * size)[:, None]
    if not is_driven:
        u = np.zeros((n_samples, 0))
    force = _hidden_force(lacks, seed, machine, t, period / 4, size)
    clean, u = _motion(machine, t, start, u, force)
    sigma = rng.uniform(*NOISE) * clean.std(axis=0)
    is_seen = _measured(rng, machine.n_states // 2)
    noise = np.where(is_seen, sigma * rng.normal(size=clean.shape), np.nan)
    data = ph.Measurements.from_arrays(
        t,
        clean + noise,
        u if is_driven else None,
        states=machine.states,
        inputs=["u"] if is_driven else None,
    )
    model = _model(kind, _start_values(rng, truth, off), is_driven)
    return FarStart(truth, model, data, noise)


def _motion(
    machine: ph.PseudoHamiltonian, t: Array, start: Array, u: Array, force: Force | None
) -> tuple[Array, Array]:
    """States (n_samples, n_states) and the input behind them; a pendulum that turns
    over has what drives it halved: it is chaotic, and has no periods to count.
    """
    share = 1.0

    def present(time: float, x: Array) -> Array:
        return share * force(time, x) if force else np.zeros_like(x)

    while True:
        given = share * u if u.shape[1] else None
        states = ph.simulate(machine, t, start, given, force=force and present)
        turns_over = "g" in machine.entries and np.max(np.abs(states[:, 0])) > np.pi
        if not turns_over:
            return states, share * u
        share /= 2


def _truth(
    rng: np.random.Generator, kind: str, n_periods: int, is_driven: bool
) -> dict[str, float]:
    """Values of the free parameters; masses are one."""
    names = {"oscillator": ("k", "c"), "pendulum": ("g", "c")}.get(
        kind, ("k1", "k2", "c1", "c2")
    )
    ratio = np.exp(rng.uniform(*np.log(DECAY))) / n_periods
    truth = {}
    for name in names:
        size = np.exp(rng.uniform(np.log(0.5), np.log(2.0)))
        truth[name] = float(size if name[0] in "kg" else 2 * ratio * size)
    if is_driven:
        truth["b"] = float(rng.uniform(0.7, 1.4))
    return truth


ENERGIES = {
    "two masses": "k1*q1**2/2 + k2*(q1 - q2)**2/2 + p1**2/2 + p2**2/2",
    "pendulum": "g*(1 - cos(q)) + p**2/2",
    "oscillator": "k*q**2/2 + p**2/2",
}


def _model(
    kind: str, values: dict[str, float], is_driven: bool
) -> ph.PseudoHamiltonian:
    free = {name: ph.Parameter(value, lower=0.0) for name, value in values.items()}
    springs = {name: free[name] for name in free if name[0] in "kg"}
    dampers = [name for name in free if name[0] == "c"]
    numbers = ["1", "2"] if kind == "two masses" else [""]
    momenta = [f"p{i}" for i in numbers]
    R = {
        momentum: ph.formula(name, **{name: free[name]})
        for name, momentum in zip(dampers, momenta, strict=True)
    }
    return ph.PseudoHamiltonian(
        states=[*(f"q{i}" for i in numbers), *momenta],
        inputs=["u"] if is_driven else [],
        S=ph.canonical(len(numbers)),
        H=ph.formula(ENERGIES[kind], **springs),
        R=R,
        F={momenta[0]: ph.formula("b*u", b=free["b"])} if is_driven else {},
    )


def _slowest(kind: str, truth: dict[str, float]) -> float:
    """The slowest frequency of small motions, rad per unit of time."""
    if kind != "two masses":
        return float(np.sqrt(truth.get("k", truth.get("g", np.nan))))
    k1 = truth["k1"]
    k2 = truth["k2"]
    stiffness = np.array([[k1 + k2, -k2], [-k2, k2]])
    return float(np.sqrt(np.linalg.eigvalsh(stiffness)[0]))


def _starting_states(rng: np.random.Generator, kind: str) -> Array:
    if kind == "two masses":
        return rng.normal(size=4)
    amplitude = rng.uniform(0.3, 2.0)
    return np.array([amplitude, 0.0])


def _force_size(truth: dict[str, float], start: Array) -> float:
    """Size of the springs' force at the start."""
    stiffness = max(value for name, value in truth.items() if name[0] in "kg")
    return float(stiffness * np.sqrt(np.mean(start**2)))


def _hidden_force(
    lacks: str,
    seed: int,
    model: ph.PseudoHamiltonian,
    t: Array,
    correlation_time: float,
    force_size: float,
) -> Force | None:
    """The rate that the model does not have."""
    if lacks == NOTHING:
        return None
    rng = np.random.default_rng([LACKS.index(lacks), seed])
    size = force_size * np.exp(rng.uniform(*np.log(LACKING)))
    n = model.n_states // 2
    unrest = _ornstein_uhlenbeck(rng, t, correlation_time)

    def force(time: float, _: Array) -> Array:
        rates = np.zeros(2 * n)
        rates[n] = size * np.interp(time, t, unrest)
        return rates

    return force


def _ornstein_uhlenbeck(
    rng: np.random.Generator, t: Array, correlation_time: float
) -> Array:
    """A random force of size one, (n_samples,)."""
    kept = np.exp(-np.diff(t) / correlation_time)
    force = rng.normal(size=len(t))
    for i in range(1, len(t)):
        force[i] = kept[i - 1] * force[i - 1] + np.sqrt(1 - kept[i - 1] ** 2) * force[i]
    return force


def _multisine(rng: np.random.Generator, t: Array, period: float) -> Array:
    """An input about the resonance with a root mean square of one."""
    omega = 2 * np.pi / period * rng.uniform(0.4, 1.8, (N_SINES, 1))
    phase = rng.uniform(0, 2 * np.pi, (N_SINES, 1))
    signal = np.sin(omega * t + phase).sum(axis=0)
    return np.asarray(signal / signal.std())


def _measured(rng: np.random.Generator, n: int) -> Array:
    """Positions always; in half of the cases momenta too, all of them or one."""
    has_momenta = rng.random() < 0.5
    is_seen = np.zeros(2 * n, dtype=bool)
    is_seen[:n] = True
    if has_momenta:
        n_momenta = int(rng.integers(1, n + 1))
        is_seen[n : n + n_momenta] = True
    return is_seen


def _start_values(
    rng: np.random.Generator, truth: dict[str, float], off: float
) -> dict[str, float]:
    """Frequencies' parameters too small or too large by ``off``, others up to half."""
    values = {}
    for name, value in truth.items():
        if name[0] in "kg":
            factor = 1 + off * rng.choice([-1.0, 1.0])
        else:
            factor = 1 + OTHERS_OFF * rng.uniform(-1.0, 1.0)
        values[name] = float(factor * value)
    return values

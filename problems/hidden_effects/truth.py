"""Machines with hidden effects, simulated without the package: one or two masses on
springs, and the connected tanks.

A machine obeys m q'' = -k q - b q^3 - c v (+ spring between the masses) + u + hidden
forces. Every hidden effect is a force on one mass, with states of its own where it has
a memory, or something a sensor does to the samples. The forces are written here once
more, from textbooks; nothing is taken from the catalogue of the package.

Arrays of states are (..., n_trajectories, 2 n_masses + memory): positions, momenta,
memory. Parameters may have leading axes too, so that variations of a machine are
integrated together.
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

Array = np.ndarray
RTOL = 1e-8
ESCAPED = 1e6  # times what a motion begins with: it runs away


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
class Machine:
    """Masses (n,), springs to the ground, cubic springs, dampers (..., n), the spring
    between two masses (...,).

    The input acts on mass ``pushed``.
    """

    mass: Array
    stiffness: Array
    cubic: Array
    damping: Array
    coupling: Array
    pushed: int = 0

    @property
    def n(self) -> int:
        """Number of masses."""
        return len(self.mass)


@dataclass(frozen=True)
class Hidden:
    """A hidden effect of a size on the mass ``at`` (or its sensor); ``shape`` holds its
    other numbers.
    """

    name: str
    at: int
    size: float
    shape: Mapping[str, float] = field(default_factory=dict)


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


Law = Callable[[float, Mapping[str, float], Moment], Array | float]


def _sign(v: Array, shape: Mapping[str, float]) -> Array:
    return np.tanh(v / shape["width"])


def _pulses(t: float, shape: Mapping[str, float]) -> float:
    """Half sines of a given length at three times."""
    length = shape["length"]
    total = 0
    for name in ("first", "second", "third"):
        since = t - shape[name]
        if 0 < since < length:
            total = total + np.sin(np.pi * since / length)
    return total


# Forces of the catalogue's effects, by its names. s: size, h: the other numbers, x: the
# moment.
FORCES: dict[str, Law] = {
    "viscous damping": lambda s, h, x: -s * x.v,
    "coulomb friction": lambda s, h, x: -s * _sign(x.v, h),
    "stribeck friction": lambda s, h, x: (
        -s * (1 + h["rise"] * np.exp(-((x.v / h["speed"]) ** 2))) * _sign(x.v, h)
    ),
    "quadratic drag": lambda s, h, x: -s * np.abs(x.v) * x.v,
    "cubic drag": lambda s, h, x: -s * x.v**3,
    "position-dependent damping": lambda s, h, x: -s * x.q**2 * x.v,
    "linear stiffness": lambda s, h, x: -s * x.q,
    "quadratic stiffness": lambda s, h, x: -s * h["sign"] * x.q**2,
    "cubic stiffness": lambda s, h, x: -s * x.q**3,
    "gravity torque": lambda s, h, x: -s * h["sign"] * np.sin(x.q),
    "coupling stiffness": lambda s, h, x: -s * (x.q - x.other),
    "gap": lambda s, h, x: -s * (x.q - np.clip(x.q, -h["play"], h["play"])),
    "constant force": lambda s, h, x: s * h["sign"],
    "harmonic force": lambda s, h, x: s * np.sin(h["omega"] * x.t + h["phase"]),
    "drifting force": lambda s, h, x: s * h["sign"] * x.t,
    "parametric stiffness": lambda s, h, x: (
        -s * np.sin(h["omega"] * x.t + h["phase"]) * x.q
    ),
    "input gain": lambda s, h, x: s * h["sign"] * x.input(),
    "quadratic input": lambda s, h, x: s * h["sign"] * x.input() ** 2,
    "input dead zone": lambda s, h, x: -np.clip(x.input(), -s, s),
    "input saturation": lambda s, h, x: (
        np.clip(x.input(), -_limit(s, h), _limit(s, h)) - x.input()
    ),
    "input lag": lambda s, h, x: x.z[..., 0] - x.input(),
    "input delay": lambda s, h, x: x.input(s) - x.input(),
    "hysteresis": lambda s, h, x: -s * x.z[..., 0],
}

# Forces that no effect of the catalogue describes.
OUTSIDE: dict[str, Law] = {
    "force q v^2": lambda s, h, x: -s * h["sign"] * x.q * x.v**2,
    "force q |v|": lambda s, h, x: -s * h["sign"] * x.q * np.abs(x.v),
    "change of stiffness": lambda s, h, x: -s * x.q * float(x.t > h["when"]),
    "attached absorber": lambda s, h, x: s * h["omega"] ** 2 * (x.z[..., 0] - x.q),
    "square wave": lambda s, h, x: s * np.sign(np.sin(h["omega"] * x.t + h["phase"])),
    "impact": lambda s, h, x: (
        -s
        * np.maximum(x.q - h["wall"], 0.0) ** 1.5
        * np.maximum(1 + h["loss"] * x.v, 0.0)
    ),
    "shocks": lambda s, h, x: s * _pulses(x.t, h),
    "damping in one direction": lambda s, h, x: -s * np.maximum(x.v, 0.0),
}


@dataclass(frozen=True)
class Memory:
    """States of an effect's own: how many, and their rates."""

    n_states: int
    rates: Callable[[float, Mapping[str, float], Moment], list[Array]]


def _bouc_wen(s: float, h: Mapping[str, float], x: Moment) -> list[Array]:
    """Bouc and Wen, exponent 1: the slope falls to 0 at |z| = 1/(beta + gamma)."""
    z = x.z[..., 0]
    return [x.v - h["beta"] * np.abs(x.v) * z - h["gamma"] * x.v * np.abs(z)]


def _absorber(s: float, h: Mapping[str, float], x: Moment) -> list[Array]:
    """Position and velocity of a small mass on a spring and a damper."""
    position = x.z[..., 0]
    velocity = x.z[..., 1]
    pull = h["omega"] ** 2 * (x.q - position)
    return [velocity, pull - h["damping"] * (velocity - x.v)]


MEMORIES = {
    "input lag": Memory(1, lambda s, h, x: [(x.input() - x.z[..., 0]) / s]),
    "hysteresis": Memory(1, _bouc_wen),
    "attached absorber": Memory(2, _absorber),
}

Shown = Callable[[float, Mapping[str, float], Array, Array, Array], Array]

# What a sensor shows of x(t) (n_trajectories, n_samples), given t and x(t - delay).
SENSORS: dict[str, Shown] = {
    "sensor offset": lambda s, h, t, x, late: x + h["sign"] * s,
    "sensor gain": lambda s, h, t, x, late: x * (1 + h["sign"] * s),
    "sensor drift": lambda s, h, t, x, late: x + h["sign"] * s * t,
    "sensor clipping": lambda s, h, t, x, late: np.clip(x, -_limit(s, h), _limit(s, h)),
    "sensor delay": lambda s, h, t, x, late: late,
}


def _limit(size: float, shape: Mapping[str, float]) -> float:
    """A limit that closes in on zero as the size grows to one."""
    return (1 - size) * shape["largest"]


class RunawayError(ArithmeticError):
    """The machine leaves every bound, as beyond the top of a softening spring: no
    experiment to learn from.
    """


def force_of(hidden: Hidden, moment: Moment) -> Array | float:
    """The force of a hidden effect at a moment."""
    return {**FORCES, **OUTSIDE}[hidden.name](hidden.size, hidden.shape, moment)


@dataclass(frozen=True, eq=False)
class _Motion:
    """Right-hand side of a machine with hidden forces.

    ``memory``: where each force's own states lie behind positions and momenta.
    """

    machine: Machine
    forces: tuple[Hidden, ...]
    memory: tuple[slice, ...]
    drive: Drive | None
    shape: tuple[int, ...]

    def rates(self, t: float, flat: Array) -> Array:
        """Rates of the flattened states of all variations and trajectories."""
        machine = self.machine
        n = machine.n
        x = flat.reshape(self.shape)
        q = x[..., :n]
        v = x[..., n : 2 * n] / machine.mass
        dx = np.empty_like(x)
        dx[..., :n] = v
        force = dx[..., n : 2 * n]
        force[...] = -machine.stiffness * q - machine.cubic * q**3 - machine.damping * v
        if n == 2:
            pull = machine.coupling * (q[..., 1] - q[..., 0])
            force[..., 0] += pull
            force[..., 1] -= pull
        if self.drive is not None:
            force[..., machine.pushed] += self.drive.at(t)
        for hidden, place in zip(self.forces, self.memory, strict=True):
            at = hidden.at
            z = x[..., place]
            moment = Moment(
                t, q[..., at], v[..., at], q[..., n - 1 - at], z, self.drive
            )
            added = force_of(hidden, moment)
            force[..., at] += added
            if hidden.name == "coupling stiffness":
                force[..., 1 - at] -= added
            if hidden.name in MEMORIES:
                rates = MEMORIES[hidden.name].rates(hidden.size, hidden.shape, moment)
                dx[..., place] = np.stack(rates, axis=-1)
        return dx.ravel()


def simulate(
    machine: Machine,
    hidden: tuple[Hidden, ...],
    starts: Array,
    drive: Drive | None,
    times: Array,
    steps: int = 0,
) -> Array:
    """States (n_times, ..., n_trajectories, 2 n_masses) from ``starts`` at times[0].

    By SciPy to ``RTOL``, or quickly, to find the size of an effect: ``steps`` of Runge
    and Kutta between two times.

    Raises:
        RunawayError: the machine leaves every bound.
    """
    n = machine.n
    forces = tuple(h for h in hidden if h.name not in SENSORS)
    begun = [starts]
    memory = []
    end = 2 * n
    for force in forces:
        z = _memory(force, starts, drive, times[0])
        begun.append(z)
        memory.append(slice(end, end + z.shape[-1]))
        end += z.shape[-1]
    x0 = np.concatenate(begun, axis=-1)
    motion = _Motion(machine, forces, tuple(memory), drive, x0.shape)
    if steps:
        states = _quickly(motion.rates, x0.ravel(), times, steps)
    else:
        states = _tightly(motion.rates, x0.ravel(), times)
    return states.reshape(len(times), *x0.shape)[..., : 2 * n]


@dataclass(frozen=True)
class _Escape:
    """An event of `solve_ivp`: a state leaves a bound, and the integration ends."""

    bound: float
    terminal: bool = True

    def __call__(self, _t: float, x: Array) -> float:
        return self.bound - float(np.abs(x).max())


def _tightly(rates: Callable[[float, Array], Array], x0: Array, times: Array) -> Array:
    """By LSODA; no pulse, kink or step of the input is passed over."""
    options = {
        "method": "LSODA",
        "t_eval": times,
        "rtol": RTOL,
        "atol": RTOL * np.abs(x0).max(),
        "max_step": float(np.max(np.diff(times))),
        # On its way to infinity LSODA would take ever shorter steps, without an end.
        "events": _Escape(ESCAPED * max(float(np.abs(x0).max()), 1.0)),
    }
    with np.errstate(over="ignore", invalid="ignore"), warnings.catch_warnings():
        # LSODA's own words about a machine that runs away.
        warnings.simplefilter("ignore", UserWarning)
        solved = solve_ivp(rates, (times[0], times[-1]), x0, **options)
    is_through = solved.status == 0
    if not is_through or not np.isfinite(solved.y).all():
        raise RunawayError(
            f"a machine could not be simulated to t = {times[-1]:.6g}: {solved.message}"
        )
    return solved.y.T


def _quickly(
    rates: Callable[[float, Array], Array], x: Array, times: Array, steps: int
) -> Array:
    """Four stages per step; the last a little before its end, where an input that is
    held has not yet jumped.
    """
    found = [x]
    # A size that is too large by far is only told to be so.
    with np.errstate(over="ignore", invalid="ignore"):
        for begin, end in pairwise(times):
            h = (end - begin) / steps
            for k in range(steps):
                t = begin + k * h
                k1 = rates(t + 1e-6 * h, x)
                k2 = rates(t + h / 2, x + h / 2 * k1)
                k3 = rates(t + h / 2, x + h / 2 * k2)
                k4 = rates(t + h - 1e-6 * h, x + h * k3)
                x = x + h / 6 * (k1 + 2 * (k2 + k3) + k4)
            found.append(x)
    return np.array(found)


def _memory(hidden: Hidden, starts: Array, drive: Drive | None, t: float) -> Array:
    """Starting values of an effect's own states: the lag has settled, the absorber
    moves along, the rest is zero.
    """
    size = MEMORIES[hidden.name].n_states if hidden.name in MEMORIES else 0
    z = np.zeros((*starts.shape[:-1], size))
    if hidden.name == "input lag" and drive is not None:
        z[..., 0] = drive.at(t)
    if hidden.name == "attached absorber":
        z[..., 0] = starts[..., hidden.at]
    return z


def measured(
    machine: Machine,
    hidden: tuple[Hidden, ...],
    starts: Array,
    drive: Drive | None,
    times: Array,
    steps: int = 0,
) -> Array:
    """What the sensors show, (n_times, n_trajectories, 2 n_masses), without noise;
    sensors count states, not masses.
    """
    sensors = [h for h in hidden if h.name in SENSORS]
    delay = sum(h.size for h in sensors if h.name == "sensor delay")
    moments = times
    if delay:
        # The record begins earlier, so that its first samples are there.
        earlier = [times[0] - delay]
        moments = np.unique(np.concatenate([earlier, times - delay, times]))
    x = simulate(machine, hidden, starts, drive, moments, steps)
    y = x[np.searchsorted(moments, times)]
    late = x[np.searchsorted(moments, times - delay)] if delay else y
    for sensor in sensors:
        at = sensor.at
        show = SENSORS[sensor.name]
        shown = show(sensor.size, sensor.shape, times, y[..., at].T, late[..., at].T)
        y = y.copy()
        y[..., at] = shown.T
    return y


Fault = Callable[[float, Mapping[str, float], Array], Array]

# Faults of the tanks: what leaves a tank with the level y per second; what slows a pipe
# with the flow y (momentum).
LEAKS: dict[str, Fault] = {
    "linear leak": lambda s, h, y: s * y,
    "turbulent leak": lambda s, h, y: s * np.sqrt(np.maximum(y, 0.0)),
    "overflow": lambda s, h, y: s * np.maximum(y - h["brim"], 0.0),
}
CLOGS: dict[str, Fault] = {
    "viscous damping": lambda s, h, y: s * y,
    "quadratic drag": lambda s, h, y: s * np.abs(y) * y,
}


def tank_states(
    matrix: Array,
    hidden: Hidden | None,
    starts: Array,
    times: Array,
    rtol: float = 1e-9,
) -> Array:
    """States (n_times, n_trajectories, 9) of the connected tanks dx/dt = ``matrix`` x
    with a fault in state ``at``.
    """
    fault = None if hidden is None else {**LEAKS, **CLOGS}[hidden.name]

    def rates(t: float, flat: Array) -> Array:
        x = flat.reshape(starts.shape)
        dx = x @ matrix.T
        if hidden is not None and fault is not None:
            dx[..., hidden.at] -= fault(hidden.size, hidden.shape, x[..., hidden.at])
        return dx.ravel()

    options = {
        "method": "DOP853",
        "t_eval": times,
        "rtol": rtol,
        "atol": rtol,
        "max_step": times[1] - times[0],
    }
    solved = solve_ivp(rates, (times[0], times[-1]), starts.ravel(), **options)
    return solved.y.T.reshape(len(times), *starts.shape)

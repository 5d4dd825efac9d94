"""The cases of `hidden_effects`: a machine with a hidden effect, its data, and the
model that does not know of it.

A case is drawn from its row and seed: one or two masses, parameters within a factor of
three, starts, input, measured channels, noise. The size of the effect is then set so
that the best re-fit of the model without it has a free-run error of a given multiple of
the noise floor, log-uniform from 3 to 30. The re-fit is least squares on the noise-free
samples (Levenberg and Marquardt over the free parameters and starting states; slopes by
differences, all variations integrated together), so that calibrating costs less than
the diagnosis. Where the target would ask for more than the effect can physically be
(`LIMITS`: a dead zone of 80 % of the input, friction that stops the machine within a
period), the effect has the largest size allowed if that still shows three times the
floor; otherwise the case is drawn anew. The error is also kept below 0.7 of the
signal's own standard deviation: at 10 % noise that is 7 times the floor, and 30 times
would be a machine that has nothing in common with its model. Some effects hardly reach
three times a floor of 10 % at all (drag beside a damper that is free): after `PATIENCE`
experiments drawn in vain, 1.5 times is enough.
"""

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

import phsi_opt as ph
from problems.hidden_effects.truth import (
    CLOGS,
    FORCES,
    LEAKS,
    OUTSIDE,
    SENSORS,
    Array,
    Drive,
    Hidden,
    Machine,
    Moment,
    RunawayError,
    force_of,
    measured,
    simulate,
    tank_states,
)
from problems.thesis.systems import (
    AREA,
    DAMPING,
    DENSITY,
    FLOWS,
    GRAVITY,
    INERTIA,
    LEVELS,
    tank_structure,
)

NOISE_LEVELS = (0.01, 0.03, 0.1)
LOUDEST, QUIETEST = 30.0, 3.0  # free-run error over noise floor
OF_SIGNAL = 0.7  # largest free-run error over the standard deviation of the signal
N_TRAIN, N_TEST = 3, 2
ATTEMPTS, PATIENCE = 40, 8
FAINTEST = 1.5  # ratio that is enough after ``PATIENCE`` attempts
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

# Largest size in the effect's own unit (see `_unit`): forces in root mean squares of
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


# --- the setting


def _log_uniform(
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
    mass, stiffness = _log_uniform(rng, 0.6, 1.8, n), _log_uniform(rng, 0.6, 1.8, n)
    damping = 2 * _log_uniform(rng, 0.012, 0.036, n) * np.sqrt(stiffness * mass)
    if "viscous damping" in effects:
        damping = np.zeros(n)
    coupled = n == 2 and "coupling stiffness" not in effects
    coupling = (
        _log_uniform(rng, 0.2, 0.6) * stiffness.mean() if coupled else np.float64(0.0)
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


# --- the model, and its best re-fit


def _values(machine: Machine) -> dict[str, float]:
    parts = {"k": machine.stiffness, "b": machine.cubic, "c": machine.damping}
    found = {
        f"{name}{i + 1}": float(values[i])
        for name, values in parts.items()
        for i in range(machine.n)
    }
    return {**found, "k12": float(machine.coupling)}


def _with_values(machine: Machine, values: Mapping[str, Array]) -> Machine:
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
    machine, states, values = setting.machine, setting.states, _values(setting.machine)
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


class Refit:
    """Least squares of the model without the effect to noise-free samples of the
    training runs.
    """

    def __init__(self, setting: Setting) -> None:
        self.setting, self.drive = setting, setting.drive
        if self.drive is not None:
            self.drive = replace(self.drive, values=self.drive.values[:N_TRAIN])
        self.starts = setting.starts[:N_TRAIN]
        self.theta = np.array([_values(setting.machine)[name] for name in setting.free])
        self.begun = self.theta, self.starts

    def _runs(self, theta: Array, starts: Array) -> Array:
        """Measured channels (n_variations, n_times, n_trajectories, n_seen) of
        (n_variations, ...) parameters.
        """
        s = self.setting
        values = {
            name: np.full(len(theta), value)
            for name, value in _values(s.machine).items()
        }
        values |= dict(zip(s.free, np.maximum(theta, 0.0).T, strict=True))
        x = simulate(
            _with_values(s.machine, values), (), starts, self.drive, s.t, STEPS
        )
        return np.moveaxis(x, 1, 0)[..., list(s.seen)]

    def error(self, y: Array, rounds: int = 10) -> float:
        """Free-run error over the channels, each in its standard deviations (Levenberg
        and Marquardt).

        Goes on from the last call's optimum.
        """
        target = y[:, :N_TRAIN, list(self.setting.seen)]
        scale = target.std(axis=(0, 1))
        best, damping = np.inf, 1e-3
        theta, starts = self.theta, self.starts
        for _ in range(rounds):
            runs, slopes = self._slopes(theta, starts)
            error = float(np.sqrt(np.mean(((target - runs) / scale) ** 2)))
            if not np.isfinite(error) and not np.isfinite(
                best
            ):  # the hidden effect or the start runs away
                return np.inf
            if error < best:
                settled = error > 0.98 * best and damping <= 1e-3
                best, self.theta, self.starts, damping = (
                    error,
                    theta,
                    starts,
                    max(damping / 10, 1e-6),
                )
                columns, left = (
                    self._columns(slopes / scale),
                    ((target - runs) / scale).ravel(),
                )
                if settled:
                    break
            else:
                damping *= 20
            change = _damped(columns, left, damping)
            theta = np.maximum(self.theta + change[: len(self.theta)], 0.0)
            starts = self.starts + change[len(self.theta) :].reshape(self.starts.shape)
        return best

    def move(self, factor: float) -> None:
        """Where the optimum should be for ``factor`` times the last size: in proportion
        from that without an effect.
        """
        theta, starts = self.begun
        self.theta = np.maximum(theta + factor * (self.theta - theta), 0.0)
        self.starts = starts + factor * (self.starts - starts)

    def _slopes(self, theta: Array, starts: Array) -> tuple[Array, Array]:
        """The runs and their slopes in every parameter and (for all trajectories at
        once) every starting value.
        """
        n_theta, n_x, h = len(theta), starts.shape[1], 1e-4
        moved = np.tile(theta, (1 + n_theta + n_x, 1))
        begun = np.tile(starts, (1 + n_theta + n_x, 1, 1))
        moved[1 + np.arange(n_theta), np.arange(n_theta)] += h
        begun[1 + n_theta + np.arange(n_x), :, np.arange(n_x)] += h
        runs = self._runs(moved, begun)
        return runs[0], (runs[1:] - runs[0]) / h

    def _columns(self, slopes: Array) -> Array:
        n_theta, n_x = len(self.theta), self.starts.shape[1]
        own = np.zeros((N_TRAIN, n_x, *slopes.shape[1:]))
        for run in range(N_TRAIN):  # a starting value moves its own trajectory alone
            own[run, :, :, run] = slopes[n_theta:, :, run]
        return np.concatenate(
            [slopes[:n_theta].reshape(n_theta, -1), own.reshape(N_TRAIN * n_x, -1)]
        ).T


def _damped(columns: Array, left: Array, damping: float) -> Array:
    information = columns.T @ columns
    ridge = np.diag(np.diag(information) * damping + 1e-12 * np.trace(information))
    return np.linalg.solve(information + ridge, columns.T @ left)


# --- the hidden effect


def _shape(
    rng: np.random.Generator, name: str, at: int, s: Setting
) -> dict[str, float]:
    """The numbers of an effect beside its size, on the scales of the experiment."""
    n, omega = s.machine.n, 2 * np.pi / s.period
    drawn = {
        "sign": float(rng.choice([-1.0, 1.0])),
        "phase": float(rng.uniform(0, 2 * np.pi)),
    }
    if name in SENSORS:
        return {
            "sign": drawn["sign"],
            "largest": float(np.abs(s.nominal[..., at]).max()),
        }
    q, v = s.nominal[..., at], s.nominal[..., n + at] / s.machine.mass[at]
    fast, far, last = (
        float(np.sqrt(np.mean(v**2))),
        float(np.abs(q).max()),
        float(s.t[-1]),
    )
    shapes: dict[str, dict[str, float]] = {
        "coulomb friction": {"width": 1e-3 * fast},
        "stribeck friction": {
            "width": 1e-3 * fast,
            "rise": rng.uniform(0.8, 1.5),
            "speed": rng.uniform(0.3, 0.6) * fast,
        },
        "gap": {"play": rng.uniform(0.25, 0.6) * far},
        "harmonic force": {"omega": omega * rng.uniform(0.5, 1.6)},
        "parametric stiffness": {"omega": omega * rng.uniform(0.4, 2.2)},
        "input saturation": {
            "largest": 0.0 if s.drive is None else float(np.abs(s.drive.values).max())
        },
        "hysteresis": dict.fromkeys(
            ("beta", "gamma"), 0.5 / (rng.uniform(0.15, 0.4) * far)
        ),
        "change of stiffness": {"when": rng.uniform(0.35, 0.65) * last},
        "attached absorber": {
            "omega": omega * rng.uniform(0.7, 1.3),
            "damping": 0.05 * omega,
        },
        "square wave": {"omega": omega * rng.uniform(0.15, 0.35)},
        "impact": {"wall": rng.uniform(0.3, 0.6) * far, "loss": 0.1 / fast},
        "shocks": {
            "length": 0.2 * s.period,
            "first": rng.uniform(0.05, 0.3) * last,
            "second": rng.uniform(0.35, 0.6) * last,
            "third": rng.uniform(0.65, 0.9) * last,
        },
    }
    return {
        **drawn,
        **{key: float(value) for key, value in shapes.get(name, {}).items()},
    }


def _unit(hidden: Hidden, s: Setting) -> float:
    """The size in which `LIMITS` are given."""
    if hidden.name in SENSORS:
        x = s.nominal[..., hidden.at]
        drift = float(x.std() / s.t[-1])
        return {
            "sensor offset": float(x.std()),
            "sensor drift": 2 * drift,
            "sensor delay": s.period,
        }.get(hidden.name, 1.0)
    if hidden.name in ("input lag", "input delay"):
        return s.period
    if hidden.name in ("input saturation", "input gain"):
        return 1.0
    if hidden.name == "input dead zone":
        assert s.drive is not None
        return float(np.abs(s.drive.values).max())
    n, at = s.machine.n, hidden.at
    spring = s.machine.stiffness[at] * np.sqrt(np.mean(s.nominal[..., at] ** 2))
    if hidden.name == "hysteresis":
        return float(spring * (hidden.shape["beta"] + hidden.shape["gamma"]))
    if hidden.name == "attached absorber":  # in masses
        return float(s.machine.mass[at])
    if hidden.name == "shocks":
        return float(spring * 2)
    forces = []
    for t, x in zip(s.t, s.nominal, strict=True):
        q, v = x[:, :n], x[:, n:] / s.machine.mass
        moment = Moment(
            t, q[:, at], v[:, at], q[:, n - 1 - at], np.zeros((len(x), 1)), s.drive
        )
        forces.append(
            np.broadcast_to(force_of(replace(hidden, size=1.0), moment), len(x))
        )
    return float(spring / max(np.sqrt(np.mean(np.array(forces) ** 2)), 1e-12))


def place_of_effect(rng: np.random.Generator, name: str, s: Setting) -> int:
    """The mass (for sensors: the measured state) on which an effect acts."""
    if name in INPUT or name == "quadratic input":
        return s.machine.pushed
    if name in SENSORS:
        return int(rng.choice(s.seen))
    return int(rng.integers(s.machine.n))


def calibrated(hidden: Hidden, s: Setting, aim: Aim) -> tuple[Hidden, float] | None:
    """The effect at the size that meets the target, and the ratio reached; None where
    the least ratio is not.
    """
    unit = _unit(hidden, s)
    largest = LIMITS.get(hidden.name, LIMIT) * unit
    wanted = aim.wanted
    refit, size, points = Refit(s), largest / 8, [(0.0, 0.0)]
    drive = s.drive and replace(s.drive, values=s.drive.values[:N_TRAIN])
    for _ in range(6):
        trial = replace(hidden, size=size)
        error = refit.error(
            measured(
                s.machine, (_rounded(trial),), s.starts[:N_TRAIN], drive, s.t, 2 * STEPS
            )
        )
        points.append((size, error))
        if 0.8 * wanted < error < 1.25 * wanted or (size >= largest and error < wanted):
            break
        if 1.5 * error * largest / size < aim.noise * np.sqrt(aim.least**2 - 1):
            return None  # even the largest size will hardly show
        size = min(_next_size(points, wanted), largest)
        refit.move(size / points[-1][0])
    ratio = float(np.sqrt(1 + (error / aim.noise) ** 2))
    good = 0.9 * aim.least <= ratio <= 1.4 * aim.target and error < 1.3 * OF_SIGNAL
    return (trial, ratio) if good else None


def _rounded(hidden: Hidden) -> Hidden:
    """Friction that a few steps between samples can follow; calibrating needs no more."""
    shape = dict(hidden.shape)
    if "width" in shape:
        shape["width"] *= 20
    return replace(hidden, shape=shape)


def _next_size(points: list[tuple[float, float]], wanted: float) -> float:
    """Between the sizes that enclose the wanted error, in proportion; else beyond the
    largest, at most four times.
    """
    below = max((p for p in points if p[1] < wanted), key=lambda p: p[0])
    above = min((p for p in points if p[1] >= wanted), key=lambda p: p[0], default=None)
    if above is None or above[0] <= below[0]:
        return below[0] * float(np.clip(wanted / max(below[1], 1e-9), 1.2, 4.0))
    share = (wanted - below[1]) / (above[1] - below[1])
    return below[0] + float(np.clip(share, 0.1, 0.9)) * (above[0] - below[0])


# --- cases


def draw(row: Row, seed: int) -> Case:
    """The case of a row and a seed; drawn anew, from the same generator, until the
    effect shows.
    """
    rng = np.random.default_rng([zlib.crc32(row.name.encode()), seed])
    made = {"tanks": _tanks_case, "nothing": _nothing_case, "two": _two_case}.get(
        row.kind, _one_case
    )
    for attempt in range(ATTEMPTS):
        noise = float(rng.choice(row.noise))
        loudest = min(LOUDEST, OF_SIGNAL / noise)
        target = float(_log_uniform(rng, QUIETEST, loudest))
        try:
            case = made(
                row,
                seed,
                rng,
                Aim(noise, target, QUIETEST if attempt < PATIENCE else FAINTEST),
            )
        except RunawayError:
            continue
        if case is not None:
            return case
    raise ArithmeticError(
        f"row {row.name!r}, seed {seed}: no experiment shows the effect in {ATTEMPTS} attempts."
    )


def _one_case(row: Row, seed: int, rng: np.random.Generator, aim: Aim) -> Case | None:
    name = str(rng.choice(row.effects))
    setting = draw_setting(rng, (name,))
    at = place_of_effect(rng, name, setting)
    found = calibrated(
        Hidden(name, at, 0.0, _shape(rng, name, at, setting)), setting, aim
    )
    return (
        None
        if found is None
        else _made(row, seed, rng, aim, setting, (found[0],), found[1])
    )


def _nothing_case(
    row: Row, seed: int, rng: np.random.Generator, aim: Aim
) -> Case | None:
    return _made(
        row, seed, rng, replace(aim, target=1.0), draw_setting(rng, ()), (), 1.0
    )


def _two_case(row: Row, seed: int, rng: np.random.Generator, aim: Aim) -> Case | None:
    """Two effects, each of which alone meets the target; errors of both together are
    computed once more.
    """
    pairs = list(combinations(row.effects, 2))
    names = pairs[rng.integers(len(pairs))]
    setting = draw_setting(rng, names)
    both = []
    for name in names:
        at = place_of_effect(rng, name, setting)
        found = calibrated(
            Hidden(name, at, 0.0, _shape(rng, name, at, setting)), setting, aim
        )
        if found is None:
            return None
        both.append(found[0])
    drive = setting.drive and replace(
        setting.drive, values=setting.drive.values[:N_TRAIN]
    )
    rounded = tuple(_rounded(h) for h in both)
    y = measured(
        setting.machine, rounded, setting.starts[:N_TRAIN], drive, setting.t, 2 * STEPS
    )
    error = Refit(setting).error(y)
    ratio = float(np.sqrt(1 + (error / aim.noise) ** 2))
    return (
        _made(row, seed, rng, aim, setting, tuple(both), ratio)
        if error < 1.3 * OF_SIGNAL
        else None
    )


def _made(
    row: Row,
    seed: int,
    rng: np.random.Generator,
    aim: Aim,
    s: Setting,
    hidden: tuple[Hidden, ...],
    ratio: float,
) -> Case | None:
    y = np.moveaxis(
        measured(s.machine, hidden, s.starts, s.drive, s.t), 0, 1
    )  # (n_runs, n_times, n_states)
    if hidden and not shows_held_out(
        y[..., list(s.seen)], np.moveaxis(s.nominal, 0, 1)[..., list(s.seen)], N_TRAIN
    ):
        return None
    deviation = aim.noise * y[:N_TRAIN].std(axis=(0, 1))
    unseen = [k for k in range(y.shape[-1]) if k not in s.seen]
    noises = deviation * rng.normal(size=y.shape)
    y[..., unseen] = np.nan
    settings = {
        "masses": s.machine.n,
        "measured": "qp" if not unseen else "q",
        "input": "none"
        if s.drive is None
        else {"linear": "multisine", "zero": "steps"}[s.drive.hold],
        "free": " ".join(s.free),
        "known": " ".join(name for name in s.present if name not in s.free),
        "n_train": N_TRAIN * len(s.t),
    }
    u = None if s.drive is None else [run[:, None] for run in s.drive.values]
    hold = "linear" if s.drive is None else s.drive.hold

    def data(runs: Array, chosen: slice, sigma: Array | None = None) -> ph.Measurements:
        given = (
            None if sigma is None else {s.states[k]: float(sigma[k]) for k in s.seen}
        )
        return ph.Measurements.from_arrays(
            [s.t] * len(runs[chosen]),
            list(runs[chosen]),
            None if u is None else u[chosen],
            states=s.states,
            inputs=None if u is None else ["u"],
            hold=hold,
            noise=given,
            names=[f"run {i + 1}" for i in range(len(runs))][chosen],
        )

    train, test = slice(0, N_TRAIN), slice(N_TRAIN, None)
    return Case(
        row,
        seed,
        model_of(s, rng),
        data(y + noises, train),
        data(y + noises, test),
        data(y, train, deviation),
        deviation,
        noises[test],
        aim.noise,
        tuple(_truth(h, s) for h in hidden),
        settings,
        aim.target,
        ratio,
    )


def shows_held_out(y: Array, without: Array, n_train: int) -> bool:
    """Whether the effect changes the held-out runs at least a third as much as the
    training runs (a brim, a wall).
    """
    change = np.sqrt(np.mean(((y - without) / y.std(axis=(0, 1))) ** 2, axis=(1, 2)))
    return bool(
        np.sqrt(np.mean(change[n_train:] ** 2))
        > np.sqrt(np.mean(change[:n_train] ** 2)) / 3
    )


# What the catalogue's coefficient is in terms of the size; where it counts something
# else, none is compared.
COEFFICIENTS: dict[str, Callable[[Hidden], float]] = {
    **dict.fromkeys(
        (
            "viscous damping",
            "coulomb friction",
            "quadratic drag",
            "cubic drag",
            "position-dependent damping",
            "linear stiffness",
            "cubic stiffness",
            "coupling stiffness",
            "gap",
            "harmonic force",
            "parametric stiffness",
            "input dead zone",
            "input lag",
            "input delay",
            "sensor delay",
        ),
        lambda h: h.size,
    ),
    **dict.fromkeys(
        (
            "quadratic stiffness",
            "gravity torque",
            "constant force",
            "drifting force",
            "input gain",
            "quadratic input",
            "sensor offset",
            "sensor gain",
            "sensor drift",
        ),
        lambda h: h.shape["sign"] * h.size,
    ),
    "hysteresis": lambda h: (
        h.size / (h.shape["beta"] + h.shape["gamma"])
    ),  # the force where it has yielded
    "input saturation": lambda h: (1 - h.size) * h.shape["largest"],
    "sensor clipping": lambda h: (1 - h.size) * h.shape["largest"],
}


def _truth(hidden: Hidden, s: Setting) -> Truth:
    n = s.machine.n
    if hidden.name in SENSORS:
        equations: tuple[str, ...] = (s.states[hidden.at],)
    elif hidden.name == "coupling stiffness":  # the spring pulls at both
        equations = s.states[n:]
    else:
        equations = (s.states[n + hidden.at],)
    return Truth(
        hidden.name, equations, COEFFICIENTS.get(hidden.name, lambda h: np.nan)(hidden)
    )


# --- the tanks of the thesis

N_TANK_TRAIN, N_TANK_TEST, TANK_TIMES = 3, 2, np.linspace(0.0, 0.6, 61)
TANK_LIMITS = {
    "linear leak": 2.0,
    "turbulent leak": 2.0,
    "overflow": 20.0,
    "viscous damping": 30.0,
    "quadratic drag": 300,
}


def _tank_matrix() -> Array:
    loss = np.diag(np.r_[DAMPING, np.zeros(4)])
    return (tank_structure() - loss) @ np.diag(
        np.r_[np.full(5, 1 / INERTIA), np.full(4, DENSITY * GRAVITY / AREA)]
    )


def tanks_model(known_pipes: bool) -> ph.PseudoHamiltonian:
    """Healthy tanks: areas and inertia known, the gravity term free; losses of the
    pipes known, or free.
    """
    text = " + ".join(
        [f"{x}**2/(2*{INERTIA})" for x in FLOWS] + [f"g*{x}**2/2" for x in LEVELS]
    )
    known = {
        x: ph.formula(f"r{i}", **{f"r{i}": float(DAMPING[i])})
        for i, x in enumerate(FLOWS)
    }
    return ph.PseudoHamiltonian(
        states=FLOWS + LEVELS,
        S=tank_structure(),
        H=ph.formula(text, g=ph.Parameter(9.0, lower=0.0)),
        R=known if known_pipes else ph.damping(*FLOWS),
    )


def _tanks_case(row: Row, seed: int, rng: np.random.Generator, aim: Aim) -> Case | None:
    name, matrix, t = str(rng.choice(row.effects)), _tank_matrix(), TANK_TIMES
    pipe = name in CLOGS
    at = int(rng.integers(5)) if pipe else 5 + int(rng.integers(4))
    flows = rng.uniform(-0.3, 0.3, (N_TANK_TRAIN + N_TANK_TEST, 5))
    starts = np.concatenate(
        [flows, rng.uniform(0.5, 2.0, (len(flows), 4))], axis=1
    )  # levels are positive
    healthy = tank_states(matrix, None, starts, t, 1e-6)
    shape = {"brim": float(np.quantile(healthy[..., at], rng.uniform(0.5, 0.8)))}
    found = _tank_size(Hidden(name, at, 0.0, shape), matrix, starts, healthy, aim)
    if found is None:
        return None
    hidden, ratio = found
    known_pipes = pipe or bool(rng.random() < 0.5)
    y = np.moveaxis(tank_states(matrix, hidden, starts, t), 0, 1)
    if not shows_held_out(y, np.moveaxis(healthy, 0, 1), N_TANK_TRAIN):
        return None
    deviation = aim.noise * y[:N_TANK_TRAIN].std(axis=(0, 1))
    noises, states = deviation * rng.normal(size=y.shape), FLOWS + LEVELS

    def data(runs: Array, sigma: Array | None = None) -> ph.Measurements:
        given = (
            None if sigma is None else dict(zip(states, map(float, sigma), strict=True))
        )
        return ph.Measurements.from_arrays(
            [t] * len(runs), list(runs), states=states, noise=given
        )

    pressure = DENSITY * GRAVITY / AREA if not pipe else 1 / INERTIA
    # R acts on dH/dx, which is the level or flow times `pressure`
    powers = {
        "linear leak": 1,
        "overflow": 1,
        "turbulent leak": 0.5,
        "viscous damping": 1,
        "quadratic drag": 2,
    }
    truth = Truth(name, (states[at],), hidden.size / pressure ** powers[name])
    settings = {
        "masses": 0,
        "measured": "all",
        "input": "none",
        "free": "g" if known_pipes else "g R",
        "known": "R" if known_pipes else "",
        "n_train": N_TANK_TRAIN * len(t),
    }
    train, test = slice(0, N_TANK_TRAIN), slice(N_TANK_TRAIN, None)
    return Case(
        row,
        seed,
        tanks_model(known_pipes),
        data((y + noises)[train]),
        data((y + noises)[test]),
        data(y[train], deviation),
        deviation,
        noises[test],
        aim.noise,
        (truth,),
        settings,
        aim.target,
        ratio,
    )


def _tank_size(
    hidden: Hidden, matrix: Array, starts: Array, healthy: Array, aim: Aim
) -> tuple[Hidden, float] | None:
    """The size of a fault by its change of the training runs; nearly nothing of the
    healthy model is free to follow.
    """
    wanted, largest = aim.wanted, TANK_LIMITS[hidden.name]
    train, size, points = (
        slice(0, N_TANK_TRAIN),
        TANK_LIMITS[hidden.name] / 8,
        [(0.0, 0.0)],
    )
    for _ in range(6):
        x = tank_states(
            matrix, replace(hidden, size=size), starts[train], TANK_TIMES, 1e-6
        )
        error = float(
            np.sqrt(np.mean(((x - healthy[:, train]) / x.std(axis=(0, 1))) ** 2))
        )
        points.append((size, error))
        if 0.8 * wanted < error < 1.25 * wanted or (size >= largest and error < wanted):
            break
        size = min(_next_size(points, wanted), largest)
    ratio = float(np.sqrt(1 + (error / aim.noise) ** 2))
    return (
        (replace(hidden, size=points[-1][0]), ratio)
        if 0.9 * aim.least <= ratio <= 1.4 * aim.target
        else None
    )


def _rows() -> dict[str, Row]:
    rows = [Row("nothing", "nothing", (), NOISE_LEVELS)]
    rows += [
        Row(f"{e.replace(' ', '_')}_{noise:g}", "one", (e,), (noise,))
        for e in ONE
        for noise in NOISE_LEVELS
    ]
    rows += [
        Row("two_effects", "two", SEPARATED, NOISE_LEVELS),
        Row("outside", "outside", tuple(OUTSIDE), NOISE_LEVELS),
    ]
    rows += [Row(e.replace(" ", "_"), "sensor", (e,), NOISE_LEVELS) for e in SENSORS]
    rows += [Row("tanks", "tanks", (*LEAKS, *CLOGS), (0.01, 0.03))]
    return {row.name: row for row in rows}


ROWS = _rows()
assert set(ONE) == set(FORCES)

"""One or two masses on springs with a hidden effect, and the model without it.

    m q'' = -k q - b q^3 - c v (+ spring between the masses) + u + hidden forces

A case is drawn from its row and seed: parameters within a factor of three, starts,
input, measured channels, noise. The size of the effect is then set so that the best
re-fit of the model without it has a free-run error of a given multiple of the noise
floor. Where that would ask for more than the effect can physically be (a dead zone of
80 % of the input), it has the largest size allowed if that still shows enough;
otherwise the case is drawn anew. The error is also kept below 0.7 of the signal's own
standard deviation.

States are (..., n_trajectories, 2 n_masses + memory): positions, momenta, memory.
Parameters may have leading axes too, so that variations of a machine are integrated
together. Everything is drawn from one generator in a fixed order.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np

import phsi_opt as ph
from problems.battery.effects import (
    EFFECTS,
    ENERGY,
    INPUT,
    SENSORS,
    Drive,
    Hidden,
    Moment,
    law_of,
)
from problems.battery.experiments import MEMORY
from problems.battery.records import (
    Aim,
    Array,
    Case,
    Rates,
    Trial,
    Truth,
    integrated,
    lasting,
    log_uniform,
    measurements,
    runge_kutta,
    searched,
)

# Numbers of effects by the kinds of rows that have several.
SEVERAL = {"two": 2, "three": 3, "shaken": 2}
SHAKEN = 0.05  # random force over the spring's, root mean square
N_TRAIN = 3
N_TEST = 2
N_RUNS = N_TRAIN + N_TEST
TRAINING, HELD_OUT = slice(0, N_TRAIN), slice(N_TRAIN, None)
STEPS = 1  # between samples, where a machine is simulated quickly
OF_SIGNAL = 0.7  # largest free-run error over the standard deviation of the signal
LOUDEST_OF_SIGNAL = 1.3 * OF_SIGNAL  # that is accepted
# A ratio is accepted within these shares of the least and of the asked one.
ACCEPTED = (0.9, 1.4)
ROUNDED = 20  # times the width over which friction turns, where a trial is simulated
# Faults of a sensor that show in the relation of position and momentum alone.
NEED_MOMENTA = {"sensor offset", "sensor gain", "sensor drift", "sensor delay"}
NEED_INPUT = {"sensor gain", "sensor delay"}
# Effects beside those of the energy that a cubic spring could be taken for.
LIKE_SPRINGS = {*ENERGY, "hysteresis", "parametric stiffness"}


# --- motions


@dataclass(frozen=True)
class Machine:
    """Masses (n,), springs to the ground, cubic springs, dampers (..., n), the spring
    between two masses (...,); the input acts on mass ``pushed``.
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


def simulate(
    machine: Machine,
    hidden: tuple[Hidden, ...],
    starts: Array,
    drive: Drive | None,
    times: Array,
    steps: int = 0,
    shaking: Drive | None = None,
) -> Array:
    """States (n_times, ..., n_trajectories, 2 n_masses) from ``starts`` at times[0].

    By SciPy, or quickly, to find the size of an effect: ``steps`` of Runge and Kutta
    between two times. Nobody knows of the force by which the pushed mass is shaken.
    """
    n = machine.n
    begun = [starts]
    forces = []
    end = 2 * n
    for effect in hidden:
        if effect.name not in SENSORS:
            z = _first_memory(effect, starts, drive, times[0])
            begun.append(z)
            forces.append((effect, law_of(effect), slice(end, end + z.shape[-1])))
            end += z.shape[-1]
    x0 = np.concatenate(begun, axis=-1)

    def rates(t: float, flat: Array) -> Array:
        x = flat.reshape(x0.shape)
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
        for pushing in filter(None, (drive, shaking)):
            force[..., machine.pushed] += pushing.at(t)
        for effect, law, place in forces:
            at = effect.at
            other = q[..., n - 1 - at]
            moment = Moment(t, q[..., at], v[..., at], other, x[..., place], drive)
            added = law(moment)
            force[..., at] += added
            if effect.name == "coupling stiffness":
                force[..., 1 - at] -= added
            memory = EFFECTS[effect.name].rates
            if memory is not None:
                own = memory(effect.size, effect.shape, moment)
                dx[..., place] = np.stack(own, axis=-1)
        return dx.ravel()

    if steps:
        found = _quickly(rates, x0.ravel(), times, steps)
    else:
        found = integrated(rates, x0.ravel(), times, float(np.max(np.diff(times))))
    return found.reshape(len(times), *x0.shape)[..., : 2 * n]


def _quickly(rates: Rates, x: Array, times: Array, steps: int) -> Array:
    """The last stage is a little before its end, where an input that is held has not
    yet jumped.
    """
    found = [x]
    # A size that is too large by far is only told to be so.
    with np.errstate(over="ignore", invalid="ignore"):
        for begin, end in pairwise(times):
            h = (end - begin) / steps
            for k in range(steps):
                t = begin + k * h
                at = {0.0: t + 1e-6 * h, 0.5: t + h / 2, 1.0: t + h - 1e-6 * h}
                x = runge_kutta(lambda share, x, at=at: rates(at[share], x), x, h)
            found.append(x)
    return np.array(found)


def _first_memory(
    hidden: Hidden, starts: Array, drive: Drive | None, t: float
) -> Array:
    """The lag has settled, the absorber moves along, the rest is zero."""
    z = np.zeros((*starts.shape[:-1], EFFECTS[hidden.name].n_memory))
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
    shaking: Drive | None = None,
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
    x = simulate(machine, hidden, starts, drive, moments, steps, shaking)
    y = x[np.searchsorted(moments, times)]
    late = x[np.searchsorted(moments, times - delay)] if delay else y
    for sensor in sensors:
        at = sensor.at
        shown = law_of(sensor)(times, y[..., at].T, late[..., at].T)
        y = y.copy()
        y[..., at] = shown.T
    return y


# --- the experiment, and the model that is given with it


@dataclass(frozen=True, eq=False)
class Setting:
    """An experiment without its hidden effect: machine, starts, input, times, measured
    states, what the model knows.

    Attributes:
        present: Names of the parameters in the model, of k1, k2, k12, b1, b2, c1, c2.
        free: Those of them that it does not know.
        nominal: The states (n_samples, n_runs, 2 n) without the effect.
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
        """q and p, or q1, q2, p1 and p2."""
        if self.machine.n == 1:
            return ("q", "p")
        return ("q1", "q2", "p1", "p2")

    @property
    def training_drive(self) -> Drive | None:
        """Input of the training runs."""
        if self.drive is None:
            return None
        return replace(self.drive, values=self.drive.values[TRAINING])


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
    names = [f"k{i + 1}" for i in range(n)]  # masses are known
    names += ["k12"] if machine.coupling > 0 else []
    names += [f"b{i + 1}" for i in range(n)] if machine.cubic.any() else []
    names += [f"c{i + 1}" for i in range(n)] if machine.damping.any() else []
    known = {"k12"} if rng.random() < 0.5 else set()
    known |= {"b1", "b2"} if rng.random() < 0.5 else set()
    known |= {"k1", "k2", "k12"} if "linear stiffness" in effects else set()
    return Setting(
        machine,
        starts,
        drive,
        t,
        seen=tuple(range(2 * n if has_momenta else n)),
        free=tuple(name for name in names if name not in known),
        present=tuple(names),
        period=period,
        nominal=simulate(machine, (), starts, drive, t, STEPS),
    )


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
    """A multisine about the resonances, or random steps; its mean square is a fraction
    of the spring's force.
    """
    if rng.random() < 0.5:
        hold = "linear"
        shape = (N_RUNS, 5, 1)
        omega = 2 * np.pi / period * rng.uniform(0.4, 1.8, shape)
        phase = rng.uniform(0, 2 * np.pi, shape)
        values = np.sin(omega * t + phase).sum(axis=1)
    else:
        hold = "zero"
        n_held = max(int(rng.uniform(0.3, 0.8) * period / t[1]), 1)
        levels = rng.uniform(-1, 1, (N_RUNS, len(t) // n_held + 1))
        values = np.repeat(levels, n_held, axis=1)[:, : len(t)]
    rms = rng.uniform(0.25, 0.45) * machine.stiffness[machine.pushed] * amplitude
    return Drive(float(t[1]), values * rms / values.std(), hold)


def values_of(machine: Machine) -> dict[str, float]:
    """The parameters of a machine by the names of the model."""
    found = {}
    groups = {"k": machine.stiffness, "b": machine.cubic, "c": machine.damping}
    for letter, values in groups.items():
        for i in range(machine.n):
            found[f"{letter}{i + 1}"] = float(values[i])
    return {**found, "k12": float(machine.coupling)}


def model_of(setting: Setting, rng: np.random.Generator) -> ph.PseudoHamiltonian:
    """What is known of the machine; starting values are off by up to a quarter."""
    machine = setting.machine
    n = machine.n
    q, p = setting.states[:n], setting.states[n:]
    values = values_of(machine)
    parameters: dict[str, ph.Parameter | float] = {**values}
    for name in setting.free:
        start = values[name] * rng.uniform(0.8, 1.25)
        parameters[name] = ph.Parameter(start, lower=0.0)
    shapes = {"k12": f"({q[0]} - {q[-1]})**2/2"}
    masses = {}
    for i in range(n):
        shapes |= {f"k{i + 1}": f"{q[i]}**2/2", f"b{i + 1}": f"{q[i]}**4/4"}
        masses[f"m{i + 1}"] = float(machine.mass[i])
    springs = [name for name in setting.present if name in shapes]
    energy = [f"{name}*{shapes[name]}" for name in springs]
    energy += [f"{p[i]}**2/(2*m{i + 1})" for i in range(n)]
    of_springs = {name: parameters[name] for name in springs}
    is_damped = any(name.startswith("c") for name in setting.present)
    is_driven = setting.drive is not None
    return ph.PseudoHamiltonian(
        states=setting.states,
        inputs=("u",) if is_driven else (),
        S=ph.canonical(n),
        H=ph.formula(" + ".join(energy), **of_springs, **masses),
        R=ph.damping(*p) if is_damped else {},
        F={p[machine.pushed]: ph.formula("u")} if is_driven else {},
    )


# --- how far the model without the effect stays from a machine that has it

STEP = 1e-4  # of the differences
FIRST_DAMPING = 1e-3
LEAST_DAMPING = 1e-6
SETTLED = 0.98  # a step that leaves more than this share of the error is the last
RIDGE = 1e-12  # share of the trace, where a direction is not seen at all


class Refit:
    """Least squares of the model without the effect to noise-free training samples.

    Levenberg and Marquardt over the free parameters and starting states; slopes by
    differences, all variations integrated together.
    """

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        self.values = values_of(setting.machine)
        self.first_theta = np.array([self.values[name] for name in setting.free])
        self.first_starts = setting.starts[TRAINING]
        self.theta = self.first_theta
        self.starts = self.first_starts

    def error(self, y: Array, rounds: int = 10) -> float:
        """Free-run error over the channels, each in its standard deviations.

        Goes on from the last call's optimum. ``y``: (n_times, n_runs, n_states).
        """
        target = y[:, TRAINING, list(self.setting.seen)]
        scale = target.std(axis=(0, 1))
        best = np.inf
        damping = FIRST_DAMPING
        theta = self.theta
        starts = self.starts
        n_theta = len(theta)
        for _ in range(rounds):
            runs, slopes = self._slopes(theta, starts)
            remaining = (target - runs) / scale
            error = float(np.sqrt(np.mean(remaining**2)))
            # The hidden effect or the start runs away.
            if not np.isfinite(error) and not np.isfinite(best):
                return np.inf
            if error < best:
                is_last = error > SETTLED * best and damping <= FIRST_DAMPING
                best = error
                self.theta = theta
                self.starts = starts
                damping = max(damping / 10, LEAST_DAMPING)
                columns = self._columns(slopes / scale)
                residual = remaining.ravel()
                if is_last:
                    break
            else:
                damping *= 20
            normal = columns.T @ columns
            diagonal = np.diag(normal) * damping + RIDGE * np.trace(normal)
            change = np.linalg.solve(normal + np.diag(diagonal), columns.T @ residual)
            theta = np.maximum(self.theta + change[:n_theta], 0.0)
            starts = self.starts + change[n_theta:].reshape(self.starts.shape)
        return best

    def move(self, factor: float) -> None:
        """Where the optimum should be for ``factor`` times the last size: in proportion
        from that without an effect.
        """
        moved = self.theta - self.first_theta
        self.theta = np.maximum(self.first_theta + factor * moved, 0.0)
        self.starts = self.first_starts + factor * (self.starts - self.first_starts)

    def _slopes(self, theta: Array, starts: Array) -> tuple[Array, Array]:
        """The measured channels (n_times, n_runs, n_seen), and their slopes in every
        parameter and (for all trajectories at once) every starting value.
        """
        s = self.setting
        n_theta, n_x = len(theta), starts.shape[1]
        of_theta, of_start = np.arange(n_theta), np.arange(n_x)
        thetas = np.tile(theta, (1 + n_theta + n_x, 1))
        thetas[1 + of_theta, of_theta] += STEP
        all_starts = np.tile(starts, (1 + n_theta + n_x, 1, 1))
        all_starts[1 + n_theta + of_start, :, of_start] += STEP
        values = {k: np.full(len(thetas), value) for k, value in self.values.items()}
        values |= dict(zip(s.free, np.maximum(thetas, 0.0).T, strict=True))
        machine = _with_values(s.machine, values)
        x = simulate(machine, (), all_starts, s.training_drive, s.t, STEPS)
        runs = np.moveaxis(x, 1, 0)[..., list(s.seen)]
        return runs[0], (runs[1:] - runs[0]) / STEP

    def _columns(self, slopes: Array) -> Array:
        """Slopes as columns; a starting value moves its own trajectory alone."""
        n_theta, n_x = len(self.theta), self.starts.shape[1]
        by_run = np.zeros((N_TRAIN, n_x, *slopes.shape[1:]))
        for run in range(N_TRAIN):
            by_run[run, :, :, run] = slopes[n_theta:, :, run]
        in_theta = slopes[:n_theta].reshape(n_theta, -1)
        in_starts = by_run.reshape(N_TRAIN * n_x, -1)
        return np.concatenate([in_theta, in_starts]).T


def _with_values(machine: Machine, values: Mapping[str, Array]) -> Machine:
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


# --- the effect: place, shape, size


def placed(
    rng: np.random.Generator, name: str, s: Setting, aim: Aim
) -> tuple[Hidden, float] | None:
    """An effect at a random place, at the size that meets the aim, and the ratio of the
    free-run error to the noise floor; None where the least ratio is not met.
    """
    if name in INPUT:
        at = s.machine.pushed
    elif name in SENSORS:
        at = int(rng.choice(s.seen))
    else:
        at = int(rng.integers(s.machine.n))
    hidden = Hidden(name, at, 0.0, drawn_shape(rng, name, at, s))
    largest = EFFECTS[name].largest * unit_of(hidden, s)
    least = aim.noise * np.sqrt(aim.least**2 - 1)
    refit = Refit(s)
    last = 0.0

    def error_of(size: float) -> float:
        nonlocal last
        if last:
            refit.move(size / last)
        last = size
        return refit.error(training_samples((replace(hidden, size=size),), s))

    def is_hopeless(trial: Trial) -> bool:
        """Whether even the largest size will hardly show."""
        return 1.5 * trial.error * largest / trial.size < least

    found = searched(error_of, largest, aim, is_hopeless)
    if found is None or not found.error < LOUDEST_OF_SIGNAL:
        return None
    ratio = aim.ratio(found.error)
    if not is_accepted(ratio, aim):
        return None
    return replace(hidden, size=found.size), ratio


def is_accepted(ratio: float, aim: Aim) -> bool:
    """Whether an effect shows enough, and not too much."""
    low, high = ACCEPTED
    return low * aim.least <= ratio <= high * aim.target


def training_samples(hidden: tuple[Hidden, ...], s: Setting) -> Array:
    """What the sensors show of the training runs, quickly and without noise; friction
    is rounded so that a few steps between samples can follow.
    """
    rounded = []
    for effect in hidden:
        shape = dict(effect.shape)
        if "width" in shape:
            shape["width"] *= ROUNDED
        rounded.append(replace(effect, shape=shape))
    starts, drive = s.starts[TRAINING], s.training_drive
    return measured(s.machine, tuple(rounded), starts, drive, s.t, 2 * STEPS)


def drawn_shape(
    rng: np.random.Generator, name: str, at: int, s: Setting
) -> dict[str, float]:
    """The numbers of an effect beside its size, on the scales of the experiment.

    Those of all forces are drawn, whichever is asked for.
    """
    sign = float(rng.choice([-1.0, 1.0]))
    phase = float(rng.uniform(0, 2 * np.pi))
    if name in SENSORS:
        return {"sign": sign, "largest": float(np.abs(s.nominal[..., at]).max())}
    n = s.machine.n
    omega = 2 * np.pi / s.period
    v = s.nominal[..., n + at] / s.machine.mass[at]
    fast = float(np.sqrt(np.mean(v**2)))
    far = float(np.abs(s.nominal[..., at]).max())
    last = float(s.t[-1])
    loudest = 0.0 if s.drive is None else float(np.abs(s.drive.values).max())
    shapes = {
        "coulomb friction": {"width": 1e-3 * fast},
        "stribeck friction": {
            "width": 1e-3 * fast,
            "rise": rng.uniform(0.8, 1.5),
            "speed": rng.uniform(0.3, 0.6) * fast,
        },
        "gap": {"play": rng.uniform(0.25, 0.6) * far},
        "harmonic force": {"omega": omega * rng.uniform(0.5, 1.6)},
        "parametric stiffness": {"omega": omega * rng.uniform(0.4, 2.2)},
        "input saturation": {"largest": loudest},
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
    own = {key: float(value) for key, value in shapes.get(name, {}).items()}
    return {"sign": sign, "phase": phase, **own}


def unit_of(hidden: Hidden, s: Setting) -> float:
    """The size of which `Effect.largest` counts: the root mean square of the spring's
    force, periods, the largest input, the share cut off.
    """
    name = hidden.name
    at = hidden.at
    x = s.nominal[..., at]
    if name in SENSORS:
        drift = float(x.std() / s.t[-1])
        units = {"sensor offset": float(x.std()), "sensor drift": 2 * drift}
        return units.get(name, s.period if name == "sensor delay" else 1.0)
    if name in ("input lag", "input delay"):
        return s.period
    if name in ("input saturation", "input gain"):
        return 1.0
    if name == "input dead zone":
        assert s.drive is not None
        return float(np.abs(s.drive.values).max())
    spring = s.machine.stiffness[at] * np.sqrt(np.mean(x**2))
    if name == "hysteresis":
        return float(spring * (hidden.shape["beta"] + hidden.shape["gamma"]))
    if name == "attached absorber":  # in masses
        return float(s.machine.mass[at])
    if name == "shocks":
        return float(spring * 2)
    # The root mean square along the nominal runs of the force of size one.
    n = s.machine.n
    law = law_of(replace(hidden, size=1.0))
    no_memory = np.zeros((s.nominal.shape[1], 1))
    forces = []
    for t, state in zip(s.t, s.nominal, strict=True):
        q = state[:, :n]
        v = state[:, n:] / s.machine.mass
        moment = Moment(t, q[:, at], v[:, at], q[:, n - 1 - at], no_memory, s.drive)
        forces.append(np.broadcast_to(law(moment), len(state)))
    rms = np.sqrt(np.mean(np.array(forces) ** 2))
    return float(spring / max(rms, 1e-12))


# --- the case


def masses_case(
    rng: np.random.Generator, kind: str, effects: tuple[str, ...], aim: Aim
) -> Case | None:
    """None, one or several of the effects in a machine; None where they do not show.

    Of several effects each alone meets the aim; the error of all together is computed
    once more.
    """
    names: tuple[str, ...] = ()
    if kind in SEVERAL:
        sets = list(combinations(effects, SEVERAL[kind]))
        names = sets[rng.integers(len(sets))]
    elif effects:
        names = (str(rng.choice(effects)),)
    s = draw_setting(rng, names)
    ratio = 1.0
    hidden = []
    for name in names:
        found = placed(rng, name, s, aim)
        if found is None:
            return None
        hidden.append(found[0])
        ratio = found[1]
    if kind in SEVERAL:
        error = Refit(s).error(training_samples(tuple(hidden), s))
        if not error < LOUDEST_OF_SIGNAL:
            return None
        ratio = aim.ratio(error)
    shaking = _shaking(rng, s) if kind == "shaken" else None
    shown = measured(s.machine, tuple(hidden), s.starts, s.drive, s.t, 0, shaking)
    y = np.moveaxis(shown, 0, 1)  # (n_runs, n_times, n_states)
    without = np.moveaxis(s.nominal, 0, 1)
    seen = list(s.seen)
    if hidden and not shows_held_out(y[..., seen], without[..., seen]):
        return None
    memory = MEMORY if kind == "lasting" else 0.0
    sampled = samples(rng, y, aim.noise, s.t, s.states, s.seen, s.drive, memory)
    return Case(
        model=model_of(s, rng),
        truths=tuple(truth_of(effect, s) for effect in hidden),
        hidden=" + ".join(names) or "nothing",
        noise=aim.noise,
        ratio=ratio,
        **sampled,
    )


def _shaking(rng: np.random.Generator, s: Setting) -> Drive:
    """An Ornstein-Uhlenbeck force whose correlation time is a radian of the swing."""
    steps = 4  # between samples
    h = float(s.t[1]) / steps
    keep = np.exp(-2 * np.pi * h / s.period)
    innovations = rng.normal(size=(N_RUNS, steps * len(s.t) + 1))
    values = lasting(innovations, keep, axis=1)
    at = s.machine.pushed
    spring = s.machine.stiffness[at] * np.sqrt(np.mean(s.nominal[..., at] ** 2))
    return Drive(h, SHAKEN * spring * values, "linear")


def samples(
    rng: np.random.Generator,
    clean: Array,
    relative_noise: float,
    t: Array,
    states: tuple[str, ...],
    seen: tuple[int, ...],
    drive: Drive | None = None,
    memory: float = 0.0,
) -> dict[str, Any]:
    """What a case has of all runs, (n_runs, n_times, n_states), with the noise that is
    known here: relative to each channel's deviation over the training runs.
    """
    sigma = relative_noise * clean[TRAINING].std(axis=(0, 1))
    noise = sigma * lasting(rng.normal(size=clean.shape), memory, axis=1)
    names = (states, ("u",) if drive else ())

    def shown(y: Array, part: slice, known: dict[str, float] | None = None) -> Any:
        runs = range(N_RUNS)[part]
        inputs = None
        if drive is not None:
            inputs = [values[:, None] for values in drive.values[part]]
        hold = drive.hold if drive else "linear"
        times = [t] * len(runs)
        return measurements(
            times, list(y[part]), inputs, names, seen, runs, hold, known
        )

    return {
        "train": shown(clean + noise, TRAINING),
        "test": shown(clean + noise, HELD_OUT),
        "clean": shown(clean, TRAINING, {states[k]: float(sigma[k]) for k in seen}),
        "sigma": sigma,
        "test_noise": noise[HELD_OUT],
    }


def truth_of(hidden: Hidden, s: Setting) -> Truth:
    """The effect as it should be found."""
    at = hidden.at if hidden.name in SENSORS else s.machine.n + hidden.at
    equations: tuple[str, ...] = (s.states[at],)
    if hidden.name == "coupling stiffness":  # the spring pulls at both
        equations = s.states[s.machine.n :]
    count = EFFECTS[hidden.name].coefficient
    coefficient = count(hidden.size, hidden.shape) if count else np.nan
    return Truth((hidden.name,), equations, coefficient)


def shows_held_out(y: Array, without: Array) -> bool:
    """Whether the effect changes the held-out runs at least a third as much as the
    training runs (a brim, a wall).

    ``y`` and ``without``: (n_runs, n_times, n_channels) with and without the effect.
    """
    scaled = (y - without) / y.std(axis=(0, 1))
    change = np.sqrt(np.mean(scaled**2, axis=(1, 2)))
    held_out = np.sqrt(np.mean(change[HELD_OUT] ** 2))
    training = np.sqrt(np.mean(change[TRAINING] ** 2))
    return bool(held_out > training / 3)

"""Experiments with machines of the field: motion, model error, sensors, size of the
hidden effect.

Every case has a disturbance that no effect of the catalogue is (a random force or a
random function of the states), unless it is asked for without, or has noise that lasts
in its stead. The size of the effect is set so that it shows by a given amount above the
noise and above what the model error does.

Arrays of states are (..., n_runs, n_states), of inputs (..., n_runs, n_inputs);
parameters may have leading axes, so that variations of a machine are integrated
together.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.optimize import least_squares

import phsi_opt as ph
from problems.battery.records import (
    Aim,
    Array,
    Truth,
    integrated,
    lasting,
    log_uniform,
    measurements,
    runge_kutta,
    searched,
)

Values = Mapping[str, float | Array]
# What a hidden effect of size one adds to dx/dt, from states and inputs.
Law = Callable[[Array, Array], Array]
# Inputs (n_runs, n_inputs) at a time, which a controller makes from the states.
InputAt = Callable[[float, Array], Array]


@dataclass(frozen=True, eq=False)
class Hidden:
    """The law of a hidden effect, and what it is called.

    Attributes:
        truths: With the coefficients of size one.
        least, largest: They enclose its size; where ``is_drawn`` it is drawn between
            them, else it is set by how it shows.
    """

    name: str
    law: Law
    truths: tuple[Truth, ...]
    largest: float
    least: float = 0.0
    is_drawn: bool = False


@dataclass(frozen=True, eq=False)
class Experiment:
    """A machine, what is done with it, and the model that lacks the hidden effect.

    Attributes:
        rates: dx/dt of the model from states, inputs and parameters.
        values: True values of the model's free parameters.
        model: With any starting values.
        row: The equation in which the machine is not quite the model.
        time: A period, or a time constant.
        is_sampled: Inputs are made at the samples, and held.
        n_kept: Samples of each run; empty: all.
        loudest: Largest free-run error of the model, as a share of the signal.
        is_faint: The effect is there, and below the noise.
    """

    rates: Callable[[Array, Array, Values], Array]
    values: Mapping[str, float]
    model: ph.Model
    hidden: Hidden
    t: Array
    starts: Array
    n_train: int
    row: int
    time: float
    seen: tuple[int, ...] = (0,)
    input_at: InputAt | None = None
    hold: str = "linear"
    is_sampled: bool = False
    n_kept: tuple[int, ...] = ()
    loudest: float = 0.9
    is_faint: bool = False

    @property
    def n_runs(self) -> int:
        """Number of runs, for training and held out."""
        return len(self.starts)

    @property
    def kept(self) -> Array:
        """Whether a sample belongs to its run, (n_samples, n_runs)."""
        n_kept = np.array(self.n_kept or [len(self.t)] * self.n_runs)
        return np.arange(len(self.t))[:, None] < n_kept

    def training(self, x: Array) -> Array:
        """The samples of the training runs that belong to them."""
        return x[:, : self.n_train][self.kept[:, : self.n_train]]


@dataclass(frozen=True, eq=False)
class Motion:
    """States (n_samples, n_runs, n_states) and inputs (n_samples, n_runs, n_inputs)."""

    x: Array
    u: Array


# --- motions

Disturbance = Callable[[float, Array], Array]  # of time and states


def simulate(
    e: Experiment, size: float, disturbance: Disturbance | None = None
) -> Motion:
    """The motion with the hidden effect of a size, and what acts beside the model."""
    shape = e.starts.shape

    def rates(t: float, flat: Array, held: Array | None = None) -> Array:
        x = flat.reshape(shape)
        u = np.zeros((shape[0], 0)) if held is None else held
        if held is None and e.input_at is not None:
            u = e.input_at(t, x)
        dx = e.rates(x, u, e.values) + size * e.hidden.law(x, u)
        if disturbance is not None:
            dx[:, e.row] += disturbance(t, x)
        return dx.ravel()

    def moved(x0: Array, t: Array, *held: Array) -> Array:
        step = float(t[1] - t[0])
        flat = integrated(rates, x0.ravel(), t, step, *held, is_bounded=False)
        return flat.reshape(len(t), *shape)

    if e.is_sampled:
        assert e.input_at is not None
        found = [e.starts]
        for begin, end in pairwise(e.t):
            held = e.input_at(begin, found[-1])
            found.append(moved(found[-1], np.array([begin, end]), held)[-1])
        x = np.array(found)
    else:
        x = moved(e.starts, e.t)
    if e.input_at is None:
        return Motion(x, np.zeros((*x.shape[:2], 0)))
    u = [e.input_at(t, now) for t, now in zip(e.t, x, strict=True)]
    return Motion(x, np.array(u))


def linear_between(values: Array, t: Array, time: float) -> Array:
    """Values at the samples, joined by straight lines."""
    place = (time - t[0]) / (t[1] - t[0])
    k = int(np.clip(place, 0, len(t) - 2))
    return values[k] + (place - k) * (values[k + 1] - values[k])


def held_between(values: Array, t: Array, time: float) -> Array:
    """Values at the samples, held until the next one."""
    return values[min(int((time - t[0]) / (t[1] - t[0]) + 1e-9), len(values) - 1)]


# --- what acts beside the model

RANDOM_FORCE, FUNCTION, NONE = "random force", "function of the states", "none"
BESIDE = (RANDOM_FORCE, FUNCTION)
# Correlation times of the random force, in the experiment's own time.
TIMES = (0.03, 1.0)
N_WAVES = 12  # of the random function
# Wavelength of its waves over 2 pi, in root mean squares of a state.
SMOOTHNESS = 0.6


def disturbance(
    rng: np.random.Generator, kind: str, e: Experiment, motion: Motion, rms: float
) -> Disturbance:
    """A disturbance of that root mean square along a motion.

    The force is Ornstein and Uhlenbeck's process at the samples. The function is a sum
    of waves in the states, less what it has in common with the laws of a catalogue.
    """
    if kind == RANDOM_FORCE:
        time = float(log_uniform(rng, *TIMES)) * e.time
        memory = np.exp(-(e.t[1] - e.t[0]) / time)
        values = lasting(rng.normal(size=(len(e.t), e.n_runs)), memory)
        force = rms * (values / np.sqrt(np.mean(values[e.kept] ** 2)))
        return lambda t, x: linear_between(force, e.t, t)
    x = motion.x[e.kept]
    scale = np.sqrt(np.mean(x**2, axis=0))
    waves = rng.normal(size=(x.shape[1], N_WAVES)) / SMOOTHNESS
    phases = rng.uniform(0, 2 * np.pi, N_WAVES)
    sizes = rng.normal(size=N_WAVES)
    shape = np.cos(x / scale @ waves + phases) @ sizes
    laws = known_laws(x / scale)
    common, *_ = np.linalg.lstsq(laws, shape, rcond=None)
    factor = 1 / np.sqrt(np.mean((shape - laws @ common) ** 2))
    sizes, common = rms * (factor * sizes), rms * (factor * common)

    def function(t: float, x: Array) -> Array:
        z = x / scale
        return np.cos(z @ waves + phases) @ sizes - known_laws(z) @ common

    return function


def known_laws(z: Array) -> Array:
    """Powers of each state up to the third, with their signs, and q^2 v; last axis."""
    columns = [np.ones(z.shape[:-1])]
    for k in range(z.shape[-1]):
        x = z[..., k]
        columns += [x, x**2, x * np.abs(x), x**3]
    if z.shape[-1] == 2:
        columns.append(z[..., 0] ** 2 * z[..., 1])
    return np.stack(columns, axis=-1)


# --- what is measured

STEPS = (3.0, 20.0)  # of a coarse sensor, in a standard deviation of the motion
UNEVEN = 5.0  # times as much noise in some runs as in others
MEMORY = 0.7  # of coloured noise, from sample to sample


@dataclass(frozen=True)
class Sensing:
    """How a motion is measured.

    Attributes:
        noise: Share of the root mean square of each channel.
        n_steps: Of the sensor in a standard deviation of the channel; 0: fine.
        memory: Of the noise.
    """

    noise: float
    n_steps: float = 0.0
    is_uneven: bool = False
    memory: float = 0.0


def measured(
    rng: np.random.Generator, e: Experiment, motion: Motion, how: Sensing
) -> list[ph.Measurements]:
    """Training runs and those held out, with noise."""
    kept = e.kept
    training = e.training(motion.x)
    noise = lasting(rng.normal(size=motion.x.shape), how.memory)
    sizes = np.full(e.n_runs, how.noise)
    if how.is_uneven:
        sizes[0::2] /= np.sqrt(UNEVEN)
        sizes[1::2] *= np.sqrt(UNEVEN)
    y = motion.x + noise * sizes[:, None] * np.sqrt(np.mean(training**2, axis=0))
    if how.n_steps:
        step = training.std(axis=0) / how.n_steps
        y = step * np.round(y / step)
    names = (e.model.states, e.model.inputs)
    parts = []
    for runs in (range(e.n_train), range(e.n_train, e.n_runs)):
        times = [e.t[kept[:, run]] for run in runs]
        states = [y[kept[:, run], run] for run in runs]
        inputs = [motion.u[kept[:, run], run] for run in runs]
        given = inputs if e.model.inputs else None
        parts.append(measurements(times, states, given, names, e.seen, runs, e.hold))
    return parts


# --- how far the model without the effect stays from the machine

STEP = 1e-5  # of the differences, in scales of the unknowns
EVALUATIONS = 40  # of the runs, at most
TOLERANCE = 1e-4  # of the error: more is not needed to set a size


class BaseFit:
    """Least squares of the model's free parameters and starting states to noise-free
    training runs, without the package.
    """

    def __init__(self, e: Experiment) -> None:
        self.e = e
        self.names = list(e.values)
        self.starts = e.starts[: e.n_train]
        size = np.sqrt(np.mean(self.starts**2, axis=0))
        scales = [max(abs(value), 1e-9) for value in e.values.values()]
        of_starts = np.tile(np.maximum(size, size.max() * 1e-3), e.n_train)
        self.scale = np.concatenate([scales, of_starts])
        first = [*e.values.values(), *self.starts.ravel()]
        self.unknowns = np.array(first) / self.scale

    def error(self, motion: Motion) -> float:
        """Root mean square over the seen channels, each in its own root mean square.

        Goes on from the last call's optimum.
        """
        e = self.e
        kept = e.kept[:, : e.n_train]
        seen = motion.x[:, : e.n_train, list(e.seen)]
        scale = np.sqrt(np.mean(seen[kept] ** 2, axis=0))
        u = motion.u[:, : e.n_train]

        def residuals(unknowns: Array) -> Array:
            runs = self._runs(unknowns[None], u)[0]
            remaining = ((runs - seen) / scale)[kept].ravel()
            return np.nan_to_num(np.clip(remaining, -1e3, 1e3), nan=1e3)

        def slopes(unknowns: Array) -> Array:
            varied = unknowns + STEP * np.eye(len(unknowns))
            runs = self._runs(np.concatenate([unknowns[None], varied]), u)
            change = (runs[1:] - runs[0]) / scale / STEP
            columns = [slope[kept].ravel() for slope in change]
            return np.nan_to_num(np.stack(columns, axis=1))

        lower = np.full(len(self.scale), -np.inf)
        lower[: len(self.names)] = 0.0
        found = least_squares(
            residuals,
            np.maximum(self.unknowns, lower),
            jac=slopes,
            bounds=(lower, np.inf),
            ftol=TOLERANCE,
            max_nfev=EVALUATIONS,
        )
        self.unknowns = found.x
        return float(np.sqrt(np.mean(found.fun**2)))

    def _runs(self, unknowns: Array, u: Array) -> Array:
        """Seen channels (n_variations, n_samples, n_runs, n_seen) along recorded
        inputs; one step of Runge and Kutta between two samples.
        """
        e = self.e
        numbers = unknowns * self.scale
        n = len(self.names)
        values = {name: numbers[:, k, None] for k, name in enumerate(self.names)}
        x = numbers[:, n:].reshape(-1, *self.starts.shape)
        found = [x]
        # Values that are tried on the way may be far off.
        with np.errstate(over="ignore", invalid="ignore"):
            for begin, following in pairwise(u):
                end = begin if e.hold == "zero" else following
                inputs = {0.0: begin, 0.5: (begin + end) / 2, 1.0: end}
                x = runge_kutta(
                    lambda share, x, u=inputs: e.rates(x, u[share], values),
                    x,
                    e.t[1] - e.t[0],
                )
                found.append(x)
        return np.moveaxis(np.array(found), 0, 1)[..., list(e.seen)]


# --- the size of the effect

# Root mean square of what acts beside the model, in that of the motion's own force.
MODEL_ERROR = 0.05
# Free-run error of the model without the effect, over the noise.
QUIETEST = 3.0
LOUDEST = 30.0
# What the effect does to a run over what the model error does to it, at least.
ABOVE_MODEL_ERROR = 2.0
WANTED_ABOVE = 2.5  # is sought where the first size is too small
FAINT = (0.1, 0.4)  # shares of the noise, of an effect that should not be seen


@dataclass(frozen=True, eq=False)
class Sized:
    """An effect's size, the motion that it makes, and how it shows.

    Attributes:
        ratio: Free-run error of the best re-fit of the model over the noise.
        disturbed: What the model error does to the same runs, over the noise.
    """

    size: float
    motion: Motion
    ratio: float
    disturbed: float

    @property
    def shows(self) -> bool:
        """Whether it is above the noise and above the model error."""
        return self.ratio > max(ABOVE_MODEL_ERROR * self.disturbed, QUIETEST)


@dataclass(frozen=True, eq=False)
class Sizing:
    """The search for a size.

    Attributes:
        noise: Its share of the signal.
        kind: Of the disturbance.
        model_error: The disturbance's share of the motion's own force.
    """

    e: Experiment
    rng: np.random.Generator
    noise: float
    kind: str
    model_error: float = MODEL_ERROR

    def sized(self) -> Sized | None:
        """The experiment with its effect; None where it does not show as it should."""
        hidden = self.e.hidden
        if self.e.is_faint:
            size = hidden.largest / 20
            share = self.rng.uniform(*FAINT)
            size *= share * self.noise / self._base_error(size)
            return self.disturbed(size, share * self.noise)
        if hidden.is_drawn:
            size = float(log_uniform(self.rng, hidden.least, hidden.largest))
            drawn = self.disturbed(size, self._base_error(size))
            return drawn if drawn.shows else None
        fit = BaseFit(self.e)
        found = self._aimed(fit, float(log_uniform(self.rng, QUIETEST, LOUDEST)))
        if found is None or found.shows:
            return found
        found = self._aimed(fit, WANTED_ABOVE * found.disturbed)
        return found if found is not None and found.shows else None

    def _base_error(self, size: float) -> float:
        return BaseFit(self.e).error(simulate(self.e, size))

    def _aimed(self, fit: BaseFit, target: float) -> Sized | None:
        """The size at which the model's error is near ``target`` times the noise."""
        found = searched(
            lambda size: fit.error(simulate(self.e, size)),
            self.e.hidden.largest,
            Aim(self.noise, target, QUIETEST),
        )
        assert found is not None
        if found.error > self.e.loudest or found.error < QUIETEST * self.noise:
            return None
        return self.disturbed(found.size, found.error)

    def disturbed(self, size: float, error: float) -> Sized:
        """The motion with what acts beside the model."""
        e = self.e
        calm = motion = simulate(e, size)
        if self.model_error > 0 and self.kind != NONE:
            strength = self.model_error * _typical_rate(e, size, calm)
            acting = disturbance(self.rng, self.kind, e, calm, strength)
            motion = simulate(e, size, acting)
        if e.input_at is not None:  # at the same recorded inputs
            join = held_between if e.hold == "zero" else linear_between
            e = replace(e, input_at=lambda t, x: join(motion.u, e.t, t))
        first, second = (
            e.training(each.x[..., list(e.seen)])
            for each in (simulate(e, size), motion)
        )
        scale = np.sqrt(np.mean(second**2, axis=0))
        change = float(np.sqrt(np.mean(((first - second) / scale) ** 2)))
        return Sized(size, motion, error / self.noise, change / self.noise)


def _typical_rate(e: Experiment, size: float, motion: Motion) -> float:
    """Root mean square rate in the equation of the disturbance."""
    x = motion.x
    rates = e.rates(x, motion.u, e.values) + size * e.hidden.law(x, motion.u)
    return float(np.sqrt(np.mean(rates[e.kept][:, e.row] ** 2)))

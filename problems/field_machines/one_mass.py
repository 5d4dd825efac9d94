"""Machines of one mass: a short run of an oscillator, a ship's roll, a pendulum that
goes over the top.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

import phsi_opt as ph
from problems.field_machines.laws import coulomb, cubic, quadratic, viscous
from problems.field_machines.records import (
    Array,
    Experiment,
    Hidden,
    Rates,
    Values,
)
from problems.hidden_effects.machines import log_uniform

PER_PERIOD = 40  # samples of a short run
PER_ROLL = 24  # samples in a period of a longer record
N_ROLLS = (6, 10)  # periods of a roll decay
LARGEST_DAMPING = 0.3  # damping ratio of a hidden damper
LARGEST_ROLL_DAMPING = 0.12
# Share of the spring's force that a cubic spring or a drag has at the largest swing.
LARGEST_SHARE = 0.7
LARGEST_DRAG = 0.4
# A pendulum: energy over that of the top, and samples.
OVER_THE_TOP = (1.15, 2.5)
N_PENDULUM = 220
PENDULUM_PERIODS = (4.0, 6.0)


@dataclass(frozen=True)
class Spring:
    """A mass on a spring with a damper, its largest swing, and its frequency."""

    mass: float
    stiffness: float
    damping: float
    swing: float

    @property
    def frequency(self) -> float:
        """In radians per unit of time."""
        return float(np.sqrt(self.stiffness / self.mass))

    @property
    def period(self) -> float:
        """Without damping."""
        return 2 * np.pi / self.frequency


def drawn_spring(rng: np.random.Generator, ratios: tuple[float, float]) -> Spring:
    """A mass on a spring whose damping ratio is between two."""
    mass = float(log_uniform(rng, 0.5, 2.0))
    stiffness = float(log_uniform(rng, 0.5, 8.0))
    ratio = float(log_uniform(rng, *ratios))
    damping = 2 * ratio * np.sqrt(stiffness * mass)
    return Spring(mass, stiffness, damping, float(rng.uniform(0.5, 1.5)))


def hidden_in(spring: Spring, name: str, ratio: float) -> Hidden:
    """The effect of that name, with the largest size that makes sense.

    ``ratio``: largest damping ratio of a hidden damper.
    """
    m = spring.mass
    swing = spring.swing
    if name == "viscous damping":
        return viscous(m, 2 * ratio * np.sqrt(spring.stiffness * m))
    if name == "quadratic drag":
        return quadratic(m, LARGEST_DRAG * m / swing)
    return cubic(LARGEST_SHARE * spring.stiffness / swing**2)


def spring_rates(mass: float, is_damped: bool) -> Rates:
    """Rates of position and momentum."""

    def rates(x: Array, u: Array, values: Values) -> Array:
        v = x[..., 1] / mass
        force = -values["k"] * x[..., 0]
        if is_damped:
            force = force - values["c"] * v
        return np.stack([v, force], axis=-1)

    return rates


def spring_model(mass: float, is_damped: bool, starts: Mapping[str, float]) -> ph.Model:
    """The mass known, spring and damper not."""
    k = ph.Parameter(starts["k"], lower=0.0)
    R = {}
    if is_damped:
        R = {"p": ph.formula("c", c=ph.Parameter(starts["c"], lower=0.0))}
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula(f"k*q**2/2 + p**2/(2*{mass!r})", k=k),
        R=R,
    )


def on_spring(
    spring: Spring,
    hidden: Hidden,
    t: Array,
    starts: Array,
    n_train: int,
    seen: tuple[int, ...] = (0,),
) -> Experiment:
    """The experiment with a mass on a spring; damped unless its damper is hidden."""
    is_damped = hidden.name != "viscous damping"
    values = {"k": spring.stiffness}
    if is_damped:
        values["c"] = spring.damping
    return Experiment(
        states=("q", "p"),
        seen=seen,
        rates=spring_rates(spring.mass, is_damped),
        values=values,
        model=lambda given: spring_model(spring.mass, is_damped, given),
        hidden=hidden,
        t=t,
        starts=starts,
        n_train=n_train,
        row=1,
        time=spring.period,
    )


def short_run(rng: np.random.Generator) -> Experiment:
    """One run of one to three periods; another one held out."""
    spring = drawn_spring(rng, (0.02, 0.08))
    name = str(rng.choice(["viscous damping", "cubic stiffness"]))
    hidden = hidden_in(spring, name, LARGEST_DAMPING)
    seen = (0, 1) if rng.random() < 0.5 else (0,)
    n_samples = int(rng.uniform(1, 3) * PER_PERIOD)
    t = np.arange(n_samples) * spring.period / PER_PERIOD
    starts = _swings(rng, spring, np.array([1.0, 0.8]))
    return on_spring(spring, hidden, t, starts, 1, seen)


def long_runs(rng: np.random.Generator) -> Experiment:
    """Runs of several periods, as `short_run` else."""
    spring = drawn_spring(rng, (0.01, 0.03))
    name = str(rng.choice(["viscous damping", "cubic stiffness"]))
    hidden = hidden_in(spring, name, LARGEST_DAMPING / 2)
    return on_spring(spring, hidden, _long(rng, spring), _decays(rng, spring), 3)


def roll_decay(rng: np.random.Generator) -> Experiment:
    """A ship that rolls out from a list; its roll angle alone is measured."""
    spring = drawn_spring(rng, (0.01, 0.04))
    names = ["viscous damping", "quadratic drag", "cubic stiffness"]
    hidden = hidden_in(spring, str(rng.choice(names)), LARGEST_ROLL_DAMPING)
    return on_spring(spring, hidden, _long(rng, spring), _decays(rng, spring), 3)


def _long(rng: np.random.Generator, spring: Spring) -> Array:
    n_samples = int(rng.uniform(*N_ROLLS) * PER_ROLL)
    return np.arange(n_samples) * spring.period / PER_ROLL


def _swings(rng: np.random.Generator, spring: Spring, shares: Array) -> Array:
    """Starts at shares of the largest swing, at a random phase."""
    phase = rng.uniform(0, 2 * np.pi, len(shares))
    q = spring.swing * shares * np.cos(phase)
    speed = spring.swing * shares * spring.frequency * np.sin(phase)
    return np.stack([q, spring.mass * speed], axis=1)


def _decays(rng: np.random.Generator, spring: Spring) -> Array:
    """Released nearly at rest from several angles; the last is held out."""
    shares = np.array([1.0, -0.75, 0.5, 0.85]) * rng.uniform(0.9, 1.0, 4)
    q = spring.swing * shares
    p = 0.03 * spring.mass * spring.frequency * spring.swing * rng.normal(size=4)
    return np.stack([q, p], axis=1)


def pendulum(rng: np.random.Generator) -> Experiment:
    """A pendulum that goes over the top before it swings; friction is hidden.

    With dry friction it may stick before the record ends.
    """
    inertia = float(log_uniform(rng, 0.5, 2.0))
    torque = float(log_uniform(rng, 2.0, 10.0))  # of gravity, when level
    frequency = float(np.sqrt(torque / inertia))
    energy = 2 * torque * rng.uniform(*OVER_THE_TOP, 4)
    momentum = np.sqrt(2 * inertia * energy) * np.array([1.0, -1.0, 1.0, -1.0])
    starts = np.stack([0.1 * rng.normal(size=4), momentum], axis=1)
    t = np.linspace(
        0, rng.uniform(*PENDULUM_PERIODS) * 2 * np.pi / frequency, N_PENDULUM
    )
    speed = float(np.sqrt(energy.mean() / inertia))
    if rng.random() < 0.5:
        sizes = 2 * inertia * frequency * np.array([0.02, 0.1])
        hidden = viscous(inertia, sizes[1])
    else:
        sizes = torque * np.array([0.05, 0.2])
        hidden = coulomb(inertia, speed, sizes[1])
    drawn = Hidden(
        hidden.name, hidden.law, hidden.truths, sizes[1], sizes[0], is_drawn=True
    )

    def rates(x: Array, u: Array, values: Values) -> Array:
        force = -values["G"] * np.sin(x[..., 0])
        return np.stack([x[..., 1] / inertia, force], axis=-1)

    def model(given: Mapping[str, float]) -> ph.Model:
        G = ph.Parameter(given["G"], lower=0.0)
        H = ph.formula(f"p**2/(2*{inertia!r}) - G*cos(q)", G=G)
        return ph.PseudoHamiltonian(states=["q", "p"], S=ph.canonical(1), H=H)

    return Experiment(
        states=("q", "p"),
        seen=(0,),
        rates=rates,
        values={"G": torque},
        model=model,
        hidden=drawn,
        t=t,
        starts=starts,
        n_train=3,
        row=1,
        time=2 * np.pi / frequency,
        loudest=np.inf,
    )

"""A simulated oscillator on which something acts that its model does not have.

A mass of 1 kg on a spring with a damper, driven by a known voltage; its position alone
is measured, every 0.1 s. Beside noise there may be a random force, a cubic spring, a
static nonlinearity that is drawn, noise that lasts, or a coarse sensor. Forces stand
per mass, in m/s^2.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.signal import lfilter

import phsi_opt as ph

TRUTH = {"k": 4.0, "R_v": 0.3, "g": 1.0}  # N/m, N s/m, N/V
INTERVAL = 0.1  # s
SUBSTEPS = 10  # of Runge and Kutta's method in an interval
INITIAL_SPREAD = 0.5  # m and m/s
# The voltage: sines of equal amplitude and random phase, whose frequencies are spread
# over a band around the natural one of 2 rad/s, of 1 V root mean square together.
N_SINES = 60
LOWEST_FREQUENCY = 0.3  # rad/s
HIGHEST_FREQUENCY = 6.0  # rad/s
FREQUENCY_JITTER = 0.05  # rad/s
# Motion from which the coefficient of a cubic spring is chosen: a share of the whole
# spring force is told to about a hundredth of itself.
MOTION_SEED = 77_777
MOTION_RUNS = 200
MOTION_SAMPLES = 400
MOST_ITERATIONS = 20  # 4 are needed
SETTLED = 1e-4  # relative change of the coefficient

# A force of position and velocity, (n_runs,) each, m/s^2.
StaticForce = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Disturbance:
    """What the model does not know of.

    Attributes:
        force_size: standard deviation of an Ornstein-Uhlenbeck force, m/s^2.
        force_time: its correlation time, s.
        cubic_share: root mean square of a cubic spring's force over that of the whole
            spring force.
        noise: standard deviation of the sensor's noise, m.
        noise_correlation: of its neighbouring samples.
        step: of a sensor that rounds, m; 0: it does not.
        drawn_shares: least and largest share of a static nonlinearity that every seed
            draws anew (`drawn_nonlinearity`); None: there is none.
    """

    force_size: float = 0.0
    force_time: float = 1.0
    cubic_share: float = 0.0
    noise: float = 0.02
    noise_correlation: float = 0.0
    step: float = 0.0
    drawn_shares: tuple[float, float] | None = None


@dataclass(frozen=True)
class Layout:
    """How many runs of how many samples a record has."""

    runs: int
    samples: int


@dataclass(frozen=True, eq=False)
class Draw:
    """Everything random of some runs.

    Attributes:
        voltage: (n_runs, n_samples), linear in between, V.
        force: (n_runs, n_substeps), constant in each, m/s^2.
        state: (n_runs, 2) position and velocity at first.
        noise: (n_runs, n_samples), m.
    """

    voltage: np.ndarray
    force: np.ndarray
    state: np.ndarray
    noise: np.ndarray

    @classmethod
    def of(cls, seed: int, disturbance: Disturbance, layout: Layout) -> "Draw":
        """The draw of a seed; voltages and states do not depend on the disturbance."""
        rng = np.random.default_rng([seed, layout.runs, layout.samples])
        voltage = _voltage(rng, layout)
        state = INITIAL_SPREAD * rng.normal(size=(layout.runs, 2))
        noise = _lasting(rng, layout, disturbance.noise_correlation)
        n_substeps = (layout.samples - 1) * SUBSTEPS
        ends = Layout(layout.runs, n_substeps + 1)
        decay = np.exp(-INTERVAL / SUBSTEPS / disturbance.force_time)
        force = disturbance.force_size * _lasting(rng, ends, float(decay))
        middle = (force[:, 1:] + force[:, :-1]) / 2
        return cls(voltage, middle, state, disturbance.noise * noise)

    @classmethod
    def joined(cls, draws: Sequence["Draw"]) -> "Draw":
        """The runs of several draws, one after the other."""
        return cls(
            voltage=np.concatenate([draw.voltage for draw in draws]),
            force=np.concatenate([draw.force for draw in draws]),
            state=np.concatenate([draw.state for draw in draws]),
            noise=np.concatenate([draw.noise for draw in draws]),
        )


def _voltage(rng: np.random.Generator, layout: Layout) -> np.ndarray:
    """(n_runs, n_samples), of unit root mean square."""
    shape = (layout.runs, N_SINES)
    frequency = np.linspace(LOWEST_FREQUENCY, HIGHEST_FREQUENCY, N_SINES)
    frequency = frequency + rng.uniform(-FREQUENCY_JITTER, FREQUENCY_JITTER, shape)
    phase = rng.uniform(0, 2 * np.pi, shape)
    voltage = np.zeros((layout.runs, layout.samples))
    for i in range(layout.samples):
        angle = frequency * (i * INTERVAL) + phase
        voltage[:, i] = np.sin(angle).sum(axis=1)
    return voltage * np.sqrt(2 / N_SINES)


def _lasting(
    rng: np.random.Generator, layout: Layout, correlation: float
) -> np.ndarray:
    """Stationary noise of unit variance whose neighbours have this correlation."""
    white = rng.normal(size=(layout.runs, layout.samples))
    white[:, 1:] *= np.sqrt(1 - correlation**2)
    lasting: np.ndarray = lfilter([1.0], [1.0, -correlation], white, axis=1)
    return lasting


@dataclass(frozen=True, eq=False)
class Motion:
    """How some runs move, without noise.

    Attributes:
        position: (n_runs, n_samples), m.
        velocity: (n_runs, n_samples), m/s.
    """

    position: np.ndarray
    velocity: np.ndarray


def motion(draw: Draw, pull: StaticForce) -> Motion:
    """Motion of every run, by Runge and Kutta's method.

    Args:
        draw: what drives the runs.
        pull: what acts beside spring and damper, against the motion as they do, m/s^2.
    """
    h = INTERVAL / SUBSTEPS
    q = draw.state[:, 0]
    v = draw.state[:, 1]
    n_samples = draw.voltage.shape[1]
    shown = Motion(np.zeros(draw.voltage.shape), np.zeros(draw.voltage.shape))
    shown.position[:, 0] = q
    shown.velocity[:, 0] = v
    for i in range(n_samples - 1):
        rise = (draw.voltage[:, i + 1] - draw.voltage[:, i]) / SUBSTEPS
        for sub in range(SUBSTEPS):
            voltage = draw.voltage[:, i] + sub * rise
            push = TRUTH["g"] * voltage + draw.force[:, i * SUBSTEPS + sub]
            more = TRUTH["g"] * rise
            a1 = push - _linear(q, v) - pull(q, v)
            q2 = q + h / 2 * v
            v2 = v + h / 2 * a1
            a2 = push + more / 2 - _linear(q2, v2) - pull(q2, v2)
            q3 = q + h / 2 * v2
            v3 = v + h / 2 * a2
            a3 = push + more / 2 - _linear(q3, v3) - pull(q3, v3)
            q4 = q + h * v3
            v4 = v + h * a3
            a4 = push + more - _linear(q4, v4) - pull(q4, v4)
            q = q + h / 6 * (v + 2 * v2 + 2 * v3 + v4)
            v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        shown.position[:, i + 1] = q
        shown.velocity[:, i + 1] = v
    return shown


def _linear(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Acceleration by spring and damper, m/s^2."""
    return TRUTH["k"] * q + TRUTH["R_v"] * v


def positions(draw: Draw, cubic: float) -> np.ndarray:
    """Positions beside a cubic spring, without noise, (n_runs, n_samples).

    Args:
        draw: what drives the runs.
        cubic: coefficient of the cubic spring, N/m^3.
    """

    def pull(q: np.ndarray, _: np.ndarray) -> np.ndarray:
        return cubic * q**3

    return motion(draw, pull).position


@cache
def cubic_coefficient(share: float) -> float:
    """Coefficient of the cubic spring with a share of the whole spring force, N/m^3."""
    layout = Layout(MOTION_RUNS, MOTION_SAMPLES)
    draw = Draw.of(MOTION_SEED, Disturbance(), layout)
    cubic = 0.0
    for _ in range(MOST_ITERATIONS):
        q = positions(draw, cubic)
        whole = np.sqrt(np.mean((TRUTH["k"] * q + cubic * q**3) ** 2))
        new = share * float(whole / np.sqrt(np.mean(q**6)))
        change = abs(new - cubic)
        cubic = new
        if change <= SETTLED * cubic:
            break
    return cubic


def model() -> ph.PseudoHamiltonian:
    """The model, which has none of the disturbances; a quarter off at first."""
    energy = ph.formula("k*q**2/2 + v**2/2", k=ph.Parameter(3.0, lower=0))
    return ph.PseudoHamiltonian(
        states=["q", "v"],
        inputs=["u"],
        S=ph.canonical(1),
        H=energy,
        R=ph.damping("v"),
        F={"v": ph.formula("g*u", g=ph.Parameter(0.8))},
    )

"""A simulated oscillator on which something acts that its model does not have.

A mass of 1 kg on a spring with a damper, driven by a known voltage; its position alone
is measured, every 0.1 s. Beside noise there may be a random force, a cubic spring,
noise that lasts, or a coarse sensor. Forces stand per mass, in m/s^2.
"""

from collections.abc import Sequence
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
FREQUENCIES = (0.3, 6.0)  # rad/s
FREQUENCY_JITTER = 0.05  # rad/s
# Motion from which the size of a nonlinearity is chosen: a share of the whole spring
# force is told to about a hundredth of itself.
MOTION_SEED = 77_777
MOTION_RUNS = 200
MOTION_SAMPLES = 400


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
    """

    force_size: float = 0.0
    force_time: float = 1.0
    cubic_share: float = 0.0
    noise: float = 0.02
    noise_correlation: float = 0.0
    step: float = 0.0


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
        ends = Layout(layout.runs, (layout.samples - 1) * SUBSTEPS + 1)
        decay = np.exp(-INTERVAL / SUBSTEPS / disturbance.force_time)
        force = disturbance.force_size * _lasting(rng, ends, float(decay))
        middle = (force[:, 1:] + force[:, :-1]) / 2
        return cls(voltage, middle, state, disturbance.noise * noise)


def _voltage(rng: np.random.Generator, layout: Layout) -> np.ndarray:
    """(n_runs, n_samples), of unit root mean square."""
    shape = (layout.runs, N_SINES)
    frequency = np.linspace(*FREQUENCIES, N_SINES)
    frequency = frequency + rng.uniform(-FREQUENCY_JITTER, FREQUENCY_JITTER, shape)
    phase = rng.uniform(0, 2 * np.pi, shape)
    voltage = np.zeros((layout.runs, layout.samples))
    for i in range(layout.samples):
        voltage[:, i] = np.sin(frequency * (i * INTERVAL) + phase).sum(axis=1)
    return voltage * np.sqrt(2 / N_SINES)


def _lasting(
    rng: np.random.Generator, layout: Layout, correlation: float
) -> np.ndarray:
    """Stationary noise of unit variance whose neighbours have this correlation."""
    white = rng.normal(size=(layout.runs, layout.samples))
    white[:, 1:] *= np.sqrt(1 - correlation**2)
    return np.asarray(lfilter([1.0], [1.0, -correlation], white, axis=1))


def positions(draw: Draw, cubic: float) -> np.ndarray:
    """Positions (n_runs, n_samples) by Runge and Kutta's method beside a cubic spring,
    without noise.
    """
    h = INTERVAL / SUBSTEPS
    q, v = draw.state.T
    shown = np.zeros(draw.voltage.shape)
    shown[:, 0] = q

    def rate(push: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return push - (TRUTH["k"] * q + TRUTH["R_v"] * v) - cubic * q**3

    for i in range(draw.voltage.shape[1] - 1):
        rise = (draw.voltage[:, i + 1] - draw.voltage[:, i]) / SUBSTEPS
        more = TRUTH["g"] * rise
        for sub in range(SUBSTEPS):
            voltage = draw.voltage[:, i] + sub * rise
            push = TRUTH["g"] * voltage + draw.force[:, i * SUBSTEPS + sub]
            a1 = rate(push, q, v)
            v2 = v + h / 2 * a1
            a2 = rate(push + more / 2, q + h / 2 * v, v2)
            v3 = v + h / 2 * a2
            a3 = rate(push + more / 2, q + h / 2 * v2, v3)
            v4 = v + h * a3
            a4 = rate(push + more, q + h * v3, v4)
            q = q + h / 6 * (v + 2 * v2 + 2 * v3 + v4)
            v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        shown[:, i + 1] = q
    return shown


@cache
def cubic_coefficient(share: float) -> float:
    """Coefficient of the cubic spring with a share of the whole spring force, N/m^3."""
    draw = Draw.of(MOTION_SEED, Disturbance(), Layout(MOTION_RUNS, MOTION_SAMPLES))
    cubic = 0.0
    for _ in range(20):  # 4 are needed
        q = positions(draw, cubic)
        whole = np.sqrt(np.mean((TRUTH["k"] * q + cubic * q**3) ** 2))
        before, cubic = cubic, share * float(whole / np.sqrt(np.mean(q**6)))
        if abs(before - cubic) <= 1e-4 * cubic:
            break
    return cubic


def model() -> ph.PseudoHamiltonian:
    """The model, which has none of the disturbances; a quarter off at first."""
    return ph.PseudoHamiltonian(
        states=["q", "v"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + v**2/2", k=ph.Parameter(3.0, lower=0)),
        R=ph.damping("v"),
        F={"v": ph.formula("g*u", g=ph.Parameter(0.8))},
    )


def records(
    seeds: Sequence[int], disturbance: Disturbance, layout: Layout
) -> list[ph.Measurements]:
    """The measurements of every seed."""
    return [record(seed, disturbance, layout) for seed in seeds]


def record(seed: int, disturbance: Disturbance, layout: Layout) -> ph.Measurements:
    """The measurements of a seed."""
    draw = Draw.of(seed, disturbance, layout)
    shown = positions(draw, cubic_coefficient(disturbance.cubic_share)) + draw.noise
    if disturbance.step:
        shown = np.round(shown / disturbance.step) * disturbance.step
    return ph.Measurements.from_arrays(
        [np.arange(layout.samples) * INTERVAL] * layout.runs,
        [np.column_stack([q, np.full(len(q), np.nan)]) for q in shown],
        list(draw.voltage[:, :, None]),
        states=["q", "v"],
        inputs=["u"],
        hold="linear",
    )

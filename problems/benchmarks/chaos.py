"""Chaotic systems over many Lyapunov times: Lorenz and a double pendulum, 10 % noise.

A trajectory computed from a guessed start leaves the measured one after a few Lyapunov
times, so least squares on simulations has countless local minima. Maximum likelihood
with the states as unknowns has no such trouble; the same sensitivity that spoils a
prediction makes the parameters precise.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import phsi_opt as ph
from problems.tools.simulation import integrated

NOISE = 0.1  # of each channel's standard deviation
START = 1.0  # of a parameter of the Lorenz system
MASS_START = 0.5  # kg, of the masses of the pendulum


@dataclass(frozen=True)
class Chaos:
    """A chaotic system, what is measured of it for how long, and the model.
    ``lyapunov``: its largest exponent.

    ``noise`` is relative to each channel's standard deviation, that of ``angles`` after
    full turns are taken off. ``steps``: integration steps between two samples (None:
    chosen by the package).
    """

    title: str
    states: tuple[str, ...]
    rhs: Callable[[float, np.ndarray], Any]
    start: tuple[float, ...]
    step: float
    n_steps: int
    lyapunov: float
    truth: Mapping[str, float]
    model: Callable[[], ph.Model]
    measured: tuple[str, ...]
    noise: float = NOISE
    angles: tuple[str, ...] = ()
    steps: int | None = None

    @property
    def times(self) -> np.ndarray:
        """The sampling times."""
        return np.linspace(0.0, self.n_steps * self.step, self.n_steps + 1)

    def solve(self) -> np.ndarray:
        """The true states (n_samples, n_states)."""
        return integrated(self.rhs, self.times, self.start, rtol=1e-12, atol=1e-12)

    def spread(self, x: np.ndarray) -> np.ndarray:
        """What the noise is relative to, (n_states,)."""
        is_angle = np.isin(self.states, self.angles)
        without_turns = np.angle(np.exp(1j * x))
        return np.where(is_angle, without_turns, x).std(axis=0)

    def data(self, seed: int) -> ph.Measurements:
        """Measurements of a seed."""
        x = self.solve()
        normal = np.random.default_rng(seed).normal(size=x.shape)
        y = x + self.noise * self.spread(x) * normal
        y[:, ~np.isin(self.states, self.measured)] = np.nan
        return ph.Measurements.from_arrays([self.times], [y], states=self.states)


# --- Lorenz

SIGMA = 10.0
RHO = 28.0
BETA = 8 / 3
LORENZ_TRUTH = {"sigma": SIGMA, "rho": RHO, "beta": BETA}


def lorenz_rates(
    _t: Any, x: Sequence[Any], theta: Sequence[Any], _cos: Any = None
) -> list[Any]:
    """Numbers of numbers, symbols of symbols; theta: sigma, rho, beta."""
    return [
        theta[0] * (x[1] - x[0]),
        x[0] * (theta[1] - x[2]) - x[1],
        x[0] * x[1] - theta[2] * x[2],
    ]


def lorenz_model() -> ph.FirstOrder:
    """Three numbers unknown, each started at 1."""
    rates = {
        "x": ph.formula("sigma*(y - x)", sigma=ph.Parameter(START)),
        "y": ph.formula("x*(rho - z) - y", rho=ph.Parameter(START)),
        "z": ph.formula("x*y - beta*z", beta=ph.Parameter(START)),
    }
    return ph.FirstOrder(["x", "y", "z"], rates)


def lorenz_dictionary() -> ph.FirstOrder:
    """All polynomials of degree 2 in every equation: 30 numbers unknown, no starts."""
    states = ("x", "y", "z")
    rate = ph.polynomials(states, degree=2, constant=True)
    return ph.FirstOrder(states, dict.fromkeys(states, rate))


def _dictionary_truth() -> dict[str, float]:
    truth = dict.fromkeys(lorenz_dictionary().free, 0.0)
    return truth | {
        "F_x[x]": -SIGMA,
        "F_x[y]": SIGMA,
        "F_y[x]": RHO,
        "F_y[y]": -1.0,
        "F_y[x*z]": -1.0,
        "F_z[x*y]": 1.0,
        "F_z[z]": -BETA,
    }


# --- double pendulum: angles a, b from the vertical, momenta pa, pb; both rods of
# length 1 m, driven at the upper joint

MASS_1 = 1.0  # kg
MASS_2 = 0.7  # kg
GRAVITY = 9.81  # m/s^2
FRICTION = 0.02  # N m s
DRIVE = 6.0  # N m
DRIVE_FREQUENCY = 2.5  # rad/s
PENDULUM_TRUTH = {"m1": MASS_1, "m2": MASS_2, "R_pa": FRICTION, "R_pb": FRICTION}
PENDULUM_ENERGY = (
    "(m2*pa**2 + (m1 + m2)*pb**2 - 2*m2*pa*pb*cos(a - b))"
    "/(2*m2*(m1 + m2*sin(a - b)**2))"
    " - (m1 + m2)*g*cos(a) - m2*g*cos(b)"
)


def _pendulum(t: float, x: np.ndarray) -> np.ndarray:
    a, b, pa, pb = x
    s = np.sin(a - b)
    c = np.cos(a - b)
    total = MASS_1 + MASS_2
    size = MASS_1 + MASS_2 * s**2
    va = (pa - pb * c) / size
    vb = (total / MASS_2 * pb - pa * c) / size
    squares = MASS_2 * pa**2 + total * pb**2 - 2 * MASS_2 * pa * pb * c
    kinetic = squares / (2 * MASS_2 * size)
    turn = pa * pb * s / size - kinetic * 2 * MASS_2 * s * c / size
    drive = DRIVE * np.sin(DRIVE_FREQUENCY * t)
    pa_rate = -turn - total * GRAVITY * np.sin(a) - FRICTION * va + drive
    pb_rate = turn - MASS_2 * GRAVITY * np.sin(b) - FRICTION * vb
    return np.array([va, vb, pa_rate, pb_rate])


def pendulum_model() -> ph.PseudoHamiltonian:
    """Both masses and both dampings unknown; lengths, gravity and drive known."""
    m1 = ph.Parameter(MASS_START, lower=0.05)
    m2 = ph.Parameter(MASS_START, lower=0.05)
    return ph.PseudoHamiltonian(
        states=["a", "b", "pa", "pb"],
        S=ph.canonical(2),
        H=ph.formula(PENDULUM_ENERGY, g=GRAVITY, m1=m1, m2=m2),
        R=ph.damping("pa", "pb"),
        F={"pa": ph.formula(f"{DRIVE}*sin({DRIVE_FREQUENCY}*t)")},
    )


def lorenz(
    title: str,
    measured: tuple[str, ...],
    steps: int | None = 1,
    dictionary: bool = False,
) -> Chaos:
    """Lorenz sampled every 0.02 s.

    One SRK4 step between the samples is accurate enough: estimates with 2 and 4 differ
    by less than 0.03 standard errors.
    """
    return Chaos(
        title,
        states=("x", "y", "z"),
        rhs=lambda t, x: lorenz_rates(t, x.tolist(), (SIGMA, RHO, BETA)),
        start=(-5.0, -6.0, 22.0),
        step=0.02,
        n_steps=1500,
        lyapunov=0.906,
        truth=_dictionary_truth() if dictionary else LORENZ_TRUTH,
        model=lorenz_dictionary if dictionary else lorenz_model,
        measured=measured,
        steps=steps,
    )


EXPERIMENTS = {
    "lorenz_xyz": lorenz("Lorenz, x, y and z measured", ("x", "y", "z")),
    "lorenz_x": lorenz("Lorenz, x alone measured", ("x",)),
    "lorenz_xyz_steps": lorenz(
        "Lorenz, x, y and z measured, integration steps chosen by the package",
        ("x", "y", "z"),
        steps=None,
    ),
    "lorenz_dictionary": lorenz(
        "Lorenz, x, y and z measured, all 30 coefficients of degree 2",
        ("x", "y", "z"),
        dictionary=True,
    ),
    "pendulum": Chaos(
        "Driven double pendulum, angles and momenta measured",
        states=("a", "b", "pa", "pb"),
        rhs=_pendulum,
        start=(1.2, 1.9, 0.0, 0.0),
        step=0.02,
        n_steps=1500,
        lyapunov=0.8,
        truth=PENDULUM_TRUTH,
        model=pendulum_model,
        measured=("a", "b", "pa", "pb"),
        angles=("a", "b"),
        steps=1,
    ),
}

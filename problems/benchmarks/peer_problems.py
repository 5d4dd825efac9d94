"""Problems of `identify`: what moves, what is measured of it, where fits begin."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import phsi_opt as ph
from problems.benchmarks.chaos import LORENZ_TRUTH, lorenz_model, lorenz_rates
from problems.benchmarks.efficiency.cases import DUFFING, duffing_model
from problems.tools.simulation import integrated

NOISE = 0.03  # of each channel's standard deviation
LEAST_OFF = 0.2  # share by which a parameter starts off, at least
MOST_OFF = 0.5
EXPLODED = 1e6  # a state beyond which no motion of these systems is

# (t, x, theta, cos) -> dx/dt: numbers for SciPy, symbols for CasADi.
Rates = Callable[[Any, Sequence[Any], Sequence[Any], Callable[[Any], Any]], list[Any]]


def _explodes(_t: float, x: np.ndarray) -> float:
    """Falls through zero, which ends an integration, where the states are lost."""
    return EXPLODED - float(np.max(np.abs(x)))


_explodes.terminal = True  # type: ignore[attr-defined]


@dataclass(frozen=True)
class Problem:
    """A system, its measurements and its model.

    Attributes:
        name: in the table.
        rates: the equations.
        truth: by name, in the order of ``theta`` in the rates.
        model: the same equations for `identify`.
        starts: (lower, upper) of each starting state.
        t: sampling times, (n_samples,).
        n_runs: number of trajectories.
        is_measured: per state.
        has_shooting: whether single shooting is run.
    """

    name: str
    rates: Rates
    truth: Mapping[str, float]
    model: Callable[[], ph.Model]
    starts: Sequence[tuple[float, float]]
    t: np.ndarray
    n_runs: int
    is_measured: tuple[bool, ...]
    has_shooting: bool = True

    def simulated(self, start: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """States at the samples, (n_samples, n_states); fewer where they explode."""
        values = theta.tolist()
        return integrated(
            lambda t, x: self.rates(t, x.tolist(), values, np.cos),
            self.t,
            start,
            "LSODA",
            events=_explodes,
            rtol=1e-7,
            atol=1e-8,
        )


@dataclass(frozen=True)
class Drawn:
    """What a seed measured, and where the fit begins.

    Attributes:
        y: (n_runs, n_samples, n_states), NaN where nothing was measured.
        sigma: (n_states,) of the noise.
        guess: (n_theta,) parameters to start from.
    """

    y: np.ndarray
    sigma: np.ndarray
    guess: np.ndarray


def drawn(problem: Problem, seed: int) -> Drawn:
    """Measurements and start of a seed."""
    rng = np.random.default_rng(seed)
    theta = np.array(list(problem.truth.values()))
    lower, upper = np.array(problem.starts).T
    runs = []
    for _ in range(problem.n_runs):
        runs.append(problem.simulated(rng.uniform(lower, upper), theta))
    x = np.array(runs)
    sigma = NOISE * x.std(axis=(0, 1))
    y = x + sigma * rng.normal(size=x.shape)
    y[:, :, ~np.array(problem.is_measured)] = np.nan
    off = rng.uniform(LEAST_OFF, MOST_OFF, len(theta))
    guess = theta * (1 + off * rng.choice([-1.0, 1.0], len(theta)))
    return Drawn(y, sigma, guess)


def duffing_rates(
    t: Any, x: Sequence[Any], theta: Sequence[Any], cos: Any
) -> list[Any]:
    """A driven Duffing oscillator."""
    force = -theta[0] * x[0] - theta[1] * x[0] ** 3 - theta[2] * x[1]
    return [x[1], force + 2 * cos(1.3 * t)]


def _spring(_t: Any, x: Sequence[Any], theta: Sequence[Any], _cos: Any) -> list[Any]:
    return [x[1], -theta[0] * x[0] - theta[1] * x[1]]


def spring_model() -> ph.PseudoHamiltonian:
    """Stiffness and damping unknown, the mass known."""
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/2", k=ph.Parameter(1.0)),
        R=ph.damping("p"),
    )


ANYWHERE = ((-1.5, 1.5), (-1.5, 1.5))
PROBLEMS = (
    Problem(
        "Duffing, q alone, 5 x 201",
        duffing_rates,
        DUFFING,
        duffing_model,
        ANYWHERE,
        np.linspace(0.0, 20.0, 201),
        5,
        (True, False),
    ),
    Problem(
        "mass-spring, 50 x 101",
        _spring,
        {"k": 2.0, "R_p": 0.2},
        spring_model,
        ANYWHERE,
        np.linspace(0.0, 10.0, 101),
        50,
        (True, True),
    ),
    Problem(
        "Lorenz, 1 x 501",
        lorenz_rates,
        LORENZ_TRUTH,
        lorenz_model,
        ((-10.0, 10.0), (-10.0, 10.0), (15.0, 30.0)),
        np.linspace(0.0, 10.0, 501),
        1,
        (True, True, True),
    ),
    Problem(
        "Duffing, q alone, 1 x 10 000",
        duffing_rates,
        DUFFING,
        duffing_model,
        ANYWHERE,
        0.1 * np.arange(10_000),
        1,
        (True, False),
        has_shooting=False,
    ),
)

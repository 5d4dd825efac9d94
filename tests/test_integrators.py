"""What every one-step scheme promises: its order, its symmetry, and to name itself when
asked for something else.
"""

from typing import Any

import numpy as np
import pytest

from phsi_opt.errors import ModelError
from phsi_opt.transcription.integrators import INTEGRATORS, Integrator, integrator

SCHEMES = list(INTEGRATORS.values())
each_scheme = pytest.mark.parametrize("scheme", SCHEMES, ids=[s.name for s in SCHEMES])


def pendulum(t: float, x: np.ndarray) -> np.ndarray:
    """A driven, damped pendulum: nonlinear and dependent on the time."""
    return np.array([x[1], -np.sin(x[0]) - 0.3 * x[1] ** 3 + 0.5 * np.cos(1.3 * t)])


def logistic(t: float, x: np.ndarray) -> np.ndarray:
    """dx/dt = -2 t x^2 with the exact solution x = 1 / (1 + t^2)."""
    return -2 * t * x**2


def logistic_solution(t: float) -> np.ndarray:
    return np.array([1 / (1 + t**2)])


def defect(
    scheme: Integrator, f: Any, t0: float, h: float, x0: np.ndarray, x1: np.ndarray
) -> float:
    psi = scheme.psi(lambda x, c: f(t0 + c * h, x), x0, x1, h)
    return float(np.max(np.abs((x1 - x0) / h - psi)))


@each_scheme
def test_the_defect_of_an_exact_solution_shrinks_with_the_claimed_order(
    scheme: Integrator,
) -> None:
    sizes = []
    for h in (0.1 / 4, 0.1 / 8):
        ends = logistic_solution(0.5), logistic_solution(0.5 + h)
        sizes.append(defect(scheme, logistic, 0.5, h, *ends))
    # The next term of the expansion moves the observed order by O(h); at these steps
    # that is less than 0.25.
    assert np.log2(sizes[0] / sizes[1]) == pytest.approx(scheme.order, abs=0.25)


@each_scheme
def test_a_scheme_is_symmetric_exactly_where_it_says_so(scheme: Integrator) -> None:
    rng = np.random.default_rng(0)
    x0, x1, t0, h = rng.normal(size=2), rng.normal(size=2), 0.3, 0.4

    def forward(x: np.ndarray, c: float) -> np.ndarray:
        return pendulum(t0 + c * h, x)

    def backward(x: np.ndarray, c: float) -> np.ndarray:
        return pendulum(t0 + h - c * h, x)

    difference = np.max(
        np.abs(scheme.psi(forward, x0, x1, h) - scheme.psi(backward, x1, x0, -h))
    )
    # Rounding of a handful of operations on numbers near one; an asymmetric scheme
    # differs by O(h).
    assert (difference < 1e-14) == scheme.symmetric
    assert scheme.symmetric or difference > 1e-3


def test_an_unknown_scheme_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(
        ModelError,
        match=r"integrator 'rk44' is unknown; expected one of .* Did you mean 'rk4'\?",
    ):
        integrator("rk44")
    assert integrator("srk4") is INTEGRATORS["srk4"]

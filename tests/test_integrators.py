"""What every one-step scheme promises: its order, its symmetry, and to name itself when
asked for something else.
"""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

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


def halving_orders(
    scheme: Integrator, f: Any, exact: Any, t0: float, steps: list[float]
) -> np.ndarray:
    sizes = [defect(scheme, f, t0, h, exact(t0), exact(t0 + h)) for h in steps]
    return np.log2(np.array(sizes[:-1]) / sizes[1:])


@each_scheme
def test_the_defect_of_an_exact_solution_shrinks_with_the_claimed_order(
    scheme: Integrator,
) -> None:
    orders = halving_orders(
        scheme, logistic, logistic_solution, 0.5, [0.1 / 2**k for k in range(4)]
    )
    # The next term of the expansion moves the observed order by O(h); at these steps
    # that is less than 0.25.
    np.testing.assert_allclose(orders[-1], scheme.order, atol=0.25)


def test_halving_the_step_divides_srk4s_defect_by_sixteen_on_a_driven_pendulum() -> (
    None
):
    solution = solve_ivp(
        pendulum,
        (0.0, 1.5),
        [1.2, -0.4],
        "DOP853",
        rtol=1e-13,
        atol=1e-14,
        max_step=0.01,
        t_eval=[0.5, 0.55, 0.6, 0.7],
    ).y.T
    start, ends = solution[0], {0.05: solution[1], 0.1: solution[2], 0.2: solution[3]}
    sizes = [
        defect(INTEGRATORS["srk4"], pendulum, 0.5, h, start, ends[h])
        for h in (0.2, 0.1, 0.05)
    ]
    # 16 up to the next term of the expansion, O(h); the reference's 1e-13 / h is far
    # below the smallest defect.
    assert sizes[-1] > 1e-10
    assert 12 < sizes[0] / sizes[1] < 20
    assert 14 < sizes[1] / sizes[2] < 18


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


@each_scheme
def test_a_constant_rate_is_integrated_without_error(scheme: Integrator) -> None:
    rate = np.array([0.5, -2.0])
    x0 = np.array([1.0, 3.0])
    # Powers of two: the arithmetic is exact but for sums of thirds and roots, one
    # rounding each.
    np.testing.assert_allclose(
        scheme.psi(lambda x, c: rate, x0, x0 + 0.25 * rate, 0.25), rate, rtol=1e-15
    )


def test_an_unknown_scheme_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(
        ModelError,
        match=r"integrator 'rk44' is unknown; expected one of .* Did you mean 'rk4'\?",
    ):
        integrator("rk44")
    assert integrator("srk4") is INTEGRATORS["srk4"]

"""Least squares within bounds: right where it is plain, and an end where it is not."""

import signal
from collections.abc import Iterator
from itertools import product

import numpy as np
import pytest

from phsi_opt.optimization.bounded_step import bounded_least_squares

LONGEST = 10  # s; it takes less than a hundredth of one


@pytest.fixture
def ends() -> Iterator[None]:
    """A test that does not end fails."""

    def stop(*_: object) -> None:
        raise TimeoutError("it goes on for ever")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(LONGEST)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("seed", range(20))
def test_it_is_the_best_of_all_faces_of_the_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 3))
    b = 3 * rng.normal(size=6)
    lower = np.full(3, -0.5)
    upper = rng.uniform(0.2, 1.0, 3)
    found = bounded_least_squares(A, b, lower, upper)
    assert np.all(found >= lower - 1e-12) and np.all(found <= upper + 1e-12)
    best = np.inf
    for face in product((None, 0, 1), repeat=3):
        x = np.where([side == 1 for side in face], upper, lower)
        free = np.array([side is None for side in face])
        if free.any():
            rest = b - A[:, ~free] @ x[~free]
            x[free] = np.linalg.lstsq(A[:, free], rest, rcond=None)[0]
        if np.all(x >= lower - 1e-12) and np.all(x <= upper + 1e-12):
            best = min(best, float(np.sum((A @ x - b) ** 2)))
    assert np.sum((A @ found - b) ** 2) == pytest.approx(best, rel=1e-9)


def test_it_ends_where_columns_differ_by_many_orders_of_magnitude(ends: None) -> None:
    # A pair of effects, one of which a record hardly shows: SciPy's line search went on
    # for ever there.
    largest = [-2.0311908612130363e09, -4.2070509841368413e12, 1.4009889237342193e05]
    A = np.array(
        [
            [9.9999988344904259e-06, -4.8280627739826e-09, -6.3038560e-16, -3.826e-17],
            [3.7903385901885973e-12, -2.4401322510438e-14, -4.9241419e-22, 0.99051009],
            [*largest, -9.5868489709405688e-02],
            [6.2134610052692509e09, 2.6153095854338926e12, 7.85356197e19, 0.0796942362],
        ]
    )
    b = np.array([-0.13428627672, -6.787018943e-07, 7.6415438225e21, -3.8478524112e21])
    lower = np.array([-4.2538407762686865e11, -1.7478440983366890e09, -np.inf, -np.inf])
    upper = np.full(4, np.inf)
    found = bounded_least_squares(A, b, lower, upper)
    assert np.all(np.isfinite(found))
    assert np.all(found >= lower)

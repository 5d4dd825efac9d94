"""Factors along the time and steps of the parameters, against dense linear algebra."""

from itertools import product

import numpy as np
import pytest
from scipy.sparse import coo_matrix, csr_matrix

import phsi_opt as ph
from phsi_opt.optimization.banded import (
    FEWEST_STATES,
    Banded,
    BandLayout,
    Chained,
)
from phsi_opt.optimization.bounded_step import (
    Room,
    bounded_least_squares,
    bounded_step,
    regularized_inverse,
)

# ---- LU factors of a band


def factors_of(
    matrix: np.ndarray, order: np.ndarray, is_symmetric: bool = False
) -> Banded:
    entries = coo_matrix(matrix)
    layout = BandLayout(entries.row, entries.col, order, is_symmetric)
    return Banded(layout, entries.data)


@pytest.mark.parametrize(
    ("below", "above"), [(3, 3), (1, 4), (4, 1), (0, 2), (2, 0), (0, 0)]
)
def test_banded_factors_solve_what_dense_ones_solve(below: int, above: int) -> None:
    rng = np.random.default_rng(0)
    n = 30
    dense = np.triu(np.tril(rng.normal(size=(n, n)), above), -below) + 5 * np.eye(n)
    shuffled = rng.permutation(n)
    matrix = dense[np.ix_(shuffled, shuffled)]
    factors = factors_of(matrix, np.argsort(shuffled))
    assert (factors.layout.kl, factors.layout.ku) == (below, above)
    right = rng.normal(size=(n, 2))
    for one in (right, right[:, 0]):
        np.testing.assert_allclose(factors.solve(one), np.linalg.solve(matrix, one))
        transposed = np.linalg.solve(matrix.T, one)
        np.testing.assert_allclose(factors.solve(one, True), transposed)
    assert factors.log_abs_det == pytest.approx(np.linalg.slogdet(matrix)[1], rel=1e-12)


def test_a_singular_system_is_refused() -> None:
    match = "singular: probably a state is not measured"
    with pytest.raises(ph.SolveError, match=match):
        factors_of(np.ones((2, 2)), np.arange(2))


# ---- Cholesky factors where samples measure many states


class System:
    """States of runs, measured at every ``steps``-th node, and their dynamics."""

    def __init__(self, n: int, n_samples: list[int], steps: int) -> None:
        rng = np.random.default_rng(0)
        lengths = [(length - 1) * steps + 1 for length in n_samples]
        run = np.repeat(np.arange(len(lengths)), lengths)
        place = np.concatenate([np.arange(length) for length in lengths])
        begin = np.flatnonzero(np.diff(run) == 0)
        self.begin = begin
        of_samples = rng.uniform(0.5, 2.0, (len(run), n))
        is_sample = (place % steps == 0)[:, None]
        self.curvature = np.where(is_sample, of_samples, 1e-13)
        slopes = np.zeros((len(begin), n, len(run), n))
        for interval, node in enumerate(begin):
            for at, sign in ((node, -1.0), (node + 1, 1.0)):
                noise = rng.normal(size=(n, n)) / (5 * n)
                slopes[interval, :, at] = sign * np.eye(n) + noise
        self.slopes = slopes.reshape(len(begin) * n, -1)
        times = np.repeat(np.r_[np.arange(len(run)), begin + 0.5], n)
        self.order = np.argsort(times, kind="stable")

    def factors(self) -> Chained | None:
        return Chained.of(csr_matrix(self.slopes), self.begin, self.curvature)

    def whole(self) -> np.ndarray:
        zeros = np.zeros((len(self.slopes), len(self.slopes)))
        curved = np.diag(self.curvature.ravel())
        return np.block([[curved, self.slopes.T], [self.slopes, zeros]])


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_cholesky_factors_solve_what_those_of_the_band_solve(steps: int) -> None:
    system = System(FEWEST_STATES, [4, 2, 3], steps)
    chained = system.factors()
    assert chained is not None
    whole = factors_of(system.whole(), system.order)
    right = np.random.default_rng(1).normal(size=(chained.n, 3))
    for one in (right, right[:, 0]):
        solution = chained.solve(one)
        np.testing.assert_allclose(solution, whole.solve(one), rtol=1e-8, atol=1e-9)
    assert chained.log_abs_det == pytest.approx(whole.log_abs_det, abs=1e-8)


# ---- the covariance of parameters


def test_information_that_is_no_number_is_refused_with_what_to_do() -> None:
    match = (
        r"^the derivatives of the model with respect to its states overflow, so no "
        r"standard errors can be computed; give the parameters bounds, or starting "
        r"values closer to the solution\.$"
    )
    with pytest.raises(ph.SolveError, match=match):
        regularized_inverse(np.array([[1.0, 0.0], [0.0, np.inf]]))


# ---- within bounds


def best_of_all_faces(
    C: np.ndarray, pull: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> float:
    """The least value of d'Cd/2 - p'd in a box: the best of the minima of its faces."""
    values = []
    for face in product((None, 0, 1), repeat=len(pull)):
        d = np.where([side == 1 for side in face], upper, lower)
        free = [side is None for side in face]
        rest = pull - C @ np.where(free, 0.0, d)
        d[free] = np.linalg.solve(C[np.ix_(free, free)], rest[free])
        if np.all(d >= lower) and np.all(d <= upper):
            values.append(float(d @ C @ d / 2 - pull @ d))
    return min(values)


@pytest.mark.parametrize("seed", range(20))
def test_steps_and_least_squares_are_the_best_of_all_faces_of_the_box(seed) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(5, 3)) * [1.0, 30.0, 1e-3]
    C = root.T @ root
    full = rng.normal(size=3)
    pull = C @ full
    # Some begin at a bound.
    sizes = rng.uniform(0.1, 1.0, (2, 3)) * rng.integers(0, 2, (2, 3))
    room = Room(-sizes[0], sizes[1] + 0.05)
    best = best_of_all_faces(C, pull, room.below, room.above)
    rounding = 1e-9 * abs(float(full @ C @ full / 2 - pull @ full))
    least_squares = bounded_least_squares(root, root @ full, room.below, room.above)
    for d in (bounded_step(C, pull, room), least_squares):
        assert np.all(d >= room.below - 1e-12) and np.all(d <= room.above + 1e-12)
        assert d @ C @ d / 2 - pull @ d <= best + rounding


INF = np.inf


@pytest.mark.parametrize(("C", "pull", "below", "above", "expected"), [
    (np.eye(2), [-1.0, 1.0], [-0.1, -INF], [0.3, INF], [-0.1, 1.0]),
    # no room
    ([[2.0, 1.0], [1.0, 2.0]], [1.0, 1.0], [0.0, -1.0], [0.0, 1.0], [0.0, 0.5]),
    # a direction without data does not move another one to its bound
    (np.diag([1.0, 1e-16]), [-1.0, 1e-17], [0.0, -1.0], [INF, INF], [0.0, 0.0]),
    (np.diag([1.0, 3e4]), [1.0, -6e4], [-INF, -INF], [INF, INF], [1.0, -2.0]),
    (np.zeros((0, 0)), [], [], [], []),
])  # fmt: skip
def test_a_step_reaches_a_bound_exactly_and_leaves_out_silent_directions(
    C: np.ndarray, pull: list, below: list, above: list, expected: list
) -> None:
    room = Room(np.array(below), np.array(above))
    step = bounded_step(np.asarray(C), np.array(pull), room)
    np.testing.assert_allclose(step, expected, rtol=1e-12, atol=0)


def test_a_step_may_end_at_a_bound_and_not_beyond() -> None:
    room = Room(np.array([-1.0, 0.0]), np.array([2.0, 0.0]))
    for step in ([-1.0, 0.0], [2.0, 0.0]):
        assert room.holds(np.array(step))
        assert not room.holds(np.array(step) * (1 + 1e-15 * 8))
        assert room.share(2 * np.array(step)).tolist() == [0.5, 1.0]

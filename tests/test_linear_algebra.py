"""Factors along the time and steps of the parameters, against dense linear algebra."""

from collections.abc import Iterator
from itertools import pairwise, product

import numpy as np
import pytest
from scipy.sparse import coo_matrix, csr_matrix

import phsi_opt as ph
from phsi_opt.optimization.banded import (
    FEWEST_STATES,
    Banded,
    BandLayout,
    Chained,
    Passage,
)
from phsi_opt.optimization.bounded_step import (
    RIDGE,
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


@pytest.mark.parametrize("n_columns", [1, 2, 5])
def test_a_symmetric_matrix_is_solved_by_its_transposed_factors(n_columns: int) -> None:
    rng = np.random.default_rng(6)
    n = 40
    matrix = np.triu(np.tril(rng.normal(size=(n, n)), 3), -3)
    right = rng.normal(size=(n, n_columns))
    for one, is_symmetric in ((matrix + matrix.T, True), (matrix, False)):
        factors = factors_of(one, np.arange(n), is_symmetric)
        expected = np.linalg.solve(one, right)
        np.testing.assert_allclose(factors.solve(right), expected, rtol=1e-8)


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


def test_what_samples_do_not_measure_takes_the_band() -> None:
    lacking, ending = System(3, [4], 1), System(3, [4], 1)
    lacking.curvature[1, 1] = 0.0
    ending.curvature[-1] = 0.0
    assert lacking.factors() is None and ending.factors() is None


# ---- dynamics over gaps, against dense algebra gap by gap

N_STEPS = (1, 3, 2, 3)  # of the gaps of a run, and of another one from the third on


class Gaps:
    """Two runs with nodes between samples; states touch those within some reach."""

    def __init__(self, n: int, reach: int, strength: float = 0.1) -> None:
        rng = np.random.default_rng(0)
        self.n = n
        is_sample: list[bool] = []
        begin: list[int] = []
        for n_steps in (N_STEPS[:2], N_STEPS[2:]):
            is_sample.append(True)
            for steps in n_steps:
                for step in range(steps):
                    begin.append(len(is_sample) - 1)
                    is_sample.append(step == steps - 1)
        self.begin = np.array(begin)
        self.is_sample = np.array(is_sample)
        place = rng.permutation(n)
        touches = np.abs(np.subtract.outer(place, place)) <= reach
        noise = rng.normal(size=(2, len(begin), n, n)) * strength / reach
        self.before, self.after = touches * noise + np.array(
            [-np.eye(n)[None], np.eye(n)[None]]
        )
        self.right = rng.normal(size=(len(begin) * n, 2))
        self.forces = rng.uniform(0.5, 1.0, (len(begin), n))

    def passage(self) -> Passage:
        n, n_intervals = self.n, len(self.begin)
        slopes = np.zeros((n_intervals, n, len(self.is_sample), n))
        for interval, node in enumerate(self.begin):
            slopes[interval, :, node] = self.before[interval]
            slopes[interval, :, node + 1] = self.after[interval]
        matrix = csr_matrix(slopes.reshape(n_intervals * n, -1))
        return Passage(matrix, self.begin, self.is_sample, n)

    def held(self) -> csr_matrix:
        """Effects of forces that are held over each gap."""
        n, n_intervals = self.n, len(self.begin)
        effects = np.zeros((n_intervals, n, len(N_STEPS), n))
        gap = np.repeat(np.arange(len(N_STEPS)), N_STEPS)
        for interval in range(n_intervals):
            effects[interval, :, gap[interval]] = np.diag(self.forces[interval])
        return csr_matrix(effects.reshape(n_intervals * n, -1))

    def over_each(self) -> Iterator[tuple[np.ndarray, ...]]:
        """Of each gap: slopes at begin and end, right-hand sides, effect of forces."""
        right = self.right.reshape(len(self.begin), self.n, 2)
        for first, limit in pairwise(np.cumsum([0, *N_STEPS])):
            before, own = self.before[first], right[first]
            effect = np.diag(self.forces[first])
            for k in range(first + 1, limit):
                on = self.before[k] @ np.linalg.inv(self.after[k - 1])
                before, own = -on @ before, right[k] - on @ own
                effect = np.diag(self.forces[k]) - on @ effect
            yield before, self.after[limit - 1], own, effect


@pytest.mark.parametrize(("n", "reach"), [(3, 3), (60, 60), (150, 1)])
def test_gaps_are_those_of_dense_algebra(n: int, reach: int) -> None:
    gaps = Gaps(n, reach)
    passed = gaps.passage()
    slopes, right = passed.slopes().toarray(), passed.over(gaps.right)
    effects = passed.over_blocks(gaps.held()).toarray()
    sample = np.cumsum(gaps.is_sample) - 1
    of_first = sample[gaps.begin[gaps.is_sample[gaps.begin]]]
    expected_slopes = np.zeros_like(slopes)
    expected_effects = np.zeros_like(effects)
    for gap, (before, after, own, effect) in enumerate(gaps.over_each()):
        rows = slice(gap * n, gap * n + n)
        begin = of_first[gap] * n
        expected_slopes[rows, begin : begin + n] = before
        expected_slopes[rows, begin + n : begin + 2 * n] = after
        expected_effects[rows, rows] = effect
        np.testing.assert_allclose(right[rows], own, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(slopes, expected_slopes, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(effects, expected_effects, rtol=1e-9, atol=1e-14)


# ---- the covariance of parameters


def test_information_is_inverted_and_a_ridge_holds_what_has_none() -> None:
    rng = np.random.default_rng(2)
    root = 1e-2 * rng.normal(size=(3, 3))
    information = root @ root.T
    expected = np.linalg.inv(information)
    np.testing.assert_allclose(regularized_inverse(information), expected, rtol=1e-3)
    along, across = np.array([0.6, 0.8]), np.array([-0.8, 0.6])
    # What rounds below zero counts as zero.
    flat = 4.0 * np.outer(along, along) - 1e-3 * np.outer(across, across)
    expected = np.outer(along, along) / 4.0 + np.outer(across, across) / RIDGE
    np.testing.assert_allclose(regularized_inverse(flat), expected, rtol=1e-5)


def test_a_parameter_that_is_held_does_not_move_the_others() -> None:
    root = np.random.default_rng(3).normal(size=(3, 3))
    information = root @ root.T
    covariance = regularized_inverse(information, held=[1])
    assert covariance[1, 1] == pytest.approx(1e-12, rel=1e-6)
    others = np.ix_([0, 2], [0, 2])
    expected = np.linalg.inv(information[others])
    np.testing.assert_allclose(covariance[others], expected, rtol=1e-6)


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

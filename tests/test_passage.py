"""Dynamics over gaps between samples, against dense algebra gap by gap."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from phsi_opt.optimization import banded
from phsi_opt.optimization.banded import APART, PANEL, Passage, neighbours_first

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
        self.before = np.zeros((len(begin), n, n))
        self.after = np.zeros((len(begin), n, n))
        for blocks, sign in ((self.before, -1.0), (self.after, 1.0)):
            for block in blocks:
                block[:] = touches * rng.normal(size=(n, n)) * strength / reach
                block += sign * np.eye(n)
        self.right = rng.normal(size=(len(begin) * n, 2))
        self.forces = rng.uniform(0.5, 1.0, (len(begin), n))

    def passage(self) -> Passage:
        n, n_intervals = self.n, len(self.begin)
        slopes = np.zeros((n_intervals, n, len(self.is_sample), n))
        for interval, node in enumerate(self.begin):
            slopes[interval, :, node] = self.before[interval]
            slopes[interval, :, node + 1] = self.after[interval]
        matrix = csr_matrix(slopes.reshape(n_intervals * n, -1))
        row, column = np.nonzero(np.any(self.before, axis=0))
        rank = np.argsort(neighbours_first(row, column, n))
        return Passage(matrix, self.begin, self.is_sample, rank)

    def held(self) -> csr_matrix:
        """Effects of forces that are held over each gap."""
        n, n_intervals = self.n, len(self.begin)
        effects = np.zeros((n_intervals, n, len(N_STEPS), n))
        gap = np.repeat(np.arange(len(N_STEPS)), N_STEPS)
        for interval in range(n_intervals):
            effects[interval, :, gap[interval]] = np.diag(self.forces[interval])
        return csr_matrix(effects.reshape(n_intervals * n, -1))

    def over_each(self) -> list[tuple[np.ndarray, ...]]:
        """Of each gap: slopes at begin and end, right-hand sides, effect of forces."""
        right = self.right.reshape(len(self.begin), self.n, 2)
        found: list[tuple[np.ndarray, ...]] = []
        limits = np.cumsum([0, *N_STEPS])
        for first, limit in pairwise(limits):
            before, own = self.before[first], right[first]
            effect = np.diag(self.forces[first])
            for k in range(first + 1, limit):
                on = self.before[k] @ np.linalg.inv(self.after[k - 1])
                before, own = -on @ before, right[k] - on @ own
                effect = np.diag(self.forces[k]) - on @ effect
            found.append((before, self.after[limit - 1], own, effect))
        return found


def solved_widths(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Columns of what is solved for from now on."""
    widths = []
    followed = Passage.followed

    def counted(self: Passage, right: np.ndarray) -> np.ndarray:
        widths.append(right.shape[1])
        return followed(self, right)

    monkeypatch.setattr(Passage, "followed", counted)
    return widths


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


def test_the_slopes_inside_solve_both_ways() -> None:
    passed = Gaps(20, 2).passage()
    rng = np.random.default_rng(1)
    one, other = rng.normal(size=(2, len(passed.inside), 3))
    np.testing.assert_allclose(
        other.T @ passed.followed(one), passed.pulled(other).T @ one
    )
    assert not np.allclose(passed.followed(one), passed.pulled(one))


def test_states_that_are_far_apart_share_a_column(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    passed = Gaps(300, 1, 0.02).passage()
    widths = solved_widths(monkeypatch)
    passed.slopes()
    assert sum(widths) == APART
    assert max(widths) == PANEL


def test_states_that_feel_all_others_have_columns_of_their_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    passed = Gaps(90, 90).passage()
    widths = solved_widths(monkeypatch)
    passed.slopes()
    assert sum(widths) > 90  # after others that did not do


def test_what_is_only_rounding_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    sparse = Gaps(150, 1).passage().slopes()
    assert sparse.nnz < 0.2 * len(N_STEPS) * 2 * 150**2
    monkeypatch.setattr(banded, "NEGLIGIBLE", 0.0)
    whole = Gaps(150, 1).passage().slopes()
    assert whole.nnz > 2 * sparse.nnz
    np.testing.assert_allclose(sparse.toarray(), whole.toarray(), atol=1e-17)

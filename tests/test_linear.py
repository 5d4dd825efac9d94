"""Banded factors and the elimination of the states, against dense linear algebra."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix

from phsi_opt.errors import SolveError
from phsi_opt.optimization.banded import Banded, BandLayout
from phsi_opt.optimization.bounded_step import (
    HELD,
    RIDGE,
    regularized_inverse,
)


def factors_of(
    matrix: np.ndarray, order: np.ndarray, is_symmetric: bool = False
) -> Banded:
    entries = coo_matrix(matrix)
    layout = BandLayout(entries.row, entries.col, order, is_symmetric)
    return Banded(layout, entries.data)


def test_banded_factors_solve_what_dense_ones_solve() -> None:
    rng = np.random.default_rng(0)
    n = 30
    dense = np.where(
        np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 3,
        rng.normal(size=(n, n)),
        0.0,
    )
    shuffled = rng.permutation(n)
    matrix = dense[np.ix_(shuffled, shuffled)]
    banded = factors_of(matrix, np.argsort(shuffled))
    assert (banded.layout.kl, banded.layout.ku) == (3, 3)
    right = rng.normal(size=(n, 2))
    np.testing.assert_allclose(
        banded.solve(right), np.linalg.solve(matrix, right), rtol=1e-9
    )
    np.testing.assert_allclose(
        banded.solve(right[:, 0]), np.linalg.solve(matrix, right[:, 0]), rtol=1e-9
    )
    assert banded.log_abs_det == pytest.approx(np.linalg.slogdet(matrix)[1], rel=1e-12)


@pytest.mark.parametrize("n_columns", [1, 2, 5])
def test_a_symmetric_matrix_is_solved_by_its_transposed_factors(n_columns: int) -> None:
    rng = np.random.default_rng(6)
    n = 40
    matrix = np.triu(np.tril(rng.normal(size=(n, n)), 3), -3)
    symmetric = matrix + matrix.T
    right = rng.normal(size=(n, n_columns))
    for one, is_symmetric in ((symmetric, True), (matrix, False)):
        banded = factors_of(one, np.arange(n), is_symmetric)
        expected = np.linalg.solve(one, right)
        np.testing.assert_allclose(banded.solve(right), expected, rtol=1e-8)


@pytest.mark.parametrize(("below", "above"), [(1, 4), (4, 1), (0, 2), (2, 0), (0, 0)])
def test_a_band_need_not_be_as_wide_above_the_diagonal_as_below(
    below: int, above: int
) -> None:
    rng = np.random.default_rng(5)
    n = 20
    matrix = np.triu(np.tril(rng.normal(size=(n, n)), above), -below) + 5 * np.eye(n)
    banded = factors_of(matrix, np.arange(n))
    assert (banded.layout.kl, banded.layout.ku) == (below, above)
    right = rng.normal(size=n)
    np.testing.assert_allclose(banded.solve(right), np.linalg.solve(matrix, right))
    assert banded.log_abs_det == pytest.approx(np.linalg.slogdet(matrix)[1])


def test_a_singular_system_is_refused() -> None:
    with pytest.raises(
        SolveError,
        match="singular: a state may neither be measured nor act on one that is",
    ):
        factors_of(np.array([[1.0, 1.0], [1.0, 1.0]]), np.arange(2))


def test_information_is_inverted_and_a_ridge_holds_what_has_none() -> None:
    rng = np.random.default_rng(2)
    root = 1e-2 * rng.normal(size=(3, 3))
    information = root @ root.T
    np.testing.assert_allclose(
        regularized_inverse(information), np.linalg.inv(information), rtol=1e-3
    )
    along, across = np.array([0.6, 0.8]), np.array([-0.8, 0.6])
    # What rounds below zero counts as zero.
    flat = 4.0 * np.outer(along, along) - 1e-3 * np.outer(across, across)
    expected = np.outer(along, along) / 4.0 + np.outer(across, across) / RIDGE
    np.testing.assert_allclose(regularized_inverse(flat), expected, rtol=1e-5)


def test_a_parameter_that_is_held_does_not_move_and_the_others_do_as_without_it() -> (
    None
):
    rng = np.random.default_rng(3)
    root = rng.normal(size=(3, 3))
    information = root @ root.T
    covariance = regularized_inverse(information, held=[1])
    assert covariance[1, 1] == pytest.approx(1 / HELD, rel=1e-6)
    others = np.ix_([0, 2], [0, 2])
    np.testing.assert_allclose(
        covariance[others], np.linalg.inv(information[others]), rtol=1e-6
    )


def test_information_that_is_no_number_is_refused_with_what_to_do() -> None:
    with pytest.raises(
        SolveError,
        match=r"^the model's slopes along its states are beyond all numbers, so that no "
        "parameter has a standard error; give parameters bounds, or start them nearer "
        r"to the truth\.$",
    ):
        regularized_inverse(np.array([[1.0, 0.0], [0.0, np.inf]]))

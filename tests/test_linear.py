"""Banded factors and the elimination of the states, against dense linear algebra."""

import casadi as ca
import numpy as np
import pytest
from scipy.sparse import csc_matrix, identity

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import SolveError
from phsi_opt.optimization.banded import Banded
from phsi_opt.optimization.evaluated import Evaluated, SparsePattern
from phsi_opt.transcription.elimination import (
    HELD,
    RIDGE,
    regularized_inverse,
    time_order,
)
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.optimality_system import eliminated


def two_runs(n: int) -> Measurements:
    t = [np.arange(5.0), np.arange(4.0)]
    return Measurements.from_arrays(
        t, [np.zeros((len(s), n)) for s in t], states=[f"x{i}" for i in range(n)]
    )


def constraints(grid: Grid, n: int, p: int, rng: np.random.Generator) -> np.ndarray:
    """A Jacobian that joins the n states of neighbouring nodes, and p parameters."""
    n_x, n_c = grid.n_nodes * n, grid.n_intervals * n
    A = np.zeros((n_c, n_x))
    for i, begin in enumerate(grid.begin):
        A[i * n : i * n + n, begin * n : begin * n + 2 * n] = rng.normal(
            size=(n, 2 * n)
        )
    return np.hstack([rng.normal(size=(n_c, p)), A])


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
    banded = Banded(csc_matrix(matrix), np.argsort(shuffled))
    assert (banded.kl, banded.ku) == (3, 3)
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
        banded = Banded(csc_matrix(one), np.arange(n), is_symmetric)
        expected = np.linalg.solve(one, right)
        np.testing.assert_allclose(banded.solve(right), expected, rtol=1e-8)


@pytest.mark.parametrize(("below", "above"), [(1, 4), (4, 1), (0, 2), (2, 0), (0, 0)])
def test_a_band_need_not_be_as_wide_above_the_diagonal_as_below(
    below: int, above: int
) -> None:
    rng = np.random.default_rng(5)
    n = 20
    matrix = np.triu(np.tril(rng.normal(size=(n, n)), above), -below) + 5 * np.eye(n)
    banded = Banded(csc_matrix(matrix), np.arange(n))
    assert (banded.kl, banded.ku) == (below, above)
    right = rng.normal(size=n)
    np.testing.assert_allclose(banded.solve(right), np.linalg.solve(matrix, right))
    assert banded.log_abs_det == pytest.approx(np.linalg.slogdet(matrix)[1])


def test_a_singular_system_is_refused() -> None:
    with pytest.raises(
        SolveError,
        match="singular: a state may neither be measured nor act on one that is",
    ):
        Banded(csc_matrix(np.array([[1.0, 1.0], [1.0, 1.0]])), np.arange(2))


def test_states_are_eliminated_as_by_dense_algebra() -> None:
    grid, n, p = grid_of(two_runs(2)), 2, 3
    rng = np.random.default_rng(1)
    n_x, n_c = grid.n_nodes * n, grid.n_intervals * n
    J = constraints(grid, n, p, rng)
    root = np.hstack([rng.normal(size=(n_x, p)), np.diag(rng.uniform(0.5, 2.0, n_x))])
    H = root.T @ root
    reduced = eliminated(grid, n, csc_matrix(H), csc_matrix(J), p)
    kkt = np.block([[H, J.T], [J, np.zeros((n_c, n_c))]])
    inverse = np.linalg.inv(kkt)
    covariance = inverse[:p, :p]
    np.testing.assert_allclose(
        np.linalg.inv(reduced.information), covariance, rtol=1e-7
    )
    e = rng.normal(size=n_c)
    response = reduced.respond(e, covariance)
    whole = inverse @ np.r_[np.zeros(p + n_x), e]
    np.testing.assert_allclose(response.joined, whole[: p + n_x], rtol=1e-7, atol=1e-9)
    starts = grid.first[:, None] * n + np.arange(n)
    following, left = (
        reduced.following,
        reduced.start_covariances(starts, grid.trajectory),
    )
    variances = np.einsum(
        "aij,jk,aik->ai", following, covariance, following
    ) + np.einsum("aii->ai", left)
    np.testing.assert_allclose(
        variances.ravel(), np.diag(inverse)[p : p + n_x], rtol=1e-6
    )


def test_unknowns_stand_in_the_order_of_their_time() -> None:
    grid = grid_of(two_runs(1))
    order = time_order(grid, ("node", 1), ("interval", 1))
    # Five nodes with four intervals in between, then four nodes with three.
    assert order[:9].tolist() == [0, 9, 1, 10, 2, 11, 3, 12, 4]
    assert order[9:].tolist() == [5, 13, 6, 14, 7, 15, 8]
    with pytest.raises(SolveError):
        Banded(0 * identity(2, format="csc"), np.arange(2))


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


def test_multipliers_are_what_the_objective_gains_per_offset() -> None:
    grid, n, p = grid_of(two_runs(2)), 2, 3
    rng = np.random.default_rng(4)
    n_x, n_c = grid.n_nodes * n, grid.n_intervals * n
    J = constraints(grid, n, p, rng)
    H = np.diag(rng.uniform(0.5, 2.0, p + n_x))
    H[:p, p] = H[p, :p] = 0.1
    reduced = eliminated(grid, n, csc_matrix(H), csc_matrix(J), p)
    covariance = np.linalg.inv(reduced.information)
    gradient = rng.normal(size=p + n_x)
    kkt = np.block([[H, J.T], [J, np.zeros((n_c, n_c))]])
    whole = np.linalg.solve(kkt, np.r_[gradient, np.zeros(n_c)])
    found = reduced.multipliers(gradient[p:], covariance, gradient[:p])
    np.testing.assert_allclose(found, whole[p + n_x :], rtol=1e-7, atol=1e-10)
    without = np.linalg.solve(kkt, np.r_[np.zeros(p), gradient[p:], np.zeros(n_c)])
    np.testing.assert_allclose(
        reduced.multipliers(gradient[p:], covariance),
        without[p + n_x :],
        rtol=1e-7,
        atol=1e-10,
    )
    # Several right-hand sides are solved side by side.
    e = rng.normal(size=(n_c, 2))
    both = reduced.respond(e, covariance).joined
    for k in range(2):
        np.testing.assert_allclose(
            both[:, k], reduced.respond(e[:, k], covariance).joined
        )


def test_entries_in_casadis_order_make_scipys_matrix_and_are_copied() -> None:
    z = ca.SX.sym("z", 3)
    sparse = ca.jacobian(ca.vertcat(z[0] * z[2], z[1] ** 2), z)
    dense = ca.densify(sparse)
    for matrix in (sparse, dense):
        function = ca.Function("slopes", [z], [matrix])
        evaluated = Evaluated(function)
        pattern = SparsePattern(function.sparsity_out(0))
        point = np.array([2.0, 3.0, 5.0])
        found = pattern.matrix(evaluated(point)[0])
        evaluated(2 * point)  # writes over the entries
        np.testing.assert_array_equal(found.toarray(), np.array(function(point)))

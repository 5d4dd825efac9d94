"""Banded factors and the elimination of the states, against dense linear algebra."""

import numpy as np
import pytest
from scipy.sparse import csc_matrix, identity

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import SolveError
from phsi_opt.optimization.banded import Banded
from phsi_opt.transcription.elimination import ReducedSystem, time_order
from phsi_opt.transcription.grid import grid_of


def two_runs(n: int) -> Measurements:
    t = [np.arange(5.0), np.arange(4.0)]
    return Measurements.from_arrays(
        t, [np.zeros((len(s), n)) for s in t], states=[f"x{i}" for i in range(n)]
    )


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
    A = np.zeros((n_c, n_x))
    for i, begin in enumerate(grid.begin):
        A[i * n : i * n + n, begin * n : begin * n + 2 * n] = rng.normal(
            size=(n, 2 * n)
        )
    J = np.hstack([rng.normal(size=(n_c, p)), A])
    root = np.hstack([rng.normal(size=(n_x, p)), np.diag(rng.uniform(0.5, 2.0, n_x))])
    H = root.T @ root
    reduced = ReducedSystem(
        grid, n, csc_matrix(H), csc_matrix(J), slice(0, p), slice(p, p + n_x)
    )
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

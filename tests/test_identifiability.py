"""Directions that the data leave open: those that are, and none by chance."""

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.estimation.uncertainty import silent_directions
from phsi_opt.optimization.bounded_step import regularized_inverse

NAMES = [f"c{i}" for i in range(30)]


def test_terms_without_significance_are_not_called_a_common_factor() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        root = rng.normal(size=(60, 30)) * 10 ** rng.uniform(-1, 2, 30)
        covariance = regularized_inverse(root.T @ root)
        # Estimates of coefficients that are zero: all within their errors.
        theta = rng.multivariate_normal(np.zeros(30), covariance)
        silent = silent_directions(NAMES, theta, covariance)
        assert silent.sentences == ()
        assert silent.parameters == ()


def test_a_factor_that_leaves_no_trace_is_found_among_well_known_parameters() -> None:
    rng = np.random.default_rng(1)
    theta = np.array([3.0, 2.0, 0.5, 1.0, -4.0])
    together = np.array(
        [3.0, 2.0, 0.5, 0.0, 0.0]
    )  # the first three may be multiplied by one number
    away = np.eye(5) - np.outer(together, together) / (together @ together)
    root = rng.normal(size=(50, 5)) @ away
    covariance = regularized_inverse(root.T @ root)
    silent = silent_directions(NAMES[:5], theta, covariance)
    assert silent.parameters == (0, 1, 2)
    text = "c0, c1, c2 apart: a common factor of all leaves no trace"
    assert text in silent.sentences[0]


def test_a_product_and_a_ratio_are_told_apart() -> None:
    rng = np.random.default_rng(2)
    theta = np.array([3.0, 2.0])
    for along, text in (
        ([3.0, 2.0], "only c0/c1 is identifiable"),
        ([3.0, -2.0], "only c0*c1 is identifiable"),
    ):
        direction = np.array(along) / np.linalg.norm(along)
        root = rng.normal(size=(50, 2)) @ (np.eye(2) - np.outer(direction, direction))
        covariance = regularized_inverse(root.T @ root)
        assert text in silent_directions(NAMES[:2], theta, covariance).sentences[0]


def test_a_parameter_without_a_trace_is_named_alone() -> None:
    root = np.diag([1.0, 0.0, 2.0])
    covariance = regularized_inverse(root.T @ root)
    silent = silent_directions(NAMES[:3], np.ones(3), covariance)
    assert silent.parameters == (1,)
    assert silent.sentences == (
        "the data say nothing about c1: fix it to a known value or remove it",
    )


def test_two_open_directions_are_named_apart_however_their_eigenvectors_are_mixed() -> (
    None
):
    rng = np.random.default_rng(4)
    sums = np.zeros((6, 2))
    sums[:3, 0] = [1.0, -2.0, 1.0]
    sums[3:5, 1] = [1.0, 1.0]
    orthonormal, _ = np.linalg.qr(sums)
    root = rng.normal(size=(50, 6)) @ (np.eye(6) - orthonormal @ orthonormal.T)
    covariance = regularized_inverse(root.T @ root)
    theta = np.array([1.0, 0.7, 2.0, 3.0, 0.2, 5.0])
    silent = silent_directions(NAMES[:6], theta, covariance)
    assert silent.parameters == (0, 1, 2, 3, 4)
    told = sorted(sentence.partition(":")[0] for sentence in silent.sentences)
    assert told == [
        "the data cannot tell c0, c1, c2 apart",
        "the data cannot tell c3, c4 apart",
    ]


def test_information_that_is_not_finite_is_a_solve_error() -> None:
    information = np.array([[1.0, np.nan], [np.nan, 1.0]])
    with pytest.raises(ph.SolveError, match="beyond all numbers"):
        regularized_inverse(information)

"""Directions that the data leave open: those that are, and none by chance."""

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.estimation.uncertainty import SilentDirections, silent_directions
from phsi_opt.optimization.bounded_step import regularized_inverse

NAMES = [f"c{i}" for i in range(30)]


def silent_along(theta: np.ndarray, *open_directions: list[float]) -> SilentDirections:
    """What is found where a design of fifty rows is blind along some directions."""
    n = len(theta)
    orthonormal, _ = np.linalg.qr(np.array(open_directions).T)
    root = np.random.default_rng(1).normal(size=(50, n))
    root = root @ (np.eye(n) - orthonormal @ orthonormal.T)
    return silent_directions(NAMES[:n], theta, regularized_inverse(root.T @ root))


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


@pytest.mark.parametrize(
    ("theta", "direction", "members", "said"),
    [
        (
            [3.0, 2.0, 0.5, 1.0, -4.0],
            [3.0, 2.0, 0.5, 0.0, 0.0],  # the first three times one number
            (0, 1, 2),
            "c0, c1, c2 apart: a common factor of all leaves no trace",
        ),
        ([3.0, 2.0], [3.0, 2.0], (0, 1), "only c0/c1 is identifiable"),
        ([3.0, 2.0], [3.0, -2.0], (0, 1), "only c0*c1 is identifiable"),
        (
            [1.0, 1.0, 1.0],
            [0.0, 1.0, 0.0],
            (1,),
            "the data say nothing about c1: fix it to a known value or remove it",
        ),
    ],
)
def test_an_open_direction_is_named_by_its_members(
    theta: list[float], direction: list[float], members: tuple[int, ...], said: str
) -> None:
    silent = silent_along(np.array(theta), direction)
    assert silent.parameters == members
    (sentence,) = silent.sentences
    assert said in sentence


def test_two_open_directions_are_named_apart_however_their_eigenvectors_are_mixed() -> (
    None
):
    theta = np.array([1.0, 0.7, 2.0, 3.0, 0.2, 5.0])
    first, second = [1.0, -2.0, 1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, 1.0, 0.0]
    silent = silent_along(theta, first, second)
    assert silent.parameters == (0, 1, 2, 3, 4)
    assert sorted(sentence.partition(":")[0] for sentence in silent.sentences) == [
        "the data cannot tell c0, c1, c2 apart",
        "the data cannot tell c3, c4 apart",
    ]


def test_information_that_is_not_finite_is_a_solve_error() -> None:
    information = np.array([[1.0, np.nan], [np.nan, 1.0]])
    with pytest.raises(ph.SolveError, match="beyond all numbers"):
        regularized_inverse(information)

"""Functions of numbers at many places: what CasADi itself finds, place by place."""

import casadi as ca
import numpy as np
import pytest

from phsi_opt.model.expressions import evaluate
from phsi_opt.optimization.column_function import (
    AT_ONCE,
    in_numbers,
    in_rows,
)

FORMULAS = (
    "sin(a)*cos(b) - tan(a/4)",
    "atan(a) + exp(-b) + log(1 + b**2)",
    "sqrt(abs(a)) * tanh(b)",
    "sign(a) + min(a, b) - max(a, b)",
    "a**2 + 2*a + b**3 - b**0.5 + (a**2)**b",
    "(a**4 + 0.1)**(-0.25) / b",
)


def function_of(formulas: tuple[str, ...]) -> ca.Function:
    """Values of the formulas, and their slopes in a and b."""
    a, b = ca.SX.sym("a", 2), ca.SX.sym("b")
    values = []
    for text in formulas:
        for i in range(2):
            values.append(evaluate(text, {"a": a[i], "b": b}))
    column = ca.vertcat(*values)
    slopes = ca.jacobian(column, ca.vertcat(a, b))
    return ca.Function("values", [a, b], [column, slopes])


def by_casadi(function: ca.Function, a: np.ndarray, b: np.ndarray) -> list[np.ndarray]:
    """Entries of the results, a column per place."""
    columns: list[list[list[float]]] = [[] for _ in range(function.n_out())]
    for place in range(a.shape[1]):
        for found, one in zip(columns, function(a[:, place], b[:, place]), strict=True):
            found.append(one.nonzeros())
    return [np.array(found).T for found in columns]


@pytest.mark.parametrize("n", [1, 7, AT_ONCE, AT_ONCE + 7])
def test_it_finds_what_casadi_finds(n: int) -> None:
    rng = np.random.default_rng(0)
    function = function_of(FORMULAS)
    a, b = rng.uniform(-2, 2, (2, n)), rng.uniform(0.5, 2, (1, n))
    found = in_numbers(function, a, b)
    for own, expected in zip(found, by_casadi(function, a, b), strict=True):
        np.testing.assert_allclose(own, expected, rtol=1e-12, atol=1e-14)


def test_results_that_follow_no_argument_stand_at_every_place() -> None:
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    function = ca.Function("constant", [a, b], [ca.vertcat(2.0, b, 3 * b, a)])
    (found,) = in_numbers(function, np.arange(3.0)[None], np.array([5.0]))
    np.testing.assert_array_equal(found, [[2] * 3, [5] * 3, [15] * 3, [0, 1, 2]])


def test_a_place_without_a_number_has_none_and_leaves_the_others() -> None:
    function = function_of(("log(a) + 1/b",))
    a = np.array([[1.0, -1.0, 2.0], [1.0, 1.0, 1.0]])
    values, _ = in_numbers(function, a, np.array([[1.0, 1.0, 0.0]]))
    assert np.isfinite(values[0]).tolist() == [True, False, False]
    assert values[1, 0] == 1.0


def test_rows_of_a_table_have_the_results_of_each_column() -> None:
    a, theta = ca.SX.sym("a", 2), ca.SX.sym("theta")
    results = [ca.vertcat(a[0] * theta, ca.exp(a[1]), theta), ca.SX.zeros(2)]
    function = ca.Function("values", [a, theta], results)
    table = np.random.default_rng(0).normal(size=(5, 2))
    found, zeros = (one.full() for one in in_rows(function, 5)(table, 3.0))
    expected = np.column_stack((3 * table[:, 0], np.exp(table[:, 1]), np.full(5, 3.0)))
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    assert zeros.shape == (5, 2) and not np.any(zeros)

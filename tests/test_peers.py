"""Other methods on the same data: SINDy and LASSO."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

pytest.importorskip("pysindy", reason="needs the extra 'peers'")
import phsi_opt as ph
from problems.peers.sindy import lasso, regressions, sindy
from problems.thesis.systems import SYSTEMS

HENON = SYSTEMS["henon_heiles"]
SHORT = replace(HENON, n_trajectories=50, n_steps=20, step=0.02)
TRUTH = SHORT.truth_first_order
each_optimizer = pytest.mark.parametrize("optimizer", ["stlsq", "sr3"])


# ---- SINDy and LASSO


@cache
def henon_heiles(noise: float = 0.0) -> ph.Measurements:
    return SHORT.data(seed=1, noise=noise)


@each_optimizer
def test_clean_data_give_the_support_and_the_coefficients(optimizer: str) -> None:
    found = sindy(SHORT.first_order(), henon_heiles(), optimizer, 0.2)
    assert set(found.removed) == set(SHORT.first_order().entries) - set(TRUTH)
    # (h omega)^2/12 with h = 0.02 and omega of about 1 is 3e-5 in the midpoint, (h
    # omega)^2/6 to /3 in the differences.
    assert found.values == pytest.approx(TRUTH, rel=5e-4)


@each_optimizer
def test_without_threshold_and_ridge_it_is_plain_least_squares(optimizer: str) -> None:
    model, data = SHORT.first_order(), henon_heiles(noise=0.01)
    found = sindy(model, data, optimizer, threshold=0.0, ridge=0.0)
    loss = 0.0
    for problem in regressions(model, data):
        expected, squares, *_ = np.linalg.lstsq(problem.columns, problem.rates)
        ours = [found.values[name] for name in problem.names]
        # Two solvers of the same squares: rounding times a condition number of 100.
        np.testing.assert_allclose(ours, expected, rtol=1e-9, atol=1e-11)
        loss += squares[0] / len(problem.rates)
    assert found.loss_value == pytest.approx(loss, rel=1e-9)


def test_the_columns_are_the_terms_at_the_middle_of_each_interval() -> None:
    terms = ph.polynomials(["x", "t"], 2) + ph.formula("b*u + 3*x", b=ph.Parameter())
    model = ph.FirstOrder(["x"], {"x": terms}, ["u"])
    t, x, u = np.array([0.0, 1.0, 3.0]), [1.0, 3.0, 2.0], [0.0, 4.0, 2.0]
    for hold, inputs in (("linear", [2.0, 3.0]), ("zero", [0.0, 4.0])):
        # Two intervals are too few for six terms, so the record is given three times.
        data = ph.Measurements.from_arrays(
            [t] * 3, [x] * 3, [u] * 3, states=["x"], inputs=["u"], hold=hold
        )
        (problem,) = regressions(model, data)
        columns = dict(zip(problem.names, problem.columns[:2].T, strict=True))
        np.testing.assert_allclose(columns["F_x[x*t]"], [2.0 * 0.5, 2.5 * 2.0])
        np.testing.assert_allclose(columns["b"], inputs)
        known = np.array([3 * 2.0, 3 * 2.5])  # of 3*x, which is taken off
        np.testing.assert_allclose(problem.rates[:2], np.array([2.0, -0.5]) - known)


@pytest.mark.parametrize("weight", [0.3, 3.0, 30.0])
def test_the_lasso_satisfies_its_optimality_conditions(weight: float) -> None:
    """2 Theta'(Theta xi - dx) is -weight sign(xi), and at most weight where xi is 0."""
    model, data = SHORT.first_order(), henon_heiles(noise=0.005)
    found = lasso(model, data, weight)
    zeros = 0
    for problem in regressions(model, data):
        xi = np.array([found.values.get(name, 0.0) for name in problem.names])
        slope = 2 * problem.columns.T @ (problem.columns @ xi - problem.rates)
        expected = -weight * np.sign(xi[xi != 0])
        # A coefficient set to zero moves the slope by 1e-6 of it.
        np.testing.assert_allclose(slope[xi != 0], expected, rtol=1e-4)
        assert np.all(np.abs(slope[xi == 0]) <= weight * (1 + 1e-4))
        zeros += int(np.sum(xi == 0))
    assert zeros == len(found.removed) > 0

"""SINDy and LASSO: recovery, agreement with least squares, optimality, refusals."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

pytest.importorskip("pysindy", reason="needs the extra 'peers'")
import phsi_opt as ph
from phsi_opt.baselines.result import Baseline
from problems.peers.sindy import lasso, regressions, sindy
from problems.thesis.systems import SYSTEMS

HENON_HEILES = replace(
    SYSTEMS["henon_heiles"], n_trajectories=50, n_steps=20, step=0.02
)
TRUTH = HENON_HEILES.truth_first_order


@cache
def henon_heiles(noise: float = 0.0) -> ph.Measurements:
    return HENON_HEILES.data(seed=1, noise=noise)


def relative_error(found: Baseline) -> float:
    return max(
        abs(found.values[name] - true) / abs(true) for name, true in TRUTH.items()
    )


@pytest.mark.parametrize("optimizer", ["stlsq", "sr3"])
def test_clean_data_give_the_support_and_the_coefficients(optimizer) -> None:
    found = sindy(HENON_HEILES.first_order(), henon_heiles(), optimizer, 0.2)
    assert set(found.values) == set(TRUTH)
    # (h omega)^2/12 with h = 0.02 and omega of about 1 is 3e-5 in the midpoint, (h
    # omega)^2/6 to /3 in the differences
    assert relative_error(found) < 5e-4
    assert set(found.removed) == set(HENON_HEILES.first_order().entries) - set(TRUTH)


@pytest.mark.parametrize("optimizer", ["stlsq", "sr3"])
def test_without_threshold_and_ridge_it_is_plain_least_squares(optimizer) -> None:
    model, data = HENON_HEILES.first_order(), henon_heiles(noise=0.01)
    found = sindy(model, data, optimizer, threshold=0.0, ridge=0.0)
    loss = 0.0
    for problem in regressions(model, data):
        expected, squares, *_ = np.linalg.lstsq(problem.columns, problem.rates)
        # two solvers of the same well-conditioned squares: rounding times the condition
        # number (about 1e2)
        np.testing.assert_allclose(
            [found.values[n] for n in problem.names], expected, rtol=1e-9, atol=1e-11
        )
        loss += squares[0] / len(problem.rates)
    assert found.loss_value == pytest.approx(loss, rel=1e-9)
    assert not found.removed


def test_the_columns_are_the_terms_at_the_middle_of_each_interval() -> None:
    model = ph.FirstOrder(
        ["x"],
        {
            "x": ph.polynomials(["x", "t"], 2)
            + ph.formula("b*u + 3*x", b=ph.Parameter())
        },
        ["u"],
    )
    t, x, u = (
        np.array([0.0, 1.0, 3.0]),
        np.array([1.0, 3.0, 2.0])[:, None],
        np.array([0.0, 4.0, 2.0])[:, None],
    )
    for hold, inputs in (("linear", [2.0, 3.0]), ("zero", [0.0, 4.0])):
        # Two intervals are too few for six terms, so the record is given three times.
        data = ph.Measurements.from_arrays(
            [t] * 3, [x] * 3, [u] * 3, states=["x"], inputs=["u"], hold=hold
        )
        (problem,) = regressions(model, data)
        columns = dict(zip(problem.names, problem.columns[:2].T, strict=True))
        np.testing.assert_allclose(columns["F_x[x*t]"], [2.0 * 0.5, 2.5 * 2.0])
        np.testing.assert_allclose(columns["b"], inputs)
        np.testing.assert_allclose(
            problem.rates[:2], [2.0 - 3 * 2.0, -0.5 - 3 * 2.5]
        )  # the known term is taken off


@pytest.mark.parametrize("weight", [0.3, 3.0, 30.0])
def test_the_lasso_satisfies_its_optimality_conditions(weight: float) -> None:
    """2 Theta'(Theta xi - dx) = -weight sign(xi) where xi is not zero, and at most
    weight where it is.
    """
    model, data = HENON_HEILES.first_order(), henon_heiles(noise=0.005)
    found = lasso(model, data, weight)
    zeros = 0
    for problem in regressions(model, data):
        xi = np.array([found.values.get(name, 0.0) for name in problem.names])
        slope = 2 * problem.columns.T @ (problem.columns @ xi - problem.rates)
        # the interior point stops at 1e-13 of the objective; a coefficient set to zero
        # moves the slope by 1e-6 of it
        np.testing.assert_allclose(
            slope[xi != 0], -weight * np.sign(xi[xi != 0]), rtol=1e-4
        )
        assert np.all(np.abs(slope[xi == 0]) <= weight * (1 + 1e-4))
        zeros += int(np.sum(xi == 0))
    assert zeros == len(found.removed) > 0

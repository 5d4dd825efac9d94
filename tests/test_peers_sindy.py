"""SINDy and LASSO: recovery, agreement with least squares, optimality, refusals."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pysindy", reason="needs the extra 'peers'")
import phsi_opt as ph
from phsi_opt.baselines.result import Baseline
from phsi_opt.model.terms import Dictionary
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
def test_clean_data_give_the_support_and_the_coefficients(
    optimizer: str,
) -> None:
    found = sindy(HENON_HEILES.first_order(), henon_heiles(), optimizer, 0.2)
    assert set(found.values) == set(TRUTH)
    # (h omega)^2/12 with h = 0.02 and omega of about 1 is 3e-5 in the midpoint, (h
    # omega)^2/6 to /3 in the differences
    assert relative_error(found) < 5e-4
    assert set(found.removed) == set(HENON_HEILES.first_order().entries) - set(TRUTH)


def test_the_lasso_finds_the_support_and_shrinks_the_coefficients() -> None:
    data = henon_heiles()
    found = lasso(HENON_HEILES.first_order(), data, weight=2.0)
    assert set(found.values) == set(TRUTH)
    assert all(abs(found.values[name]) < abs(true) for name, true in TRUTH.items())


@pytest.mark.parametrize("optimizer", ["stlsq", "sr3"])
def test_without_threshold_and_ridge_it_is_plain_least_squares(
    optimizer: str,
) -> None:
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


def test_the_result_simulates_and_says_what_was_removed() -> None:
    found = sindy(HENON_HEILES.first_order(), henon_heiles(), threshold=0.2)
    t, truth = HENON_HEILES.tests(1)
    # over 8 time units an error of 1e-4 in a frequency of 1 is 1e-3 of the amplitude
    # (below 1)
    assert np.abs(found.simulate(t, truth[0][0]) - truth[0]).max() < 5e-3
    assert (
        "SINDy (STLSQ)" in str(found)
        and "removed: F_q1[q1]" in str(found)
        and "threshold 0.2" in found.settings
    )
    assert len(found.equations()) == 4 and "p1" in found.equations()[0]


def test_an_equation_may_lose_all_its_terms_but_not_every_equation() -> None:
    t = np.linspace(0, 1, 50)
    data = ph.Measurements.from_arrays(
        [t], [np.column_stack([np.full(50, 2.0), np.exp(t)])], states=["a", "b"]
    )
    model = ph.FirstOrder(
        ["a", "b"], {"a": ph.polynomials(["a"], 1), "b": ph.polynomials(["b"], 1)}
    )
    for found in (sindy(model, data), lasso(model, data, 1e-3)):
        assert found.removed == ("F_a[a]",)
        assert found.values["F_b[b]"] == pytest.approx(1.0, rel=1e-3)
    with pytest.raises(ph.ModelError, match=r"removes every term \(threshold 9"):
        sindy(model, data, threshold=9.0)
    with pytest.raises(ph.ModelError, match="LASSO removes every term"):
        lasso(model, data, 1e6)


def one_state(force: Dictionary, **more: Any) -> ph.FirstOrder:
    return ph.FirstOrder(["x"], {"x": force}, **more)


def decay(x: Any = None, t: Any = None, states: Any = ("x",)) -> ph.Measurements:
    t = np.linspace(0, 1, 30) if t is None else t
    column = (np.exp(-t) if x is None else x)[:, None]
    return ph.Measurements.from_arrays(
        [t], [np.tile(column, len(states))], states=states
    )


LINEAR = one_state(ph.polynomials(["x"], 1))


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (ph.PseudoHamiltonian(states=["x"], S=[[0]], H=ph.formula("x**2")), "needs a FirstOrder model, not Pseudo"),
        (one_state(ph.trigonometric("t")), r"'F_x.omega_t' does not enter linearly.*fixed=\{'F_x.omega_t': 1.0\}"),
        (one_state(ph.formula("exp(-k*x)", k=ph.Parameter())), "'k' does not enter linearly"),
        (one_state(ph.polynomials(["x"], 2), R=ph.damping("x")), r"'R_x' has bounds \[0, inf\]"),
        (LINEAR.frozen(), "no free coefficient"),
        (
            ph.FirstOrder(
                ["x", "y"], dict.fromkeys("xy", ph.formula("a*x", a=ph.Parameter()))
            ),
            "'a' stands in the equations of x and y",
        ),
    ],
)  # fmt: skip
def test_a_model_that_is_no_linear_regression_is_refused(
    model: Any, message: str
) -> None:
    for method in (sindy, lambda m, d: lasso(m, d, 1.0)):
        with pytest.raises(ph.ModelError, match=message):
            method(model, decay(states=model.states))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"optimizer": "stlq"}, "optimizer='stlq'.*Did you mean 'stlsq'"),
        ({"threshold": -0.1}, "threshold=-0.1 .* number of at least 0"),
        ({"ridge": np.nan}, "ridge=nan .* expected"),
        ({"relaxation": 0.0, "optimizer": "sr3"}, "relaxation=0.0 .* a number above 0"),
        (
            {"fixed": {"F_x[y]": 1.0}},
            r"fixed names 'F_x\[y\]', which is not in the model",
        ),
    ],
)
def test_a_bad_setting_is_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ph.ModelError, match=message):
        sindy(LINEAR, decay(), **settings)


def test_a_negative_weight_of_the_lasso_is_refused() -> None:
    with pytest.raises(ph.ModelError, match=r"weight=-1 .* number of at least 0"):
        lasso(LINEAR, decay(), -1)


def test_data_that_cannot_be_regressed_are_refused() -> None:
    x = np.exp(-np.linspace(0, 1, 30))
    with pytest.raises(ph.DataError, match=r"x at t\[7\]=0.241379 is missing"):
        sindy(LINEAR, decay(np.where(np.arange(30) == 7, np.nan, x)))
    with pytest.raises(ph.DataError, match="5 terms but the data give 3 rates"):
        sindy(one_state(ph.polynomials(["x"], 5)), decay(t=np.linspace(0, 1, 4)))
    with pytest.raises(ph.DataError, match="not finite over the data"):
        sindy(one_state(ph.formula("a*log(x - 0.5)", a=ph.Parameter())), decay())


def test_sr3_that_does_not_converge_says_so() -> None:
    with pytest.raises(
        ph.SolveError,
        match=r"dq1/dt: SR3 did not converge after 1 iterations. Allow more",
    ):
        sindy(
            HENON_HEILES.first_order(),
            henon_heiles(0.01),
            "sr3",
            max_iterations=1,
            relaxation=1e-3,
        )

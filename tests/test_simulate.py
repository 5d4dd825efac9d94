"""`simulate` against closed forms, for free motion and for both ways of holding an
input; and what it refuses.
"""

import gc
from typing import Any

import numpy as np
import pytest

from phsi_opt.errors import DataError, SolveError
from phsi_opt.model.model import FirstOrder, PseudoHamiltonian
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.structure import canonical
from phsi_opt.model.terms import damping, formula
from phsi_opt.simulation import simulate as simulating
from phsi_opt.simulation.simulate import simulate

K, M, D = 40.0, 2.5, 0.8
# Local errors of 1e-8 (RTOL), gathered over some hundred steps.
RTOL = 2e-6


def spring() -> PseudoHamiltonian:
    model = PseudoHamiltonian(
        states=("q", "p"),
        S=canonical(1),
        H=formula("k*q**2/2 + p**2/(2*m)", k=Parameter(K), m=M),
        R=damping("p"),
    )
    return model.with_values({"R_p": D})


def lag(rate: float = 2.0) -> FirstOrder:
    return FirstOrder(states=["x"], inputs=["u"], F={"x": formula("a*(u - x)", a=rate)})


@pytest.mark.parametrize("method", ["LSODA", "DOP853", "Radau"])
def test_a_damped_oscillation_is_that_of_the_closed_form(method: str) -> None:
    t = np.linspace(0.5, 8.5, 201)
    decay, omega = D / (2 * M), np.sqrt(K / M - (D / (2 * M)) ** 2)
    s = t - 0.5
    q = np.exp(-decay * s) * (np.cos(omega * s) + decay / omega * np.sin(omega * s))
    v = -np.exp(-decay * s) * (K / M) / omega * np.sin(omega * s)
    found = simulate(spring(), t, [1.0, 0.0], method=method)
    np.testing.assert_allclose(
        found, np.column_stack([q, M * v]), atol=10 * RTOL
    )  # momenta reach 10
    np.testing.assert_array_equal(found[0], [1.0, 0.0])


def test_a_held_input_follows_the_exponentials_between_the_samples() -> None:
    rng = np.random.default_rng(0)
    t, u = np.cumsum(rng.uniform(0.1, 0.5, 30)), rng.normal(size=(30, 1))
    u[10:14] = u[9]  # stretches of equal input are joined
    expected = [0.3]
    for h, value in zip(np.diff(t), u[:-1, 0], strict=True):
        expected.append(value + (expected[-1] - value) * np.exp(-2 * h))
    np.testing.assert_allclose(
        simulate(lag(), t, [0.3], u, hold="zero")[:, 0], expected, atol=RTOL
    )


def test_a_linear_input_follows_the_ramp_response_between_the_samples() -> None:
    rng = np.random.default_rng(1)
    t, u = np.cumsum(rng.uniform(0.1, 0.5, 30)), rng.normal(size=30)
    expected = [0.3]
    for h, u0, slope in zip(np.diff(t), u[:-1], np.diff(u) / np.diff(t), strict=True):
        particular = u0 - slope / 2  # x = u - slope / a solves the equation with a = 2
        expected.append(
            particular + slope * h + (expected[-1] - particular) * np.exp(-2 * h)
        )
    np.testing.assert_allclose(simulate(lag(), t, [0.3], u)[:, 0], expected, atol=RTOL)


def test_an_input_may_be_a_function_of_the_time() -> None:
    t = np.linspace(0.0, 5.0, 51)
    # x' = 2 (sin t - x): x = (4 sin t - 2 cos t)/5 + c exp(-2 t).
    expected = (4 * np.sin(t) - 2 * np.cos(t)) / 5 + 0.4 * np.exp(-2 * t)
    np.testing.assert_allclose(
        simulate(lag(), t, [0.0], np.sin)[:, 0], expected, atol=RTOL
    )


def test_a_short_pulse_is_not_stepped_over() -> None:
    t = np.linspace(0.0, 20.0, 401)
    u = np.zeros(401)
    u[300] = 1.0
    for hold, area in (("linear", 0.05), ("zero", 0.05)):
        # A pulse of that area moves an integrator by it.
        model = FirstOrder(states=["x"], inputs=["u"], F={"x": formula("u")})
        assert simulate(model, t, [0.0], u, hold=hold)[-1, 0] == pytest.approx(
            area, abs=RTOL
        )


def test_the_right_hand_side_outlives_the_memory_it_was_made_in() -> None:
    # CasADi's buffers are bare pointers; this crashed the interpreter once the arrays
    # behind them were freed.
    t = np.linspace(0.0, 1.0, 11)
    first = simulate(spring(), t, [1.0, 0.0])
    for _ in range(2):
        gc.collect()
        waste = [np.full(n % 7 + 1, np.nan) for n in range(200)]
        np.testing.assert_array_equal(simulate(spring(), t, [1.0, 0.0]), first)
        del waste


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"t": [0.0]}, "at least two finite, strictly increasing times"),
        ({"t": [0.0, 0.0]}, "strictly increasing"),
        ({"t": [0.0, np.nan]}, "finite"),
        ({"x0": [1.0]}, r"must be 2 finite numbers, one per state \(q, p\)"),
        ({"x0": [1.0, np.nan]}, "must be 2 finite numbers"),
        (
            {"u": np.zeros((3, 1))},
            r"u has shape \(3, 1\); expected finite numbers of shape \(2, 0\)",
        ),
    ],
)
def test_arguments_of_the_wrong_shape_are_refused(
    arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        simulate(spring(), **({"t": [0.0, 1.0], "x0": [1.0, 0.0]} | arguments))


@pytest.mark.parametrize(
    ("u", "hold", "message"),
    [
        (None, "linear", r"the model has inputs \(u\); give u of shape \(2, 1\)"),
        ([np.nan, 0.0], "linear", "expected finite numbers"),
        ([1.0, 0.0], "spline", "hold='spline' is unknown"),
        (lambda t: [1.0, 2.0], "linear", "gave 2 numbers; expected 1"),
    ],
)
def test_inputs_that_do_not_fit_are_refused(u: Any, hold: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        simulate(lag(), [0.0, 1.0], [0.0], u, hold=hold)


def test_a_solution_that_escapes_to_infinity_is_refused_where_it_ends() -> None:
    model = FirstOrder(states=["x"], F={"x": formula("x**2")})
    with pytest.raises(SolveError, match="cannot be continued beyond t="):
        simulate(model, np.linspace(0.0, 2.0, 21), [1.0])


@pytest.mark.parametrize("method", ["LSODA", "RK45"])
def test_a_solution_that_ends_before_the_first_sample_is_refused(method: str) -> None:
    model = FirstOrder(states=["x"], F={"x": formula("x**3")})
    with pytest.raises(SolveError, match="cannot be continued beyond t="):
        simulate(model, [0.0, 1.0, 2.0], [10.0], method=method)


def test_a_model_that_is_far_too_fast_for_its_samples_is_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(simulating, "ALWAYS_ALLOWED", 10_000)
    monkeypatch.setattr(simulating, "MOST_PER_SAMPLE", 10)
    t = np.linspace(0, 10, 21)
    calm = simulate(spring(), t, [1.0, 0.0])
    assert np.all(np.isfinite(calm))
    with pytest.raises(SolveError, match="far faster than the samples"):
        simulate(spring().with_values({"k": 1e12}), t, [1.0, 0.0])

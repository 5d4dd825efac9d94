"""Runs by SciPy against closed forms, fast free runs against those of SciPy, for
smooth, kinked, stiff, irregular and broken off motion; and what both refuse.
"""

import gc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.model.catalogue import effect_named
from phsi_opt.simulation import simulate as simulating
from phsi_opt.simulation.simulate import (
    Runs,
    SampledInputs,
    free_run,
    rates,
)
from tests.systems import pair

K, M, D = 40.0, 2.5, 0.8
# Local errors of 1e-8, gathered over some hundred steps.
RTOL = 2e-6
# of the spread: what two integrations at tolerances of 1e-9 and 1e-8 per step may
# differ by
CLOSE = 1e-5


def spring(H: Any = None, F: str = "u") -> ph.PseudoHamiltonian:
    energy = H or "k*q**2/2 + p**2/(2*m)"
    return pair(energy, "d", F or None, k=ph.Parameter(K), m=M, d=D)


def first_order(*inputs: str, **rates: str) -> ph.FirstOrder:
    F = {name: ph.formula(text) for name, text in rates.items()}
    return ph.FirstOrder(states=list(rates), inputs=list(inputs), F=F)


LAG = first_order("u", x="2*(u - x)")


# ---- closed forms


@pytest.mark.parametrize("method", ["LSODA", "DOP853", "Radau", "free run"])
def test_a_damped_oscillation_is_that_of_the_closed_form(method: str) -> None:
    t = np.linspace(0.5, 8.5, 201)
    decay, omega = D / (2 * M), np.sqrt(K / M - (D / (2 * M)) ** 2)
    s = t - 0.5
    q = np.exp(-decay * s) * (np.cos(omega * s) + decay / omega * np.sin(omega * s))
    p = -M * np.exp(-decay * s) * (K / M) / omega * np.sin(omega * s)
    if method == "free run":
        x = free_run(spring(F=""), t, [1.0, 0.0])
    else:
        x = ph.simulate(spring(F=""), t, [1.0, 0.0], method=method)
    np.testing.assert_allclose(x, np.column_stack([q, p]), atol=10 * RTOL)  # p is 10
    np.testing.assert_array_equal(x[0], [1.0, 0.0])


def test_inputs_between_samples_are_held_or_linear_or_functions_of_the_time() -> None:
    rng = np.random.default_rng(0)
    t, u = np.cumsum(rng.uniform(0.1, 0.5, 30)), rng.normal(size=30)
    u[10:14] = u[9]  # stretches of equal input are joined
    held, ramps = [0.3], [0.3]
    for h, u0, slope in zip(np.diff(t), u[:-1], np.diff(u) / np.diff(t), strict=True):
        held.append(u0 + (held[-1] - u0) * np.exp(-2 * h))
        particular = u0 - slope / 2  # x = u - slope / a solves the equation with a = 2
        left = (ramps[-1] - particular) * np.exp(-2 * h)
        ramps.append(particular + slope * h + left)
    for expected, hold in ((held, "zero"), (ramps, "linear")):
        x = ph.simulate(LAG, t, [0.3], u, hold=hold)[:, 0]
        np.testing.assert_allclose(x, expected, atol=RTOL)
    # x' = 2 (sin t - x): x = (4 sin t - 2 cos t)/5 + c exp(-2 t).
    t = np.linspace(0.0, 5.0, 51)
    expected = (4 * np.sin(t) - 2 * np.cos(t)) / 5 + 0.4 * np.exp(-2 * t)
    x = ph.simulate(LAG, t, [0.0], np.sin)[:, 0]
    np.testing.assert_allclose(x, expected, atol=RTOL)


@pytest.mark.parametrize("hold", ["linear", "zero"])
def test_a_short_pulse_is_not_stepped_over(hold: str) -> None:
    t = np.linspace(0.0, 20.0, 401)
    u = np.zeros(401)
    u[300] = 1.0
    end = ph.simulate(first_order("u", x="u"), t, [0.0], u, hold=hold)[-1, 0]
    assert end == pytest.approx(0.05, abs=RTOL)  # its area moves an integrator


def test_the_right_hand_side_outlives_the_memory_it_was_made_in() -> None:
    # CasADi's buffers are bare pointers; this crashed the interpreter once the arrays
    # behind them were freed.
    t = np.linspace(0.0, 1.0, 11)
    first = ph.simulate(spring(F=""), t, [1.0, 0.0])
    for _ in range(2):
        gc.collect()
        waste = [np.full(n % 7 + 1, np.nan) for n in range(200)]
        np.testing.assert_array_equal(ph.simulate(spring(F=""), t, [1.0, 0.0]), first)
        del waste


# ---- refusals


@pytest.mark.parametrize("run", [ph.simulate, free_run])
@pytest.mark.parametrize(("arguments", "message"), [
    ({"t": [0.0]}, "at least two finite, strictly increasing times"),
    ({"t": [0.0, 0.0]}, "strictly increasing"),
    ({"t": [0.0, np.nan]}, "finite"),
    ({"x0": [1.0]}, r"must be 2 finite numbers, one per state \(q, p\)"),
    ({"x0": [1.0, np.nan]}, "must be 2 finite numbers"),
    ({"u": np.zeros((3, 1))}, r"u has shape \(3, 1\); expected finite numbers of"),
    ({"u": [np.nan, 0.0]}, r"expected finite numbers of shape \(2, 1\)"),
    ({"u": None}, r"the model has inputs \(u\); give u of shape \(2, 1\)"),
    ({"u": lambda t: [1.0, 2.0]}, "returned 2 numbers; expected 1, one for each of u"),
    ({"u": lambda: 1.0}, r"the function u\(t\) failed: TypeError"),
    ({"u": lambda t: "a"}, r"u\(t\)='a' must be an array of real numbers"),
    ({"hold": "spline"}, "hold='spline' is unknown"),
])  # fmt: skip
def test_arguments_that_do_not_fit_are_refused(run, arguments, message) -> None:
    given: dict[str, Any] = {"t": [0.0, 1.0], "x0": [1.0, 0.0], "u": np.zeros((2, 1))}
    with pytest.raises(ph.DataError, match=message):
        run(spring(), **(given | arguments))


def test_a_force_of_another_length_is_refused() -> None:
    with pytest.raises(ph.DataError, match=r"force\(t, x\) returned 1 numbers"):
        ph.simulate(spring(F=""), [0.0, 1.0], [1.0, 0.0], force=lambda t, x: x[:1])


@pytest.mark.parametrize(("rate", "run"), [
    ("x**2", ph.simulate),
    ("x**2", free_run),
    ("10*x**3", ph.simulate),  # before the first sample
])  # fmt: skip
def test_a_solution_that_escapes_to_infinity_is_refused_where_it_ends(
    rate: str, run: Callable[..., np.ndarray]
) -> None:
    with pytest.raises(ph.SolveError, match="cannot be continued beyond t="):
        run(first_order(x=rate), np.linspace(0.0, 2.0, 21), [1.0])


def test_a_model_that_is_far_too_fast_for_its_samples_is_given_up(monkeypatch) -> None:
    monkeypatch.setattr(simulating, "ALWAYS_ALLOWED", 10_000)
    monkeypatch.setattr(simulating, "MOST_PER_SAMPLE", 10)
    t = np.linspace(0, 10, 21)
    assert np.all(np.isfinite(ph.simulate(spring(F=""), t, [1.0, 0.0])))
    with pytest.raises(
        ph.SolveError, match="much faster than the time between samples"
    ):
        ph.simulate(spring(F="").with_values({"k": 1e12}), t, [1.0, 0.0])


# ---- the fast free run


def rubbing() -> ph.Model:
    model = spring().add(effect_named(spring(), "coulomb friction", "p"))
    turnover = next(name for name in model.entries if name.endswith("v0"))
    return model.with_values({"coulomb_friction_p": 2.0, turnover: 0.02})


DUFFING = spring(ph.formula("q**2/2 + q**4/4 + p**2/2"))
GAP = spring(ph.formula("40*(abs(q) - 0.3 + abs(abs(q) - 0.3))**2/8 + p**2/5"))
TANKS = first_order("u", a="30*u - 20*sqrt(abs(a))", b="20*sqrt(abs(a)) - 2*sqrt(b)")
RUSHING = first_order("u", a="300*(u - a)", b="a - b")  # a third of a hundredth, and 1


def regular(step: float) -> np.ndarray:
    return np.arange(300) * step


def irregular() -> np.ndarray:
    gaps = np.random.default_rng(0).uniform(0.01, 0.2, 300)
    gaps[[50, 200]] = 4.0
    return np.cumsum(gaps)


def without_scipy(*_: object, **__: object) -> np.ndarray:
    raise AssertionError("the run was left to SciPy")


@pytest.mark.parametrize(("model", "t", "hold"), [
    pytest.param(spring(), regular(0.05), "linear", id="mass-spring"),
    pytest.param(DUFFING, irregular(), "linear", id="Duffing, irregular times"),
    pytest.param(DUFFING, regular(0.1), "zero", id="zero-order hold"),
    pytest.param(rubbing(), regular(0.05), "linear", id="Coulomb friction"),
    pytest.param(GAP, regular(0.05), "linear", id="gap"),
    pytest.param(TANKS, regular(0.05), "zero", id="tanks"),
    pytest.param(RUSHING, regular(0.1), "zero", id="stiff"),
])  # fmt: skip
def test_the_free_run_is_that_of_scipy_without_its_help(
    model: ph.Model, t: np.ndarray, hold: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    u = 1.0 + 0.5 * np.cos(1.3 * t)[:, None]
    x0 = np.array([1.0, 0.2])
    expected = ph.simulate(model, t, x0, u, hold=hold)
    monkeypatch.setattr(simulating, "simulate", without_scipy)
    x, again = (free_run(model, t, x0, u, hold) for _ in range(2))
    error = np.abs(x - expected) / np.std(expected, axis=0)
    np.testing.assert_array_less(error, CLOSE)
    np.testing.assert_array_equal(x[0], x0)
    np.testing.assert_array_equal(x, again)


def test_what_explicit_steps_cannot_do_is_left_to_scipy() -> None:
    model = first_order("u", a="1e6*(u - a)")
    t = np.linspace(0.0, 2.0, 41)
    u = np.sin(t)[:, None]
    inputs = SampledInputs.of(model, t, u, np.array(["linear"]))
    runs = Runs(rates(model.rhs(), model.theta))
    assert runs.run(inputs, np.zeros(1)) is None
    expected = ph.simulate(model, t, [0.0], u)
    np.testing.assert_array_equal(free_run(model, t, [0.0], u), expected)

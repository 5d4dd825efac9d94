"""The fast free run against SciPy and closed forms, for smooth, kinked, stiff,
irregular and broken off motion.
"""

import casadi as ca
import numpy as np
import pytest

import phsi_opt.simulation.simulate as module
from phsi_opt.errors import DataError, SolveError
from phsi_opt.model.catalogue import effect_named
from phsi_opt.model.model import FirstOrder, Model, PseudoHamiltonian
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.structure import canonical
from phsi_opt.model.terms import Dictionary, formula
from phsi_opt.simulation import simulate as stepping
from phsi_opt.simulation.simulate import Runs, free_run, rates, simulate

# of the spread: what two integrations at tolerances of 1e-6 and 1e-8 per step may
# differ by
CLOSE = 1e-5


def spring(H: Dictionary | None = None, F: str = "u") -> PseudoHamiltonian:
    energy = formula("k*q**2/2 + p**2/(2*m)", k=40.0, m=2.5) if H is None else H
    force = {"p": formula(F)} if F else {}
    return PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"] if F else [],
        S=canonical(1),
        H=energy,
        R={"p": formula("d", d=0.3)},
        F=force,
    )


def duffing() -> PseudoHamiltonian:
    return spring(formula("q**2/2 + q**4/4 + p**2/2"))


def rubbing() -> Model:
    model = spring().add(effect_named(spring(), "coulomb friction", "p"))
    turnover = next(name for name in model.entries if name.endswith("v0"))
    return model.with_values({"coulomb_friction_p": 2.0, turnover: 0.02})


def gap() -> PseudoHamiltonian:
    return spring(formula("40*(abs(q) - 0.3 + abs(abs(q) - 0.3))**2/8 + p**2/5"))


def tanks(pipe: float = 20.0) -> FirstOrder:
    flow = formula("30*u - c*sqrt(abs(a))", c=pipe)
    return FirstOrder(
        states=["a", "b"],
        inputs=["u"],
        F={"a": flow, "b": formula("20*sqrt(abs(a)) - 2*sqrt(abs(b))")},
    )


def rushing() -> FirstOrder:
    """A time constant of a third of a hundredth beside one of a second."""
    return FirstOrder(
        states=["a", "b"],
        inputs=["u"],
        F={"a": formula("300*(u - a)"), "b": formula("a - b")},
    )


def regular(step: float) -> np.ndarray:
    return np.arange(300) * step


def irregular() -> np.ndarray:
    gaps = np.random.default_rng(0).uniform(0.01, 0.2, 300)
    gaps[[50, 200]] = 4.0
    return np.cumsum(gaps)


def without_scipy(*_: object, **__: object) -> np.ndarray:
    raise AssertionError("the run was left to SciPy")


@pytest.mark.parametrize(
    ("model", "t", "hold"),
    [
        pytest.param(spring(), regular(0.05), "linear", id="mass-spring"),
        pytest.param(duffing(), regular(0.1), "linear", id="Duffing"),
        pytest.param(duffing(), irregular(), "linear", id="irregular times"),
        pytest.param(duffing(), regular(0.1), "zero", id="zero-order hold"),
        pytest.param(rubbing(), regular(0.05), "linear", id="Coulomb friction"),
        pytest.param(gap(), regular(0.05), "linear", id="gap"),
        pytest.param(tanks(), regular(0.05), "zero", id="tanks"),
        pytest.param(rushing(), regular(0.1), "zero", id="stiff"),
    ],
)
def test_the_free_run_is_that_of_scipy_without_its_help(
    model: Model, t: np.ndarray, hold: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    u = 1.0 + 0.5 * np.cos(1.3 * t)[:, None]
    x0 = np.array([1.0, 0.2])
    expected = simulate(model, t, x0, u, hold=hold)
    monkeypatch.setattr(module, "simulate", without_scipy)
    found = free_run(model, t, x0, u, hold)
    np.testing.assert_array_less(
        np.abs(found - expected) / np.std(expected, axis=0), CLOSE
    )
    np.testing.assert_array_equal(found[0], x0)


def test_a_damped_oscillation_is_that_of_the_closed_form() -> None:
    t = np.linspace(0.5, 30.5, 601)
    decay = 0.3 / (2 * 2.5)
    omega, s = np.sqrt(40.0 / 2.5 - decay**2), t - 0.5
    q = np.exp(-decay * s) * (np.cos(omega * s) + decay / omega * np.sin(omega * s))
    found = free_run(spring(F=""), t, [1.0, 0.0])
    np.testing.assert_allclose(found[:, 0], q, atol=module.TOLERANCE * np.std(q))


def test_a_run_from_rest_stays_there() -> None:
    np.testing.assert_array_equal(
        free_run(spring(F=""), regular(0.05), [0.0, 0.0]), 0.0
    )


def test_half_the_steps_are_tried_until_nothing_changes_beyond_the_tolerance() -> None:
    t, x0, u = regular(0.1), np.array([1.0, 0.0]), np.zeros((300, 1))
    runs = Runs(rates(duffing()))
    exact, rough = (
        runs.run(t, x0, u, np.array(["linear"]), tolerance)
        for tolerance in (1e-9, 1e-3)
    )
    assert exact is not None and rough is not None
    error = np.max(np.abs(rough - exact) / np.std(exact, axis=0))
    assert 1e-8 < error < 1e-3


def test_what_explicit_steps_cannot_do_is_left_to_scipy() -> None:
    model = FirstOrder(states=["a"], inputs=["u"], F={"a": formula("1e6*(u - a)")})
    t = np.linspace(0.0, 2.0, 41)
    u = np.sin(t)[:, None]
    assert Runs(rates(model)).run(t, np.zeros(1), u, np.array(["linear"])) is None
    np.testing.assert_array_equal(
        free_run(model, t, [0.0], u), simulate(model, t, [0.0], u)
    )


def test_a_run_that_escapes_to_infinity_is_refused_where_it_ends() -> None:
    model = FirstOrder(states=["x"], F={"x": formula("x**2")})
    with pytest.raises(SolveError, match="cannot be continued beyond t="):
        free_run(model, np.linspace(0.0, 2.0, 41), [1.0])


def test_two_runs_are_the_same_to_the_last_digit() -> None:
    t = regular(0.05)
    first, second = (
        free_run(rubbing(), t, [1.0, 0.0], np.cos(t)[:, None]) for _ in range(2)
    )
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"t": [0.0, 0.0]}, "strictly increasing"),
        ({"x0": [1.0]}, "must be 2 finite numbers"),
        ({"u": np.zeros((3, 1))}, r"u has shape \(3, 1\)"),
        ({"u": None}, "the model has inputs"),
        ({"hold": "spline"}, "hold='spline' is unknown"),
    ],
)
def test_arguments_of_the_wrong_shape_are_refused(
    arguments: dict[str, object], message: str
) -> None:
    given: dict[str, object] = {
        "t": [0.0, 1.0],
        "x0": [1.0, 0.0],
        "u": np.zeros((2, 1)),
        "hold": "linear",
    }
    with pytest.raises(DataError, match=message):
        free_run(duffing(), **(given | arguments))  # type: ignore[arg-type]


def test_the_loop_is_built_once_for_all_records_of_a_model(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    built = []
    step = stepping._step

    def noted(rhs: ca.Function) -> ca.Function:
        built.append(rhs)
        return step(rhs)

    monkeypatch.setattr(stepping, "_step", noted)
    t = np.linspace(0, 2, 41)
    u = np.sin(t)[:, None]
    model = spring(formula("k*q**2/2 + p**2/5", k=Parameter(40.0)))
    first = free_run(model, t, [1.0, 0.0], u)
    other = free_run(model.with_values({"k": 40.0}), t[:21], [0.5, 0.0], u[:21])
    assert len(built) == 1
    softer = free_run(model.with_values({"k": 30.0}), t, [1.0, 0.0], u)
    assert len(built) == 2
    again = free_run(model, t, [1.0, 0.0], u)
    assert len(built) == 2
    np.testing.assert_array_equal(again, first)
    exact = simulate(model, t, [1.0, 0.0], u)
    np.testing.assert_allclose(first, exact, atol=CLOSE)
    assert np.max(np.abs(softer - first)) > 0.1
    assert len(other) == 21

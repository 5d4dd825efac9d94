"""Models from SymPy move as SymPy's own equations say, and keep its names."""

from typing import Any

import numpy as np
import pytest
import sympy as sp
from sympy.physics.mechanics import (
    KanesMethod,
    LagrangesMethod,
    Particle,
    Point,
    ReferenceFrame,
    dynamicsymbols,
)

import phsi_opt as ph

m, M, a, g, c, k, d = sp.symbols("m M l g c k d")
x, q, phi, psi = dynamicsymbols("x q phi psi")
F = dynamicsymbols("F")
t = dynamicsymbols._t
N = ReferenceFrame("N")
VALUES = {m: 0.7, M: 1.9, a: 0.4, g: 9.81, c: 0.3, k: 11.0, d: 0.2}


def pulled(speed: Any, force: Any) -> tuple[Point, Any]:
    """A point that moves along the first axis, and the force on it."""
    point = Point("P")
    point.set_vel(N, speed * N.x)
    return point, force * N.x


def cart() -> LagrangesMethod:
    """A pendulum on a cart with a spring, a damper and a force."""
    vx = x.diff() + a * phi.diff() * sp.cos(phi)
    vy = a * phi.diff() * sp.sin(phi)
    kinetic = M * x.diff() ** 2 / 2 + m * (vx**2 + vy**2) / 2
    L = kinetic + m * g * a * sp.cos(phi) - k * x**2 / 2
    forces = [pulled(x.diff(), F - c * x.diff() - d * x.diff() * sp.Abs(x.diff()))]
    return LagrangesMethod(L, [x, phi], forcelist=forces, frame=N)


def double_pendulum() -> LagrangesMethod:
    x1, y1 = a * sp.sin(phi), -a * sp.cos(phi)
    x2, y2 = x1 + k * sp.sin(psi), y1 - k * sp.cos(psi)
    first = M * (x1.diff(t) ** 2 + y1.diff(t) ** 2) / 2 - M * g * y1
    second = m * (x2.diff(t) ** 2 + y2.diff(t) ** 2) / 2 - m * g * y2
    joint = N.orientnew("A", "Axis", [phi, N.z])
    friction = [(joint, -c * phi.diff() * N.z)]
    return LagrangesMethod(first + second, [phi, psi], forcelist=friction, frame=N)


def spring() -> LagrangesMethod:
    """A damped spring whose force is part of the Lagrangian."""
    L = m * x.diff() ** 2 / 2 - k * x**2 / 2 + F * x
    return LagrangesMethod(L, [x], forcelist=[pulled(x.diff(), -c * x.diff())], frame=N)


def in_a_field() -> LagrangesMethod:
    """A charge in a magnetic field: the Lagrangian is linear in a velocity too."""
    kinetic = m * (x.diff() ** 2 + q.diff() ** 2) / 2
    field = c * (x * q.diff() - q * x.diff()) / 2
    return LagrangesMethod(kinetic + field, [x, q])


def rates(model: ph.Model, states: Any, inputs: Any) -> np.ndarray:
    values = {str(name): value for name, value in VALUES.items()}
    theta = [values[name] for name in model.free]
    found: np.ndarray = np.array(model.rhs()(states, inputs, 0.0, theta))
    return found.ravel()


@pytest.mark.parametrize("make", [cart, double_pendulum, spring, in_a_field])
def test_the_energy_of_a_lagrangian_moves_as_lagranges_equations(make: Any) -> None:
    method = make()
    model = ph.from_sympy(method)
    assert isinstance(model, ph.PseudoHamiltonian)
    method.form_lagranges_equations()
    speeds = list(method.q.diff(t))
    accelerations = dict(
        zip(method.q.diff(t, 2), method.rhs()[len(speeds) :], strict=True)
    )
    momenta = sp.Matrix([method._L[0].diff(v) for v in speeds])
    moved = momenta.diff(t).subs(accelerations)
    arguments = [*method.q, *speeds, F]
    expected = sp.lambdify(arguments, [momenta.subs(VALUES), moved.subs(VALUES)])
    random = np.random.default_rng(0)
    for _ in range(5):
        n = len(speeds)
        coordinates, velocity = random.normal(size=(2, n))
        force = random.normal(size=len(model.inputs))
        p, dp = expected(*coordinates, *velocity, *(force if len(force) else [0.0]))
        at = np.concatenate([coordinates, np.ravel(p)])
        found = rates(model, at, force)
        # Rounding of sums of some ten terms.
        np.testing.assert_allclose(found[:n], velocity, rtol=1e-11)
        np.testing.assert_allclose(found[n:], np.ravel(dp), rtol=1e-10, atol=1e-11)


def test_names_are_kept_and_each_term_stands_where_it_belongs() -> None:
    model = ph.from_sympy(cart(), g=9.81, k=ph.Parameter(10.0, lower=0, unit="N/m"))
    assert model.states == ("x", "phi", "p_x", "p_phi") and model.inputs == ("F",)
    printed = str(model)
    assert "R_p_x = c + d*abs(dH_dp_x)" in printed and "F_p_x = F" in printed
    assert "k*x**2/2 - g*l*m*cos(phi)" in printed
    table = {name: one.parameter for name, one in model.entries.items()}
    assert set(table) == {"M", "m", "l", "g", "k", "c", "d"}
    assert table["g"] == ph.Parameter(9.81, fixed=True)
    assert table["k"] == ph.Parameter(10.0, lower=0, unit="N/m")


def test_kanes_equations_are_rates_of_coordinates_and_speeds() -> None:
    u = dynamicsymbols("u1")
    point = Point("O")
    point.set_vel(N, u * N.x)
    loads = [(point, (F - k * x - c * u) * N.x)]
    method = KanesMethod(N, q_ind=[x], u_ind=[u], kd_eqs=[x.diff() - u])
    with pytest.raises(ph.ModelError, match="call its method kanes_equations"):
        ph.from_sympy(method)
    method.kanes_equations([Particle("body", point, m)], loads)
    model = ph.from_sympy(method)
    assert isinstance(model, ph.FirstOrder)
    assert (model.states, model.inputs) == (("x", "u1"), ("F",))
    expected = (1.5 - 11.0 * 0.3 - 0.3 * -0.8) / 0.7
    np.testing.assert_allclose(rates(model, [0.3, -0.8], [1.5]), [-0.8, expected])


def test_any_right_hand_side_is_taken_with_symbols_functions_or_a_mapping() -> None:
    h, u = sp.symbols("h u")
    tank = ph.from_sympy([u - c * sp.sqrt(h)], states=[h])
    assert (tank.states, tank.inputs, tank.free) == (("h",), ("u",), ("c",))
    same = ph.from_sympy({h: sp.E * h / sp.exp(1) + F - h - c * sp.sqrt(h)})
    assert same.inputs == ("F",)
    for model in (tank, same):
        assert rates(model, [4.0], [1.0]) == pytest.approx([1.0 - 0.3 * 2.0])
    assert ph.from_sympy([-k * x], ["x"], inputs=["k"]).inputs == ("k",)
    wave = ph.from_sympy(sp.Matrix([sp.sin(t)]), states=[x])
    assert np.array(wave.rhs()(0.0, [], 0.5, [])) == pytest.approx(np.sin(0.5))


def test_a_model_from_sympy_is_identified_from_its_motion() -> None:
    truth = ph.from_sympy(spring(), m=0.7, c=0.3, k=11.0)
    times = np.linspace(0, 6, 121)
    force = 5 * np.sin(times**2 / 2)
    motion = ph.simulate(truth, times, [0.2, 0.0], force[:, None])
    noisy = motion[:, :1] + 0.002 * np.random.default_rng(1).normal(size=(121, 1))
    data = ph.Measurements.from_arrays(
        times, noisy, states=["x"], u=force[:, None], inputs=["F"]
    )
    stiffness = ph.Parameter(5.0, lower=0)
    model = ph.from_sympy(spring(), m=ph.Parameter(1.0, lower=0), k=stiffness)
    fit = ph.identify(model, data)
    for name, value in {"m": 0.7, "c": 0.3, "k": 11.0}.items():
        assert abs(fit.values[name] - value) < 4 * fit.std_errors[name] < 0.1 * value


relativistic = LagrangesMethod(-m * sp.sqrt(1 - x.diff() ** 2), [x])
constrained = LagrangesMethod(x.diff() ** 2 / 2, [x, q], hol_coneqs=[x - q])
belt = sp.Symbol("v")
on_a_belt = LagrangesMethod(m * x.diff() ** 2 / 2 - belt * x, [x])
momentum = LagrangesMethod(m * x.diff() ** 2 / 2 - sp.Symbol("p") * x, [x])
swept = LagrangesMethod(m * x.diff() ** 2 / 2 - dynamicsymbols("v") * x, [x])
massless = LagrangesMethod(m * x.diff() ** 2 / 2 - k * q**2, [x, q])


@pytest.mark.parametrize(("arguments", "message"), [
    (([sp.asin(x)], [x]), "function 'asin' in formula 'asin\\(x\\)' is not known"),
    (([sp.Function("f")(x)], [x]), "f\\(x\\(t\\)\\) in dx/dt is an unknown function"),
    (([F], [x], []), "F\\(t\\) in dx/dt is an unknown function"),
    (([sp.Piecewise((x, x > 0), (0, True))], [x]), "function 'Piecewise'"),
    (([x.diff()], [x]), "Derivative\\(x\\(t\\), t\\) in dx/dt is no state"),
    (([x], [x.diff()]), "Derivative\\(x\\(t\\), t\\) is no symbol"),
    (([sp.I * x], [x]), "I in dx/dt is not a finite real number"),
    (([sp.Symbol("lambda") * x], [x]), "'lambda' cannot be used in a formula"),
    ((["__import__('os')"], [x]), "is no right-hand side; expected an expression of"),
    (([x, x], [x]), "expected a LagrangesMethod, a KanesMethod, or one right-hand"),
    ((3,), "system=3 with states=None; expected a LagrangesMethod"),
    ((spring(), [x]), "a LagrangesMethod has its own"),
    ((relativistic,), "is not quadratic in the velocities"),
    ((constrained,), "has a constraint on .*; choose independent coordinates"),
    ((on_a_belt,), "symbol v in the Lagrangian has the name of a function of time"),
    ((momentum,), "symbol p in the Lagrangian has the name of a function of time"),
    (([sp.Symbol("q"), x], [x, q]), "symbol q in dx/dt has the name of a function"),
    (([F - x, sp.Symbol("F")], [x, q]), "symbol F in dq/dt has the name of a function"),
    ((swept,), "the name 'v' is used 2 times"),
    ((massless,), "is singular: not every one of the coordinates x, q"),
])  # fmt: skip
def test_what_formulas_cannot_hold_is_refused_by_name(
    arguments: Any, message: str
) -> None:
    with pytest.raises(ph.ModelError, match=message):
        ph.from_sympy(*arguments)


def test_a_parameter_that_is_in_no_formula_is_refused() -> None:
    with pytest.raises(ph.ModelError, match="'stiffness' is in none of the formulas"):
        ph.from_sympy(spring(), stiffness=3.0)

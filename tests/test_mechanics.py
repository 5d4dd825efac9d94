"""m a = F as a pseudo-Hamiltonian model: the motion is that of the forces, and each term
stands where its physics belongs.
"""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import phsi_opt as ph
from phsi_opt.model.expressions import NUMPY, evaluate

TIMES = np.linspace(0, 0.5, 11)  # short of the time when x**3 grows without limit


def motion(
    coordinates: list[str], masses: list[float], forces: list[str], values: Any, x0: Any
) -> np.ndarray:
    """m a = F by SciPy: positions and momenta at the times."""
    n = len(coordinates)
    velocities = [f"v_{name}" for name in coordinates] if n > 1 else ["v"]

    def rate(t: float, state: np.ndarray) -> np.ndarray:
        known = dict(zip([*coordinates, *velocities], state, strict=True))
        known |= {**values, "t": t, "u": np.sin(3 * t)}
        a = [evaluate(text, known, NUMPY) for text in forces]
        return np.concatenate([state[n:], np.array(a) / masses])

    solved = solve_ivp(
        rate, (0, 0.5), x0, t_eval=TIMES, rtol=1e-10, atol=1e-12, method="DOP853"
    )
    assert solved.success
    x: np.ndarray = solved.y.T
    return x * np.array([1.0] * n + masses)


def assert_moves_alike(
    coordinates: list[str], masses: list[float], forces: list[str], values: Any
) -> ph.PseudoHamiltonian:
    model = ph.mechanical(coordinates, masses, forces, inputs=["u"], **values)
    n = len(coordinates)
    x0 = np.linspace(0.3, 0.7, 2 * n)
    expected = motion(coordinates, masses, forces, values, x0)
    start = x0 * np.array([1.0] * n + masses)
    found = ph.simulate(model, TIMES, start, lambda t: np.array([np.sin(3 * t)]))
    # The simulation's own tolerance is 1e-8.
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
    return model


number = st.floats(-1, 1).map(lambda value: round(value, 2))
TERMS = (
    *("{}*x", "{}*x**2", "{}*x**3", "{}", "{}*sin(x)", "{}*x*abs(x)", "{}*cos(2*x)"),
    *("{}*v", "{}*v*abs(v)", "{}*x*v", "{}*x**2*v", "{}*tanh(v)", "{}*(x - u)"),
    *("{}*u", "{}*u*x", "{}*t", "{}*sin(2*t)*v", "{}*exp(-x**2)", "{}*(x + 1)*(v + u)"),
)


def some_of(bodies: tuple[str, ...]) -> Any:
    return st.lists(st.tuples(st.sampled_from(bodies), number), min_size=1, max_size=4)


def force_of(terms: list[tuple[str, float]]) -> str:
    return " + ".join(body.format(f"({value})") for body, value in terms)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(some_of(TERMS))
def test_one_mass_moves_as_its_forces_say(terms: Any) -> None:
    assert_moves_alike(["x"], [1.7], [force_of(terms)], {})


COUPLED = (
    "{}*(x - y)",
    "{}*(v_x - v_y)",
    "{}*x*y",
    "{}*y",
    "{}*u",
    "{}*sin(x - y)",
    "{}*v_x",
)


@settings(max_examples=8, deadline=None, derandomize=True)
@given(some_of(COUPLED), some_of(COUPLED))
def test_two_masses_move_as_their_forces_say(first: Any, second: Any) -> None:
    laws = [force_of(first), force_of(second)]
    assert_moves_alike(["x", "y"], [1.7, 0.6], laws, {})


def rows(*arguments: Any, **parameters: Any) -> dict[str, str]:
    """What the model prints: each place and its terms."""
    text = str(ph.mechanical(*arguments, **parameters))
    pairs = [line.split(" = ") for line in text.splitlines() if " = " in line]
    return {place: terms for place, terms in pairs if not place.endswith("/dt")}


def test_every_term_stands_where_its_physics_belongs() -> None:
    assert rows(["x"], "m", "-k*(x - u) - c*v - d*v*abs(v) - f*tanh(v/v0)") == {
        "H": "p**2/(2*m) + k*x**2/2",
        "R_p": "c + d*abs(dH_dp)",
        "F_p": "-f*tanh(dH_dp/v0) + k*u",
    }
    assert rows(["q"], "m*l**2", "-m*g*l*sin(q) + c*v") == {
        "H": "p**2/(2*(m*l**2)) - g*l*m*cos(q)",
        "F_p": "c*dH_dp",  # it drives
    }
    assert rows(["x1", "x2"], ["m1", "m2"], ["-k*(x1 - x2) + u", "k*(x1 - x2)"]) == {
        "H": "p_x1**2/(2*m1) + p_x2**2/(2*m2) + k*(x1 - x2)**2/2",
        "F_p_x1": "u",
    }
    assert rows(["x", "y"], "m", ["-k*x*y**2 - a*y - b*x", "-k*x**2*y + a*x"]) == {
        "H": "p_x**2/(2*m) + p_y**2/(2*m) + b*x**2/2 + k*x**2*y**2/2",
        "F_p_x": "-a*y",  # a rotation has no potential
        "F_p_y": "a*x",
    }


def test_names_are_parameters_and_inputs_as_they_are_given() -> None:
    stiffness = ph.Parameter(50, lower=0, unit="N/m")
    model = ph.mechanical(["x"], 2.5, "-k*x - c*v + b*u", k=stiffness, b=2.0)
    table = {name: entry.parameter for name, entry in model.entries.items()}
    assert table == {
        "m": ph.Parameter(2.5, fixed=True),
        "k": stiffness,
        "c": ph.Parameter(lower=0),
        "b": ph.Parameter(2.0, fixed=True),
    }
    assert (model.states, model.inputs) == (("x", "p"), ("u",))
    constant = ph.mechanical(["x"], "m", "u - c*v", inputs=[])
    assert constant.inputs == () and "u" in constant.free
    assert ph.mechanical(["x"], "m", "a*w", inputs=["w"]).inputs == ("w",)


@pytest.mark.parametrize(("arguments", "message"), [
    (("x", 1, "-k*x"), "coordinates='x' is not possible; expected Sequence"),
    ((["x"], 0, "-k*x"), "mass 'm' is 0; expected a number above zero"),
    ((["x"], ph.Parameter(-1.0), "-k*x"), "mass 'm' is -1"),
    ((["x"], "m*x", "-k*x"), "mass 'm\\*x' depends on 'x'; expected a constant"),
    ((["x"], 1, "-c*v_x"), "'v_x' .* is unknown; velocities are called v."),
    ((["x"], 1, "-c*p"), "'p' .* is unknown; velocities are called v."),
    ((["x", "y"], 1, ["-v", "x"]), "velocities are called v_x, v_y"),
    ((["x", "y"], 1, "-k*x"), "give a list with one for each"),
    ((["x", "v"], 1, ["x", "x*u", "x"]), "give a list with one for each"),
    ((["v"], 1, "-k*v"), "the name 'v' is used 2 times"),
    ((["x"], 1, "-k*("), "cannot be read"),
])  # fmt: skip
def test_what_is_no_mechanics_is_refused(arguments: Any, message: str) -> None:
    with pytest.raises(ph.ModelError, match=message):
        ph.mechanical(*arguments)

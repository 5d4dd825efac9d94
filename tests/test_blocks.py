"""Diagrams of blocks: the model is that of the equations written by hand."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.model.block_kinds import KINDS, example
from phsi_opt.model.expressions import NUMPY, evaluate
from phsi_opt.model.unit_checks import UnitCheck

DRIVE = {
    "u": "voltage: a, ground",
    "R": "resistor: a, b",
    "L": "coil: b, c",
    "K": "motor: c, ground, motor",
    "J1": "inertia: motor",
    "k": "torsion spring: motor, load",
    "d": "torsion damper: motor, load",
    "J2": "inertia: load",
    "b": "torsion damper: load, ground",
    "tau": "torque: load, ground",
}


def at_random_points(model: ph.Model, seed: int = 0) -> Any:
    """Values of the parameters by name, five states, inputs and the rates there."""
    random = np.random.default_rng(seed)
    values = {name: random.uniform(0.5, 2.0) for name in model.entries}
    theta = [values[name] for name in model.free]
    for _ in range(5):
        x = random.normal(size=model.n_states)
        u = random.normal(size=model.n_inputs)
        yield values, x, u, np.array(model.rhs()(x, u, 0.0, theta)).ravel()


def test_a_drive_of_two_masses_is_the_model_that_is_written_by_hand() -> None:
    by_hand = ph.PseudoHamiltonian(
        states=["motor", "load", "p_motor", "p_load", "psi_L"],
        inputs=["u", "tau"],
        S={("motor", "p_motor"): 1, ("load", "p_load"): 1, ("p_motor", "psi_L"): "K"},
        H="p_motor**2/(2*J1) + p_load**2/(2*J2) + psi_L**2/(2*L)"
        " + k*(motor - load)**2/2",
        R={"p_load": "b", "psi_L": "R", "p_motor - p_load": "d"},
        F={"p_load": "tau", "psi_L": "u"},
    )
    model = ph.blocks(DRIVE).model
    assert (model.states, model.inputs) == (by_hand.states, by_hand.inputs)
    assert model.S == by_hand.S and model.R.keys() == by_hand.R.keys()
    assert set(model.free) == set(by_hand.free)
    for values, x, u, rates in at_random_points(model):
        theta = [values[name] for name in by_hand.free]
        expected = np.array(by_hand.rhs()(x, u, 0.0, theta)).ravel()
        np.testing.assert_allclose(rates, expected, rtol=1e-12)
    units = {name: one.parameter.unit for name, one in model.entries.items()}
    assert units["J1"] == "kg m^2" and units["K"] == "V s/rad" and units["R"] == "Ohm"
    assert model.kind["psi_L"] == "electrical" and model.kind["load"] == "mechanical"


def test_masses_springs_and_dampers_are_those_of_mechanical() -> None:
    diagram = {
        "m1": "mass: x1",
        "m2": "mass: x2",
        "k": "spring: x1, x2; k*x + k3*x**3",
        "c": "damper: x1, ground; c*v + e*v*abs(v)",
        "f": "damper: x2, ground; f*tanh(v/0.1)",
        "u": "force: x1, x2",
    }
    model = ph.blocks(diagram).model
    spring = "k*(x1 - x2) + k3*(x1 - x2)**3"
    forces = [
        f"-({spring}) - c*v_x1 - e*v_x1*abs(v_x1) + u",
        f"{spring} - f*tanh(v_x2/0.1) - u",
    ]
    same = ph.mechanical(["x1", "x2"], ["m1", "m2"], forces)
    assert model.states == same.states
    assert "R_p_x1 = c + e*abs(dH_dp_x1)" in str(model)
    for values, x, u, rates in at_random_points(model):
        theta = [values[name] for name in same.free]
        expected = np.array(same.rhs()(x, u, 0.0, theta)).ravel()
        np.testing.assert_allclose(rates, expected, rtol=1e-11)


# A diagram, and the rates of its states by hand.
CASES: dict[str, tuple[dict[str, str], dict[str, str]]] = {
    # A road moves a mass through a spring beside a spring and a damper in series.
    "suspension": (
        {
            "m": "mass: x",
            "k": "spring: x, road",
            "k1": "spring: x, y",
            "c": "damper: y, road",
            "u": "velocity: road, ground",
        },
        {
            "x": "p_x/m",
            "q_u": "u",
            "y": "u + k1*(x - y)/c",
            "p_x": "-k*(x - q_u) - k1*(x - y)",
        },
    ),
    # What is joined rigidly is one storage, also through a gear and a rack.
    "merged": (
        {
            "J1": "inertia: motor",
            "n": "gear: motor, pinion",
            "J2": "inertia: pinion",
            "r": "rack: pinion, x",
            "m": "mass: x",
            "k": "spring: x, ground",
            "d": "torsion damper: pinion, ground",
            "tau": "torque: motor, ground",
        },
        {
            "motor": "p_motor/(J1 + (J2 + m*r**2)/n**2)",
            "p_motor": "tau - k*(r/n)**2*motor"
            " - d/n**2*p_motor/(J1 + (J2 + m*r**2)/n**2)",
        },
    ),
    # Coils in series, capacitors side by side, nodes without a storage.
    "circuit": (
        {
            "u": "voltage: a, ground",
            "L1": "coil: a, b",
            "L2": "coil: b, c",
            "R": "resistor: c, d",
            "G": "resistor: c, ground",
            "C1": "capacitor: d, ground",
            "C2": "capacitor: d, ground",
            "i": "current: d, ground",
        },
        {
            "q_C1": "(G*psi_L1/(L1 + L2) - q_C1/(C1 + C2))/(R + G) + i",
            "psi_L1": "u - G*(R*psi_L1/(L1 + L2) + q_C1/(C1 + C2))/(R + G)",
        },
    ),
    "isolated secondary": (
        {
            "u": "voltage: a, ground",
            "R": "resistor: a, b",
            "n": "transformer: b, ground, c, d",
            "L": "coil: c, d",
        },
        {"psi_L": "u/n - R*psi_L/L/n**2"},
    ),
    "springs in series": (
        {
            "m": "mass: x",
            "k1": "spring: x, y",
            "k2": "spring: y, ground",
            "F": "force: x, ground",
        },
        {"x": "p_x/m", "p_x": "F - k1*k2/(k1 + k2)*x"},
    ),
    "tanks": (
        {
            "C1": "tank: a",
            "C2": "tank: b",
            "R": "pipe: a, b",
            "out": "pipe: b, ground; g*sign(v)*sqrt(abs(v))",
            "I": "fluid inertia: a, b",
            "q": "flow: a, ground",
        },
        {
            "V_a": "q - (V_a/C1 - V_b/C2)/R - psi_I/I",
            "V_b": "(V_a/C1 - V_b/C2)/R + psi_I/I - g*sign(V_b)*sqrt(abs(V_b)/C2)",
            "psi_I": "V_a/C1 - V_b/C2",
        },
    ),
    "press": (
        {
            "p": "pressure: s, ground",
            "R": "pipe: s, c",
            "C": "tank: c",
            "A": "piston: c, ground, x",
            "m": "mass: x",
            "D": "pump: c, ground, w",
            "J": "inertia: w",
        },
        {
            "V_c": "(p - V_c/C)/R - A*p_x/m - D*p_w/J",
            "p_x": "A*V_c/C",
            "p_w": "D*V_c/C",
        },
    ),
    # Two pumps in one circuit turn as a gear does, which a spring holds.
    "hydrostatic drive": (
        {
            "J1": "inertia: motor",
            "D1": "pump: a, b, motor",
            "D2": "pump: a, b, load",
            "J2": "inertia: load",
            "k": "torsion spring: load, ground",
            "tau": "torque: motor, ground",
        },
        {
            "load": "-D1/D2*p_motor/(J1 + J2*(D1/D2)**2)",
            "p_motor": "tau + k*D1/D2*load",
        },
    ),
    "room": (
        {
            "C": "thermal storage: room",
            "R": "thermal resistance: room, out",
            "To": "temperature: out, ground",
            "heater": "heat flow: room, ground",
        },
        {"Q_room": "heater + (To - Q_room/C)/R"},
    ),
    # Three storages with two states: H has a product of both.
    "loop of capacitors": (
        {
            "C1": "capacitor: a, ground",
            "C2": "capacitor: b, ground",
            "C3": "capacitor: a, b",
            "R": "resistor: a, ground",
            "i": "current: b, ground",
        },
        {
            "q_C1": "-((C2 + C3)*q_C1 + C3*q_C2)/(C1*C2 + C1*C3 + C2*C3)/R",
            "q_C2": "i",
        },
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_the_rates_are_those_of_the_equations_by_hand(name: str) -> None:
    diagram, by_hand = CASES[name]
    model = ph.blocks(diagram).model
    assert model.states == tuple(by_hand)
    for values, x, u, rates in at_random_points(model):
        known = dict(zip((*model.states, *model.inputs), (*x, *u), strict=True))
        expected = [evaluate(text, values | known, NUMPY) for text in by_hand.values()]
        # Rounding of some ten operations.
        np.testing.assert_allclose(rates, expected, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("name", CASES)
def test_units_of_parameters_and_sources_fit_together(name: str) -> None:
    model = ph.blocks(CASES[name][0]).model
    of_sources = {"u": "m/s" if name == "suspension" else "V", "i": "A", "q": "m^3/s"}
    of_sources |= {"tau": "N m", "F": "N", "p": "Pa", "To": "K", "heater": "W"}
    units = {name: of_sources[name] for name in model.inputs}
    assert UnitCheck(model, units | {"t": "s"}).contradiction is None
    first = next(iter(model.entries))
    changed = model.with_parameters(
        lambda _, one: replace(one, unit=f"{one.unit} s"), [first]
    )
    is_seen = UnitCheck(changed, units | {"t": "s"}).contradiction is not None
    assert is_seen or "n" in model.entries  # a ratio, which could have any unit


def test_a_decimal_in_a_law_is_no_decimal_elsewhere() -> None:
    diagram = {
        "R": "resistor: a, b; 2.5*v",
        "G": "resistor: b, ground",
        "C": "capacitor: a, ground",
    }
    model = ph.blocks(diagram).model
    assert list(model.R) == ["q_C"]
    for values, x, _, rates in at_random_points(model):
        current = x[0] / values["C"] / (0.4 + values["G"])
        np.testing.assert_allclose(rates, [-current], rtol=1e-12)


def test_names_values_and_bounds_are_kept() -> None:
    stiffness = ph.Parameter(20.0, lower=1.0)
    diagram = ph.blocks(DRIVE, k=stiffness, J1=0.01)
    table = {name: one.parameter for name, one in diagram.model.entries.items()}
    assert table["J1"] == ph.Parameter(0.01, unit="kg m^2", fixed=True)
    assert table["k"] == ph.Parameter(20.0, lower=1.0, unit="N m/rad")
    assert table["b"] == ph.Parameter(lower=0.0, unit="N m s/rad")
    assert table["J2"] == ph.Parameter(1.0, lower=0.0, unit="kg m^2")
    with pytest.raises(ph.ModelError, match="'J3' is in none of the formulas"):
        ph.blocks(DRIVE, J3=1.0)


def test_a_position_that_no_spring_needs_can_be_asked_for() -> None:
    geared = {
        "J1": "inertia: motor",
        "n": "gear: motor, load",
        "J2": "inertia: load",
        "tau": "torque: motor, ground",
    }
    assert ph.blocks(geared).model.states == ("p_motor",)
    assert ph.blocks(geared, ["motor"]).model.states == ("motor", "p_motor")
    with pytest.raises(
        ph.ModelError, match="'load' is no free position; expected one of motor"
    ):
        ph.blocks(geared, ["load"])


def test_every_block_and_node_is_in_the_picture() -> None:
    from matplotlib.figure import Figure

    for diagram in (DRIVE, CASES["isolated secondary"][0], CASES["press"][0]):
        ax = Figure().subplots()
        assert ph.blocks(diagram).plot(ax) is ax
        words = [text.get_text().split("\n")[0] for text in ax.texts]
        nodes = {
            one for row in diagram.values() for one in row.split(": ")[1].split(", ")
        }
        assert sorted(words) == sorted([*diagram, *(nodes - {"ground"})])


def test_each_kind_says_how_it_is_written() -> None:
    for kind in KINDS:
        with pytest.raises(ph.ModelError, match=f"'{example(kind)}'"):
            ph.blocks({"one": f"{kind}: "})


MASS = {"m": "mass: x", "k": "spring: x, ground"}


@pytest.mark.parametrize(("blocks", "message"), [
    ({"m": "mas: x"}, "block 'm': kind 'mas' is unknown.* Did you mean 'mass'"),
    ({"k": "spring: x"}, "a spring has 2 port\\(s\\), .* port 2 is not connected"),
    ({"m": "mass: x, y"}, "a mass has 1 port\\(s\\), .* port 2 is too much"),
    ({"k": "spring: x, x"}, "'spring: x, x' joins 'x' with itself"),
    ({"m": "mass: ground"}, "joins 'ground' with itself"),
    ({"k": "spring: x, 2y"}, "nodes: '2y' cannot be used"),
    ({"v": "damper: x, ground"}, "block 'v': v is a variable in the law of a damper, 'n\\*v'"),
    ({"a": "gear: x, y"}, "a is a variable in the law of a gear"),
    ({"sin": "mass: x"}, "blocks: the name 'sin' is reserved"),
    (MASS | {"c": "damper: x, y"}, "damper 'c' is not connected at 'y'"),
    (MASS | {"R": "resistor: x, ground"}, "node 'x' joins the translation of mass 'm' with the electrical of resistor 'R'"),
    (MASS | {"v": "velocity: x, ground"}, "mass 'm' has no state, as it is joined rigidly to 'v'"),
    ({"u": "voltage: a, ground", "w": "voltage: a, ground", "L": "coil: a, ground"}, "voltage 'w' ties a, ground, which other"),
    ({"i": "current: a, ground", "L": "coil: a, ground"}, "at node 'a', .* current 'i', coil 'L' cannot all be given"),
    ({"u": "voltage: a, ground", "L": "coil: a, b", "K": "motor: b, ground, w", "k": "torsion spring: w, ground"}, "at node 'w', .* a conflict of causality"),
    ({"u": "voltage: a, ground", "R": "resistor: a, ground"}, "no block stores energy"),
    ({}, "no block stores energy"),
    ({"m": "mass: x", "n": "mass: p_x", "k": "spring: x, p_x"}, "the state 'p_x' is used 2 times"),
    ({"u": "voltage: a, ground", "K": "motor: a, ground, w", "k": "torsion spring: w, ground"}, "the ends of torsion spring 'k' follow from 'u'"),
    ({"x": "mass: x", "k": "spring: x, ground"}, "mass 'x' has the name of a state"),
    ({"m": "mass: x", "k": "spring: x, ground; k*v"}, "law='k\\*v' is not possible for a spring; expected a formula in x"),
    ({"m": "mass: x; 3*x", "k": "spring: x, ground"}, "for a mass; expected none"),
    ({"m": "mass: a", "k": "spring: a, ground; a*x"}, "a in its law 'a\\*x' is a state"),
    ({"m": "mass: x", "k": "spring: x, ground; k*exp(x**2)"}, "has no energy that a formula can hold"),
    (MASS | {"c": "damper: x, y; c*v**3", "e": "damper: y, ground"}, "damper 'c' is not linear, and one of its nodes"),
    (MASS | {"C": "thermal storage: a", "R": "thermal resistance: a, ground"}, "thermal resistance 'R' is thermal and spring 'k' is not"),
])  # fmt: skip
def test_what_cannot_be_joined_is_refused_by_name(
    blocks: dict[str, str], message: str
) -> None:
    with pytest.raises(ph.ModelError, match=message):
        ph.blocks(blocks)

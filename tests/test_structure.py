"""Which state is what: read from the structure matrix, kinds and units."""

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.model.kinds import kind_of_unit
from phsi_opt.model.structure import (
    forced_rows,
    kind_of,
    position_of_momentum,
    storage_states,
    with_kinds_of_units,
)
from phsi_opt.model.terms import Dictionary, Term
from tests.systems import spring


def two_tanks() -> ph.PseudoHamiltonian:
    """Two storages, and the flow in a pipe between them that loses energy."""
    return ph.PseudoHamiltonian(
        states=["left", "right", "flow"],
        S=[[0, 0, -1], [0, 0, 1], [1, -1, 0]],
        H="(left**2 + right**2 + flow**2)/2",
        R=ph.damping("flow"),
    )


def first_order() -> ph.FirstOrder:
    return ph.FirstOrder(states=["a", "b"], F={"a": ph.polynomials(["a", "b"], 1)})


def test_canonical_is_the_structure_matrix_of_hamilton() -> None:
    np.testing.assert_array_equal(
        ph.canonical(2), [[0, 0, 1, 0], [0, 0, 0, 1], [-1, 0, 0, 0], [0, -1, 0, 0]]
    )


def motor(kind: Any = None) -> ph.PseudoHamiltonian:
    """The flux of a motor and the momentum of its rotor: a gyrator between the two."""
    return ph.PseudoHamiltonian(
        states=["turn", "flux"],
        S=[[0.0, 2.0], [-2.0, 0.0]],
        H="turn**2/2 + flux**2/2",
        kind=kind or {},
    )


TURNED = ph.PseudoHamiltonian(
    states=["p", "q"], S=-ph.canonical(1), H="q**2/2 + p**2/2"
)
TWO_FIELDS = {"turn": "mechanical", "flux": "electrical"}


@pytest.mark.parametrize(("model", "pairs", "forced"), [
    (spring(1.0), {"p": "q"}, (1,)),  # the rate of a position lacks no force
    (TURNED, {"p": "q"}, (0,)),  # whatever their order
    (two_tanks(), {}, (0, 1, 2)),
    (first_order(), {}, (0, 1)),
    (motor(), {}, (0, 1)),
    (motor("electrical"), {"flux": "turn"}, (0, 1)),  # a capacitor may leak
    (motor("hydraulic"), {"flux": "turn"}, (0, 1)),
    (motor("mechanical"), {"flux": "turn"}, (1,)),  # a position does not
    (motor("thermal"), {}, (0, 1)),
    (motor(TWO_FIELDS), {}, (0, 1)),  # of one kind, or a gyrator
])  # fmt: skip
def test_pairs_and_equations_that_may_lack_a_force(model, pairs, forced) -> None:
    assert position_of_momentum(model) == pairs
    assert forced_rows(model) == forced


@pytest.mark.parametrize("rate", [
    ph.formula("v"),
    ph.formula("3.6*v"),
    ph.formula("c*v", c=3.6),
    ph.formula("v/(2 + 2)"),
    Dictionary((Term("v", ph.Parameter(2.0, fixed=True)),)),
])  # fmt: skip
def test_without_an_energy_a_known_multiple_of_a_velocity_is_kinematics(rate) -> None:
    model = ph.FirstOrder(["x", "v"], {"x": rate, "v": "-x"})
    assert position_of_momentum(model) == {"v": "x"}
    assert forced_rows(model) == (1,)
    heat = replace(model, kind="thermal")
    assert position_of_momentum(heat) == {}


@pytest.mark.parametrize("rate", [
    ph.formula("c*v", c=ph.Parameter(1.0)),
    ph.formula("-v"),
    ph.formula("v**2"),
    ph.formula("v + 1"),
    ph.formula("v + x"),
    ph.formula("v*0"),
    ph.formula("sqrt(v)"),  # of a level: without a value at some of the velocities
    ph.formula("1/(v - 1)"),
    ph.formula("u"),
    ph.formula("x"),
    ph.polynomials("v", 1),
    ph.formula("v") + ph.formula("u"),
])  # fmt: skip
def test_no_other_equation_is(rate: Dictionary) -> None:
    model = ph.FirstOrder(["x", "v"], {"x": rate, "v": "-x"}, inputs=["u"])
    assert position_of_momentum(model) == {}
    lossy = ph.FirstOrder(["x", "v"], {"x": "v", "v": "-x"}, R={"x": "1"})
    assert forced_rows(lossy) == (0, 1)


def test_a_state_of_a_pair_is_mechanical_or_of_the_kind_of_the_other_one() -> None:
    lossless = replace(motor(), S=ph.canonical(1))
    assert kind_of(lossless, "turn") == kind_of(lossless, "flux") == "mechanical"
    told = replace(lossless, kind={"flux": "electrical"})
    assert kind_of(told, "turn") == kind_of(told, "flux") == "electrical"
    assert kind_of(two_tanks(), "left") == ""


@pytest.mark.parametrize(("kind", "storages"), [
    ({}, ("left", "right", "flow")),  # nobody says which
    ("hydraulic", ("left", "right", "flow")),
    ({"flow": "mechanical"}, ("left", "right")),
    ("mechanical", ()),
    ("thermal", ()),
])  # fmt: skip
def test_storages_are_tanks_or_of_an_unknown_kind(kind, storages) -> None:
    assert storage_states(replace(two_tanks(), kind=kind)) == storages


@pytest.mark.parametrize(("units", "kinds"), [
    ({}, {}),
    ({"flow": "m^3/s"}, {"flow": "hydraulic"}),
    ({"left": "m", "right": "cm", "flow": "m^3/s"}, dict.fromkeys(["left", "right", "flow"], "hydraulic")),
    ({"left": "m", "right": "m"}, {}),  # the third may be a speed
    ({"left": "m", "right": "m", "flow": "m/s"}, dict.fromkeys(["left", "right", "flow"], "mechanical")),
    ({"left": "V", "right": "V", "flow": "V"}, {}),  # of any sensor
    ({"left": "V", "right": "V", "flow": "A"}, dict.fromkeys(["left", "right", "flow"], "electrical")),
    ({"left": "degC", "t": "s"}, {"left": "thermal"}),
])  # fmt: skip
def test_units_tell_kinds_outside_the_pairs(units, kinds) -> None:
    assert with_kinds_of_units(two_tanks(), units).kind == kinds


def test_units_tell_the_kind_of_a_pair() -> None:
    circuit = with_kinds_of_units(spring(1.0), {"q": "C", "p": "Wb"})
    assert circuit.kind == {"q": "electrical", "p": "electrical"}
    assert position_of_momentum(circuit) == {"p": "q"}
    assert with_kinds_of_units(spring(1.0), {"q": "V"}).kind == {}  # of any sensor


def test_the_memory_of_an_effect_is_neither_forced_nor_a_storage() -> None:
    model = two_tanks().add("sensor delay", "left")
    assert forced_rows(model) == (0, 1, 2)
    assert storage_states(model) == ("left", "right", "flow")


# ---- kinds of states


def heater(kind: Any = "thermal") -> ph.FirstOrder:
    return ph.FirstOrder(
        states=["T1", "T2"],
        F={
            "T1": ph.formula("-a*T1 + u", a=ph.Parameter(0.5, lower=0)),
            "T2": ph.formula("b*(T1 - T2)", b=ph.Parameter(0.3, lower=0)),
        },
        inputs=["u"],
        kind=kind,
    )


def circuit(kind: Any = "electrical") -> ph.PseudoHamiltonian:
    """A coil (flux phi) and a capacitor (charge q) at a voltage u."""
    return ph.PseudoHamiltonian(
        states=["q", "phi"],
        inputs=["u"],
        S=ph.canonical(1),
        H="q**2/2 + phi**2/2",
        R={"phi": ph.formula("r", r=ph.Parameter(0.2, lower=0))},
        F={"phi": "u"},
        kind=kind,
    )


def test_one_kind_is_that_of_all_states_and_a_mapping_that_of_some() -> None:
    assert heater().kind == {"T1": "thermal", "T2": "thermal"}
    assert heater({"T2": "thermal"}).kind == {"T2": "thermal"}
    assert heater(None).kind == {} == circuit({}).kind


@pytest.mark.parametrize(("kind", "said"), [
    ("thermic", "kind 'thermic' is unknown; .* Did you mean 'thermal'"),
    ({"T1": "Electrical"}, "kind of 'T1': 'Electrical' .* mean 'electrical'"),
    ({"T": "thermal"}, "kind of 'T', which is not a state .* Did you mean 'T"),
    (["thermal"], r"kind=\['thermal'\] is not possible"),
    ({"T1": None}, "kind={'T1': None} is not possible"),
])  # fmt: skip
def test_a_kind_that_there_is_not_is_refused(kind: Any, said: str) -> None:
    with pytest.raises(ph.ModelError, match=said):
        heater(kind)


@pytest.mark.parametrize("model", [heater(), circuit()], ids=["heater", "circuit"])
def test_a_model_that_changes_keeps_its_kinds(model: ph.Model) -> None:
    changed = model.frozen().dynamics().add("sensor delay", model.states[0])
    assert changed.kind == model.kind
    assert not set(changed.memory) & set(changed.kind)
    assert pickle.loads(pickle.dumps(model)) == model


@pytest.mark.parametrize(("unit", "kind"), [
    *((unit, "mechanical") for unit in ("m", "mm", "rad", "deg", "m/s", "mrad/s")),
    *((unit, "mechanical") for unit in ("N", "kN", "N m", "N*s", "kg m/s", "rpm")),
    *((unit, "hydraulic") for unit in ("m^3", "m³", "L", "mL", "Pa", "mbar")),
    *((unit, "hydraulic") for unit in ("m**3/s", "L/min", "m^3/h")),
    *((unit, "electrical") for unit in ("A", "mA", "C", "Wb", "V s", "Ah")),
    *((unit, "thermal") for unit in ("K", "degC", "°C", "J", "kJ", "kWh")),
    *((unit, "") for unit in ("", "V", "mV", "1", "kg", "s", "%", "W")),
])  # fmt: skip
def test_a_unit_tells_the_kind_where_it_belongs_to_one_field(unit, kind) -> None:
    assert kind_of_unit(unit) == kind

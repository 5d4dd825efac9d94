"""Units of parameters: what the equations say of them, as people write it."""

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.model.catalogue import (
    effect_named,
    inertia_of,
    inertia_words,
    lacking_quantity,
)
from phsi_opt.model.parameter_units import parameter_units, state_units
from phsi_opt.presentation.units import (
    coefficient_unit,
    in_si,
    powers_as_written,
    powers_in_base_units,
    scale_of,
)
from phsi_opt.screening.effect_size import size_unit
from tests.systems import pair

LENGTHS = {"t": "s", "q": "m", "p": "kg m/s", "u": "N"}
ANGLES = {"t": "s", "q": "rad", "p": "kg m^2/s"}
HOUSE = {"t": "h", "T": "degC", "outside": "degC", "heating": "W"}
SPEED = {"t": "s", "w": "rad/s", "u": "V"}
CAR = {"t": "s", "v": "m/s"}
DRAG = ("quadratic drag", "N s^2/m^2")
HEATED = {**HOUSE, "t": "s"}
VOLTS = {"t": "s", "h": "V", "u": "V"}


def free(*names: str) -> dict[str, ph.Parameter]:
    return {name: ph.Parameter(1.0) for name in names}


def spring(energy: str = "p**2/(2*m) + k*q**2/2") -> ph.PseudoHamiltonian:
    return pair(energy, F="u", **free("m", "k"))


def pendulum() -> ph.PseudoHamiltonian:
    return pair("p**2/(2*J) - w*cos(q)", ph.damping("p"), **free("J", "w"))


def house() -> ph.FirstOrder:
    rate = ph.formula("a*(outside - T) + b*heating", **free("a", "b"))
    inputs = ["outside", "heating"]
    return ph.FirstOrder(states=["T"], F={"T": rate}, inputs=inputs, kind="thermal")


def motor() -> ph.FirstOrder:
    rate = ph.formula(
        "(K*(u - K*w)/R - b*w)/J",
        K=ph.Parameter(0.08, unit="N m/A"),
        R=ph.Parameter(1.1, unit="Ohm"),
        J=ph.Parameter(0.012, unit="kg m^2"),
        b=ph.Parameter(unit="N m s"),
    )
    return ph.FirstOrder(states=["w"], F={"w": rate}, inputs=["u"])


def car(rate: str, **mass: ph.Parameter) -> ph.FirstOrder:
    force = ph.Parameter(200.0, lower=0, unit="N")
    return ph.FirstOrder(states=["v"], F={"v": ph.formula(rate, F=force, **mass)})


def chamber(unit: str) -> ph.FirstOrder:
    rate = ph.formula("heating/C", C=ph.Parameter(5e4, unit=unit))
    return ph.FirstOrder(states=["T"], F={"T": rate}, inputs=["outside", "heating"])


def tank() -> ph.FirstOrder:
    rate = ph.formula("a*u", **free("a"))
    return ph.FirstOrder(states=["h"], F={"h": rate}, inputs=["u"], kind="hydraulic")


def test_masses_and_stiffnesses_follow_from_the_states() -> None:
    assert parameter_units(spring(), LENGTHS) == {"m": "kg", "k": "N/m"}
    of_angles = {"J": "kg m^2", "w": "N m", "R_p": "N m s/rad"}
    assert parameter_units(pendulum(), ANGLES) == of_angles
    assert parameter_units(house(), HOUSE) == {"a": "1/h", "b": "degC/(W h)"}


def test_a_measured_force_tells_the_unit_of_a_momentum_that_nobody_measures() -> None:
    units = {"t": "s", "q": "m", "u": "N"}
    assert parameter_units(spring(), units) == {"m": "kg", "k": "N/m"}
    assert state_units(spring(), units) == {"q": "m", "p": "kg m/s"}
    assert state_units(spring(), {"t": "s", "q": "m"}) == {"q": "m", "p": ""}


@pytest.mark.parametrize(("model", "units", "name", "expected"), [
    (spring(), LENGTHS, "viscous damping", "N s/m"),
    (spring(), LENGTHS, "coulomb friction", "N"),
    (spring(), LENGTHS, "quadratic drag", "N s^2/m^2"),
    (spring(), LENGTHS, "cubic stiffness", "N/m^3"),
    (spring(), LENGTHS, "position-dependent damping", "N s/m^3"),
    (spring(), LENGTHS, "drifting force", "N/s"),
    (spring(), LENGTHS, "harmonic force", "N"),
    (spring(), LENGTHS, "quadratic input", "1/N"),
    (spring(), LENGTHS, "input lag", "s"),
    (spring(), LENGTHS, "input gain", ""),
    (spring(), LENGTHS, "hysteresis", "N"),
    (spring(), LENGTHS, "bouc-wen hysteresis", "N"),
    (pendulum(), ANGLES, "coulomb friction", "N m"),
    (pendulum(), ANGLES, "linear stiffness", "N m/rad"),
    (pendulum(), ANGLES, "quadratic drag", "N m s^2/rad^2"),
    (house(), HOUSE, "harmonic heat input", "degC/h"),
    (house(), HOUSE, "quadratic heat loss", "1/(degC h)"),
    # A mass or capacity that divides forces makes the sizes of effects forces.
    (motor(), SPEED, "coulomb friction", "N m"),
    (motor(), SPEED, "quadratic input", "N m/V^2"),
    (motor(), SPEED, "sensor offset", "rad/s"),
    (car("-F/m", m=ph.Parameter(1420.0, fixed=True, unit="kg")), CAR, *DRAG),
    (car("-F/1420"), CAR, *DRAG),
    (car("-F/(2*m)", m=ph.Parameter(1420.0, fixed=True, unit="kg")), CAR, *DRAG),
    (chamber("J/K"), HEATED, "heat exchange with outside", "W/K"),
    (chamber(""), HEATED, "constant heat input", "W"),
    (chamber("J/K"), HEATED, "quadratic input of heating", "1/W"),
    (tank(), VOLTS, "turbulent leak", "V^0.5/s"),
    (tank(), VOLTS, "constant inflow", "V/s"),
])  # fmt: skip
def test_sizes_of_effects_have_the_unit_that_their_equation_gives(
    model: ph.Model, units: dict[str, str], name: str, expected: str
) -> None:
    equation = model.states[-1]
    effect = effect_named(model, name, equation, units)
    assert size_unit(model, effect, units) == expected


@pytest.mark.parametrize("unit_of_L", ["H", "V s/A", ""])
@pytest.mark.parametrize("unit_of_C", ["F", ""])
def test_an_inductance_in_henry_makes_sizes_physical(
    unit_of_L: str, unit_of_C: str
) -> None:
    loop = ph.formula("-(R*i + uC)/L + u/L", L=coil(unit_of_L), R=coil(""))
    charge = ph.formula("i/C", C=coil(unit_of_C))
    kind = "electrical"
    model = ph.FirstOrder(["i", "uC"], {"i": loop, "uC": charge}, ["u"], kind=kind)
    units = {"t": "s", "i": "A", "u": "V"}
    known = {"L": unit_of_L or "H", "R": "Ohm", "C": "F"}
    assert parameter_units(model, units) == known
    for name, unit in LOSSES_OF_A_COIL.items():
        effect = effect_named(model, name, "i", units)
        assert size_unit(model, effect, units) == unit
        assert inertia_words(model.add(effect), effect, units) == ""


LOSSES_OF_A_COIL = {
    "cubic elastance": "1/V^2",
    "charge-dependent resistance": "1/(A V)",
    "quadratic resistance": "V/A^2",
    "constant voltage": "V",
}


def coil(unit: str) -> ph.Parameter:
    return ph.Parameter(0.01, lower=0, unit=unit)


def test_resistances_behind_a_torque_constant_are_in_ohm() -> None:
    known = {
        "K": ph.Parameter(0.1, unit="V s/rad"),
        "J": ph.Parameter(1, unit="kg m^2"),
    }
    rate = ph.formula("K*(u - K*w)/(R*J)", R=ph.Parameter(1.1, fixed=True), **known)
    model = ph.FirstOrder(["w"], {"w": rate}, inputs=["u"])
    assert parameter_units(model, SPEED) == {"K": "V s/rad", "R": "Ohm", "J": "kg m^2"}


def test_a_size_without_an_inertia_is_told_per_unit_of_it() -> None:
    slow = ph.FirstOrder(["w"], {"w": "(K*u - w)/T"}, inputs=["u"])

    def per(model: ph.Model, units: dict[str, str], name: str) -> str:
        effect = effect_named(model, name, model.states[-1], units)
        return inertia_words(model.add(effect), effect, units)

    assert per(slow, SPEED, "coulomb friction") == ", per inertia"
    assert per(house(), HOUSE, "heat loss") == ", per heat capacity"
    assert per(slow, SPEED, "input dead zone") == ""
    assert per(slow, SPEED, "sensor offset") == ""
    assert per(motor(), SPEED, "coulomb friction") == ""
    assert per(spring(), LENGTHS, "coulomb friction") == ""


@pytest.mark.parametrize(("model", "units", "quantity"), [
    (spring(), LENGTHS, "force"),
    (spring(), {}, "force"),
    (pendulum(), ANGLES, "torque"),
    (motor(), SPEED, "torque"),
    (car("-F/m", m=ph.Parameter(1420.0, fixed=True, unit="kg")), CAR, "force"),
    (house(), HOUSE, "heat flow per heat capacity"),
    (tank(), VOLTS, "flow per capacity"),
    (ph.FirstOrder(["i"], {"i": "u - i"}, ["u"]), {"i": "A", "t": "s"}, "voltage per inductance"),
    (ph.FirstOrder(["x"], {"x": "u - x"}, ["u"]), {"t": "s"}, "term"),
])  # fmt: skip
def test_what_an_equation_lacks_has_the_name_of_its_field(
    model: ph.Model, units: dict[str, str], quantity: str
) -> None:
    x = model.states[-1]
    inertia = inertia_of(model, x, units)
    assert lacking_quantity(model, x, units, inertia) == quantity


def test_millimetres_are_no_metres_and_keep_their_name() -> None:
    units = {"t": "s", "q": "mm", "p": "kg mm/s", "u": "kg mm/s^2"}
    assert parameter_units(spring(), units) == {"m": "kg", "k": "N/m"}
    mixed = {"t": "s", "q": "mm", "p": "kg m/s", "u": "N"}
    assert parameter_units(spring(), mixed)["m"] == "kg m/mm"
    friction = effect_named(spring(), "coulomb friction", "p")
    assert size_unit(spring(), friction, mixed) == "N"


WRITTEN = {
    "mm": ({"t": "s", "q": "mm", "u": "N"}, "mm/s", "mm"),
    "deg": ({"t": "s", "q": "deg", "u": "N m"}, "deg/s", "deg"),
}


@pytest.mark.parametrize("unit", WRITTEN)
def test_speeds_and_lengths_of_an_effect_are_told_in_the_unit_of_the_position(
    unit: str,
) -> None:
    """They are parameters of the equation of a momentum that nobody measures."""
    given, speed, length = WRITTEN[unit]
    for name, beside, told in (
        ("coulomb friction", "coulomb_friction_p.v0", speed),
        ("stribeck friction", "stribeck_friction_p.v_s", speed),
        ("gap", "gap_q.play", length),
        ("hysteresis", "hysteresis_width_p", length),
        ("sensor offset", "sensor_offset_q", length),
    ):
        on = "q" if name == "sensor offset" else "p"
        larger = spring().add(effect_named(spring(), name, on))
        found = scale_of(parameter_units(larger, in_si(given))[beside])
        assert found.unit == told
        assert found.size == pytest.approx(1e-3 if unit == "mm" else np.pi / 180)


def test_what_is_compared_with_an_input_is_told_in_its_unit() -> None:
    tank = ph.FirstOrder(["h"], {"h": "g*u - a*h"}, inputs=["u"], kind="hydraulic")
    units = in_si({"t": "s", "h": "cm", "u": "l/min"})
    dead_zone = effect_named(tank, "input dead zone", "h")
    assert scale_of(size_unit(tank, dead_zone, units)).unit == "l/min"


def test_rates_of_a_speed_are_told_in_its_unit() -> None:
    units = in_si({"t": "s", "w": "deg/s", "u": "V"})
    larger = motor().add(effect_named(motor(), "constant force", "w"))
    assert (
        scale_of(parameter_units(larger, units)["constant_force_w"]).unit == "deg/s^2"
    )


def test_an_offset_of_a_thermometer_has_no_zero_of_its_own() -> None:
    units = in_si(HEATED | {"T": "degF"})
    larger = house().add(effect_named(house(), "sensor offset", "T"))
    scale = scale_of(parameter_units(larger, units)["sensor_offset_T"])
    assert (scale.unit, scale.zero) == ("degF", 0.0)
    assert scale.size == pytest.approx(5 / 9)


def test_a_number_that_may_have_a_unit_of_its_own_leaves_the_unit_open() -> None:
    model = spring("p**2/2.7 + k*q**2/2")
    assert parameter_units(model, LENGTHS) == {"k": "N/m"}
    hidden = spring("p**2/2 + 9.81*k*q**2/2")
    assert parameter_units(hidden, LENGTHS) == {"k": ""}


def test_a_unit_that_the_model_states_is_kept_and_tells_the_others() -> None:
    mass = ph.Parameter(1.0, unit="kg")
    model = pair("p**2/(2*m) + k*q**2/2", m=mass, k=ph.Parameter(1.0))
    assert parameter_units(model, {"t": "s", "q": "m"}) == {"m": "kg", "k": "N/m"}


def test_written_powers_are_read_and_written_alike() -> None:
    for unit in ("N s/m", "kg m^2", "1/s", "m/s^2", "degC/(W h)", "W", "%"):
        powers = powers_as_written(unit)
        assert powers is not None
        assert coefficient_unit(powers) == unit
    powers = powers_in_base_units("A/(V^3 s)")
    assert powers is not None and coefficient_unit(powers) == "A/(V^3 s)"
    of_charge = {"kg": 1, "m": 2, "A": -4, "s": -6}  # of q^3 in an elastance
    assert coefficient_unit(of_charge) == "V/C^3"
    assert powers_as_written("3 apples") is None

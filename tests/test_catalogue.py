"""What the catalogue offers a model: names, families, and what they need."""

import re
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.model.catalogue import (
    EffectChoice,
    effect_named,
    effects_told,
    every_name,
)
from phsi_opt.model.kinds import KINDS
from phsi_opt.model.laws import is_second_storage, law_of, laws_told
from tests.systems import pair

ROOT = Path(__file__).resolve().parents[1]
EVERY_KIND: tuple[Any, ...] = ({}, *KINDS)


def driven_spring(H: str = "p**2/2") -> ph.PseudoHamiltonian:
    return pair(H, F="u")


def two_tanks() -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["a", "b"], S=[[0.0, 0.0], [0.0, 0.0]], H="(a**2 + b**2)/2"
    )


def two_masses() -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["q1", "q2", "p1", "p2"], S=ph.canonical(2), H="(p1**2 + p2**2)/2"
    )


FAMILIES = {
    "a loss that grows with speed": "viscous damping, quadratic drag, cubic drag",
    "dry friction": "coulomb friction, stribeck friction",
    "damping that depends on the position": "position-dependent damping",
    "a force that depends on the position": "linear stiffness, quadratic stiffness, "
    "cubic stiffness, gravity torque, gap",
    "hysteresis": "hysteresis, bouc-wen hysteresis",
    "a constant force": "constant force",
    "a force that changes with the time": "drifting force, harmonic force",
    "a stiffness that changes with the time": "parametric stiffness",
    "an error in the size of the input's force": "input gain, quadratic input, odd quadratic input, "
    "input dead zone, input saturation",
    "a delay of the input": "input lag, input delay",
    "a spring that yields": "maxwell element",
    "a resonance": "resonance",
}


def test_the_effects_of_a_body_are_in_the_family_of_their_cause() -> None:
    found: dict[str, set[str]] = {}
    for effect in ph.catalogue(driven_spring()):
        if effect.equation == "p" and effect.slot != "sensor":
            found.setdefault(effect.family, set()).add(effect.name)
    assert found.keys() == FAMILIES.keys()
    for family, names in FAMILIES.items():  # a further law needs no entry
        assert found[family] >= set(names.split(", "))


def test_only_effects_that_change_with_the_time_need_the_clock() -> None:
    with_clock = {e.name for e in ph.catalogue(driven_spring()) if e.needs_clock}
    assert with_clock == {
        "drifting force",
        "harmonic force",
        "parametric stiffness",
        "sensor drift",
    }
    rate = {"z": ph.formula("cos(w*t)", w=1.0)}
    turning = ph.Effect("own", "F", "p", ph.formula("c*z", c=ph.Parameter()), rate)
    assert turning.needs_clock


# --- by kind


def storage(kind: Any, loses: bool = False) -> ph.PseudoHamiltonian:
    """One state outside of pairs; its own loss, if any, is of no law of the catalogue."""
    own = {"x": ph.formula("r*x**4", r=ph.Parameter(0.1, lower=0))}
    return ph.PseudoHamiltonian(
        states=["x"], S=[[0.0]], H="x**2/2", R=own if loses else {}, kind=kind
    )


def names_on(model: ph.Model, equation: str, slots: str = "RH") -> set[str]:
    effects = [e for e in ph.catalogue(model) if e.slot in slots]
    return {e.name for e in effects if e.equation == equation}


def first_order(kind: Any) -> ph.FirstOrder:
    return ph.FirstOrder(["a", "b"], {"a": "sin(b)"}, kind=kind)


MODELS = [driven_spring(), two_masses(), two_tanks(), first_order({}), storage({})]


@pytest.mark.parametrize("kind", EVERY_KIND)
def test_what_is_offered_does_not_depend_on_whether_energy_is_lost(kind: Any) -> None:
    with_loss, without = storage(kind, loses=True), storage(kind)
    assert ph.catalogue(with_loss) == ph.catalogue(without)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("kind", EVERY_KIND)
def test_no_term_has_two_names_and_each_has_a_family(model: Any, kind: Any) -> None:
    effects = ph.catalogue(replace(model, kind=kind))
    for one, other in combinations(effects, 2):
        is_same_place = (one.slot, one.equation) == (other.slot, other.equation)
        bodies = {term.body for term in one.term} & {term.body for term in other.term}
        if is_same_place and not one.memory:
            # Stribeck friction holds Coulomb's, and two waves their free frequency.
            assert not bodies or "stribeck friction" in (one.name, other.name)
        assert str(one) != str(other)
    assert all(effect.family for effect in effects)


OF_THE_FIELD: dict[str, str] = {
    "": "linear leak, quadratic drag, cubic drag, coulomb friction, stribeck friction, "
    "turbulent leak, saturating leak, overflow",
    "mechanical": "viscous damping, quadratic drag, cubic drag, coulomb friction, "
    "stribeck friction",
    "hydraulic": "linear leak, quadratic leak, turbulent leak, saturating leak, overflow",
    "electrical": "linear resistance, quadratic resistance, contact voltage drop, "
    "coil or capacitor saturation",
    "thermal": "heat loss, quadratic heat loss, radiation",
}


@pytest.mark.parametrize("kind", OF_THE_FIELD)
def test_losses_and_energies_outside_of_pairs_are_those_of_the_field(kind: str) -> None:
    known = set(", ".join(OF_THE_FIELD.values()).split(", "))
    found = names_on(storage(kind or {}), "x")
    assert found & known == set(OF_THE_FIELD[kind].split(", "))


def test_what_runs_between_two_storages_is_water_or_heat() -> None:
    def between(kind: Any) -> set[str]:
        found = ph.catalogue(replace(two_tanks(), kind=kind))
        words = {"from", "with", "between"}
        return {str(e) for e in found if words & set(e.name.split())}

    overflows = {"overflow from a on b", "overflow from b on a"}
    overflows |= {"spill from a into b", "spill from b into a"}
    assert between({}) == overflows
    assert between("hydraulic") == overflows | {"connection between a and b"}
    assert between("thermal") == {
        "heat exchange with a on b",
        "heat exchange with b on a",
        "exchange of heat between a and b",
    }
    laws = ("damper", "dry friction", "gyroscopic coupling")
    assert between("mechanical") == {f"{law} between a and b" for law in laws}
    assert between("electrical") == set()
    assert between({"a": "hydraulic", "b": "thermal"}) == set()


def test_units_tell_the_kind_where_the_model_does_not() -> None:
    def losses(model: ph.Model, unit: str) -> set[str]:
        found = ph.catalogue(model, {"x": unit})
        return {e.name for e in found if e.slot == "R"}

    assert "radiation" in losses(storage({}), "K")
    # Its fourth power is that of an absolute temperature.
    assert losses(storage({}), "degC") == {"heat loss", "quadratic heat loss"}
    assert losses(storage("thermal"), "°C") == {"heat loss", "quadratic heat loss"}
    assert "viscous damping" in losses(storage({}), "m/s")
    assert losses(storage("hydraulic"), "m/s") == losses(storage("hydraulic"), "")


def test_heat_is_taken_from_the_hotter_storage() -> None:
    model = replace(two_tanks(), kind="thermal")
    larger = model.add("heat exchange with b", "a")
    larger = larger.with_values({"heat_exchange_b_a": 0.3})
    rates = np.array(larger.rhs()([0.2, 1.2], [], 0.0, larger.theta)).ravel()
    np.testing.assert_allclose(rates, [0.3, 0.0])


def test_heat_is_exchanged_with_an_input_that_may_be_a_temperature() -> None:
    model = replace(heated(), inputs=("u", "Ta"))

    def exchanged(units: dict[str, str]) -> set[str]:
        found = ph.catalogue(model, units)
        return {str(e) for e in found if e.name.endswith((" u", " Ta"))}

    with_u = {"heat exchange with u on T1", "heat exchange with u on T2"}
    with_ambient = {"heat exchange with Ta on T1", "heat exchange with Ta on T2"}
    only_heat = {name for name in exchanged({}) if name.startswith("heat")}
    assert only_heat == with_u | with_ambient
    told = {name for name in exchanged({"u": "W", "Ta": "degC"}) if "heat" in name}
    assert told == with_ambient
    larger = model.add("heat exchange with Ta", "T2")
    larger = larger.with_values({"heat_exchange_Ta_T2": 0.3, "b": 0.0, "a": 0.0})
    rates = np.array(larger.rhs()([0.0, 1.0], [0.0, 3.0], 0.0, larger.theta)).ravel()
    np.testing.assert_allclose(rates, [0.0, 0.6])


# --- names of all kinds


def test_what_the_model_has_by_another_name_cannot_be_added_again() -> None:
    tank = storage("hydraulic").add("viscous damping", "x")
    with pytest.raises(ph.ModelError, match="has 'linear leak' on x already"):
        tank.add("linear leak", "x")
    rolls = ph.FirstOrder(["v"], {"v": "-f"}, ["f"], kind="mechanical")
    with pytest.raises(ph.ModelError, match="has 'quadratic drag' already"):
        rolls.add("air drag").add("quadratic drag")


def pushed() -> ph.PseudoHamiltonian:
    """A mass with a spring and a force, without losses."""
    # Nothing is free: no effect is compared with what parameters can do.
    return driven_spring("q**2/2 + p**2/2")


@pytest.mark.parametrize(("other", "name"), [
    ("air drag", "quadratic drag"),
    ("Windage", "quadratic drag"),
    ("backlash", "gap"),
    ("free play", "gap"),
    ("dead time", "input delay"),
    ("stiction", "stribeck friction"),
    ("dashpot", "viscous damping"),
])  # fmt: skip
def test_an_effect_is_found_by_what_people_call_it(other: str, name: str) -> None:
    model = pushed()
    assert str(effect_named(model, other)) == f"{name} on p"
    assert str(effect_named(model, f"{other} on p")) == f"{name} on p"
    assert model.add(other, "p") == model.add(name, "p")
    assert [str(e) for e in ph.catalogue(model, called=other)] == [f"{name} on p"]
    chosen = EffectChoice([other], without=["gap"]).checked(model).candidates(model)
    assert [str(e) for e in chosen] == [f"{name} on p"] * (name != "gap")


@pytest.mark.parametrize(("asked", "words"), [
    ("offset on p", "'offset' may be constant force or sensor offset; say which"),
    ("rope friction", "Did you mean 'viscous damping' or 'coulomb friction'"),
    ("wind", "Did you mean 'quadratic drag'?"),
    ("coulom friction", "Did you mean 'coulomb friction'?"),
    ("voodoo", "'voodoo' in the catalogue. ph.catalogue(model)"),
])  # fmt: skip
def test_an_unknown_name_is_answered_by_meaning(asked: str, words: str) -> None:
    with pytest.raises(ph.ModelError) as refused:
        pushed().add(asked)
    assert words in str(refused.value)
    assert len(str(refused.value)) <= 300


def test_every_law_says_what_it_adds_and_no_other_name_is_that_of_a_law() -> None:
    told = laws_told()
    assert not [name for name, adds in told.items() if not adds]
    names = set(told)
    for name in told:
        assert not names & set(law_of(name).others)
    adds = {str(effect): one for effect, one in effects_told(pushed())}
    assert adds["quadratic drag on p"] == "-c |dH_dp| dH_dp"
    assert adds["input delay on p"] == "dF/du (u(t - delay) - u)"
    assert list(adds) == list(map(str, ph.catalogue(pushed())))


def test_the_page_of_effects_has_every_name() -> None:
    text = (ROOT / "docs" / "api" / "effects.rst").read_text(encoding="utf-8")
    page = " ".join(text.split())
    for model in MODELS:
        for effect in every_name(model):
            name = re.split(" (?:with|from|between) ", effect.name)[0]
            assert name in page, name


# --- found in records


def heated() -> ph.FirstOrder:
    rates = {
        "T1": ph.formula("-a*T1 + u", a=ph.Parameter(0.3, lower=0)),
        "T2": ph.formula("-b*T2", b=ph.Parameter(0.2, lower=0)),
    }
    return ph.FirstOrder(["T1", "T2"], rates, inputs=["u"], kind="thermal")


def test_a_spring_without_an_energy_is_offered_what_one_with_it_is() -> None:
    k = {"k": ph.Parameter(3.0, lower=0)}
    energy = pair("k*q**4 + p**2/2", F="u", **k)
    rates = {"q": ph.formula("p"), "p": ph.formula("u - 4*k*q**3", **k)}
    plain = ph.FirstOrder(["q", "p"], rates, inputs=["u"])
    offered = {str(effect): effect for effect in ph.catalogue(plain)}
    known = {str(effect): effect for effect in ph.catalogue(energy)}
    assert offered.keys() == known.keys()
    assert {"linear stiffness on p", "gap on p", "hysteresis on p"} <= known.keys()
    random = np.random.default_rng(3)
    for name, effect in known.items():
        assert effect.family == offered[name].family
        first, second = energy.add(effect), plain.add(offered[name])
        values = dict.fromkeys(first.free, 0.7) | {"k": 3.0}
        first, second = first.with_values(values), second.with_values(values)
        for x in random.normal(size=(5, first.n_states)):
            u = random.normal(size=1)
            np.testing.assert_allclose(
                np.array(first.rhs()(x, u, 0.4, first.theta)),
                np.array(second.rhs()(x, u, 0.4, second.theta)),
                err_msg=name,
            )


@pytest.mark.parametrize(("unit", "zero"), [("degC", 273.15), ("°F", 459.67)])
def test_radiation_counts_from_the_zero_of_the_scale(unit: str, zero: float) -> None:
    bare = ph.FirstOrder(["T"], {"T": "0"}, kind="thermal")
    (effect,) = [e for e in ph.catalogue(bare, {"T": unit}) if e.name == "radiation"]
    model = bare.add(effect).with_values({"radiation_T": 2e-9})
    for T in (-40.0, 0.0, 25.0, 600.0):
        rate = float(model.rhs()([T], [], 0.0, model.theta))
        expected = -2e-9 * ((T + zero) ** 4 - zero**4)
        assert rate == pytest.approx(expected, rel=1e-9, abs=1e-9)
    in_kelvin = [e for e in ph.catalogue(bare, {"T": "K"}) if e.name == "radiation"]
    assert in_kelvin[0].term.terms[0].body == "abs(T)**3"


@pytest.mark.parametrize(
    ("unit", "half_turn"),
    [("", np.pi), ("rad", np.pi), ("mrad", 1000 * np.pi), ("deg", 180.0), ("rev", 0.5)],
)
@pytest.mark.parametrize("has_energy", [True, False])
def test_gravity_turns_with_the_angle_in_its_unit(unit, half_turn, has_energy) -> None:
    model: ph.Model = ph.FirstOrder(["q", "p"], {"q": "p", "p": "0"})
    if has_energy:
        model = pair("p**2/2")
    (effect,) = [
        e for e in ph.catalogue(model, {"q": unit}) if e.name == "gravity torque"
    ]
    heavy = model.add(effect).with_values({"gravity_torque_q": 1.5})

    def torque(q: float) -> float:
        return float(np.array(heavy.rhs()([q, 0.0], [], 0.0, heavy.theta))[1, 0])

    assert torque(half_turn) == pytest.approx(0.0, abs=1e-9)
    assert torque(half_turn / 2) < 0 < torque(-half_turn / 2)
    assert torque(half_turn / 6) == pytest.approx(torque(half_turn / 2) / 2)


# ---- a storage that nobody measures


@pytest.mark.parametrize(
    ("kind", "name"),
    [("thermal", "second heat storage"), ("electrical", "second charge storage")],
)
def test_heat_and_charge_may_have_a_second_storage(kind: str, name: str) -> None:
    model = ph.FirstOrder(
        ["x"], {"x": ph.formula("u - c*x", c=1.0)}, inputs=["u"], kind=kind
    )
    offered = [one for one in ph.catalogue(model) if is_second_storage(one)]
    assert [one.name for one in offered] == [name]
    larger = model.add(offered[0])
    assert not [one for one in ph.catalogue(larger) if is_second_storage(one)]


# ---- effects that are considered


def coupled_masses() -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["q1", "q2", "p1", "p2"],
        S=ph.canonical(2),
        H="(q1 - q2)**2/2 + (p1**2 + p2**2)/2",
    )


def own_effect(coefficient: str = "c") -> ph.Effect:
    term = ph.formula(f"{coefficient}*q1*q2", **{coefficient: ph.Parameter()})
    return ph.Effect("own", "F", "p1", term)


def listed(choice: EffectChoice, model: ph.Model) -> list[str]:
    return [str(effect) for effect in choice.checked(model).candidates(model)]


def test_a_name_means_every_equation_that_can_have_the_effect() -> None:
    choice = EffectChoice(["coulomb friction", "gap on p2", own_effect()])
    assert listed(choice, coupled_masses()) == [
        "coulomb friction on p1",
        "coulomb friction on p2",
        "gap on p2",
        "own on p1",
    ]


def test_an_effect_that_was_added_since_is_not_offered_again() -> None:
    model = coupled_masses()
    choice = EffectChoice(["coulomb friction", "stribeck friction on p1", own_effect()])
    choice = choice.checked(model)
    larger = model.add("coulomb friction", "p1").add(own_effect())
    found = choice.candidates(larger)
    assert [str(effect) for effect in found] == [
        "coulomb friction on p2",
        "stribeck friction on p1",
    ]
    assert len(found[1].term) == 1  # the rise alone: the model has the level


@pytest.mark.parametrize(("effects", "without", "said"), [
    (["coulom friction"], (), "in effects is not in .* mean 'coulomb friction'"),
    (None, ["gap on p3"], "'gap on p3' in without .* Did you mean 'gap on p"),
    (None, ["overflow"], "'overflow' in without is not in the catalogue"),
    (None, [own_effect()], "'own on p1' in without is not in the catalogue"),
    (None, "gap", "without='gap' .* Write a list"),
    (own_effect(), (), r"effects=.* expected Sequence\[Effect \| str\]"),
    ([3], (), r"effects=\[3\] .* expected Sequence\[Effect \| str\]"),
])  # fmt: skip
def test_what_no_equation_can_have_is_refused(effects, without, said) -> None:
    with pytest.raises(ph.ModelError, match=said):
        EffectChoice(effects, without).checked(coupled_masses())

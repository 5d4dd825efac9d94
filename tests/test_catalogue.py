"""What the catalogue offers a model: names, families, and what they need."""

import pickle

import pytest

import phsi_opt as ph


def driven_spring() -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("p**2/2"),
        F={"p": ph.formula("u")},
    )


def two_tanks() -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["a", "b"],
        S=[[0.0, 0.0], [0.0, 0.0]],
        H=ph.formula("(a**2 + b**2)/2"),
    )


def two_masses() -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["q1", "q2", "p1", "p2"],
        S=ph.canonical(2),
        H=ph.formula("(p1**2 + p2**2)/2"),
    )


@pytest.mark.parametrize("model", [driven_spring(), two_masses(), two_tanks()])
def test_every_effect_of_the_catalogue_has_a_family(model: ph.Model) -> None:
    for effect in ph.catalogue(model):
        assert effect.family, effect


@pytest.mark.parametrize(
    ("family", "names"),
    [
        (
            "a loss that grows with speed",
            {"viscous damping", "quadratic drag", "cubic drag"},
        ),
        ("dry friction", {"coulomb friction", "stribeck friction"}),
        ("damping that depends on the position", {"position-dependent damping"}),
        (
            "a force that depends on the position",
            {
                "linear stiffness",
                "quadratic stiffness",
                "cubic stiffness",
                "gravity torque",
                "gap",
            },
        ),
        ("hysteresis", {"hysteresis"}),
        ("a constant force", {"constant force"}),
        ("a force that changes with the time", {"drifting force", "harmonic force"}),
        ("a stiffness that changes with the time", {"parametric stiffness"}),
        (
            "an error in the size of the input's force",
            {"input gain", "quadratic input", "input dead zone", "input saturation"},
        ),
        ("a delay of the input", {"input lag", "input delay"}),
    ],
)
def test_the_effects_of_a_body_are_in_the_family_of_their_cause(
    family: str, names: set[str]
) -> None:
    effects = [e for e in ph.catalogue(driven_spring()) if e.equation == "p"]
    assert {e.name for e in effects if e.family == family} == names


def test_a_family_outlives_pickling_and_is_empty_for_an_effect_of_ones_own() -> None:
    effect = ph.catalogue(driven_spring())[0]
    assert pickle.loads(pickle.dumps(effect)).family == effect.family
    own = ph.Effect("own", "F", "p", ph.formula("c*q", c=ph.Parameter()))
    assert own.family == ""


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

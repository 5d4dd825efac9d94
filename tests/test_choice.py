"""Which effects are considered: all of the catalogue, those chosen, none left out."""

from typing import Any

import pytest

import phsi_opt as ph
from phsi_opt.model.catalogue import EffectChoice


def two_masses() -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["q1", "q2", "p1", "p2"],
        S=ph.canonical(2),
        H=ph.formula("k*(q1 - q2)**2/2 + (p1**2 + p2**2)/2", k=ph.Parameter(1.0)),
    )


def own(coefficient: str = "c") -> ph.Effect:
    term = ph.formula(f"{coefficient}*q1*q2", **{coefficient: ph.Parameter()})
    return ph.Effect("own", "F", "p1", term)


def listed(choice: EffectChoice, model: ph.Model) -> list[str]:
    return [str(effect) for effect in choice.checked(model).candidates(model)]


def test_without_a_choice_the_whole_catalogue_is_considered() -> None:
    model = two_masses()
    assert EffectChoice().checked(model).candidates(model) == ph.catalogue(model)


def test_a_name_means_every_equation_that_can_have_the_effect() -> None:
    choice = EffectChoice(["coulomb friction", "gap on p2", own()])
    assert listed(choice, two_masses()) == [
        "coulomb friction on p1",
        "coulomb friction on p2",
        "gap on p2",
        "own on p1",
    ]


def test_an_effect_chosen_twice_is_considered_once() -> None:
    choice = EffectChoice(["gap on p2", "gap", *ph.catalogue(two_masses())])
    assert sorted(listed(choice, two_masses())) == sorted(
        str(effect) for effect in ph.catalogue(two_masses())
    )


@pytest.mark.parametrize(
    ("without", "left"),
    [
        (["coulomb friction"], {"gap on p1", "gap on p2", "own on p1"}),
        (
            ["gap on p2", "own"],
            {"gap on p1", "coulomb friction on p1", "coulomb friction on p2"},
        ),
        (
            ["gap", own("d")],  # by its name and place
            {"coulomb friction on p1", "coulomb friction on p2"},
        ),
    ],
)
def test_what_is_left_out_is_never_considered(without: list[Any], left: set) -> None:
    choice = EffectChoice(["gap", "coulomb friction", own()], without)
    assert set(listed(choice, two_masses())) == left


def test_an_effect_that_was_added_since_is_not_offered_again() -> None:
    model = two_masses()
    choice = EffectChoice(["coulomb friction", "stribeck friction on p1", own()])
    choice = choice.checked(model)
    larger = model.add("coulomb friction", "p1").add(own())
    found = choice.candidates(larger)
    assert [str(effect) for effect in found] == [
        "coulomb friction on p2",
        "stribeck friction on p1",
    ]
    assert len(found[1].term) == 1  # the rise alone: the model has the level


def test_an_effect_of_the_catalogue_changes_with_what_the_model_has() -> None:
    model = two_masses()
    by_object = EffectChoice(ph.catalogue(model)).checked(model)
    larger = model.add("coulomb friction", "p1")
    found = by_object.candidates(larger)
    (stribeck,) = (e for e in found if str(e) == "stribeck friction on p1")
    larger.add(stribeck)


@pytest.mark.parametrize(
    ("effects", "without", "said"),
    [
        (["coulom friction"], (), "in effects is not in .* mean 'coulomb friction'"),
        (None, ["gap on p3"], "'gap on p3' in without .* Did you mean 'gap on p"),
        (None, ["overflow"], "'overflow' in without is not in the catalogue"),
        (None, [own()], "'own on p1' in without is not in the catalogue"),
        (None, "gap", "without='gap' must be a list"),
        (own(), (), "must be a list of effects or of their names"),
        ([3], (), "3 in effects is neither an Effect nor the name of one"),
    ],
)
def test_what_no_equation_can_have_is_refused(
    effects: Any, without: Any, said: str
) -> None:
    with pytest.raises(ph.ModelError, match=said):
        EffectChoice(effects, without).checked(two_masses())


def test_an_effect_of_ones_own_that_the_model_has_is_refused() -> None:
    with pytest.raises(ph.ModelError, match="'own on p1' in effects stands in the"):
        EffectChoice([own()]).checked(two_masses().add(own()))


def test_a_narrower_choice_takes_other_effects_and_leaves_more_out() -> None:
    choice = EffectChoice(["gap", "hysteresis"], ["gap on p1"])
    assert choice.narrowed(None, ["hysteresis"]) == EffectChoice(
        ["gap", "hysteresis"], ["gap on p1", "hysteresis"]
    )
    assert choice.narrowed(["gap"], ()) == EffectChoice(["gap"], ["gap on p1"])

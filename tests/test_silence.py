"""No name where nothing is missing but what every model is inexact by."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.comparison.model_selection import is_like_noise
from phsi_opt.diagnosis.doubts import fitted_size, found_by_chance, kinds_of
from phsi_opt.later import Later
from phsi_opt.model_error.standard_errors import Source
from phsi_opt.screening.effect_size import Size
from problems.field_machines.cases import draw
from problems.field_machines.kinds import KINDS

STIFFNESSES = ("linear stiffness", "gravity torque", "cubic stiffness")
OTHERS = (
    "viscous damping",
    "coulomb friction",
    "position-dependent damping",
    "constant force",
    "drifting force",
)
DRAGS = ("viscous damping", "quadratic drag", "cubic drag")


@cache
def diagnosed(kind: str, seed: int, *names: str) -> ph.Diagnosis:
    """The diagnosis of a field machine's model, with these candidates."""
    case = draw(KINDS[kind], seed)
    assert not case.places
    fit = ph.identify(case.model, case.train)
    effects = [f"{name} on p" for name in names]
    return ph.diagnose(fit, case.train, case.test, effects=effects)


def test_what_a_random_force_looks_like_is_not_named() -> None:
    # A pendulum goes over the top under a random force of 5 % of its own: on three
    # runs, and on a fourth, a spring explains four fifths of what that does.
    found = diagnosed("nothing", 158, *STIFFNESSES, *OTHERS)
    (effect,) = found.proposed
    fit = found.proposed_fit
    assert fit is not None and fit.std_error_source == Source.DISTURBANCES
    size = fitted_size(found.fit, fit, effect)
    assert size.z > 3 and size.freedom < 10
    assert found.findings == ()
    assert found.verdict == ph.Verdict.UNEXPLAINED
    assert "by chance (p-value of the size, by Student" in found.ranking[0].lost


def test_the_more_kinds_of_candidates_the_clearer_a_size_must_be() -> None:
    found = diagnosed("nothing", 158, *STIFFNESSES)
    fit = found.proposed_fit
    assert fit is not None
    (effect,) = found.proposed
    known = replace(fit.uncertainty.value, covariance=fit.covariance / 9)
    clearer = replace(fit, uncertainty=Later.known(known))
    p_value = fitted_size(found.fit, clearer, effect).p_value
    most = int(0.05 / p_value)
    assert most > 3
    assert found_by_chance(found.fit, [(effect, clearer)], most) == ""
    assert found_by_chance(found.fit, [(effect, clearer)], most + 1) != ""
    # Of those that do as well, the clearest counts.
    members = [(effect, fit), (effect, clearer)]
    assert found_by_chance(found.fit, members, most) == ""


def test_laws_of_one_family_are_one_kind_of_candidate() -> None:
    case = draw(KINDS["nothing"], 158)
    by_name = {one.name: one for one in ph.catalogue(case.model)}
    drags = [by_name[name] for name in DRAGS]
    assert len(kinds_of(drags)) == 1
    assert len(kinds_of([*drags, by_name["coulomb friction"]])) == 2


def test_a_loss_can_only_take_energy_so_its_p_value_is_one_sided() -> None:
    case = draw(KINDS["short_run"], 517)
    fit = ph.identify(case.model, case.train)
    effects = ["viscous damping on p"]
    found = ph.diagnose(fit, case.train, case.test, effects=effects)
    refit = found.proposed_fit
    assert refit is not None and refit.std_error_source != Source.NOISE
    (effect,) = found.proposed
    p_value = fitted_size(fit, refit, effect).p_value
    most = int(0.05 / (p_value / 2))
    assert most > int(0.05 / p_value) > 1
    assert found_by_chance(fit, [(effect, refit)], most) == ""
    assert found_by_chance(fit, [(effect, refit)], most + 1) != ""


def test_what_the_noise_hid_is_not_named_unless_it_is_very_clear() -> None:
    # A fall whose free run is off by noise alone: a random function of the states
    # changes it by one noise, the drag by a third of that.
    found = diagnosed("falling", 141, *DRAGS)
    assert found.base.rmse < 1.1 * found.base.noise_floor
    first = found.ranking[0]
    assert 3 < first.coefficient / first.std_error < 8
    assert found.findings == ()
    assert "not clear enough where other causes may act" in first.lost


def test_a_constant_force_below_the_noise_is_not_named() -> None:
    # Off by 4 % more than noise, and not white: a random function of the states.
    found = diagnosed("nothing", 239, "constant force")
    assert not is_like_noise(ph.compare(found.fit, found.data))
    assert found.findings == ()
    assert "not clear enough where other causes may act" in found.ranking[0].lost


def test_what_leaves_noise_in_training_must_explain_the_data_held_out_too() -> None:
    # The clipping of a sensor takes what little is left of three falls, and a fifth of
    # the error of a fourth.
    case = draw(KINDS["falling"], 204)
    fit = ph.identify(case.model, case.train)
    found = ph.diagnose(fit, case.train, case.test, effects=["sensor clipping on h"])
    first = found.ranking[0]
    assert 0.1 < first.share < 0.3 and first.trained is not None
    assert is_like_noise(first.trained)
    assert found.verdict == ph.Verdict.UNEXPLAINED and found.findings == ()


@pytest.mark.parametrize(
    ("freedom", "p_value"),
    [
        (1.0, 1 - 2 / np.pi * np.arctan(2.0)),
        (2.0, 1 - 2 / np.sqrt(6.0)),
        (np.inf, 0.04550026),
    ],
)
def test_the_p_value_of_a_size_is_that_of_students_t(
    freedom: float, p_value: float
) -> None:
    size = Size(-0.6, 0.3, freedom=freedom)
    assert size.p_value == pytest.approx(p_value)

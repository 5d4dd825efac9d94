"""Why what stands in for an effect from outside the catalogue is not named."""

import pytest

import phsi_opt as ph
from phsi_opt.comparison.model_selection import is_like_noise, is_white_noise
from problems.hidden_effects.cases import draw
from problems.hidden_effects.rows import ROWS


def stood_in(seed: int, *effects: str) -> ph.Diagnosis:
    """The diagnosis of a machine with an effect from outside, by these alone."""
    case = draw(ROWS["outside"], seed)
    fit = ph.identify(case.model, case.train)
    return ph.diagnose(fit, case.train, case.test, effects=effects)


@pytest.mark.parametrize(
    ("seed", "effect", "against"),
    [
        pytest.param(
            2016,
            "constant force on p",
            "the force that remains is 22 % of the motion's own, more than models err",
            id="damping in one direction",
        ),
        pytest.param(
            2004,
            "cubic stiffness on p",
            "is not clear enough: a term of the energy bends to whatever force goes",
            id="impact",
        ),
    ],
)
def test_what_imitates_an_effect_from_outside_is_near_and_not_named(
    seed: int, effect: str, against: str
) -> None:
    found = stood_in(seed, effect)
    assert found.verdict == ph.Verdict.UNEXPLAINED and found.findings == ()
    assert against in found.reason and against in found.ranking[0].lost
    assert found.ranking[0].share > 0.5
    assert [str(one) for one in found.proposed] == [effect]


def test_what_an_effect_leaves_is_no_noise_that_lasts() -> None:
    # The spring leaves what looks like noise of the sensor that lasts for two samples.
    found = stood_in(2010, "cubic stiffness on p")
    first = found.ranking[0]
    assert first.trained is not None
    assert is_like_noise(first.trained) and not is_white_noise(first.trained)
    assert not first.leaves_noise
    assert found.findings == ()


def test_two_springs_that_are_needed_together_stand_for_another_law() -> None:
    found = stood_in(2129, "gravity torque on p", "cubic stiffness on p")
    assert "may together stand for one force that depends" in found.reason
    assert len(found.proposed) == 1
    (finding,) = found.findings
    assert finding.family == "a force that depends on the position"
    assert {effect.name for effect in finding.effects} == {
        "gravity torque",
        "cubic stiffness",
    }
    pair = next(one for one in found.ranking if one.partner is not None)
    assert abs(pair.coefficient) > 10 * abs(finding.coefficient)

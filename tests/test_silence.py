"""No name where nothing is missing but what every model is inexact by."""

import pytest

import phsi_opt as ph
from problems.battery.draw import KINDS, draw

STIFFNESSES = ("linear stiffness", "gravity torque", "cubic stiffness")
OTHERS = (
    "viscous damping",
    "coulomb friction",
    "position-dependent damping",
    "constant force",
    "drifting force",
)
DRAGS = ("viscous damping", "quadratic drag", "cubic drag")


def diagnosed(kind: str, seed: int, *effects: str) -> ph.Diagnosis:
    """The diagnosis of a field machine's model, with these candidates."""
    case = draw(KINDS[kind], seed)
    assert not case.places
    fit = ph.identify(case.model, case.train)
    return ph.diagnose(fit, case.train, case.test, effects=effects)


@pytest.mark.parametrize(
    ("kind", "seed", "effects"),
    [
        # A pendulum goes over the top under a random force of 5 % of its own: a spring
        # explains four fifths of what that does.
        pytest.param("nothing", 158, (*STIFFNESSES, *OTHERS), id="a random force"),
        # A fall whose free run is off by noise alone.
        pytest.param("falling", 141, DRAGS, id="less than the noise"),
    ],
)
def test_what_a_random_force_does_is_not_named(
    kind: str, seed: int, effects: tuple[str, ...]
) -> None:
    found = diagnosed(kind, seed, *(f"{name} on p" for name in effects))
    assert found.findings == () and found.proposed == ()
    assert found.verdict in (ph.Verdict.NOTHING_MISSING, ph.Verdict.UNEXPLAINED)


def test_a_sensor_is_not_blamed_for_the_little_that_is_left_in_training() -> None:
    # The clipping of a sensor takes what little is left of three falls, and a fifth of
    # the error of a fourth.
    found = diagnosed("falling", 204, "sensor clipping on h")
    assert found.findings == ()

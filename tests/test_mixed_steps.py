"""Steps that leave a share of the error each: mixed, they end where they lead."""

import numpy as np

from phsi_opt.optimization.mixed_steps import MOST_MIXED, MixedSteps

OPTIMUM = np.array([1.0, -2.0, 0.5])
# Of the error: one direction goes to and fro, one creeps.
LEFT = np.diag([-0.9, 0.8, 0.1])


def step_at(z: np.ndarray) -> np.ndarray:
    return (LEFT - np.eye(3)) @ (z - OPTIMUM)


def test_three_directions_are_learned_from_four_steps() -> None:
    mixed = MixedSteps()
    z = np.zeros(3)
    for _ in range(4):
        z = mixed.end(step_at(z), z + step_at(z), lambda v: 2 * v)
    np.testing.assert_allclose(z, OPTIMUM, atol=1e-9)
    # Of what mixing takes off at once, plain steps would leave so much each.
    assert 0.7 < mixed.share <= 0.9


def test_what_is_forgotten_is_not_mixed() -> None:
    mixed = MixedSteps()
    z = np.zeros(3)
    mixed.end(step_at(z), z + step_at(z), np.asarray)
    mixed.forget()
    end = z + step_at(z)
    np.testing.assert_array_equal(mixed.end(step_at(z), end, np.asarray), end)


def test_the_end_may_have_more_parts_than_the_step() -> None:
    """Multipliers go along in the same shares."""
    mixed = MixedSteps()
    z = np.zeros(3)
    for _ in range(4):
        end = z + step_at(z)
        both = mixed.end(step_at(z), np.r_[end, 3 * end], np.asarray)
        z = both[:3]
    np.testing.assert_allclose(both[3:], 3 * OPTIMUM, atol=1e-8)


def test_steps_that_do_not_change_are_left_as_they_are() -> None:
    mixed = MixedSteps()
    for _ in range(2 * MOST_MIXED):
        end = mixed.end(np.ones(3), OPTIMUM, np.asarray)
    np.testing.assert_array_equal(end, OPTIMUM)

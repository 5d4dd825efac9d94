"""The benchmark of starts far off: its machines, and how it judges a fit."""

import numpy as np
import pandas as pd
import pytest

from problems.benchmarks import basins
from problems.benchmarks.basin_machines import KINDS, OTHERS_OFF, UNREST, draw_case


@pytest.mark.parametrize("kind", KINDS)
def test_a_machine_is_the_same_whenever_it_is_drawn_and_starts_as_far_off_as_said(
    kind: str,
) -> None:
    case = draw_case(kind, 3, off=0.7)
    again = draw_case(kind, 3, off=0.7)
    np.testing.assert_array_equal(
        case.data.trajectories[0].x, again.data.trajectories[0].x
    )
    for name, value in case.truth.items():
        distance = abs(case.model.values[name] / value - 1)
        if name in case.frequency_parameters:
            assert distance == pytest.approx(0.7)
        else:
            assert distance <= OTHERS_OFF


def test_a_hidden_force_changes_the_motion_and_a_pendulum_never_turns_over() -> None:
    for seed in range(2):
        plain = draw_case("pendulum", seed)
        forced = draw_case("pendulum", seed, lacks=UNREST)
        x = plain.data.trajectories[0].x[:, 0] - plain.noise[:, 0]
        pushed = forced.data.trajectories[0].x[:, 0] - forced.noise[:, 0]
        assert max(np.max(np.abs(x)), np.max(np.abs(pushed))) <= np.pi
        assert np.std(pushed - x) > 1e-3


def test_one_machine_from_half_off_is_judged_right_by_its_own_truth() -> None:
    setting = basins.Setting(0.5, basins.NOTHING, 1)
    row = basins.row("oscillator", 1, setting)
    assert row["right"]
    assert row["frequency_error"] == pytest.approx(0.0, abs=1e-3)
    frame = pd.DataFrame([row, {**row, "kind": "pendulum", "right": False}])
    counted = basins.summary(frame).set_index("machine")
    assert counted["right"].to_dict() == {
        "oscillator": 1,
        "pendulum": 0,
        "two masses": 0,
        "all": 1,
    }
    assert "## Those that are wrong" in basins.page(frame)


def test_a_random_force_that_would_turn_a_pendulum_over_is_halved() -> None:
    case = draw_case("pendulum", 5001, off=0.7, lacks=UNREST)
    assert not case.is_driven
    x = case.data.trajectories[0].x[:, 0] - case.noise[:, 0]
    assert np.max(np.abs(x)) <= np.pi

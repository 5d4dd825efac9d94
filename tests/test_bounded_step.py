"""The best step within bounds: that of the best face, none where data are silent."""

from itertools import product

import numpy as np
import pytest

from phsi_opt.optimization.bounded_step import Room, bounded_step

ANYWHERE = Room(np.full(3, -np.inf), np.full(3, np.inf))


def positive(rng: np.random.Generator) -> np.ndarray:
    root = rng.normal(size=(5, 3)) * [1.0, 30.0, 1e-3]
    return root.T @ root


@pytest.mark.parametrize("seed", range(30))
def test_it_is_the_best_of_all_faces_of_the_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    C = positive(rng)
    full = rng.normal(size=3)
    pull = C @ full
    # Some begin at a bound.
    sizes = rng.uniform(0.1, 1.0, (2, 3)) * rng.integers(0, 2, (2, 3))
    room = Room(-sizes[0], sizes[1] + 0.05)
    found = bounded_step(C, pull, room)
    assert np.all(found >= room.below) and np.all(found <= room.above)

    def value(d: np.ndarray) -> float:
        return float(d @ C @ d / 2 - pull @ d)

    for face in product((None, 0, 1), repeat=3):
        d = np.where([side == 1 for side in face], room.above, room.below)
        free = [side is None for side in face]
        rest = pull - C @ np.where(free, 0.0, d)
        d[free] = np.linalg.solve(C[np.ix_(free, free)], rest[free])
        if np.all(d >= room.below) and np.all(d <= room.above):
            assert value(found) <= value(d) + 1e-9 * abs(value(full))


def test_without_a_bound_in_the_way_it_is_the_full_step() -> None:
    C = positive(np.random.default_rng(1))
    full = np.array([1.0, -2.0, 300.0])
    step = bounded_step(C, C @ full, ANYWHERE)
    np.testing.assert_allclose(step, full, rtol=1e-6)


def test_a_bound_is_reached_exactly() -> None:
    room = Room(np.array([-0.1, -np.inf]), np.array([0.3, np.inf]))
    step = bounded_step(np.eye(2), np.array([-1.0, 1.0]), room)
    np.testing.assert_array_equal(step, [-0.1, 1.0])


def test_what_data_are_silent_about_does_not_move_another_one_to_its_bound() -> None:
    C = np.diag([1.0, 1e-16, 2.0])
    room = Room(np.array([0.0, -1.0, -1.0]), np.full(3, np.inf))
    step = bounded_step(C, np.array([-1.0, 1e-17, 1.0]), room)
    np.testing.assert_array_equal(step, [0.0, 0.0, 0.5])


def test_a_parameter_without_room_stays() -> None:
    room = Room(np.array([0.0, -1.0]), np.array([0.0, 1.0]))
    step = bounded_step(np.array([[2.0, 1.0], [1.0, 2.0]]), np.ones(2), room)
    np.testing.assert_allclose(step, [0.0, 0.5])


def test_no_parameters_no_step() -> None:
    none = np.zeros(0)
    assert len(bounded_step(np.zeros((0, 0)), none, Room(none, none))) == 0

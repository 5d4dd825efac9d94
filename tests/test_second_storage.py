"""A storage that nobody measures: a room with walls, simulated without the package."""

from functools import cache

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim

import phsi_opt as ph
from phsi_opt.model.laws import is_second_storage

AIR, WALLS = 2.0, 10.0  # capacities
INSIDE, OUTSIDE = 2.0, 0.5  # conductances: air to walls, air to outdoors
SAMPLES = np.linspace(0.0, 80.0, 401)
NOISE = 0.02
WINDOWED = INSIDE / AIR
FOLLOWING = WALLS / INSIDE


def room() -> ph.FirstOrder:
    """Air and walls as one capacity."""
    rate = ph.formula(
        "(P - G*(T - To))/C",
        C=ph.Parameter(8.0, lower=0.1),
        G=ph.Parameter(1.0, lower=0),
    )
    return ph.FirstOrder(["T"], {"T": rate}, inputs=["P", "To"], kind="thermal")


def heated(walls: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Temperature and inputs, (n_samples, 1) and (n_samples, 2); no walls: walls=0."""
    rng = np.random.default_rng(seed)
    power = np.repeat(rng.uniform(0, 6, 41), 10)[: len(SAMPLES)]
    outdoors = 2 + np.sin(2 * np.pi * SAMPLES / 24)
    inside = INSIDE if walls else 0.0
    A = np.array(
        [
            [-(OUTSIDE + inside) / AIR, inside / AIR],
            [inside / max(walls, 1.0), -inside / max(walls, 1.0)],
        ]
    )
    B = np.array([[1 / AIR, OUTSIDE / AIR], [0.0, 0.0]])
    u = np.column_stack([power, outdoors])
    step = SAMPLES[1] - SAMPLES[0]
    system = cont2discrete((A, B, np.eye(2), np.zeros((2, 2))), step, method="zoh")
    _, y, _ = dlsim(system, u, x0=[3.0, 3.0])
    return y[:, :1] + NOISE * rng.normal(size=(len(SAMPLES), 1)), u


@cache
def records(walls: float) -> tuple[ph.Measurements, ph.Measurements]:
    """Two runs to fit, one to judge."""
    runs = [heated(walls, seed) for seed in range(3)]
    data = ph.Measurements.from_arrays(
        [SAMPLES] * 3,
        [x for x, _ in runs],
        [u for _, u in runs],
        states=["T"],
        inputs=["P", "To"],
        hold="zero",
    )
    return data[:2], data[2:]


def test_walls_that_nobody_measures_are_named_and_measured() -> None:
    train, test = records(WALLS)
    study = ph.Study(room(), train, held_out=test)
    found = study.diagnose()
    assert found.verdict == ph.Verdict.NAMED
    (finding,) = found.findings
    assert finding.effects[0].name == "second heat storage"
    study.auto(max_steps=2)
    values = study.fit.values
    errors = study.fit.parameters.set_index("name")["std_error"]
    exchange = values["second_heat_storage_T"]
    following = values["following_time_T"]
    assert abs(exchange - WINDOWED) < 4 * errors["second_heat_storage_T"]
    assert abs(following - FOLLOWING) < 4 * errors["following_time_T"]
    # The capacity that stays is the air's.
    assert abs(values["C"] - AIR) < 4 * errors["C"]
    assert study.diagnose().verdict == ph.Verdict.NOTHING_MISSING


def test_a_room_without_walls_gets_none() -> None:
    train, test = records(0.0)
    found = ph.Study(room(), train, held_out=test).diagnose()
    assert found.verdict == ph.Verdict.NOTHING_MISSING
    assert not found.findings


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


def test_bodies_and_tanks_have_none() -> None:
    for kind in ("mechanical", "hydraulic"):
        model = ph.FirstOrder(["x"], {"x": ph.formula("-c*x", c=1.0)}, kind=kind)
        assert not any(is_second_storage(one) for one in ph.catalogue(model))


def test_a_second_storage_that_follows_at_once_changes_nothing_at_rest() -> None:
    model = room().add("second heat storage", "T")
    model = model.with_values({"second_heat_storage_T": 3.0, "following_time_T": 2.0})
    rates = model.rhs()([1.5, 1.5], [0.75, 0.0], 0.0, model.theta).full().ravel()
    alone = room().rhs()([1.5], [0.75, 0.0], 0.0, room().theta).full().ravel()
    np.testing.assert_allclose(rates, [alone[0], 0.0], atol=1e-12)

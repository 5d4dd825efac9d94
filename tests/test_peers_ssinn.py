"""SSINN: its scheme against SciPy, recovery of a separable energy, refusals."""

from typing import Any

import numpy as np
import pytest
import torch

import phsi_opt as ph
from problems.peers.ssinn import SymplecticDescent, _Flow, separable, ssinn
from problems.thesis.systems import SYSTEMS

HENON = SYSTEMS["henon_heiles"]
TRUTH = HENON.truth


def error_of_one_interval(h: float, steps: int) -> float:
    """Largest error of the scheme at the true coefficients over the interval h, against
    DOP853 at 1e-12.
    """
    model = separable(HENON.states, ["q1", "q2"], ["p1", "p2"], 3)
    theta = torch.tensor(
        [TRUTH.get(name, 0.0) for name in model.entries], dtype=torch.float64
    )
    flow = _Flow(
        model, ["q1", "q2"], ["p1", "p2"], SymplecticDescent(steps=steps), torch.float64
    )
    x0 = np.array([0.3, -0.2, 0.1, 0.25])
    x1 = HENON.solve(x0, np.array([0.0, h]))[-1]
    q0, p0, q1, p1 = (
        torch.tensor(v[None, :]) for v in (x0[:2], x0[2:], x1[:2], x1[2:])
    )
    tables = [p0, q0, q1, p1, torch.full((1, 1), h, dtype=torch.float64)]
    return float(flow.loss(theta, tables))


def test_the_scheme_is_of_fourth_order() -> None:
    errors = [error_of_one_interval(h, 1) for h in (0.1, 0.05)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(
        5, abs=0.4
    )  # one step: order plus one
    assert error_of_one_interval(0.1, 2) < errors[0] / 10


@pytest.fixture(scope="module")
def clean() -> Any:
    data = HENON.data(0, noise=0.0, n=300)
    return ssinn(
        data,
        ["q1", "q2"],
        ["p1", "p2"],
        3,
        SymplecticDescent(epochs=50, learning_rate=3e-2, steps=1),
    )


def test_clean_data_give_the_separable_energy(clean: Any) -> None:
    assert (
        max(abs(value - TRUTH.get(name, 0.0)) for name, value in clean.values.items())
        < 1e-3
    )  # 500 steps
    assert set(TRUTH) < set(clean.values)
    assert len(clean.values) == 18
    assert clean.history["loss"].iloc[-1] < 1e-3 * clean.history["loss"].iloc[0]


def test_the_result_is_a_model_like_any_other(clean: Any) -> None:
    t = np.linspace(0, 2, 21)
    np.testing.assert_allclose(
        clean.simulate(t, [0.3, 0, 0, 0.3]),
        HENON.solve(np.array([0.3, 0, 0, 0.3]), t),
        atol=0.01,
    )
    assert (
        clean.equations()[0].startswith("dq1/dt = ")
        and clean.method == "SSINN"
        and "SSINN" in str(clean)
    )


def test_states_may_stand_in_any_order() -> None:
    model = separable(["p", "q"], ["q"], ["p"], 2)
    assert model.S == ((0.0, -1.0), (1.0, 0.0))


def test_seeds_are_reproducible_to_the_bit_and_differ() -> None:
    data = HENON.data(0, n=60)
    one, again, other = (
        ssinn(
            data,
            ["q1", "q2"],
            ["p1", "p2"],
            2,
            SymplecticDescent(epochs=2),
            seed=s,
        )
        for s in (0, 0, 1)
    )
    assert one.values == again.values
    assert one.values != other.values


def test_what_does_not_pair_up_or_makes_no_sense_is_refused() -> None:
    data = HENON.data(0, n=10)
    with pytest.raises(ph.ModelError, match="do not pair up the states"):
        ssinn(data, ["q1", "q2"], ["p1"], 3)
    for settings, message in (
        ({"steps": 0}, "steps=0"),
        ({"decay": ((0.5, 0.1), (0.4, 0.01))}, "decay=.*increasing"),
        ({"dtype": "half"}, "dtype='half'"),
    ):
        with pytest.raises(ph.ModelError, match=message):
            SymplecticDescent(**settings)


def test_the_schedule_falls_at_its_shares() -> None:
    settings = SymplecticDescent(epochs=6, learning_rate=1.0)
    assert [settings.rate(epoch) for epoch in range(1, 7)] == [
        1.0,
        1.0,
        0.1,
        0.01,
        0.001,
        0.001,
    ]

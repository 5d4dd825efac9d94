"""A larger model is never kept that fits worse than the smaller one it contains."""

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.errors import SolveError
from phsi_opt.study import record


def plate(target: float, seed: int, n: int = 200, fine: int = 10) -> np.ndarray:
    """Temperature and power of a plate that a switch keeps warm; the sensor is late."""
    rng = np.random.default_rng(seed)
    late = [0.0] * fine
    plate = sensor = 20.0
    is_on = True
    rows = []
    for _ in range(n):
        is_on = sensor < target + (2 if is_on else -2)
        power = 55.0 * is_on
        rows.append((sensor + 0.1 * rng.standard_normal(), power))
        for _ in range(fine):
            late.append(power)
            plate += (late.pop(0) - 0.2 * (plate - 20)) / 9 / fine
            sensor += (plate - sensor) / 3 / fine
    return np.array(rows)


def study_of(seeds: tuple[int, ...]) -> ph.Study:
    runs = [plate(110 + seed, seed) for seed in seeds]
    data = ph.Measurements.from_arrays(
        [np.arange(200.0)] * len(runs),
        [run[:, :1] for run in runs],
        [run[:, 1:] for run in runs],
        states=["T"],
        inputs=["W"],
        hold="zero",
        units={"t": "s", "T": "degC", "W": "W"},
    )
    loss = ph.Parameter(0.1, lower=0, unit="W/K")
    capacity = ph.Parameter(15.0, lower=1, unit="J/K")
    rate = ph.formula("(W - h*(T-20))/C", h=loss, C=capacity)
    model = ph.FirstOrder(["T"], {"T": rate}, inputs=["W"], kind="thermal")
    return ph.Study(model, data)


def test_an_effect_that_the_data_do_not_show_leaves_the_error_as_it_was() -> None:
    study = study_of((11, 31))
    study.add("second heat storage", "T")
    before, after = study.history["train_rmse"]
    assert after <= before * (1 + 1e-6)


def test_a_worse_fit_is_refused_in_words(monkeypatch) -> None:
    study = study_of((12,))
    monkeypatch.setattr(record, "is_worse", lambda *_: True)
    with pytest.raises(
        SolveError, match="input lag in the equation of T is not added: with it no fit"
    ):
        study.add("input lag", "T")
    assert len(study.steps) == 1

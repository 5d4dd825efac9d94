"""Several laws at once, and laws that only a fit of its own shows."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import phsi_opt as ph
from tests.systems import pair, positive


def swing(amplitude: float, seed: int) -> ph.Measurements:
    """A swing with two losses and a stiffening spring; its position is measured."""
    t = np.arange(0, 30, 0.1)

    def rates(_: float, x: np.ndarray) -> list[float]:
        q, v = x
        return [v, -4 * q - 0.02 * v - 0.01 * v * abs(v) - 0.01 * q**3]

    x = solve_ivp(rates, (0, 30), [amplitude, 0.0], t_eval=t, rtol=1e-9, atol=1e-9).y
    q = x[0] + 0.005 * np.random.default_rng(seed).standard_normal(len(t))
    states = np.c_[q, np.full(len(t), np.nan)]
    return ph.Measurements.from_arrays([t], [states], states=["q", "p"])


LAWS = ("viscous damping", "quadratic drag", "cubic stiffness", "bouc-wen hysteresis")


def test_an_input_that_acts_late_is_found_from_a_fit_of_its_own() -> None:
    """Beside a force that does everything neither screening nor weighing sees it."""
    rng = np.random.default_rng(43)
    runs = []
    for length in (31, 23):
        power = 2.0 * (np.arange(240) // length % 2)
        late = np.r_[np.zeros(8), power[:-8]]
        heat = np.zeros(240)
        for k in range(239):
            heat[k + 1] = np.exp(-0.05) * heat[k] + (1 - np.exp(-0.05)) * 5 * late[k]
        runs.append((heat + 0.01 * rng.standard_normal(240), power))
    data = ph.Measurements.from_arrays(
        [np.arange(240.0)] * 2,
        [heat[:, None] for heat, _ in runs],
        [power[:, None] for _, power in runs],
        states=["T"],
        inputs=["P"],
        hold="zero",
    )
    start = {"a": ph.Parameter(0.1, lower=0), "b": ph.Parameter(0.1, lower=0)}
    model = ph.FirstOrder(["T"], {"T": ph.formula("b*P - a*T", **start)}, inputs=["P"])
    fit = ph.identify(model, data[:1])
    effects = ["input delay", "sensor offset", "quadratic drag"]
    found = ph.diagnose(fit, data[:1], held_out=data[1:], effects=effects)
    (finding,) = found.findings
    assert str(finding.effects[0]) == "input delay on T"
    assert finding.coefficient == pytest.approx(8.0, abs=0.1)


def test_laws_named_together_are_added_one_by_one_as_the_error_falls() -> None:
    model = pair("k*q**2/2 + p**2/2", k=positive(3.0))
    train, test = swing(4.0, 41), swing(5.0, 42)
    study = ph.Study(model, train, held_out=test, effects=list(LAWS[:3]))
    found = study.diagnose()
    assert {str(one) for one in found.proposed} == {f"{law} on p" for law in LAWS[:3]}
    study.add()
    history = study.history
    assert list(history["effect"]) == ["base model", *map(str, found.proposed)]
    assert list(history["held_out_rmse"]) == sorted(history["held_out_rmse"])[::-1]
    assert study.fit is found.proposed_fit
    study.undo()
    assert study.added == found.proposed[:2]

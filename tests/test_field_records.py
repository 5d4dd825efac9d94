"""Records as people take them: what is hidden in them is told, and nothing else.

A clip with a wrong zero, a coast-down, runs whose sensor was mounted anew each time,
times in hours.
"""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

import phsi_opt as ph


def solved(rates: Callable, t: np.ndarray, x0: list[float], step: float) -> np.ndarray:
    """The first state."""
    found = solve_ivp(rates, (0, t[-1]), x0, t_eval=t, rtol=1e-8, max_step=step)
    return np.asarray(found.y[0])


def only_first(y: np.ndarray) -> np.ndarray:
    """A measured state, and one that nobody measured, (n, 2)."""
    return np.column_stack([y, np.full(len(y), np.nan)])


def test_the_wrong_zero_of_a_clip_is_a_force_or_a_sensor_and_no_spring() -> None:
    rng = np.random.default_rng(20)
    t = np.arange(800) / 25

    def rates(_: float, x: np.ndarray) -> list[float]:
        drag = 0.02 * x[1] + 0.005 * x[1] * abs(x[1])
        return [x[1], -24.0 * np.sin(x[0]) - drag]

    y = solved(rates, t, [0.9, 0.0], 0.02)
    # Neighbours of the noise have a correlation of 0.6.
    noise = lfilter([1.0], [1.0, -0.6], 0.006 * rng.normal(size=len(t)))
    y = y + 0.009 + 0.014 * np.exp(-t / 4) + noise
    data = ph.Measurements.from_arrays(
        [t], [only_first(y)], states=["q", "w"], units={"t": "s", "q": "rad"}
    )
    train, test = data.split(0.6)
    model = ph.PseudoHamiltonian(
        states=["q", "w"],
        S=ph.canonical(1),
        H=ph.formula("w**2/2 - a*cos(q)", a=ph.Parameter(30.0, lower=0)),
        R=ph.damping("w"),
    )
    found = ph.diagnose(ph.identify(model, train), train, held_out=test)
    (finding,) = found.findings
    names = {str(effect) for effect in finding.effects}
    assert names == {"constant force on w", "sensor offset on q"}


@pytest.mark.slow
def test_a_coast_down_lacks_rolling_resistance_and_no_step_makes_it_worse() -> None:
    rng = np.random.default_rng(21)
    times, speeds = [], []
    for slope in (0.005, -0.005, 0.005, -0.005):
        t = np.arange(0.0, 220.0, 2.0)

        def rate(s: float, v: np.ndarray, slope: float = slope) -> np.ndarray:
            rolling = 0.03 * np.tanh(v / 0.02)
            wind = 0.015 * np.cos(2 * np.pi * s / 35)
            return -7e-4 * v * abs(v) - rolling - slope + wind

        v = solved(rate, t, [8.0], 1.0)
        end = int(np.argmax(v < 0.3)) if (v < 0.3).any() else len(v)
        times.append(t[:end])
        speeds.append((v + 0.25 * rng.normal(size=len(v)))[:end, None])
    data = ph.Measurements.from_arrays(
        times, speeds, states=["v"], units={"t": "s", "v": "m/s"}
    )
    rate_of_air = ph.formula("-k*v*abs(v)", k=ph.Parameter(5e-4, lower=0))
    model = ph.FirstOrder(["v"], {"v": rate_of_air}, kind="mechanical")
    study = ph.Study(model, data[:2], held_out=data[2:])
    study.auto()
    errors = study.history["held_out_rmse"].to_numpy()
    assert np.all(errors[1:] < errors[:-1])
    assert study.added[0].name in ("coulomb friction", "constant force")


@pytest.mark.slow
def test_a_sensor_mounted_anew_for_each_run_hides_no_friction() -> None:
    rng = np.random.default_rng(22)
    t = np.arange(0, 8, 0.04)

    def rates(_: float, x: np.ndarray) -> list[float]:
        return [x[1], -12.0 * x[0] - 0.4 * x[1] - 0.9 * np.tanh(x[1] / 0.01)]

    shown = []
    for zero, start in ((0.2, 1.2), (-0.4, 2.0), (0.7, 1.7)):
        y = solved(rates, t, [start, 0.0], 0.01)
        shown.append(only_first(y + zero + 0.04 * rng.normal(size=len(t))))
    data = ph.Measurements.from_arrays([t] * 3, shown, states=["q", "p"])
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/2", k=ph.Parameter(6.0, lower=0)),
        R=ph.damping("p"),
        sensor={"q": ph.formula("b", b=ph.Parameter(0.0, per_trajectory=True))},
    )
    train, test = data[:2], data[2:]
    rivals = ["coulomb friction", "quadratic drag", "constant force", "sensor gain"]
    fit = ph.identify(model, train)
    found = ph.diagnose(fit, train, held_out=test, effects=rivals)
    (finding,) = found.findings
    assert str(finding.effects[0]) == "coulomb friction on p"
    assert finding.coefficient == pytest.approx(0.9, abs=0.06)
    assert found.ranking[0].held_out_rmse < 1.1 * 0.04


def test_a_delay_in_hours_is_told_in_hours() -> None:
    rng = np.random.default_rng(23)
    t = np.arange(0, 60, 0.5)
    heating = np.where((t // 6) % 2 == 0, 1800.0, 0.0)

    def rate(s: float, x: np.ndarray) -> np.ndarray:
        return (5 - x) / 10 + np.interp(s - 1.5, t, heating) / 1000

    y = solved(rate, t, [9.0], 0.1) + 0.05 * rng.normal(size=len(t))
    u = np.column_stack([heating, 5 + 0 * t])
    units = {"t": "h", "T": "degC", "P": "W", "Te": "degC"}
    data = ph.Measurements.from_arrays(
        [t], [y[:, None]], [u], states=["T"], inputs=["P", "Te"], units=units
    )
    train, test = data.split(0.7)
    resistance = ph.Parameter(0.01, lower=0, unit="K/W")
    capacity = ph.Parameter(1100.0, lower=0, unit="J/degC")
    law = ph.formula("(Te - T)/(R*C) + P/C", R=resistance, C=capacity)
    model = ph.FirstOrder(["T"], {"T": law}, inputs=["P", "Te"], kind="thermal")
    rivals = ["input delay of P", "quadratic heat loss", "sensor offset"]
    fit = ph.identify(model, train)
    found = ph.diagnose(fit, train, held_out=test, effects=rivals)
    (finding,) = found.findings
    assert str(finding.effects[0]) == "input delay of P on T" and finding.unit == "h"
    assert abs(finding.coefficient - 1.5) < 4 * finding.std_error

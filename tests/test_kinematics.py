"""Nothing is missing in dx/dt = v, however the rest of the model is coupled to it."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import phsi_opt as ph
from phsi_opt.model.structure import forced_rows

T = np.linspace(0.0, 8.0, 121)


def records(
    rates: Callable[..., list[float]], *starts: list[float], **about: Any
) -> ph.Measurements:
    """Runs of which only the first state is seen."""
    random = np.random.default_rng(5)
    runs = []
    for start in starts:
        x = solve_ivp(rates, T[[0, -1]], start, t_eval=T, rtol=1e-9, atol=1e-9).y.T
        x += 0.005 * random.normal(size=x.shape)
        x[:, 1] = np.nan
        runs.append(x)
    return ph.Measurements.from_arrays([T] * len(runs), runs, **about)


def test_a_spring_written_with_its_velocity_is_diagnosed_as_one() -> None:
    def rates(_: float, x: list[float]) -> list[float]:
        return [x[1], -4.0 * x[0] - 0.5 * x[0] ** 2 - 0.1 * x[1]]

    starts = ([1.0, 0.0], [-0.7, 1.0], [0.4, -1.2])
    units = {"t": "s", "x": "m", "v": "m/s"}
    data = records(rates, *starts, states=["x", "v"], units=units)
    w, d = ph.Parameter(2.0, lower=0), ph.Parameter(0.2, lower=0)
    terms = {"x": ph.formula("v"), "v": ph.formula("-w*x - d*v", w=w, d=d)}
    fit = ph.identify(ph.FirstOrder(["x", "v"], terms), data[:2])
    assert fit.model.kind == {"x": "mechanical", "v": "mechanical"}
    found = ph.diagnose(fit, data[:2], data[2:])
    assert found.verdict == ph.Verdict.NAMED
    assert str(found.proposed[0]) == "quadratic stiffness on v"
    assert set(found.missing_force) == {"trajectory", "t", "v", "std_v"}
    assert not any("dx/dt" in sentence for sentence in found.sentences)


def test_units_of_a_piston_tell_that_its_place_is_kinematics() -> None:
    def rates(_: float, x: list[float]) -> list[float]:
        q, p, z = x
        return [p, -4.0 * q - 0.3 * p + 0.5 * z, -0.5 * p - 0.2 * z]

    starts = ([1.0, 0.0, 0.5], [-0.7, 1.0, 0.0])
    units = {"q": "m", "p": "kg m/s", "z": "kPa"}
    data = records(rates, *starts, states=["q", "p", "z"], units=units)
    model = ph.PseudoHamiltonian(
        states=["q", "p", "z"],
        S=[[0, 1, 0], [-1, 0, 0.5], [0, -0.5, 0]],
        H=ph.formula("k*q**2/2 + p**2/2 + z**2/2", k=ph.Parameter(3.0, lower=0)),
        R=ph.damping("p") | ph.damping("z"),
    )
    assert forced_rows(model) == (0, 1, 2)
    fit = ph.identify(model, data)
    assert forced_rows(fit.model) == (1, 2)
    assert abs(fit.values["k"] - 4.0) < 0.05

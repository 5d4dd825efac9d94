"""Two effects that a record cannot tell apart: the experiment that would, or that none
does.
"""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

import phsi_opt as ph
from phsi_opt.diagnosis.experiments import Separation, separating
from phsi_opt.simulation.simulate import free_run

NOISE = 0.02
SIGMA = np.array([NOISE, np.nan])
OFFSET = {"q": ph.formula("b", b=ph.Parameter(0.0))}
PUSH = {"p": ph.formula("f", f=ph.Parameter(0.0))}
Pair = tuple[ph.Fit, ph.Fit, ph.Measurements]


def hamiltonian(H: Any, R: Any, **slots: Any) -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(states=["q", "p"], S=ph.canonical(1), H=H, R=R, **slots)


def spring(
    k: ph.Parameter | float = 40.0, m: ph.Parameter | float = 2.5, **slots: Any
) -> ph.PseudoHamiltonian:
    energy = ph.formula("k*q**2/2 + p**2/(2*m)", k=k, m=m)
    return hamiltonian(energy, ph.damping("p"), **slots).with_values({"R_p": 0.5})


DRIVEN: Any = {"inputs": ["u"], "F": {"p": ph.formula("u")}}


def positions(
    model: ph.Model,
    t: np.ndarray,
    x0: list[float],
    u: np.ndarray | None = None,
    keep: int = 0,
    offset: float = 0.0,
) -> ph.Measurements:
    """Noisy positions along a simulation, of which the last ``keep`` samples are kept
    (0: all).
    """
    x = free_run(model, t, x0, u)[-keep:] + np.array([offset, np.nan])
    x = x + NOISE * np.random.default_rng(0).normal(size=x.shape)
    inputs, kept = (None, None) if u is None else (["u"], [u[-keep:]])
    about: Any = {"states": ["q", "p"], "inputs": inputs, "units": {"t": "s", "q": "m"}}
    return ph.Measurements.from_arrays([t[-keep:] - t[-keep]], [x], kept, **about)


def separated(first: ph.Model, second: ph.Model, data: ph.Measurements) -> Separation:
    fits = ph.identify(first, data), ph.identify(second, data)
    return separating(*fits, data, SIGMA)


@pytest.fixture(scope="module")
def shifted() -> Pair:
    """Positions with an offset, by a sensor's and by a constant force."""
    data = positions(spring(), np.linspace(0.0, 4.0, 101), [1.0, 0.0], offset=0.1)
    models = spring(sensor=OFFSET), spring().add("constant force", "p")
    first, second = (ph.identify(model, data) for model in models)
    return first, second, data


@pytest.fixture(scope="module")
def resonant() -> Pair:
    """A steady vibration at one frequency: it tells k - m omega^2, not k or m."""
    t = np.linspace(0.0, 60.0, 1501)
    u = 60.0 * np.cos(3.0 * t)[:, None]
    data = positions(spring(46.0, **DRIVEN), t, [0.0, 0.0], u, keep=201)
    stiff = ph.identify(spring(k=ph.Parameter(44.0, lower=1.0), **DRIVEN), data)
    heavy = ph.identify(spring(m=ph.Parameter(2.0, lower=0.1), **DRIVEN), data)
    return stiff, heavy, data


@pytest.fixture(scope="module")
def found(resonant: Pair) -> Separation:
    return separating(*resonant, SIGMA)


def test_a_sensor_offset_and_a_constant_force_are_the_same_on_a_linear_spring(
    shifted: Pair,
) -> None:
    found = separating(*shifted, SIGMA)
    assert found.sentence.endswith("the two models are equivalent")
    # Starts, a shifted start, a longer record, the momentum.
    assert len(found.table) >= 7
    assert not found.table["separates"].any()


def test_on_a_hardening_spring_a_longer_record_tells_an_offset_from_a_force() -> None:
    parts = ph.formula("20*q**2 + 300*q**4/4 + p**2/5"), {"p": ph.formula("0.5")}
    sensor, force = hamiltonian(*parts, sensor=OFFSET), hamiltonian(*parts, F=PUSH)
    data = positions(sensor, np.linspace(0.0, 3.0, 151), [0.1, 0.0], offset=0.1)
    found = separated(sensor, force, data)
    table = found.table.set_index("experiment")
    longer = table.loc["a record 3 times as long"]
    assert longer["separates"] and longer["separation"] > 2 * found.in_record
    # A start further out is imitated by another force: each by nearly as much as here.
    further = table.loc["initial states 3 times as far from the mean"]
    assert further["separation"] == pytest.approx(found.in_record, rel=0.1)
    assert "noise standard deviations; in this record by" in found.sentence


def test_a_steady_vibration_hides_what_other_frequencies_show(resonant, found) -> None:
    stiff, heavy, data = resonant
    # The two models respond alike at the frequency of the record.
    response = 40.0 - heavy.values["m"] * 9.0
    assert stiff.values["k"] - 2.5 * 9.0 == pytest.approx(response, rel=0.02)
    table = found.table.set_index("experiment")
    assert found.in_record < 0.2
    sines = [name for name in table.index if "a sine of period" in name]
    assert len(sines) == 3
    assert table.loc[sines, "separation"].max() > 5.0
    assert any("sweep of periods" in name for name in table.index)
    assert table["separation"].is_monotonic_decreasing
    assert separating(stiff, heavy, data, SIGMA).table.equals(found.table)


def test_the_separation_is_what_a_search_over_the_parameters_leaves(
    resonant: Pair, found: Separation
) -> None:
    """Reference: SciPy's least squares on simulations, for the same record with the
    momentum measured too.
    """
    stiff, heavy, data = resonant
    run = data.trajectories[0]

    def simulated(model: ph.Model, x0: np.ndarray) -> np.ndarray:
        return free_run(model, run.t, x0, run.u)

    truth = simulated(stiff.model, stiff.states[0][0])
    spread = np.std(truth, axis=0)
    weight = 1 / (NOISE / spread[0] * spread)

    def misfit(z: np.ndarray) -> np.ndarray:
        values = dict(zip(heavy.model.free, z[:2].tolist(), strict=True))
        model = heavy.model.with_values(values)
        here = (simulated(model, z[2:4]) - truth) * weight
        there = (simulated(model, z[4:6]) - truth)[:, :1] * weight[0]
        return np.r_[here.ravel(), there.ravel()]

    x0 = heavy.states[0][0]
    begin = np.r_[heavy.model.theta, x0, x0]
    best = least_squares(misfit, begin, x_scale="jac")
    added = 2 * best.cost - found.in_record**2 * len(run.t)
    row = found.table.set_index("experiment").loc["p measured, too"]
    # 5 %: the record's part is taken as linear in the parameters.
    expected = np.sqrt(added / truth.size)
    assert row["separation"] == pytest.approx(expected, rel=0.05)

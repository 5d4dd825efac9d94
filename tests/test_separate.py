"""The next experiment: what tells two effects apart that a record does not, or sharpens
a parameter, within limits.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import phsi_opt as ph
from phsi_opt.diagnosis.experiments import Experiment, next_experiment
from phsi_opt.presentation.units import Scale, Unit
from phsi_opt.simulation.simulate import free_run
from tests import systems
from tests.systems import Number, pair

NOISE = 0.02
SIGMA = {"q": NOISE}
OFFSET = {"q": ph.formula("b", b=ph.Parameter(0.0))}
PUSH = {"p": ph.formula("f", f=ph.Parameter(0.0))}
DRIVEN: Any = {"F": "u"}
LIMITS = {"u": (-60.0, 60.0), "q": (-5.0, 5.0), "p/2.5": (-6.0, 6.0), "t": 6.0}
REST = {"q": 0.0, "p": 0.0}
Fits = dict[str, ph.Fit]


def spring(k: Number = 40.0, m: Number = 2.5, **slots: Any) -> ph.PseudoHamiltonian:
    return systems.spring(k, m=m, **slots).with_values({"R_p": 0.5})


def positions(
    model: ph.Model,
    t: np.ndarray,
    x0: list[float],
    u: np.ndarray | None = None,
    keep: int = 0,
    offset: float = 0.0,
    seed: int = 0,
) -> ph.Measurements:
    """Noisy positions along a simulation, of which the last ``keep`` samples are kept
    (0: all).
    """
    x = free_run(model, t, x0, u)[-keep:] + np.array([offset, np.nan])
    x = x + NOISE * np.random.default_rng(seed).normal(size=x.shape)
    inputs, kept = (None, None) if u is None else (["u"], [u[-keep:]])
    about: Any = {"states": ["q", "p"], "inputs": inputs, "units": {"t": "s", "q": "m"}}
    return ph.Measurements.from_arrays([t[-keep:] - t[-keep]], [x], kept, **about)


@pytest.fixture(scope="module")
def resonant() -> tuple[Fits, ph.Measurements]:
    """A steady vibration at one frequency: it tells k - m omega^2, not k or m."""
    t = np.linspace(0.0, 60.0, 1501)
    u = 60.0 * np.cos(3.0 * t)[:, None]
    data = positions(spring(46.0, **DRIVEN), t, [0.0, 0.0], u, keep=201)
    stiff = ph.identify(spring(k=ph.Parameter(44.0, lower=1.0), **DRIVEN), data)
    heavy = ph.identify(spring(m=ph.Parameter(2.0, lower=0.1), **DRIVEN), data)
    return {"stiff": stiff, "heavy": heavy}, data


@pytest.fixture(scope="module")
def found(resonant: tuple[Fits, ph.Measurements]) -> Experiment:
    return next_experiment(*resonant, SIGMA, LIMITS, REST)


def test_a_steady_vibration_hides_what_a_designed_input_shows(
    resonant: tuple[Fits, ph.Measurements], found: Experiment
) -> None:
    fits, _ = resonant
    response = 40.0 - fits["heavy"].values["m"] * 9.0
    assert fits["stiff"].values["k"] - 2.5 * 9.0 == pytest.approx(response, rel=0.02)
    assert min(found.log_bayes.values()) > 1000
    assert "expected log Bayes factor" in found.sentence
    assert found.t[-1] == pytest.approx(6.0, abs=0.05)


def test_the_limits_hold_along_the_true_motion(
    resonant: tuple[Fits, ph.Measurements], found: Experiment
) -> None:
    x = ph.simulate(resonant[0]["stiff"].model, found.t, [0.0, 0.0], found.u)
    assert np.all(np.abs(found.u) <= 60.0 + 1e-6)
    assert np.max(np.abs(x[:, 0])) <= 5.0 * 1.001
    speed = np.max(np.abs(x[:, 1] / 2.5))
    assert 5.0 < speed <= 6.0 * 1.001  # it uses what is allowed


def test_an_input_for_one_parameter_tells_it_better_than_the_record_as_long(
    resonant: tuple[Fits, ph.Measurements],
) -> None:
    fits, data = resonant
    only = {"stiff": fits["stiff"]}
    found = next_experiment(only, data, SIGMA, {"u": (-60.0, 60.0)}, sharpen="R_p")
    before, after = found.std_errors["R_p"]
    # A second record like the first would leave 1 / sqrt(2).
    assert after < 0.95 * before / np.sqrt(2)
    assert f"reduces the standard error of R_p from {before:.2g} to" in str(found)
    per_mm = replace(found, units={"R_p": Unit("kg/s", Scale("kg/ms", 1e3))})
    assert f"R_p from {before / 1e3:.2g} to {after / 1e3:.2g} kg/ms" in str(per_mm)


def test_an_offset_and_a_force_are_the_same_on_a_linear_spring() -> None:
    data = positions(spring(), np.linspace(0.0, 4.0, 101), [1.0, 0.0], offset=0.1)
    models = {"sensor": spring(sensor=OFFSET), "force": spring(F=PUSH)}
    fits = {name: ph.identify(model, data) for name, model in models.items()}
    found = next_experiment(fits, data, SIGMA)
    assert found.sentence.startswith("No experiment within these limits distinguishes")


def test_on_a_hardening_spring_a_larger_start_tells_an_offset_from_a_force() -> None:
    parts = "20*q**2 + 300*q**4/4 + p**2/5", "0.5"
    sensor, force = pair(*parts, sensor=OFFSET), pair(*parts, PUSH)
    data = positions(sensor, np.linspace(0.0, 3.0, 151), [0.1, 0.0], offset=0.1)
    models = {"sensor": sensor, "force": force}
    fits = {name: ph.identify(model, data) for name, model in models.items()}
    near = next_experiment(fits, data, SIGMA)
    far = next_experiment(fits, data, SIGMA, {"q": (-1.0, 1.0)})
    assert far.kind == "start" and abs(far.x0["q"]) > 0.9
    assert min(far.log_bayes.values()) > 5 * min(near.log_bayes.values())
    assert "Start at q = " in far.sentence


def test_delays_are_told_from_lags_by_the_input() -> None:
    """Delayed inputs are exact in the design, too."""
    t = np.linspace(0.0, 10.0, 101)
    u = np.sin(0.3 * t)[:, None]
    body = ph.FirstOrder(["T"], {"T": "-0.5*T + b*u"}, inputs=["u"])
    late, slow = body.add("input delay", "T"), body.add("input lag", "T")
    truth = late.with_values({"b": 1.0, "delay_u_T": 0.35})
    y = free_run(truth, t, [0.0], u)
    y += 0.005 * np.random.default_rng(1).normal(size=y.shape)
    data = ph.Measurements.from_arrays([t], [y], [u], states=["T"], inputs=["u"])
    loss = ph.MaximumLikelihood(noise={"T": 0.005})
    models = {"delay": late, "lag": slow}
    fits = {name: ph.identify(model, data, loss) for name, model in models.items()}
    assert abs(fits["delay"].bic - fits["lag"].bic) / 2 < 3.0
    found = next_experiment(fits, data, {"T": 0.005})
    again = free_run(truth, found.t, [0.0], found.u)
    again += 0.005 * np.random.default_rng(2).normal(size=again.shape)
    both = ph.Measurements.from_arrays(
        [t, found.t], [y, again], [u, found.u], states=["T"], inputs=["u"]
    )
    delay, lag = (ph.identify(fit.model, both, loss) for fit in fits.values())
    reached = (lag.bic - delay.bic) / 2
    assert reached > 4.6
    assert reached == pytest.approx(found.log_bayes["delay"], rel=0.2)


def test_an_experiment_is_written_for_the_rig(
    found: Experiment, tmp_path: Path
) -> None:
    table = pd.read_csv(found.to_csv(tmp_path / "next.csv"))
    assert list(table) == ["t [s]", "u"]
    np.testing.assert_allclose(table["u"], found.u[:, 0], rtol=1e-9)


BAD: list[tuple[dict[str, Any], str]] = [
    ({"limits": {"u": (5.0, -5.0)}}, r"limits\['u'\]"),
    ({"limits": {"u": 3.0}}, r"limits\['u'\]"),
    ({"limits": {"force": (0.0, 1.0)}}, "force"),
    ({"limits": {"t": 0.001}}, "duration above 0.04 s"),
    ({"limits": {"t": np.inf}}, "a finite duration"),
    ({"start": {"v": 0.0}}, "state 'v'"),
    ({"start": {"q": np.nan}}, r"start\['q'\]=nan"),
    ({"limits": {"q": (-0.1, 0.1)}, "start": {"q": 1.0}}, r"start\['q'\]=1.0 .* 0\.1"),
    ({"limits": {"q": (4.0, 5.0)}}, r"start\['q'\]=.* limits of q, 4 to 5"),
    ({"sharpen": "mass"}, "parameter 'mass'"),
]


@pytest.mark.parametrize(("given", "said"), BAD)
def test_limits_that_cannot_be_are_named(
    resonant: tuple[Fits, ph.Measurements], given: dict[str, Any], said: str
) -> None:
    with pytest.raises(ph.ModelError, match=said):
        next_experiment(*resonant, SIGMA, **given)


def test_without_limits_the_motion_of_the_model_is_within_the_range_of_the_data() -> (
    None
):
    model = spring(k=ph.Parameter(40.0, lower=0), **DRIVEN)
    t = np.linspace(0.0, 8.0, 161)
    u = 0.1 * np.sin(t)[:, None]
    for seed in range(3):  # the noise of the largest samples decides
        data = positions(model, t, [1.0, 0.0], u, seed=seed)
        fits = {"spring": ph.identify(model, data)}
        found = next_experiment(fits, data, SIGMA, sharpen="k")
        assert found.std_errors["k"][1] < found.std_errors["k"][0]


def test_expected_errors_are_those_of_all_runs_and_the_experiment() -> None:
    model = spring(k=ph.Parameter(40.0, lower=0), **DRIVEN)
    t = np.linspace(0.0, 4.0, 81)
    u = np.sin(2 * t)[:, None]
    noisy = [
        positions(model, t, [0.2, 0.0], u, seed=seed).trajectories[0].x
        for seed in range(6)
    ]
    runs = [t] * 7, [*noisy, noisy[0]], [u] * 7  # the last is a copy, used once
    names: Any = {"states": ["q", "p"], "inputs": ["u"]}
    data = ph.Measurements.from_arrays(*runs, **names)
    loss = ph.MaximumLikelihood(noise=SIGMA)
    fit = ph.identify(model, data, loss)
    found = next_experiment({"spring": fit}, data, SIGMA, {"t": 2.0})
    x0 = [found.x0[name] for name in ("q", "p")]
    x = fit.simulate(found.t, x0, found.u)
    x[:, 1] = np.nan
    added = [found.t], [x], [found.u]
    both = ph.Measurements.from_arrays(
        *(old + new for old, new in zip(runs, added, strict=True)), **names
    )
    again = ph.identify(fit.model, both, loss)
    for name, (before, after) in found.std_errors.items():
        assert before == fit.std_errors[name] > after
        assert after == pytest.approx(again.std_errors[name], rel=0.01)


def test_the_expected_factor_counts_all_runs_and_priors() -> None:
    t = np.linspace(0.0, 8.0, 161)
    u = 20.0 * np.cos(3.0 * t)[:, None]
    names: Any = {"states": ["q", "p"], "inputs": ["u"]}
    rest = [0.0, 0.0]
    noisy = [positions(spring(46.0, **DRIVEN), t, rest, u, seed=i) for i in range(3)]
    runs = [t] * 3, [one.trajectories[0].x for one in noisy], [u] * 3
    data = ph.Measurements.from_arrays(*runs, **names)
    loss = ph.MaximumLikelihood(noise=SIGMA)
    mass = ph.Parameter(2.5, lower=0.1, prior=(2.5, 0.002))
    stiff = ph.identify(spring(k=ph.Parameter(44.0, lower=1), **DRIVEN), data, loss)
    heavy = ph.identify(spring(m=mass, **DRIVEN), data, loss)
    fits = {"stiff": stiff, "heavy": heavy}
    found = next_experiment(fits, data, SIGMA, {"t": 2.0}, REST)

    def deviance(is_designed: bool) -> float:
        """-2 log likelihood of the heavy one where the stiff one moves."""
        courses = [stiff.simulate(t, x[0], u) for x in stiff.states]
        times, inputs = [t] * 3, [u] * 3
        if is_designed:
            courses.append(stiff.simulate(found.t, rest, found.u))
            times, inputs = [*times, found.t], [*inputs, found.u]
        shown = [np.column_stack([x[:, 0], np.full(len(x), np.nan)]) for x in courses]
        exact = ph.Measurements.from_arrays(times, shown, inputs, **names)
        fit = ph.identify(heavy.model, exact, loss)
        counted = len(fit.names) * np.log(fit.n_values)
        return fit.bic - counted - fit.n_values * np.log(2 * np.pi * NOISE**2)

    expected = (deviance(True) - deviance(False)) / 2
    assert found.log_bayes["stiff"] == pytest.approx(expected, rel=1e-3)


def test_a_model_that_is_too_stiff_for_a_design_is_refused() -> None:
    t = np.linspace(0.0, 8.0, 161)
    u = np.sin(t)[:, None]
    model = spring(**DRIVEN).add("input lag", "p").with_fixed({"lag_u_p": 1e-5})
    data = positions(spring(**DRIVEN), t, [0.1, 0.0], u)
    fit = ph.identify(model, data, ph.MaximumLikelihood(steps=4))
    with pytest.raises(ph.SolveError, match="or none can be simulated"):
        next_experiment({"lag": fit}, data, SIGMA, {"t": 1.0})
    with pytest.raises(ph.ModelError, match="no free parameter"):
        known = ph.identify(spring(**DRIVEN).frozen(), data)
        next_experiment({"known": known}, data, SIGMA)

"""Awkward data and models: what a fit says must be right, or refused in words."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.errors import ModelError
from phsi_opt.estimation.estimate import Task
from phsi_opt.estimation.identify import estimate_by
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.model.parameters import Scan
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.optimization.ipopt import SolverSettings
from phsi_opt.transcription.grid import AlignedData

NOISE = 0.02


def decay(
    rate: ph.Parameter | float, sensor: dict[str, Dictionary] | None = None
) -> ph.FirstOrder:
    return ph.FirstOrder(["x"], {"x": ph.formula("-a*x", a=rate)}, sensor=sensor or {})


def decaying(
    n: int = 60, seed: int = 0, noise: float = NOISE
) -> tuple[np.ndarray, np.ndarray]:
    t = np.linspace(0.0, 4.0, n)
    return t, 2 * np.exp(-0.7 * t)[:, None] + noise * np.random.default_rng(
        seed
    ).normal(size=(n, 1))


def spring(mass: ph.Parameter | float) -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/(2*m)", k=40.0, m=mass),
        R=ph.damping("p"),
    )


@pytest.fixture(scope="module")
def loads() -> ph.Measurements:
    """Three springs with masses 2, 3, 4; position only."""
    t = np.linspace(0.0, 4.0, 120)
    runs = []
    for seed, mass in enumerate((2.0, 3.0, 4.0)):
        x = ph.simulate(spring(mass).with_values({"R_p": 1.0}), t, [1.0, 0.0])
        runs.append(x + NOISE * np.random.default_rng(seed).normal(size=x.shape))
        runs[-1][:, 1] = np.nan
    return ph.Measurements.from_arrays([t] * 3, runs, states=["q", "p"])


@pytest.fixture(scope="module")
def loaded_fit(loads: ph.Measurements) -> ph.Fit:
    return ph.identify(spring(ph.Parameter(2.5, lower=0.1, per_trajectory=True)), loads)


# ---- parameters per trajectory -------------------------------------------------------


def test_a_known_run_is_compared_with_its_own_parameters(
    loaded_fit: ph.Fit, loads: ph.Measurements, tmp_path: Path
) -> None:
    loaded_fit.save(tmp_path / "fit.json")
    again = ph.Fit.load(tmp_path / "fit.json")
    for fit, data in ((loaded_fit, loads[0]), (again, loads), (again, loads[1:])):
        comparison = ph.compare(fit, data)
        assert comparison.rmse < 1.1 * comparison.noise_floor


def test_renamed_runs_are_other_runs(
    loaded_fit: ph.Fit, loads: ph.Measurements
) -> None:
    renamed = replace(
        loads,
        trajectories=tuple(
            replace(run, name=f"again {i}") for i, run in enumerate(loads.trajectories)
        ),
    )
    comparison = ph.compare(loaded_fit, renamed)
    assert comparison.rmse < 1.1 * comparison.noise_floor
    assert comparison.values["again 2"]["m"] == pytest.approx(4.0, rel=0.02)


def test_a_name_that_would_stand_for_two_parameters_is_refused() -> None:
    t, y = decaying()
    own = Dictionary((Term("1", ph.Parameter(per_trajectory=True)),))
    model = ph.FirstOrder(["x"], {"x": own + ph.polynomials(["x"], 2)})
    data = ph.Measurements.from_arrays(
        [t, t], [y, 1.01 * y], states=["x"], names=["x", "b"]
    )
    with pytest.raises(
        ModelError, match=r"the name 'F_x\[x\]' stands for two parameters"
    ):
        ph.identify(model, data)
    fit = ph.identify(
        model,
        replace(data, trajectories=tuple(replace(r, name=f"{r.name} 1") for r in data)),
    )
    assert fit.parameters["name"].is_unique


def test_a_scan_of_a_frequency_per_trajectory_is_refused() -> None:
    with pytest.raises(
        ModelError, match="a scanned frequency is one for all trajectories"
    ):
        ph.Parameter(guess=Scan("t"), per_trajectory=True)


# ---- sensors -------------------------------------------------------------------------


@pytest.mark.parametrize("gain", [2.0, 5.0, 10.0])
def test_a_known_gain_of_any_size_changes_neither_the_estimate_nor_the_noise_floor(
    gain: float,
) -> None:
    t, y = decaying()
    plain = ph.identify(
        decay(ph.Parameter(0.5)), ph.Measurements.from_arrays(t, y, states=["x"])
    )
    data = ph.Measurements.from_arrays(t, gain * y, states=["x"])
    fit = ph.identify(
        decay(ph.Parameter(0.5), {"x": ph.formula("(g - 1)*x", g=gain)}), data
    )
    assert fit.values["a"] == pytest.approx(plain.values["a"], rel=1e-4)
    assert fit.noise["x"] == pytest.approx(gain * plain.noise["x"], rel=1e-3)
    comparison = ph.compare(fit, data)
    assert comparison.noise["x"] == pytest.approx(fit.noise["x"], rel=0.1)
    assert comparison.bands is not None
    # The band is that of what the sensor shows.
    unscaled = ph.compare(plain, ph.Measurements.from_arrays(t, y, states=["x"])).bands
    assert unscaled is not None
    np.testing.assert_allclose(comparison.bands[0], gain * unscaled[0], rtol=0.1)


def test_the_band_knows_that_the_offset_of_the_sensor_is_uncertain() -> None:
    shown, bands = [], []
    for seed in range(24):
        t, y = decaying(30, seed)
        data = ph.Measurements.from_arrays(t, y + 0.3, states=["x"])
        model = decay(ph.Parameter(0.5), {"x": ph.formula("b", b=ph.Parameter(0.0))})
        comparison = ph.compare(
            ph.identify(model, data, ph.MaximumLikelihood(noise={"x": NOISE})), data
        )
        assert comparison.bands is not None
        shown.append(comparison.shown[0][:, 0])
        bands.append(comparison.bands[0][:, 0])
    error = np.array(shown) - (2 * np.exp(-0.7 * decaying(30)[0]) + 0.3)
    # 24 draws tell the spread at one time to 14 %; without the offset's part the last
    # ones would be off by more than 3.
    np.testing.assert_allclose(
        np.sqrt(np.mean(error**2, axis=0)) / np.mean(bands, axis=0), 1.0, atol=0.5
    )


def test_a_drifting_sensor_does_not_hide_the_friction() -> None:
    t = np.linspace(0.0, 6.0, 200)
    friction = ph.formula("-0.5*dH_dp*(dH_dp**4 + v0**4)**(-0.25)", v0=0.05)
    truth = replace(spring(2.5).with_values({"R_p": 0.5}), F={"p": friction})
    runs = []
    for seed, start in enumerate(([1.0, 0.0], [0.6, 1.0])):
        x = ph.simulate(truth, t, start)
        y = (
            x[:, 0]
            + 1.0
            + 0.5 * t
            + 0.01 * np.random.default_rng(seed).normal(size=len(t))
        )
        runs.append(np.column_stack([y, np.full(len(t), np.nan)]))
    data = ph.Measurements.from_arrays([t, t], runs, states=["q", "p"])
    drift = {"q": ph.formula("b + d*t", b=ph.Parameter(0.0), d=ph.Parameter(0.0))}
    model = replace(spring(2.5), sensor=drift)
    fit = ph.identify(model, data)
    assert str(ph.diagnose(fit, data).effects[0]) == "coulomb friction on p"


# ---- outliers ------------------------------------------------------------------------


def test_the_standard_errors_of_huber_are_those_of_repeated_draws() -> None:
    fits = []
    for seed in range(60):
        t, y = decaying(60, seed)
        data = ph.Measurements.from_arrays(t, y, states=["x"])
        fits.append(
            ph.identify(
                decay(ph.Parameter(0.5)), data, ph.MaximumLikelihood(huber=1.345)
            )
        )
    spread = np.std([fit.values["a"] for fit in fits], ddof=1)
    # 60 draws tell a standard deviation to 9 %.
    assert np.mean([fit.std_errors["a"] for fit in fits]) == pytest.approx(
        spread, rel=0.2
    )
    assert min(fit.std_errors["a"] for fit in fits) > 0.7 * spread


def test_a_comparison_keeps_the_loss_of_the_fit() -> None:
    t, y = decaying(100, 1, 0.01)
    data = ph.Measurements.from_arrays(t, y, states=["x"])
    wrong = y.copy()
    wrong[::12] += 1.0
    fit = ph.identify(decay(ph.Parameter(0.5)), data, ph.MaximumLikelihood(huber=1.345))
    comparison = ph.compare(fit, ph.Measurements.from_arrays(t, wrong, states=["x"]))
    assert comparison.simulated[0][0, 0] == pytest.approx(2.0, abs=0.02)


# ---- starts and files ----------------------------------------------------------------


def test_a_loaded_fit_is_a_start_and_has_the_profile_of_the_fit_it_was(
    tmp_path: Path,
) -> None:
    t = np.linspace(0.0, 12.0, 150)
    y = (0.8 * np.sin(3.3 * t) + 0.05 * np.random.default_rng(0).normal(size=150))[
        :, None
    ]
    model = ph.FirstOrder(
        ["x"],
        {"x": ph.formula("A*w*cos(w*t)", A=ph.Parameter(1.0), w=ph.Parameter(3.2))},
    )
    data = ph.Measurements.from_arrays(t, y, states=["x"])
    fit = ph.identify(model, data)
    assert fit.values["w"] == pytest.approx(3.3, rel=0.01)
    fit.save(tmp_path / "fit.json")
    loaded = ph.Fit.load(tmp_path / "fit.json")
    far = model.with_values({"A": 1.0, "w": 1.0})
    assert ph.identify(far, data, start=loaded).values["w"] == pytest.approx(
        fit.values["w"], rel=1e-5
    )
    assert [n.tolist() for n in loaded.steps] == [n.tolist() for n in fit.steps]
    assert ph.profile(loaded, data, "w").ci_lower == pytest.approx(
        ph.profile(fit, data, "w").ci_lower, rel=1e-5
    )


def test_a_profile_of_other_measurements_is_refused() -> None:
    t, y = decaying()
    fit = ph.identify(
        decay(ph.Parameter(0.5)), ph.Measurements.from_arrays(t, y, states=["x"])
    )
    with pytest.raises(
        ph.SolveError,
        match=r"could not be repeated on these measurements: a is .* in the fit, now",
    ):
        ph.profile(fit, ph.Measurements.from_arrays(t, y**2, states=["x"]), "a")


def test_a_fit_of_shorter_records_is_still_a_start() -> None:
    (t, y), (t2, y2) = decaying(60), decaying(90)
    fit = ph.identify(
        decay(ph.Parameter(0.5)), ph.Measurements.from_arrays(t, y, states=["x"])
    )
    longer = ph.Measurements.from_arrays(t2, y2, states=["x"])
    assert ph.identify(decay(ph.Parameter(0.5)), longer, start=fit).values[
        "a"
    ] == pytest.approx(0.7, abs=0.05)


# ---- noise ---------------------------------------------------------------------------


def test_noise_may_be_known_of_one_channel_and_estimated_of_the_other() -> None:
    t = np.linspace(0.0, 6.0, 200)
    x = ph.simulate(spring(2.5).with_values({"R_p": 1.0}), t, [1.0, 0.0])
    y = x + np.random.default_rng(0).normal(size=x.shape) * np.array([0.02, 0.2])
    data = ph.Measurements.from_arrays(t, y, states=["q", "p"], noise={"q": 0.02})
    fit = ph.identify(spring(ph.Parameter(2.0)), data)
    assert fit.noise["q"] == 0.02
    assert fit.noise["p"] == pytest.approx(0.2, rel=0.2)
    assert ph.compare(fit, data).noise["p"] == pytest.approx(0.2, rel=0.2)


def test_data_without_noise_are_explained_and_the_fit_says_so() -> None:
    t, y = decaying(noise=0.0)
    fit = ph.identify(
        decay(ph.Parameter(0.5)), ph.Measurements.from_arrays(t, y, states=["x"])
    )
    assert fit.outcome.success
    assert fit.values["a"] == pytest.approx(0.7, rel=1e-5)


@pytest.mark.parametrize("value", [3.0, 0.0])
def test_a_channel_that_never_changes_does_not_harm_the_other(value: float) -> None:
    t, y = decaying()
    model = ph.FirstOrder(
        ["x", "z"],
        {
            "x": ph.formula("-a*x", a=ph.Parameter(0.5)),
            "z": ph.formula("c", c=ph.Parameter(0.1)),
        },
    )
    data = ph.Measurements.from_arrays(
        t, np.column_stack([y[:, 0], np.full(len(t), value)]), states=["x", "z"]
    )
    fit = ph.identify(model, data)
    assert fit.values["a"] == pytest.approx(0.7, abs=0.05)
    assert fit.values["c"] == pytest.approx(0.0, abs=1e-4)


def test_other_data_are_started_from_states_as_accurate_as_the_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    t = np.linspace(0.0, 30.0, 101)
    runs = [
        ph.simulate(spring(2.0).with_values({"R_p": 0.05}), t, x0)
        for x0 in ([1.0, 0.0], [0.0, 3.0])
    ]
    rng = np.random.default_rng(0)
    train, other = (
        ph.Measurements.from_arrays(
            t,
            x + 0.005 * np.std(x, axis=0) * rng.normal(size=x.shape),
            states=["q", "p"],
        )
        for x in runs
    )
    fit = ph.identify(spring(ph.Parameter(2.1, lower=0.1)), train)
    coarse = replace(fit, steps=tuple(np.ones_like(n) for n in fit.steps))
    noise = 0.005 * np.std(runs[1], axis=0)

    def error() -> float:
        (left,) = ph.compare(coarse, other).residuals
        return float(np.sqrt(np.mean((left / noise) ** 2)))

    fine = error()
    monkeypatch.setattr("phsi_opt.estimation.record.STEP_REFINEMENTS", 0)
    assert fine < 1.1 and error() > 1.3


def test_the_change_of_the_deviance_by_a_fixed_number_needs_no_fit(
    loads: ph.Measurements,
) -> None:
    def estimate(damping: float) -> LikelihoodEstimate:
        model = ph.PseudoHamiltonian(
            states=["q", "p"],
            S=ph.canonical(1),
            H=ph.formula("k*q**2/2 + p**2/(2*m)", k=40.0, m=ph.Parameter(2.0)),
            R={"p": ph.formula("c", c=damping)},
        )
        aligned = AlignedData.of(model, loads[:1])
        task = Task(model, aligned, {}, None, SolverSettings())
        found = estimate_by(ph.MaximumLikelihood(), task, None)
        assert isinstance(found, LikelihoodEstimate)
        return found

    here, there, beyond = (estimate(c) for c in (1.1, 1.101, 1.102))
    # At 1.101 by both neighbours: the slope is that of the deviances, fitted anew.
    slope = (beyond.deviance - here.deviance) / 2
    # The noise is that of the values less the mass and two starting states.
    slope *= (there.n_values - 3) / there.n_values
    assert there.deviance_change(beyond.model) == pytest.approx(slope, rel=1e-3)
    assert there.deviance_change(there.model) == 0

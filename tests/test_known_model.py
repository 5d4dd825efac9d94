"""A model whose values are all known: compared, diagnosed, studied without a parameter
to estimate.
"""

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

import phsi_opt as ph
from tests.systems import NOISE, STARTS, TIMES, damped_spring, swings

WITH_FRICTION = "0.1 + 0.08*(p**4 + 0.03**4)**(-0.25)"


@pytest.fixture(scope="module")
def data() -> ph.Measurements:
    return swings(damped_spring(), seed=1)


@pytest.fixture(scope="module")
def fit(data: ph.Measurements) -> ph.Fit:
    return ph.identify(damped_spring(), data)


# ---- the fit without estimates -------------------------------------------------------


def test_a_model_without_free_parameters_gets_noise_and_states_alone(
    fit: ph.Fit, data: ph.Measurements, tmp_path: Path
) -> None:
    assert fit.names == ()
    # 423 values: a standard error of 3.4 %.
    assert fit.noise["q"] == pytest.approx(NOISE, rel=0.08)
    for states, run, x0 in zip(fit.states, data.trajectories, STARTS, strict=True):
        assert states.shape == run.x.shape
        np.testing.assert_allclose(states[0], x0, atol=5 * NOISE)
    assert np.isfinite(fit.bic)
    # Every form of a fit is there.
    assert "noise: q" in str(fit)
    assert len(fit.parameters) == len(fit.intervals()) == 0
    assert fit.correlations.shape == fit.covariance.shape == (0, 0)
    assert "No parameter was estimated" in fit.plot_parameters().get_title()
    plt.close("all")
    fit.save(tmp_path / "fit.json")
    loaded = ph.Fit.load(tmp_path / "fit.json")
    assert loaded.covariance.shape == (0, 0)
    assert loaded.noise == fit.noise
    runs = [one.simulate(TIMES, [1.0, 0.0]) for one in (loaded, fit)]
    np.testing.assert_array_equal(runs[0], runs[1])


# ---- compared ------------------------------------------------------------------------


def test_the_noise_floor_is_known_where_the_noise_is_declared() -> None:
    data = replace(swings(damped_spring(), seed=4), noise={"q": NOISE})
    declared = ph.compare(damped_spring(), data)
    assert declared.noise_floor_std_error == 0
    assert declared.noise_floor_interval == (NOISE, NOISE)
    assert declared.rmse == pytest.approx(NOISE, rel=0.1)


# ---- diagnosed and studied -----------------------------------------------------------


def test_a_study_of_a_known_model_adds_takes_back_and_goes_on_by_itself() -> None:
    train, test = swings(damped_spring(loss=WITH_FRICTION), seed=8).split(0.6)
    effects = ["coulomb friction", "quadratic drag", "cubic stiffness"]
    study = ph.Study(damped_spring(), train, test, effects=effects)
    before = study.compare().rmse
    fit = study.add("coulomb friction")
    assert study.compare().rmse < before / 3
    assert fit.values["coulomb_friction_p"] == pytest.approx(0.08, rel=0.05)
    assert study.undo().names == ()
    stopped = study.auto()
    assert [str(effect) for effect in study.added] == ["coulomb friction on p"]
    assert "nothing missing" in stopped
    errors = study.history["held_out_rmse"]
    assert errors.iloc[-1] < errors.iloc[0] / 3
    assert study.remove("coulomb friction").names == ()


# ---- refusals ------------------------------------------------------------------------


def test_what_has_to_be_fitted_or_is_no_model_is_refused(fit, data) -> None:
    k = ph.Parameter(2.0, lower=0)
    model = damped_spring("k*q**2/2 + p**2/2", k=k)
    with pytest.raises(ph.ModelError, match=r"free parameters \(k\).*identify\(model"):
        ph.compare(model, data)
    with pytest.raises(ph.ModelError, match=r"diagnose\(identify\(model, data\), data"):
        ph.diagnose(model, data)
    assert ph.compare(model.with_fixed({"k": 2.3}), data).rmse < 2 * NOISE
    with pytest.raises(ph.ModelError, match=r"fit='fit.json' .* expected Fit \| Model"):
        ph.compare("fit.json", data)  # type: ignore[arg-type]
    with pytest.raises(ph.ModelError, match="no free parameter, and the PHSI loss"):
        ph.identify(damped_spring(), data, ph.PHSILoss())
    with pytest.raises(ph.ModelError, match="the fit has no free parameter"):
        ph.profile(fit, data, "k")

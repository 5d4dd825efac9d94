"""Priors of parameters: one more measurement in every loss."""

import re
from pathlib import Path

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.sweeps.local_workers import InThisProcess
from tests.systems import recorded

T = np.arange(0.0, 10.0, 0.1)
U = np.sin(T)[:, None]
TRUTH = 0.8


def decay(prior: tuple[float, float] | None = None, **settings) -> ph.FirstOrder:
    rate = ph.Parameter(1.0, prior=prior, **settings)
    return ph.FirstOrder(["x"], {"x": ph.formula("u - r*x", r=rate)}, inputs=["u"])


def record(seed: int = 1, n_runs: int = 1) -> ph.Measurements:
    truth = decay().with_fixed({"r": TRUTH})
    return recorded(truth, T, *[[1.0]] * n_runs, u=U, noise=0.1, seed=seed)


@pytest.fixture(scope="module")
def data() -> ph.Measurements:
    return record()


@pytest.mark.parametrize("loss", [
    ph.MaximumLikelihood(noise={"x": 0.1}),
    ph.MaximumLikelihood(),
    ph.MaximumLikelihood(huber=3.0),
    ph.MaximumLikelihood(model_error=True),
])  # fmt: skip
def test_a_prior_is_weighted_with_the_data_by_their_variances(loss, data) -> None:
    free = ph.identify(decay(), data, loss)
    value, error = free.values["r"], free.std_errors["r"]
    for deviation in (0.01 * error, error, 100 * error):
        mean = value + error / 2
        fit = ph.identify(decay((mean, deviation)), data, loss)
        weights = np.array([error, deviation]) ** -2.0
        expected = weights @ [value, mean] / weights.sum()
        # The model is not linear in r, and the noise is estimated anew.
        assert fit.values["r"] == pytest.approx(expected, abs=0.03 * error)
        assert fit.std_errors["r"] == pytest.approx(weights.sum() ** -0.5, rel=0.03)


def test_full_steps_and_ipopt_agree(data) -> None:
    model = decay((0.9, 0.05))
    values = []
    for solver in ("auto", "ipopt"):
        settings = ph.SolverSettings(solver=solver)
        loss = ph.MaximumLikelihood(noise={"x": 0.1})
        values.append(ph.identify(model, data, loss, settings=settings).values["r"])
    assert values[0] == pytest.approx(values[1], rel=1e-7)


def test_the_phsi_loss_counts_a_prior_beside_the_scatter_of_its_defects(data) -> None:
    free = ph.identify(decay(), data, ph.PHSILoss())
    for deviation, expected in ((1e-6, 0.5), (1e6, free.values["r"])):
        fit = ph.identify(decay((0.5, deviation)), data, ph.PHSILoss())
        assert fit.values["r"] == pytest.approx(expected, abs=1e-4)
        assert fit.std_errors["r"] <= 1.001 * min(deviation, free.std_errors["r"])
    # A least-squares problem in r alone, solved by hand: weights of defects and prior.
    x, u = data.trajectories[0].x[:, 0], data.trajectories[0].u[:, 0]
    fit = ph.identify(decay((0.5, 0.05)), data, ph.PHSILoss("midpoint"))
    regressor = -(x[1:] + x[:-1]) / 2
    rate = np.diff(x) / 0.1 - (u[1:] + u[:-1]) / 2
    variance = np.mean((rate - fit.values["r"] * regressor) ** 2)
    information = regressor @ regressor / variance + 0.05**-2
    by_hand = (regressor @ rate / variance + 0.5 / 0.05**2) / information
    assert fit.values["r"] == pytest.approx(by_hand, rel=1e-3)


def test_scatter_between_runs_counts_the_error_of_a_prior() -> None:
    data = record(2, n_runs=12)
    fit = ph.identify(decay((0.8, 1e-3)), data, ph.MaximumLikelihood(model_error=True))
    assert fit.std_errors["r"] == pytest.approx(1e-3, rel=0.05)


def test_a_prior_makes_parameters_identifiable_and_is_told_and_saved(
    tmp_path: Path,
) -> None:
    data = record()
    scaled = {"x": ph.formula("g*u - r*x", g=ph.Parameter(1.0), r=ph.Parameter(1.0))}
    sensor = {"x": ph.formula("(s - 1)*x", s=ph.Parameter(1.0, prior=(1.0, 0.1)))}
    model = ph.FirstOrder(["x"], scaled, inputs=["u"], sensor=sensor)
    assert not ph.identifiability(model, data).sentences
    fit = ph.identify(model, data)
    assert fit.std_errors["s"] == pytest.approx(0.1, rel=1e-3)
    assert fit.std_errors["g"] > 0.09
    assert "the prior of s, 1 +- 0.1, counts as data" in fit.warnings
    fit.save(tmp_path / "fit.json")
    loaded = ph.Fit.load(tmp_path / "fit.json")
    assert loaded.entry("s").parameter.prior == (1.0, 0.1)
    known = ph.MaximumLikelihood(noise={"x": 0.1})
    far = ph.identify(decay((2.0, 0.2)), data, known)
    (said,) = [one for one in far.warnings if "the prior of r" in one]
    assert "standard deviations away" in said


@pytest.mark.parametrize(("settings", "said"), [
    ({"prior": (1.0, 0.0)}, "standard deviation above zero"),
    ({"prior": (np.nan, 1.0)}, "its mean, finite and within"),
    ({"prior": (1.0,)}, "its mean, finite and within"),
    ({"prior": (-1.0, 1.0), "lower": 0.0}, r"within \[0, inf\]"),
])  # fmt: skip
def test_a_prior_that_is_none_is_refused(settings, said: str) -> None:
    with pytest.raises(ph.ModelError, match=said):
        ph.Parameter(**settings)
    assert ph.Parameter(prior=(2.0, 1.0)).start == 2.0


def test_a_study_file_has_priors_in_the_unit_that_is_written(tmp_path: Path) -> None:
    folder = Path(ph.__file__).parent / "study_file" / "examples" / "spring"
    text = (folder / "study.toml").read_text()
    text = text.replace("friction_spring.csv", str(folder / "friction_spring.csv"))
    priored = 'k = { prior = [40.0, 2.0], upper = 41.0, unit = "N/mm" }'
    path = tmp_path / "study.toml"
    path.write_text(re.sub(r"^k = .*$", priored, text, flags=re.MULTILINE))
    file = ph.StudyFile.read(path)
    prior = file.model().entries["k"].parameter.prior
    assert prior == pytest.approx((40e3, 2e3))
    (said,) = [one for one in file.study().fit.warnings if "prior of k" in one]
    assert said.startswith("the prior of k, 40 +- 2 N/mm, counts as data")
    file.write(tmp_path / "again.toml")
    again = ph.StudyFile.read(tmp_path / "again.toml")
    assert again.model().entries["k"].parameter.prior == pytest.approx(prior)
    low = (
        path.read_text()
        .replace("upper = 41.0", "upper = 0.02")
        .replace("40.0,", "0.02,")
    )
    path.write_text(low)
    (said,) = [
        one for one in ph.StudyFile.read(path).study().fit.warnings if "bound" in one
    ]
    assert said.startswith("k is at its upper bound 0.02 N/mm")
    path.write_text(low.replace(", 2.0]", ", -2.0]"))
    with pytest.raises(ph.StudyFileError, match="mean and standard deviation"):
        ph.StudyFile.read(path)


def test_a_profile_and_a_bootstrap_count_a_prior_as_the_standard_errors_do() -> None:
    data = record()
    loss = ph.MaximumLikelihood(noise={"x": 0.1})
    error = ph.identify(decay(), data, loss).std_errors["r"]
    fit = ph.identify(decay((TRUTH + error, 0.5 * error)), data, loss)
    assert not ph.profile(fit, data, "r").is_curved
    draws = ph.bootstrap(fit, data, 40, executor=InThisProcess())
    ratio = draws.estimates["r"].std() / fit.std_errors["r"]
    assert ratio == pytest.approx(1.0, abs=0.35)  # three standard deviations of 40
    assert abs(draws.table["bias"]["r"]) < 3 * fit.std_errors["r"] / np.sqrt(40)

"""Free runs: their errors, bands and energy against closed forms, and when flat."""

from dataclasses import replace
from functools import cache
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy import stats

import phsi_opt as ph
from phsi_opt.comparison.compare import flat_sentence, is_flat
from phsi_opt.estimation import record
from phsi_opt.presentation.units import Scale, Unit
from phsi_opt.statistics import ljung_box
from tests.systems import STARTS, recorded, spring

T = np.linspace(2.0, 8.0, 61)
U = np.sin(1.1 * T)
OFFSETS = (0.1, -0.2, 0.3)  # of the position, m
NOISE = {"q": 0.01, "p": 0.03}
UNITS = {"t": "s", "q": "m", "p": "kg m/s"}


KNOWN = spring(2.0, 0.3, F="u")


@cache
def measured(has_offset: bool = False) -> ph.Measurements:
    """Three noisy runs of both states; the last lacks many values of p."""
    rng = np.random.default_rng(0)
    found = []
    for x0, offset in zip(STARTS, OFFSETS, strict=True):
        x = ph.simulate(KNOWN, T, x0, U)
        x[:, 0] += offset * has_offset
        found.append(x + np.array(list(NOISE.values())) * rng.normal(size=x.shape))
    found[2][20:, 1] = np.nan
    return ph.Measurements.from_arrays(
        [T] * 3, found, [U] * 3, states=["q", "p"], inputs=["u"], units=UNITS
    )


# ---- how far off it is


@pytest.mark.parametrize("declared", [None, {"q": 0.01}])
def test_errors_and_floor_are_those_of_a_run_from_the_first_states(declared) -> None:
    data = replace(measured(), noise=declared)
    found = ph.compare(KNOWN, data)
    runs = [ph.simulate(KNOWN, T, x[0], U) for x in found.simulated]
    left = [run.x - x for run, x in zip(data.trajectories, runs, strict=True)]
    y, stacked = data.stacked("x"), np.concatenate(left)
    n = np.array([183, 142])
    spread, squares = np.nanstd(y, axis=0), np.nansum(stacked**2, axis=0)
    table = found.table
    assert str(found).count("\n") == 5 and "horizon" in str(found)
    assert table["rmse"].to_numpy() == pytest.approx(np.sqrt(squares / n), rel=1e-4)
    assert table["n_samples"].tolist() == n.tolist()
    fit_percent = 100 * (1 - np.sqrt(squares / n) / spread)
    assert table["fit_percent"].to_numpy() == pytest.approx(fit_percent, rel=1e-4)
    chi2 = squares / n / found.sigma**2
    assert table["chi2_dof"].to_numpy() == pytest.approx(chi2, rel=1e-4)
    whiteness = [ljung_box([r[np.isfinite(r)] for r in s.T]) for s in np.array(left).T]
    assert table["whiteness"].to_numpy() == pytest.approx(whiteness, rel=1e-2)
    # All channels together, each over its standard deviation.
    assert found.rmse == pytest.approx(
        np.sqrt(sum(squares / spread**2) / 325), rel=1e-4
    )
    of_noise = n * (found.sigma / spread) ** 2 / 325
    assert found.noise_floor == pytest.approx(np.sqrt(of_noise.sum()))
    # The degrees of freedom of each channel, less its share of six starting states.
    share = np.sqrt(2 / (n * (1 - 6 / 325))) * of_noise
    if declared:
        share[0] = 0.0
    error = np.sqrt(np.sum(share**2)) / (2 * found.noise_floor)
    assert found.noise_floor_std_error == pytest.approx(error, rel=1e-9)
    nu = 1 / (2 * (error / found.noise_floor) ** 2)
    ends = found.noise_floor * np.sqrt(nu / stats.chi2(nu).ppf([0.975, 0.025]))
    assert found.noise_floor_interval == pytest.approx(tuple(ends), rel=1e-9)
    assert found.sigma == pytest.approx(list(NOISE.values()), rel=0.2)


def test_the_horizon_ends_where_a_residual_leaves_the_noise_in_the_worst_run() -> None:
    runs = []
    for run, sample in zip(measured(), (50, 40), strict=False):
        wrong = 0.2 * np.outer(np.arange(61) == sample, [1, 0])
        runs.append(replace(run, x=run.x + wrong))
    data = replace(measured(), trajectories=tuple(runs), noise=NOISE)
    horizon = ph.compare(KNOWN, data).table["horizon"]
    assert horizon.tolist() == pytest.approx([4.0, 6.0])


def test_units_change_what_is_told_and_nothing_else() -> None:
    runs = measured().trajectories
    alone = tuple(replace(run, x=run.x * [1.0, np.nan]) for run in runs)
    data = replace(measured(), trajectories=alone)
    in_mm = {"t": Unit("s", Scale("ms", 1e-3)), "q": Unit("m", Scale("mm", 1e-3))}
    plain, told = (ph.compare(KNOWN, replace(data, units=u)) for u in (UNITS, in_mm))
    assert (plain.error_unit, told.error_unit) == ("m", "mm")
    row, other = plain.table.iloc[0], told.table.iloc[0]
    assert (row["unit"], other["unit"]) == ("m", "mm")
    for name in ("rmse", "noise_floor", "horizon"):
        assert other[name] == pytest.approx(1e3 * row[name], rel=1e-9)
    for name in ("fit_percent", "chi2_dof", "whiteness", "n_samples"):
        assert other[name] == pytest.approx(row[name], rel=1e-9)
    assert told.rmse == pytest.approx(other["rmse"], rel=1e-9)
    assert told.floor_words(2.0, " m") == plain.floor_words(2e3, " m")
    ax = told.plot(trajectory="run 2")
    points, run = (np.asarray(line.get_ydata()) for line in ax.lines[:2])
    np.testing.assert_allclose(np.asarray(ax.lines[0].get_xdata()), 1e3 * T)
    np.testing.assert_allclose(points, 1e3 * alone[1].x[:, 0])
    np.testing.assert_allclose(run, 1e3 * told.shown[1][:, 0])
    rmse, floor = f"{told.rmse:.3g}", f"{told.noise_floor:.3g}"
    title = f"Free run of run 2: rmse {rmse}, noise floor {floor} (all runs)"
    assert ax.get_title() == title
    plt.close("all")


def test_the_energy_balance_is_that_of_spring_damper_and_input() -> None:
    found = ph.compare(KNOWN, measured())
    for row, x in zip(found.energy.itertuples(), found.simulated, strict=True):
        q, p = x.T
        energy = q**2 + p**2 / 2
        assert row.change == pytest.approx(energy[-1] - energy[0])
        assert row.supplied == pytest.approx(np.trapezoid(U * p, T))
        assert row.dissipated == pytest.approx(np.trapezoid(0.3 * p**2, T))
    assert found.energy["trajectory"].tolist() == ["run 1", "run 2", "run 3"]


# ---- how certain it is


@cache
def fitted() -> ph.Fit:
    """Stiffness and damping of two runs, each with an offset of its own."""
    model = spring(ph.Parameter(1.5, lower=0), ph.Parameter(0.2, lower=0), F="u")
    offset = ph.formula("b", b=ph.Parameter(0.0, per_trajectory=True))
    return ph.identify(replace(model, sensor={"q": offset}), measured(True)[:2])


@pytest.mark.parametrize("taken", [slice(0, 2), slice(2, 3)])
def test_bands_are_those_of_the_dense_covariance_of_parameters_and_starts(
    taken: slice,
) -> None:
    fit = fitted()
    found = ph.compare(fit, measured(True)[taken])
    assert found.bands is not None
    free = replace(fit.model, sensor={})
    # Stiffness and damping are those of the fit; the rest follows the record.
    shared = fit.covariance[:2, :2]
    for run, x, band in zip(
        found.data.trajectories, found.simulated, found.bands, strict=True
    ):
        at = np.array([fit.values["k"], fit.values["c"], *x[0]])
        columns = []
        for step in 1e-4 * np.eye(4):
            ends = []
            for z in (at + step, at - step):
                model = free.with_values({"k": z[0], "c": z[1]})
                ends.append(ph.simulate(model, T, z[2:], U))
            columns.append((ends[0] - ends[1]) / 2e-4)
        jacobian = np.stack([*columns, np.tile([1.0, 0.0], (61, 1))], axis=-1)
        white = (jacobian / found.sigma[:, None])[np.isfinite(run.x)]
        own = np.linalg.inv(white[:, 2:].T @ white[:, 2:])
        following = np.vstack([np.eye(2), -own @ white[:, 2:].T @ white[:, :2]])
        covariance = following @ shared @ following.T
        covariance[2:, 2:] += own
        expected = np.einsum("tij,jk,tik->ti", jacobian, covariance, jacobian)
        np.testing.assert_allclose(band, np.sqrt(expected), rtol=0.01)


# ---- when it is flat


def test_a_run_is_flat_that_hardly_moves_beside_a_motion_and_explains_nothing() -> None:
    y = np.tile([3.0, -3.0, 3.0, -3.0], 5)  # of a standard deviation of three
    across = np.tile([3.0, 3.0, -3.0, -3.0], 5)
    for near, is_so in ((0.999, True), (1.001, False)):
        assert is_flat(y, 7.0 + 0 * y, 1.5 * near) == is_so
        assert is_flat(y, 0.25 * near * across, 0.0) == is_so
        assert is_flat(y, 0.05 * near * y, 0.0) == is_so  # a fit of 5 %


def test_it_is_told_what_to_do_where_a_run_is_flat() -> None:
    assert flat_sentence([]) == ""
    assert flat_sentence(["q", "w"]) == (
        "The free run of q and w is almost constant and does not follow the "
        "measurements. The fit probably ended at a wrong optimum, and a diagnosis of "
        "it would be meaningless. Check the sign of each term, and choose other "
        "starting values for the parameters."
    )


def test_a_prediction_for_new_inputs_is_as_uncertain_as_its_parameters() -> None:
    t = np.linspace(0, 4, 200)
    u = np.ones((200, 1))
    law = ph.FirstOrder(
        ["x"], {"x": ph.formula("(b*u - x)/tau", b=2.0, tau=0.8)}, ["u"]
    )
    data = recorded(law, t, [0.0], u=u, noise=0.05, seed=5)
    free: Any = {"b": ph.Parameter(1.0), "tau": ph.Parameter(1.0, lower=0)}
    model = ph.FirstOrder(["x"], {"x": ph.formula("(b*u - x)/tau", **free)}, ["u"])
    fit = ph.identify(model, data)
    t, u = np.linspace(0, 3, 50), np.full((50, 1), 3.0)
    found = fit.predict(t, [0.0], u)
    b, tau = fit.values["b"], fit.values["tau"]
    decay = np.exp(-t / tau)
    np.testing.assert_allclose(found.states[:, 0], 3 * b * (1 - decay), rtol=1e-5)
    # The slopes of the closed form in b and tau.
    slopes = np.array([3 * (1 - decay), -3 * b * decay * t / tau**2])
    order = [fit.names.index(name) for name in ("b", "tau")]
    covariance = fit.covariance[np.ix_(order, order)]
    std = np.sqrt(np.einsum("it,ij,jt->t", slopes, covariance, slopes))
    np.testing.assert_allclose(found.std[:, 0], std, rtol=1e-3, atol=1e-9)
    ax = found.plot(plt.figure().add_subplot())
    (line,) = [one for one in ax.get_lines() if one.get_label() == "prediction"]
    np.testing.assert_array_equal(line.get_ydata(), found.states[:, 0])
    plt.close("all")


def test_a_prediction_by_the_means_of_the_runs_is_as_uncertain_as_these() -> None:
    t = np.linspace(0, 4, 100)
    own = ph.Parameter(1.0, per_trajectory=True)
    model = ph.FirstOrder(["x"], {"x": ph.formula("a - x/2", a=own)})
    rng = np.random.default_rng(6)
    runs = []
    for a in (1.0, 1.2, 1.4):
        exact = ph.simulate(model.with_values({"a": a}), t, [0.0])
        runs.append(exact + rng.normal(0, 0.05, (100, 1)))
    fit = ph.identify(model, ph.Measurements.from_arrays([t] * 3, runs, states=["x"]))
    slope = 2 * (1 - np.exp(-t / 2))  # of x in a
    for trajectory, share in ((None, np.full(3, 1 / 3)), (1, np.eye(3)[1])):
        std = fit.predict(t, [0.0], trajectory=trajectory).std[:, 0]
        expected = slope * np.sqrt(share @ fit.covariance @ share)
        np.testing.assert_allclose(std, expected, rtol=1e-3, atol=1e-9)


def test_a_start_is_found_where_the_likelihood_finds_none(monkeypatch) -> None:
    """States of the missing force follow the data, and begin where no run fits best."""
    t = 0.05 * np.arange(160)
    pushed = ph.mechanical(["q"], mass=2.0, forces="u - k*q - c*v", k=9.0, c=0.4)
    stiffening = pushed.add("cubic stiffness", "p")
    truth = stiffening.with_values({"cubic_stiffness_q": 6.0})
    rng = np.random.default_rng(17)
    u = 3 * np.sin(np.outer(t, (0.9, 2.3)) + rng.uniform(0, 6, 2)).sum(axis=1)
    x = ph.simulate(truth, t, [1.2, -1.0], u[:, None])
    x[:, 0] += 0.01 * rng.normal(size=160)
    x[:, 1] = np.nan
    data = ph.Measurements.from_arrays(t, x, u, states=["q", "p"], inputs=["u"])
    fit = ph.identify(pushed, data)
    other = ph.Measurements.from_arrays(
        t + 1.0, x, u, states=["q", "p"], inputs=["u"], names=["other"]
    )
    best = ph.compare(fit, other).rmse
    monkeypatch.setattr(record, "_most_likely_states", lambda *_: None)
    assert ph.compare(fit, other).rmse == pytest.approx(best, rel=1e-3)

"""The Cramer-Rao bound, and the studies of efficiency, chaos and scaling under
problems/, small.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import phsi_opt as ph
from problems.benchmarks import chaos, scaling, state_growth
from problems.benchmarks.efficiency import page, run
from problems.benchmarks.efficiency.cases import CASES, duffing, tanks_leak, thesis_draw
from problems.benchmarks.efficiency.cramer_rao import (
    TrueSystem,
    covariance_bound,
    efficient_error,
)
from problems.thesis.systems import SYSTEMS, closed_tanks
from problems.tools import provenance


def test_the_bound_agrees_with_the_closed_form_of_exponential_decay() -> None:
    system = TrueSystem(("x",), ("-a*x",), {"a": 0.7}, ("a",))
    t, starts, sigma = (
        np.linspace(0.0, 3.0, 31),
        np.array([[2.0], [-1.0]]),
        np.array([0.1]),
    )
    slopes = system.sensitivities(starts, t)
    decay = np.exp(-0.7 * t)
    left = -t * decay - decay * np.sum(-t * decay**2) / np.sum(decay**2)
    variance = sigma[0] ** 2 / (np.sum(left**2) * (2.0**2 + 1.0**2))
    # rtol=1e-11 of the integration
    assert covariance_bound(slopes, sigma)[0, 0] == pytest.approx(variance, rel=1e-8)


@pytest.mark.parametrize("measured", [("q", "p"), ("q",)])
def test_the_bound_agrees_with_finite_differences_of_an_integration(
    measured: tuple[str, ...],
) -> None:
    system, t, start, sigma = (
        duffing(),
        np.linspace(0.0, 8.0, 41),
        np.array([1.5, 0.0]),
        np.array([0.1, 0.2]),
    )
    seen = np.random.default_rng(0).random((1, 41, 2)) < 0.7
    seen &= np.isin(system.states, measured)

    def states(values: np.ndarray) -> np.ndarray:
        moved = replace(
            system, values=dict(zip(system.values, values[2:], strict=True))
        )
        return moved.solve(values[None, :2], t)[0]

    at, h = np.array([*start, *system.values.values()]), 1e-4
    columns = [
        (states(at + h * e) - states(at - h * e)) / (2 * h) for e in np.eye(len(at))
    ]
    J = np.stack([(column / sigma)[seen[0]] for column in columns], axis=1)
    expected = np.linalg.inv(J.T @ J)[2:, 2:]
    slopes = system.sensitivities(start[None, :], t)
    # central differences of step 1e-4: errors of 1e-8 times third derivatives
    assert covariance_bound(slopes, sigma, seen) == pytest.approx(expected, rel=1e-5)


def test_the_efficient_estimate_is_least_squares_over_parameters_and_starts() -> None:
    rng = np.random.default_rng(1)
    t, sigma = np.linspace(0.0, 8.0, 41), np.array([0.1, 0.2])
    starts = np.array([[1.5, 0.0], [-1.0, 0.4]])
    slopes = duffing().sensitivities(starts, t)
    seen = rng.random((2, 41, 2)) < 0.7
    noise = sigma * rng.normal(size=seen.shape)
    rows = []
    for k in range(2):
        of_starts = np.zeros((41, 2, 4))
        of_starts[:, :, 2 * k : 2 * k + 2] = slopes.in_start[k]
        row = np.concatenate([of_starts, slopes.in_theta[k]], axis=2)
        rows.append((row / sigma[:, None])[seen[k]])
    expected = np.linalg.lstsq(np.concatenate(rows), (noise / sigma)[seen])[0][4:]
    found = efficient_error(slopes, sigma, noise, seen)
    # two factorisations of one matrix, whose columns differ by a hundred
    assert found == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(
    "name", ["henon_heiles", "mass_spring", "schrodinger", "tanks", "tanks_leak"]
)
def test_the_bound_s_systems_are_those_of_the_thesis(name: str) -> None:
    case, system = CASES[name], SYSTEMS[name.removesuffix("_leak")]
    rhs = closed_tanks if name == "tanks" else system.rhs
    x = np.random.default_rng(1).normal(size=len(system.states))
    truth = case.system()
    theta = list(truth.values.values())
    rates = [float(r) for r in truth.functions.rates(0.3, x, theta)]
    # the same formula in two orders of evaluation
    assert rates == pytest.approx(rhs(0.3, x), rel=1e-12, abs=1e-12)
    assert set(truth.truth) == set(case.model().free)


def test_the_data_of_the_thesis_systems_are_drawn_as_in_the_thesis() -> None:
    small = replace(SYSTEMS["mass_spring"], n_trajectories=3)
    mine = replace(CASES["mass_spring"], draw=thesis_draw(small)).sample(7).data
    for a, b in zip(mine, small.data(7), strict=True):
        # two integrators with tolerances of 1e-11 and 1e-12
        assert a.x == pytest.approx(b.x, abs=1e-8)


def test_fixed_steps_over_the_kinks_of_the_leak_leave_the_bound_as_it_is() -> None:
    case, truth = CASES["tanks_leak"], tanks_leak()
    starts = case.draw(np.random.default_rng(3)).starts[:1]
    sigma = np.full(9, case.noise)
    t = case.t[:21]  # two periods
    stepped = truth.sensitivities(starts, t)
    adaptive = replace(truth, kinked=False).sensitivities(starts, t)
    # the leak reaches its limit again and again, and both see every kink
    assert np.ptp(np.sign(np.abs(stepped.states[0, :, 8]) - 0.3)) == 2
    bounds = [np.sqrt(np.diag(covariance_bound(s, sigma))) for s in (stepped, adaptive)]
    # three digits of a bound are enough
    assert bounds[0] == pytest.approx(bounds[1], rel=1e-2)


def test_likelihood_is_close_to_the_bound_and_needs_no_complete_samples() -> None:
    tables = run.quick(["duffing_qp_0.1", "duffing_q_0.1_gaps"], 1)
    table = tables["duffing_qp_0.1"]
    z = (
        ((table["estimate"] - table["truth"]) / table["bound"])
        .abs()
        .groupby(table["method"])
        .max()
    )
    # the largest of three standard normal numbers is above 4 once in 5000 draws
    assert z["likelihood"] < 4
    assert set(table["method"]) == {"likelihood", "one-step"}
    # the standard error is the bound with estimated noise and parameters: within 15 %
    # at 1002 values
    share = (table["std_error"] / table["bound"])[table["method"] == "likelihood"]
    assert share.to_numpy() == pytest.approx(1, abs=0.15)
    assert set(tables["duffing_q_0.1_gaps"]["method"]) == {"likelihood"}
    assert set(tables["duffing_q_0.1_gaps"]["outcome"]) == {"solved"}


def test_a_failed_fit_is_counted_and_its_interval_does_not_hold_the_truth(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object) -> None:
        raise ph.SolveError("no")

    monkeypatch.setattr(ph, "identify", fail)
    rows = run.quick(["duffing_qp_0.1"], 1)["duffing_qp_0.1"]
    assert page.failures(rows) == 1
    assert (page.scores(rows)["coverage"] == 0).all()


def test_the_page_is_made_from_the_kept_rows_and_a_run_goes_on_where_it_stopped(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("sys.argv", ["run.py"])
    monkeypatch.setattr(provenance, "RESULTS", tmp_path)
    run.main(["duffing_qp_0.1"], n_seeds=1, jobs=1)
    first = pd.read_csv(tmp_path / "efficiency" / "duffing_qp_0.1.csv")
    run.main(["duffing_qp_0.1"], n_seeds=2, jobs=1)
    both = pd.read_csv(tmp_path / "efficiency" / "duffing_qp_0.1.csv")
    assert both["seed"].nunique() == 2
    pd.testing.assert_frame_equal(both.head(len(first)), first)
    assert "coverage, pooled" in (tmp_path / "efficiency.md").read_text(
        encoding="utf-8"
    )
    assert (tmp_path / "efficiency.png").stat().st_size > 10_000


def test_the_double_pendulum_of_the_data_is_that_of_the_model() -> None:
    model = chaos.pendulum_model().with_values(chaos.PENDULUM_TRUTH)
    x = np.array([0.3, 1.1, 0.7, -0.4])
    rates = np.array(
        model.rhs()(x, [], 0.3, [model.values[name] for name in model.free])
    ).ravel()
    # the same formula in two orders of evaluation
    assert rates == pytest.approx(chaos._pendulum(0.3, x), rel=1e-12)


def test_lorenz_is_identified_beyond_the_time_of_any_prediction(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        chaos,
        "EXPERIMENTS",
        {"small": chaos.lorenz("small", ("x", "y", "z"), n_steps=500)},
    )
    table = chaos.main(["small"], 1, keep=False)
    assert set(table["outcome"]) == {"solved"}
    # the largest of three standard normal numbers is above 4 once in 5000 draws
    assert chaos.scores(table)["z, largest"].max() < 4


def test_the_cost_of_a_fit_is_measured() -> None:
    row = scaling.measure(300, "qp")
    assert float(row["solve_seconds"]) < float(row["seconds"])
    assert float(row["largest_error_in_std_errors"]) < 4
    rows = pd.DataFrame({"n_samples": [10, 100, 1000], "seconds": [1.0, 20.0, 400.0]})
    assert scaling.exponent(rows) == pytest.approx(np.log10(20))


def test_the_cost_of_many_states_is_measured() -> None:
    row = state_growth.measure(2, 100)
    assert row["states"] == 4
    # The first is of the clock, the second of the processor.
    assert min(row["solves (s)"], row["identify (s)"]) > 0
    assert row["largest error in standard errors"] < 4
    rows = [{"states": 10, "s": 1.0}, {"states": 100, "s": 100.0}]
    assert state_growth.growth(rows, "s") == pytest.approx(2.0)

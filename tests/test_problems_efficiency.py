"""The Cramer-Rao bound, and the studies of efficiency, chaos and scaling under
problems/, small.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest


def test_the_bound_agrees_with_the_closed_form_of_exponential_decay() -> None:
    from problems.benchmarks.efficiency.cramer_rao import TrueSystem, covariance_bound

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
    from dataclasses import replace

    from problems.benchmarks.efficiency.cases import duffing
    from problems.benchmarks.efficiency.cramer_rao import covariance_bound

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


@pytest.mark.parametrize(
    "name", ["henon_heiles", "mass_spring", "schrodinger", "tanks", "tanks_leak"]
)
def test_the_bound_s_systems_are_those_of_the_thesis(name: str) -> None:
    from problems.benchmarks.efficiency.cases import CASES
    from problems.thesis.systems import SYSTEMS, closed_tanks

    case, system = CASES[name], SYSTEMS[name.removesuffix("_leak")]
    rhs = closed_tanks if name == "tanks" else system.rhs
    x = np.random.default_rng(1).normal(size=len(system.states))
    truth = case.system()
    theta = list(truth.values.values())
    rates = [float(r) for r in truth.functions.rates(0.3, x, theta)]
    # the same formula in two orders of evaluation
    assert rates == pytest.approx(rhs(0.3, x), rel=1e-12, abs=1e-12)
    assert set(truth.truth) == set(case.model().free)


def test_likelihood_is_close_to_the_bound_and_needs_no_complete_samples() -> None:
    from problems.benchmarks.efficiency.run import quick

    tables = quick(["duffing_qp_0.1", "duffing_q_0.1_gaps"], 1)
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


def test_the_page_is_made_from_the_kept_rows_and_a_run_goes_on_where_it_stopped(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from problems.benchmarks.efficiency import run
    from problems.tools import provenance

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


def test_lorenz_is_identified_beyond_the_time_of_any_prediction(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from problems.benchmarks import chaos

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
    from problems.benchmarks import scaling

    row = scaling.measure(300, "qp")
    assert float(row["solve_seconds"]) < float(row["seconds"])
    assert float(row["largest_error_in_std_errors"]) < 4
    rows = pd.DataFrame({"n_samples": [10, 100, 1000], "seconds": [1.0, 20.0, 400.0]})
    assert scaling.exponent(rows) == pytest.approx(np.log10(20))


def test_the_cost_of_many_states_is_measured() -> None:
    from problems.benchmarks import state_growth

    row = state_growth.measure(2, 100)
    assert row["states"] == 4
    assert 0 < row["solves (s)"] < row["identify (s)"]
    assert row["largest error in standard errors"] < 4
    rows = [{"states": 10, "s": 1.0}, {"states": 100, "s": 100.0}]
    assert state_growth.growth(rows, "s") == pytest.approx(2.0)

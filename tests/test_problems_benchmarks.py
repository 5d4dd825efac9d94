"""The benchmarks, small: the Cramer-Rao bound, chaos, scaling, coverage, far starts."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import phsi_opt as ph
from problems.benchmarks import coverage, identifiability, identify
from problems.benchmarks.coverage import SCENARIOS
from problems.benchmarks.efficiency.cases import CASES, duffing
from problems.benchmarks.efficiency.cramer_rao import TrueSystem, covariance_bound
from problems.benchmarks.oscillator import TRUTH, Disturbance, Layout, record, records
from problems.benchmarks.peer_problems import PROBLEMS
from problems.thesis.systems import SYSTEMS, closed_tanks


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
def test_the_bound_agrees_with_finite_differences_of_an_integration(measured) -> None:
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
        return moved.sensitivities(values[None, :2], t).states[0]

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
    "name", ["henon_heiles", "mass_spring", "schrodinger", "tanks"]
)
def test_the_bound_s_systems_are_those_of_the_thesis(name: str) -> None:
    case, system = CASES[name], SYSTEMS[name]
    rhs = closed_tanks if name == "tanks" else system.rhs
    x = np.random.default_rng(1).normal(size=len(system.states))
    truth = case.system()
    theta = list(truth.values.values())
    rates = [float(r) for r in truth.rates_and_slopes(0.3, x, theta)[0]]
    # the same formula in two orders of evaluation
    assert rates == pytest.approx(rhs(0.3, x), rel=1e-12, abs=1e-12)
    assert set(truth.truth) == set(case.model().free)


# ---- coverage of intervals

SHORT = Layout(2, 100)


@pytest.mark.parametrize("scenario", ["OU 0.2 m/s^2, 1 s", "quantised"])
def test_a_seed_gives_the_same_record_again_and_its_disturbance(scenario: str) -> None:
    first, again = records([2, 2], SCENARIOS[scenario], SHORT)
    undisturbed = record(2, Disturbance(), SHORT)
    assert first.digest == again.digest
    assert first.digest != undisturbed.digest


def test_intervals_are_counted_and_a_failed_fit_contains_nothing(monkeypatch) -> None:
    rows = coverage.fit_rows(("fixed cubic spring 3 %", SHORT, 1))
    assert len(rows) == 2 * len(TRUTH)

    def broken(*arguments: object, **options: object) -> None:
        raise ph.SolveError("no way")

    monkeypatch.setattr(ph, "identify", broken)
    rows += coverage.fit_rows(("fixed cubic spring 3 %", SHORT, 2))
    table = pd.DataFrame(rows)
    text = coverage.page(table, 1, 2)
    assert "not containing the truth: 1." in text
    table["held"] = [True] * 6 + [False] * 6
    (line,) = coverage.summary(table).to_dict("records")
    assert (
        line["the package"] == line["white noise alone"] == "3 of 6, 50% (19% to 81%)"
    )
    assert line["the package: k / R_v / g, %"] == "50 / 50 / 50"


# ---- starts far off


@pytest.mark.slow
def test_every_peer_finds_the_motion_of_an_easy_start() -> None:
    row = identify.peer_row(PROBLEMS[0], 0)
    found = {name: value for name, value in row.items() if name.endswith("found")}
    assert {"identify found", "CasADi found", "SciPy found"} <= set(found)
    assert all(found.values())


def test_fits_that_hold_a_parameter_agree_with_the_verdict_on_a_random_model() -> None:
    row = identifiability.judged(60_042)
    assert (row["parameters"], row["not identifiable"]) == (4, 3)
    assert not row["wrong"] and not row["unseen"]

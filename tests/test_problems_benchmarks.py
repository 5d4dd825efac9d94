"""The benchmarks, small: the Cramer-Rao bound, chaos, scaling, coverage, far starts."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import phsi_opt as ph
from problems.benchmarks import basins, chaos, scaling, state_growth
from problems.benchmarks.basin_machines import KINDS as MACHINES
from problems.benchmarks.basin_machines import OTHERS_OFF, UNREST, draw_case
from problems.benchmarks.coverage import (
    DEFAULT,
    HIGHEST,
    LOWEST,
    PLAIN,
    SCENARIOS,
    WITH_FORCE,
    Job,
    chance_within,
    kept,
    make,
    measures,
    page,
    summary,
)
from problems.benchmarks.efficiency import run
from problems.benchmarks.efficiency.cases import CASES, duffing
from problems.benchmarks.efficiency.cramer_rao import TrueSystem, covariance_bound
from problems.benchmarks.oscillator import (
    KINDS,
    MOTION_RUNS,
    MOTION_SEED,
    SUBSTEPS,
    TRUTH,
    Disturbance,
    Draw,
    Layout,
    Nonlinearities,
    cubic_coefficient,
    kind_of,
    least_squares_estimate,
    model,
    motion,
    positions,
    records,
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


# ---- coverage of intervals

SHORT = Layout(2, 100)
SHARES = (0.01, 0.05)


@pytest.mark.parametrize("scenario", ["OU 0.2 m/s^2, 1 s", "nonlinearity 1 to 5 %"])
def test_a_seed_gives_the_same_record_alone_and_among_others(scenario: str) -> None:
    alone = records([2], SCENARIOS[scenario], SHORT)[0]
    among = records([1, 2, 3], SCENARIOS[scenario], SHORT)[1]
    undisturbed = records([2], Disturbance(), SHORT)[0]
    assert alone.digest == among.digest
    assert alone.digest != undisturbed.digest


def test_the_force_has_its_size_and_its_correlation_time() -> None:
    disturbance = Disturbance(force_size=0.2, force_time=1.0)
    force = Draw.of(1, disturbance, Layout(400, 50)).force
    later = SUBSTEPS * 10  # one second
    assert force.std() == pytest.approx(0.2, rel=0.05)
    correlation = np.mean(force[:, :-later] * force[:, later:]) / np.mean(force**2)
    assert correlation == pytest.approx(np.exp(-1), abs=0.06)


@pytest.fixture(scope="module")
def drawn() -> Nonlinearities:
    return Nonlinearities.of(range(8), SHARES, Layout(1, 100))


def test_a_drawn_nonlinearity_has_its_share_and_no_linear_part(
    drawn: Nonlinearities,
) -> None:
    layout = Layout(1, 100)
    assert len(set(drawn.kind)) == len(KINDS)
    assert drawn.share.min() >= SHARES[0]
    assert drawn.share.max() <= SHARES[1]
    ensemble = Draw.of(MOTION_SEED, Disturbance(), Layout(MOTION_RUNS, 100))
    moved = motion(Draw.joined([ensemble] * 8), drawn.repeated(MOTION_RUNS).pull)
    positions, velocities = moved
    of_samples = drawn.repeated(MOTION_RUNS * layout.samples)
    force = of_samples.pull(positions.ravel(), velocities.ravel())
    force = force.reshape(8, -1)
    q = positions.reshape(8, -1)
    v = velocities.reshape(8, -1)
    size = np.sqrt(np.mean(force**2, axis=1))
    spring = TRUTH["k"] * np.sqrt(np.mean(q**2, axis=1))
    # The motions of the last pass are not quite those from which it was told.
    assert size / spring == pytest.approx(drawn.share, rel=0.01)
    for linear in (q, v, np.ones_like(q)):
        alike = np.mean(force * linear, axis=1)
        of_linear = np.sqrt(np.mean(linear**2, axis=1))
        assert abs(alike / of_linear / size).max() < 0.01


def test_an_estimate_of_a_linear_machine_tends_to_the_truth() -> None:
    draw = Draw.of(1, Disturbance(), Layout(20, 100))
    found = least_squares_estimate(positions(draw, 0.0), draw.voltage)
    assert found == pytest.approx(TRUTH, rel=1e-5)


def test_least_squares_is_the_estimate_of_the_package_on_the_same_record() -> None:
    disturbance = Disturbance(cubic_share=0.05)
    draw = Draw.of(1, disturbance, SHORT)
    cubic = cubic_coefficient(disturbance.cubic_share)
    found = least_squares_estimate(positions(draw, cubic) + draw.noise, draw.voltage)
    fit = ph.identify(model(), records([1], disturbance, SHORT)[0])
    assert fit.estimates == pytest.approx(found, rel=1e-4)


def test_coverage_is_counted_and_a_failed_fit_holds_nothing() -> None:
    rows = pd.DataFrame(
        {
            "estimate": [1.0, 1.2, 2.0, np.nan],
            "std_error": [0.1, 0.1, 0.5, np.nan],
            "half": [0.2, 0.2, 1.0, np.nan],
            "white": [0.1, 0.05, 0.1, np.nan],
            "white_half": [0.2, 0.1, 0.2, np.nan],
            "source": ["white noise", "model error", "model error", "SolveError"],
        }
    )
    of_fit = measures(rows, 1.0, is_plain=False)
    of_plain = measures(rows, 1.0, is_plain=True)
    assert of_fit["coverage"] == 75.0
    assert of_plain["coverage"] == 25.0
    assert of_fit["n_failed"] == 1
    assert of_fit["median_width_ratio"] == pytest.approx(2.0)
    assert of_fit["same_width"] == 25.0
    assert of_fit["model error"] == 50.0
    assert of_fit["coverage_if_white"] == 100.0
    assert of_fit["coverage_if_more"] == pytest.approx(200 / 3)
    assert of_fit["rms_z"] == pytest.approx(np.sqrt((0 + 4 + 4) / 3))


def test_exact_intervals_are_counted_within_the_limits_as_often_as_drawn() -> None:
    held = np.random.default_rng(1).random((20_000, 40)) < 0.95
    share = 100 * held.mean(axis=1)
    counted = np.mean((share >= LOWEST) & (share <= HIGHEST))
    assert chance_within(40) == pytest.approx(counted, abs=0.015)  # four errors


@pytest.mark.slow
def test_the_page_tells_every_method(tmp_path: Path) -> None:
    jobs = [
        Job("none", SHORT, DEFAULT),
        Job("nonlinearity 1 to 5 %", SHORT, DEFAULT),
        Job("cubic spring 5 %", SHORT, DEFAULT),
        Job("cubic spring 5 %", SHORT, WITH_FORCE),
    ]
    make([(job, [1, 2]) for job in jobs], tmp_path / "fits.csv")
    fits = kept(tmp_path / "fits.csv")
    rows = summary(fits)
    assert len(rows) == 3 * (2 + 2 + 2 * 2 + 2)
    assert set(rows["method"]) == {PLAIN, DEFAULT, WITH_FORCE}
    assert (rows["n"] == 2).all()
    text = page(rows, fits)
    assert "Not measured: default, 1 x 400." in text
    assert "| default | 2 x 100 | 2 |" in text
    assert f"| 2 x 100 | {kind_of(1, SHORT)} |" in text
    assert "| cubic spring 5 % | 2 x 100 | limit of the estimate |" in text
    asked, stressed = text.split("## Stress test")
    assert "cubic spring 5 %" not in asked
    assert "| cubic spring 5 % | 2 x 100 | 2 |" in stressed


# ---- starts far off


@pytest.mark.parametrize("kind", MACHINES)
def test_a_machine_is_the_same_whenever_it_is_drawn_and_starts_as_far_off_as_said(
    kind: str,
) -> None:
    case = draw_case(kind, 3, off=0.7)
    again = draw_case(kind, 3, off=0.7)
    np.testing.assert_array_equal(
        case.data.trajectories[0].x, again.data.trajectories[0].x
    )
    for name, value in case.truth.items():
        distance = abs(case.model.values[name] / value - 1)
        if name in case.frequency_parameters:
            assert distance == pytest.approx(0.7)
        else:
            assert distance <= OTHERS_OFF


def test_a_hidden_force_changes_the_motion_and_a_pendulum_never_turns_over() -> None:
    for seed in range(2):
        plain = draw_case("pendulum", seed)
        forced = draw_case("pendulum", seed, lacks=UNREST)
        x = plain.data.trajectories[0].x[:, 0] - plain.noise[:, 0]
        pushed = forced.data.trajectories[0].x[:, 0] - forced.noise[:, 0]
        assert max(np.max(np.abs(x)), np.max(np.abs(pushed))) <= np.pi
        assert np.std(pushed - x) > 1e-3


def test_one_machine_from_half_off_is_judged_right_by_its_own_truth() -> None:
    setting = basins.Setting(0.5, basins.NOTHING, 1)
    row = basins.row("oscillator", 1, setting)
    assert row["right"]
    assert row["frequency_error"] == pytest.approx(0.0, abs=1e-3)
    frame = pd.DataFrame([row, {**row, "kind": "pendulum", "right": False}])
    counted = basins.summary(frame).set_index("machine")
    assert counted["right"].to_dict() == {
        "oscillator": 1,
        "pendulum": 0,
        "two masses": 0,
        "all": 1,
    }
    assert "## Those that are wrong" in basins.page(frame)


def test_a_random_force_that_would_turn_a_pendulum_over_is_halved() -> None:
    case = draw_case("pendulum", 5001, off=0.7, lacks=UNREST)
    assert not case.is_driven
    x = case.data.trajectories[0].x[:, 0] - case.noise[:, 0]
    assert np.max(np.abs(x)) <= np.pi

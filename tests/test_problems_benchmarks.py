"""The benchmarks, small: the Cramer-Rao bound, chaos, scaling, coverage, far starts."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import phsi_opt as ph
from problems.benchmarks import chaos, coverage, identify, scaling
from problems.benchmarks.coverage import SCENARIOS
from problems.benchmarks.efficiency import run
from problems.benchmarks.efficiency.cases import CASES, duffing
from problems.benchmarks.efficiency.cramer_rao import TrueSystem, covariance_bound
from problems.benchmarks.far_starts import KINDS as MACHINES
from problems.benchmarks.far_starts import NOTHING, OTHERS_OFF, UNREST, draw_case
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
    motion,
    records,
)
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
    "name", ["henon_heiles", "mass_spring", "schrodinger", "tanks"]
)
def test_the_bound_s_systems_are_those_of_the_thesis(name: str) -> None:
    case, system = CASES[name], SYSTEMS[name]
    rhs = closed_tanks if name == "tanks" else system.rhs
    x = np.random.default_rng(1).normal(size=len(system.states))
    truth = case.system()
    theta = list(truth.values.values())
    rates = [float(r) for r in truth.functions.rates(0.3, x, theta)]
    # the same formula in two orders of evaluation
    assert rates == pytest.approx(rhs(0.3, x), rel=1e-12, abs=1e-12)
    assert set(truth.truth) == set(case.model().free)


def test_likelihood_is_close_to_the_bound_and_needs_no_complete_samples(
    capsys: pytest.CaptureFixture[str],
) -> None:
    tables = run.main(["duffing_qp_0.1", "duffing_q_0.1_gaps"], quick=True)
    table = tables["duffing_qp_0.1"]
    z = ((table["estimate"] - table["truth"]) / table["bound"]).abs()
    # the largest of three standard normal numbers is above 4 once in 5000 draws
    assert z[table["method"] == "likelihood"].max() < 4
    assert set(table["method"]) == {"likelihood", "one-step"}
    # the standard error is the bound with estimated noise and parameters: within 15 %
    # at 1002 values
    ratio = (table["std_error"] / table["bound"])[table["method"] == "likelihood"]
    assert ratio.to_numpy() == pytest.approx(1, abs=0.15)
    gaps = tables["duffing_q_0.1_gaps"]
    assert set(gaps["method"]) == {"likelihood"}
    assert gaps["estimate"].notna().all()
    said = capsys.readouterr().out
    assert (
        "| Duffing, 10 % noise, q measured, 50 % of the samples removed | 1 | 0 |"
        in said
    )


def test_lorenz_is_identified_beyond_the_time_of_any_prediction(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    small = chaos.lorenz("small", ("x", "y", "z"), n_steps=500)
    monkeypatch.setattr(chaos, "EXPERIMENTS", {"small": small})
    rows = run.fits(("small", 7000))
    assert rows["estimate"].notna().all()
    # the largest of three standard normal numbers is above 4 once in 5000 draws
    assert run.scores(rows)["z"].max() < 4
    failed = rows.assign(estimate=np.nan, std_error=np.nan, seed=7001)
    line = run.line("small", pd.concat([rows, failed]))
    assert (line["seeds"], line["failed"]) == (2, 1)
    assert str(line["95 % intervals that contain the truth"]).startswith(("50%", "33%"))


def test_the_cost_of_a_fit_is_measured() -> None:
    row = scaling.by_samples(300, "qp")
    assert (row["measured"], row["samples"]) == ("q and p", 300)
    assert float(str(row["largest error in standard errors"])) < 4
    row = scaling.by_states(2, 100)
    assert row["states"] == 4
    assert float(str(row["identify (s)"])) > 0
    assert float(str(row["largest error in standard errors"])) < 4
    rows: list[scaling.Row] = [
        {"states": 10, "identify (s)": 1.0},
        {"states": 100, "identify (s)": 100.0},
    ]
    assert scaling.growth(rows, "states") == pytest.approx(2.0)


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


def test_intervals_are_counted_and_a_failed_fit_contains_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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
    assert line["the package"] == line["white noise alone"] == "50% (19% to 81%)"
    assert line["the package: k / R_v / g, %"] == "50 / 50 / 50"


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
    row = identify.far_row("oscillator", 1, 0.5, NOTHING)
    assert row["right"]
    frame = pd.DataFrame([row, {**row, "machine": "pendulum", "right": False}])
    counted = identify.far_summary(frame).set_index("machine")["right"]
    assert counted.to_dict() == {"oscillator": 1, "pendulum": 0}


@pytest.mark.slow
def test_every_peer_finds_the_motion_of_an_easy_start() -> None:
    row = identify.peer_row(PROBLEMS[0], 0)
    found = {name: value for name, value in row.items() if name.endswith("found")}
    assert {"identify found", "CasADi found", "SciPy found"} <= set(found)
    assert all(found.values())


def test_a_random_force_that_would_turn_a_pendulum_over_is_halved() -> None:
    case = draw_case("pendulum", 5001, off=0.7, lacks=UNREST)
    assert not case.is_driven
    x = case.data.trajectories[0].x[:, 0] - case.noise[:, 0]
    assert np.max(np.abs(x)) <= np.pi

"""The coverage benchmark: its machine, its limits, its counting, on a few seeds."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import phsi_opt as ph
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

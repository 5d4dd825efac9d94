"""The halves of measured records, and the loaders that only they use."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import phsi_opt as ph

RATE = 0.8  # of the decay that the tests fit


def present(path: Path) -> Path:
    """Where a measured set lies; skips the test where it is not there."""
    if not path.exists():
        pytest.skip(f"the measurements are not at {path}; set PHSI_OPT_DATA")
    return path


def decays(seed: int, n_runs: int = 2, n_samples: int = 80) -> ph.Measurements:
    """Noisy decays towards an input that steps up and down."""
    rng = np.random.default_rng(seed)
    t = 0.05 * np.arange(n_samples)
    u = np.where(np.arange(n_samples) // 20 % 2 == 0, 1.0, -1.0)
    states = []
    for _ in range(n_runs):
        x = ph.simulate(decay(), t, [0.5], u, hold="zero")
        states.append(x + 0.05 * rng.normal(size=x.shape))
    return ph.Measurements.from_arrays(
        [t] * n_runs, states, [u] * n_runs, states=["x"], inputs=["u"], hold="zero"
    )


def decay(lower: float = 0.0) -> ph.FirstOrder:
    """dx/dt = b u - r x, starting at the truth or at the bound."""
    rate = ph.Parameter(max(RATE, lower), lower=lower)
    terms = ph.formula("b*u - r*x", b=ph.Parameter(1.0), r=rate)
    return ph.FirstOrder(["x"], {"x": terms}, inputs=["u"])


# --- halves


@pytest.mark.parametrize("cut", ["first and second", "alternating", "dealt"])
@pytest.mark.parametrize("size", [None, 20, 27])
def test_halves_share_no_sample_and_lose_only_short_ends(
    cut: str, size: int | None
) -> None:
    from problems.measured.halving import halved

    data = decays(0)
    halves = halved(data, size, cut, is_windowed=True)
    values = []
    for half in (halves.first, halves.second):
        for run in half:
            values += run.x[:, 0].tolist()
            assert size is None or size // 2 <= run.n_samples <= size
    # noise makes every sample of the record a number of its own
    assert len(set(values)) == len(values)
    whole = np.concatenate([run.x[:, 0] for run in data])
    assert set(values) <= set(whole.tolist())
    n_lost = len(whole) - len(values)
    most = 0 if size is None else size // 2
    assert n_lost <= most * len(data) * 2


def test_alternating_windows_take_turns_and_dealt_ones_do_not() -> None:
    from problems.measured.halving import halved

    data = decays(0, n_runs=1)
    alternating = halved(data, 10, "alternating")
    begins = [run.t[0] for run in alternating.first]
    assert np.allclose(np.diff(begins), 2 * 10 * 0.05)
    dealt = halved(data, 10, "dealt", seed=3)
    again = halved(data, 10, "dealt", seed=3)
    assert dealt.first.digest == again.first.digest
    assert dealt.first.digest != alternating.first.digest


def test_first_and_second_half_are_cut_from_every_trajectory() -> None:
    from problems.measured.halving import halved

    halves = halved(decays(0), 20, "first and second")
    assert len(halves.first) == len(halves.second) == 2
    for first, second in zip(halves.first, halves.second, strict=True):
        assert first.t[-1] < second.t[0]


def test_distances_are_differences_over_their_own_standard_error() -> None:
    from problems.measured.halves_rows import Estimate, distance, white_distance

    first = Estimate(5.0, std_error=3.0, white=0.3, degrees=1000)
    second = Estimate(-5.0, std_error=4.0, white=0.4, degrees=1000)
    assert distance(first, second) == pytest.approx(2.0)
    assert distance(second, first) == pytest.approx(-2.0)
    assert white_distance(first, second) == pytest.approx(20.0)


def test_white_noise_leaves_a_root_mean_square_near_one() -> None:
    from problems.measured.halves_rows import measured_halves, root_mean_square
    from problems.measured.machines import Case

    z = []
    for seed in range(20):
        case = Case(decay, _reader(seed), Path(), window=20, length="1 s")
        run = measured_halves("decay", case, "alternating")
        assert not run.failure
        z += [row.z for row in run.rows]
    # 40 distances, some correlated: 0.7 to 1.4 hold 99 % of draws of 30
    assert 0.65 < root_mean_square(np.array(z)) < 1.4


def _reader(seed: int) -> Callable[[Path], ph.Measurements]:
    def load(path: Path) -> ph.Measurements:
        return decays(seed)

    return load


def test_a_parameter_at_a_bound_is_left_out_and_said_so() -> None:
    from problems.measured.halves_rows import AT_BOUND, measured_halves
    from problems.measured.machines import Case

    case = Case(
        lambda: decay(lower=2 * RATE), lambda path: decays(0), Path(), 20, "1 s"
    )
    run = measured_halves("decay", case, "dealt")
    left_out = {row.parameter: row.left_out for row in run.rows}
    assert left_out == {"b": "", "r": AT_BOUND}


def test_a_fit_that_fails_is_kept_with_its_message() -> None:
    from problems.measured.halves_rows import measured_halves
    from problems.measured.machines import Case

    other = ph.FirstOrder(["y"], {"y": ph.formula("r*y", r=ph.Parameter(1.0))})
    case = Case(lambda: other, lambda path: decays(0), Path(), 20, "1 s")
    run = measured_halves("other", case, "dealt")
    assert "'y'" in run.failure
    assert not run.rows


def test_the_page_tells_sets_failures_and_values_that_do_not_hold() -> None:
    from dataclasses import asdict

    import pandas as pd

    from problems.measured.halves_page import page
    from problems.measured.halves_rows import Row, Run
    from problems.measured.published_values import Held

    numbers = (3, 3, "d", 5.0, -5.0, 3.0, 4.0, 90, 90, 2.0, 20.0, "")
    row = Row("coupled drives, linear", "dealt", *numbers)
    runs = [
        Run("coupled drives, linear", "dealt", (row,), (1.0, 2.0)),
        Run("two heaters", "dealt", (), (1.0,), "it did not converge"),
    ]
    held = [Held("whole record", "M", 95.1, 94.0, 0.1, 93.8, 94.2)]
    text = page(pd.DataFrame([asdict(row)]), runs, held, is_white=True)
    assert "| coupled drives, linear | - | - | 2.00 (n 1) | 2.00 (n 1) |" in text
    assert "| coupled drives, linear | - | - | 20.00 (n 1) | 20.00 (n 1) |" in text
    assert "| two heaters | dealt | it did not converge |" in text
    assert "does not hold" in text
    assert "0 of 1 sets" in text


# --- loaders


def test_the_pendulum_swings_up_from_hanging() -> None:
    from problems.measured.torque_pendulum import FILE, load

    (run,) = load(present(FILE)).trajectories
    assert abs(run.x[0, 0]) < 0.01
    assert run.x[-1, 0] == pytest.approx(np.pi, abs=0.05)
    # the velocity is that of the angle: both channels agree over the whole record
    way = np.trapezoid(run.x[:, 1], run.t)
    assert way == pytest.approx(run.x[-1, 0] - run.x[0, 0], rel=0.05)


@pytest.mark.parametrize("house", [1, 3])
def test_houses_have_one_temperature_and_three_inputs(house: int) -> None:
    from problems.measured.houses import load
    from problems.tools.data_paths import folder

    data = load(present(folder("building")), house)
    (run,) = data.trajectories
    assert data.measured == ("Ti",)
    assert np.allclose(np.diff(run.t), 0.25)
    outdoor, sun, heat = run.u.T
    assert np.all(heat >= 0) and np.all(sun >= 0)
    assert np.mean(outdoor) < np.mean(run.x[:, 0])  # a winter


def test_the_second_heater_is_the_weaker_one() -> None:
    from problems.measured.heaters import FILE, load, model

    fit = ph.identify(model(), load(present(FILE)))
    assert fit.values["a2"] < fit.values["a1"]
    assert fit.values["coupling"] > 0


def test_cycles_of_the_battery_keep_their_charge_and_their_jumps() -> None:
    from problems.measured.battery_cell import FILE, JUMP, RAMP, load

    data = load(present(FILE))
    assert len(data) == 6
    for run in data:
        current = run.u[:, 0]
        # per cycle the file counts -0.24, 0.06 and -3.00 A h
        charge = np.trapezoid(current, run.t) / 3600
        assert charge == pytest.approx(-3.18, abs=0.03)
        jumps = np.flatnonzero(np.abs(np.diff(current)) > JUMP)
        assert np.allclose(np.diff(run.t)[jumps], RAMP)
        assert np.all(np.isnan(run.x[jumps + 1, 0]))
    for earlier, later in pairwise(data):
        assert earlier.t[-1] >= later.t[0]  # the rest before a cycle is in both


def test_signs_of_the_coupled_drives_unfold_the_speed() -> None:
    from scipy.io import loadmat

    from problems.measured.coupled_drives import FILE, RECORDS, load

    data = load(present(FILE))
    content = loadmat(FILE)
    for record, run in zip(RECORDS, data, strict=True):
        v = run.x[:, 0]
        size = content[f"z{record}"].ravel()
        assert np.array_equal(np.abs(v), size)
        # a speed without its sign has a kink at every zero
        assert np.abs(np.diff(v, 2)).max() < np.abs(np.diff(size, 2)).max()

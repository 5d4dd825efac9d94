"""The measured sets: loaders, models, stories, and halves of records."""

from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.io import loadmat

import phsi_opt as ph
from problems.examples import demo
from problems.measured import halves, long_stories, machines, sets, storages, stories
from problems.measured.halves import AT_BOUND, Run, halved, measured_halves
from problems.measured.sets import Case
from problems.tools import provenance
from problems.tools.data_paths import folder

RATE = 0.8  # of the decay that the tests fit


def present(name: str) -> Path:
    """Where a measured set lies; skips the test where it is not there."""
    path = folder(name)
    if not path.exists():
        pytest.skip(f"the measurements are not at {path}; set PHSI_OPT_DATA")
    return path


def test_a_script_of_measured_data_says_where_it_looked_for_them(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["x.py", f"--data={tmp_path}"])
    assert sets.chosen_cases(["heaters", "pendulum"]) == {}
    long_stories.main(["emps", "silverbox"])
    stories.main(["house 1"])
    said = capsys.readouterr().out
    for name in ("heaters", "torque_pendulum", "emps", "silverbox", "building"):
        assert f"skipped: the data are not at {tmp_path / name}; give" in said


# --- loaders and models


def test_the_silverbox_model_predicts_a_record_it_was_not_fitted_to() -> None:
    present("silverbox")
    effects = ("constant force on p", "cubic stiffness on p")
    larger = sets.with_effects(machines.box_model(), effects)
    fit = ph.identify(larger, machines.box(40_700, 41_700))
    # A quarter of the samples of the script, which leaves 0.42 mV; the linear spring
    # leaves 9 mV.
    assert machines.box_error(fit, 50_000, 51_000) < 1.0


def test_the_drive_is_identified_from_its_position_alone() -> None:
    present("emps")
    fit = ph.identify(machines.emps_model(), machines.emps())
    # Windows of 1 s, which solve in seconds; the script's whole record is nearer.
    for name, value in machines.EMPS_PUBLISHED.items():
        assert fit.values[name] == pytest.approx(value, rel=0.10)


def test_the_ball_and_hoop_study_reaches_the_reference() -> None:
    present("ball_and_hoop")
    # A quarter of the training record keeps the test short; the script uses all of it.
    train, rest = machines.hoop().split(0.25)
    fit = sets.CASES["ball and hoop, quadratic drag"].fit(train)
    for name in machines.HOOP_TESTS:
        # 0.30 V: plain least squares with quadratic drag reaches 0.283 and 0.267 V
        assert ph.compare(fit, machines.hoop(name)).rmse < 0.30
    assert rest.n_samples > train.n_samples


@pytest.mark.parametrize("number", [1, 3])
def test_houses_have_one_temperature_and_three_inputs(number: int) -> None:
    present("building")
    data = storages.house(number)
    (run,) = data.trajectories
    assert data.measured == ("Ti",)
    assert np.allclose(np.diff(run.t), 0.25)
    outdoor, sun, heat = run.u.T
    assert np.all(heat >= 0) and np.all(sun >= 0)
    assert np.mean(outdoor) < np.mean(run.x[:, 0])  # a winter


def test_the_second_heater_is_the_weaker_one() -> None:
    present("heaters")
    fit = ph.identify(storages.heaters_model(), storages.heaters())
    assert fit.values["a2"] < fit.values["a1"]
    assert fit.values["coupling"] > 0


def test_signs_of_the_coupled_drives_unfold_the_speed() -> None:
    content = loadmat(present("coupled_drives") / machines.DRIVES_FILE)
    for record, run in zip((1, 2, 3), machines.drives(), strict=True):
        v = run.x[:, 0]
        size = content[f"z{record}"].ravel()
        assert np.array_equal(np.abs(v), size)
        # a speed without its sign has a kink at every zero
        assert np.abs(np.diff(v, 2)).max() < np.abs(np.diff(size, 2)).max()


# --- stories


def test_a_story_tells_each_step_and_why_it_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(provenance, "RESULTS", tmp_path)
    train, held_out = demo.measurements()[:2].split(0.5)
    study = ph.Study(demo.model(), train, held_out=held_out)
    found = stories.told(study, max_steps=1, goes_on=True)
    found.tests = {"again": [1.0, 0.5]}
    assert found.how == ["base model", "named"]
    assert [d.verdict for d in found.diagnoses] == ["missing: named", "nothing missing"]
    page = long_stories.Page("EMPS", 1e3, "mm")
    text = long_stories.story_page("ball_and_hoop", page, found)
    assert "| 1 | coulomb friction on p | named |" in text
    assert "Added: coulomb friction on p. The last verdict is" in text
    assert '"nothing missing"' in text
    assert "### The base model" in text and "### After step 1" in text
    pictures = {path.name for path in (tmp_path / "measured").iterdir()}
    assert pictures == {f"ball_and_hoop_{n}.png" for n in ("history", "missing_force")}
    monkeypatch.setitem(stories.SETS, "spring", sets.SETS["EMPS"])
    short = stories.page({"spring": found})
    assert "1 sets, a study each" in short and "## spring" in short
    assert "1. **missing: named** (" in short
    assert "| 1 | coulomb friction on p |" in short


# --- halves


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


@pytest.mark.parametrize("cut", ["first and second", "alternating", "dealt"])
@pytest.mark.parametrize("size", [None, 20, 27])
def test_halves_share_no_sample_and_lose_only_short_ends(
    cut: str, size: int | None
) -> None:
    data = decays(0)
    values = []
    for half in halved(data, size, cut, is_windowed=True):
        for run in half:
            values += run.x[:, 0].tolist()
            assert size is None or size // 2 <= run.n_samples <= size
    # noise makes every sample of the record a number of its own
    assert len(set(values)) == len(values)
    whole = np.concatenate([run.x[:, 0] for run in data])
    assert set(values) <= set(whole.tolist())
    most = 0 if size is None else size // 2
    assert len(whole) - len(values) <= most * len(data) * 2


def test_white_noise_leaves_a_root_mean_square_near_one() -> None:
    assert halves.distance(5.0, -5.0, 3.0, 4.0) == pytest.approx(2.0)
    z = []
    for seed in range(20):
        case = Case("", decay, partial(decays, seed), 20, "1 s")
        run = measured_halves("decay", case, "alternating")
        assert not run.failure
        z += [row["z"] for row in run.rows]
    # 40 distances, some correlated: 0.7 to 1.4 hold 99 % of draws of 30
    assert 0.65 < halves.root_mean_square(np.array(z)) < 1.4


def test_what_cannot_be_compared_is_said() -> None:
    case = Case("", lambda: decay(2 * RATE), lambda: decays(0), 20, "1 s")
    run = measured_halves("decay", case, "dealt")
    left_out = {row["parameter"]: row["left_out"] for row in run.rows}
    assert left_out == {"b": "", "r": AT_BOUND}
    other = ph.FirstOrder(["y"], {"y": ph.formula("r*y", r=ph.Parameter(1.0))})
    case = Case("", lambda: other, lambda: decays(0), 20, "1 s")
    run = measured_halves("other", case, "dealt")
    assert "'y'" in run.failure and not run.rows


def test_the_page_tells_sets_failures_and_values_that_do_not_hold() -> None:
    row: dict[str, object] = {"set": "coupled drives, linear", "cut": "dealt"}
    row |= {"n_first": 3, "n_second": 3, "parameter": "d", "z": 2.0, "z_white": 20.0}
    row |= {"first": 5.0, "second": -5.0, "std_error_first": 3.0, "left_out": ""}
    row |= {"std_error_second": 4.0}
    runs = [
        Run("coupled drives, linear", "dealt", (row,), (1.0, 2.0)),
        Run("two heaters", "dealt", (), (1.0,), "it did not converge"),
    ]
    text = halves.page(pd.DataFrame([row]), runs, "| does not hold |", is_white=True)
    assert "| coupled drives, linear | - | - | 2.00 (n 1) | 2.00 (n 1) |" in text
    assert "| coupled drives, linear | - | - | 20.00 (n 1) | 20.00 (n 1) |" in text
    assert "| d | 5 +- 3 | -5 +- 4 | 2.00 | 20.00 |" in text
    assert "| two heaters | dealt | it did not converge |" in text
    assert "does not hold" in text
    assert "0 of 1 sets" in text  # 2 is more than 1.5

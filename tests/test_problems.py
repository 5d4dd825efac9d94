"""The scripts under problems/, small."""

from importlib import import_module
from itertools import pairwise
from pathlib import Path

import pytest

import phsi_opt as ph
from phsi_opt.model.catalogue import effect_named
from phsi_opt.model.effect import Effect


@pytest.mark.parametrize(
    "name",
    [
        "ball_and_hoop",
        "battery_cell",
        "cascaded_tanks",
        "coupled_drives",
        "emps",
        "heaters",
        "houses",
        "quarter_drone",
        "silverbox",
        "torque_pendulum",
    ],
)
def test_a_script_of_measured_data_says_where_it_looked_for_them(
    name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert import_module(f"problems.measured.{name}").main(tmp_path / "absent") == {}
    assert (
        f"skipped: the data are not at {tmp_path / 'absent'}" in capsys.readouterr().out
    )


def present(name: str, file: str = "") -> Path:
    """Where a measured set lies; skips the test where it is not there."""
    from problems.tools.data_paths import folder

    path = folder(name) / file
    if not path.exists():
        pytest.skip(f"the measurements are not at {path}; set PHSI_OPT_DATA")
    return path


def test_the_silverbox_model_predicts_a_record_it_was_not_fitted_to() -> None:
    from problems.measured.silverbox import free_run_error, load, model

    path = present("silverbox", "SNLS80mV.csv")
    larger = (
        model()
        .add(effect_named(model(), "constant force", "p"))
        .add(effect_named(model(), "cubic stiffness", "p"))
    )
    fit = ph.identify(larger, load(path, 40_700, 41_700))
    # A quarter of the samples of the script, which leaves 0.42 mV; the linear spring
    # leaves 9 mV.
    assert free_run_error(fit, path, 50_000, 51_000) < 1.0


def test_the_drive_is_identified_from_its_position_alone() -> None:
    from problems.measured.emps import PUBLISHED, WINDOW, load, model

    path = present("emps")
    start = {"M": 80.0, "Fv": 100.0, "Fc": 5.0, "offset": 0.0}
    fit = ph.identify(model(start), load(path / "DATA_EMPS.mat", WINDOW))
    # Windows of 1 s, which solve in seconds; the script's whole record is nearer.
    for name, value in PUBLISHED.items():
        assert fit.values[name] == pytest.approx(value, rel=0.10)


def test_the_ball_and_hoop_study_reaches_the_reference() -> None:
    from problems.measured.ball_and_hoop import load, model

    path = present("ball_and_hoop")
    # A quarter of the training record keeps the test short; the script uses all of it.
    train, rest = load(path / "randomStepSequence.mat").split(0.25)
    fit = ph.identify(model().add(_drag()), train)
    for name in ("fixedStepSequence", "closedLoop"):
        # 0.30 V: plain least squares with quadratic drag reaches 0.283 and 0.267 V
        assert ph.compare(fit, load(path / f"{name}.mat")).rmse < 0.30
    assert rest.n_samples > train.n_samples


def _drag() -> Effect:
    from problems.measured.ball_and_hoop import model

    return effect_named(model(), "quadratic drag", "y")


def test_windows_of_the_quarter_drone_share_ends_and_keep_the_mean_command() -> None:
    import numpy as np

    from problems.measured.quarter_drone import FLYING, THIN, WINDOW, load

    path = present("quarter_drone")
    data = load(path, "steps")
    runs = data.trajectories
    assert len(runs) == round((FLYING[1] - FLYING[0]) / WINDOW)
    for earlier, later in pairwise(runs):
        assert earlier.t[-1] == later.t[0] and earlier.x[-1, 0] == later.x[0, 0]
    (whole,) = load(path, "steps", thin=1, window=FLYING[1] - FLYING[0]).trajectories
    assert runs[0].u[:-1].mean() == pytest.approx(
        whole.u[: THIN * (len(runs[0].t) - 1)].mean()
    )
    assert np.all(np.abs(np.rad2deg(whole.x[:, 0])) < 90)


def test_a_story_tells_each_step_and_why_it_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from problems.examples.demo import measurements, model
    from problems.measured import story
    from problems.tools import provenance

    monkeypatch.setattr(provenance, "RESULTS", tmp_path)
    train, held_out = measurements()[:2].split(0.5)
    found = story.told(model(), train, held_out, max_steps=1, say=lambda line: None)
    assert found.how == ["base model", "named"]
    assert [d.verdict for d in found.diagnoses] == ["missing: named", "nothing missing"]
    text = story.page(
        found, "spring", "A spring.", {"again": [1.0, 0.5]}, scale=1e3, unit="mm"
    )
    assert "| 1 | coulomb friction on p | named |" in text
    assert 'The last verdict is "nothing missing"' in text
    assert {path.name for path in (tmp_path / "measured").iterdir()} == {
        "spring_history.png",
        "spring_missing_force.png",
    }

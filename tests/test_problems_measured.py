"""The measured sets: loaders, models and stories."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

import phsi_opt as ph
from problems.examples import demo
from problems.measured import machines, sets, stories
from problems.tools import provenance
from problems.tools.data_paths import folder


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
    stories.main(["EMPS", "Silverbox", "house 1"])
    said = capsys.readouterr().out
    for name in ("emps", "silverbox", "building"):
        assert f"skipped: the data are not at {tmp_path / name}; give" in said


# --- loaders and models


def test_the_silverbox_model_predicts_a_record_it_was_not_fitted_to() -> None:
    present("silverbox")
    effects = ("constant force on p", "cubic stiffness on p")
    larger = sets.with_effects(machines.box_model(), effects)
    fit = ph.identify(larger, machines.box(40_700, 41_700))
    # A quarter of the samples of the study; the linear spring leaves 9 mV.
    assert ph.compare(fit, machines.box(50_000, 51_000)).rmse < 1e-3


def test_the_drive_is_identified_from_its_position_alone() -> None:
    present("emps")
    fit = ph.identify(machines.emps_model(), machines.emps())
    # Windows of 1 s, which solve in seconds; the script's whole record is nearer.
    for name, value in machines.EMPS_PUBLISHED.items():
        assert fit.values[name] == pytest.approx(value, rel=0.10)


def test_signs_of_the_coupled_drives_unfold_the_speed() -> None:
    content = loadmat(present("coupled_drives") / machines.DRIVES_FILE)
    for record, run in zip((1, 2, 3), machines.drives(), strict=True):
        v = run.x[:, 0]
        size = content[f"z{record}"].ravel()
        assert np.array_equal(np.abs(v), size)
        # a speed without its sign has a kink at every zero
        assert np.abs(np.diff(v, 2)).max() < np.abs(np.diff(size, 2)).max()


# --- stories


def test_a_story_tells_each_step_and_why_it_ends(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(provenance, "RESULTS", tmp_path)
    train, held_out = demo.measurements()[:2].split(0.5)
    study = ph.Study(demo.model(), train, held_out=held_out)
    found = stories.told(study, max_steps=1)
    found.tests = {"again": [1.0, 0.5]}
    assert found.how == ["base model", "named"]
    assert [d.verdict for d in found.diagnoses] == ["missing: named", "nothing missing"]
    text = stories.long_page(sets.SETS["ball and hoop"], found)
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
    assert "| 1 | coulomb friction on p | named |" in short

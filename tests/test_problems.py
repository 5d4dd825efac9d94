"""The scripts under problems/, small."""

from pathlib import Path

import pytest

from phsi_opt.effects import Effect, effect_named


def test_the_ball_and_hoop_script_says_where_it_looked_for_its_data(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    from measured.ball_and_hoop import main

    assert main(tmp_path / "absent") == {}
    assert "skipped" in capsys.readouterr().out


def test_the_ball_and_hoop_study_reaches_the_reference() -> None:
    from measured.ball_and_hoop import load, model
    from measured.paths import folder

    import phsi_opt as ph

    path = folder("ball_and_hoop")
    if not path.exists():
        pytest.skip(f"the measurements are not at {path}; set PHSI_OPT_DATA")
    # A quarter of the training record keeps the test short; the script uses all of it.
    train, rest = load(path / "randomStepSequence.mat").split(0.25)
    fit = ph.identify(model().add(_drag()), train)
    for name in ("fixedStepSequence", "closedLoop"):
        # 0.30 V: plain least squares with quadratic drag reaches 0.283 and 0.267 V
        assert ph.compare(fit, load(path / f"{name}.mat")).rmse < 0.30
    assert rest.n_samples > train.n_samples


def _drag() -> Effect:
    from measured.ball_and_hoop import model

    return effect_named(model(), "quadratic drag", "y")

"""Spoilt samples and runs that differ are told, and no effect is named for them."""

from typing import Any

import numpy as np
import pytest

import phsi_opt as ph

STIFFNESS = ph.Parameter(10.0, lower=0)
SPRING = ph.mechanical(
    ["x"], mass=2.0, forces="u - k*x - c*v", k=STIFFNESS, c=ph.Parameter(0.5, lower=0)
)
TRUTH = SPRING.with_values({"k": 18.0, "c": 1.1})
OTHER = SPRING.with_values({"k": 26.0, "c": 1.1})
FEW = ["coulomb friction", "sensor gain", "cubic stiffness"]


def pushed(
    seed: int, truth: Any = TRUTH, force: float = 8.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, positions with 1 % of noise, and the force on the spring."""
    rng = np.random.default_rng(seed)
    t = 0.04 * np.arange(200)
    phases = np.outer(t, rng.uniform(1, 6, 4)) + rng.uniform(0, 6, 4)
    u = force * np.sin(phases).sum(axis=1, keepdims=True)
    start = force / 8 * rng.normal(size=2)
    x = ph.simulate(truth, t, start, u)
    x[:, 0] += 0.01 * x[:, 0].std() * rng.normal(size=200)
    x[:, 1] = np.nan
    return t, x, u


def measured(*runs: tuple[np.ndarray, ...]) -> ph.Measurements:
    t, x, u = map(list, zip(*runs, strict=True))
    units = {"t": "s", "x": "m", "p": "kg m/s", "u": "N"}
    return ph.Measurements.from_arrays(
        t, x, u, states=["x", "p"], inputs=["u"], units=units
    )


def diagnosed(data: ph.Measurements, **options: Any) -> ph.Diagnosis:
    fit = ph.identify(SPRING, data, options.get("loss"))
    return ph.diagnose(fit, data, effects=FEW, **options)


def spoilt(kind: str) -> ph.Measurements:
    runs = [pushed(seed) for seed in (41, 42, 43)]
    rng = np.random.default_rng(8)
    for _, x, _ in runs:
        if kind == "sticks":
            x[140:, 0] = x[140, 0]
        elif kind == "saturates":
            np.clip(x[:, 0], -2.0, 2.0, out=x[:, 0])
        elif kind == "repeats":
            for k in np.flatnonzero(rng.random(199) < 0.2) + 1:
                x[k] = x[k - 1]
        elif kind == "spikes":
            x[20:200:30, 0] += rng.choice([-1, 1], 6) * rng.uniform(1, 3, 6)
    return measured(*runs)


@pytest.mark.parametrize(("kind", "words"), [
    ("sticks", "x: stays at"),
    ("saturates", "x: at its highest value in"),
    ("repeats", "repeats its previous value in"),
    ("spikes", "outliers of one sample"),
])  # fmt: skip
def test_samples_that_are_spoilt_are_the_cause_and_no_effect(kind, words) -> None:
    found = diagnosed(spoilt(kind))
    assert found.verdict == "missing: unexplained"
    assert words in found.reason
    assert "without these samples the training error falls" in found.reason
    assert not found.findings
    assert not found.strong


def test_spikes_are_told_by_the_fit_and_a_huber_loss_survives_them() -> None:
    data = spoilt("spikes")
    fit = ph.identify(SPRING, data)
    assert "outliers of one sample" in str(fit.warnings)
    assert "spikes count less with a Huber loss" in str(fit.warnings)
    assert "consistent with it" not in str(fit)
    huber = ph.MaximumLikelihood(huber=1.345)
    survives = ph.identify(SPRING, data, huber)
    assert abs(survives.values["k"] - 18.0) < 3 * survives.std_errors["k"] < 0.1
    assert "Huber" not in diagnosed(data, loss=huber).reason


def test_a_run_that_differs_is_told_as_a_run() -> None:
    runs = [pushed(51), pushed(52, OTHER), pushed(53)]
    found = diagnosed(measured(*runs))
    assert found.verdict == "missing: unexplained"
    assert found.reason.startswith("run 2 differs from the others")
    assert "without it the training error falls" in found.reason
    assert "set-up" in str(found.next_step)


def test_sound_runs_are_no_cause() -> None:
    friction = TRUTH.add("coulomb friction", "p")
    friction = friction.with_values({"coulomb_friction_p": 1.5})
    data = measured(*(pushed(seed, friction) for seed in (61, 62, 63)))
    found = diagnosed(data)
    assert found.verdict == "missing: named"
    assert found.data_cause is None
    assert found.findings[0].effects[0].name == "coulomb friction"


def test_a_run_in_which_alone_an_effect_shows_is_no_cause() -> None:
    """The error on data held out falls with the effect, and not without the run."""
    hard = TRUTH.add("cubic stiffness", "p").add("quadratic drag", "p")
    hard = hard.with_values({"cubic_stiffness_x": 1.5, "quadratic_drag_p": 0.1})
    small = [pushed(seed, hard, 0.4) for seed in (71, 72)]
    data, judge = measured(*small, pushed(73, hard)), measured(pushed(74, hard))
    found = diagnosed(data, held_out=judge)
    assert found.data_cause is None
    assert found.verdict == "missing: partly named"  # the drag is no candidate
    assert found.findings[0].effects[0].name == "cubic stiffness"


def test_a_report_blames_the_data_and_gives_no_odds() -> None:
    study = ph.Study(SPRING, spoilt("sticks"), effects=FEW)
    study.diagnose()
    headline = study.content().headline
    words = " ".join(map(str, (headline, *headline.answers)))
    assert "most of the error comes from the data" in words.lower()
    for certain in ("practically certain", "very likely", "certainly incomplete"):
        assert certain not in words

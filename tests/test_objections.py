"""Why what stands in for an effect from outside the catalogue is not named."""

import numpy as np
import pytest
from scipy.signal import lfilter

import phsi_opt as ph
from problems.battery.draw import ROWS, draw


def stood_in(seed: int, *effects: str) -> ph.Diagnosis:
    """The diagnosis of a machine with an effect from outside, by these alone."""
    case = draw(ROWS["outside"], seed)
    fit = ph.identify(case.model, case.train)
    return ph.diagnose(fit, case.train, case.test, effects=effects)


@pytest.mark.parametrize(
    ("seed", "effect"),
    [
        pytest.param(2016, "constant force on p", id="damping in one direction"),
        pytest.param(2004, "cubic stiffness on p", id="impact"),
        pytest.param(2010, "cubic stiffness on p", id="what lasts for two samples"),
    ],
)
def test_what_imitates_an_effect_from_outside_is_not_named(
    seed: int, effect: str
) -> None:
    found = stood_in(seed, effect)
    assert found.verdict == ph.Verdict.UNEXPLAINED and found.findings == ()
    assert found.ranking[0].lost


def test_noise_that_lasts_and_was_there_before_is_noise() -> None:
    case = draw(ROWS["cubic_stiffness_0.03"], 2000)
    rng = np.random.default_rng(1)
    train, test = (
        with_lasting_noise(case.train, rng),
        with_lasting_noise(case.test, rng),
    )
    fit = ph.identify(case.model, train)
    found = ph.diagnose(fit, train, test, effects=["cubic stiffness on p2"])
    assert {"force", "sensor error"} <= {row.kind for row in fit.model_error_rows}
    assert found.verdict == ph.Verdict.NAMED


def with_lasting_noise(
    data: ph.Measurements, rng: np.random.Generator
) -> ph.Measurements:
    """The same with noise of 6 % more that has a correlation of 0.7 with its past."""
    runs = []
    for run in data.trajectories:
        seen = np.isfinite(run.x).any(axis=0)
        size = np.where(seen, 0.06 * np.nanstd(np.where(seen, run.x, 0), axis=0), 0)
        white = rng.normal(size=run.x.shape)
        lasting = lfilter([np.sqrt(1 - 0.7**2)], [1, -0.7], white, axis=0)
        runs.append(run.x + size * lasting)
    times = [run.t for run in data.trajectories]
    inputs = [run.u for run in data.trajectories] if data.inputs else None
    return ph.Measurements.from_arrays(
        times, runs, states=data.states, u=inputs, inputs=data.inputs
    )

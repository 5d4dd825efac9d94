"""Before modelling: a stretch, a trend less, new samples, a spectrum, first guesses."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lsim

import phsi_opt as ph
from phsi_opt.data.first_guess import FirstGuess, first_guess
from phsi_opt.study_file.study_file import StudyFile

STEP = 0.02  # s
W, ZETA = 8.2, 0.05
NOT_HELD = np.array([False])


def staircase(n: int, seed: int, length: int = 50) -> np.ndarray:
    levels = np.random.default_rng(seed).choice([-1.0, 0.0, 1.0], -(-n // length))
    return np.repeat(levels, length)[:n]


def response(
    system: Any, delay: float, noise: float, n: int = 1500, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t = np.arange(n) * STEP
    u = staircase(n, seed)
    y = lsim(system, np.interp(t - delay, t, u), t)[1]
    y += noise * np.std(y) * np.random.default_rng(seed + 1).standard_normal(n)
    return t, y, u[:, None]


LAG = ([2.0], [0.5, 1.0])
INTEGRATING = ([1.0], [0.2, 1.0, 0.0])
OSCILLATION = ([1.0], [1 / W**2, 2 * ZETA / W, 1.0])


@pytest.mark.parametrize("delay", [0.0, 0.06, 0.6])
@pytest.mark.parametrize(
    ("system", "expected"),
    [
        (LAG, {"lag": 0.5}),
        (INTEGRATING, {"lag": 0.2, "integrates": True}),
        (OSCILLATION, {"frequency": W / (2 * np.pi), "damping": ZETA}),
    ],
)
def test_dead_time_lag_and_natural_frequency_are_guessed_from_data_alone(
    system: Any, expected: dict[str, float], delay: float
) -> None:
    if "frequency" in expected:
        delay = min(delay, 0.3)  # below half a period: later is another sign
    found = first_guess(*response(system, delay, noise=0.03), NOT_HELD)
    assert found is not None
    for name, value in expected.items():
        assert getattr(found, name) == pytest.approx(value, rel=0.1), name
    others = {"lag", "frequency", "damping"} - expected.keys()
    assert np.isnan([getattr(found, name) for name in others]).all()
    assert found.dead_time == pytest.approx(delay, abs=STEP)
    assert found.explained > 0.99


def test_a_free_oscillation_has_a_period_and_a_random_walk_nothing() -> None:
    t = np.arange(1000) * STEP
    rng = np.random.default_rng(5)
    y = np.exp(-0.2 * t) * np.cos(4 * t + 1) + 7 + 0.05 * rng.standard_normal(1000)
    found = first_guess(t, y, np.empty((1000, 0)), NOT_HELD[:0])
    assert found is not None
    assert found.frequency == pytest.approx(4 / (2 * np.pi), rel=0.01)
    assert found.damping == pytest.approx(0.05, rel=0.1)
    guess = partial(first_guess, t, is_held=NOT_HELD)
    steps = np.random.default_rng(77).standard_normal((50, 1000))
    inputs = [staircase(1000, seed)[:, None] for seed in range(500, 550)]
    told: list[FirstGuess | None] = list(map(guess, np.cumsum(steps, axis=1), inputs))
    assert sum(one is not None for one in told) <= 5, "one in ten by chance"
    for y in (t, 5 * np.exp(-t / 15), np.sqrt(t), t**2):
        assert guess(y, inputs[0]) is None, "whatever the input does"
    assert guess(rng.standard_normal(1000), inputs[0]) is None
    assert guess(np.ones(1000), inputs[0]) is None


def record(**changes: Any) -> ph.Measurements:
    """Half a minute of a lag, sampled in milliseconds."""
    t, y, u = response(LAG, 0.1, noise=0.01)
    arguments = {"states": ["T"], "inputs": ["u"]} | changes
    units = {"t": "ms", "T": "K", "u": "V"}
    x = np.c_[y, *[y * np.nan] * (len(arguments["states"]) - 1)]
    return ph.Measurements.from_arrays(1000 * t, x, u, units=units, **arguments)


def test_the_guess_is_told_with_the_names_and_units_of_the_record() -> None:
    data = replace(record(states=["T", "T2"]), labels={"u": "Voltage"})
    clock, state, unmeasured, voltage = data.noticed["guess"]
    assert state.startswith("follows Voltage with a lag of 497 ms, dead time 101 ms")
    assert clock == unmeasured == voltage == ""
    assert "T: first guess: follows Voltage" in str(data)
    assert "a lag of 497 ms" in str(data.in_si()), "as it was written"


def test_a_held_input_acts_until_the_next_sample_and_one_wave_tells_nothing() -> None:
    n = 1500
    t = np.arange(float(n))
    u = staircase(n, 3, length=20)
    x = np.zeros(n)
    for k in range(n - 1):  # exact of a lag of 3
        x[k + 1] = u[k] + (x[k] - u[k]) * np.exp(-1 / 3)
    found = first_guess(t, x, u[:, None], np.array([True]))
    assert found is not None
    assert found.lag == pytest.approx(3, rel=0.1) and found.dead_time == 0.0
    step = 1.0 * (t > 100)
    found = first_guess(
        t, lsim(([1.0], [30.0, 1.0]), step, t)[1], step[:, None], NOT_HELD
    )
    assert found is not None and found.lag == pytest.approx(30, rel=0.02)
    wave = np.sin(0.5 * t - 0.15 - np.arctan(1.5))
    assert first_guess(t, wave, np.sin(0.5 * t)[:, None], NOT_HELD) is None


# ---- new samples ---------------------------------------------------------------------


def test_what_is_too_fast_for_the_new_samples_is_filtered_out_and_nothing_else() -> (
    None
):
    t = np.arange(0.0, 20.0, 0.001)
    slow, hum = np.sin(2 * np.pi * 1.5 * t), np.sin(2 * np.pi * 47.0 * t)
    data = ph.Measurements.from_arrays(t, slow + hum, slow - hum, states=["x"])
    (run,) = data.resampled(0.05)
    assert np.allclose(np.diff(run.t), 0.05)
    assert run.t[0] == pytest.approx(0.5) and run.t[-1] == pytest.approx(
        19.45, abs=0.05
    )
    for values in (run.x, run.u):
        assert np.allclose(values[:, 0], np.sin(2 * np.pi * 1.5 * run.t), atol=0.01)
    assert run.remark == "low-pass filtered, then a sample every 0.05"


def test_a_linear_model_stays_true_behind_the_filter() -> None:
    model = ph.FirstOrder(states=["T"], inputs=["u"], F={"T": "(k*u - T)/tau"})
    t = np.arange(0.0, 40.0, 0.01)
    u = staircase(len(t), 8, length=130)
    y = lsim(LAG, np.r_[u[0], u[:-1]], t, interp=False)[1]
    y += 0.05 * np.random.default_rng(1).standard_normal(len(t))
    whole = ph.Measurements.from_arrays(
        t, y, u, states=["T"], inputs=["u"], hold="zero"
    )
    known = ph.identify(model, whole)
    fit = ph.identify(model, whole.resampled(0.1))
    assert fit.values["tau"] == pytest.approx(known.values["tau"], rel=0.03)
    assert fit.values["k"] == pytest.approx(known.values["k"], rel=0.01)


def test_noise_gaps_and_missing_values_pass_the_filter_as_they_should() -> None:
    rng = np.random.default_rng(2)
    t = np.r_[np.arange(0.0, 30.0, 0.01), np.arange(40.0, 70.0, 0.01)]
    x = np.c_[rng.standard_normal(len(t)), np.full(len(t), np.nan)]
    x[1500, 0] = np.nan
    data = ph.Measurements.from_arrays(t, x, states=["x", "v"], noise={"x": 1.0})
    thin = data.resampled(0.1)
    (run,) = thin
    assert thin.noise is not None
    is_known = np.isfinite(run.x[:, 0])
    assert np.std(run.x[is_known, 0]) == pytest.approx(thin.noise["x"], rel=0.1)
    assert 15 <= np.sum(~is_known) <= 25 and np.isnan(run.x[:, 1]).all()
    assert np.max(np.diff(run.t)) == pytest.approx(12.0, abs=0.2)  # with both ends


def test_a_clock_that_is_too_uneven_is_no_matter_of_memory() -> None:
    t = np.r_[np.arange(0.0, 1.0, 0.001), 10.0 ** np.arange(1, 12)]
    data = ph.Measurements.from_arrays(t, np.sin(t), states=["x"])
    with pytest.raises(ph.DataError, match="its clock is too uneven"):
        data.resampled(1e9)
    assert data.noticed["guess"][1] is not None


@pytest.mark.parametrize(
    ("step", "told"),
    [
        (0.0, "expected a time between new samples that is greater than 0"),
        ("1 s", "'1 s'"),
        (1.0, "a sample every 20; expected a time that is not shorter"),
        (1e4, "cannot be resampled(10000.0): 0 samples would remain"),
        (1e300, "cannot be resampled(1e+300): 0 samples would remain"),
    ],
)
def test_a_step_that_is_of_no_use_is_refused(step: Any, told: str) -> None:
    with pytest.raises(ph.DataError) as raised:
        record().resampled(step)
    assert told in str(raised.value)


# ---- a trend -------------------------------------------------------------------------


def test_a_trend_is_taken_out_of_the_channels_that_are_named() -> None:
    t = np.arange(0.0, 30.0, 0.01)
    x = np.c_[np.sin(3 * t) + 0.02 * t, np.cos(3 * t) + 0.02 * t]
    units = {"t": "s", "a": "m", "b": "m"}
    data = ph.Measurements.from_arrays(t, x, states=["a", "b"], units=units)
    less = data.detrended(["a"])
    (run,) = less
    assert np.ptp(run.x[:, 0] - np.sin(3 * t)) < 0.02
    assert run.x[:, 0].mean() == pytest.approx(x[:, 0].mean())
    assert np.array_equal(run.x[:, 1], x[:, 1])
    assert "a less a trend of 0.02 m/s" in less.noticed["noticed"][0]
    assert "trend" in data.noticed["noticed"][1]
    assert less.noticed["noticed"][1] == ""
    with pytest.raises(
        ph.DataError, match="there is no channel 'c'; expected one of a, b"
    ):
        data.detrended(["c"])


# ---- the spectrum --------------------------------------------------------------------


def test_a_spectrum_has_the_amplitude_of_a_wave_in_its_unit() -> None:
    t = np.r_[np.arange(0.0, 60.0, 0.01), np.arange(70.0, 110.0, 0.01)]
    noise = 0.3 * np.random.default_rng(3).standard_normal(len(t))
    wave = 2 * np.sin(2 * np.pi * 5 * t) + 7 + 0.1 * t
    wave[::7] = np.nan
    x = np.c_[wave, noise, np.full(len(t), np.nan), np.ones(len(t))]
    units = {"t": "ms", "a": "m", "b": "V"}
    names = ["a", "b", "unmeasured", "constant"]
    data = ph.Measurements.from_arrays(1000 * t, x, states=names, units=units)
    chart = data.spectrum
    assert chart.x_label == "frequency (Hz)"
    assert [one.label for one in chart.panels] == ["a (m)", "b (V)"]
    (tone,), (flat,) = (panel.curves for panel in chart.panels)
    assert tone.x[np.argmax(tone.y)] == pytest.approx(5.0, abs=0.01)
    assert np.max(tone.y) == pytest.approx(2.0, rel=0.01)
    assert np.max(tone.y[tone.x < 4]) < 0.05, "nothing of mean, trend and gap"
    assert np.max(flat.y) < 0.05
    assert data.plot(over="frequency").get_ylabel() == "a (m)"
    with pytest.raises(ph.DataError, match=r"plot\(over='time_'\) is unknown"):
        data.plot(over="time_")


# ---- a study file --------------------------------------------------------------------


def test_a_study_file_prepares_its_data_in_the_order_of_its_keys(
    tmp_path: Path,
) -> None:
    t = np.arange(0.0, 40.0, 0.01)
    q = np.sin(3 * t) + 0.01 * t
    np.savetxt(tmp_path / "log.csv", np.c_[1000 * t, q], "%.9g", ",", header="t,q")
    text = """
[data]
files = ["log.csv"]
time = { column = "t", unit = "ms" }
between = [5000, 35000]
detrended = ["q"]
resampled = 50
[data.states]
q = { column = "q", unit = "m" }
[model]
type = "FirstOrder"
states = ["q"]
F = { q = "a*q" }
[parameters]
a = { start = 1.0, unit = "1/s" }
"""
    (tmp_path / "study.toml").write_text(text)
    data = StudyFile.read(tmp_path / "study.toml").measurements()
    (run,) = data
    assert run.t[0] == pytest.approx(5.5) and run.t[-1] == pytest.approx(34.5, abs=0.1)
    assert run.remark == (
        "q less a trend of 1e-05 m/ms; low-pass filtered, then a sample every 50 ms"
    )
    assert np.std(run.x) == pytest.approx(np.sqrt(0.5), rel=0.02)
    study = ph.Study(ph.FirstOrder(states=["q"], F={"q": "a*q"}), data)
    told = {one.question: one for one in study.content().settings}
    assert run.remark in str(told["Before fitting"])

"""What is noticed in measurements before there is a model, and their picture."""

import io
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

import phsi_opt as ph
from phsi_opt.data.noticed import NOT_HELD, lone_peaks
from phsi_opt.presentation.charts import Chart, Curve, draw

T = 0.01 * np.arange(2000)
RNG = np.random.default_rng(0)
NOISY = np.sin(T) + 0.01 * RNG.normal(size=T.size)


def data_of(q: np.ndarray, t: np.ndarray = T, **options: Any) -> ph.Measurements:
    units = {"t": "s", "q": "m"}
    return ph.Measurements.from_arrays(t, q, states=["q"], units=units, **options)


def noticed(q: np.ndarray, t: np.ndarray = T) -> tuple[str, str]:
    """Of the clock, and of the channel."""
    clock, channel = data_of(q, t).noticed["noticed"]
    return clock, channel


def changed(places: Any, values: Any, q: np.ndarray = NOISY) -> np.ndarray:
    q = q.copy()
    q[places] = values
    return q


# ---- the clock


def test_a_regular_clock_is_said_to_be_regular() -> None:
    assert noticed(NOISY) == ("every 0.01 s, regular", "")


def test_jitter_is_the_standard_deviation_of_the_steps() -> None:
    steps = 0.01 * (1 + 0.08 * np.sqrt(1.5) * (np.arange(T.size) % 3 - 1))
    clock, _ = noticed(NOISY, np.cumsum(steps))
    assert clock == "every 0.01 s, jitter 8 %"


def test_gaps_are_counted_and_the_longest_is_placed() -> None:
    kept = (T < 3) | ((T > 3.2) & (T < 12)) | (T > 13)
    clock, _ = noticed(NOISY[kept], T[kept])
    assert clock == "every 0.01 s, regular, 2 gaps up to 1.02 s, at t = 11.99 s"


# ---- channels


def test_single_samples_far_from_both_neighbours_are_outliers() -> None:
    q = changed([400, 1200], [1.5, -2.0])
    assert noticed(q)[1] == "2 outliers of one sample, the first at t = 4 s"
    assert data_of(q).look.channels[0].outliers.tolist() == [400, 1200]


def test_an_outlier_is_beyond_the_noise_and_its_surroundings() -> None:
    t, run = np.cumsum(1.0 + np.arange(100) % 3), np.repeat([0, 1], [60, 40])

    def found(size: float, other: float = 0.0, place: int = 50) -> list[int]:
        y = 2 * t  # a line has no deviations, however it is sampled
        y[[place, 53]] += size, other
        return lone_peaks(t, y, run, noise=1.0).tolist()

    assert (found(6.0), found(6.3), found(-6.3)) == ([], [50], [50])
    assert (found(7.0, 1.2), found(7.0, 1.5)) == ([50], [])
    assert found(7.0, place=56) == [56]
    assert found(7.0, place=59) == found(7.0, place=60) == [], "ends of runs"


@pytest.mark.parametrize("q", [
    np.where(T > 7, 1.0, 0.0) + NOISY,  # a step
    np.abs(T % 2 - 1),  # corners
    np.sin(2.2 / 0.01 * T),  # three samples in a period
    np.exp(-(((T - 7) / 0.02) ** 2)),  # a pulse of some samples
    RNG.normal(size=T.size),
    np.round(NOISY, 1),
])  # fmt: skip
def test_motions_are_no_outliers(q: np.ndarray) -> None:
    assert not len(data_of(q).look.channels[0].outliers)


def test_a_sensor_at_its_limit_is_told_and_the_top_of_a_quantised_wave_is_not() -> None:
    clipped = np.minimum(NOISY, 0.8)
    percent = 100 * np.mean(clipped == 0.8)
    told = f"at its highest value in {percent:.2g} % of the samples"
    assert told in noticed(clipped)[1]
    for step in (0.01, 0.003, 0.1):
        assert "highest" not in noticed(step * np.round(np.sin(T) / step))[1]


def test_missing_samples_stuck_sensors_and_repeated_values_are_told() -> None:
    assert noticed(changed(slice(3, 8), np.nan))[1] == "5 of 2000 missing"
    for n, told in ((9, ""), (10, "10 samples, at t = 5 s")):
        stuck = noticed(changed(slice(500, 500 + n), NOISY[500]))[1]
        assert stuck == (told and f"stays at {NOISY[500]:.4g} for {told}")
    assert noticed(np.repeat(NOISY[::10], 10))[1] == "a new value every 10 samples"
    assert noticed(np.ones(T.size))[1] == "does not change"
    assert noticed(RNG.normal(size=T.size))[1].startswith("changes mostly between")


def test_a_trend_under_an_oscillation_is_told_and_a_slow_motion_is_none() -> None:
    fast = np.sin(9 * T) + NOISY - np.sin(T)
    told = noticed(fast + 0.02 * T)[1]
    assert told == "trend: its mean rises by 0.4 m in a run"
    assert noticed(fast - 0.02 * T)[1] == told.replace("rises", "falls")
    for q in (fast, np.exp(-T / 4) * fast, NOISY, 20 - np.exp(-T / 5)):
        assert "trend" not in noticed(q)[1]
    runs: Any = ([T, T], [fast + 0.02 * T, fast - 0.02 * T])
    assert data_of(runs[1], runs[0]).noticed["noticed"][1] == "", "of both signs"


def test_values_far_from_all_others_may_stand_for_missing_ones() -> None:
    for value in (-9999.0, 999.0, 1e30):
        said = (
            f"{value:g} in 3 samples, far from all others, first at t = 4 s: missing?"
        )
        assert said in noticed(changed([400, 401, 1200], value))[1]
    assert "missing" not in noticed(changed([400, 401, 1200], 3.0))[1]
    # Of a signal with few values it is not said: pulses of an input have them.
    assert "missing" not in noticed(np.where(T % 7 < 0.1, 1.0, 0.0))[1]


def test_samples_that_repeat_the_one_before_are_told_unless_it_is_chance() -> None:
    stale = np.arange(100, 2000, 10)
    told = "190 samples like the one before in all channels, the first at t = 1 s"
    assert noticed(changed(stale, NOISY[stale - 1]))[0].endswith(told)
    assert "like the one" not in noticed(np.round(NOISY, 3))[0]
    assert "like the one" not in noticed(np.where(T < 3, 0.0, NOISY))[0], "at rest"
    u = changed(stale, 0.0, np.cos(T))
    data = data_of(changed(stale, NOISY[stale - 1]), u=u, inputs=["u"])
    assert "like the one" not in data.noticed["noticed"][0]


def test_steps_of_a_run_that_are_a_power_of_ten_longer_are_told() -> None:
    for factor, is_told in ((1000, True), (0.1, True), (7, False), (1, False)):
        runs: Any = ([T, T, factor * T], [NOISY] * 3)
        clock = data_of(runs[1], runs[0]).noticed["noticed"][0]
        said = (
            f"the steps of run 3 are {factor:g} times those of others: in another unit?"
        )
        assert (said in clock) == is_told


def test_a_last_line_that_was_cut_is_told() -> None:
    lines = [f"{t:.2f},{q:.4f}" for t, q in zip(T[:40], NOISY, strict=False)]
    for text, is_told in (("\n".join(lines), False), ("\n".join(lines)[:-2], True)):
        for end in ("", "\n"):
            file = io.StringIO(f"t,q\n{text}{end}")
            data = ph.Measurements.from_csv(file, time="t", states=["q"])
            assert ("may be cut: '0." in str(data)) == (is_told and not end)


def test_an_input_that_jumps_is_told_with_its_hold() -> None:
    u = np.repeat(RNG.normal(size=20), 100)
    for hold, said in (("zero", "held"), ("linear", NOT_HELD)):
        table = data_of(NOISY, u=u, inputs=["u"], hold=hold).noticed
        assert table["noticed"][2] == f"constant between jumps, {said}"
        assert np.isnan(table["noise"][2]) == (hold == "zero"), "steps are no noise"


def test_peaks_of_an_input_may_be_kicks_of_a_controller() -> None:
    u = changed([400, 1200], [1.5, -2.0])
    said = {}
    for hold in ("linear", "zero"):
        table = data_of(NOISY, u=u, inputs=["u"], hold=hold).noticed
        said[hold] = table["noticed"][2]
    place = "2 peaks of one sample, the first at t = 4 s"
    assert said == {"linear": f"{place}: errors, or kicks of a controller", "zero": ""}


def test_a_run_whose_name_is_a_number_is_called_run() -> None:
    titles = {}
    for name in ("3", "bench 3"):
        titles[name] = data_of(NOISY, names=[name]).trajectories[0].title
    assert titles == {"3": "run 3", "bench 3": "bench 3"}


def test_the_table_has_numbers_for_the_clock_and_every_channel() -> None:
    x = np.column_stack([np.round(NOISY, 2), np.full(T.size, np.nan)])
    units = {"t": "s", "q": "m", "u": "V"}
    names: Any = {"states": ["q", "p"], "inputs": ["u"], "units": units}
    table = ph.Measurements.from_arrays(T, x, np.cos(T), **names).noticed
    assert table["channel"].tolist() == ["t", "q", "p", "u"]
    q = table.loc[1]
    assert q["resolution"] == pytest.approx(0.01)
    assert q["noise"] == pytest.approx(np.hypot(0.01, 0.01 / np.sqrt(12)), rel=0.2)
    assert (q["lowest"], q["highest"]) == (x[:, 0].min(), x[:, 0].max())
    assert table["noticed"][2] == "not measured"
    assert max(map(len, str(table).splitlines())) <= 80


# ---- the picture


def curves_of(chart: Chart, panel: int = 0) -> dict[str, Curve]:
    return {curve.name: curve for curve in chart.panels[panel].curves}


def test_runs_stand_one_after_another_on_one_scale_of_time() -> None:
    runs: Any = ([T[:1000], T[:500]], [NOISY[:1000], NOISY[:500]])
    chart = data_of(runs[1], runs[0]).chart()
    assert chart.ticks == (["run 1"], ["run 2"])
    (line,) = chart.panels[0].curves
    (gap,) = np.flatnonzero(np.isnan(line.y))
    first, second = line.x[:gap], line.x[gap + 1 :]
    assert np.ptp(first) == pytest.approx(2 * np.ptp(second), rel=0.01)
    assert -0.5 < first[0] < first[-1] < 0.5 < second[0] < second[-1] < 1.5
    assert chart.x_label == "runs in turn, up to 9.99 s long"


def test_what_is_held_out_is_marked_with_its_times() -> None:
    train, held_out = data_of(NOISY, T).split(0.7)
    chart = train.chart(held_out)
    assert (chart.x_label, chart.ticks) == ("t (s)", ())  # one clock, one axis
    (line,) = chart.panels[0].curves
    assert np.nanmax(line.x) == T[-1]
    fitted, judging = chart.spans
    assert (fitted.shade, judging.shade) == ("", "held out: not used for fitting")
    ends = held_out.trajectories[0].t[[0, -1]]
    assert [judging.low, judging.high] == pytest.approx(ends)
    runs: Any = ([T[:500], T[:500] + 3], [NOISY[:500], NOISY[500:1000]])
    both = data_of(runs[1], runs[0])
    chart = both[:1].chart(final=both[1:])
    assert chart.ticks == (["run 1", "0 to 4.99 s"], ["run 2", "3 to 7.99 s"])
    assert [one.shade for one in chart.spans] == ["", "for the final test"]
    assert [(one.begin, one.end) for one in chart.spans] == [(0.0, 4.99), (3.0, 7.99)]
    drawn_on = Figure().add_subplot()
    draw(drawn_on, chart)
    legend = drawn_on.get_legend()
    assert legend is not None
    assert "for the final test" in [one.get_text() for one in legend.get_texts()]


def test_gaps_limits_and_outliers_are_marked_where_they_are() -> None:
    kept = np.abs(T - 5) > 0.5
    q = changed(1500, 2.0, np.minimum(NOISY, 0.8))[kept]
    marked = curves_of(data_of(q, T[kept]).chart())
    assert marked["gap"].x[:2] == pytest.approx([4.49, 5.51])
    ring = marked["single sample far from both neighbours"]
    assert (ring.x.tolist(), ring.y.tolist()) == ([15.0], [2.0])


def test_a_long_record_is_thinned_with_its_extremes() -> None:
    t = np.arange(100_000.0)
    q = changed(31_415, 7.0, np.sin(t))
    line = data_of(q, t).chart().panels[0].curves[0]
    assert len(line.x) < 5000
    assert line.y.max() == 7.0


@pytest.mark.parametrize("n_runs", [1, 3, 30, 300])
def test_the_picture_has_a_panel_for_each_measured_channel(n_runs: int) -> None:
    runs: Any = [np.column_stack([NOISY, np.full(T.size, np.nan)])[:50]] * n_runs
    names: Any = {"states": ["q", "p"], "inputs": ["u"], "units": {"q": "m"}}
    u = [np.cos(T[:50])] * n_runs
    data = ph.Measurements.from_arrays([T[:50]] * n_runs, runs, u, **names)
    ax = Figure().add_subplot()
    assert data.plot(ax) is ax
    upper, lower = ax.figure.axes
    assert (upper.get_ylabel(), lower.get_ylabel()) == ("q (m)", "u, input")
    assert len([one for one in lower.get_xticklabels() if one.get_text()]) <= 10

"""Measurements as a chart: a panel for each channel, the runs one after another."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from os.path import commonprefix
from textwrap import wrap

import numpy as np

from phsi_opt.data.noticed import BEYOND, ChannelLook, DataLook
from phsi_opt.data.spectrum import spectrum
from phsi_opt.presentation.charts import (
    ATTENTION,
    FORCE,
    FREE,
    LOG,
    MEASURED,
    MODEL,
    POINTS,
    RINGS,
    Chart,
    Curve,
    Panel,
    Span,
    time_label,
)
from phsi_opt.presentation.content import thinned
from phsi_opt.presentation.numbers import label, number_of
from phsi_opt.presentation.units import (
    computed_unit,
    scale_of,
    scale_of_time,
    time_words,
    times_words,
)

FITTED_GROUND = ("", "")  # the ground of data that are fitted has no name and no colour
HELD_OUT_GROUND = ("held out: not used for fitting", MEASURED)
FINAL_GROUND = ("for the final test", ATTENTION)
Ground = tuple[str, str]


def data_chart(look: DataLook, grounds: Sequence[Ground] = ()) -> Chart:
    """Every measured channel over time, states first.

    Parts of one record have one axis of time. Several runs stand one after another, in
    cells of one scale of time. A dotted line is a gap, rings are around single samples
    far from both neighbours, and orange points are samples at a limit of the sensor.

    Args:
        look: the measurements.
        grounds: of each run, one of the three above; (): all runs are fitted.
    """
    channels = [one for one in look.channels if len(one.known)]
    height = 0.8 if len(channels) == 1 else 0.55
    x, x_label, ticks, clock = _axis(look)
    spans, time = _spans(look, x, grounds or [FITTED_GROUND] * len(look.trajectories))
    told: set[str] = set()  # names that the legend has
    panels = []
    for one in channels:
        curves = []
        for curve in (_line(look, one, x), *_marks(look, one, x)):
            curves.append(replace(curve, name="" if curve.name in told else curve.name))
            told.add(curve.name)
        name = label(f"{one.called}, input" if one.hold else one.called, one.unit)
        panels.append(Panel(name, curves, height=height, scale=FREE))
    n_runs = number_of(len(look.trajectories), "trajectory", "trajectories")
    title = f"{n_runs}, {len(look.t)} samples"
    return Chart(x_label, tuple(panels), title, ticks, None, spans, time, clock)


def _spans(
    look: DataLook, x: np.ndarray, grounds: Sequence[Ground]
) -> tuple[tuple[Span, ...], str]:
    """Where each run stands, with its times, and the label of these."""
    scale = scale_of_time(float(np.abs(look.t).max()), look.units["t"])
    spans = []
    for k, (run, ground) in enumerate(zip(look.trajectories, grounds, strict=True)):
        low, high = x[look.run == k][[0, -1]].tolist()
        begin, end = (run.t[[0, -1]] / scale.size).tolist()
        spans.append(Span(run.name, low, high, begin, end, *ground))
    return tuple(spans), label("t", scale.unit)


def _axis(
    look: DataLook, most_names: int = 10, letters: int = 38, width: float = 0.94
) -> tuple[np.ndarray, str, tuple[list[str], ...], float]:
    """Where each sample stands, (n_samples,); label, ticks and clock of the axis.

    Below the axis there is room for ten names of runs, on a narrow screen for 38
    letters; the longest run takes 94 % of its cell.
    """
    runs = look.trajectories
    begins = np.array([run.t[0] for run in runs])
    lengths = np.array([run.t[-1] - run.t[0] for run in runs])
    longest = float(lengths.max())
    unit = look.units["t"]
    order = np.argsort(begins)
    waits = begins[order[1:]] - (begins + lengths)[order[:-1]]
    has_one_clock = len({run.origin for run in runs}) == 1
    if has_one_clock and np.all(waits >= 0) and waits.sum() < lengths.sum() / 2:
        scale = scale_of_time(float(np.abs(look.t).max()), unit)
        x_label = time_label(scale.unit, runs[0].origin)
        return look.t / scale.size, x_label, (), scale.size
    cells = np.arange(len(runs)) - width * lengths / longest / 2
    x = cells[look.run] + width * (look.t - begins[look.run]) / longest
    each = "each" if np.ptp(lengths) < 0.01 * longest else "up to"
    x_label = f"runs in turn, {each} {time_words(longest, unit)} long"
    if np.ptp(begins) == 0 and each == "each":
        within = times_words(begins[0], begins[0] + longest, unit)
        x_label = f"runs in turn, each from {within}"
    if len(runs) > 200:
        return x + 1, f"number of the run; {x_label}", (), 0.0
    every = -(-len(runs) // most_names)
    room = max(letters // min(len(runs), most_names), 5)
    names = [run.name for run in runs]
    if max(map(len, names)) > 2 * room:  # without what all names begin with
        begin = commonprefix(names)  # noqa: RUF071 -- these are no paths
        names = [name.removeprefix(begin) for name in names]
    shown = [name if k % every == 0 else "" for k, name in enumerate(names)]
    ticks = []
    for run, name in zip(runs, shown, strict=True):
        lines = wrap(name, room, break_long_words=False)[:4]
        if np.ptp(begins) > 0 and every == 1:
            within = times_words(run.t[0], run.t[-1], unit)
            lines += wrap(within, room, break_long_words=False)
        ticks.append(lines)
    return x, x_label, tuple(ticks), 0.0


def _line(look: DataLook, one: ChannelLook, x: np.ndarray) -> Curve:
    """The channel; lines end at runs and gaps, points are where some miss."""
    color = FORCE if one.hold else MODEL
    y = one.values[one.known]
    x = x[one.known]
    if len(y) < len(one.values):
        return _thinned(Curve("", x, y, color, POINTS))
    is_break = np.isnan(look.steps[:-1])
    is_break[look.gaps] = True
    if one.hold == "zero":
        kept = np.where(is_break, np.nan, y[:-1])  # at the time of the next sample
        y = np.insert(y, np.arange(1, len(y)), kept)
        return _thinned(Curve("", np.repeat(x, 2)[1:], y, color))
    places = np.flatnonzero(is_break) + 1
    y = np.insert(y, places, np.nan)
    return _thinned(Curve("", np.insert(x, places, x[places]), y, color))


def _thinned(curve: Curve) -> Curve:
    kept = thinned([curve.y], 4000)
    return replace(curve, x=curve.x[kept], y=curve.y[kept])


def _marks(look: DataLook, one: ChannelLook, x: np.ndarray) -> Iterator[Curve]:
    """What is to be seen: gaps, samples at a limit, single samples far away."""
    if len(look.gaps):
        ends = np.array([look.gaps, look.gaps + 1, look.gaps + 1])
        y = np.array([*one.values[ends[:2]], np.full(len(look.gaps), np.nan)])
        yield Curve("gap", x[ends].T.ravel(), y.T.ravel(), ATTENTION, "dot")
    if len(one.at_limit):
        y = one.values[one.at_limit]
        yield _thinned(Curve("at a limit", x[one.at_limit], y, ATTENTION, POINTS))
    if len(one.outliers):
        y = one.values[one.outliers]
        name = "single sample far from both neighbours"
        yield Curve(name, x[one.outliers], y, ATTENTION, RINGS)


def spectrum_chart(look: DataLook) -> Chart:
    """The amplitude of every channel over frequency, states first."""
    time = look.units["t"]
    computed = computed_unit(time)
    size = scale_of(computed).size if computed == "s" else 1.0
    unit = "Hz" if computed == "s" else f"1/{time}" if time else ""
    panels = []
    for one in look.channels:
        known = one.known
        if len(known) < 3 or not np.ptp(one.values[known]):
            continue
        t = look.t[known]
        line = np.polyfit(t - t[0], one.values[known], 1)
        y = one.values[known] - np.polyval(line, t - t[0])
        steps = np.diff(t)
        is_gap = steps > BEYOND * np.median(steps)  # which ends a stretch
        stretch = look.run[known] + np.cumsum(np.append(False, is_gap))
        found = spectrum(t, stretch, y)
        kept = thinned([found.amplitudes], 4000)
        curve = Curve("", found.frequencies[kept] / size, found.amplitudes[kept], MODEL)
        curve = replace(curve, color=FORCE) if one.hold else curve
        panels.append(
            Panel(label(one.called, one.unit), (curve,), height=0.55, scale=LOG)
        )
    return Chart(label("frequency", unit), tuple(panels), "spectrum")

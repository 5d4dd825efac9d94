"""The charts of a study, made once: for a script, as SVG, and on axes.

A `Chart` says what is drawn; ``chart.js`` draws it in page and report (`figure`), and
matplotlib on paper, in notebooks and in browsers without scripts (`svg`, `draw`).
Names are never read as formulas or markup. Nothing here calls ``plt.show``.
"""

import datetime as dt
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from functools import partial
from itertools import chain, cycle, product
from textwrap import fill, wrap
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from phsi_opt.presentation.content import (
    Channel,
    ErrorStep,
    Follows,
    ForceRun,
    Run,
    StudyContent,
)
from phsi_opt.presentation.numbers import (
    label,
    number,
    proper_names,
    shortened,
    with_interval,
)
from phsi_opt.presentation.units import date_words

# Contrast to white and to #16191d at least 3:1, as WCAG asks of graphics.
MEASURED = "#7a828c"  # grey: what was measured, and what stands for comparison
MODEL = "#2f7fd6"  # blue: the model, and what was estimated
FLOOR = "#3b8f5a"  # green: noise
ATTENTION = "#c8611a"  # orange: what a reader should look at first
FORCE = "#9a5fd0"  # violet: what is missing
BASELINE = "0.3"  # dark grey: the line at zero
FORCE_COLORS = (FORCE, ATTENTION, FLOOR, MODEL)
# Of one model; of base and present model; of base, first step and present model.
MODEL_LOOKS = (
    ((MODEL, "solid"),),
    ((ATTENTION, "dash"), (MODEL, "solid")),
    ((ATTENTION, "dash"), (FORCE, "dot"), (MODEL, "solid")),
)
POINTS = "points"
STEPS = "steps"
RINGS = "rings"
FILLED = "band"  # what ``std`` says, with a thin line where it is narrow
MATPLOTLIB_LOOKS: dict[str, Any] = {
    "solid": {},
    "dash": {"ls": "--"},
    "dot": {"ls": ":"},
    POINTS: {"ls": "none", "marker": ".", "ms": 3},
    STEPS: {"marker": "o", "ms": 5},
    FILLED: {"lw": 0.8},
    RINGS: {"ls": "none", "marker": "o", "ms": 9, "mfc": "none"},
}
STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "report",  # the same names of parts in every run
    "text.parse_math": False,  # a "$" in a name is a "$"
    "font.size": 10,
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
}
FROM_ZERO = "from zero"
LOG = "log"
FREE = "free"
Mark = tuple[float, str]  # a time, with what it is called


@dataclass(frozen=True)
class Span:
    """A run where it stands on the first axis, with its times."""

    name: str
    low: float  # where it begins on the axis
    high: float
    begin: float  # its first time
    end: float
    shade: str = ""  # what its ground is called in the legend; "": it has none
    color: str = ""  # of the ground


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve of (n,) points."""

    name: str  # for the legend; "" keeps it out
    x: np.ndarray
    y: np.ndarray
    color: str
    # ``POINTS``, ``RINGS``, ``STEPS`` (line and markers), or a kind of line
    look: str = "solid"
    std: np.ndarray | None = None  # half the width of a band around it; None: no band
    band: str = "two standard deviations"  # what the band is called
    texts: tuple[str, ...] = ()  # beside the points
    is_below: tuple[bool, ...] = ()  # whether a text stands below its point
    is_shown: bool = True  # before somebody asks for it
    group: str = ""  # the name of the curve with which it is shown or not


@dataclass(frozen=True, eq=False)
class Panel:
    """Curves over one axis."""

    label: str
    curves: Sequence[Curve]
    # Half the width of the band that noise fills; None: no band.
    noise: float | None = None
    band: str = "noise, two standard deviations"  # what the band is called
    height: float = 1.0  # relative to the other panels
    # of the axis: ``FROM_ZERO``, ``LOG``, ``FREE``, or "": with a line at zero
    scale: str = ""


@dataclass(frozen=True, eq=False)
class Chart:
    """Panels one below the other."""

    x_label: str
    panels: tuple[Panel, ...]
    title: str = ""
    # Lines of text on the first axis, in place of numbers.
    ticks: tuple[list[str], ...] = ()
    mark: Mark | None = None  # a place on it
    spans: tuple[Span, ...] = ()  # runs that share it
    time: str = ""  # the label of their times
    # Of the first axis, in the unit of the times that it shows; 0: it shows none.
    clock: float = 0.0


# ---- what is drawn -------------------------------------------------------------------


def errors_chart(steps: Sequence[ErrorStep], unit: str) -> Chart:
    """The errors step by step, with the 95 % interval of the noise floor."""
    n = len(steps)
    x = np.arange(n, dtype=float)
    errors = np.array([(one.train, one.held_out, one.floor) for one in steps], float)
    train, held_out, floor = errors.T
    is_below = train <= held_out  # of two near errors both numbers are seen
    curves = [_steps("training", x, train, MODEL, is_below)]
    of = ""
    if np.isfinite(held_out).any():
        of = " of held-out data"
        training = replace(curves[0], color=MEASURED)
        curves = [training, _steps("held out", x, held_out, MODEL, ~is_below)]
    final = np.array([one.final for one in steps], float)
    if np.isfinite(final).any():
        curves.append(Curve("final test", x, final, ATTENTION, "dot"))
    ends = np.array([one.floor_ends for one in steps])
    ends = np.where(np.isfinite(ends), ends, floor[:, None])
    band = f"noise floor{of} {with_interval(floor[-1], ends[-1])}"
    ends = np.pad(ends, ((1, 1), (0, 0)), mode="edge")
    wide = np.r_[-0.5, x, n - 0.5]  # a band where there is one step too
    middle = ends.mean(axis=1)
    half = np.ptp(ends, axis=1) / 2
    curves.append(Curve("", wide, middle, FLOOR, FILLED, half, band, group=band))
    known = errors[errors > 0]
    is_log = n > 1 and known.size > 0 and known.max() >= 10 * known.min()
    scale, told = (LOG, "error, on a log scale") if is_log else (FROM_ZERO, "error")
    panel = Panel(label(told, unit), curves, scale=scale)
    changes = [proper_names(step.change(k)) for k, step in enumerate(steps)]
    n_letters = max(60 // n, 8)  # of each label: side by side they have 60
    return Chart("", (panel,), ticks=tuple(wrap(one, n_letters) for one in changes))


def _steps(
    name: str, x: np.ndarray, y: np.ndarray, color: str, is_below: np.ndarray
) -> Curve:
    texts = tuple(number(one, 3) if np.isfinite(one) else "" for one in y)
    below = tuple(is_below.tolist())
    return Curve(name, x, y, color, STEPS, texts=texts, is_below=below)


def run_chart(
    content: StudyContent, run: Run, channel: int, mark: Mark | None = None
) -> Chart:
    """The channel of a number measured and simulated, with the residuals below."""
    x_label = time_label(content.time.unit, run.origin)
    panels = channel_panels(run.channels[channel], content.names)
    return Chart(x_label, panels, run.title, mark=mark)


def channel_panels(one: Channel, names: Sequence[str]) -> tuple[Panel, Panel]:
    """A channel measured and simulated by models of these names; the residuals.

    Where curves lie upon each other, the residuals have most of the room.
    """
    residuals = [one.measured - model for model in one.models]
    curves = []
    for curve in _of_models(names, one.t, residuals):
        curves.append(replace(curve, name="", group=curve.name))
    largest = np.nanmax(np.abs(np.concatenate([[0.0], *residuals])))
    sigma = one.noise or 0.0
    noise = 2 * sigma if sigma > 0.005 * largest else None  # of a band that is seen
    # More where curves are hardly told apart.
    height = 1.4 if one.change < 0.1 else 0.5
    below = Panel(label("residual", one.unit), curves, noise=noise, height=height)
    measured = Curve("measured", one.t, one.measured, MEASURED, POINTS)
    shown = _of_models(names, one.t, one.models)
    if one.std is not None:
        shown = [replace(curve, std=2 * one.std) for curve in shown]
    return Panel(one.title, [measured, *shown]), below


def _of_models(
    names: Sequence[str], t: np.ndarray, values: Sequence[np.ndarray]
) -> list[Curve]:
    """A curve for each model; the first and the last are shown."""
    last = len(values) - 1
    curves = []
    for k, (color, look) in enumerate(MODEL_LOOKS[last]):
        is_shown = k in (0, last)
        curves.append(Curve(names[k], t, values[k], color, look, is_shown=is_shown))
    return curves


def force_chart(
    forces: Sequence[ForceRun], unit_of_time: str, mark: Mark | None = None
) -> Chart:
    """The missing forces of one run with two standard deviations each."""
    units = {one.unit for one in forces}
    what = " and ".join(dict.fromkeys(one.quantity for one in forces))
    y_label = label(f"missing {what}", units.pop() if len(units) == 1 else "")
    x_label = time_label(unit_of_time, forces[0].origin)
    curves = []
    for one, color in zip(forces, cycle(FORCE_COLORS), strict=False):
        name = f"missing in {one.equation}" if len(forces) > 1 else "missing"
        curves.append(Curve(name, one.t, one.force, color, std=2 * one.std))
    return Chart(x_label, (Panel(y_label, curves),), forces[0].run, mark=mark)


def follows_chart(found: Follows) -> Chart:
    """A missing force against what it follows, with the law that was found.

    Before a law is found, with its mean in bins: these would smear the step of a law.
    """
    dots = Curve("estimated", found.x, found.force, MEASURED, POINTS)
    binned = (found.centre, found.mean, MODEL, STEPS, found.std, "std. deviation")
    through = Curve("mean in bins", *binned)
    if found.law is not None:
        through = Curve("the law that was found", found.x, found.law, ATTENTION, POINTS)
    return Chart(found.x_label, (Panel(found.y_label, (dots, through)),))


def time_label(unit: str, origin: dt.datetime | None) -> str:
    """The label of an axis of time, with the date at which the time is 0."""
    date = date_words(0.0, origin)
    return label("t", unit) + (f" since {date}" if date else "")


def _short(name: str) -> str:
    """A name that leaves room for the curves; the text has it whole."""
    return shortened(name, 44)


# ---- by a script -------------------------------------------------------------------


def figure(value: Any) -> Any:
    """What ``chart.js`` draws: a chart, or a part of it, as JSON; None for NaN."""
    if isinstance(value, np.ndarray):
        return rounded(value)
    if isinstance(value, list | tuple):
        return list(map(figure, value))
    if isinstance(value, Mapping):
        return {name: figure(one) for name, one in value.items()}
    return figure(vars(value)) if is_dataclass(value) else value


def rounded(curve: np.ndarray) -> list[float | None]:
    """Values (n,) with seven digits of their range, to be saved too; None for NaN."""
    known = curve[np.isfinite(curve)]
    extent = float(np.ptp(known)) if len(known) else 0.0
    size = extent or (abs(float(known[0])) if len(known) else 1.0) or 1.0
    n_decimals = 6 - math.floor(math.log10(size))
    values = curve.tolist()
    return [round(one, n_decimals) if math.isfinite(one) else None for one in values]


def numbers_of(chart: Chart) -> pd.DataFrame:
    """The numbers of a chart, as its button saves them: a row for each place.

    A column for each curve and for half of each band; of runs that share the axis the
    run and its time.
    """
    columns: dict[str, pd.Series] = {}
    curves = chain.from_iterable(product([one], one.curves) for one in chart.panels)
    for panel, curve in curves:
        name = ", ".join(filter(None, (curve.name or curve.group, panel.label)))
        table = pd.DataFrame({"x": curve.x, name: curve.y})
        if curve.std is not None:
            table[f"{name}, half of the band"] = curve.std
        table = table.dropna(subset=[name])
        if chart.ticks and not chart.spans:
            table = table[table["x"] % 1 == 0]  # of the steps themselves
        if curve.look != POINTS:  # of a jump the value after it
            table = table.drop_duplicates("x", keep="last")
        table["nth"] = table.groupby("x").cumcount()
        placed = table.set_index(["x", "nth"])
        for column in placed:
            columns[str(column)] = placed[column]
    found = pd.DataFrame(columns).sort_index().reset_index(level="x")
    x = found.pop("x").to_numpy()
    if not chart.spans:
        found.insert(0, chart.x_label or "step", x)
        return found.reset_index(drop=True)
    runs = np.full(len(x), "", dtype=object)
    times = np.full(len(x), np.nan)
    for one in chart.spans:
        inside = (x >= one.low) & (x <= one.high)
        share = (x[inside] - one.low) / (one.high - one.low)
        times[inside] = one.begin + share * (one.end - one.begin)
        runs[inside] = one.name
    n_decimals = 9 - int(np.log10(max(np.nanmax(np.abs(times)), 1.0)))
    found.insert(0, chart.time, times.round(n_decimals))
    found.insert(0, "run", runs)
    return found.reset_index(drop=True)


# ---- by matplotlib -------------------------------------------------------------------


def svg(chart: Chart, width: float = 7.2) -> str:
    """A chart as the text of an SVG file; as wide as a page, or less (inches)."""
    return saved(chart, "svg", width).decode()


def saved(chart: Chart, kind: str, width: float = 7.2) -> bytes:
    """A chart as a file: ``csv`` for its numbers, or ``svg``, ``png``, ``pdf``."""
    if kind == "csv":
        return numbers_of(chart).to_csv(index=False).encode()
    with rc_context(STYLE):
        figure = Figure(figsize=_size(chart, width), layout="constrained")
        ax = drawn(chart, ax=figure.add_subplot())
        for line in chain.from_iterable(map(Axes.get_lines, figure.axes)):
            if line.get_linestyle() == "None":  # each of many points takes 100 letters
                line.set_rasterized(np.size(line.get_xdata()) > 300)
        set_title(ax, _short(chart.title), loc="left", fontsize=10)
        content = io.BytesIO()
        unwritten = {"Date": None, "Creator": None} if kind == "svg" else {}
        figure.savefig(content, dpi=150, format=kind, metadata=unwritten)
    return content.getvalue()


def _size(chart: Chart, width: float) -> tuple[float, float]:
    return width, 1.0 + 2.4 * sum(panel.height for panel in chart.panels)


def axes_of(ax: Axes | None, size: tuple[float, float]) -> Axes:
    """The axes; None: those of a new figure, whose size is in inches."""
    import matplotlib.pyplot as plt

    return ax or plt.subplots(figsize=size, layout="constrained")[1]


def _rows_of(ax: Axes, heights: Sequence[float]) -> list[Axes]:
    """The place of axes in rows of relative heights; the first one has the axes."""
    place = ax.get_subplotspec()
    if place is None:  # free in the figure: a grid within the same box
        box = ax.get_position()
        edges = {"left": box.x0, "right": box.x1, "bottom": box.y0, "top": box.y1}
        place = ax.figure.add_gridspec(1, 1, **edges)[0]
    grid = place.subgridspec(len(heights), 1, height_ratios=heights)
    ax.set_subplotspec(grid[0])
    rows = [ax]
    for k in range(1, len(heights)):
        rows.append(ax.figure.add_subplot(grid[k], sharex=ax))
    return rows


def drawn(chart: Chart, title: str = "", ax: Axes | None = None) -> Axes:
    """All panels of a chart below each other, the first one on axes."""
    heights = [panel.height for panel in chart.panels]
    ax = axes_of(ax, _size(chart, 8.0))
    rows = _rows_of(ax, heights) if len(heights) > 1 else [ax]
    for place, row in enumerate(rows):
        draw(row, chart, place)
        is_last = row is rows[-1]
        row.tick_params(axis="x", labelbottom=is_last)
        row.xaxis.label.set_visible(is_last)
    if title:
        set_title(ax, title)
    return ax


def set_title(ax: Axes, title: str, **look: Any) -> None:
    """Above the legend."""
    legend = ax.get_legend()
    n_rows = math.ceil(len(legend.get_texts()) / 3) if legend else 0
    ax.set_title(title, pad=6 + 14 * n_rows, **look)  # points, above the legend


def draw(ax: Axes, chart: Chart, place: int = 0) -> None:
    """Draw the panel of a number."""
    ax.set_xlabel(_short(chart.x_label))
    panel = chart.panels[place]
    for curve in panel.curves:
        _draw_curve(ax, curve)
    shaded = set()
    for span in chart.spans:
        if span.shade:
            ground = ax.axvspan(span.low, span.high, color=span.color, alpha=0.2, lw=0)
            ground.set_label(span.shade if span.shade not in shaded else "")
            shaded.add(span.shade)
    if panel.noise is not None:
        band = ax.axhspan(-panel.noise, panel.noise, color=FLOOR, alpha=0.2, lw=0)
        band.set_label(panel.band)
    ax.set_ylabel(fill(_short(panel.label), int(32 * panel.height)))
    ax.margins(y=0.25)
    if panel.scale == LOG:
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter("{x:g}")  # no formula of a power of ten
        ax.yaxis.set_minor_formatter(partial(_between_decades, ax))
    elif panel.scale == FROM_ZERO:
        ax.set_ylim(bottom=0)
    elif panel.scale != FREE and ax.get_ylim()[0] < 0 < ax.get_ylim()[1]:
        ax.axhline(0, color=BASELINE, lw=0.6)
    if chart.ticks:
        ax.set_xlim(-0.5, len(chart.ticks) - 0.5)
        ax.set_xticks(range(len(chart.ticks)), map("\n".join, chart.ticks))
    if ax.get_legend_handles_labels()[0]:
        # A handle is as long as the longest marker.
        room: Any = {"handlelength": 3.5, "columnspacing": 1.2}
        room |= {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0}
        ax.legend(frameon=False, fontsize=8, ncols=3, **room)


def _between_decades(ax: Axes, value: float, place: int) -> str:
    """Twice and five times a power of ten, on an axis of at most three decades."""
    low, high = ax.get_ylim()
    first = value / 10 ** math.floor(math.log10(value) + 1e-9)
    is_shown = high < 1000 * low and round(first, 6) in (2, 5)
    return f"{value:g}" if is_shown else ""


def _draw_curve(ax: Axes, curve: Curve) -> None:
    if curve.std is not None:
        ends = (curve.y - curve.std, curve.y + curve.std)
        look: Any = {"color": curve.color, "alpha": 0.2, "lw": 0}
        ax.fill_between(curve.x, *ends, label=curve.band, **look)
    look = {"lw": 1.3, "color": curve.color, **MATPLOTLIB_LOOKS[curve.look]}
    ax.plot(curve.x, curve.y, label=_short(curve.name) or None, **look)
    for k, text in enumerate(curve.texts):
        offset, place = (-4, "top") if curve.is_below[k] else (4, "bottom")
        look = {"ha": "center", "va": place, "color": curve.color}
        look |= {"xytext": (0, offset), "textcoords": "offset points"}
        ax.annotate(text, (curve.x[k], curve.y[k]), **look)

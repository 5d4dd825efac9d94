"""The charts of a study, made once: as figures of plotly, as SVG, and on axes.

A `Chart` says what is drawn; the page and the report's browser draw it by plotly
(`plotly`), paper and browsers without scripts by matplotlib (`svg`). Names are never
read as formulas or markup. Colours stand out 3:1 from white and from a dark ground.
"""

import datetime as dt
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from itertools import pairwise
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from phsi_opt.presentation.axes import (
    ATTENTION,
    BASELINE,
    FLOOR,
    FORCE,
    MARK,
    MEASURED,
    MODEL,
    label,
)
from phsi_opt.presentation.content import (
    ErrorStep,
    Follows,
    ForceMap,
    ForceRun,
    Run,
    StudyContent,
)
from phsi_opt.presentation.durations import date_words
from phsi_opt.presentation.numbers import number, proper_names
from phsi_opt.presentation.thinning import rounded

FORCE_COLORS = (FORCE, ATTENTION, FLOOR, MODEL)
# Of one model; of base and present model; of base, first step and present model.
MODEL_LOOKS = (
    ((MODEL, "solid"),),
    ((ATTENTION, "dash"), (MODEL, "solid")),
    ((ATTENTION, "dash"), (FORCE, "dot"), (MODEL, "solid")),
)
MATPLOTLIB_LINES = {"solid": "-", "dash": "--", "dot": ":"}
POINTS = "points"
STEPS = "steps"
TWO_DEVIATIONS = "two standard deviations"
BAND_OPACITY = 0.22
DIGITS_OF_TIME = 6  # over the range of a record: a zoomed curve has no steps
ASIDE = 0.05  # of a step, by which training and held-out error stand aside
BEHIND = 0.8  # of a step, that the axis goes on: room for the number of the floor
FAR_ABOVE = 2.0  # times the noise floor: there is room above the floor's number
LOW_SHARE = 0.2  # of the largest error, below which there is no room below a number
DECADE = 10  # ratio of errors from which on their axis is logarithmic
LETTERS_PER_INCH = 9.5  # of a tick label in matplotlib's default font
TICK_LETTERS = 16  # in a line of a step's label
MOST_LETTERS = 44  # of a name in a chart; the text has it whole
PANEL_GAP = 0.1  # of the height, between two panels
PAPER_WIDTH = 7.2  # inches: the width of a page of paper
STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "report",  # the same names of parts in every run
    "text.parse_math": False,  # a "$" in a name is a "$"
    "font.size": 10,
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
}


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve of (n,) points.

    Attributes:
        name: for the legend; "" keeps it out.
        look: ``POINTS``, ``STEPS`` (line and markers), or a kind of line.
        std: (n,) half the width of a band around it; None: there is none.
        band: what the band is called.
        texts: beside the points; ``sides``: "top left", ... of each.
        is_shown: whether it is drawn before somebody asks for it.
    """

    name: str
    x: np.ndarray
    y: np.ndarray
    color: str
    look: str = "solid"
    std: np.ndarray | None = None
    band: str = TWO_DEVIATIONS
    texts: tuple[str, ...] = ()
    sides: tuple[str, ...] = ()
    is_shown: bool = True


@dataclass(frozen=True, eq=False)
class Panel:
    """Curves over one axis.

    Attributes:
        noise: half the width of the band that noise fills; None: no band.
        height: beside that of the other panels.
        limits: of the axis; None: as the curves ask.
    """

    label: str
    curves: Sequence[Curve]
    noise: float | None = None
    height: float = 1.0
    limits: tuple[float, float] | None = None
    is_log: bool = False


@dataclass(frozen=True, eq=False)
class Chart:
    """Panels one below the other, or a map.

    Attributes:
        ticks: of the first axis, in place of numbers.
        mark: a place on it, with what it is called.
        window: a part of it to look at.
        map: in place of panels.
    """

    x_label: str
    panels: tuple[Panel, ...] = ()
    title: str = ""
    ticks: tuple[str, ...] = ()
    mark: tuple[float, str] | None = None
    window: tuple[float, float] | None = None
    map: ForceMap | None = None
    map_label: str = ""


# ---- what is drawn -------------------------------------------------------------------


def errors_chart(steps: Sequence[ErrorStep], unit: str) -> Chart:
    """The errors step by step, with their values, down to the noise floor."""
    x = np.arange(len(steps), dtype=float)
    train = _known([step.train for step in steps])
    held_out = _known([step.held_out for step in steps])
    floor = _known([step.floor for step in steps])
    has_held_out = bool(np.isfinite(held_out).any())
    aside = ASIDE if has_held_out else 0.0  # so that equal errors do not hide another
    judged = held_out if has_held_out else train
    curves = []
    if has_held_out:
        sides = _free_sides(train)
        curves.append(_steps("training", x - aside, train, MEASURED, sides))
    right = ("top right",) * len(x)
    name = "held out" if has_held_out else "training"
    curves.append(_steps(name, x + aside, judged, MODEL, right))
    is_low = judged[-1] > FAR_ABOVE * floor[-1]
    lowest = f"floor {number(floor[-1], 3)}" if np.isfinite(floor[-1]) else ""
    texts = ("",) * (len(x) - 1) + (lowest,)
    sides = ("top right" if is_low else "bottom right",) * len(x)
    curves.append(
        Curve("noise floor", x, floor, FLOOR, "dot", texts=texts, sides=sides)
    )
    limits, is_log = _error_axis(np.concatenate([train, held_out, floor]), len(x))
    panel = Panel(label("error", unit), curves, limits=limits, is_log=is_log)
    ticks = tuple(proper_names(step.change(k)) for k, step in enumerate(steps))
    return Chart("", (panel,), ticks=ticks)


def _steps(
    name: str, x: np.ndarray, y: np.ndarray, color: str, sides: tuple[str, ...]
) -> Curve:
    texts = tuple(number(one, 3) if np.isfinite(one) else "" for one in y)
    return Curve(name, x, y, color, STEPS, texts=texts, sides=sides)


def _free_sides(errors: np.ndarray) -> tuple[str, ...]:
    """Where numbers stand beside points on the left: below where the line falls."""
    places = ["top left"]
    for before, after in pairwise(errors):
        is_free_below = LOW_SHARE * np.nanmax(errors) < after < before
        places.append("bottom left" if is_free_below else "top left")
    return tuple(places)


def _error_axis(
    errors: np.ndarray, n_steps: int
) -> tuple[tuple[float, float] | None, bool]:
    """From zero; by decades where the errors of several steps span more than one."""
    known = errors[np.isfinite(errors) & (errors > 0)]
    if not len(known):
        return None, False
    least, most = float(known.min()), float(known.max())
    if most >= DECADE * least and n_steps > 1:
        return (least / 2, 3 * most), True
    return (0.0, 1.3 * most), False


def run_chart(
    content: StudyContent,
    run: Run,
    channel: int,
    mark: tuple[float, str] | None = None,
) -> Chart:
    """One channel measured and simulated, with the residuals below.

    Args:
        content: that the run is of; ``channel``: number of its channel.
        run: that is drawn.
        mark: a time, with what it is called.
    """
    one = run.channels[channel]
    looks = MODEL_LOOKS[len(content.names) - 1]
    residuals = []
    for k, (color, look) in enumerate(looks):
        off = one.measured - one.models[k]
        shown = k in (0, len(looks) - 1)
        residuals.append(Curve("", one.t, off, color, look, is_shown=shown))
    label_below = label("residual", one.unit)
    below = Panel(label_below, residuals, noise=_twice(one.noise), height=0.5)
    above = _measured_panel(content, run, channel)
    return Chart(_time(content, run.origin), (above, below), run.title, mark=mark)


def _twice(noise: float | None) -> float | None:
    return None if noise is None else 2 * noise


def _measured_panel(content: StudyContent, run: Run, channel: int) -> Panel:
    one = run.channels[channel]
    curves = [Curve("measured", one.t, one.measured, MEASURED, POINTS)]
    looks = MODEL_LOOKS[len(content.names) - 1]
    for k, (color, look) in enumerate(looks):
        shown = k in (0, len(looks) - 1)
        values = one.models[k]
        curves.append(
            Curve(content.names[k], one.t, values, color, look, is_shown=shown)
        )
    return Panel(label(one.name, one.unit), curves)


def glance_chart(content: StudyContent) -> Chart:
    """One channel measured and simulated, and the missing force below."""
    place = content.glance
    assert place is not None, "there is nothing to show"
    run = content.runs[place.run]
    panels = [_measured_panel(content, run, place.channel)]
    if place.force is not None:
        name = f"missing in d{place.force.equation}/dt"
        panels.append(_force_panel([place.force], label(name, place.force.unit), 0.8))
    x_label = _time(content, run.origin)
    return Chart(x_label, tuple(panels), run.title, window=place.window)


def force_chart(
    content: StudyContent,
    forces: Sequence[ForceRun],
    mark: tuple[float, str] | None = None,
) -> Chart:
    """The missing forces of one run with two standard deviations each."""
    units = {one.unit for one in forces}
    unit = units.pop() if len(units) == 1 else ""
    panel = _force_panel(forces, label("missing force", unit), 1.0)
    x_label = _time(content, forces[0].origin)
    return Chart(x_label, (panel,), forces[0].run, mark=mark)


def _force_panel(forces: Sequence[ForceRun], y_label: str, height: float) -> Panel:
    curves = []
    for k, one in enumerate(forces):
        color = FORCE_COLORS[k % len(FORCE_COLORS)]
        name = f"missing in d{one.equation}/dt"
        curves.append(Curve(name, one.t, one.force, color, std=2 * one.std))
    return Panel(y_label, curves, height=height)


def follows_chart(content: Follows) -> Chart:
    """A missing force against what it follows."""
    dots = Curve("force", content.x, content.force, MEASURED, POINTS)
    mean = Curve(
        "mean in bins",
        content.centre,
        content.mean,
        MODEL,
        STEPS,
        content.std,
        "spread",
    )
    return Chart(content.x_label, (Panel(content.y_label, (dots, mean)),))


def map_chart(content: ForceMap, force_label: str) -> Chart:
    """The mean missing force over two variables."""
    return Chart(content.x_label, map=content, map_label=f"mean {force_label}")


def _time(content: StudyContent, origin: dt.datetime | None) -> str:
    """The label of an axis of time, with the date at which the time is 0."""
    date = date_words(0.0, origin)
    text = label("t", content.time.unit)
    return f"{text} since {date}" if date else text


def _known(numbers: Sequence[float | None]) -> np.ndarray:
    return np.array([np.nan if one is None else one for one in numbers], dtype=float)


def _short(name: str) -> str:
    """A name that leaves room for the curves."""
    if len(name) <= MOST_LETTERS:
        return name
    return f"{name[: MOST_LETTERS - 1]}\N{HORIZONTAL ELLIPSIS}"


# ---- by plotly -----------------------------------------------------------------------


def plotly(chart: Chart) -> dict[str, Any]:
    """Data and layout for plotly's library, as JSON takes them.

    Texts and grid have no colours: those of the page around them are taken.
    """
    look = _looks()
    data: list[dict[str, Any]] = []
    shapes: list[dict[str, Any]] = []
    notes: list[dict[str, Any]] = []
    bottom = f"y{len(chart.panels) or 1}"
    place = {"anchor": bottom, "zeroline": False}
    axes = {"xaxis": {**_plotly_axis(chart.x_label), **place}}
    if chart.map is not None:
        axes["yaxis1"] = _plotly_axis(chart.map.y_label)
        data.append(_plotly_map(chart.map, chart.map_label))
    domains = _domains([panel.height for panel in chart.panels])
    for k, (panel, domain) in enumerate(zip(chart.panels, domains, strict=True)):
        axis = {**_plotly_axis(panel.label), "domain": domain}
        if panel.limits is not None:
            ends = np.log10(panel.limits) if panel.is_log else np.array(panel.limits)
            axis["type"] = "log" if panel.is_log else "linear"
            axis["range"] = ends.tolist()
        axes[f"yaxis{k + 1}"] = axis
        for curve in panel.curves:
            data += _plotly_curve(curve, f"y{k + 1}")
        if panel.noise is not None:
            band = {"yref": f"y{k + 1}", "y0": -panel.noise, "y1": panel.noise}
            color = {"fillcolor": _faint(FLOOR)}
            shapes.append({**look["band"], **look["across"], **band, **color})
            notes.append({**look["note"], **look["noise"], "y": domain[1]})
    if chart.ticks:
        broken = [map(_escaped, wrap(one, TICK_LETTERS)) for one in chart.ticks]
        axes["xaxis"]["ticktext"] = ["<br>".join(lines) for lines in broken]
        axes["xaxis"]["tickvals"] = list(range(len(broken)))
        axes["xaxis"]["range"] = [-0.5, max(len(broken) - 1 + BEHIND, 1.5)]
    along = {**look["band"], **look["along"]}
    if chart.window is not None:
        begin, end = chart.window
        shapes.append({**along, "x0": begin, "x1": end, "fillcolor": _faint(ATTENTION)})
    if chart.mark is not None:
        t, text = chart.mark
        line = {"color": MARK, "width": 2, "dash": "dash"}
        shapes.append({**along, "type": "line", "x0": t, "x1": t, "line": line})
        notes.append(
            {**look["note"], "text": _escaped(text), "xref": "x", "x": t, "y": 1}
        )
    layout = {**look["layout"], **axes, "shapes": shapes, "annotations": notes}
    return {"data": data, "layout": layout}


@cache
def _looks() -> dict[str, Any]:
    """What all charts of plotly's library have in common."""
    path = files("phsi_opt.presentation") / "templates" / "chart.json"
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def _domains(heights: Sequence[float]) -> list[list[float]]:
    """Bottom and top of each panel, the first one at the top."""
    room = 1 - PANEL_GAP * (len(heights) - 1)
    top = 1.0
    found = []
    for height in heights:
        share = room * height / sum(heights)
        found.append([max(top - share, 0.0), top])
        top -= share + PANEL_GAP
    return found


def _plotly_axis(title: str) -> dict[str, Any]:
    text = {"text": _escaped(title), "font": {"size": 13}}
    return {**_looks()["axis"], "title": text}


def _plotly_curve(curve: Curve, axis: str) -> list[dict[str, Any]]:
    """The curve; before it the edges of its band, where it has one."""
    look = _looks()
    x = rounded(curve.x, DIGITS_OF_TIME)
    dash = curve.look if curve.look in MATPLOTLIB_LINES else "solid"
    trace: dict[str, Any] = {
        "type": "scatter",
        "x": x,
        "y": rounded(curve.y),
        "name": _escaped(_short(curve.name)),
        "yaxis": axis,
        "line": {"color": curve.color, "width": 2, "dash": dash},
        "hovertemplate": "%{y:.4g}",
        "showlegend": bool(curve.name),
        "visible": True if curve.is_shown else "legendonly",
        "mode": "lines",
        **look.get(curve.look, {}),
    }
    trace["marker"] = {**trace.get("marker", {}), "color": curve.color}
    if curve.texts:
        texts = {"text": curve.texts, "textposition": curve.sides}
        trace |= {"mode": "lines+markers+text", "cliponaxis": False, **texts}
    if curve.std is None:
        return [trace]
    edges = []
    for sign in (1, -1):
        y = rounded(curve.y + sign * curve.std)
        edge = {"type": "scatter", "x": x, "y": y, "yaxis": axis, **look["edge"]}
        edges.append({**edge, "showlegend": sign < 0, "name": curve.band})
    edges[1] |= {"fill": "tonexty", "fillcolor": _faint(curve.color)}
    return [*edges, trace]


def _plotly_map(content: ForceMap, name: str) -> dict[str, Any]:
    limit = _largest(content.force)
    return {
        **_looks()["map"],
        "x": rounded(content.x),
        "y": rounded(content.y),
        "z": [rounded(row) for row in content.force],
        "zmin": -limit,
        "zmax": limit,
        "colorbar": {"title": {"text": _escaped(name), "side": "right"}},
    }


def _largest(force: np.ndarray) -> float:
    known = force[np.isfinite(force)]
    return float(np.abs(known).max()) if len(known) else 1.0


def _faint(color: str) -> str:
    red, green, blue = (int(color[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},{BAND_OPACITY})"


def _escaped(text: str) -> str:
    """A text in which nothing is markup: plotly reads some tags in labels."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


# ---- by matplotlib -------------------------------------------------------------------


def svg(chart: Chart) -> str:
    """A chart as the text of an SVG file."""
    heights = [panel.height for panel in chart.panels] or [1.0]

    def draw(figure: Figure) -> None:
        panels = figure.subplots(
            len(heights), 1, sharex=True, squeeze=False, height_ratios=heights
        )
        if chart.map is not None:
            _draw_map(figure, panels[0, 0], chart.map, chart.map_label)
        for ax, panel in zip(panels[:, 0], chart.panels, strict=False):
            draw_panel(ax, panel, chart)
        panels[-1, 0].set_xlabel(_short(chart.x_label))
        panels[0, 0].set_title(_short(chart.title), loc="left", fontsize=10)

    return _svg(draw, 1.0 + 2.4 * sum(heights))


def _svg(draw: Callable[[Figure], None], height: float) -> str:
    with rc_context(STYLE):
        figure = Figure(figsize=(PAPER_WIDTH, height), layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return text.getvalue()


def draw_panel(ax: Axes, panel: Panel, chart: Chart | None = None) -> None:
    """The curves of a panel on axes, as a part of a chart where one is given."""
    for curve in panel.curves:
        _draw_curve(ax, curve)
    if panel.noise is not None:
        half = panel.noise
        text = "noise, two standard deviations"
        ax.axhspan(-half, half, color=FLOOR, alpha=0.2, lw=0, label=text)
    ax.set_ylabel(_short(panel.label))
    ax.margins(y=0.25)
    if panel.limits is not None:
        ax.set_yscale("log" if panel.is_log else "linear")
        ax.set_ylim(panel.limits)
    else:
        ax.axhline(0, color=BASELINE, lw=0.6)
    if chart is not None and chart.window is not None:
        ax.axvspan(*chart.window, color=ATTENTION, alpha=0.15, lw=0)
    if chart is not None and chart.ticks:
        ax.set_xlim(-0.5, len(chart.ticks) - 1 + BEHIND)
        ax.set_xticks(range(len(chart.ticks)), _broken_ticks(ax, chart.ticks))
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="upper right", frameon=False, fontsize=8, ncols=4)


def _broken_ticks(ax: Axes, ticks: Sequence[str]) -> list[str]:
    """Labels in lines so short that neighbours do not touch."""
    inches = ax.get_window_extent().width / ax.figure.dpi
    n_letters = max(int(LETTERS_PER_INCH * inches / (len(ticks) + BEHIND)), 8)
    return ["\n".join(wrap(one, n_letters)) for one in ticks]


def _draw_curve(ax: Axes, curve: Curve) -> None:
    if curve.std is not None:
        lower, upper = curve.y - curve.std, curve.y + curve.std
        look: Any = {"color": curve.color, "alpha": 0.2, "lw": 0}
        ax.fill_between(curve.x, lower, upper, label=curve.band, **look)
    dots = {POINTS: ".", STEPS: "o"}.get(curve.look, "_" if curve.texts else "")
    ax.plot(
        curve.x,
        curve.y,
        marker=dots,
        ms={"": 0, ".": 3, "o": 5, "_": 30}[dots],
        ls="none" if curve.look == POINTS else MATPLOTLIB_LINES.get(curve.look, "-"),
        lw=1.3,
        color=curve.color,
        label=_short(curve.name) or None,
    )
    for x, y, text, side in zip(
        curve.x, curve.y, curve.texts, curve.sides, strict=False
    ):
        if text and np.isfinite(y):
            is_left = side.endswith("left")
            ax.annotate(
                text,
                (x, y),
                xytext=(-6 if is_left else 6, 5 if side.startswith("top") else -14),
                textcoords="offset points",
                ha="right" if is_left else "left",
                color=curve.color,
            )


def _draw_map(figure: Figure, ax: Axes, content: ForceMap, name: str) -> None:
    limit = _largest(content.force)
    mean = np.ma.masked_invalid(content.force)
    look: Any = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit, "shading": "nearest"}
    mesh = ax.pcolormesh(content.x, content.y, mean, **look)
    figure.colorbar(mesh, ax=ax, label=_short(name))
    ax.set_ylabel(_short(content.y_label))

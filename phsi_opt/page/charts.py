"""Charts of a snapshot, as plotly's browser library takes them.

Text and grid take their colours from the page's style, which knows light and dark; the
curves have colours that stand out from both.
"""

import datetime as dt
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from phsi_opt.page.limits import CHART_POINTS
from phsi_opt.page.snapshot import ChannelCurves, ErrorStep, ForceCurve, RunCurves
from phsi_opt.presentation.axes import label
from phsi_opt.presentation.durations import TimeScale, date_words, scale_of_time
from phsi_opt.presentation.numbers import number, proper_names

Figure = dict[str, Any]

# Contrast to white and to #16191d at least 3:1, as WCAG asks of graphics.
MEASURED_COLOR = "#7a828c"
MODEL_COLOR = "#2f7fd6"
OTHER_COLOR = "#c8611a"
FLOOR_COLOR = "#3b8f5a"
MARK_COLOR = "#b5459e"
BAND_OPACITY = 0.22
FONT = "Roboto, system-ui, sans-serif"  # by name: widths of legends are taken from it
BEHIND = 0.8  # of a step, that the axis goes on: room for the number of the floor
ASIDE = 0.05  # of a step, by which training and held-out error stand aside
FAR_ABOVE = 2.0  # times the noise floor: there is room above the floor's number
LOW_SHARE = 0.2  # of the largest error, below which there is no room below a number
N_WORDS_A_LINE = 16  # letters of a step's label below the staircase
# Of plotly's buttons, all but zoom in, zoom out and the whole. They are taken out, not
# chosen: nested lists in the configuration make plotly's ``react`` draw without end.
UNUSED_BUTTONS = ("toImage", "zoom2d", "pan2d", "select2d", "lasso2d", "autoScale2d")
WORST = "worst moment"
RESIDUAL_PART = 0.3  # of the chart's height
RESIDUAL_GAP = 0.1  # of it, above the residual


def free_run(
    run: RunCurves,
    channel: ChannelCurves,
    t_unit: str,
    mark: float | None = None,
    is_worst: bool = False,
) -> Figure:
    """Measured and free run of one channel, with the residual below.

    Args:
        run: that is drawn; ``channel``: of it.
        t_unit: of the times of the run; long ones are drawn in hours or days.
        mark: the time that is marked, in the unit of the run.
        is_worst: whether that is the moment that the page has chosen.
    """
    scale = scale_of_run(run, t_unit)
    t = _thinned(run.t) / scale.size
    noise = 2 * channel.noise
    data = [
        _curve(t, channel.measured, "measured", MEASURED_COLOR, mode="markers"),
        _curve(t, channel.shown, "model", MODEL_COLOR),
        _curve(t, channel.residual, "residual", MODEL_COLOR, yaxis="y2"),
    ]
    data[-1]["showlegend"] = False  # its axis says what it is
    layout = _layout(_time_label(scale.unit, run.origin))
    upper_part = [RESIDUAL_PART + RESIDUAL_GAP, 1]
    layout["yaxis"] = _axis(_label(channel.name, channel.unit), upper_part)
    layout["yaxis2"] = _axis(_label("residual", channel.unit), [0, RESIDUAL_PART])
    layout["xaxis"]["anchor"] = "y2"  # times stand below the residual
    layout["shapes"] = [_band(-noise, noise, "y2")]
    layout["annotations"] = [_note("shaded: noise, two standard deviations")]
    _mark(layout, mark, scale, is_worst)
    return _figure(data, layout)


def scale_of_run(run: RunCurves | ForceCurve, t_unit: str) -> TimeScale:
    """The unit in which the times of a run are told: days where it lasts for days."""
    return scale_of_time(float(run.t[-1]), t_unit)


def missing_force(
    curves: Sequence[ForceCurve],
    t_unit: str,
    mark: float | None = None,
    is_worst: bool = False,
) -> Figure:
    """The missing force of one run with two standard deviations, an equation each.

    Arguments as in `free_run`.
    """
    scale = scale_of_run(curves[0], t_unit) if curves else TimeScale(t_unit, 1.0)
    data: list[Figure] = []
    colors = (MODEL_COLOR, OTHER_COLOR, FLOOR_COLOR, MARK_COLOR)
    for place, curve in enumerate(curves):
        color = colors[place % len(colors)]
        data += _banded(replace(curve, t=curve.t / scale.size), color)
    origin = curves[0].origin if curves else None
    layout = _layout(_time_label(scale.unit, origin))
    units = {curve.unit for curve in curves}
    unit = units.pop() if len(units) == 1 else ""
    layout["yaxis"] = _axis(_label("missing force", unit))
    layout["shapes"] = [_line("y", 0)]
    _mark(layout, mark, scale, is_worst)
    return _figure(data, layout)


def staircase(steps: Sequence[ErrorStep], unit: str) -> Figure:
    """The error of every step, with its value, down to the noise floor."""
    x = [step.number for step in steps]
    labels = [_broken(proper_names(_change(step))) for step in steps]
    judged = [step.judged for step in steps]
    is_held_out = steps[-1].held_out is not None
    data = []
    if is_held_out:
        train = [step.train for step in steps]
        # Aside, so that equal errors do not hide each other.
        left = [place - ASIDE for place in x]
        training = _step_curve(left, train, "training", MEASURED_COLOR, "dash")
        training["marker"]["symbol"] = "square"
        _write_values(
            training, [number(value, 3) for value in train], _free_sides(train)
        )
        data.append(training)
    name = "held out" if is_held_out else "training"
    right = [place + ASIDE for place in x] if is_held_out else x
    main = _step_curve(right, judged, name, MODEL_COLOR, "solid")
    _write_values(main, [number(value, 3) for value in judged], "top right")
    data.append(main)
    floor = [step.floor for step in steps]
    lowest = _step_curve(x, floor, "noise floor", FLOOR_COLOR, "dot")
    told = ["" for _ in floor[:-1]] + [f"floor {number(floor[-1], 3)}"]
    is_low = judged[-1] > FAR_ABOVE * floor[-1]
    _write_values(lowest, told, "top right" if is_low else "bottom right")
    data.append(lowest)
    layout = _layout("")
    layout["xaxis"].update(
        {
            "tickvals": x,
            "ticktext": labels,
            "range": [-0.5, max(len(x) - 1 + BEHIND, 1.5)],
        }
    )
    values = [*judged, *floor, *(step.train for step in steps)]
    layout["yaxis"] = _axis(_label("error", unit))
    layout["yaxis"].update(_error_axis(values, len(steps)))
    return _figure(data, layout)


def _free_sides(errors: Sequence[float]) -> list[str]:
    """Where numbers stand beside points on the left: below where the line falls."""
    places = ["top left"]
    lowest = LOW_SHARE * max(errors)
    for before, after in pairwise(errors):
        is_free_below = after < before and after > lowest
        places.append("bottom left" if is_free_below else "top left")
    return places


def _write_values(curve: Figure, values: list[str], place: str | list[str]) -> None:
    """Numbers beside the points of a curve, in its colour."""
    curve["mode"] = "lines+markers+text"
    curve["text"] = values
    curve["textposition"] = place
    curve["textfont"] = {"color": curve["line"]["color"]}


def _error_axis(values: Sequence[float], n_steps: int) -> Figure:
    """From zero; by decades where the errors of several steps span more than one."""
    largest = max(values)
    smallest = min(values)
    if smallest > 0 and largest / smallest > 10 and n_steps > 1:
        low = np.log10(smallest) - 0.2
        return {"type": "log", "range": [low, np.log10(largest) + 0.3]}
    return {"range": [0, 1.25 * largest]}


def _change(step: ErrorStep) -> str:
    is_addition = step.number > 0 and not step.label.startswith("without ")
    return f"+ {step.label}" if is_addition else step.label


def _broken(text: str) -> str:
    """A label in lines of few letters."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + len(word) > N_WORDS_A_LINE:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "<br>".join(_escaped(line) for line in lines)


def _escaped(text: str) -> str:
    """A text in which nothing is markup: plotly reads some tags in labels."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _time_label(unit: str, origin: dt.datetime | None) -> str:
    """Of the axis of time, with the date at which the time is 0."""
    date = date_words(0.0, origin)
    return f"{_label('time', unit)} since {date}" if date else _label("time", unit)


def _label(name: str, unit: str) -> str:
    return _escaped(label(name, unit))


def _thinned(values: np.ndarray) -> np.ndarray:
    """Every so many samples where there are more than a screen shows.

    Args:
        values: (n_samples,).
    """
    stride = max(int(np.ceil(len(values) / CHART_POINTS)), 1)
    return values[::stride]


def _numbers(values: np.ndarray) -> list[float | None]:
    """Thinned values, None where there is none: JSON has no NaN."""
    thinned = _thinned(np.asarray(values, dtype=float))
    listed = thinned.tolist()
    return [value if np.isfinite(value) else None for value in listed]


def _note(text: str) -> Figure:
    """A remark above the residual, at its right end."""
    return {
        "text": text,
        "xref": "paper",
        "yref": "paper",
        "x": 1,
        "y": RESIDUAL_PART + 0.005,
        "xanchor": "right",
        "yanchor": "bottom",
        "showarrow": False,
        "font": {"size": 12},
    }


def _curve(
    t: np.ndarray,
    values: np.ndarray,
    name: str,
    color: str,
    *,
    mode: str = "lines",
    yaxis: str = "y",
) -> Figure:
    return {
        "type": "scatter",
        "x": _numbers(t),
        "y": _numbers(values),
        "name": name,
        "mode": mode,
        "yaxis": yaxis,
        "line": {"color": color, "width": 2},
        "marker": {"color": color, "size": 5},
        "hovertemplate": "%{y:.4g}",
    }


def _banded(curve: ForceCurve, color: str) -> list[Figure]:
    """A missing force and, below it, the band of two standard deviations."""
    name = f"d{curve.equation}/dt"
    upper = _curve(curve.t, curve.force + 2 * curve.std, name, color)
    lower = _curve(curve.t, curve.force - 2 * curve.std, name, color)
    for edge in (upper, lower):
        edge.update({"hoverinfo": "skip", "showlegend": False})
        edge["line"] = {"width": 0, "color": color}
    lower["fill"] = "tonexty"
    lower["fillcolor"] = _transparent(color)
    lower.update({"showlegend": True, "name": "two standard deviations"})
    line = _curve(curve.t, curve.force, f"missing in {name}", color)
    return [upper, lower, line]


def _transparent(color: str) -> str:
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{BAND_OPACITY})"


def _step_curve(
    x: Sequence[float], y: Sequence[float], name: str, color: str, dash: str
) -> Figure:
    return {
        "type": "scatter",
        "x": list(x),
        "y": list(y),
        "name": name,
        "mode": "lines+markers",
        "line": {"color": color, "width": 2, "dash": dash},
        "marker": {"color": color, "size": 8},
        "hovertemplate": "%{y:.4g}",
        "cliponaxis": False,
    }


def _layout(x_title: str) -> Figure:
    return {
        "margin": {"l": 64, "r": 12, "t": 44, "b": 44},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": FONT, "size": 13},
        "hovermode": "x unified",
        "hoverlabel": {"bgcolor": "#16191d", "font": {"color": "#f4f6f8"}},
        "legend": {
            "orientation": "h",
            "x": 0,
            "xref": "container",
            "y": 1,
            "yref": "container",
            "yanchor": "top",
            "font": {"size": 12},
        },
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": MEASURED_COLOR},
        "xaxis": {"title": _title(x_title), "zeroline": False},
        "dragmode": "zoom",
    }


def _title(text: str) -> Figure:
    return {"text": text, "font": {"size": 13}}


def _axis(title: str, domain: list[float] | None = None) -> Figure:
    axis: Figure = {"title": _title(title), "zeroline": False, "automargin": True}
    if domain is not None:
        axis["domain"] = domain
    return axis


def _band(low: float, high: float, axis: str) -> Figure:
    return {
        "type": "rect",
        "xref": "paper",
        "yref": axis,
        "x0": 0,
        "x1": 1,
        "y0": low,
        "y1": high,
        "line": {"width": 0},
        "fillcolor": _transparent(MEASURED_COLOR),
        "layer": "below",
    }


def _line(axis: str, y: float) -> Figure:
    return {
        "type": "line",
        "xref": "paper",
        "yref": axis,
        "x0": 0,
        "x1": 1,
        "y0": y,
        "y1": y,
        "line": {"color": MEASURED_COLOR, "width": 1},
    }


def _mark(layout: Figure, t: float | None, scale: TimeScale, is_worst: bool) -> None:
    """A vertical line at the time that is looked at."""
    if t is None:
        return
    t = t / scale.size
    note = {
        "text": WORST if is_worst else "the time looked at",
        "xref": "x",
        "yref": "paper",
        "x": t,
        "y": 1,
        "yanchor": "bottom",
        "showarrow": False,
        "font": {"size": 12},
    }
    layout.setdefault("annotations", []).append(note)
    layout.setdefault("shapes", []).append(
        {
            "type": "line",
            "xref": "x",
            "yref": "paper",
            "x0": t,
            "x1": t,
            "y0": 0,
            "y1": 1,
            "line": {"color": MARK_COLOR, "width": 2, "dash": "dash"},
        }
    )


def _figure(data: list[Figure], layout: Figure) -> Figure:
    config = {
        "responsive": True,
        "displaylogo": False,
        "displayModeBar": True,
        "modeBarButtonsToRemove": list(UNUSED_BUTTONS),
    }
    return {"data": data, "layout": layout, "config": config}

"""The static pictures of a report, for paper and where no script runs.

They are drawn from the content of the report, as the interactive charts are. Names are
never read as formulas, and text stays text in the file.
"""

import io
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from phsi_opt.presentation.axes import (
    ATTENTION,
    BASELINE,
    FLOOR,
    MEASURED,
    MODEL,
    label,
)
from phsi_opt.presentation.pictures import draw_errors
from phsi_opt.presentation.report_content import (
    ChannelRun,
    Follows,
    Force,
    ForceMap,
    ForceRun,
    Glance,
    Numbers,
    Runs,
    Staircase,
)

STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "report",  # the same names of parts in every run
    "text.parse_math": False,  # a "$" in a name is a "$"
    "font.size": 10,
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
}
PAPER_WIDTH = 7.2  # inches: the width of a page of paper
MODEL_STYLES = (
    {"color": ATTENTION, "ls": "--"},
    {"color": "C4", "ls": ":"},
    {"color": MODEL, "ls": "-"},
)
MOST_LETTERS = 36  # of a name in a picture; the page has it whole
NOISE_BAND = 2  # standard deviations of the noise


def svg(draw: Callable[[Figure], None], height: float) -> str:
    """A drawing as the text of an SVG file, ``height`` in inches."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(PAPER_WIDTH, height), layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return text.getvalue()


def staircase_picture(content: Staircase) -> str:
    """The errors step by step as SVG."""

    def draw(figure: Figure) -> None:
        steps = content.steps
        draw_errors(
            figure.subplots(),
            [step.label for step in steps],
            train=values([step.train for step in steps]),
            held_out=values([step.held_out for step in steps]),
            floor=values([step.floor for step in steps]),
            unit=content.unit,
        )

    return svg(draw, 3.4)


def runs_picture(content: Runs) -> str:
    """The trajectory that is shown first: every channel with its residuals, as SVG."""
    run = content.runs[content.shown]
    n_channels = len(run.channels)

    def draw(figure: Figure) -> None:
        ratios = [2.0, 1.0] * n_channels
        axes = figure.subplots(2 * n_channels, 1, sharex=True, height_ratios=ratios)
        for k, channel in enumerate(run.channels):
            pair = (axes[2 * k], axes[2 * k + 1])
            _draw_channel(pair, content, k, channel)
        axes[-1].set_xlabel(_since(label("t", content.unit_of_time), run.since))
        axes[0].set_title(f"{_short(run.name)} ({run.part})", loc="left", fontsize=10)

    return svg(draw, 0.4 + 3.2 * n_channels)


def glance_picture(content: Glance, runs: Runs) -> str:
    """One channel measured and simulated, the missing force below, as SVG."""
    run = runs.runs[content.run]
    channel = run.channels[content.channel]
    info = runs.channels[content.channel]

    def draw(figure: Figure) -> None:
        n_panels = 1 if content.force is None else 2
        panels = figure.subplots(n_panels, 1, sharex=True, squeeze=False)[:, 0]
        t = values(channel.t)
        measured = values(channel.measured)
        panels[0].plot(t, measured, ".", ms=3, color=MEASURED, label="measured")
        for m, style in enumerate(model_styles(len(runs.models))):
            name = _short(runs.models[m])
            panels[0].plot(t, values(channel.models[m]), lw=1.2, label=name, **style)
        panels[0].set_ylabel(_short(label(info.name, info.unit)))
        if content.force is not None:
            _draw_force(panels[1], content.force, content.label)
        for ax in panels:
            if content.window is not None:
                ax.axvspan(*content.window, color=ATTENTION, alpha=0.15, lw=0)
            ax.legend(loc="upper right", frameon=False, fontsize=8, ncols=4)
            ax.margins(y=0.25)
        panels[-1].set_xlabel(_since(label("t", runs.unit_of_time), run.since))

    return svg(draw, 2.4 if content.force is None else 3.6)


def _draw_channel(
    axes: tuple[Axes, Axes], content: Runs, k: int, channel: ChannelRun
) -> None:
    upper, lower = axes
    t = values(channel.t)
    info = content.channels[k]
    upper.plot(t, values(channel.measured), ".", ms=3, color=MEASURED, label="measured")
    styles = model_styles(len(content.models))
    for m, style in enumerate(styles):
        name = _short(content.models[m])
        upper.plot(t, values(channel.models[m]), lw=1.2, label=name, **style)
        lower.plot(t, values(channel.residuals[m]), lw=1.0, **style)
    if info.noise is not None:
        band = NOISE_BAND * info.noise
        lower.axhspan(-band, band, color=FLOOR, alpha=0.2, lw=0, label="noise, 2 std.")
        lower.legend(loc="upper right", frameon=False, fontsize=8)
    lower.axhline(0, color=BASELINE, lw=0.6)
    upper.set_ylabel(_short(label(info.name, info.unit)))
    lower.set_ylabel(_short(label("residual", info.unit)))
    upper.margins(y=0.25)
    if k == 0:
        upper.legend(loc="upper right", frameon=False, fontsize=8, ncols=4)


def model_styles(n_models: int) -> list[dict[str, Any]]:
    """Base model dashed, present model solid; a single model solid."""
    if n_models == 1:
        return [dict(MODEL_STYLES[-1])]
    if n_models == 2:
        return [dict(MODEL_STYLES[0]), dict(MODEL_STYLES[-1])]
    return [dict(style) for style in MODEL_STYLES]


def force_picture(content: Force) -> str:
    """The missing force over time, where it is strongest, as SVG."""
    run = content.runs[content.shown]

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        _draw_force(ax, run, content.label)
        ax.set_xlabel(_since(content.t_label, run.since))
        ax.set_title(_short(run.name), loc="left", fontsize=10)
        ax.legend(loc="upper right", frameon=False, fontsize=8, ncols=2)

    return svg(draw, 3.0)


def _draw_force(ax: Axes, run: ForceRun, y_label: str) -> None:
    """The missing force of a trajectory with two standard deviations."""
    t = values(run.t)
    force = values(run.force)
    band = 2 * values(run.std)
    ax.fill_between(
        t, force - band, force + band, color=MODEL, alpha=0.2, lw=0, label="2 std."
    )
    ax.plot(t, force, color=MODEL, lw=1.2, label="missing force")
    ax.axhline(0, color=BASELINE, lw=0.6)
    ax.set_ylabel(_short(y_label))


def map_picture(content: ForceMap, force_label: str) -> str:
    """The mean missing force over two variables as SVG."""

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        rows = [values(row) for row in content.force]
        mean = np.ma.masked_invalid(np.array(rows))
        limit = float(np.ma.max(np.ma.abs(mean))) if mean.count() else 1.0
        mesh = ax.pcolormesh(
            values(content.x),
            values(content.y),
            mean,
            cmap="RdBu_r",
            vmin=-limit,
            vmax=limit,
            shading="nearest",
        )
        figure.colorbar(mesh, ax=ax, label=_short(f"mean {force_label}"))
        ax.set(xlabel=_short(content.x_label), ylabel=_short(content.y_label))

    return svg(draw, 3.6)


def follows_picture(content: Follows, force_label: str) -> str:
    """The missing force against what it follows as SVG."""

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        x = values(content.x)
        ax.plot(x, values(content.force), ".", ms=2.5, color="0.7", label="force")
        centre = values(content.centre)
        mean = values(content.mean)
        std = values(content.std)
        ax.fill_between(
            centre, mean - std, mean + std, color=MODEL, alpha=0.2, lw=0, label="spread"
        )
        ax.plot(centre, mean, "o-", color=MODEL, ms=4, lw=1.4, label="mean in bins")
        ax.axhline(0, color=BASELINE, lw=0.6)
        ax.set(xlabel=_short(content.label), ylabel=_short(force_label))
        ax.margins(y=0.2)
        ax.legend(frameon=False, fontsize=8, ncols=3, loc="upper center")

    return svg(draw, 3.6)


def _since(t_label: str, date: str) -> str:
    """The label of an axis of time, with the date at which the time is 0."""
    return f"{_short(t_label)} since {date}" if date else _short(t_label)


def _short(name: str) -> str:
    """A name that leaves room for the curves."""
    if len(name) <= MOST_LETTERS:
        return name
    return f"{name[: MOST_LETTERS - 1]}\N{HORIZONTAL ELLIPSIS}"


def values(numbers: Numbers | Sequence[float | None]) -> np.ndarray:
    """Numbers as an array, (n,), NaN where they are not known."""
    return np.array([np.nan if one is None else one for one in numbers], dtype=float)

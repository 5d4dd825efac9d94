"""Pictures of free runs, missing forces, profiles, histories and estimates.

Each function takes arrays or tables, never a result of the package: so every result may
call it. Each draws on ``ax`` (None: on a new figure), returns the axes, and its title
says what to see; where the title holds numbers of a result, the result words it.
Pictures of where a missing force acts stand in `force_analysis`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.interpolate import PchipInterpolator

from phsi_opt.presentation.axes import FLOOR, MEASURED, MODEL, axes_of, label
from phsi_opt.presentation.charts import (
    POINTS,
    Chart,
    Curve,
    Panel,
    draw,
    errors_chart,
    force_chart,
)
from phsi_opt.presentation.content import TRAINING, ErrorStep, ForceRun
from phsi_opt.presentation.units import rate_unit

RESIDUAL_HEIGHT = 0.5  # of the panel of residuals, over that of the curves
BAND = "run, two standard deviations"
STATE_HEIGHT = 1.8  # inches of a panel
N_CURVE = 200  # points of a smooth curve: no corner is seen between them


@dataclass(frozen=True, eq=False)
class Channel:
    """What is drawn of one measured state along one trajectory.

    Attributes:
        name: Of the state; ``unit``: its unit, or "".
        measured: (n_samples,) measured values, NaN where missing.
        simulated: (n_samples,) what the sensor would show of the free run.
        std: (n_samples,) standard deviation of ``simulated``; None: not known.
        noise: Standard deviation of the sensor's noise; None: no residuals are drawn.
    """

    name: str
    unit: str
    measured: np.ndarray
    simulated: np.ndarray
    std: np.ndarray | None
    noise: float | None = None


def plot_free_run(
    t: np.ndarray,
    channels: Sequence[Channel],
    *,
    t_unit: str,
    title: str,
    ax: Axes | None = None,
) -> Axes:
    """Measurements and free run of one trajectory, (n_samples,) times ``t``.

    A band covers two standard deviations of the run where they are known. Residuals
    stand in a panel below, with the band that noise alone leaves.
    """
    ax = axes_of(ax, (8.0, 4.8))
    curves: list[Curve] = []
    residuals: list[Curve] = []
    is_alone = len(channels) == 1
    for n, one in enumerate(channels):
        color, dots = (MODEL, MEASURED) if n == 0 else (f"C{n}", f"C{n + 3}")
        std = None if one.std is None else 2 * one.std
        run = Curve(f"{one.name} free run", t, one.simulated, color, std=std, band=BAND)
        curves += [Curve(f"{one.name} measured", t, one.measured, dots, POINTS), run]
        # One channel in its unit, several in standard deviations of their noise.
        scale = 1.0 if is_alone else one.noise or 1.0
        residuals.append(Curve("", t, (one.measured - one.simulated) / scale, color))
    names = ", ".join(channel.name for channel in channels)
    units = {channel.unit for channel in channels}
    unit = units.pop() if len(units) == 1 else ""
    above = Panel(label(names, unit), curves)
    noise = 2 * (channels[0].noise or 1.0) if is_alone else 2.0
    told = label("residual", unit if is_alone else "noise std.")
    below = Panel(told, residuals, noise=noise)
    chart = Chart(label("t", t_unit), (above, below))
    draw(ax, chart)
    ax.set_title(title)
    if all(channel.noise for channel in channels):
        draw(_panel_below(ax), chart, place=1)
        ax.tick_params(axis="x", labelbottom=False)
        ax.xaxis.label.set_visible(False)  # it stands below the residuals
    return ax


def _panel_below(ax: Axes) -> Axes:
    """New axes in the lower part of the place that the axes had."""
    place = ax.get_subplotspec()
    if place is not None:
        rows = place.subgridspec(2, 1, height_ratios=(1.0, RESIDUAL_HEIGHT))
        ax.set_subplotspec(rows[0])
        return ax.figure.add_subplot(rows[1], sharex=ax)
    box = ax.get_position()
    lower = box.height * RESIDUAL_HEIGHT / (1 + RESIDUAL_HEIGHT)
    ax.set_position((box.x0, box.y0 + lower, box.width, box.height - lower))
    size = (box.x0, box.y0, box.width, 0.85 * lower)  # a gap between them
    return ax.figure.add_axes(size, sharex=ax)


def plot_missing_force(
    table: pd.DataFrame,
    equations: Sequence[str],
    units: Mapping[str, str],
    ax: Axes | None = None,
) -> Axes:
    """The missing force along one trajectory, with two standard deviations.

    Where the band leaves zero, the model lacks something.

    Args:
        table: A row per interval: ``t``, and for every equation its force and standard
            deviation in the columns named as the state, ``p``, and ``std_p``.
        equations: States in whose equations a force was estimated.
        units: Units by name, of the states and of ``t``.
        ax: Axes to draw on; None: a new figure.
    """
    ax = axes_of(ax, (8.0, 3.6))
    t_unit = units.get("t", "")
    forces = []
    for state in equations:
        unit = rate_unit(units.get(state, ""), t_unit)
        t, w, std = table[["t", state, f"std_{state}"]].to_numpy(dtype=float).T
        forces.append(ForceRun("", TRAINING, state, unit, t, w, std))
    draw(ax, force_chart(forces, t_unit))
    ax.set_title("Where the band leaves zero, a force is surely missing")
    return ax


def plot_profile(
    points: np.ndarray,
    value: float,
    curvature: tuple[float, float],
    threshold: float,
    level: float,
    ax: Axes | None = None,
) -> Axes:
    """A profile likelihood; the interval is where it stays below the threshold.

    Args:
        points: (n, 2) values of the parameter, increasing, and rise of -2 log
            likelihood.
        value: Estimate of the parameter.
        curvature: Limits of confidence by the standard error, whose parabola is drawn
            for comparison.
        threshold: Rise at the limits of confidence.
        level: Of confidence, between 0 and 1.
        ax: Axes to draw on; None: a new figure.

    Returns:
        The axes, to which the caller adds the parameter's name and the title.
    """
    ax = axes_of(ax, (6.0, 3.6))
    held, rise = points.T
    # The signed root of the rise is nearly straight, so a smooth curve goes through few
    # points.
    signed_root = np.sign(held - value) * np.sqrt(rise)
    root = PchipInterpolator(held, signed_root)
    inside = np.linspace(held[0], held[-1], N_CURVE)
    ax.plot(inside, root(inside) ** 2, "-", color=MODEL, label="profile")
    ax.plot(held, rise, "o", color=MODEL, ms=4, label="re-fits")

    lower, upper = curvature
    half_width = (upper - lower) / 2
    wide = np.linspace(min(held[0], lower), max(held[-1], upper), N_CURVE)
    parabola = threshold * ((wide - value) / half_width) ** 2
    ax.plot(wide, parabola, "--", color=MEASURED, label="curvature")
    percent = f"{100 * level:.3g} %"
    ax.axhline(threshold, color=FLOOR, lw=1.0, ls=":", label=percent)
    ax.set(ylabel="rise of -2 log likelihood", ylim=(0, 2 * threshold))
    ax.legend(frameon=False, loc="upper center", ncols=2)
    return ax


def plot_history(history: pd.DataFrame, ax: Axes | None = None, unit: str = "") -> Axes:
    """Free-run error after each step: training, held out, and the noise floor.

    The values stand at the points; the axis is logarithmic where errors span a decade.

    Args:
        history: A row per step with the columns ``step``, ``effect``, ``train_rmse``,
            ``held_out_rmse`` (NaN: nothing was held out) and ``noise_floor``.
        ax: Axes to draw on; None: a new figure.
        unit: Unit of the errors.
    """
    ax = axes_of(ax, (7.0, 3.8))
    errors = history[["effect", "train_rmse", "held_out_rmse", "noise_floor"]]
    steps = [ErrorStep(str(row[0]), *row[1:]) for row in errors.to_numpy()]
    draw(ax, errors_chart(steps, unit))
    ax.set_title("Free-run error after each added effect")
    return ax


def plot_states(
    t: np.ndarray, channels: Sequence[Channel], *, t_unit: str, title: str
) -> Figure:
    """Measured and estimated states of one trajectory, a panel each.

    Args:
        t: (n_samples,) times.
        channels: The states; one that nobody measured has NaN for its measurements,
            ``simulated`` is the estimate.
        t_unit: Unit of the time.
        title: Over the panels.
    """
    size = (8.0, 0.8 + STATE_HEIGHT * len(channels))
    figure, axes = plt.subplots(
        len(channels), 1, sharex=True, figsize=size, layout="constrained", squeeze=False
    )
    for ax, channel in zip(axes[:, 0], channels, strict=True):
        draw_state(ax, t, channel, t_unit)
        ax.label_outer()
    figure.suptitle(title)
    return figure


def draw_state(ax: Axes, t: np.ndarray, channel: Channel, t_unit: str) -> None:
    """Measurements and estimate of one state over (n_samples,) times on axes."""
    curves = [Curve("measured", t, channel.measured, MEASURED, POINTS)]
    name = "estimated"
    if not np.isfinite(channel.measured).any():
        curves, name = [], "estimated (not measured)"
    curves.append(Curve(name, t, channel.simulated, MODEL))
    panel = Panel(label(channel.name, channel.unit), curves)
    draw(ax, Chart(label("t", t_unit), (panel,)))

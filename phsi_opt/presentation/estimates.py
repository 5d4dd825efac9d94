"""The picture of a fit: how well every parameter is known.

Parameters differ in unit and size, so each interval is drawn relative to the absolute
value of its own estimate; the labels give the numbers with their units.
"""

from textwrap import fill

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from phsi_opt.presentation.axes import ATTENTION, BASELINE, MODEL, axes_of

WIDTH = 8.0  # inches of a new figure
ROW_HEIGHT = 0.32  # inches per parameter: tick labels do not touch
FRAME_HEIGHT = 1.1  # inches for title and axis below and above the rows
LEAST_ROWS = 2  # for which a new figure has room
TITLE_WIDTH = 60  # in a line of the title over the axes of a new figure
AXIS_MARGIN = 1.15  # range of the axis over the widest interval that it shows


def plot_estimates(table: pd.DataFrame, level: float, ax: Axes | None = None) -> Axes:
    """Every estimate with its interval of confidence, in percent of its absolute value.

    An interval that reaches beyond zero (more than 100 %) leaves even the sign open: it
    is drawn in another colour with arrows, over the whole width. A square marks a
    parameter that ended at a bound, an open circle one without a standard error.

    Args:
        table: A row per estimate, from top to bottom: ``name``, ``value``,
            ``ci_lower`` and ``ci_upper`` (NaN: not known), ``unit``, ``at_bound``.
        level: Of confidence, between 0 and 1.
        ax: Axes to draw on; None: a new figure, as high as the table is long.
    """
    n = len(table)
    ax = axes_of(ax, (WIDTH, FRAME_HEIGHT + ROW_HEIGHT * max(n, LEAST_ROWS)))
    ends = table[["value", "ci_lower", "ci_upper"]].astype(float)
    half_width = (ends["ci_upper"] - ends["ci_lower"]).to_numpy() / 2
    size = ends["value"].abs().to_numpy()
    at_bound = table["at_bound"].to_numpy(dtype=bool)
    is_known = np.isfinite(half_width)
    is_sure = is_known & (half_width < size)
    is_open = is_known & ~is_sure
    is_held = at_bound & ~is_known
    is_unknown = ~at_bound & ~is_known

    percent = np.full(n, np.nan)
    percent[is_sure] = 100 * half_width[is_sure] / size[is_sure]
    reach = AXIS_MARGIN * float(np.nanmax(percent)) if is_sure.any() else 100.0
    ax.axvline(0, color=BASELINE, lw=0.8)
    _draw_intervals(ax, np.flatnonzero(is_sure), percent[is_sure])
    _draw_open_signs(ax, np.flatnonzero(is_open), reach)
    _draw_marks(ax, np.flatnonzero(is_held), "s", face=BASELINE)
    _draw_marks(ax, np.flatnonzero(is_unknown), "o", face="white")

    ax.set_yticks(np.arange(n), _row_labels(table, half_width))
    ax.tick_params(axis="y", length=0, pad=8)  # room for the arrows
    ax.set_ylim(max(n, 1) - 0.5, -0.5)
    ax.set_xlim(-reach, reach)
    ax.set_xlabel(f"{100 * level:.3g} % interval around the estimate (% of its size)")
    title = _doubts(is_open, is_unknown, is_held) or _worst(table["name"], percent)
    ax.set_title(fill(title, TITLE_WIDTH))
    return ax


def _draw_intervals(ax: Axes, rows: np.ndarray, percent: np.ndarray) -> None:
    middle = np.zeros(len(rows))
    ax.errorbar(middle, rows, xerr=percent, fmt="o", color=MODEL, ms=5, capsize=4)


def _draw_open_signs(ax: Axes, rows: np.ndarray, reach: float) -> None:
    """Lines to both edges, with arrows that say that the intervals go on."""
    ax.hlines(rows, -reach, reach, color=ATTENTION, lw=0.8)
    ax.plot(np.zeros(len(rows)), rows, "o", color=ATTENTION, ms=5)
    for edge, arrow in ((-reach, "<"), (reach, ">")):
        at_edge = np.full(len(rows), edge)
        ax.plot(at_edge, rows, arrow, color=ATTENTION, ms=7, clip_on=False)


def _draw_marks(ax: Axes, rows: np.ndarray, marker: str, *, face: str) -> None:
    middle = np.zeros(len(rows))
    ax.plot(middle, rows, marker, mfc=face, mec=BASELINE, ms=7, mew=1.5, ls="none")


def _row_labels(table: pd.DataFrame, half_width: np.ndarray) -> list[str]:
    """Name, value and half width with the unit, or why there is no half width."""
    labels = []
    for i, half in enumerate(half_width):
        name = str(table["name"].iloc[i])
        value = float(table["value"].iloc[i])
        unit = str(table["unit"].iloc[i])
        estimate = f"{name} = {value:.4g}"
        if np.isfinite(half):
            labels.append(f"{estimate} \N{PLUS-MINUS SIGN} {half:.2g} {unit}".rstrip())
            continue
        reason = "at its bound" if table["at_bound"].iloc[i] else "no standard error"
        labels.append(f"{estimate} {unit}".rstrip() + f", {reason}")
    return labels


def _doubts(is_open: np.ndarray, is_unknown: np.ndarray, is_held: np.ndarray) -> str:
    """How many estimates are not to be relied on, and how they are marked; or ""."""
    counted = (
        (int(is_open.sum()), "not told from zero (orange)"),
        (int(is_unknown.sum()), "without standard error (circle)"),
        (int(is_held.sum()), "at a bound (square)"),
    )
    parts = [f"{number} {what}" for number, what in counted if number]
    return f"Of {len(is_open)} estimates: {', '.join(parts)}" if parts else ""


def _worst(names: pd.Series, percent: np.ndarray) -> str:
    """Which parameter is known worst, where all are known."""
    if not len(percent):
        return "No parameter was estimated"
    worst = int(np.argmax(percent))
    return f"{names.iloc[worst]} is known worst, to {percent[worst]:.2g} % of its size"

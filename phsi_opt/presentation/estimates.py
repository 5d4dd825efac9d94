"""The picture of a fit: how well every parameter is known.

Parameters differ in unit and size, so each interval is drawn relative to the absolute
value of its own estimate; the labels give the numbers with their units.
"""

from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from phsi_opt.presentation.axes import ATTENTION, BASELINE, MODEL, axes_of

WIDTH = 8.0  # inches of a new figure
ROW_HEIGHT = 0.32  # inches per parameter: tick labels do not touch
FRAME_HEIGHT = 1.1  # inches for title and axis below and above the rows
LEAST_ROWS = 2  # for which a new figure has room
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
    rows = np.arange(n)
    zero = np.zeros(n)
    ax.axvline(0, color=BASELINE, lw=0.8)
    width = percent[is_sure]
    look: Any = {"fmt": "o", "color": MODEL, "ms": 5, "capsize": 4}
    ax.errorbar(zero[is_sure], rows[is_sure], xerr=width, **look)
    # Lines to both edges, with arrows that say that the intervals go on.
    ax.hlines(rows[is_open], -reach, reach, color=ATTENTION, lw=0.8)
    for shown, x, marker, color, face in (
        (is_open, 0.0, "o", ATTENTION, ATTENTION),
        (is_open, -reach, "<", ATTENTION, ATTENTION),
        (is_open, reach, ">", ATTENTION, ATTENTION),
        (is_held, 0.0, "s", BASELINE, BASELINE),
        (is_unknown, 0.0, "o", BASELINE, "white"),
    ):
        mark: Any = {"mec": color, "mfc": face, "ms": 7, "ls": "none"}
        ax.plot(zero[shown] + x, rows[shown], marker, clip_on=False, **mark)

    ax.set_yticks(rows, _row_labels(table, half_width))
    ax.tick_params(axis="y", length=0, pad=8)  # room for the arrows
    ax.set_ylim(max(n, 1) - 0.5, -0.5)
    ax.set_xlim(-reach, reach)
    ax.set_xlabel(f"{100 * level:.3g} % interval around the estimate (% of its size)")
    ax.set_title(fill(_title(table, percent, is_open, is_unknown, is_held), 60))
    return ax


def _row_labels(table: pd.DataFrame, half_width: np.ndarray) -> list[str]:
    """Name, value and half width with the unit, or why there is no half width."""
    labels = []
    for (_, row), half in zip(table.iterrows(), half_width, strict=True):
        estimate = f"{row['name']} = {float(row['value']):.4g}"
        reason = "at its bound" if row["at_bound"] else "no standard error"
        told = f"{estimate} {row['unit']}".rstrip() + f", {reason}"
        if np.isfinite(half):
            told = f"{estimate} \N{PLUS-MINUS SIGN} {half:.2g} {row['unit']}".rstrip()
        labels.append(told)
    return labels


def _title(
    table: pd.DataFrame,
    percent: np.ndarray,
    is_open: np.ndarray,
    is_unknown: np.ndarray,
    is_held: np.ndarray,
) -> str:
    """How many are not to be relied on, and how marked; else which is known worst."""
    counted = (
        (int(is_open.sum()), "not told from zero (orange)"),
        (int(is_unknown.sum()), "without standard error (circle)"),
        (int(is_held.sum()), "at a bound (square)"),
    )
    doubts = [f"{n} {what}" for n, what in counted if n]
    if doubts:
        return f"Of {len(table)} estimates: {', '.join(doubts)}"
    if not len(table):
        return "No parameter was estimated"
    worst = int(np.argmax(percent))
    name = table["name"].iloc[worst]
    return f"{name} is known worst, to {percent[worst]:.2g} % of its size"

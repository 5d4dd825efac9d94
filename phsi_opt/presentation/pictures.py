"""The picture of all estimates, from a table: how well every parameter is known.

Other pictures are a `Chart`, which page and report draw too.
"""

from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from phsi_opt.presentation.charts import (
    ATTENTION,
    BASELINE,
    MODEL,
    axes_of,
)
from phsi_opt.presentation.numbers import with_error

# How estimates of a kind are drawn (marker, colour, face), by what is said of them.
IS_SURE = ""
SIGN_UNKNOWN = "not significantly different from zero (orange)"
NO_STD_ERROR = "without standard error (circle)"
ENDED_AT_BOUND = "at a bound (square)"
LOOKS = {
    SIGN_UNKNOWN: ("o", ATTENTION, ATTENTION),
    NO_STD_ERROR: ("o", BASELINE, "white"),
    ENDED_AT_BOUND: ("s", BASELINE, BASELINE),
    IS_SURE: ("o", MODEL, MODEL),
}


def plot_estimates(table: pd.DataFrame, level: float, ax: Axes | None = None) -> Axes:
    """Every estimate with its interval of confidence, in percent of its absolute value.

    An interval that reaches beyond zero (more than 100 %) leaves even the sign open: it
    is drawn in another colour, over the whole width. A square marks a parameter that
    ended at a bound, an open circle one without a standard error.
    """
    n = len(table)
    ax = axes_of(ax, (8.0, 1.1 + 0.32 * max(n, 2)))  # tick labels do not touch
    half_width = table["half_width"].to_numpy(dtype=float)
    percent = 100 * half_width / table["value"].abs().to_numpy(dtype=float)
    is_known = np.isfinite(half_width)
    cases = [is_known & (percent < 100), is_known, table["at_bound"].to_numpy(bool)]
    kind = np.select(cases, [IS_SURE, SIGN_UNKNOWN, ENDED_AT_BOUND], NO_STD_ERROR)
    is_sure = kind == IS_SURE
    reach = 1.15 * float(percent[is_sure].max()) if is_sure.any() else 100.0
    ax.axvline(0, color=BASELINE, lw=0.8)
    doubts = []
    for told, (marker, color, face) in LOOKS.items():
        rows = np.flatnonzero(kind == told)
        drawn: Any = {"mfc": face, "ms": 6, "capsize": 4, "color": color}
        # What is open goes beyond the edges.
        width = np.nan_to_num(np.minimum(percent[rows], 2 * reach))
        ax.errorbar(0 * rows, rows, xerr=width, fmt=marker, **drawn)
        if told and len(rows):
            doubts.append(f"{len(rows)} {told}")
    ax.set_yticks(np.arange(n), list(map(_row_label, table.itertuples())))
    ax.tick_params(axis="y", length=0)
    ax.set_ylim(max(n, 1) - 0.5, -0.5)
    ax.set_xlim(-reach, reach)
    ax.set_xlabel(f"{100 * level:.3g} % interval around the estimate (% of its size)")
    title = f"Of {n} estimates: {', '.join(doubts)}"
    if not n:
        title = "No parameter was estimated"
    elif not doubts:
        worst = int(np.argmax(percent))
        name = table["name"].iloc[worst]
        title = f"{name} is the least certain, to {percent[worst]:.2g} % of its size"
    ax.set_title(fill(title, 60))
    return ax


def _row_label(row: Any) -> str:
    """Name, value and half width with the unit, or why there is no half width."""
    told = f"{row.name} = {with_error(row.value, row.half_width, row.unit)}"
    if np.isfinite(row.half_width):
        return told
    return f"{told}, {'at its bound' if row.at_bound else 'no standard error'}"

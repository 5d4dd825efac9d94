"""Figures under results/, drawn without a window.

Modules that draw take ``plt`` from here, so that the backend is chosen before it loads.
"""

from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from problems.tools import provenance

__all__ = ["legend_below", "panels", "plt", "save"]


def panels(
    rows: int, columns: int, size: tuple[float, float], shared: bool = False
) -> tuple[Figure, Any]:
    """A figure, ``size`` in inches, and its axes (rows, columns).

    ``shared``: all have the same limits.
    """
    return plt.subplots(
        rows,
        columns,
        sharex=shared,
        sharey=shared,
        squeeze=False,
        figsize=size,
        layout="constrained",
    )


def legend_below(ax: Axes) -> None:
    """The legend of a panel, below all panels of its figure."""
    handles, labels = ax.get_legend_handles_labels()
    look: Any = {"loc": "outside lower center", "ncols": 5, "frameon": False}
    ax.figure.legend(handles, labels, **look)


def save(figure: Figure, name: str, dpi: int) -> None:
    """Save a figure as results/``name`` and close it."""
    path = provenance.RESULTS / name
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)
    plt.close(figure)

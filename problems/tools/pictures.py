"""Figures under results/, drawn without a window.

Modules that draw take ``plt`` from here, so that the backend is chosen before it loads.
"""

import matplotlib
from matplotlib.figure import Figure

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from problems.tools import provenance

__all__ = ["plt", "save"]


def save(figure: Figure, name: str, dpi: int) -> None:
    """Save a figure as results/``name`` and close it."""
    path = provenance.RESULTS / name
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)
    plt.close(figure)

"""Shared by the pictures of a missing force: titles, lines, bands, bins."""

from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.presentation.axes import BASELINE, MODEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PANEL_TITLE_LETTERS = 62  # in a line of the title over a single panel
N_SHOWN_BINS = 16  # of a variable in which mean and spread are shown
FEWEST_IN_BIN = 3  # intervals in a bin that is shown


def draw_title(ax: "Axes", text: str) -> None:
    """The title, in lines that are as long as a panel is wide."""
    ax.set_title(fill(text, PANEL_TITLE_LETTERS), fontsize=10)


def draw_zero(ax: "Axes") -> None:
    """A line where there is no force."""
    ax.axhline(0, color=BASELINE, lw=0.8)


def draw_band(
    ax: "Axes", z: np.ndarray, lower: np.ndarray, upper: np.ndarray, text: str
) -> None:
    """What lies between two curves over z; all are (n,)."""
    ax.fill_between(z, lower, upper, color=MODEL, alpha=0.2, lw=0, label=text)


@dataclass(frozen=True, eq=False)
class Bins:
    """Mean and spread of a force in bins of a variable that hold enough values.

    Attributes:
        centre: of the bins, (n_bins,).
        mean: of the force, (n_bins,).
        std: standard deviation of the force, (n_bins,).
        width: of each bin.
    """

    centre: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    width: float

    @classmethod
    def of(cls, z: np.ndarray, w: np.ndarray) -> "Bins":
        """Bins of even width over a variable z (n,), of a force w (n,)."""
        edges = np.linspace(z.min(), z.max(), N_SHOWN_BINS + 1)
        below = np.searchsorted(edges, z, "right") - 1
        part = np.clip(below, 0, N_SHOWN_BINS - 1)
        count = np.bincount(part, minlength=N_SHOWN_BINS)
        at_least_one = np.maximum(count, 1)
        mean = np.bincount(part, w, N_SHOWN_BINS) / at_least_one
        deviation = w - mean[part]
        squares = np.bincount(part, deviation**2, N_SHOWN_BINS)
        std = np.sqrt(squares / at_least_one)
        centre = (edges[:-1] + edges[1:]) / 2
        shown = count >= FEWEST_IN_BIN
        width = float(edges[1] - edges[0])
        return cls(centre[shown], mean[shown], std[shown], width)

"""What all pictures share: axes to draw on, labels with units, and colours.

Pictures never call ``plt.show``: a caller shows or saves the figure of the axes.
"""

from typing import TYPE_CHECKING

from phsi_opt.presentation.numbers import typeset

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Contrast to white and to #16191d at least 3:1, as WCAG asks of graphics.
MEASURED = "#7a828c"  # grey: what was measured, and what stands for comparison
MODEL = "#2f7fd6"  # blue: the model, and what was estimated
FLOOR = "#3b8f5a"  # green: a limit set by the noise
ATTENTION = "#c8611a"  # orange: what a reader should look at first
FORCE = "#9a5fd0"  # violet: what is missing
MARK = "#b5459e"  # a place that somebody points at
BASELINE = "0.3"  # dark grey: the line at zero


def axes_of(ax: "Axes | None", size: tuple[float, float]) -> "Axes":
    """The axes, or those of a new figure.

    Args:
        ax: Axes to draw on; None: make a figure.
        size: Width and height of a new figure in inches.
    """
    import matplotlib.pyplot as plt

    if ax is not None:
        return ax
    _, new_axes = plt.subplots(figsize=size, layout="constrained")
    return new_axes


def label(name: str, unit: str) -> str:
    """The label of an axis, such as "t (s)"; the name alone where there is no unit."""
    return f"{name} ({typeset(unit)})" if unit else name

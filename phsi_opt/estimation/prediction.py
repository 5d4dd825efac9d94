"""What a fit predicts for new inputs, with a band: how well the parameters let it.

`comparison` has the band along measurements, whose starting states are estimated too.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.presentation.numbers import label
from phsi_opt.presentation.units import scale_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class Prediction:
    """States that a fit predicts from a given start, and how well they are known.

    Attributes:
        t: Times, (n_samples,).
        states: States at the times, (n_samples, n_states).
        std: Their standard deviation by that of the parameters, in the same shape; the
            starting state is taken as exact, and noise is not in it.
        names: Of the states.
        units: Unit by name, of states and the time ``t``.
    """

    t: np.ndarray
    states: np.ndarray
    std: np.ndarray
    names: tuple[str, ...]
    units: Mapping[str, str]

    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """Draw every state with a band of two standard deviations.

        Args:
            ax: Axes whose place is divided among the states; None: a new figure.

        Returns:
            The axes of the first state; those of the others are in its figure.
        """
        from phsi_opt.presentation.charts import MODEL, Chart, Curve, Panel, drawn

        time = scale_of(self.units.get("t", ""))
        panels = []
        for k, name in enumerate(self.names):
            scale = scale_of(self.units.get(name, ""))
            y = scale.shown(self.states[:, k])
            std = 2 * self.std[:, k] / scale.size
            curve = Curve("prediction", time.shown(self.t), y, MODEL, std=std)
            panels.append(Panel(label(name, scale.unit), (curve,)))
        return drawn(Chart(label("t", time.unit), tuple(panels)), "", ax)

"""Steps that go to and fro, or ever in the same direction: what they converge to.

Full Gauss-Newton steps converge linearly where residuals are large: each leaves the
same share of the error. A few of them tell that share, and what is left is taken off
at once (Anderson 1965; Walker and Ni, SIAM J. Numer. Anal. 49, 2011).
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

MOST_MIXED = 4  # steps of which the share is learned, at most
# Share of the largest curvature among the steps' changes below which one is rounding.
LEAST_CHANGE = 1e-12

Product = Callable[[np.ndarray], np.ndarray]


@dataclass(eq=False)
class MixedSteps:
    """What the last steps of one iteration say about where it ends.

    Attributes:
        share: the largest that a step alone would have left of the error before it.
    """

    share: float = 0.0
    _steps: list[np.ndarray] = field(default_factory=list)
    _ends: list[np.ndarray] = field(default_factory=list)

    def forget(self) -> None:
        """Begin anew: what follows belongs to another problem."""
        self._steps.clear()
        self._ends.clear()

    def end(self, step: np.ndarray, end: np.ndarray, times: Product) -> np.ndarray:
        """Where to go instead of to the end of a step, (n_end,).

        Of the affine combinations of the last steps that which is shortest.

        Args:
            step: (n,).
            end: (n_end,) where it leads, multipliers included.
            times: the product of the metric, (n, n), and a vector.
        """
        self._steps = [*self._steps[1 - MOST_MIXED :], step]
        self._ends = [*self._ends[1 - MOST_MIXED :], end]
        changes = np.diff(self._steps, axis=0)
        weighed = np.array([times(change) for change in changes])
        if not len(changes):
            return end
        shares = np.linalg.lstsq(weighed @ changes.T, weighed @ step, LEAST_CHANGE)[0]
        differences = np.diff(self._ends, axis=0)
        self._observe(changes[-1], differences[-1, : len(step)], times)
        mixed: np.ndarray = end - shares @ differences
        return mixed

    def _observe(self, change: np.ndarray, left: np.ndarray, times: Product) -> None:
        """Of a move, the difference between the ends of the steps at its two sides."""
        move = left - change
        size = float(move @ times(move))
        if size > 0:
            share = float(np.sqrt(max(float(left @ times(left)), 0.0) / size))
            self.share = max(self.share, share)

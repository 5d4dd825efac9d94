"""Records of one position and one force: thinned, and cut into windows.

A record over which small errors of a model are integrated is cut into windows with free
starting states. Thinning keeps every n-th position and the mean of the force in
between, which leaves the momentum exact.
"""

from dataclasses import dataclass

import numpy as np

import phsi_opt as ph


@dataclass(frozen=True, eq=False)
class Record:
    """Times, positions and forces of the same samples, each (n_samples,)."""

    t: np.ndarray
    q: np.ndarray
    u: np.ndarray

    def thinned(self, thin: int) -> "Record":
        """Every ``thin``-th position; the force as its mean in between."""
        n = (len(self.t) - 1) // thin
        u = self.u[: n * thin].reshape(n, thin).mean(axis=1)
        kept = slice(0, n * thin + 1, thin)
        return Record(self.t[kept], self.q[kept], np.append(u, u[-1]))

    def in_windows(self, size: int | None, units: dict[str, str]) -> ph.Measurements:
        """Windows of ``size`` steps that share their ends; None: one trajectory.

        The position is the state q; nobody measured its momentum p. A last window that
        is shorter than half of the others is left out.
        """
        n = len(self.t) - 1
        size = size or n
        pieces = [slice(i, i + size + 1) for i in range(0, n - size // 2, size)]
        x = np.column_stack([self.q, np.full(n + 1, np.nan)])
        return ph.Measurements.from_arrays(
            [self.t[piece] for piece in pieces],
            [x[piece] for piece in pieces],
            [self.u[piece][:, None] for piece in pieces],
            states=["q", "p"],
            inputs=["u"],
            hold="zero",
            units=units,
        )

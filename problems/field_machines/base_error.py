"""How far the model without the hidden effect stays from the machine: least squares of
its free parameters and starting states, without the package.
"""

import numpy as np
from scipy.optimize import least_squares

from problems.field_machines.motion import quick_runs
from problems.field_machines.records import Array, Experiment, Motion

STEP = 1e-5  # of the differences, in scales of the unknowns
EVALUATIONS = 40  # of the runs, at most
TOLERANCE = 1e-4  # of the error: more is not needed to set a size


class BaseFit:
    """Least squares of the model without the effect to noise-free training runs."""

    def __init__(self, e: Experiment) -> None:
        self.e = e
        self.names = list(e.values)
        self.starts = e.starts[: e.n_train]
        size = np.sqrt(np.mean(self.starts**2, axis=0))
        scales = [max(abs(value), 1e-9) for value in e.values.values()]
        of_starts = np.tile(np.maximum(size, size.max() * 1e-3), e.n_train)
        self.scale = np.concatenate([scales, of_starts])
        first = [*e.values.values(), *self.starts.ravel()]
        self.unknowns = np.array(first) / self.scale

    def error(self, motion: Motion) -> float:
        """Root mean square over the seen channels, each in its own root mean square.

        Goes on from the last call's optimum.
        """
        e = self.e
        kept = e.kept[:, : e.n_train]
        seen = motion.x[:, : e.n_train, list(e.seen)]
        scale = np.sqrt(np.mean(seen[kept] ** 2, axis=0))
        u = motion.u[:, : e.n_train]

        def residuals(unknowns: Array) -> Array:
            runs = self._runs(unknowns[None], u)[0]
            left = ((runs - seen) / scale)[kept].ravel()
            return np.nan_to_num(np.clip(left, -1e3, 1e3), nan=1e3)

        def slopes(unknowns: Array) -> Array:
            varied = unknowns + STEP * np.eye(len(unknowns))
            runs = self._runs(np.concatenate([unknowns[None], varied]), u)
            change = (runs[1:] - runs[0]) / scale / STEP
            columns = [one[kept].ravel() for one in change]
            return np.nan_to_num(np.stack(columns, axis=1))

        lower = np.full(len(self.scale), -np.inf)
        lower[: len(self.names)] = 0.0
        found = least_squares(
            residuals,
            np.maximum(self.unknowns, lower),
            jac=slopes,
            bounds=(lower, np.inf),
            ftol=TOLERANCE,
            max_nfev=EVALUATIONS,
        )
        self.unknowns = found.x
        return float(np.sqrt(np.mean(found.fun**2)))

    def _runs(self, unknowns: Array, u: Array) -> Array:
        """Seen channels (n_variations, n_samples, n_runs, n_seen)."""
        e = self.e
        numbers = unknowns * self.scale
        values = {}
        for k, name in enumerate(self.names):
            values[name] = numbers[:, k, None]
        starts = numbers[:, len(self.names) :].reshape(-1, *self.starts.shape)
        x = quick_runs(e, u, values, starts)
        return np.moveaxis(x, 0, 1)[..., list(e.seen)]

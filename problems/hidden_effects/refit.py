"""How far the model without the effect stays from a machine that has it.

Least squares over the free parameters and starting states (Levenberg and Marquardt);
slopes by differences, all variations integrated together. It costs less than the
diagnosis, so that an effect's size can be set by it.
"""

import numpy as np

from problems.hidden_effects.machines import Setting, values_of, with_values
from problems.hidden_effects.rows import N_TRAIN, STEPS
from problems.hidden_effects.truth import Array, simulate

STEP = 1e-4  # of the differences
FIRST_DAMPING = 1e-3
LEAST_DAMPING = 1e-6
SETTLED = 0.98  # a step that leaves more than this share of the error is the last
RIDGE = 1e-12  # share of the trace, where a direction is not seen at all


class Refit:
    """Least squares of the model without the effect to noise-free samples of the
    training runs.
    """

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        self.drive = setting.training_drive
        values = values_of(setting.machine)
        self.first_theta = np.array([values[name] for name in setting.free])
        self.first_starts = setting.training_starts
        self.theta = self.first_theta
        self.starts = self.first_starts

    def error(self, y: Array, rounds: int = 10) -> float:
        """Free-run error over the channels, each in its standard deviations.

        Goes on from the last call's optimum. ``y``: (n_times, n_runs, n_states).
        """
        target = y[:, :N_TRAIN, list(self.setting.seen)]
        scale = target.std(axis=(0, 1))
        best = np.inf
        damping = FIRST_DAMPING
        theta = self.theta
        starts = self.starts
        for _ in range(rounds):
            runs, slopes = self._slopes(theta, starts)
            left = (target - runs) / scale
            error = float(np.sqrt(np.mean(left**2)))
            # The hidden effect or the start runs away.
            if not np.isfinite(error) and not np.isfinite(best):
                return np.inf
            if error < best:
                is_last = error > SETTLED * best and damping <= FIRST_DAMPING
                best = error
                self.theta = theta
                self.starts = starts
                damping = max(damping / 10, LEAST_DAMPING)
                columns = self._columns(slopes / scale)
                residual = left.ravel()
                if is_last:
                    break
            else:
                damping *= 20
            change = _damped(columns, residual, damping)
            n_theta = len(self.theta)
            of_starts = change[n_theta:].reshape(self.starts.shape)
            theta = np.maximum(self.theta + change[:n_theta], 0.0)
            starts = self.starts + of_starts
        return best

    def move(self, factor: float) -> None:
        """Where the optimum should be for ``factor`` times the last size: in proportion
        from that without an effect.
        """
        moved = self.theta - self.first_theta
        self.theta = np.maximum(self.first_theta + factor * moved, 0.0)
        self.starts = self.first_starts + factor * (self.starts - self.first_starts)

    def _runs(self, theta: Array, starts: Array) -> Array:
        """Measured channels (n_variations, n_times, n_trajectories, n_seen) of
        (n_variations, ...) parameters.
        """
        s = self.setting
        values = {}
        for name, value in values_of(s.machine).items():
            values[name] = np.full(len(theta), value)
        values |= dict(zip(s.free, np.maximum(theta, 0.0).T, strict=True))
        machine = with_values(s.machine, values)
        x = simulate(machine, (), starts, self.drive, s.t, STEPS)
        return np.moveaxis(x, 1, 0)[..., list(s.seen)]

    def _slopes(self, theta: Array, starts: Array) -> tuple[Array, Array]:
        """The runs and their slopes in every parameter and (for all trajectories at
        once) every starting value.
        """
        n_theta = len(theta)
        n_x = starts.shape[1]
        of_theta = np.arange(n_theta)
        of_start = np.arange(n_x)
        thetas = np.tile(theta, (1 + n_theta + n_x, 1))
        thetas[1 + of_theta, of_theta] += STEP
        all_starts = np.tile(starts, (1 + n_theta + n_x, 1, 1))
        all_starts[1 + n_theta + of_start, :, of_start] += STEP
        runs = self._runs(thetas, all_starts)
        return runs[0], (runs[1:] - runs[0]) / STEP

    def _columns(self, slopes: Array) -> Array:
        """Slopes as columns; a starting value moves its own trajectory alone."""
        n_theta = len(self.theta)
        n_x = self.starts.shape[1]
        by_run = np.zeros((N_TRAIN, n_x, *slopes.shape[1:]))
        for run in range(N_TRAIN):
            by_run[run, :, :, run] = slopes[n_theta:, :, run]
        in_theta = slopes[:n_theta].reshape(n_theta, -1)
        in_starts = by_run.reshape(N_TRAIN * n_x, -1)
        return np.concatenate([in_theta, in_starts]).T


def _damped(columns: Array, residual: Array, damping: float) -> Array:
    """A step of Levenberg and Marquardt."""
    information = columns.T @ columns
    diagonal = np.diag(information) * damping + RIDGE * np.trace(information)
    return np.linalg.solve(information + np.diag(diagonal), columns.T @ residual)

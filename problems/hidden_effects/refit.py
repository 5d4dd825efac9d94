"""How far the model without the effect stays from a machine that has it."""

from dataclasses import replace

import numpy as np

from problems.hidden_effects.machines import Setting, values_of, with_values
from problems.hidden_effects.rows import N_TRAIN, STEPS
from problems.hidden_effects.truth import Array, simulate


class Refit:
    """Least squares of the model without the effect to noise-free samples of the
    training runs.
    """

    def __init__(self, setting: Setting) -> None:
        self.setting, self.drive = setting, setting.drive
        if self.drive is not None:
            self.drive = replace(self.drive, values=self.drive.values[:N_TRAIN])
        self.starts = setting.starts[:N_TRAIN]
        self.theta = np.array(
            [values_of(setting.machine)[name] for name in setting.free]
        )
        self.begun = self.theta, self.starts

    def _runs(self, theta: Array, starts: Array) -> Array:
        """Measured channels (n_variations, n_times, n_trajectories, n_seen) of
        (n_variations, ...) parameters.
        """
        s = self.setting
        values = {
            name: np.full(len(theta), value)
            for name, value in values_of(s.machine).items()
        }
        values |= dict(zip(s.free, np.maximum(theta, 0.0).T, strict=True))
        x = simulate(with_values(s.machine, values), (), starts, self.drive, s.t, STEPS)
        return np.moveaxis(x, 1, 0)[..., list(s.seen)]

    def error(self, y: Array, rounds: int = 10) -> float:
        """Free-run error over the channels, each in its standard deviations (Levenberg
        and Marquardt).

        Goes on from the last call's optimum.
        """
        target = y[:, :N_TRAIN, list(self.setting.seen)]
        scale = target.std(axis=(0, 1))
        best, damping = np.inf, 1e-3
        theta, starts = self.theta, self.starts
        for _ in range(rounds):
            runs, slopes = self._slopes(theta, starts)
            error = float(np.sqrt(np.mean(((target - runs) / scale) ** 2)))
            if not np.isfinite(error) and not np.isfinite(
                best
            ):  # the hidden effect or the start runs away
                return np.inf
            if error < best:
                settled = error > 0.98 * best and damping <= 1e-3
                best, self.theta, self.starts, damping = (
                    error,
                    theta,
                    starts,
                    max(damping / 10, 1e-6),
                )
                columns, left = (
                    self._columns(slopes / scale),
                    ((target - runs) / scale).ravel(),
                )
                if settled:
                    break
            else:
                damping *= 20
            change = _damped(columns, left, damping)
            theta = np.maximum(self.theta + change[: len(self.theta)], 0.0)
            starts = self.starts + change[len(self.theta) :].reshape(self.starts.shape)
        return best

    def move(self, factor: float) -> None:
        """Where the optimum should be for ``factor`` times the last size: in proportion
        from that without an effect.
        """
        theta, starts = self.begun
        self.theta = np.maximum(theta + factor * (self.theta - theta), 0.0)
        self.starts = starts + factor * (self.starts - starts)

    def _slopes(self, theta: Array, starts: Array) -> tuple[Array, Array]:
        """The runs and their slopes in every parameter and (for all trajectories at
        once) every starting value.
        """
        n_theta, n_x, h = len(theta), starts.shape[1], 1e-4
        moved = np.tile(theta, (1 + n_theta + n_x, 1))
        begun = np.tile(starts, (1 + n_theta + n_x, 1, 1))
        moved[1 + np.arange(n_theta), np.arange(n_theta)] += h
        begun[1 + n_theta + np.arange(n_x), :, np.arange(n_x)] += h
        runs = self._runs(moved, begun)
        return runs[0], (runs[1:] - runs[0]) / h

    def _columns(self, slopes: Array) -> Array:
        n_theta, n_x = len(self.theta), self.starts.shape[1]
        own = np.zeros((N_TRAIN, n_x, *slopes.shape[1:]))
        for run in range(N_TRAIN):  # a starting value moves its own trajectory alone
            own[run, :, :, run] = slopes[n_theta:, :, run]
        return np.concatenate(
            [slopes[:n_theta].reshape(n_theta, -1), own.reshape(N_TRAIN * n_x, -1)]
        ).T


def _damped(columns: Array, left: Array, damping: float) -> Array:
    information = columns.T @ columns
    ridge = np.diag(np.diag(information) * damping + 1e-12 * np.trace(information))
    return np.linalg.solve(information + ridge, columns.T @ left)

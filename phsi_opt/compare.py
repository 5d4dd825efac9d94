"""Model against measurements: the free run, its errors, and what the noise alone would leave."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy.optimize import least_squares
from scipy.stats import chi2

from phsi_opt.errors import SolveError
from phsi_opt.fit import Fit
from phsi_opt.grid import grid_of
from phsi_opt.identify import matched
from phsi_opt.measurements import Measurements
from phsi_opt.model import Model
from phsi_opt.simulate import simulate
from phsi_opt.start import initial_noise, smoothed
from phsi_opt.work import data_digest

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LOST = 1e3  # residual, in standard deviations of a channel, that stands for a simulation that broke off
WORST_OF_NOISE = 4.0  # standard deviations of noise beyond which a single residual ends the free-run horizon


@dataclass(frozen=True, eq=False)
class Comparison:
    """A free run beside the measurements.

    ``simulated`` and ``residuals`` hold one array (n_samples, n_states) per trajectory; ``noise`` is the measurement
    noise per state, estimated with a free missing force, so that a wrong model does not inflate it.
    """

    model: Model
    data: Measurements
    simulated: tuple[np.ndarray, ...]
    residuals: tuple[np.ndarray, ...]
    noise: np.ndarray

    @cached_property
    def table(self) -> pd.DataFrame:
        """Per measured state: unit, fit %, rmse, noise_floor, chi2_dof, whiteness (p-value), horizon, n_samples."""
        rows = [self._row(k, name) for k, name in enumerate(self.model.states) if name in self.data.measured]
        columns = [
            "state",
            "unit",
            "fit_percent",
            "rmse",
            "noise_floor",
            "chi2_dof",
            "whiteness",
            "horizon",
            "n_samples",
        ]
        return pd.DataFrame(rows, columns=columns)

    def _row(self, k: int, name: str) -> tuple[Any, ...]:
        r = np.concatenate([run[:, k] for run in self.residuals])
        y = np.concatenate([run.x[:, k] for run in self.data.trajectories])
        r, y = r[np.isfinite(y)], y[np.isfinite(y)]
        rmse = float(np.sqrt(np.mean(r**2)))
        fit = 100 * (1 - rmse / max(float(np.std(y)), 1e-300))
        horizon = min(self._horizon(i, k) for i in range(len(self.residuals)))
        unit = self.data.units.get(name, "")
        return name, unit, fit, rmse, self.noise[k], (rmse / self.noise[k]) ** 2, self._whiteness(k), horizon, len(r)

    def _horizon(self, run: int, k: int) -> float:
        """Time from the start until a residual leaves the noise."""
        t, r = self.data.trajectories[run].t, self.residuals[run][:, k]
        beyond = np.flatnonzero(np.abs(np.nan_to_num(r)) > WORST_OF_NOISE * self.noise[k])
        return float((t[beyond[0]] if len(beyond) else t[-1]) - t[0])

    def _whiteness(self, k: int) -> float:
        """p-value of Ljung and Box's test of the residuals at the first lags."""
        statistic, n_lags = 0.0, 0
        for run in self.residuals:
            r = run[np.isfinite(run[:, k]), k]
            lags = min(10, len(r) // 5)
            power = float(np.sum(r**2))
            for lag in range(1, lags + 1) if power > 0 else ():
                statistic += len(r) * (len(r) + 2) * (np.sum(r[lag:] * r[:-lag]) / power) ** 2 / (len(r) - lag)
            n_lags += lags
        return float(chi2.sf(statistic, n_lags)) if n_lags else np.nan

    @property
    def weights(self) -> np.ndarray:
        """Scale of each state in `rmse`: one where a single channel is measured, else 1/(its standard deviation)."""
        seen = [name in self.data.measured for name in self.model.states]
        if sum(seen) == 1:
            return np.where(seen, 1.0, 0.0)
        y = np.concatenate([run.x for run in self.data.trajectories])
        spread = np.array([np.nanstd(y[:, k]) if seen[k] else np.inf for k in range(len(seen))])
        return 1 / np.where(spread > 0, spread, 1.0)

    @cached_property
    def squares(self) -> np.ndarray:
        """Squared, scaled residuals of all measured values in the order of time, trajectory after trajectory."""
        rows = [((r * self.weights) ** 2)[np.isfinite(run.x)] for r, run in self._pairs()]
        return np.concatenate(rows)

    def _pairs(self) -> list[tuple[np.ndarray, Any]]:
        return list(zip(self.residuals, self.data.trajectories, strict=True))

    @property
    def rmse(self) -> float:
        """Root mean square of the free-run residual over the measured channels, on the scale of `weights`."""
        return float(np.sqrt(np.mean(self.squares)))

    @property
    def noise_floor(self) -> float:
        """What the estimated measurement noise alone leaves, on the same scale."""
        n = np.array([np.isfinite(np.concatenate([r.x[:, k] for r in self.data.trajectories])).sum()
                      for k in range(len(self.weights))])  # fmt: skip
        return float(np.sqrt(np.sum(n * (self.noise * self.weights) ** 2) / n.sum()))

    @cached_property
    def energy(self) -> pd.DataFrame:
        """Energy balance of the free run per trajectory: change of H = supplied - dissipated (trapezoid rule)."""
        rows = []
        for x, run in zip(self.simulated, self.data.trajectories, strict=True):
            rows.append((run.name, *_energy_balance(self.model, x, run.t, run.u)))
        return pd.DataFrame(rows, columns=["trajectory", "change", "supplied", "dissipated"])

    def plot(self, ax: "Axes | None" = None, trajectory: int = 0) -> "Axes":
        """Measurements, free run and residual of one trajectory."""
        from phsi_opt.plotting import plot_comparison

        return plot_comparison(self, ax, trajectory)

    def __str__(self) -> str:
        return (
            f"Free run against {self.data.n_samples} samples: rmse {self.rmse:.4g}, "
            f"noise floor {self.noise_floor:.4g}\n"
            + self.table.to_string(index=False, float_format=lambda v: f"{v:.4g}")
        )

    __repr__ = __str__


def compare(fit: Fit, data: Measurements) -> Comparison:
    """Simulate the fitted model from starting states estimated from the record, and compare (see `Comparison`)."""
    data = matched(fit.model, data)
    model = fit.model.frozen()
    grid = grid_of(data)
    known = None if data.noise is None else np.array([data.noise.get(n, np.nan) for n in model.states])
    estimate = smoothed(model, grid, initial_noise(data, known), "srk4", known_noise=known is not None)
    # The starting states of a fit to these very measurements are its own; others are estimated from the record.
    own = bool(fit.states) and fit.provenance.get("data_sha256") == data_digest(data)
    simulated = []
    for i, run in enumerate(data.trajectories):
        guess = fit.states[i][0] if own else estimate.x[grid.trajectory == i][0]
        simulated.append(free_run(model, run.t, run.x, run.u, guess, estimate.sigma, data.hold, search=not own))
    residuals = tuple(run.x - x for run, x in zip(data.trajectories, simulated, strict=True))
    return Comparison(model, data, tuple(simulated), residuals, estimate.sigma)


def free_run(
    model: Model, t: np.ndarray, y: np.ndarray, u: np.ndarray, guess: np.ndarray, sigma: np.ndarray, hold: str,
    search: bool = True,
) -> np.ndarray:  # fmt: skip
    """The simulation whose starting state fits the record best, found by least squares from ``guess`` if ``search``."""
    seen = np.isfinite(y)

    def residual(x0: np.ndarray) -> np.ndarray:
        try:
            x = simulate(model, t, x0, u, hold=hold)
        except SolveError:
            return np.full(seen.sum(), LOST)
        return np.clip(((x - y) / sigma)[seen], -LOST * 10, LOST * 10)

    size = np.maximum(np.abs(guess), 1e-3 * np.max(np.abs(guess)) + 1e-12)
    start = least_squares(residual, guess, x_scale=size, diff_step=1e-5, max_nfev=8, ftol=1e-6).x if search else guess
    try:
        return simulate(model, t, start, u, hold=hold)
    except SolveError:
        return np.where(np.arange(len(t))[:, None] == 0, start, LOST * np.nanstd(np.where(seen, y, np.nan)))


def _energy_balance(model: Model, x: np.ndarray, t: np.ndarray, u: np.ndarray) -> tuple[float, float, float]:
    import casadi as ca

    n = len(t)
    sx, su, st = ca.SX.sym("x", model.n_states), ca.SX.sym("u", model.n_inputs), ca.SX.sym("t")
    e = model.expressions(
        [sx[i] for i in range(model.n_states)], [su[i] for i in range(model.n_inputs)], st, model.values
    )
    supplied = sum((f * g for f, g in zip(e.force, e.efforts, strict=True)), start=ca.SX(0))
    lost = sum((r * g**2 for r, g in zip(e.loss, e.efforts, strict=True)), start=ca.SX(0))
    powers = ca.Function("p", [sx, su, st], [ca.SX(e.energy), supplied, lost]).map(n)
    energy, gain, loss = (np.array(v).ravel() for v in powers(x.T, u.T, t[None, :]))
    return float(energy[-1] - energy[0]), float(np.trapezoid(gain, t)), float(np.trapezoid(loss, t))

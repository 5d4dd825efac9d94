"""Model against measurements: the free run, its errors, and what the noise alone would
leave.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy.stats import chi2

from phsi_opt.comparison.prediction_bands import bands
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.trajectory import Trajectory
from phsi_opt.errors import SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.missing_force import ForceEstimate, force_of
from phsi_opt.estimation.smoothing import explained
from phsi_opt.estimation.trajectory_parameters import parameter_matrix, parameters_of
from phsi_opt.model.model import Model
from phsi_opt.simulation.free_run import free_run
from phsi_opt.statistics import TINY
from phsi_opt.transcription.alignment import aligned
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.sensors import outputs_at_samples

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from phsi_opt.presentation.pictures import Channel

# in standard deviations of the measurements: stands for a simulation that broke off
LOST = 1e3
# standard deviations of noise beyond which a single residual ends the free-run horizon
WORST_OF_NOISE = 4.0


@dataclass(frozen=True, eq=False)
class Comparison:
    """A free run beside the measurements.

    ``simulated``, ``shown`` (what the sensors would show of it) and ``residuals`` hold
    one array (n_samples, n_states) per trajectory, ``values`` the free parameters that
    were used in each; ``noise`` is the measurement noise per state, estimated with a
    free missing force, so that a wrong model does not inflate it.
    """

    fit: Fit
    data: Measurements
    values: Mapping[str, Mapping[str, float]]
    simulated: tuple[np.ndarray, ...]
    shown: tuple[np.ndarray, ...]
    residuals: tuple[np.ndarray, ...]
    noise: np.ndarray

    @property
    def model(self) -> Model:
        """The model that ran."""
        return self.fit.model

    @cached_property
    def bands(self) -> tuple[np.ndarray, ...] | None:
        """Standard deviation of what the free run shows (see `record.bands`), per
        trajectory; None: not known.
        """
        return bands(self.fit, self.data, self.noise, self.simulated, self.values)

    @cached_property
    def table(self) -> pd.DataFrame:
        """Per measured state: unit, fit %, rmse, noise_floor, chi2_dof, whiteness
        (p-value), horizon, n_samples.
        """
        rows = [
            self._row(k, name)
            for k, name in enumerate(self.model.states)
            if name in self.data.measured
        ]
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
        fit = 100 * (1 - rmse / max(float(np.std(y)), TINY))
        horizon = min(self._horizon(i, k) for i in range(len(self.residuals)))
        unit = self.data.units.get(name, "")
        return (
            name,
            unit,
            fit,
            rmse,
            self.noise[k],
            (rmse / self.noise[k]) ** 2,
            self._whiteness(k),
            horizon,
            len(r),
        )

    def _horizon(self, run: int, k: int) -> float:
        """Time from the start until a residual leaves the noise."""
        t, r = self.data.trajectories[run].t, self.residuals[run][:, k]
        beyond = np.flatnonzero(
            np.abs(np.nan_to_num(r)) > WORST_OF_NOISE * self.noise[k]
        )
        return float((t[beyond[0]] if len(beyond) else t[-1]) - t[0])

    def _whiteness(self, k: int) -> float:
        """p-value of Ljung and Box's test of the residuals at the first lags."""
        statistic, n_lags = 0.0, 0
        for run in self.residuals:
            r = run[np.isfinite(run[:, k]), k]
            lags = min(10, len(r) // 5)
            power = float(np.sum(r**2))
            for lag in range(1, lags + 1) if power > 0 else ():
                statistic += (
                    len(r)
                    * (len(r) + 2)
                    * (np.sum(r[lag:] * r[:-lag]) / power) ** 2
                    / (len(r) - lag)
                )
            n_lags += lags
        return float(chi2.sf(statistic, n_lags)) if n_lags else np.nan

    @property
    def weights(self) -> np.ndarray:
        """Scale of each state in `rmse`: one where a single channel is measured, else
        1/(its standard deviation).
        """
        seen = [name in self.data.measured for name in self.model.states]
        if sum(seen) == 1:
            return np.where(seen, 1.0, 0.0)
        y = np.concatenate([run.x for run in self.data.trajectories])
        spread = np.array(
            [np.nanstd(y[:, k]) if seen[k] else np.inf for k in range(len(seen))]
        )
        return 1 / np.where(spread > 0, spread, 1.0)

    @cached_property
    def squares(self) -> np.ndarray:
        """Squared, scaled residuals of all measured values in the order of time,
        trajectory after trajectory.
        """
        rows = [
            ((r * self.weights) ** 2)[np.isfinite(run.x)] for r, run in self._pairs()
        ]
        return np.concatenate(rows)

    def _pairs(self) -> list[tuple[np.ndarray, Any]]:
        return list(zip(self.residuals, self.data.trajectories, strict=True))

    @property
    def rmse(self) -> float:
        """Root mean square of the free-run residual over the measured channels, on the
        scale of `weights`.
        """
        return float(np.sqrt(np.mean(self.squares)))

    @property
    def noise_floor(self) -> float:
        """What the estimated measurement noise alone leaves, on the same scale."""
        n = np.array(
            [
                np.isfinite(
                    np.concatenate([r.x[:, k] for r in self.data.trajectories])
                ).sum()
                for k in range(len(self.weights))
            ]
        )
        return float(np.sqrt(np.sum(n * (self.noise * self.weights) ** 2) / n.sum()))

    @cached_property
    def energy(self) -> pd.DataFrame:
        """Energy balance of the free run per trajectory: change of H = supplied -
        dissipated (trapezoid rule).
        """
        rows = []
        for x, run in zip(self.simulated, self.data.trajectories, strict=True):
            model = self.model.with_values(self.values[run.name])
            rows.append((run.name, *_energy_balance(model, x, run.t, run.u)))
        return pd.DataFrame(
            rows, columns=["trajectory", "change", "supplied", "dissipated"]
        )

    def plot(self, ax: "Axes | None" = None, trajectory: str | int = 0) -> "Axes":
        """Draw measurements and free run of one trajectory.

        A band covers two standard deviations of what is uncertain in the run.

        Args:
            ax: Axes to draw on; None: a new figure.
            trajectory: Name of the trajectory, or its number, counted from 0.

        Raises:
            DataError: There is no such trajectory.
        """
        from phsi_opt.presentation.pictures import plot_free_run

        number = self.data.trajectory_number(trajectory)
        run = self.data.trajectories[number]
        title = (
            f"Free run of {run.name}: rmse {self.rmse:.3g}, "
            f"noise floor {self.noise_floor:.3g} (all runs)"
        )
        t_unit = self.data.units.get("t", "")
        return plot_free_run(
            run.t, self._channels(number), t_unit=t_unit, title=title, ax=ax
        )

    def _channels(self, number: int) -> "list[Channel]":
        """What a picture shows of one trajectory."""
        from phsi_opt.presentation.pictures import Channel

        run = self.data.trajectories[number]
        simulated = self.shown[number]
        std = None if self.bands is None else self.bands[number]
        channels = []
        for k, name in enumerate(self.model.states):
            if name in self.data.measured:
                unit = self.data.units.get(name, "")
                std_of_state = None if std is None else std[:, k]
                channels.append(
                    Channel(name, unit, run.x[:, k], simulated[:, k], std_of_state)
                )
        return channels

    def __str__(self) -> str:
        return (
            f"Free run against {self.data.n_samples} samples: rmse {self.rmse:.4g}, "
            f"noise floor {self.noise_floor:.4g}\n"
            + self.table.to_string(index=False, float_format=lambda v: f"{v:.4g}")
        )

    __repr__ = __str__


def compare(fit: Fit, data: Measurements) -> Comparison:
    """Simulate the fitted model from starting states estimated from the record, and
    compare (see `Comparison`).

    Parameters that every trajectory has of its own are those of the fit for
    trajectories of the same name, and estimated from the record, with its starting
    state, for others.
    """
    data = aligned(fit.model, data)
    estimate = force_of(fit, data)
    return compared(fit, data, estimate.sigma, estimate.grid.split(estimate.x))


def compared(
    fit: Fit, data: Measurements, sigma: np.ndarray, guess: Sequence[np.ndarray]
) -> Comparison:
    """`compare` with the noise known, and states to start from that may lack the memory
    of the model's effects.
    """
    data = aligned(fit.model, data)
    sigma = np.r_[sigma, np.ones(fit.model.n_states - len(sigma))]
    # The starting states of a fit to these very measurements are its own; others are
    # estimated from the record.
    if fit.states and fit.provenance.get("data_sha256") == data.digest:
        states: Sequence[np.ndarray] = fit.states
        values = parameters_of(fit, data)
    else:
        values, grid = parameters_of(fit, data), grid_of(data)
        guess = grid.split(
            with_memory(
                fit.model,
                grid,
                np.concatenate(guess),
                parameter_matrix(fit.model, values),
            )
        )
        # Where no states obey the model along the whole record, those of the missing
        # force are the best to start from. Outliers that the fit set aside must not
        # make up the noise here.
        own = np.array(
            [
                fit.noise.get(name, s)
                for name, s in zip(fit.model.states, sigma, strict=True)
            ]
        )
        found = explained(fit, data, sigma if fit.huber is None else own, guess)
        states, values = found or (guess, values)
    simulated = tuple(
        _free_run(fit.model.with_values(values[run.name]), run, x[0], data.hold)
        for run, x in zip(data.trajectories, states, strict=True)
    )
    seen = outputs_at_samples(
        fit.model, data, simulated, parameter_matrix(fit.model, values)
    )
    residuals = tuple(run.x - y for run, y in zip(data.trajectories, seen, strict=True))
    return Comparison(fit, data, values, simulated, seen, residuals, sigma)


def _free_run(model: Model, run: Trajectory, x0: np.ndarray, hold: str) -> np.ndarray:
    """The simulation from x0; where it breaks off, values far beyond every measurement."""
    try:
        return free_run(model, run.t, x0, run.u, hold)
    except SolveError:
        return np.where(
            np.arange(run.n_samples)[:, None] == 0, x0, LOST * np.nanstd(run.x)
        )


def _energy_balance(
    model: Model, x: np.ndarray, t: np.ndarray, u: np.ndarray
) -> tuple[float, float, float]:
    import casadi as ca

    n = len(t)
    sx, su, st = (
        ca.SX.sym("x", model.n_states),
        ca.SX.sym("u", model.n_inputs),
        ca.SX.sym("t"),
    )
    e = model.expressions(
        [sx[i] for i in range(model.n_states)],
        [su[i] for i in range(model.n_inputs)],
        st,
        model.values,
    )
    supplied = sum(
        (f * g for f, g in zip(e.force, e.efforts, strict=True)), start=ca.SX(0)
    )
    lost = sum(
        (r * g**2 for r, g in zip(e.loss, e.efforts, strict=True)), start=ca.SX(0)
    )
    powers = ca.Function("p", [sx, su, st], [ca.SX(e.energy), supplied, lost]).map(n)
    energy, gain, loss = (np.array(v).ravel() for v in powers(x.T, u.T, t[None, :]))
    return (
        float(energy[-1] - energy[0]),
        float(np.trapezoid(gain, t)),
        float(np.trapezoid(loss, t)),
    )


def compared_from_estimate(
    fit: Fit, data: Measurements, estimate: ForceEstimate
) -> Comparison:
    return compared(fit, data, estimate.sigma, estimate.grid.split(estimate.x))

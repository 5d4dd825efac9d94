"""Model against measurements: the free run, its errors, and what noise alone leaves.

A free run begins at a state that was estimated from the whole record and never looks at
the measurements again. A prediction over one step would hide what a model lacks: every
sample would correct it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from phsi_opt.arguments import typed
from phsi_opt.criteria import (
    EXPLAINED_IF_NAMED,
    FAILING_ERROR,
    SURE_ERROR,
    SURE_LEVEL,
    WHITE_ERROR,
)
from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.free_runs import (
    Parameters,
    Runs,
    WithResiduals,
    channels,
    free_runs,
    parameter_matrix,
    plot_run,
)
from phsi_opt.estimation.identify import fit_of
from phsi_opt.estimation.noise_estimation import LEAST_COUNTED
from phsi_opt.estimation.record import (
    Record,
    leaving_words,
    smoothed_states,
)
from phsi_opt.initialization.scaling import point_at
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import Expressions, function_of
from phsi_opt.model_error.linearization import Linearizer
from phsi_opt.model_error.marginal_likelihood import white_system
from phsi_opt.optimization.column_function import in_numbers
from phsi_opt.presentation.content import Channel
from phsi_opt.presentation.numbers import with_interval
from phsi_opt.presentation.summary import Part, Summarised, Summary, printed_table
from phsi_opt.presentation.units import STANDARD_DEVIATIONS, Scale, scale_of, spaced
from phsi_opt.statistics import (
    TINY,
    autocorrelation_time,
    chi_square_limit,
    ljung_box,
    rms,
)
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.sensors import output_slopes, output_slopes_in_theta

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes


# Standard deviations of the noise beyond which one residual ends the horizon of a free
# run: among 1e4 values normal noise gets there once or not at all.
HORIZON_RESIDUAL = 4.0


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(WithResiduals, Summarised):
    """A free run compared with the measurements.

    Attributes:
        record: the fit, the measurements, and the noise, which was estimated together
            with a missing force so that a wrong model does not inflate it.
        values: the free parameters that were used, by trajectory and name.
        simulated: states of the free run, one (n_samples, n_states) per trajectory.
        shown: the predicted sensor values, in the same shape.
        residuals: measured minus predicted values, in the same shape; NaN for missing
            values.
    """

    _between = "\n"
    record: Record
    values: Parameters
    simulated: tuple[np.ndarray, ...]
    shown: tuple[np.ndarray, ...]
    residuals: tuple[np.ndarray, ...]

    @property
    def fit(self) -> Fit:
        """The fit that was simulated."""
        return self.record.fit

    @property
    def model(self) -> Model:
        """The model that was simulated."""
        return self.record.model

    @property
    def data(self) -> Measurements:
        """The measurements, in the model's order."""
        return self.record.data

    @property
    def _residuals(self) -> tuple[Measurements, Runs]:
        return self.data, self.residuals

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of the noise, (n_states,); one for unmeasured states."""
        return self.record.sigma

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviation of the noise by measured state, in its unit."""
        by_state = zip(self.model.states, self.sigma.tolist(), strict=True)
        return {name: s for name, s in by_state if name in self.data.measured}

    @cached_property
    def _y(self) -> np.ndarray:
        return self.data.stacked("x")  # (n_samples of all trajectories, n_states)

    @cached_property
    def _n_values(self) -> np.ndarray:
        """How many values were measured of each state, (n_states,)."""
        return np.isfinite(self._y).sum(axis=0)

    @cached_property
    @interruptible
    def bands(self) -> tuple[np.ndarray, ...] | None:
        """Standard deviation of the prediction by the free run, per trajectory.

        See `prediction_bands`; None where it is not known.
        """
        return prediction_bands(self.record, self.simulated, self.values)

    @cached_property
    def table(self) -> "pd.DataFrame":
        """A row per measured state.

        Columns: state; unit; fit_percent (100 for a perfect free run, 0 for one as good
        as the mean); rmse and noise_floor in the unit of the state; chi2_dof (their
        ratio squared); whiteness (p-value of Ljung and Box's test, 1978); horizon (time
        until a residual leaves the noise, in the worst trajectory); n_samples.
        """
        rows = map(self._row, np.flatnonzero(self._n_values).tolist())
        return printed_table(rows)

    def _row(self, number: int) -> dict[str, object]:
        name = self.model.states[number]
        residuals = [_known(run[:, number]) for run in self.residuals]
        rmse = rms(np.concatenate(residuals))
        spread = float(np.std(_known(self._y[:, number])))
        floor = self.sigma[number]
        scale = scale_of(self.data.units.get(name, ""))
        time = scale_of(self.data.units.get("t", ""))
        horizons = []
        for run, of_run in zip(self.data.trajectories, self.residuals, strict=True):
            is_beyond = np.abs(of_run[:, number]) > HORIZON_RESIDUAL * floor
            beyond = np.append(np.flatnonzero(is_beyond), run.n_samples - 1)
            horizons.append(float(run.t[beyond[0]] - run.t[0]))
        return {
            "state": name,
            "unit": scale.unit,
            "fit_percent": 100 * (1 - rmse / max(spread, TINY)),
            "rmse": rmse / scale.size,
            "noise_floor": floor / scale.size,
            "chi2_dof": (rmse / floor) ** 2,
            "whiteness": ljung_box(residuals),
            "horizon": min(horizons) / time.size,
            "n_samples": int(self._n_values[number]),
        }

    @cached_property
    def flat(self) -> tuple[str, ...]:
        """Names of the states whose free run is almost constant."""
        shown = np.concatenate(self.shown)
        names = []
        for number in np.flatnonzero(self._n_values).tolist():
            y = self._y[:, number]
            seen = shown[np.isfinite(y), number]
            if is_flat(_known(y), seen, self.sigma[number]):
                names.append(self.model.states[number])
        return tuple(names)

    @property
    def warning(self) -> str:
        """What to do if the free run leaves the data or is almost constant; or "".

        Or if the data are noise: neighbouring samples differ as all samples do, and the
        free run explains nothing of them.
        """
        leaves = leaving_words(self.model, self.data, self.residuals)
        words = leaves or flat_sentence(self.flat)
        for one in self.data.look.state_looks:
            known = one.values[one.known]
            if words or (len(known) and not one.noise > 0.8 * np.std(known)):
                return words
        if self.table["fit_percent"].max() > 5:
            return ""
        names = " and ".join(self.data.measured)
        return (
            f"Nothing explains the measurements of {names}: they look like noise. "
            "Check that these are the right columns, that the machine moved, and that "
            "it was sampled fast enough."
        )

    @property
    def weights(self) -> np.ndarray:
        """Scale of each state in `rmse`, (n_states,).

        With one measured channel the scale of its unit, otherwise one over the standard
        deviation of each channel.
        """
        is_measured = self._n_values > 0
        if sum(is_measured) == 1:
            return np.where(is_measured, 1 / self._told.size, 0.0)
        spread = np.full(len(is_measured), np.inf)
        spread[is_measured] = np.nanstd(self._y[:, is_measured], axis=0)
        return 1 / np.where(spread > 0, spread, 1.0)

    @cached_property
    def squares(self) -> np.ndarray:
        """Squared, scaled residuals of all measured values, (n_values,).

        In the order of time, trajectory after trajectory.
        """
        squared = (np.concatenate(self.residuals) * self.weights) ** 2
        return squared[np.isfinite(self._y)]

    @property
    def rmse(self) -> float:
        """Root mean square of the free-run residual, in `error_unit`."""
        return float(np.sqrt(np.mean(self.squares)))

    @cached_property
    def run_errors(self) -> np.ndarray:
        """`rmse` of each trajectory, (n_trajectories,)."""
        is_measured = self._n_values > 0
        scaled = [(run * self.weights)[:, is_measured] for run in self.residuals]
        return np.sqrt(np.nan_to_num([np.nanmean(run**2) for run in scaled]))

    @property
    def error_unit(self) -> str:
        """Unit of `rmse`: of the one measured channel, else standard deviations."""
        if len(self.data.measured) != 1:
            return STANDARD_DEVIATIONS
        return self._told.unit

    @property
    def _told(self) -> Scale:
        """The scale of the first channel that is measured."""
        return scale_of(self.data.units.get(self.data.measured[0], ""))

    @property
    def noise_floor(self) -> float:
        """The error that the estimated noise alone causes, on the scale of `rmse`."""
        squares = self._n_values * (self.sigma * self.weights) ** 2
        return float(np.sqrt(np.sum(squares) / self._n_values.sum()))

    @cached_property
    def noise_floor_std_error(self) -> float:
        """Standard error of `noise_floor`, on its scale; 0 where all noise is declared.

        ``floor / sqrt(2 nu)``. The degrees of freedom nu of a channel are the number of
        its values minus its share of the parameters and starting states; correlated
        noise reduces them. The variances of channels add up (Satterthwaite 1946).
        """
        n = self._n_values
        n_used = len(self.record.grid.starts) * self.model.n_states
        n_used += self.record.is_of_training * len(self.fit.names)
        freedom = n * max(1 - n_used / n.sum(), LEAST_COUNTED)
        if self.record.has_correlated_noise:
            by_state = zip(*(run.T for run in self.residuals), strict=True)
            freedom /= [autocorrelation_time(list(map(_known, s))) for s in by_state]
        is_open = (n > 0) & ~np.isin(self.model.states, list(self.data.noise or {}))
        squares = n[is_open] * (self.sigma * self.weights)[is_open] ** 2 / n.sum()
        variance = np.sum(2 * squares**2 / freedom[is_open])  # of the floor's square
        return float(np.sqrt(variance)) / (2 * self.noise_floor)

    @property
    def noise_floor_interval(self) -> tuple[float, float]:
        """95 % interval of `noise_floor`, ``floor * sqrt(nu / chi2)`` by chi square."""
        floor, share = self.noise_floor, self.noise_floor_std_error / self.noise_floor
        if not share:
            return floor, floor
        nu = 1 / (2 * share**2)
        high, low = map(chi_square_limit, (0.975, 0.025), (nu, nu))
        return floor * (nu / low) ** 0.5, floor * (nu / high) ** 0.5

    def floor_words(self, size: float = 1.0, unit: str | None = None) -> str:
        """Noise floor and its interval, times ``size``, with a unit such as " m"."""
        unit = spaced(self.error_unit) if unit is None else unit
        low, high = self.noise_floor_interval
        return with_interval(size * self.noise_floor, (size * low, size * high), unit)

    @cached_property
    def energy(self) -> "pd.DataFrame":
        """The energy balance of the free run, change of H = supplied - dissipated.

        A row per trajectory: trajectory, change, supplied, dissipated, by the
        trapezoidal rule.
        """
        rows = []
        for x, run in zip(self.simulated, self.data.trajectories, strict=True):
            model = self.model.with_values(self.values[run.name])
            powers = function_of(model, "powers", _energy_and_powers)
            (values,) = in_numbers(powers, x.T, run.u.T, run.t[None, :], model.theta)
            energy, supplied, dissipated = values
            powers_over_time = np.trapezoid([supplied, dissipated], run.t)
            rows.append((run.name, energy[-1] - energy[0], *powers_over_time.tolist()))
        columns = ["trajectory", "change", "supplied", "dissipated"]
        return printed_table(rows, columns=columns)

    def plot(self, ax: "Axes | None" = None, trajectory: str | int = 0) -> "Axes":
        """Draw measurements and free run of one trajectory, residuals below them.

        The band of the free run covers two standard deviations of its prediction, the
        band of the residuals two of the noise.

        Args:
            ax: Axes to draw on; None: a new figure.
            trajectory: Name of the trajectory, or its number, counted from 0.

        Raises:
            DataError: There is no such trajectory.
        """
        number = self.data.trajectory_number(trajectory)
        run = self.data.trajectories[number]
        title = (
            f"Free run of {run.name}: rmse {self.rmse:.3g}, "
            f"noise floor {self.noise_floor:.3g} (all runs)"
        )
        found = []
        for name, one in zip(self.noise, self.channels(number), strict=True):
            std = None
            if self.bands is not None:
                row = self.model.states.index(name)
                unit = scale_of(self.data.units.get(name, ""))
                std = self.bands[number][:, row] / unit.size
            found.append(replace(one, std=std))
        return plot_run(self.data, found, number, title, ax)

    def channels(self, number: int) -> list[Channel]:
        """Every measured channel along the trajectory of a number, in its unit."""
        return channels(self.data, self.shown, self.noise, number)

    def _summary(self) -> Summary:
        unit = f" {self.error_unit}" if self.error_unit else ""
        title = (
            f"Free run against {self.data.n_samples} samples: "
            f"rmse {self.rmse:.4g}{unit}\nnoise floor {self.floor_words()}, an estimate"
        )
        title = "\n".join(filter(None, (self.warning, title)))
        return Summary(title, (Part(table=self.table),))


@typed
@interruptible
def compare(fit: Fit | Model, data: Measurements) -> Comparison:
    """Simulate a fitted model from estimated starting states, and compare.

    A model without free parameters needs no fit: noise and starting states are
    estimated from the measurements.

    Starting states and parameters with ``per_trajectory`` are estimated from each whole
    trajectory by maximum likelihood; on the measurements of the fit they are those of
    the fit. All other parameters are those of the fit.

    Args:
        fit: a fit by maximum likelihood or by the PHSI loss, or a model whose
            parameters are all known.
        data: measurements with the states and inputs of the model.

    Raises:
        DataError: a state or input of the model is not in the measurements.
        ModelError: a model with free parameters was given instead of a fit.
        SolveError: the starting states could not be estimated.

    Examples:
        >>> found = ph.compare(fit, test)
        >>> print(f"error {found.rmse:.3f} m, noise {found.noise_floor:.3f} m")
        error 0.044 m, noise 0.044 m
    """
    return compare_record(Record.of(fit_of(fit, data, "compare"), data))


def compare_record(record: Record) -> Comparison:
    """`compare` for a record; a run that breaks off is far beyond every measurement."""
    found = smoothed_states(record)
    begun = (record.aligned, found.states, found.parameters)
    return Comparison(record, found.parameters, *free_runs(record.model, *begun))


def _known(residual: np.ndarray) -> np.ndarray:
    return residual[np.isfinite(residual)]


def _energy_and_powers(parts: Expressions) -> ca.SX:
    """H, and dH/dt = F . grad H - grad H . R grad H in its two parts, (3,)."""
    efforts = ca.vertcat(*parts.efforts)
    supplied = ca.dot(ca.vertcat(*parts.force), efforts)
    dissipated = ca.dot(ca.vertcat(*parts.losses), efforts)
    return ca.vertcat(parts.energy, supplied, dissipated)


# ---- how certain a free run is


def prediction_bands(
    record: Record,
    simulated: Sequence[np.ndarray],
    values: Parameters,
) -> tuple[np.ndarray, ...] | None:
    """Standard deviation of what a free run shows, to first order along the run.

    The covariance of the estimates, carried to what the run shows: that of the
    parameters, with starting states that follow the record, and that of the starting
    states. The noise of a single measurement is not in it.
    """
    fit, grid, model = record.fit, record.grid, record.model
    is_known = np.isfinite(np.diag(fit.covariance))
    has_covariance = not fit.names or is_known.any()
    nodes = np.concatenate(simulated)
    # Of very many values they take longer than the fit, and are too narrow to be seen.
    if not has_covariance or nodes.size > 200_000:
        return None
    if not np.all(np.isfinite(nodes)) or not grid.measured.any():
        return None
    unknown = Theta.of(model, record.runs)
    theta = unknown.stacked(parameter_matrix(model, values))
    point = point_at(model, grid, unknown, theta, nodes)
    scheme = MaximumLikelihood().integrator
    likelihood = LikelihoodValues(model, grid, scheme, point, unknown)
    linear = Linearizer(likelihood).at(point.scaled)
    system = white_system(linear, record.sigma)
    # How states follow the parameters, and their covariance for given parameters.
    by_theta = system.following * point.x_scale[:, None]
    of_starts = system.start_covariances()
    of_starts = of_starts * np.outer(point.x_scale, point.x_scale)
    if model.sensor:
        of_runs = unknown.by_trajectory(theta)
        by_state = output_slopes(model, grid, nodes, of_runs).in_states
        direct = output_slopes_in_theta(unknown, grid, nodes, theta)
        by_theta = by_state @ by_theta + direct * point.theta_scale
        of_starts = by_state @ of_starts @ by_state.transpose(0, 2, 1)
    own_names = record.estimated_here(model)
    is_own = np.array([one.name in own_names for one in unknown.entries], dtype=bool)
    covariance = _parameter_covariance(
        fit, unknown, is_own, point.theta_scale, system.information
    )
    from_parameters = np.einsum("aij,jk,aik->ai", by_theta, covariance, by_theta)
    from_starts = np.einsum("aii->ai", of_starts)
    # What is not independent tells as little about starting states as about parameters.
    share = fit.independent_share(fit.names)
    from_starts = from_starts / (share if np.isfinite(share) else 1.0)
    return grid.split(np.sqrt(np.maximum(from_parameters + from_starts, 0.0)))


def _parameter_covariance(
    fit: Fit,
    unknown: Theta,
    is_own: np.ndarray,
    scale: np.ndarray,
    information: np.ndarray,
) -> np.ndarray:
    """Covariance of the scaled parameters along a record, (n_theta, n_theta)."""
    # That of the fit; what is estimated from the record (``is_own``) follows it, given
    # the other parameters.
    is_known = np.isfinite(np.diag(fit.covariance))
    fitted = np.where(np.outer(is_known, is_known), fit.covariance, 0.0)
    shared = np.flatnonzero(~is_own)
    own = np.flatnonzero(is_own)
    place = [fit.names.index(unknown.names[i]) for i in shared]
    of_shared = fitted[np.ix_(place, place)] / np.outer(scale[shared], scale[shared])
    covariance = np.zeros((len(unknown), len(unknown)))
    following = np.eye(len(unknown))[:, shared]
    if len(own):
        conditional = np.linalg.pinv(information[np.ix_(own, own)])
        following[own] = -conditional @ information[np.ix_(own, shared)]
        covariance[np.ix_(own, own)] = conditional
    return covariance + following @ of_shared @ following.T


# ---- a free run that hardly moves beside measurements that do: that is how a fit ends
# whose parameters began too far off. A motion that is out of step with the measurements
# costs more than none, so that it dies out; every criterion of the solver is met there.


def is_flat(
    measured: np.ndarray,
    shown: np.ndarray,
    noise: float,
    *,
    most_noise: float = 0.5,
    most_moved: float = 0.25,
    most_explained: float = 0.05,
) -> bool:
    """Whether a run (n_values,) hardly moves, and explains next to nothing.

    Args:
        measured: the values at the same times, (n_values,).
        shown: the run.
        noise: the standard deviation of the noise.
        most_noise: the share of the measured standard deviation from which noise makes
            it up: where a state shows little but noise, a flat free run is right.
        most_moved: the share of it up to which a flat run moves.
        most_explained: the share of the motion that a flat run explains: one that dies
            out within a twentieth of the record is flat.
    """
    spread = float(np.std(measured))
    explains = rms(measured - shown) < (1 - most_explained) * spread
    is_still = float(np.std(shown)) < most_moved * spread
    return noise < most_noise * spread and is_still and not explains


def flat_sentence(states: Sequence[str]) -> str:
    """What to do where the free run of ``states`` is flat; empty without any."""
    if not states:
        return ""
    return (
        f"The free run of {' and '.join(states)} is almost constant and does not "
        "follow the measurements. The fit probably ended at a wrong optimum, and a "
        "diagnosis of it would be meaningless. Check the sign of each term, and choose "
        "other starting values for the parameters."
    )


# ---- whether a model fails, and whether a larger one leaves noise alone


def is_like_noise(comparison: Comparison) -> bool:
    """Whether the residuals look like noise: as small as the noise floor, and white.

    Noise that the fit found to last from sample to sample need not be white.
    """
    lasts = comparison.record.has_correlated_noise
    return is_white_noise(comparison) or (lasts and is_small_as_noise(comparison))


def is_white_noise(comparison: Comparison) -> bool:
    """Whether the residuals are as small as the noise floor, and white.

    The whiteness of several channels is tested together (Bonferroni).
    """
    p_values = comparison.table["whiteness"].to_numpy()
    is_white = np.nanmin(p_values) * len(p_values) > SURE_LEVEL
    return bool(is_white and is_small_as_noise(comparison))


def is_small_as_noise(comparison: Comparison) -> bool:
    """Whether noise hides, by its size, what the free run is off by besides."""
    return comparison.rmse < WHITE_ERROR * comparison.noise_floor


def is_failing(comparison: Comparison) -> bool:
    """Whether the free run is further off than the noise alone would leave it."""
    return comparison.rmse > FAILING_ERROR * comparison.noise_floor


def is_surely_failing(comparison: Comparison) -> bool:
    """Whether neither noise nor estimates that are little known explain its error."""
    variance = comparison.noise_floor**2
    if comparison.bands is not None:
        by_estimates = np.concatenate(comparison.bands) * comparison.weights
        variance += np.mean(by_estimates[np.isfinite(comparison._y)] ** 2)
    return bool(comparison.rmse > SURE_ERROR * np.sqrt(variance))


def is_explained(base: Comparison, trained: Comparison, judged: Comparison) -> bool:
    """Whether a larger model explains what was missing.

    Its residuals on the training record look like noise, or are as small as the noise
    there and on the record that judges, where ``base`` is the smaller model. Noise that
    lasts must have been seen beside that too: an effect that imitates another one
    leaves residuals that look like it. Where the record that judges shows surely more
    than noise, nothing is explained.
    """
    if is_surely_failing(judged):
        return False
    has_lasting = base.record.shows_correlated_noise
    if is_white_noise(trained) or (has_lasting and is_like_noise(trained)):
        return True
    both = (judged, trained)
    is_small = all(one.rmse < FAILING_ERROR * one.noise_floor for one in both)
    return is_small and explained_share(base, judged) > EXPLAINED_IF_NAMED


def explained_share(old: Comparison, new: Comparison) -> float:
    """Share of the squared error above the noise floor that a larger model removes."""
    above_floor = max(old.rmse**2 - old.noise_floor**2, TINY)
    return (old.rmse**2 - new.rmse**2) / above_floor


def deviance(fit: Fit) -> float:
    """-2 log likelihood of a maximum-likelihood fit."""
    return fit.bic - len(fit.names) * float(np.log(fit.n_values))

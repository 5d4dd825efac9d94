"""How well one fitted model can imitate another, in a record and in an experiment.

The imitator's parameters and starting states are re-fitted to what the other model
shows, by a few Gauss-Newton steps within their bounds. In the record this is done once;
its misfit is then taken as quadratic in the parameters, starting states following them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from phsi_opt.diagnosis.experiment_simulator import (
    Bounds,
    ExperimentSimulator,
    Linearization,
)
from phsi_opt.diagnosis.experiments import Experiment
from phsi_opt.statistics import TINY

MOST_GAUSS_NEWTON_STEPS = 8
STEP_SHARES = (1.0, 0.25, 0.05)  # of a step that are tried
SETTLED = 0.05  # relative fall of the misfit at which the steps end
# Singular values of the scaled slopes, over the largest, that count as zero.
SLOPE_RANK_TOLERANCE = 1e-9
# Tolerance of the simulations, in noise deviations. It is that of the coarser run: the
# finer one is 30 times better.
SIMULATION_TOLERANCE = 0.3
LEAST_TOLERANCE = 1e-6
LARGEST_TOLERANCE = 1e-3

Residuals = Callable[[np.ndarray], Linearization | None]


@dataclass(frozen=True, eq=False)
class Minimum:
    """A point ``z`` (n_unknowns,) and the ``residuals`` there."""

    z: np.ndarray
    residuals: Linearization


@dataclass(frozen=True, eq=False)
class RecordImitation:
    """The misfit in the record near the best imitation in it.

    It is taken as the square of ``value + slope (theta - z[:n_free])``.

    Attributes:
        z: (n_unknowns,) parameters and starting state of the best imitation.
        value: (n_free + 1 at most,).
        slope: the same rows, (..., n_free).
        squares: the misfit there, in noise variances.
    """

    z: np.ndarray
    value: np.ndarray
    slope: np.ndarray
    squares: float


class Imitation:
    """One model taken for the truth, and another that imitates it.

    Args:
        truth: what is imitated.
        imitator: what is re-fitted.
        noise: standard deviation of the measurement noise by measured state.
        spread: standard deviation along the record by state.
    """

    def __init__(
        self,
        truth: ExperimentSimulator,
        imitator: ExperimentSimulator,
        noise: Mapping[str, float],
        spread: Mapping[str, float],
    ) -> None:
        self.truth = truth
        self.imitator = imitator
        self.noise = noise
        least_noise = min(noise[name] / max(spread[name], TINY) for name in noise)
        tolerance = SIMULATION_TOLERANCE * least_noise
        self.tolerance = float(np.clip(tolerance, LEAST_TOLERANCE, LARGEST_TOLERANCE))

    def in_record(self, record: Experiment) -> RecordImitation | None:
        """The best imitation in the record; None where it cannot be simulated."""
        differences = self._differences(record)
        if differences is None:
            return None
        imitator = self.imitator
        best = least_squares(differences.at, imitator.z, imitator.bounds)
        if best is None:
            return None
        residuals = best.residuals
        n_free = len(imitator.theta)
        # What starting states can explain is taken out; of the rest, which may have as
        # many rows as there are values, only its triangular factor matters.
        by_start, _ = np.linalg.qr(residuals.slope[:, n_free:])
        columns = np.column_stack([residuals.slope[:, :n_free], residuals.value])
        beyond_start = columns - by_start @ (by_start.T @ columns)
        factor = np.asarray(np.linalg.qr(beyond_start, mode="r"))
        value = factor[:, n_free]
        slope = factor[:, :n_free]
        return RecordImitation(best.z, value, slope, residuals.squares)

    def misfit_added(
        self, experiment: Experiment, in_record: RecordImitation
    ) -> float | None:
        """What an experiment adds to the misfit of the best imitation in both.

        Returns:
            A sum of squares in noise variances; None where either model cannot be
            simulated.
        """
        differences = self._differences(experiment)
        if differences is None:
            return None
        imitator = self.imitator
        n_free = len(imitator.theta)
        theta = in_record.z[:n_free]
        x0 = experiment.start(imitator.model, in_record.z[n_free:])
        both = _WithRecord(differences, in_record)
        best = least_squares(both.at, np.r_[theta, x0], imitator.bounds)
        if best is None:
            return None
        return max(best.residuals.squares - in_record.squares, 0.0)

    def _differences(self, experiment: Experiment) -> "_Differences | None":
        """None where the truth cannot be simulated."""
        y = self.truth.shown(experiment, experiment.measured, self.tolerance)
        if y is None:
            return None
        weights = [1 / self.noise[name] for name in experiment.measured]
        weight = np.tile(weights, len(y))
        return _Differences(
            self.imitator, experiment, y.ravel(), weight, self.tolerance
        )


@dataclass(frozen=True, eq=False)
class _Differences:
    """Prediction less truth in an experiment, in standard deviations of the noise.

    Attributes:
        imitator: what predicts.
        experiment: in which.
        shown: (n_values,) what the truth shows.
        weight: (n_values,) one over the noise.
        tolerance: of the simulation.
    """

    imitator: ExperimentSimulator
    experiment: Experiment
    shown: np.ndarray
    weight: np.ndarray
    tolerance: float

    def at(self, z: np.ndarray) -> Linearization | None:
        """With unknowns z (n_unknowns,); None where it cannot be simulated."""
        predicted = self.imitator.predicted(self.experiment, z, self.tolerance)
        if predicted is None:
            return None
        value = self.weight * (predicted.value - self.shown)
        slope = self.weight[:, None] * predicted.slope
        return Linearization(value, slope)


@dataclass(frozen=True, eq=False)
class _WithRecord:
    """The differences in an experiment, and below them those in the record."""

    differences: _Differences
    in_record: RecordImitation

    def at(self, z: np.ndarray) -> Linearization | None:
        """With unknowns z (n_unknowns,); None where it cannot be simulated."""
        here = self.differences.at(z)
        if here is None:
            return None
        record = self.in_record
        n_free = record.slope.shape[1]
        there = record.value + record.slope @ (z[:n_free] - record.z[:n_free])
        by_start = np.zeros((len(there), len(z) - n_free))
        slope_there = np.hstack([record.slope, by_start])
        value = np.r_[here.value, there]
        return Linearization(value, np.vstack([here.slope, slope_there]))


def least_squares(
    residuals: Residuals, z: np.ndarray, bounds: Bounds
) -> Minimum | None:
    """Least squares by Gauss-Newton steps, shortened until the misfit falls.

    Args:
        residuals: of unknowns (n_unknowns,); None where they are not defined.
        z: (n_unknowns,) where to start.
        bounds: steps are cut off at them.

    Returns:
        The best point found; None where there are no residuals at the start.
    """
    start = bounds.nearest(z)
    at_start = residuals(start)
    if at_start is None:
        return None
    best = Minimum(start, at_start)
    for _ in range(MOST_GAUSS_NEWTON_STEPS):
        better = _stepped(residuals, best, bounds)
        if better is None:
            return best
        left = better.residuals.squares
        is_settled = left > (1 - SETTLED) * best.residuals.squares
        best = better
        if is_settled:
            break
    return best


def _stepped(residuals: Residuals, best: Minimum, bounds: Bounds) -> Minimum | None:
    """A Gauss-Newton step; None where no share of it makes the misfit smaller."""
    r = best.residuals.value
    slope = best.residuals.slope
    norms = np.linalg.norm(slope, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    scaled_step = np.linalg.lstsq(slope / norms, r, rcond=SLOPE_RANK_TOLERANCE)[0]
    step = -scaled_step / norms
    for share in STEP_SHARES:
        z = bounds.nearest(best.z + share * step)
        found = residuals(z)
        if found is not None and found.squares < best.residuals.squares:
            return Minimum(z, found)
    return None

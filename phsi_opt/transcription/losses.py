"""The two losses: one family of problems, by where the noise is assumed to be.

================= =========== ============ =========================================
loss              states      defects      objective
================= =========== ============ =========================================
PHSILoss          the data    minimised    mean of squared defects + L1
MaximumLikelihood unknown     equal zero   mean of squared residuals/sigma^2 + L1
================= =========== ============ =========================================

Each makes a `Program` from a model, a grid and a starting point; what is done with the
program is the business of `identify`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import casadi as ca
import numpy as np

from phsi_opt.arguments import is_count, require, require_positive, require_size, typed
from phsi_opt.errors import DataError, ModelError, did_you_mean
from phsi_opt.model.model import Model
from phsi_opt.optimization.program import SLACK_ABOVE, Program
from phsi_opt.transcription.defects import (
    defect,
    known_defects,
    symbols_at_nodes,
    symbols_in_intervals,
)
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import SCHEME
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.parameter_vector import Point, Theta

# Programs, each linear in delays of inputs beside where the last one ended, and the
# change, as a share, up to which these stay.
MOST_PROGRAMS = 6
SAME_DELAY = 1e-4


@typed
@dataclass(frozen=True)
class PHSILoss:
    """Squared defects of the measured states, and an L1 penalty (thesis Eq. 5.6).

    ::

        (1/m) sum_i |(x_{i+1} - x_i)/h_i - Psi(g; x_i, x_{i+1})|^2
        + sum_j lambda_j |xi_j| + (s^2/m) sum_j ((xi_j - mean_j)/deviation_j)^2

    The last term is that of priors, with the mean square s^2 of one defect. The states
    are the data, so every state must be measured; intervals with a missing value at an
    end are omitted. Fast, and convex where Psi is one evaluation of g and R is fixed.
    The noise in the states biases the estimates: use `MaximumLikelihood` for final
    estimates from measured data. (The thesis uses the sum instead of the mean.)

    Args:
        integrator: the integration scheme, whose errors in a step are the defects.
    """

    integrator: str = SCHEME

    def program(
        self,
        model: Model,
        grid: Grid,
        point: Point,
        l1: Mapping[str, float],
        variance: float = 0.0,
    ) -> Program:
        """The program in theta and the slacks; the data enter as numbers.

        Beside defects of a ``variance`` priors count as they do beside noise; not at
        all where it is zero.

        Raises:
            ModelError: the model has a sensor, or a parameter per trajectory.
            DataError: the data have no interval that is completely measured.
        """
        used = complete_intervals(model, grid).driven(model, point.theta)
        size = mean_square_rate(used)
        weight = np.sqrt(2 / (size * used.n_intervals))
        program = Program()
        unknown = Theta.of(model, ("",))
        theta = _theta_variable(program, unknown, point)
        residual, slopes = known_defects(model, used, self.integrator, theta)
        program.add_residual(weight * residual, weight * slopes)
        mean, information = unknown.priors
        if variance and np.any(information):
            program.add_squares(theta, mean, weight**2 * variance * information)
        _add_l1(program, theta, point, unknown.weights(l1) / size)
        return program


@typed
@dataclass(frozen=True)
class MaximumLikelihood:
    """Squared residuals of the measurements, over states that satisfy the model.

    ::

        minimise   (1/N) sum ((y - x)/sigma)^2 + sum_j lambda_j |xi_j|
                   + (1/N) sum_j ((xi_j - mean_j)/deviation_j)^2, of priors
        over states x and parameters, subject to zero defects

    States may be unmeasured, and samples may be missing.

    Args:
        noise: standard deviations by state name; None estimates them.
        integrator: the integration scheme, whose errors in a step are the defects.
        steps: integration steps between neighbouring samples; None chooses them so that
            the integration error does not affect the estimates.
        huber: residuals beyond this many standard deviations count linearly instead of
            squared, which reduces the influence of outliers (1.345 costs 5 % of the
            efficiency for normal noise); None: all count squared.
        starts: number of starting points: the first comes from the data, the others are
            moved from it by a fixed random sequence. The warnings of the fit say how
            many of them agree.
        model_error: whether the equations include a random force; its size and
            correlation time are estimated together with the parameters
            (`Fit.model_error`).

    Raises:
        ModelError: a setting is out of its range.
    """

    noise: Mapping[str, float] | None = None
    integrator: str = SCHEME
    steps: int | None = None
    huber: float | None = None
    starts: int = 1
    model_error: bool = False

    def __post_init__(self) -> None:
        huber = self.huber
        if huber is not None and self.model_error:
            raise ModelError(
                f"huber={huber!r} and model_error=True of MaximumLikelihood cannot be "
                "combined: outliers are not a model error. Choose one of them."
            )
        if huber is not None:
            require_positive("MaximumLikelihood: huber", huber)
        most = 1000  # a program grows with the steps
        expected = f"a whole number from 1 to {most}"
        for name in ("steps", "starts"):
            n = getattr(self, name)
            may_lack = name == "steps" and n is None
            fine = may_lack or (is_count(n) and n <= most)
            require(fine, f"MaximumLikelihood: {name}", n, expected)
        for name, size in (self.noise or {}).items():
            require_positive(f"MaximumLikelihood: noise[{name!r}]", size)

    def program(
        self, values: LikelihoodValues, l1: Mapping[str, float], sigma: np.ndarray
    ) -> Program:
        """The program in theta, x and the slacks.

        Args:
            values: of the likelihood: model, layout, start and sizes of the unknowns.
            l1: weight by slot.
            sigma: (n_states,) noise of each channel, a setting of the program.
        """
        model, grid, point = values.model, values.grid, values.point
        n_states = model.n_states
        program = Program()
        theta = _theta_variable(program, values.unknown, point)
        mean, information = values.unknown.priors
        if np.any(information):
            n_values = int(grid.measured.sum())
            program.add_squares(theta, mean, 2 / n_values * information)
        lower, upper = np.broadcast_to(point.x_bounds, (2, *point.x.shape))
        scale = np.tile(point.x_scale, grid.n_nodes)
        label = partial(grid.node_label, n_states)
        column = program.variable(
            "x", point.x.ravel(), lower.ravel(), upper.ravel(), scale, label
        )
        x = ca.reshape(column, n_states, -1)
        of_runs = values.unknown.by_trajectory(theta)
        function = defect(model, self.integrator)
        (d,) = symbols_in_intervals(function, grid, x, of_runs)
        program.constrain(
            "defect",
            (d * ca.DM(values.per_size)).T,
            label=partial(grid.interval_label, n_states),
            curvature=partial(values.curvature_in_symbols, x, of_runs),
        )
        # Row by row (n_nodes, n_states) is CasADi's order column by column.
        measured = np.flatnonzero(grid.measured.ravel()).tolist()
        shown = x
        if model.sensor:
            shown = symbols_at_nodes(model.output(), grid, x, of_runs)[0].T
        misfit = ca.DM(grid.y.ravel()[measured]) - ca.vec(shown)[measured]
        noise = program.setting("sigma", sigma)
        residual = misfit / ca.vec(noise[grid.channel.tolist()])
        if self.huber is not None:
            residual = residual - _outlier_slack(program, len(measured), self.huber)
        program.add_residual(residual * np.sqrt(2 / len(measured)))
        _add_l1(program, theta, point, values.unknown.weights(l1))
        return program


def _theta_variable(program: Program, unknown: Theta, point: Point) -> ca.MX:
    """Add the block "theta", with the bounds of the parameters, (n_theta,)."""
    return program.variable(
        "theta",
        point.theta,
        unknown.lower,
        unknown.upper,
        point.theta_scale,
        unknown.names.__getitem__,
    )


def _outlier_slack(program: Program, n_measured: int, limit: float) -> ca.MX:
    """Add slacks (n_measured,) that take over what of a residual is over the limit."""
    # At a linear cost, so that both together are Huber's function. Source: P. J. Huber,
    # Robust estimation of a location parameter, 1964.
    start = np.full(n_measured, SLACK_ABOVE)  # standard deviations
    above = program.variable("outlier_above", start, lower=0.0)
    below = program.variable("outlier_below", start, lower=0.0)
    program.cost += 2 * limit / n_measured * (ca.sum1(above) + ca.sum1(below))
    return above - below


def _add_l1(program: Program, theta: ca.MX, point: Point, weights: np.ndarray) -> None:
    """Add ``sum_j weight_j |xi_j|`` over the coefficients with a weight (n_theta,)."""
    places = np.flatnonzero(weights > 0).tolist()
    if places:
        program.add_l1(
            "theta",
            theta[places],
            weights[places],
            point.theta[places],
            point.theta_scale[places],
        )


def l1_weights(l1: Mapping[str, float] | float | None) -> dict[str, float]:
    """L1 weight per slot: a number stands for H and F alike.

    Raises:
        ModelError: a slot is unknown, or a weight is negative or not finite.
    """
    if l1 is None:
        return {}
    weights = dict(l1) if isinstance(l1, Mapping) else {"H": l1, "F": l1}
    for slot, weight in weights.items():
        if slot not in ("H", "R", "F"):
            raise ModelError(
                f"l1 names slot {slot!r}; expected 'H', 'R' or 'F'."
                f"{did_you_mean(str(slot), 'HRF')}"
            )
        require_size(f"l1[{slot!r}]", weight)
    return weights


def complete_intervals(model: Model, grid: Grid) -> Grid:
    """The grid with only the intervals whose two ends are completely measured.

    Raises:
        ModelError: the model has a sensor, or a parameter per trajectory: it is not one
            for `PHSILoss`.
        DataError: a state was never measured, or there is no such interval.
    """
    refusal = "PHSILoss cannot include {}; use MaximumLikelihood()."
    for name, entry in model.entries.items():
        if entry.parameter.per_trajectory:
            raise ModelError(refusal.format(f"the parameter per trajectory {name!r}"))
    for name in model.sensor:
        raise ModelError(refusal.format(f"the sensor of {name!r}"))
    for name, is_measured in zip(model.states, grid.measured.T, strict=True):
        if not np.any(is_measured):
            raise DataError(
                f"state {name!r} was never measured, but PHSILoss takes the states "
                "from the data; use MaximumLikelihood(), where the states are decision "
                "variables."
            )
    is_complete = np.asarray(grid.measured.all(axis=1))
    keep = np.flatnonzero(is_complete[grid.begin] & is_complete[grid.begin + 1])
    if not len(keep):
        raise DataError(
            "PHSILoss needs two neighbouring samples without missing values, and "
            "there are none; use MaximumLikelihood()."
        )
    return grid.intervals(keep)


def mean_square_rate(grid: Grid) -> float:
    """Mean square of the rates of the measured states; 1 where they do not move.

    The objective of `PHSILoss` is divided by it, so that a tolerance does not depend on
    units.
    """
    size = float(np.mean(np.sum(grid.rates(grid.y) ** 2, axis=1)))
    return size if size > 0 else 1.0

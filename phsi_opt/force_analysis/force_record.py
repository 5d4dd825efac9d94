"""The missing force along a record, beside everything that it may depend on.

It stands at the middle of every interval, where the estimate has it; states, efforts,
inputs and the slopes of the model in its parameters are taken there as well. What the
force depends on is judged elsewhere (`dependence`, `energy`, `localization`).
"""

import datetime as dt
from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.missing_force import ForceEstimate
from phsi_opt.estimation.record import Record
from phsi_opt.model.model import Model
from phsi_opt.model.parameter_units import state_units
from phsi_opt.statistics import TINY

# Distance to a bound, as a change of the rates beside these, up to which a parameter
# stands at it.
AT_BOUND = 1e-6


@dataclass(frozen=True, eq=False)
class ForceRecord:
    """The missing force and what it may depend on, at the middle of every interval.

    Attributes:
        fit: the fit whose model lacks the force.
        estimate: the force with its prior and the linearised problem.
        trajectories: their names.
        origins: the moments at which their times are 0; None where these are no dates.
        units: by name of the state or input, and of ``t``.
        equations: states in whose equations a force was estimated, (n_forced,).
        t: time, (n_intervals,).
        h: length of the interval, (n_intervals,).
        run: number of the trajectory, (n_intervals,).
        w: missing force, (n_intervals, n_forced).
        states: (n_intervals, n_states).
        efforts: dH/dx, (n_intervals, n_states).
        inputs: (n_intervals, n_inputs).
        losses: -R dH/dx of the model, (n_intervals, n_states).
        rates: dx/dt of the model, (n_intervals, n_states).
        slopes: of dx/dt in the parameters that are free to move, each of rms one,
            (n_intervals, n_states, n_moving).
    """

    fit: Fit
    estimate: ForceEstimate
    trajectories: tuple[str, ...]
    origins: tuple[dt.datetime | None, ...]
    units: Mapping[str, str]
    equations: tuple[str, ...]
    t: np.ndarray
    h: np.ndarray
    run: np.ndarray
    w: np.ndarray
    states: np.ndarray
    efforts: np.ndarray
    inputs: np.ndarray
    losses: np.ndarray
    rates: np.ndarray
    slopes: np.ndarray

    @classmethod
    def of(cls, record: Record) -> "ForceRecord":
        """The missing force of a record with states, efforts, inputs and slopes."""
        estimate = record.estimate
        grid = estimate.grid
        model = record.model.with_values(estimate.rounded)
        middles = _Middles.of(record)
        rates = middles.values(model.rhs())
        return cls(
            fit=record.fit,
            estimate=estimate,
            trajectories=record.trajectories,
            origins=tuple(run.origin for run in record.data.trajectories),
            units={**record.data.units, **state_units(model, record.data.units)},
            equations=tuple(model.states[row] for row in estimate.rows),
            t=middles.t,
            h=grid.h,
            run=grid.trajectory[grid.begin],
            w=estimate.w,
            states=middles.states,
            efforts=middles.values(model.function(*model.efforts)),
            inputs=middles.inputs,
            losses=_losses(model, middles),
            rates=rates,
            slopes=_slopes(model, middles, rates),
        )

    def origin_of(self, trajectory: str) -> dt.datetime | None:
        """The moment at which the time of a trajectory is 0, where it is a date."""
        return self.origins[self.trajectories.index(trajectory)]

    def variable(self, name: str) -> np.ndarray:
        """Values of a state, an effort, an input or the time ``t``, (n_intervals,)."""
        model = self.fit.model
        known = {"t": self.t}
        known |= zip(model.efforts, self.efforts.T, strict=True)
        known |= zip(model.states, self.states.T, strict=True)
        known |= zip(model.inputs, self.inputs.T, strict=True)
        return known[name]

    def effort_of(self, equation: str) -> np.ndarray:
        """The effort of an equation, (n_intervals,): the velocity, for a momentum."""
        return self.efforts[:, self.fit.model.states.index(equation)]

    def loss_in(self, equation: str) -> np.ndarray:
        """-R dH/dx of the model in an equation, (n_intervals,)."""
        return self.losses[:, self.fit.model.states.index(equation)]

    def force_on(self, equation: str) -> np.ndarray:
        """The missing force of an equation, (n_intervals,)."""
        return self.w[:, self.equations.index(equation)]

    def as_estimated(self, equation: str, forces: np.ndarray) -> np.ndarray:
        """What the estimate would show of forces on an equation, (n_intervals, k).

        It is less than the forces by what noise and prior hide::

            w_shown = w - C P^-1 w

        with the force's covariance P before and C after the measurements.

        Args:
            equation: on which the forces act.
            forces: (n_intervals, k).
        """
        number = self.equations.index(equation)
        return self.estimate.posterior.shown(number, forces)

    def by_parameters(self, equation: str) -> np.ndarray:
        """Slopes of an equation in its parameters, as the estimate would show them.

        Returns:
            (n_intervals, n_acting), for the parameters that act in the equation.
        """
        slopes = self.slopes[:, self.fit.model.states.index(equation)]
        is_acting = np.any(slopes != 0, axis=0)
        return self.as_estimated(equation, slopes[:, is_acting])


@dataclass(frozen=True, eq=False)
class _Middles:
    """Arguments of the model's functions at the middle of every interval.

    Attributes:
        states: (n_intervals, n_states).
        inputs: (n_intervals, n_inputs).
        t: (n_intervals,).
        theta: free parameters, (n_free, n_intervals).
    """

    states: np.ndarray
    inputs: np.ndarray
    t: np.ndarray
    theta: np.ndarray | ca.DM

    @classmethod
    def of(cls, record: Record) -> "_Middles":
        estimate = record.estimate
        grid = estimate.grid
        x = estimate.x
        states = (x[grid.begin] + x[grid.begin + 1]) / 2
        inputs = (grid.u0 + grid.u1) / 2
        t = grid.t[grid.begin] + grid.h / 2
        run = grid.trajectory[grid.begin]
        theta = record.theta
        of_interval = theta[:, run] if len(theta) else ca.DM(0, len(t))
        return cls(states, inputs, t, of_interval)

    def without_parameters(self) -> "_Middles":
        """The arguments of a model whose parameters are all fixed."""
        return replace(self, theta=ca.DM(0, len(self.t)))

    def values(self, function: ca.Function) -> np.ndarray:
        """Values of a function of states, inputs, time and parameters.

        Returns:
            (n_intervals, n_out).
        """
        mapped = function.map(len(self.t))
        columns = mapped(self.states.T, self.inputs.T, self.t[None, :], self.theta)
        return np.array(columns).T


def _losses(model: Model, middles: _Middles) -> np.ndarray:
    """-R dH/dx, (n_intervals, n_states): what dx/dt has more with R than without."""
    known = middles.without_parameters()
    frozen = model.frozen()
    with_loss = known.values(frozen.rhs())
    without_loss = known.values(replace(frozen, R={}).rhs())
    return with_loss - without_loss


def _slopes(model: Model, middles: _Middles, rates: np.ndarray) -> np.ndarray:
    """Slopes of dx/dt in the parameters that do not stand at a bound, of rms one.

    Args:
        model: with the values of the fit.
        middles: where the slopes are taken.
        rates: dx/dt there, (n_intervals, n_states).

    Returns:
        (n_intervals, n_states, n_moving).
    """
    rhs = model.rhs()
    arguments = [ca.SX.sym(rhs.name_in(i), rhs.size1_in(i)) for i in range(4)]
    theta = arguments[-1]
    jacobian = ca.jacobian(rhs(*arguments), theta)
    columns = ca.densify(jacobian)
    # Row by row, so that reshaping gives back states and parameters.
    flat = middles.values(ca.Function("slopes", arguments, [ca.vec(columns.T)]))
    shaped = flat.reshape(len(middles.t), model.n_states, -1)
    slopes = np.nan_to_num(shaped)
    size = np.sqrt(np.mean(slopes**2, axis=0))
    rate = np.sqrt(np.mean(np.nan_to_num(rates) ** 2, axis=0))
    strength = np.max(size / np.maximum(rate, TINY)[:, None], axis=0, initial=0.0)
    is_moving = _to_bounds(model) > AT_BOUND / np.maximum(strength, TINY)
    scaled = slopes / np.where(size > 0, size, 1.0)
    return np.asarray(scaled[:, :, is_moving])


def _to_bounds(model: Model) -> np.ndarray:
    """Distance of each free parameter to the nearer of its bounds, (n_free,)."""
    distances = []
    for name in model.free:
        parameter = model.entries[name].parameter
        value = model.values[name]
        distances.append(min(value - parameter.lower, parameter.upper - value))
    return np.abs(np.array(distances))

"""What a fitted model shows in experiments, and how that depends on its unknowns.

The unknowns of an experiment are z = (parameters, starting state). Slopes in them come
from the sensitivity equations, integrated together with the model.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from phsi_opt.comparison.compare import compare
from phsi_opt.data.checks import hold_of_each
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.experiments import Experiment
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.model import Model
from phsi_opt.simulation.free_run import Runs, rates

# Change by twice the steps, in standard deviations of each state, that a run may have
# which only says how large things are.
COARSE_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class Linearization:
    """A vector as a function of unknowns, near one value of theirs.

    Attributes:
        value: (n_values,).
        slope: (n_values, n_unknowns).
    """

    value: np.ndarray
    slope: np.ndarray

    @property
    def squares(self) -> float:
        """Sum of the squared values."""
        return float(self.value @ self.value)


@dataclass(frozen=True, eq=False)
class Bounds:
    """Limits of unknowns, ``lower`` and ``upper`` (n_unknowns,)."""

    lower: np.ndarray
    upper: np.ndarray

    def nearest(self, z: np.ndarray) -> np.ndarray:
        """The point within the bounds that is nearest to z (n_unknowns,)."""
        return np.clip(z, self.lower, self.upper)


class ExperimentSimulator:
    """A fitted model in one trajectory, run through experiments derived from it.

    Args:
        fit: the model and, where it knows them, its states along the measurements.
        data: the measurements it was fitted to.
        number: of the trajectory.

    Attributes:
        model: with the parameters of that trajectory.
        x0: (n_states,) its start there.
        theta: (n_free,) its free parameters.
        bounds: of (parameters, starting state).
    """

    def __init__(self, fit: Fit, data: Measurements, number: int) -> None:
        self.model = fit.model_of(data.trajectories[number].name)
        knows_states = len(fit.states) == data.n_trajectories
        runs = fit.states if knows_states else compare(fit, data).simulated
        self.x0 = runs[number][0]
        self.theta = self.model.theta
        self.bounds = _bounds(self.model)
        self._inputs = [data.inputs.index(name) for name in self.model.inputs]
        self.hold = hold_of_each(data.hold, data.inputs)[self._inputs]

    @property
    def z(self) -> np.ndarray:
        """The fitted unknowns (n_unknowns,), parameters and then starting state."""
        return np.r_[self.theta, self.x0]

    @cached_property
    def _runs(self) -> Runs:
        return Runs(rates(self.model))

    @cached_property
    def _sensitivities(self) -> "_Sensitivities":
        return _Sensitivities.of(self.model)

    def shown(
        self,
        experiment: Experiment,
        names: Sequence[str],
        tolerance: float = COARSE_TOLERANCE,
    ) -> np.ndarray | None:
        """What sensors of the named states show of the fitted model.

        Returns:
            (n_samples, n_names); None where the model cannot be simulated.
        """
        u = experiment.u[:, self._inputs]
        x0 = experiment.start(self.model, self.x0)
        x = self._runs.run(experiment.t, x0, u, self.hold, tolerance)
        if x is None:
            return None
        n_samples = len(x)
        theta = np.tile(self.theta[:, None], n_samples)
        output = self.model.output().map(n_samples)
        y = output(x.T, u.T, experiment.t[None], theta).full().T
        return np.asarray(y[:, [self.model.index(name) for name in names]])

    def predicted(
        self, experiment: Experiment, z: np.ndarray, tolerance: float
    ) -> Linearization | None:
        """The measured values of an experiment, sample by sample, by the unknowns.

        Args:
            experiment: its inputs and sensors; its start is that of z.
            z: (n_unknowns,), parameters and starting state.
            tolerance: of the simulation, as in `free_run`.

        Returns:
            n_samples * n_measured values; None where the model cannot be simulated.
        """
        u = experiment.u[:, self._inputs]
        system = self._sensitivities
        x = system.runs.run(experiment.t, system.start(z), u, self.hold, tolerance)
        if x is None:
            return None
        n_samples = len(x)
        output = system.output.map(n_samples)
        y, slopes = output(x.T, u.T, experiment.t[None])
        measured = [self.model.index(name) for name in experiment.measured]
        values = y.full().T[:, measured]
        n_states = self.model.n_states
        by_unknown = slopes.full().T.reshape(n_samples, len(z), n_states)
        by_value = by_unknown[:, :, measured].transpose(0, 2, 1)
        return Linearization(np.asarray(values.ravel()), by_value.reshape(-1, len(z)))


def _bounds(model: Model) -> Bounds:
    """Those of the parameters; starting states have none."""
    parameters = [model.entries[name].parameter for name in model.free]
    lower = [parameter.lower for parameter in parameters]
    upper = [parameter.upper for parameter in parameters]
    endless = np.full(model.n_states, np.inf)
    return Bounds(np.r_[lower, -endless], np.r_[upper, endless])


@dataclass(frozen=True, eq=False)
class _Sensitivities:
    """A model with its parameters and slopes as further states: (x, theta, vec X).

    X = dx/d(theta, x0), (n_states, n_unknowns), obeys dX/dt = (df/dx) X + (df/dtheta,
    0).

    Attributes:
        n_states: of the model; ``n_free``: of its free parameters.
        runs: of all these states; only the errors of the model's own count.
        output: CasADi function (states, u, t) -> what the sensors show, vec of slopes.
    """

    n_states: int
    n_free: int
    runs: Runs
    output: ca.Function

    @classmethod
    def of(cls, model: Model) -> "_Sensitivities":
        n_states = model.n_states
        n_free = len(model.free)
        x = ca.SX.sym("x", n_states)
        theta = ca.SX.sym("theta", n_free)
        X = ca.SX.sym("X", n_states, n_free + n_states)
        u = ca.SX.sym("u", model.n_inputs)
        t = ca.SX.sym("t")

        def slopes(value: ca.SX) -> ca.SX:
            """Those of a function of x and theta in the unknowns, as one column."""
            by_states = ca.jacobian(value, x) @ X
            by_theta = ca.jacobian(value, theta)
            direct = ca.horzcat(by_theta, ca.SX(n_states, n_states))
            return ca.vec(ca.densify(by_states + direct))

        f = model.rhs()(x, u, t, theta)
        y = model.output()(x, u, t, theta)
        states = ca.vertcat(x, theta, ca.vec(X))
        constant = ca.SX(n_free, 1)
        rate = ca.densify(ca.vertcat(f, constant, slopes(f)))
        rhs = ca.Function("sensitivities", [states, u, t], [rate])
        output = ca.Function("shown", [states, u, t], [y, slopes(y)])
        return cls(n_states, n_free, Runs(rhs, n_states), output)

    def start(self, z: np.ndarray) -> np.ndarray:
        """The states at the first sample, from the unknowns z (n_unknowns,)."""
        theta = z[: self.n_free]
        x0 = z[self.n_free :]
        by_theta = np.zeros((self.n_states, self.n_free))
        slopes = np.hstack([by_theta, np.eye(self.n_states)])
        return np.r_[x0, theta, slopes.T.ravel()]

"""What the log evidence would gain by processes that are not there yet.

At white noise alone, the evidence has a slope and a curvature in the variance of every
process that could act beside the model. One factorisation, without any process in it,
gives them for many processes at once, and the Newton step that they promise says
whether a search is worth its time. (A score test of variance components: Lin,
Biometrika 84, 1997; the curvature is the average information of `ascent`, and traces
are those of random signs.)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_matrix

from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.marginal_likelihood import (
    MarginalLikelihood,
    whitener_of_force,
    whitener_of_sensor,
)
from phsi_opt.model_error.processes import Process, Whitener
from phsi_opt.optimization.bounded_least_squares import bounded_least_squares
from phsi_opt.statistics import TINY
from phsi_opt.transcription.elimination import RIDGE

SIGN_SEED = 0  # of the random signs: the same every time
# Random vectors for every group of processes: a slope is then known to about a third of
# its standard deviation.
N_SIGNS = 8
# Slope, in standard deviations, below which a process is as unwanted as any: that of a
# channel whose residuals are zero is beyond numbers.
MOST_UNWANTED = -1e6
ALMOST_NONE = 1e-9  # share of the information that is added where there is none


@dataclass(frozen=True)
class PromisedGain:
    """What the first step of a search promises, of the log evidence.

    Attributes:
        forces: by forces.
        sensors: by processes of sensors.
    """

    forces: float = 0.0
    sensors: float = 0.0


@dataclass(frozen=True, eq=False)
class _Shifts:
    """Changes of the data and of the dynamics, a column each.

    Attributes:
        values: (n_values, k).
        dynamics: (n_intervals * n_states, k).
    """

    values: np.ndarray
    dynamics: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence["_Shifts"]) -> "_Shifts":
        """All columns side by side."""
        values = np.hstack([part.values for part in parts])
        return cls(values, np.hstack([part.dynamics for part in parts]))


@dataclass(frozen=True, eq=False)
class _Component:
    """A process of size one that could act beside the model.

    Attributes:
        problem: the linearised record.
        whitener: of its values.
        effects: of a force, what its values do to the dynamics; None: of a sensor.
        shown: of a sensor, places of the measured values that it is added to.
    """

    problem: Linearization
    whitener: Whitener
    effects: csc_matrix | None = None
    shown: np.ndarray | None = None

    @classmethod
    def of_force(cls, problem: Linearization, force: Process) -> "_Component":
        whitener = whitener_of_force(problem, force)
        return cls(problem, whitener, problem.dynamics_of_force(force.place))

    @classmethod
    def of_sensor(cls, problem: Linearization, sensor: Process) -> "_Component":
        whitener = whitener_of_sensor(problem, sensor)
        return cls(problem, whitener, shown=problem.values_of(sensor.place))

    @property
    def n(self) -> int:
        """Number of its values."""
        return len(self.whitener.diagonal)

    def shifts(self, values: np.ndarray) -> _Shifts:
        """What its values (n, k) do.

        What a force adds to the states, the data would show; so it is taken from the
        dynamics where it is added to the data.
        """
        problem = self.problem
        k = values.shape[1]
        shown = np.zeros((problem.n_values, k))
        dynamics = np.zeros((problem.dynamics_in_states.shape[0], k))
        if self.effects is not None:
            dynamics = -np.asarray(self.effects @ values)
        else:
            shown[self.shown] = values
        return _Shifts(shown, dynamics)

    def felt(self, left: _Shifts) -> np.ndarray:
        """What it would take to bring down what is left, (n, k)."""
        if self.effects is not None:
            return np.asarray(self.effects.T @ left.dynamics)
        return left.values[self.shown]


class WhiteRecord:
    """A linearised record under white noise alone, ready to be asked.

    Args:
        likelihood: of a structure without processes; functions of states may be in it.
        white: the noise, and functions of any size.

    Attributes:
        border: what is left for parameters and functions.
        left: what states and parameters leave of the data, without any function.

    Raises:
        SolveError: the states do not follow from the data.
    """

    def __init__(self, likelihood: MarginalLikelihood, white: Disturbances) -> None:
        self.problem = likelihood.problem
        self._likelihood = likelihood
        self._parts = likelihood.eliminated(white)
        self.border = likelihood.border_of(self._parts)
        n_theta = self.border.n_theta
        self._in_shown = likelihood.border_in_shown[:, :n_theta]
        self._right = self._parts.right[:, :n_theta]
        self._solved = self._parts.solved[:, :n_theta]
        ridge = RIDGE * np.eye(n_theta)
        self._information = self.border.information[:n_theta, :n_theta] + ridge
        residual = self.problem.residual[:, None]
        self._data = _Shifts(residual, -self.problem.offset[:, None])
        self.left = self._left(self._data)

    def _left(self, shifts: _Shifts) -> _Shifts:
        """What states and parameters leave of shifts, weighted by the noise.

        Of the values, and as multipliers of the dynamics.
        """
        likelihood = self._likelihood
        n = likelihood.n_unknowns
        weights = self._parts.weights[:, None]
        weighted = weights * shifts.values
        inner = np.vstack([likelihood.shown.T @ weighted, shifts.dynamics])
        answer = self._parts.factors.solve(inner)
        in_theta = self._in_shown.T @ weighted - self._right.T @ answer
        theta = np.linalg.solve(self._information, in_theta)
        answer -= self._solved @ theta
        shown = likelihood.shown @ answer[:n] + self._in_shown @ theta
        return _Shifts(weights * (shifts.values - shown), answer[n:])

    def promised_gains(
        self, trials: Sequence["Trial"], channels: Sequence[int]
    ) -> "list[PromisedGain]":
        """Gains of the log evidence by the processes of each trial.

        What few columns need is solved for together; the random signals of each trial
        by themselves, so that memory does not grow with the trials.

        Args:
            trials: processes that could act.
            channels: states whose noise is estimated, and would follow.
        """
        together = []
        for trial in trials:
            components = self._components(trial)
            together.append(_Asked(components, self.left, len(trial.forces)))
        worth_asking = [asked for asked in together if asked.components]
        if worth_asking:
            self._set_information(worth_asking, channels)
            self._set_excess(worth_asking)
        return [asked.gain for asked in together]

    def _components(self, trial: "Trial") -> list[_Component]:
        components = []
        for force in trial.forces:
            components.append(_Component.of_force(self.problem, force))
        for sensor in trial.sensors:
            components.append(_Component.of_sensor(self.problem, sensor))
        return components

    def _set_information(
        self, together: Sequence["_Asked"], channels: Sequence[int]
    ) -> None:
        """Average information about variances, while noises follow them."""
        noise = self._noise_shifts(channels)
        moved = [shift for asked in together for shift in asked.moved()]
        shifts = _Shifts.joined([noise, *moved])
        products = _products(shifts, self._left(shifts)) / 2
        n = len(channels)
        of_noise = np.linalg.pinv(products[:n, :n], hermitian=True)
        first = n
        for asked in together:
            own = slice(first, first + len(asked.components))
            mixed = products[own, :n]
            asked.information = products[own, own] - mixed @ of_noise @ mixed.T
            first = own.stop

    def _set_excess(self, together: Sequence["_Asked"]) -> None:
        """Slopes of the log evidence in the variances times their sizes."""
        for asked in together:
            asked.set_excess(self._left(asked.signalled()))

    def _noise_shifts(self, channels: Sequence[int]) -> _Shifts:
        """How the data would move with the logarithm of each channel's noise."""
        residual = self.left.values / self._parts.weights[:, None]
        is_in = self.problem.channel[:, None] == np.array(channels, dtype=int)
        shifts = np.where(is_in, 2 * residual, 0.0)
        return _Shifts(shifts, np.zeros((len(self.left.dynamics), len(channels))))


@dataclass(frozen=True)
class Trial:
    """Processes that could act together, each at its time; their sizes do not matter.

    Attributes:
        forces: that could act.
        sensors: processes that could add to what is shown.
    """

    forces: Sequence[Process]
    sensors: Sequence[Process]


class _Asked:
    """The components of a trial, and what the record says of them.

    Args:
        components: forces first.
        left: what states and parameters leave of the data.
        n_forces: number of forces.

    Attributes:
        information: (n, n) about the variances.
        excess: (n,) slopes of the log evidence in the variances times their sizes.
    """

    def __init__(
        self, components: Sequence[_Component], left: _Shifts, n_forces: int
    ) -> None:
        self.components = components
        self.felt = [component.felt(left) for component in components]
        self.n_forces = n_forces
        self.information = np.zeros((0, 0))
        self.excess = np.zeros(0)
        self._signals: list[np.ndarray] = []

    @property
    def size(self) -> np.ndarray:
        """Root of the information about each variance, (n,)."""
        return np.sqrt(np.maximum(np.diag(self.information), TINY))

    def moved(self) -> list[_Shifts]:
        """What each component does to the data where it follows what it feels."""
        moved = []
        for component, own in zip(self.components, self.felt, strict=True):
            values = component.whitener.covariance_times(own)
            moved.append(component.shifts(values))
        return moved

    def signalled(self) -> _Shifts:
        """What random signals of all components do together, a column per sign."""
        rng = np.random.default_rng(SIGN_SEED)
        self._signals = []
        shifts = []
        for component, scale in zip(self.components, self.size, strict=True):
            signs = rng.choice([-1.0, 1.0], (component.n, N_SIGNS))
            signal = component.whitener.coloured(signs) / np.sqrt(scale)
            self._signals.append(signal)
            shifts.append(component.shifts(signal))
        return _Shifts(
            np.sum([shift.values for shift in shifts], axis=0),
            np.sum([shift.dynamics for shift in shifts], axis=0),
        )

    def set_excess(self, left: _Shifts) -> None:
        """From what is left of the signals."""
        slopes = []
        for component, signal, own, scale in zip(
            self.components, self._signals, self.felt, self.size, strict=True
        ):
            by_chance = np.sum(signal * component.felt(left)) / N_SIGNS
            seen = np.sum(component.whitener.factor_of(own) ** 2) / scale
            slopes.append((seen - by_chance) / 2)
        self.excess = np.maximum(slopes, MOST_UNWANTED)

    @property
    def gain(self) -> PromisedGain:
        """What the first step of a search promises."""
        size = self.size
        with np.errstate(over="ignore"):  # a component that leaves no trace
            correlation = self.information / np.outer(size, size)
        information = np.clip(correlation, -1.0, 1.0)
        of_forces = slice(0, self.n_forces)
        of_sensors = slice(self.n_forces, len(size))
        return PromisedGain(
            _gain(self.excess[of_forces], information[of_forces, of_forces]),
            _gain(self.excess[of_sensors], information[of_sensors, of_sensors]),
        )


def _products(shifts: _Shifts, left: _Shifts) -> np.ndarray:
    """Products of shifts with what is left of shifts, (k, k)."""
    products = shifts.values.T @ left.values - shifts.dynamics.T @ left.dynamics
    return (products + products.T) / 2


def _gain(slopes: np.ndarray, information: np.ndarray) -> float:
    """The most that a quadratic rises by variances that are not negative.

    Args:
        slopes: (n,) at zero.
        information: (n, n), of diagonal one.
    """
    if not np.any(slopes > 0):
        return 0.0
    ridge = ALMOST_NONE * np.eye(len(slopes))
    free = np.linalg.solve(information + ridge, slopes)
    if np.all(free >= 0):
        return float(slopes @ free - free @ information @ free / 2)
    lower = np.linalg.cholesky(information + ridge)
    right = np.linalg.solve(lower, slopes)
    none = np.zeros(len(slopes))
    found = bounded_least_squares(lower.T, right, none, none + np.inf)
    return float(slopes @ found - found @ information @ found / 2)

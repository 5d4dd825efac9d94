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
    def none(cls, problem: Linearization, k: int) -> "_Shifts":
        """Columns that change nothing yet."""
        n_dynamics = problem.dynamics_in_states.shape[0]
        return cls(np.zeros((problem.n_values, k)), np.zeros((n_dynamics, k)))

    @classmethod
    def joined(cls, parts: Sequence["_Shifts"]) -> "_Shifts":
        """All columns side by side."""
        values = np.hstack([part.values for part in parts])
        return cls(values, np.hstack([part.dynamics for part in parts]))


@dataclass(frozen=True, eq=False)
class _Component:
    """A process that could act beside the model.

    Attributes:
        whitener: of its values at size one.
        size: its own.
        effects: of a force, what its values do to the dynamics; None: of a sensor.
        shown: of a sensor, places of the measured values that it is added to.
    """

    whitener: Whitener
    size: float
    effects: csc_matrix | None = None
    shown: np.ndarray | None = None

    @classmethod
    def of_force(cls, problem: Linearization, force: Process) -> "_Component":
        whitener = whitener_of_force(problem, force)
        return cls(whitener, force.size, problem.dynamics_of_force(force.place))

    @classmethod
    def of_sensor(cls, problem: Linearization, sensor: Process) -> "_Component":
        whitener = whitener_of_sensor(problem, sensor)
        shown = problem.values_of(sensor.place)
        return cls(whitener, sensor.size, shown=shown)

    @property
    def n(self) -> int:
        """Number of its values."""
        return len(self.whitener.diagonal)

    def add(self, values: np.ndarray, shifts: _Shifts) -> None:
        """Add what its values (n, k) do.

        What a force adds to the states, the data would show; so it is taken from the
        dynamics where it is added to the data.
        """
        if self.effects is not None:
            shifts.dynamics[:] -= self.effects @ (self.size * values)
        else:
            shifts.values[self.shown] += self.size * values

    def felt(self, left: _Shifts) -> np.ndarray:
        """What it would take to bring down what is left, (n, k)."""
        if self.effects is not None:
            return self.size * np.asarray(self.effects.T @ left.dynamics)
        return self.size * left.values[self.shown]


@dataclass(frozen=True, eq=False)
class _Kind:
    """Components whose variances share a factor: of small systems one alone.

    Attributes:
        components: with sizes in the ratios that they keep.
    """

    components: Sequence[_Component]

    def add(self, values: Sequence[np.ndarray], shifts: _Shifts) -> None:
        """Add what the values (n, k) of its components do."""
        for component, own in zip(self.components, values, strict=True):
            component.add(own, shifts)

    def felt(self, left: _Shifts) -> list[np.ndarray]:
        """What it would take of each component to bring down what is left, (n, k)."""
        return [component.felt(left) for component in self.components]

    def covariance_times(self, felt: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Of what each component feels, (n, k)."""
        moved = []
        for component, own in zip(self.components, felt, strict=True):
            moved.append(component.whitener.covariance_times(own))
        return moved

    def seen(self, felt: Sequence[np.ndarray]) -> float:
        """What is felt, squared, as far as the kind could bring it down."""
        seen = 0.0
        for component, own in zip(self.components, felt, strict=True):
            seen += float(np.sum(component.whitener.factor_of(own) ** 2))
        return seen

    def signals(self, rng: np.random.Generator, scale: float) -> list[np.ndarray]:
        """Values of its components by random signs over the scale, (n, N_SIGNS)."""
        signals = []
        for component in self.components:
            signs = rng.choice([-1.0, 1.0], (component.n, N_SIGNS))
            signals.append(component.whitener.coloured(signs) / np.sqrt(scale))
        return signals


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
        together = [_Asked.of(self.problem, trial, self.left) for trial in trials]
        worth_asking = [asked for asked in together if asked.kinds]
        if worth_asking:
            are_tied = any(trial.is_tied for trial in trials)
            self._set_information(worth_asking, _groups(channels, are_tied))
            self._set_excess(worth_asking)
        return [asked.gain for asked in together]

    def _set_information(
        self, together: Sequence["_Asked"], groups: Sequence[Sequence[int]]
    ) -> None:
        """Average information about variances, while noises follow them."""
        noise = self._noise_shifts(groups)
        moved = [shift for asked in together for shift in asked.moved()]
        shifts = _Shifts.joined([noise, *moved])
        products = _products(shifts, self._left(shifts)) / 2
        n = len(groups)
        of_noise = np.linalg.pinv(products[:n, :n], hermitian=True)
        first = n
        for asked in together:
            own = slice(first, first + len(asked.kinds))
            mixed = products[own, :n]
            asked.information = products[own, own] - mixed @ of_noise @ mixed.T
            first = own.stop

    def _set_excess(self, together: Sequence["_Asked"]) -> None:
        """Slopes of the log evidence in the variances times their sizes."""
        for asked in together:
            asked.set_excess(self._left(asked.signalled()))

    def _noise_shifts(self, groups: Sequence[Sequence[int]]) -> _Shifts:
        """How the data would move with the logarithm of each group's noise."""
        residual = self.left.values / self._parts.weights[:, None]
        shifts = _Shifts.none(self.problem, len(groups))
        for number, channels in enumerate(groups):
            is_in = np.isin(self.problem.channel, channels)
            shifts.values[is_in, number] = 2 * residual[is_in, 0]
        return shifts


@dataclass(frozen=True)
class Trial:
    """Processes that could act together, each at its time.

    Attributes:
        forces: that could act.
        sensors: processes that could add to what is shown.
        is_tied: whether those of one kind share a factor, as in a search; otherwise
            sizes do not matter.
    """

    forces: Sequence[Process]
    sensors: Sequence[Process]
    is_tied: bool = False


class _Asked:
    """The processes of a trial, and what the record says of them.

    Args:
        problem: the linearised record.
        kinds: those of forces first.
        left: what states and parameters leave of the data.
        n_forces: number of kinds of forces.

    Attributes:
        information: (n, n) about the variances.
        excess: (n,) slopes of the log evidence in the variances times their sizes.
    """

    def __init__(
        self,
        problem: Linearization,
        kinds: Sequence[_Kind],
        left: _Shifts,
        n_forces: int,
    ) -> None:
        self._problem = problem
        self.kinds = kinds
        self.felt = [kind.felt(left) for kind in kinds]
        self.n_forces = n_forces
        self.information = np.zeros((0, 0))
        self.excess = np.zeros(0)
        self._signals: list[list[np.ndarray]] = []

    @classmethod
    def of(cls, problem: Linearization, trial: Trial, left: _Shifts) -> "_Asked":
        """About a trial."""
        forces = [_Component.of_force(problem, force) for force in trial.forces]
        sensors = [_Component.of_sensor(problem, sensor) for sensor in trial.sensors]
        of_forces = _kinds(forces, trial.is_tied)
        kinds = of_forces + _kinds(sensors, trial.is_tied)
        return cls(problem, kinds, left, len(of_forces))

    @property
    def size(self) -> np.ndarray:
        """Root of the information about each variance, (n,)."""
        return np.sqrt(np.maximum(np.diag(self.information), TINY))

    def moved(self) -> list[_Shifts]:
        """What each kind does to the data where it follows what it feels."""
        moved = []
        for kind, own in zip(self.kinds, self.felt, strict=True):
            shifts = _Shifts.none(self._problem, 1)
            kind.add(kind.covariance_times(own), shifts)
            moved.append(shifts)
        return moved

    def signalled(self) -> _Shifts:
        """What random signals of all kinds do together, a column per sign."""
        rng = np.random.default_rng(SIGN_SEED)
        self._signals = []
        together = _Shifts.none(self._problem, N_SIGNS)
        for kind, scale in zip(self.kinds, self.size, strict=True):
            signals = kind.signals(rng, scale)
            self._signals.append(signals)
            kind.add(signals, together)
        return together

    def set_excess(self, left: _Shifts) -> None:
        """From what is left of the signals."""
        slopes = []
        for kind, signals, own, scale in zip(
            self.kinds, self._signals, self.felt, self.size, strict=True
        ):
            by_chance = _product(signals, kind.felt(left)) / N_SIGNS
            slopes.append((kind.seen(own) / scale - by_chance) / 2)
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


def _groups(channels: Sequence[int], is_tied: bool) -> list[Sequence[int]]:
    """Channels whose noises share a factor."""
    if is_tied:
        return [channels] if channels else []
    return [[channel] for channel in channels]


def _kinds(components: Sequence[_Component], is_tied: bool) -> list[_Kind]:
    """Components of one kind, together or one by one."""
    if is_tied:
        return [_Kind(components)] if components else []
    return [_Kind([component]) for component in components]


def _product(some: Sequence[np.ndarray], others: Sequence[np.ndarray]) -> float:
    """Sum of the products of their values."""
    products = 0.0
    for one, other in zip(some, others, strict=True):
        products += float(np.sum(one * other))
    return products


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

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

    def add_covariance_times(self, left: _Shifts, shifts: _Shifts) -> None:
        """Add its covariance times what is left, to the one column of shifts."""
        for component in self.components:
            felt = component.felt(left)
            component.add(component.whitener.covariance_times(felt), shifts)

    def seen(self, left: _Shifts) -> float:
        """What is left, squared, as far as the kind could bring it down."""
        seen = 0.0
        for component in self.components:
            felt = component.felt(left)
            seen += float(np.sum(component.whitener.factor_of(felt) ** 2))
        return seen

    def signals(self, rng: np.random.Generator) -> list[np.ndarray]:
        """Values of its components by random signs, (n, N_SIGNS) each."""
        signals = []
        for component in self.components:
            signs = rng.choice([-1.0, 1.0], (component.n, N_SIGNS))
            signals.append(component.whitener.coloured(signs))
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
        alone = self._parts.factors.solve(inner)
        in_theta = self._in_shown.T @ weighted - self._right.T @ alone
        theta = np.linalg.solve(self._information, in_theta)
        answer = alone - self._solved @ theta
        shown = likelihood.shown @ answer[:n] + self._in_shown @ theta
        return _Shifts(weights * (shifts.values - shown), answer[n:])

    def promised_gain(
        self,
        forces: Sequence[Process],
        sensors: Sequence[Process],
        channels: Sequence[int],
        is_tied: bool = False,
    ) -> PromisedGain:
        """Gains of the log evidence by forces, and by sensors' processes.

        Args:
            forces: that could act, each at its time; their sizes do not matter, but for
                their ratios where sizes are tied.
            sensors: processes that could add to what is shown, likewise.
            channels: states whose noise is estimated, and would follow.
            is_tied: whether sizes of one kind share a factor, as in a search.
        """
        of_forces = [_Component.of_force(self.problem, force) for force in forces]
        of_sensors = [_Component.of_sensor(self.problem, own) for own in sensors]
        force_kinds = _kinds(of_forces, is_tied)
        kinds = force_kinds + _kinds(of_sensors, is_tied)
        if not kinds:
            return PromisedGain()
        information = self._information_about(kinds, _groups(channels, is_tied))
        size = np.sqrt(np.maximum(np.diag(information), TINY))
        excess = self._excess(kinds, size)
        with np.errstate(over="ignore"):  # a component that leaves no trace
            correlation = information / np.outer(size, size)
        information = np.clip(correlation, -1.0, 1.0)
        first = slice(0, len(force_kinds))
        others = slice(len(force_kinds), len(kinds))
        return PromisedGain(
            _gain(excess[first], information[first, first]),
            _gain(excess[others], information[others, others]),
        )

    def _information_about(
        self, kinds: Sequence[_Kind], groups: Sequence[Sequence[int]]
    ) -> np.ndarray:
        """Average information about variances, while noises follow them, (n, n)."""
        moved = []
        for kind in kinds:
            shifts = _Shifts.none(self.problem, 1)
            kind.add_covariance_times(self.left, shifts)
            moved.append(shifts)
        asked = _Shifts.joined([self._noise_shifts(groups), *moved])
        products = _products(asked, self._left(asked)) / 2
        n = len(groups)
        mixed = products[n:, :n]
        of_noise = np.linalg.pinv(products[:n, :n], hermitian=True)
        information: np.ndarray = products[n:, n:] - mixed @ of_noise @ mixed.T
        return information

    def _excess(self, kinds: Sequence[_Kind], size: np.ndarray) -> np.ndarray:
        """Slopes of the log evidence in the variances times their ``size``, (n,)."""
        rng = np.random.default_rng(SIGN_SEED)
        together = _Shifts.none(self.problem, N_SIGNS)
        signals = []
        for kind, scale in zip(kinds, size, strict=True):
            own = [signal / np.sqrt(scale) for signal in kind.signals(rng)]
            for component, signal in zip(kind.components, own, strict=True):
                component.add(signal, together)
            signals.append(own)
        left = self._left(together)
        slopes = []
        for kind, own, scale in zip(kinds, signals, size, strict=True):
            by_chance = 0.0
            for component, signal in zip(kind.components, own, strict=True):
                by_chance += np.sum(signal * component.felt(left)) / N_SIGNS
            slopes.append((kind.seen(self.left) / scale - by_chance) / 2)
        return np.maximum(slopes, MOST_UNWANTED)

    def _noise_shifts(self, groups: Sequence[Sequence[int]]) -> _Shifts:
        """How the data would move with the logarithm of each group's noise."""
        residual = self.left.values / self._parts.weights[:, None]
        shifts = _Shifts.none(self.problem, len(groups))
        for number, channels in enumerate(groups):
            is_in = np.isin(self.problem.channel, channels)
            shifts.values[is_in, number] = 2 * residual[is_in, 0]
        return shifts


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
    if not len(slopes):
        return 0.0
    ridge = ALMOST_NONE * np.eye(len(slopes))
    lower = np.linalg.cholesky(information + ridge)
    right = np.linalg.solve(lower, slopes)
    none = np.zeros(len(slopes))
    found = bounded_least_squares(lower.T, right, none, none + np.inf)
    return float(slopes @ found - found @ information @ found / 2)

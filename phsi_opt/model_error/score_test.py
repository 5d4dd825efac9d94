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
from functools import cached_property

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix

from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.marginal_likelihood import (
    MarginalLikelihood,
    solve_border,
    whitener_of_force,
    whitener_of_sensor,
)
from phsi_opt.model_error.processes import Process, Whitener
from phsi_opt.model_error.signs import random_signs
from phsi_opt.optimization.bounded_least_squares import bounded_least_squares
from phsi_opt.statistics import TINY
from phsi_opt.transcription.elimination import RIDGE

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
        """No change, to be added to; column after column in memory."""
        n_dynamics = problem.dynamics_in_states.shape[0]
        values = np.zeros((problem.n_values, k), order="F")
        return cls(values, np.zeros((n_dynamics, k), order="F"))

    def columns(self, chosen: slice) -> "_Shifts":
        """Some of the columns; the same memory."""
        return _Shifts(self.values[:, chosen], self.dynamics[:, chosen])


@dataclass(frozen=True, eq=False)
class _Place:
    """Where processes act, and what the data say there.

    Attributes:
        effects: of a force, what its values do to the dynamics; None: of a sensor.
        transposed: the same, transposed.
        shown: of a sensor, places of the measured values that it is added to.
    """

    effects: csc_matrix | None = None
    transposed: csr_matrix | None = None
    shown: np.ndarray | None = None

    @classmethod
    def of_force(cls, effects: csc_matrix) -> "_Place":
        """Of a force with these effects."""
        return cls(effects, effects.T)

    def add(self, shifts: _Shifts, values: np.ndarray) -> None:
        """Add what values (n, k) do to shifts.

        What a force adds to the states, the data would show; so it is taken from the
        dynamics where it is added to the data.
        """
        if self.effects is not None:
            shifts.dynamics[:] -= self.effects @ values
        else:
            shifts.values[self.shown] += values

    def felt(self, left: _Shifts) -> np.ndarray:
        """What it would take to bring down what is left, (n, k)."""
        if self.transposed is not None:
            return np.asarray(self.transposed @ left.dynamics)
        return left.values[self.shown]


@dataclass(frozen=True, eq=False)
class _Component:
    """A process that could act beside the model, of its own size.

    Attributes:
        place: where it acts.
        whitener: of its values at size one.
        size: its own.
        felt: (n, 1) what it would take to bring down what is left of the data.
    """

    place: _Place
    whitener: Whitener
    size: float
    felt: np.ndarray

    @property
    def n(self) -> int:
        """Number of its values."""
        return len(self.whitener.diagonal)

    @cached_property
    def factor(self) -> np.ndarray:
        """F'F is the variance that the prior gives what is felt, (n, 1)."""
        return self.whitener.factor_of(self.felt)

    def add(self, shifts: _Shifts, values: np.ndarray) -> None:
        """Add what its values (n, k) do."""
        self.place.add(shifts, self.size * values)

    def felt_of(self, left: _Shifts) -> np.ndarray:
        """What it would take to bring down what is left, (n, k)."""
        return self.size * self.place.felt(left)


@dataclass(frozen=True, eq=False)
class _Kind:
    """Components whose variances share a factor: of small systems one alone.

    Attributes:
        components: with sizes in the ratios that they keep.
    """

    components: Sequence[_Component]

    def add_moved(self, shifts: _Shifts) -> None:
        """Add what they do to the data where they follow what they feel, one column."""
        for component in self.components:
            component.add(shifts, component.whitener.coloured(component.factor))

    @property
    def seen(self) -> float:
        """What is felt, squared, as far as the kind could bring it down."""
        return float(sum(np.sum(one.factor**2) for one in self.components))


@dataclass(frozen=True, eq=False)
class _Signal:
    """A random signal of a component.

    Attributes:
        component: whose it is.
        values: (n, N_SIGNS).
    """

    component: _Component
    values: np.ndarray

    def product(self, left: _Shifts) -> float:
        """With what the component feels of what is left."""
        return float(np.sum(self.values * self.component.felt_of(left)))


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
        data = _Shifts(residual, -self.problem.offset[:, None])
        self.left = self._answered(data, self._parts.solved[:, -1:].copy())

    def _left(self, shifts: _Shifts) -> _Shifts:
        """What states and parameters leave of shifts, weighted by the noise.

        Of the values, and as multipliers of the dynamics.
        """
        likelihood = self._likelihood
        n = likelihood.n_unknowns
        shape = (n + len(shifts.dynamics), shifts.values.shape[1])
        inner = np.empty(shape, order="F")
        weighted = self._parts.weights[:, None] * shifts.values
        inner[:n] = likelihood.shown_transposed @ weighted
        inner[n:] = shifts.dynamics
        return self._answered(shifts, self._parts.factors.solve(inner))

    def _answered(self, shifts: _Shifts, answer: np.ndarray) -> _Shifts:
        """The same, once the states have answered; their answer is written over."""
        likelihood = self._likelihood
        n = likelihood.n_unknowns
        weights = self._parts.weights[:, None]
        in_theta = self._in_shown.T @ (weights * shifts.values)
        # The matrix is symmetric: what was solved for the parameters serves again.
        in_theta -= self._right.T @ answer
        theta = solve_border(self._information, in_theta)
        answer -= self._solved @ theta
        shown = likelihood.shown @ answer[:n] + self._in_shown @ theta
        return _Shifts(weights * (shifts.values - shown), answer[n:])

    def promised_gains(
        self, trials: Sequence["Trial"], channels: Sequence[int]
    ) -> "list[PromisedGain]":
        """Gains of the log evidence by the processes of each trial.

        What few columns need is solved for together; the random signals of each trial
        by themselves: fresh memory costs more than a further call.

        Args:
            trials: processes that could act.
            channels: states whose noise is estimated, and would follow.
        """
        places = _Places(self)
        together = [places.asked(trial) for trial in trials]
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
        n = len(groups)
        n_kinds = sum(len(asked.kinds) for asked in together)
        shifts = _Shifts.none(self.problem, n + n_kinds)
        self._add_noise(shifts.columns(slice(0, n)), groups)
        owned = []
        first = n
        for asked in together:
            owned.append(slice(first, first + len(asked.kinds)))
            asked.add_moved(shifts.columns(owned[-1]))
            first = owned[-1].stop
        products = _products(shifts, self._left(shifts)) / 2
        of_noise = np.linalg.pinv(products[:n, :n], hermitian=True)
        for asked, own in zip(together, owned, strict=True):
            mixed = products[own, :n]
            asked.information = products[own, own] - mixed @ of_noise @ mixed.T

    def _set_excess(self, together: Sequence["_Asked"]) -> None:
        """Slopes of the log evidence in the variances times their sizes."""
        for asked in together:
            shifts = _Shifts.none(self.problem, N_SIGNS)
            asked.add_signals(shifts)
            asked.set_excess(self._left(shifts))

    def _add_noise(self, shifts: _Shifts, groups: Sequence[Sequence[int]]) -> None:
        """Add how the data would move with the logarithm of each group's noise."""
        residual = self.left.values / self._parts.weights[:, None]
        for number, channels in enumerate(groups):
            is_in = np.isin(self.problem.channel, channels)
            shifts.values[is_in, number] += 2 * residual[is_in, 0]


class _Places:
    """The places of a record's processes, each made once for all trials.

    Args:
        record: the record, with what is left of its data.
    """

    def __init__(self, record: WhiteRecord) -> None:
        self._problem = record.problem
        self._left = record.left
        self._made: dict[tuple[str, int], tuple[_Place, np.ndarray]] = {}

    def asked(self, trial: "Trial") -> "_Asked":
        """A trial's kinds, forces first."""
        problem = self._problem
        forces = []
        for force in trial.forces:
            whitener = whitener_of_force(problem, force)
            forces.append(self._component("force", force, whitener))
        sensors = []
        for sensor in trial.sensors:
            whitener = whitener_of_sensor(problem, sensor)
            sensors.append(self._component("sensor", sensor, whitener))
        of_forces = _kinds(forces, trial.is_tied)
        kinds = of_forces + _kinds(sensors, trial.is_tied)
        return _Asked(kinds, len(of_forces))

    def _component(self, kind: str, process: Process, whitener: Whitener) -> _Component:
        place, felt = self._place(kind, process.place)
        return _Component(place, whitener, process.size, process.size * felt)

    def _place(self, kind: str, number: int) -> tuple[_Place, np.ndarray]:
        if (kind, number) not in self._made:
            if kind == "force":
                place = _Place.of_force(self._problem.dynamics_of_force(number))
            else:
                place = _Place(shown=self._problem.values_of(number))
            self._made[kind, number] = (place, place.felt(self._left))
        return self._made[kind, number]


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
        kinds: those of forces first.
        n_forces: number of kinds of forces.

    Attributes:
        information: (n, n) about the variances.
        excess: (n,) slopes of the log evidence in the variances times their sizes.
    """

    def __init__(self, kinds: Sequence[_Kind], n_forces: int) -> None:
        self.kinds = kinds
        self.n_forces = n_forces
        self.information = np.zeros((0, 0))
        self.excess = np.zeros(0)
        self._signals: list[list[_Signal]] = []

    @property
    def size(self) -> np.ndarray:
        """Root of the information about each variance, (n,)."""
        return np.sqrt(np.maximum(np.diag(self.information), TINY))

    def add_moved(self, shifts: _Shifts) -> None:
        """Add what each kind does to the data where it follows what it feels.

        Args:
            shifts: a column per kind.
        """
        for k, kind in enumerate(self.kinds):
            kind.add_moved(shifts.columns(slice(k, k + 1)))

    def add_signals(self, shifts: _Shifts) -> None:
        """Add what random signals of all components do together.

        Args:
            shifts: a column per sign.
        """
        lengths = [one.n for kind in self.kinds for one in kind.components]
        signs = iter(random_signs(tuple(lengths), N_SIGNS))
        self._signals = []
        for kind, scale in zip(self.kinds, self.size, strict=True):
            signals = []
            for one in kind.components:
                values = one.whitener.coloured(next(signs)) / np.sqrt(scale)
                signals.append(_Signal(one, values))
                one.add(shifts, values)
            self._signals.append(signals)

    def set_excess(self, left: _Shifts) -> None:
        """From what is left of the signals."""
        slopes = []
        for kind, signals, scale in zip(
            self.kinds, self._signals, self.size, strict=True
        ):
            by_chance = sum(signal.product(left) for signal in signals) / N_SIGNS
            slopes.append((kind.seen / scale - by_chance) / 2)
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
